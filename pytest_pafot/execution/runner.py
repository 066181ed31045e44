"""One way to run a scenario: a search announces which ones come, and asks for one run after the other.

Where a run is made depends on the ADS and on what a run costs: in this process, in lock step with others, or in
another process. Nothing but the time depends on it. :func:`runner_for` puts together who does what.
"""

from __future__ import annotations

import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from pytest_pafot.execution.crash_records import CrashRecord
from pytest_pafot.execution.prefetching import Isolated, LockStep, Processes
from pytest_pafot.execution.scenario_pool import Job
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Trace
from pytest_pafot.searching.evaluation_cache import Chains, plain_chains
from pytest_pafot.world.driving.ads import is_vehicle_class, wants_env
from pytest_pafot.world.protocol import WorldLike, lock_stepping, resumable

# What an ADS decided in earlier runs, for runs that begin alike.

DECISIONS = 100_000
"""Decisions kept at most: some 300 runs of a minute at five a second, which is about 15 MB."""

_Key = tuple[object, ...]
_Actions = tuple[Any, ...]


class DecisionCache:
    """Decisions of the last runs of one ADS in one world, found again by what they depended on.

    Up to the end of its gene ``g`` a run depends on the first ``g`` genes of each NPC and on the start alone; the
    decision at that very tick, before the next gene begins, is the last one that does. For what two scenarios must
    have in common see :class:`~pytest_pafot.searching.evaluation_cache.EvaluationCache`: the chains as driven, or as
    asked for with the seed. Where NPCs with Lane-Instructions start may be drawn by the seed, which is then always part
    of it.

    Only an ADS that decides from its observation alone decides the same there.

    Args:
        decisions: kept at most; the oldest runs are forgotten first.
    """

    def __init__(self, decisions: int = DECISIONS) -> None:
        self._room = decisions
        self._kept = 0
        self._known: dict[_Key, tuple[_Actions, int]] = {}
        self._runs: deque[tuple[_Actions, list[_Key]]] = deque()

    def remember(self, trace: Trace) -> None:
        """Keep the decisions of a run, in the place of older ones that were the same."""
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
            for key in by_both if scenario.positions else [by_seed]:
                self._known[key] = (actions, count)
                keys.append(key)
        self._runs.append((actions, keys))
        self._kept += len(actions)
        while self._kept > self._room:
            oldest, keys = self._runs.popleft()
            self._kept -= len(oldest)
            for key in keys:
                if key in self._known and self._known[key][0] is oldest:  # else a later run has taken its place
                    del self._known[key]

    def recall(self, scenario: Scenario) -> _Actions:
        """The first decisions in a run of the scenario, as far as earlier runs tell; often none."""
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
    """Who makes the runs of a job.

    Args:
        job: what is run.
        record: of this process, open; the caller clears it after each verdict, and closes it.
        workers: processes at most beside this one; with 1, all runs are made in this one unless ``isolate`` is set.
        isolate: whether the ADS shall never run in this process.
        executor: makes the announced runs, where one is given, and with ``isolate`` all.
        times_decisions: whether it matters how long each decision takes, which decisions for many runs at once, and
            those that are known from earlier runs, do not tell.
        clock: monotonic [s].

    Raises:
        WorldError: by a world that finds out only now that it cannot be used.
    """
    if isolate:
        return Runner(job=job, record=record, processes=Isolated(job, workers=workers, executor=executor), clock=clock)
    is_asked = not (times_decisions or is_vehicle_class(job.ads) or wants_env(job.ads))
    can_lock_step = is_asked and executor is None and lock_stepping(job.world) is not None
    # This process makes the first runs. They show what the ADS can do and what a run costs. From then on the runs that
    # were announced are made in lock step where the ADS decides for many at once, else in processes where a run is
    # dear; what was not announced, or cannot be made elsewhere, is always made in this process.
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
    """Give who makes the runs of a command in this process, whose crash records are of no use to a later one."""
    with tempfile.TemporaryDirectory(prefix="pafot-") as records:
        job = Job(world=world, ads=ads, records=Path(records), owner="command")
        with job.crash_record() as record, runner_for(job, record) as runner:
            yield runner


@dataclass(eq=False, kw_only=True)
class Runner:
    """Gives the runs of one search: those that were made ahead, and makes all others in this process.

    At the end of a ``with`` statement the processes that it has started end, at once where an exception passes. What
    was announced is forgotten then; a runner can be used after that, and in another ``with`` statement.

    A pure ADS is asked once for what it decides in runs that begin alike. Physics is stepped as always, so that a trace
    is the same to the last bit. The declaration is a promise of the user's: what counts is asked for afresh.

    ``processes`` make announced runs ahead, ``lock_step`` in their place once the ADS shows that it can. With
    ``can_resume``, decisions are taken from earlier runs once the ADS shows that it is pure.
    """

    job: Job
    record: CrashRecord
    processes: Processes
    lock_step: LockStep | None = None
    can_resume: bool = False
    clock: Callable[[], float]
    is_alone: bool = field(default=True, init=False)
    """Whether the last trace was made by itself, and not in lock step with others."""

    def __post_init__(self) -> None:
        self._prefetching: Processes | LockStep = self.processes
        self._decisions: DecisionCache | None = None
        is_of_interest = (self.lock_step is not None or self.can_resume) and not is_vehicle_class(self.job.ads)
        self._factory = self._showing(self.job.ads) if is_of_interest else self.job.ads

    @property
    def notes(self) -> list[str]:
        """How the runs were made, where that is worth telling; complete once the processes have ended."""
        return self._prefetching.notes

    @property
    def decides_for_many(self) -> bool:
        """Whether the ADS has shown that it decides for many runs at once."""
        return self._prefetching is self.lock_step

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        self._prefetching.announce(())
        self.processes.close(at_once=kind is not None)

    def announce(self, scenarios: Iterable[Scenario]) -> None:
        """Say what will be asked for next, in this order; what was announced before is forgotten."""
        self._prefetching.announce(scenarios)

    def run(self, scenario: Scenario, *, afresh: bool = False) -> Trace:
        """One run. It leaves the crash record written, for a verdict that may end the process too.

        Args:
            scenario: to run, announced or not.
            afresh: whether the ADS is asked for every decision, and for this run alone.

        Raises:
            ProcessLostError: where another process made it, and did not come back.
            ExecutionError: where it must be made in another process, and none can be started.
            Exception: what the world, the factory or the ADS's ``batch`` raises.
        """
        __tracebackhide__ = True
        trace = self._prefetching.take(scenario, afresh=afresh)
        self.is_alone = trace is None or self._prefetching is not self.lock_step
        self.record.write(scenario, reference=self.job.reference)
        if trace is None:
            decisions = () if afresh or self._decisions is None else self._decisions.recall(scenario)
            started = self.clock()
            given = {"decisions": decisions} if decisions else {}  # a world of the user's own need not know of them
            trace = self.job.world.rollout(scenario, self._factory, **given)
            if not self.decides_for_many:
                self.processes.ran_here(self.clock() - started)
        if self._decisions is not None and self.is_alone:  # what is decided for many at once is not relied on
            self._decisions.remember(trace)
        return trace

    def _showing(self, factory: Callable[..., Any]) -> Callable[..., Any]:
        """The factory, whose first ADS is looked at: a factory is called for runs and for nothing else."""

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

        make.__wrapped__ = factory  # type: ignore[attr-defined]  # signatures are looked up there
        return make
