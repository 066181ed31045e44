"""The runner of a search, which receives the next scenarios in advance and returns one run after the other.

A run is made in this process, in lock step with other runs, or in a different process. The choice depends on the ADS
and on the duration of a run. It affects only the time of the search, not its results. :func:`runner_for` combines the
parts.
"""

from __future__ import annotations

import copy
import sys
import tempfile
import threading
import time
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial, wraps
from pathlib import Path
from typing import Any, Self, TypeVar, cast

from pytest_pafot.door import EXECUTOR_POOL, opened
from pytest_pafot.execution import scenario_pool
from pytest_pafot.execution.crash_records import CrashRecord, Leftover
from pytest_pafot.execution.pool import GRACE, ProcessLostError, WorkerPool
from pytest_pafot.execution.scenario_pool import (
    NOT_REPEATED,
    Answer,
    BlockTask,
    Digest,
    ExecutionError,
    ExecutorPool,
    InGym,
    Job,
    LostRun,
    Made,
    ScenarioPool,
    Timed,
    capture_output,
    drivers_error,
    made_apart,
    made_from,
    pool_for,
    read_nothing,
    trace_of,
)
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Outcome, Trace
from pytest_pafot.oracle.run import Facts, Run
from pytest_pafot.searching.evaluation import Chains, plain_chains
from pytest_pafot.support.errors import flag
from pytest_pafot.support.isolation import isolates
from pytest_pafot.support.text import listed, one_line, plural, visible
from pytest_pafot.world import Highway
from pytest_pafot.world.base_world import BaseWorld
from pytest_pafot.world.driving.perception import ads_and_sight
from pytest_pafot.world.driving.policy import Policy
from pytest_pafot.world.driving.seeing import SeeingAds, is_copyable, is_pure
from pytest_pafot.world.driving.shadow import ending_after
from pytest_pafot.world.guard.chance import GENERATORS
from pytest_pafot.world.guard.failure import UNFIT, Around, closing, let_through
from pytest_pafot.world.guard.own_worlds import base_world, rollout_of

ResultT = TypeVar("ResultT")


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
    if isolate:
        return Runner(job=job, record=record, processes=Isolated(job, workers=workers, executor=executor), clock=clock)
    is_asked = job.policy.only_observes and not times_decisions
    can_lock_step = is_asked and executor is None and job.world.has_lock_step
    # This process makes the first runs, which show what the ADS can do and how long a run takes. Then the announced
    # runs are made in lock step if the ADS decides for many runs at once, or else in other processes if runs are slow.
    # Runs that were not announced, or that cannot be made elsewhere, are always made in this process.
    return Runner(
        job=job,
        record=record,
        processes=Processes(job, workers=workers, executor=executor),
        lock_step=LockStep(job, record, workers=workers) if can_lock_step else None,
        can_resume=not times_decisions and job.world.is_resumable,
        clock=clock,
    )


