"""The runner of a search, which receives the next scenarios in advance and returns one run after the other.

A run is made in this process, in lock step with other runs, or in a different process. The choice depends on the ADS
and on the duration of a run. It affects only the time of the search, not its results. :func:`runner_for` combines the
parts.
"""

from __future__ import annotations

import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

from pytest_pafot.execution.crash_records import CrashRecord
from pytest_pafot.execution.prefetching import Isolated, LockStep, Processes
from pytest_pafot.execution.revision_policy import Elsewhere, RevisionPolicy
from pytest_pafot.execution.scenario_pool import Job
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Trace
from pytest_pafot.searching.evaluation import Chains, plain_chains
from pytest_pafot.world.driving.ads import is_vehicle_class, wants_env
from pytest_pafot.world.guard.own_worlds import rollout_of
from pytest_pafot.world.protocol import WorldLike, lock_stepping, resumable

# The decisions of an ADS in earlier runs, for runs that begin in the same way.

DECISIONS = 100_000
"""The largest number of cached decisions, which are about 300 runs of a minute at 5 Hz and take about 15 MB."""

_Key = tuple[object, ...]
_Actions = tuple[Any, ...]


class DecisionCache:
    """A cache of the decisions in the last runs of one ADS in one world, by the genes on which the decisions depended.

    Until the end of gene ``g``, a run depends only on the start and on the first ``g`` genes of each NPC. The last
    decision that depends only on these genes is at the tick at which the next gene begins. Two scenarios share
    decisions if their chains as driven are the same, or if their requested chains and their seeds are the same (see
    :class:`~pytest_pafot.searching.evaluation.EvaluationCache`).

    The cache is valid only for an ADS that decides only from its observation.

    Args:
        decisions: the largest number of cached decisions; the oldest runs are removed first.
    """

    def __init__(self, decisions: int = DECISIONS) -> None:
        self._room = decisions
        self._kept = 0
        self._known: dict[_Key, tuple[_Actions, int]] = {}
        self._runs: deque[tuple[_Actions, list[_Key]]] = deque()

    def remember(self, trace: Trace) -> None:
        """Cache the decisions of a run; they replace older decisions after the same genes."""
        actions, scenario = trace.actions, trace.scenario
        if not actions or len(actions) > self._room:
            return
        gene_ticks, every = round(scenario.gene_seconds * trace.physics_hz), trace.physics_hz // trace.ads_hz
        asked, driven = plain_chains(scenario), plain_chains(trace.executed)
        keys = []
        for genes in range(1, min(-(-trace.ticks // max(gene_ticks, 1)), scenario.genes) + 1):
            count = min(genes * gene_ticks // every + 1, len(actions))
            by_chains, by_seed = _key(scenario, driven, genes, None), _key(scenario, asked, genes, scenario.seed)
            by_both = [by_chains] if by_chains[-1] == by_seed[-1] else [by_chains, by_seed]
            for key in by_both:
                self._known[key] = (actions, count)
                keys.append(key)
        self._runs.append((actions, keys))
        self._kept += len(actions)
        while self._kept > self._room:
            oldest, keys = self._runs.popleft()
            self._kept -= len(oldest)
            for key in keys:
                if key in self._known and self._known[key][0] is oldest:  # unless a later run has replaced it
                    del self._known[key]

    def recall(self, scenario: Scenario) -> _Actions:
        """Return the cached decisions with which a run of a scenario begins; empty if there are none."""
        chains = plain_chains(scenario)
        for genes in range(scenario.genes, 0, -1):
            for seed in (None, scenario.seed):
                known = self._known.get(_key(scenario, chains, genes, seed))
                if known is not None:
                    actions, count = known
                    return actions[:count]
        return ()


def _key(scenario: Scenario, chains: Chains, genes: int, seed: int | None) -> _Key:
    shared = tuple([chain[:genes] for chain in chains])
    return scenario.ego_lane, scenario.ego_speed, scenario.gene_seconds, scenario.traffic, seed, shared


def runner_for(
    job: Job,
    record: CrashRecord,
    *,
    workers: int = 1,
    isolate: bool = False,
    executor: Executor | None = None,
    times_decisions: bool = False,
    clock: Callable[[], float] = time.perf_counter,
) -> Runner:
    """Return the runner of a job.

    Args:
        job: everything that a run needs.
        record: the open crash record of this process; the caller clears it after each verdict, and closes it.
        workers: the largest number of other processes; with 1, all runs are made in this process, unless ``isolate`` is
            set.
        isolate: True if the ADS must never run in this process.
        executor: an executor that makes the announced runs, and with ``isolate`` all runs; None for no executor.
        times_decisions: True if the duration of each decision matters. No decision is then cached or made for many runs
            at once.
        clock: a monotonic clock [s].

    Raises:
        WorldError: if the world cannot be used.
    """
    if isinstance(job.ads, RevisionPolicy):  # Its runs are in a process of its own already.
        job, workers, isolate, executor = replace(job, world=Elsewhere(job.world, job.ads)), 1, False, None
    if isolate:
        return Runner(job=job, record=record, processes=Isolated(job, workers=workers, executor=executor), clock=clock)
    is_asked = not (times_decisions or is_vehicle_class(job.ads) or wants_env(job.ads))
    can_lock_step = is_asked and executor is None and lock_stepping(job.world) is not None
    # This process makes the first runs, which show what the ADS can do and how long a run takes. Then the announced
    # runs are made in lock step if the ADS decides for many runs at once, or else in other processes if runs are slow.
    # Runs that were not announced, or that cannot be made elsewhere, are always made in this process.
    return Runner(
        job=job,
        record=record,
        processes=Processes(job, workers=workers, executor=executor),
        lock_step=LockStep(job, record, workers=workers) if can_lock_step else None,
        can_resume=not times_decisions and resumable(job.world) is not None,
        clock=clock,
    )


@contextmanager
def runner_here(world: WorldLike, ads: Callable[..., Any]) -> Iterator[Runner]:
    """Provide a runner for a command, which makes all runs in this process and writes only temporary crash records."""
    with tempfile.TemporaryDirectory(prefix="pafot-") as records:
        job = Job(world=world, ads=ads, records=Path(records), owner="command")
        with job.crash_record() as record, runner_for(job, record) as runner:
            yield runner


@dataclass(eq=False, kw_only=True)
class Runner:
    """A runner, which returns runs that were made in advance, and makes all other runs in this process.

    The end of a ``with`` statement ends the processes that the runner has started, at once after an exception, and
    drops the announced scenarios. The runner can still be used after that, also in a second ``with`` statement.

    If runs begin with the same situations, a pure ADS decides in them only once. Physics is always simulated, so a
    trace is the same to the last bit. That the ADS is pure is only a promise of the user, so the runs that decide on a
    finding are made without cached decisions.

    ``processes`` makes announced runs in advance. As soon as the ADS shows that it has ``batch``, ``lock_step`` makes
    them instead. With ``can_resume``, decisions are cached as soon as the ADS shows that it is pure.
    """

    job: Job
    record: CrashRecord
    processes: Processes
    lock_step: LockStep | None = None
    can_resume: bool = False
    clock: Callable[[], float]
    is_alone: bool = field(default=True, init=False)
    """True if the last run was made by itself, and not in lock step with other runs."""

    def __post_init__(self) -> None:
        self._prefetching: Processes | LockStep = self.processes
        self._decisions: DecisionCache | None = None
        is_of_interest = (self.lock_step is not None or self.can_resume) and not is_vehicle_class(self.job.ads)
        self._factory = self._showing(self.job.ads) if is_of_interest else self.job.ads

    @property
    def notes(self) -> list[str]:
        """Notes on how the runs were made; complete after the processes have ended."""
        return self._prefetching.notes

    @property
    def decides_for_many(self) -> bool:
        """True if the ADS has shown that it decides for many runs at once."""
        return self._prefetching is self.lock_step

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        self._prefetching.announce(())
        self.processes.close(at_once=kind is not None)

    def announce(self, scenarios: Iterable[Scenario]) -> None:
        """Announce the next scenarios in the order in which they will be requested; earlier ones are dropped."""
        self._prefetching.announce(scenarios)

    def run(self, scenario: Scenario, *, afresh: bool = False) -> Trace:
        """Return the trace of a run of a scenario.

        The crash record of the scenario stays on disk, because the evaluation of the run may end the process, too.

        Args:
            scenario: the scenario to run, announced or not.
            afresh: True if the ADS must make every decision of this run, without cached or common decisions.

        Raises:
            ProcessLostError: if the run was in a different process, which died or hung.
            ExecutionError: if the run must be in a different process, and none can be started.
            Exception: any exception of the world, the factory or the ADS's ``batch``.
        """
        __tracebackhide__ = True
        trace = self._prefetching.take(scenario, afresh=afresh)
        self.is_alone = trace is None or self._prefetching is not self.lock_step
        self.record.write(scenario, reference=self.job.reference)
        if trace is None:
            decisions = () if afresh or self._decisions is None else self._decisions.recall(scenario)
            started = self.clock()
            given = {"decisions": decisions} if decisions else {}  # the user's own world need not have this argument
            trace = rollout_of(self.job.world)(scenario, self._factory, **given)
            if not self.decides_for_many:
                self.processes.ran_here(self.clock() - started)
        if self._decisions is not None and self.is_alone:  # decisions of a batch may differ, so they are not cached
            self._decisions.remember(trace)
        return trace

    def _showing(self, factory: Callable[..., Any]) -> Callable[..., Any]:
        """Return a factory that inspects its first ADS, because the user's factory must be called only for runs."""

        def make(*arguments: Any, **named: Any) -> Any:
            __tracebackhide__ = True
            ads = factory(*arguments, **named)
            self._factory = factory
            if self.can_resume and getattr(ads, "pure", False) is True:
                self._decisions = DecisionCache()
            if self.lock_step is not None and callable(getattr(ads, "batch", None)):
                self.lock_step.announce(self.processes.announced)
                self._prefetching = self.lock_step
            return ads

        make.__wrapped__ = factory  # type: ignore[attr-defined]  # for inspect.signature
        return make