@dataclass(eq=False, kw_only=True)
class Runner:
    """A runner, which returns runs that were made in advance, and makes all other runs in this process.

    The end of a ``with`` statement ends the processes that the runner has started, at once after an exception, and
    drops the announced scenarios. The runner can still be used after that, also in a second ``with`` statement.

    If runs begin with the same situations, a pure ADS decides in them only once, and so does a copyable one, a copy of
    which then goes on. Physics is always simulated, so a trace is the same to the last bit. That the ADS is pure or
    copyable is only a promise of the user, so the runs that decide on a finding are made without cached decisions, and
    some others are made again at the end of a search.

    ``processes`` makes announced runs in advance. As soon as the ADS shows that it has ``batch``, ``lock_step`` makes
    them instead. With ``can_resume``, decisions are cached as soon as the ADS shows that it is pure or copyable.
    """

    job: Job
    record: CrashRecord
    processes: Processes
    lock_step: LockStep | None = None
    can_resume: bool = False
    clock: Callable[[], float]
    is_alone: bool = field(default=True, init=False)
    """True if the last run was made by itself, and not in lock step with other runs."""
    decisions: int = field(default=0, init=False)
    """The number of decisions that the ADS made in the runs with a trace so far."""
    reused: int = field(default=0, init=False)
    """The number of cached decisions in these runs, which the ADS did not make."""
    resumed: list[tuple[int, Trace]] = field(default_factory=list, init=False)
    """The runs that would best show that the ADS breaks its promise, the best first, each with the number of cached
    decisions. The best has the most of them or of decisions after them, whichever are fewer."""

    def __post_init__(self) -> None:
        self._prefetching: Processes | LockStep = self.processes
        self._held = ExitStack()
        self._decisions: DecisionCache | None = None
        is_of_interest = (self.lock_step is not None or self.can_resume) and not self.job.policy.drives_itself
        factory = self.job.policy.factory
        self._factory = self._showing(factory) if is_of_interest else factory
        self._copies: Copies | None = None
        if self.can_resume and is_of_interest and isinstance(world := self.job.world.given, Highway):
            self._copies = Copies(world.physics_hz, world.physics_hz // world.ads_hz)

    @property
    def notes(self) -> list[str]:
        """Notes on how the runs were made; complete after the processes have ended."""
        return self._prefetching.notes + ([self._copies.ended] if self._copies and self._copies.ended else [])

    @property
    def mark(self) -> str:
        """The attribute by which the ADS allows that its decisions are reused."""
        return "pure" if self._copies is None else "copyable"

    @property
    def ready(self) -> int:
        """The number of runs that were made in lock step and not requested yet."""
        return 0 if self.lock_step is None else self.lock_step.ready

    @property
    def decides_for_many(self) -> bool:
        """True if the ADS has shown that it decides for many runs at once."""
        return self._prefetching is self.lock_step

    def __enter__(self) -> Self:
        self._held.enter_context(GENERATORS.held(may_share=not self.processes.is_elsewhere))  # clients have threads
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        self._held.close()
        self._prefetching.announce(())
        self.processes.close(at_once=kind is not None)

    def announce(self, scenarios: Iterable[Scenario], *, more: bool = False) -> None:
        """Announce the next scenarios in the order in which they will be requested.

        Earlier ones that were not requested are dropped, unless these are ``more`` of them.
        """
        self._prefetching.announce(scenarios, more=more)

    def run(self, scenario: Scenario, *, afresh: bool = False, most: int | None = None) -> Trace:
        """Return the trace of a run of a scenario that was not announced; arguments and errors as :meth:`made`."""
        __tracebackhide__ = True
        made = self.made(scenario, afresh=afresh, most=most)
        if isinstance(made, Digest):
            raise TypeError(f"scenario: expected one that no other process has judged, received {scenario}")
        return trace_of(made)

    def made(self, scenario: Scenario, *, afresh: bool = False, most: int | None = None) -> Made:
        """Return the trace of a run of a scenario, or what the process has sent that made an announced run.

        Without a digest, the crash record of the scenario stays on disk, because the evaluation of the run may end the
        process, too.

        Args:
            scenario: the scenario to run, announced or not.
            afresh: True if the ADS must make every decision of this run, without cached or common decisions.
            most: the number of decisions after which the run is of no interest, and ends with an error of the ADS. A
                run that was made in advance has more decisions, and so has one in a different process.

        Raises:
            ProcessLostError: if the run was in a different process, which died or hung.
            ExecutionError: if the run must be in a different process, and none can be started.
            Exception: any exception of the world, the factory or the ADS's ``batch``.
        """
        __tracebackhide__ = True
        made = self._prefetching.collect(scenario, afresh=afresh)
        if isinstance(made, Digest):
            self.is_alone = True
            return made
        trace = None if made is None else trace_of(made)
        self.is_alone = trace is None or self._prefetching is not self.lock_step
        self.record.write(scenario, reference=self.job.reference)
        reused = 0
        copies: dict[int, Any] = {}
        if trace is None:
            decisions, begun = ((), None) if afresh or self._decisions is None else self._decisions.recall(scenario)
            started, factory = self.clock(), self._factory
            if self._copies is not None and not (afresh or self._copies.ended):
                factory, decisions, copies = self._copies.around(factory, scenario, decisions, begun)
            given = {"decisions": decisions} if decisions else {}  # the user's own world need not have this argument
            if most is not None:
                factory = ending_after(factory, most - len(decisions))
            trace = rollout_of(self.job.world)(scenario, factory, **given)
            reused = min(len(decisions), len(trace.actions))  # a run may end earlier
            seconds = self.clock() - started
            if not self.decides_for_many:
                self.processes.ran_here(seconds)
            if self._copies is not None:
                self._copies.count(trace, seconds)
                self._decisions = None if self._copies.ended else self._decisions
            if 0 < reused < len(trace.actions) and (most is None or len(trace.actions) < most):
                self.resumed.insert(0, (reused, trace))  # Of those that are as good, the last has most to share.
                self.resumed.sort(key=lambda pair: -min(pair[0], len(pair[1].actions) - pair[0]))
                del self.resumed[RESUMED:]
        self.decisions, self.reused = self.decisions + len(trace.actions) - reused, self.reused + reused
        if self._decisions is not None and self.is_alone:  # decisions of a batch may differ, so they are not cached
            self._decisions.remember(trace, None if self._copies is None else copies)
        return made or trace

    def _showing(self, factory: Callable[..., Any]) -> Callable[..., Any]:
        """Return a factory that inspects its first ADS, because the user's factory must be called only for runs."""

        def make(*arguments: Any, **named: Any) -> Any:
            __tracebackhide__ = True
            ads = factory(*arguments, **named)
            self._factory = factory
            if is_pure(ads) or not is_copyable(ads):
                self._copies = None
            if self.can_resume and (is_pure(ads) or self._copies is not None):
                self._decisions = DecisionCache()
            if self.lock_step is not None and callable(getattr(ads, "batch", None)):
                self.lock_step.announce(self.processes.announced)
                self._prefetching = self.lock_step
            return ads

        make.__wrapped__ = factory  # type: ignore[attr-defined]  # for inspect.signature
        return make


# The decisions of an ADS in earlier runs, for runs that begin in the same way.

DECISIONS = 100_000
"""The largest number of cached decisions, which are about 300 runs of a minute at 5 Hz and take about 15 MB."""

COPIES = 100
"""The largest number of places in runs with a copy of the ADS."""

COPY_SECONDS = 1.0
"""The time that copies may take before it is compared with the time of the runs [s]."""

COPY_SHARE = 1 / 10
"""The largest share of the time of runs that copies may take. Hardly more decisions than this can be saved."""

RESUMED = 20
"""The largest number of runs with cached decisions that are made again at the end of a search, with all decisions."""

_Key = tuple[object, ...]
_Actions = tuple[Any, ...]


class DecisionCache:
    """A cache of the decisions in the last runs of one ADS in one world, by the genes on which the decisions depended.

    Until the end of gene ``g``, a run depends only on the start and on the first ``g`` genes of each NPC. The last
    decision that depends only on these genes is at the tick at which the next gene begins. Two scenarios share
    decisions if their chains as driven are the same, or if their requested chains and their seeds are the same (see
    :class:`~pytest_pafot.searching.evaluation.EvaluationCache`).

    The cache is valid only for an ADS that decides only from its observation, or that goes on as a copy of the ADS that
    has made the decisions.

    Args:
        decisions: the largest number of cached decisions; the oldest runs are removed first.
        copies: the largest number of genes after which there is a copy; those that were not used longest are removed.
    """

    def __init__(self, decisions: int = DECISIONS, copies: int = COPIES) -> None:
        self._room = decisions
        self._copies = copies
        self._kept = 0
        self._known: dict[_Key, tuple[_Actions, int, Any]] = {}
        self._runs: deque[tuple[_Actions, list[_Key]]] = deque()

    def remember(self, trace: Trace, copies: Mapping[int, Any] | None = None) -> None:
        """Cache the decisions of a run; they replace older decisions after the same genes.

        ``copies`` are those of the ADS in this run, by the number of decisions that it had made. Then only beginnings
        are cached after which there is a copy from this run or an earlier one. It is None if no copy is needed.
        """
        actions, scenario = trace.actions, trace.scenario
        if not actions or len(actions) > self._room:
            return
        gene_ticks, ticks = round(scenario.gene_seconds * trace.physics_hz), trace.decision_ticks
        asked, driven = plain_chains(scenario), plain_chains(trace.executed)
        keys = []
        for genes in range(1, min(-(-trace.ticks // max(gene_ticks, 1)), scenario.genes) + 1):
            count = min(bisect_right(ticks, genes * gene_ticks), len(actions))
            by_chains, by_seed = _key(scenario, driven, genes, None), _key(scenario, asked, genes, scenario.seed)
            by_both = [by_chains] if by_chains[-1] == by_seed[-1] else [by_chains, by_seed]
            _, earlier, copied = self._known.get(by_chains, ((), 0, None))
            if copies is not None and earlier != count:
                if count not in copies:
                    continue
                copied = copies[count]
            for key in by_both:
                self._known.pop(key, None)  # it becomes the latest
                self._known[key] = (actions, count, copied)
                keys.append(key)
        while copies is not None and len(self._known) > self._copies:
            del self._known[next(iter(self._known))]
        self._runs.append((actions, keys))
        self._kept += len(actions)
        while self._kept > self._room:
            oldest, keys = self._runs.popleft()
            self._kept -= len(oldest)
            for key in keys:
                if key in self._known and self._known[key][0] is oldest:  # unless a later run has replaced it
                    del self._known[key]

    def recall(self, scenario: Scenario) -> tuple[_Actions, Any]:
        """Return the cached decisions with which a run of a scenario begins, and the copy of the ADS after them.

        There are no decisions if none are known, and there is no copy if none is needed.
        """
        chains = plain_chains(scenario)
        for genes in range(scenario.genes, 0, -1):
            for seed in (None, scenario.seed):
                known = self._known.get(_key(scenario, chains, genes, seed))
                if known is not None:
                    actions, count, copied = known
                    return actions[:count], copied
        return (), None


def _key(scenario: Scenario, chains: Chains, genes: int, seed: int | None) -> _Key:
    shared = tuple([chain[:genes] for chain in chains])
    if any(chain[0].drives_itself for chain in scenario.npcs):  # a driver of an NPC may draw
        seed = scenario.seed
    return (
        scenario.ego_lane,
        scenario.ego_speed,
        scenario.gene_seconds,
        scenario.traffic,
        scenario.vehicles,
        seed,
        shared,
    )


class Copies:
    """The copying of an ADS in runs: before the first decision after each gene, and at the end.

    ``every`` is the number of ticks between decisions, of which the world has ``hz`` per second.
    """

    def __init__(self, hz: int, every: int) -> None:
        self._hz, self._every = hz, every
        self._seconds = self._run_seconds = 0.0
        self.ended = ""
        """Why there are no more copies, for the user; empty as long as there are."""

    def around(
        self, factory: Callable[..., Any], scenario: Scenario, decisions: _Actions, begun: Any
    ) -> tuple[Callable[..., Any], _Actions, dict[int, Any]]:
        """Return the factory of a run, the decisions with which it begins, and a dictionary for the copies made in it.

        ``begun`` is the copy of the ADS after the decisions, a copy of which goes on. If that cannot be copied again, a
        new ADS makes all decisions.
        """
        first = None if begun is None else self._copied(begun)
        decisions, ready = () if first is None else decisions, [first]
        ticks = round(scenario.gene_seconds * self._hz)
        copies: dict[int, Any] = {}
        borders = {genes * ticks // self._every + 1 for genes in range(1, scenario.genes + 1)}

        def make(*arguments: Any, **named: Any) -> Any:
            __tracebackhide__ = True
            copies.clear()
            # There is a second call only if the ADS drew random numbers, because the run is then made again.
            go_on = ready.pop if ready else partial(copy.deepcopy, begun)
            ads = factory(*arguments, **named) if first is None else go_on()
            if not is_copyable(ads):
                return ads

            def take(number: int) -> None:
                copied = self._copied(ads)
                if copied is not None:
                    copies[number] = copied

            inner, sight = ads_and_sight(ads)
            counted = _Counted(inner, len(decisions), borders, take)
            return counted if sight is None else SeeingAds(counted, sight)

        return wraps(factory, updated=())(make), decisions, copies

    def count(self, trace: Trace, seconds: float) -> None:
        """Count a run and its duration [s], and end the copies if they take too long or cannot be right."""
        self._run_seconds += seconds
        if trace.drew:
            self._end("random numbers from global generators")
        elif self._seconds > max(COPY_SECONDS, COPY_SHARE * self._run_seconds):
            self._end(f"copies that took {self._seconds:.1f} s of the {self._run_seconds:.1f} s of runs")

    def _copied(self, ads: Any) -> Any:
        """Return a copy of an ADS; None if there are no more copies."""
        started = time.perf_counter()
        try:
            copied = None if self.ended else copy.deepcopy(ads)
        except UNFIT as error:
            let_through(error)
            self._end(one_line(f"{type(error).__name__}: {error}"))
            return None
        self._seconds += time.perf_counter() - started
        if copied is not None and ads_and_sight(copied)[0] is ads_and_sight(ads)[0]:
            self._end("the ADS itself as its copy")
        return None if self.ended else copied

    def _end(self, received: str) -> None:
        self.ended = self.ended or (
            "copyable: expected an ADS of which copy.deepcopy copies all that it remembers, in a tenth of the time of "
            f"its runs, received {received}; it makes all decisions from now on; mend its `__deepcopy__`, draw from a "
            "generator in an attribute, or remove `copyable`"
        )


class _Counted(Around):
    """An ADS before some of whose decisions, and before whose end, a function is called with their number so far."""

    def __init__(self, ads: Any, number: int, borders: Collection[int], take: Callable[[int], object]) -> None:
        super().__init__(ads)
        self._number, self._borders, self._take = number, borders, take

    def __call__(self, observation: Any) -> Any:
        if self._number in self._borders:
            self._take(self._number)
        self._number += 1
        return self._ads(observation)

    def close(self) -> None:
        """Take the last copy while the ADS is open."""
        self._take(self._number)
        super().close()


# Simulation of runs before a search requests them: many at once in lock step, or in other processes.
#
# :meth:`Runner.run` documents the exceptions of ``take``.

DEAR = 0.010
"""The mean duration of a run from which on a search is faster with other processes [s].

A run in a different process takes half a millisecond longer, and starting a process takes as long as several runs.
"""

OWN = __name__.partition(".")[0]
"""This package, whose threads no policy needs."""

WARM_RUNS = 2
"""The number of runs, after the first run of a search, that decide whether other processes are used.

The first run is slower, because it loads libraries. If it was slow, processes are started after it. If the next runs
turn out to be fast, the processes are ended.
"""


class LockStep:
    """A maker of runs in lock step: it runs all announced scenarios in one batch when the first of them is requested.

    On a Highway, all scenarios of a batch have the same number of NPCs. Otherwise the observations would have rows of
    NaN for missing NPCs, and a network would decide on NaN without an error. The world of the job must have
    ``rollout_batch``. ``workers`` is the number of processes that the user requested.
    """

    def __init__(self, job: Job, record: CrashRecord, *, workers: int) -> None:
        self._job = job
        self._record = record
        self._workers = workers
        self._announced: list[Scenario] = []
        self._made: dict[Scenario, Trace] = {}

    @property
    def notes(self) -> list[str]:
        """The note on why processes were not used although the user requested them; empty if not requested."""
        why = "since the ADS decides for many runs at once, by its `batch`"
        return [] if self._workers == 1 else [f"{flag('workers', self._workers)}: not in use, {why}"]

    @property
    def ready(self) -> int:
        """The number of runs that were made and not taken."""
        return len(self._made)

    def announce(self, scenarios: Iterable[Scenario], *, more: bool = False) -> None:
        """Announce the next scenarios; without ``more``, earlier ones that were not taken are dropped."""
        if not more:
            self._announced, self._made = [], {}
        self._announced += scenarios

    def collect(self, scenario: Scenario, *, afresh: bool) -> Trace | None:
        """Return the trace of an announced scenario; None if the scenario must be run by itself.

        Each trace can be collected once. With ``afresh`` the result is always None.
        """
        __tracebackhide__ = True
        if afresh:
            return None
        if scenario in self._announced:
            are_alike = not isinstance(self._job.world.given, Highway)
            together = [each for each in self._announced if are_alike or len(each.npcs) == len(scenario.npcs)]
            self._announced = [each for each in self._announced if each not in together]
            if len(together) > 1:
                self._record.write(*together)
                traces = rollout_of(self._job.world, "rollout_batch")(together, self._job.policy.factory)
                self._made |= dict(zip(together, traces, strict=True))
        return self._made.pop(scenario, None)


class Processes:
    """A maker of announced runs in other processes, which are started if runs turn out to be slow.

    With one worker, no process is ever started. If there is an executor, it makes all announced runs.
    """

    def __init__(self, job: Job, *, workers: int, executor: Executor | None = None) -> None:
        self.announced: dict[Scenario, None] = {}
        """The announced scenarios that were not requested yet, in order."""
        self.ready: dict[Scenario, Timed] = {}
        """Runs from blocks that other processes drive, which this process must judge."""
        self.recovered: list[LostRun] = []
        """The deaths of processes of earlier pools, and in blocks, in scenarios that ran to their end later."""
        self._job = job
        self._workers = workers
        self._executor = executor
        self._pool: ScenarioPool | ExecutorPool | None = None
        self._failure = ""
        self._is_measured = self._drives = False
        self._runs = self._runs_before = 0  # all runs, and the runs before processes were started
        self._warm_seconds = 0.0

    @property
    def is_elsewhere(self) -> bool:
        """True if an executor makes the announced runs."""
        return self._executor is not None

    @property
    def notes(self) -> list[str]:
        """Notes on the use of processes if the user requested them; complete after the processes have ended."""
        if self._failure:
            return [f"{flag('workers')} is 1: {self._failure}"]
        if self._executor is not None and self._pool is not None:
            return cast("ExecutorPool", self._pool).notes
        option = flag("workers", self._workers)
        if self._runs_before:
            used = f"{option}: in use after {plural(self._runs_before, 'run')} of this process{self._job.remark}"
            if self._pool is not None and self._pool.failure:
                used = f"{flag('workers')}: this process ran the scenarios; no other one could: {self._pool.failure}"
            return [used, *self._retried]
        if self._workers == 1 or self._runs <= WARM_RUNS:
            return []
        mean, dear = 1000 * self._warm_seconds / (self._runs - 1), 1000 * DEAR
        return [f"{option}: not in use, since a run took {mean:.1f} ms, and it pays off from {dear:g} ms on"]

    @property
    def in_use(self) -> int:
        """The number of processes in use; 0 if none are, or if it is the executor that knows."""
        return 0 if self._executor is not None or self._pool is None or self._pool.failure else self._workers

    @property
    def run_seconds(self) -> float:
        """The mean time of the runs so far, without the first one, which loads libraries [s]; 0 if there is none."""
        return self._warm_seconds / (self._runs - 1) if self._runs > 1 else 0.0

    def announce(self, scenarios: Iterable[Scenario], *, more: bool = False) -> None:
        """Announce the next scenarios, and start to run them if processes are in use."""
        if not more:
            self.announced = {}
        if self._pool is None:
            # Without other processes, only the first generation is of interest, to an ADS that decides for many runs.
            if not more or self._executor is not None or self._workers > 1 or not self._runs:
                self.announced.update(dict.fromkeys(scenarios))
        elif not more:
            self._pool.expect(self._noted(scenarios))
        elif isinstance(self._pool, WorkerPool):
            self._pool.add_first(self._noted(scenarios))  # before those of later blocks
        else:
            self._pool.add_all(self._noted(scenarios))

    def announce_later(self, scenarios: Iterable[Scenario]) -> None:
        """Announce scenarios that are requested after all others."""
        if self._pool is not None:
            self._pool.add_all(self._noted(scenarios))

    def arrived(self, scenarios: Iterable[Scenario]) -> list[Any]:
        """Return the runs or digests of announced scenarios that are there; they can still be taken."""
        answers = () if self._pool is None else map(self._pool.arrived, scenarios)
        return [answer[0] for answer in answers if isinstance(answer, tuple)]

    def drive(self, task: BlockTask) -> bool:
        """Let a process drive a block by itself; return False if none can."""
        if self._pool is None and not self._failure:
            self._start()
        if not isinstance(self._pool, WorkerPool) or self._pool.failure:
            return False
        self._pool.follow(task)
        self._drives = True
        return True

    def hear(self, *, waits: bool) -> tuple[BlockTask, Any] | None:
        """Return what one of the processes says next that drive blocks, as :meth:`WorkerPool.hear` does."""
        return self._pool.hear(waits=waits) if isinstance(self._pool, WorkerPool) else None

    def read_here(self) -> None:
        """Let this process read the traces of all runs that are announced from now on; other processes judge none.

        The workers of an executor, which may be elsewhere, judge no runs anyway.
        """
        if self._executor is None:
            self._job = replace(self._job, read=read_nothing, drive=None)
            self.end()

    def end(self) -> None:
        """End the pool, so that processes with another task can be started."""
        if self._pool is not None:
            self.recovered += self._pool.recovered
            self._pool.close()
            self._pool = None

    @property
    def _retried(self) -> list[str]:
        """Notes on processes that died in runs that later succeeded."""
        return [lost.recovery for lost in (*self.recovered, *([] if self._pool is None else self._pool.recovered))]

    def _noted(self, scenarios: Iterable[Scenario]) -> Iterator[Scenario]:
        for scenario in scenarios:
            self.announced[scenario] = None
            yield scenario

    def collect(self, scenario: Scenario, *, afresh: bool) -> Made | None:
        """Return what became of an announced scenario; None if the scenario must be run in this process.

        Each run can be collected once. With ``afresh`` the result is always None.
        """
        __tracebackhide__ = True
        if not afresh and scenario in self.ready:
            return made_from(self.ready.pop(scenario))
        if afresh or scenario not in self.announced:
            return None
        if self._executor is not None and self._pool is None:
            self._begin()
        del self.announced[scenario]
        self._is_measured = self._pool is None
        if self._pool is None:
            return None
        answer = self._pool.fetch(scenario)
        if isinstance(answer, tuple) and self._executor is None:
            self._learn(answer[2])
        return made_from(answer)

    def ran_here(self, seconds: float) -> None:
        """Record the duration of the last run in this process [s]; only announced runs are used."""
        if self._is_measured:
            self._is_measured = False
            self._learn(seconds)

    def count(self, runs: int, seconds: float) -> None:
        """Count runs and the time that they took [s]."""
        self._warm_seconds += seconds if self._runs else 0.0
        self._runs += runs

    def _learn(self, seconds: float) -> None:
        self.count(1, seconds)
        is_dear = self._warm_seconds >= DEAR * (self._runs - 1) if self._runs > WARM_RUNS else seconds >= DEAR
        if self._pool is not None and self._runs == WARM_RUNS + 1 and not is_dear and not self._drives:
            self._pool.close(at_once=True)
            self._pool, self._runs_before = None, 0
        elif self._pool is None and is_dear and self._workers > 1 and not self._failure:
            self._start()

    def _start(self) -> None:
        self._runs_before = self._runs_before or self._runs
        try:
            self._begin()
        except ExecutionError as error:
            self._failure = str(error)

    def close(self, *, at_once: bool) -> None:
        """End the processes; ``at_once`` kills them without waiting, unless they have simulators to close before."""
        if self._pool is not None:
            self._pool.close(at_once=at_once)

    def _begin(self) -> ScenarioPool | ExecutorPool:
        job, executor = self._job, self._executor
        pool: ScenarioPool | ExecutorPool
        pool = pool_for(job, self._workers) if executor is None else opened(EXECUTOR_POOL)(job, executor)
        self._pool = pool
        pool.expect(self.announced)
        return pool


class Isolated(Processes):
    """A maker of all runs, announced or not, in other processes, so that the ADS is never called in this process."""

    @property
    def notes(self) -> list[str]:
        """Notes on processes that died in runs that later succeeded, and on an executor that made all runs."""
        if self._executor is not None and self._pool is not None:
            pool = cast("ExecutorPool", self._pool)
            return [] if pool.failure or pool.unable else pool.notes
        return self._retried

    def collect(self, scenario: Scenario, *, afresh: bool) -> Trace | Facts:
        """Return the run of a scenario from a different process, and raise the exceptions of that process.

        No run is repeated in this process. So if a worker of an executor raises, for example because it lacks a
        package, the result is an ``ExecutionError``.
        """
        __tracebackhide__ = True
        if not afresh and scenario in self.ready:
            return made_apart(self.ready.pop(scenario))
        answer = self._fetched(scenario)
        if isinstance(answer, tuple):
            self.count(1, answer[2])
        return made_apart(answer)

    def in_gym(self, scenario: Scenario) -> Trace:
        """Return the run of a scenario with ``env.step`` of highway-env's own environment, from a different process.

        It is one of the processes that make the other runs, so that no more policies drive at once than there are
        workers. An executor's worker need not have the environment, so for an executor it is one of this machine.
        """
        __tracebackhide__ = True
        if self._executor is None:
            return trace_of(made_apart(self._fetched(InGym(scenario))))
        here = Isolated(self._job, workers=1)
        try:
            return here.in_gym(scenario)
        finally:
            here.close(at_once=False)

    def _fetched(self, task: Any) -> Answer:
        __tracebackhide__ = True
        pool = self._begun()
        answer = pool.fetch(task)
        if pool.failure:
            raise ExecutionError(f"{flag('isolate')}: expected processes to run the ADS in, received: {pool.failure}")
        if self._executor is not None and (unable := cast("ExecutorPool", pool).unable):
            first = unable[0]
            raise ExecutionError(
                f"{flag('isolate')}: expected workers that can make every run, received from one of them "
                f"{type(first).__name__}: {first}; install what the run needs on the workers, or search without "
                f"{flag('isolate')}, so that this process makes such runs"
            )
        return answer

    def _begun(self) -> ScenarioPool | ExecutorPool:
        try:
            return self._pool or self._begin()
        except ExecutionError as error:
            raise ExecutionError(f"{flag('isolate')}: {error}") from None


# Runs in a separate process, for scenarios in which the run or its evaluation may end this process.


@dataclass(frozen=True, slots=True)
class _OtherRuns(BaseWorld):
    """A stand-in for a world, with a different ``rollout``, which guards the ADS. It can do nothing else."""

    world: BaseWorld
    drive: Callable[[Scenario, Callable[..., Any]], Any]

    @property
    def hang_limit(self) -> float:
        """The limit of the world [s]."""
        return self.world.hang_limit

    @property
    def speed_limit(self) -> float:
        """The limit of the world [m/s]."""
        return self.world.speed_limit

    @property
    def longest_run(self) -> float:
        """The longest duration of a run in the world [s]."""
        return self.world.longest_run

    def to_dict(self) -> dict[str, Any]:
        """Return the world as plain data."""
        return self.world.to_dict()

    def rollout(self, scenario: Scenario, ads_factory: Callable[..., Any]) -> Any:
        """Call the function in the place of the world's ``rollout``."""
        __tracebackhide__ = True
        return self.drive(scenario, ads_factory)


def answers_apart(
    job: Job, scenarios: Sequence[Scenario], judge: Callable[[Trace], object], *, isolate: bool
) -> dict[Scenario, Answer] | None:
    """Run and evaluate each scenario by itself in a separate process; return the answers, or None if impossible.

    If a process dies, the answer is a ``ProcessLostError`` even if a second attempt succeeds, because a process has
    already died in this scenario before.

    Args:
        job: everything that a run needs.
        scenarios: the scenarios, run one after the other.
        judge: evaluates a trace. It needs the fixtures of the test function, which only forked processes have. Its
            output and its exceptions are ignored, because the session evaluates the run again.
        isolate: True if the run must be in a separate process, without the evaluation if processes cannot be forked.

    Raises:
        ExecutionError: with ``isolate``, if no other process can be started.
    """
    world = job.world

    def judged(scenario: Scenario, ads: Callable[..., Any]) -> Trace:
        trace: Trace = rollout_of(world)(scenario, ads)
        with capture_output(), suppress(BaseException):
            judge(trace)
        return trace

    if scenario_pool.METHOD == "fork":
        job = replace(job, world=_OtherRuns(world, judged))
    elif not isolate:
        return None
    with pool_for(job, 1) as pool:
        pool.expect(scenarios)
        answers = {scenario: pool.fetch(scenario) for scenario in scenarios}
    if pool.failure and isolate:
        raise ExecutionError(f"{flag('isolate')}: expected processes to run the ADS in, received: {pool.failure}")
    return None if pool.failure else answers | {lost.task: lost for lost in pool.recovered}


def run_apart(job: Job, scenario: Scenario, judge: Callable[[Trace], object], *, isolate: bool) -> Trace:
    """Return the trace of a scenario that was run and evaluated in a separate process; see :func:`answers_apart`.

    The session then evaluates the trace again.

    Raises:
        ProcessLostError: if the separate process died or hung.
        ExecutionError: if no other process can be started; without ``isolate``, also if the ADS does not work in one.
        Exception: with ``isolate``, any exception of the separate process.
    """
    __tracebackhide__ = True
    answers = answers_apart(job, [scenario], judge, isolate=True)
    assert answers is not None  # noqa: S101  (only without isolation it may be None)
    try:
        return trace_of(made_apart(answers[scenario]))
    except ProcessLostError:
        raise
    except Exception as error:
        if isolate:
            raise
        raise ExecutionError(
            "expected a scenario that has ended a process to run in a separate process, received from there "
            f"{type(error).__name__}: {error}. {NOT_REPEATED} Or delete the file; a search may then find it again"
        ) from None


def call_apart(job: Job, scenario: Scenario, drive: Callable[[Scenario, Callable[..., Any]], ResultT]) -> ResultT:
    """Return what a function of a scenario and the ADS's factory returns in a separate process, which must be forked.

    Raises:
        ProcessLostError: if the separate process died or hung.
        ExecutionError: if no other process can be started.
        Exception: any exception of the separate process.
    """
    __tracebackhide__ = True
    with pool_for(replace(job, world=_OtherRuns(job.world, drive)), 1) as pool:
        answer = pool.fetch(scenario)
    if pool.failure:
        raise ExecutionError(f"{flag('isolate')}: expected processes to run the ADS in, received: {pool.failure}")
    result: Any = made_from(answer)
    if isinstance(answer, Exception):
        raise answer
    return result  # type: ignore[no-any-return]


@contextmanager
def driving(world: Any, ads: Callable[..., Any]) -> Iterator[Callable[[Scenario], Run]]:
    """Provide a function that drives a scenario and returns its run, for a test.

    If policies are isolated, a forked process drives the scenario first, and ends in place of this one. This process
    then drives it as well, because a test may read what a policy has noted, and a policy that works only in the process
    of the test must work.

    The function raises a ``ProcessLostError`` if the forked process died or hung.
    """
    base = base_world(world)
    with ExitStack() as stack:
        pool = None
        if scenario_pool.METHOD == "fork" and isolates():
            records = stack.enter_context(tempfile.TemporaryDirectory(prefix="pafot-"))
            job = Job(world=base, policy=Policy(ads), records=Path(records, "records"), owner="test")
            pool = stack.enter_context(pool_for(job, 1))

        def drive(scenario: Scenario) -> Run:
            __tracebackhide__ = True
            answer = None if pool is None else pool.fetch(scenario)
            if isinstance(answer, ProcessLostError):
                raise answer
            there = base.driven_in((scenario,), ads)
            return there.run_of(rollout_of(there)(scenario, ads))

        yield drive


def must_stay_here(job: Job, scenario: Scenario) -> str:
    """Return why runs had better stay in this process although nobody has decided that; empty if they can leave it.

    The ADS may decide for many runs at once, which is faster. Or it works only in the process that has begun: a model
    is on a GPU there, or a thread that its decisions wait for. A separate process makes it and drives a scenario, since
    it may end its process. If it raises or hangs at its first decision, this process judges that. A policy that does
    without the answer of a thread decides otherwise there: so if a thread runs code of the project, both drive.
    """
    if job.policy.drives_itself:
        return ""
    patience = job.world.hang_limit

    def asked(_: str, tell: object) -> tuple[str, str]:
        if not job.policy.simulates:
            ads = job.policy.make()
            with closing(ads.given, patience):  # as at the end of a run: it may have opened what only one can have
                if ads.decides_for_many:
                    return "decides for many runs at once", ""
        trace = rollout_of(job.world)(scenario, job.policy.factory)
        if trace.error is None or trace.actions:
            return "", repr(trace.actions)
        return f"{'hangs' if trace.outcome is Outcome.HANG else f'raises {trace.error.kind}'} in another process", ""

    pool = WorkerPool[str, tuple[str, str]](
        asked, 1, method=scenario_pool.METHOD, patience=patience + GRACE, **job.closing
    )
    with capture_output(), pool:
        answer = pool.fetch("the first run of the ADS")
    if isinstance(answer, ProcessLostError):
        return "hangs in another process" if answer.is_hang else ""
    if isinstance(answer, Exception):
        return f"raises {type(answer).__name__} in another process"
    why, actions = answer
    folders = [job.root]
    with suppress(OSError):  # the current folder may be gone
        folders.append(Path.cwd())  # a command's policy is there, and the rootdir of its session elsewhere
    threads = [] if why else _threads_below(folders)
    with capture_output():
        if threads and repr(rollout_of(job.world)(scenario, job.policy.factory).actions) != actions:
            return f"decides otherwise in another process, which does not have {listed(threads)}"
    return why


def _threads_below(folders: Iterable[Path]) -> list[str]:
    """Return the names of the threads of this process that run a function or a class of a module below a folder."""
    found = []
    for thread in threading.enumerate():
        target = getattr(thread, "_target", None)  # only a running thread has one
        names = {getattr(target, "__module__", None) or "", type(thread).__module__}
        files = [getattr(sys.modules.get(name), "__file__", None) for name in names if name.partition(".")[0] != OWN]
        own = [Path(each) for each in files if each and "site-packages" not in each]
        if any(each.is_relative_to(folder) for each in own for folder in folders):
            found.append(f"the thread {visible(thread.name)}")
    return found


# A scenario in which a process died runs again in a separate process before it is called a finding.
#
# A process may also be killed from outside: a job is cancelled, or the system is short of memory. Then the scenario
# says nothing about the ADS, however many sessions are killed in a row. But if two processes died in the same scenario,
# the cause is probably something that builds up from run to run, such as memory of the test function. Then the scenario
# is called a finding after all, or this would never be reported.


@dataclass(frozen=True, slots=True, kw_only=True)
class Retried:
    """The result of a second attempt to run the scenarios of a process that died."""

    notes: tuple[str, ...] = ()
    """Notes for the user on scenarios that did not cause the death of the process."""
    pending: Leftover | None = None
    """The crash record to remove at the end of the search, or None. If this session dies, the next one reads it."""
    fatal: Scenario | None = None
    """A scenario that must not be run, because the driver of an NPC ends the process in it; None if there is none."""


def retry(
    leftover: Leftover,
    job: Job,
    judge: Callable[[Trace], object],
    *,
    isolate: bool,
    has_died_twice: bool,
    keep: Callable[[Leftover, Scenario, LostRun | None], object],
    run_here: Callable[[Leftover], object],
) -> Retried:
    """Try the scenarios of a process that died a second time, and save the scenarios that caused its death.

    If a reference was driving when the process died, the reference is the cause, and nothing is run again. A scenario
    that ran by itself is saved although a second attempt survives, or is impossible, in two cases: two processes died
    in it, or no separate process can be started.

    Args:
        leftover: the crash record of the process; it is removed unless the result contains it as ``pending``.
        job: everything that a run of the scenarios needs.
        judge, isolate: see :func:`answers_apart`.
        has_died_twice: whether another process died in the same scenarios, and neither was killed with its session.
        keep: saves a scenario in which a process died; its last argument is the second death, or None if unknown.
        run_here: runs the scenarios of a batch in this process, one by one, each with a crash record on disk. If this
            process dies, the next session reads that record.
    """
    if leftover.reference:
        note = (
            f"a process (pid {leftover.pid}) died while the reference {leftover.reference} drove in "
            f"{leftover.scenario}, which says nothing about the ADS: correct the reference, or search with "
            f"{flag('isolate')}, so that it can die without harm"
        )
        return Retried(notes=(note,), pending=leftover)
    # Try all of them again, each in a process of its own if there can be one.
    answers: dict[Scenario, Answer] | None = None
    with suppress(ExecutionError):  # The first run of the search reports it.
        answers = answers_apart(job, leftover.scenarios, judge, isolate=isolate)
    if answers is None and leftover.is_lock_step:
        run_here(leftover)
        return Retried()
    # The guilty ones are saved. Of a batch in lock step nobody knows which one it was, so only a second death counts.
    is_build_up = has_died_twice and not leftover.is_lock_step
    guilty = [
        each for each in leftover.scenarios if answers is None or is_build_up or not _came_to_its_end(answers[each])
    ]
    for scenario in guilty:
        answer = None if answers is None else answers[scenario]
        lost = answer if isinstance(answer, ProcessLostError) else None
        if lost is not None and (error := drivers_error(lost)):
            note = (
                f"a process (pid {leftover.pid}) died while it ran {scenario}, and again: {error}, which says nothing "
                f"about the ADS: correct that driver, leave it out of drivers=, or search with {flag('isolate')}, so "
                "that it can die without harm"
            )
            return Retried(notes=(note,), pending=leftover, fatal=scenario)
        if lost is not None or not leftover.is_lock_step:
            keep(leftover, scenario, lost)
    if guilty:
        leftover.discard()
        return Retried()
    ran = f"{leftover.scenario},"
    if leftover.is_lock_step:
        ran = f"{len(leftover.scenarios)} scenarios in lock step, each of"
    note = (
        f"a process (pid {leftover.pid}) died while it ran {ran} which ran to its end when it was tried again: the "
        "process was killed from outside, or there was too little memory"
    )
    return Retried(notes=(note,), pending=leftover)


def _came_to_its_end(answer: Answer) -> bool:
    """Return whether a run succeeded, without an error of the ADS, which may occur only in the separate process."""
    trace = None if isinstance(answer, Exception) else answer[0]
    return isinstance(trace, Trace) and trace.outcome not in (Outcome.ADS_ERROR, Outcome.HANG)
