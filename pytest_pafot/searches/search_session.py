"""One session of a search, from the replays to the summary."""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from inspect import GEN_CLOSED, getgeneratorstate
from types import MappingProxyType
from typing import Any, Self

from pytest_pafot.algorithms.catalogue import RandomSearch
from pytest_pafot.algorithms.evaluation import EndReason
from pytest_pafot.algorithms.fitness import FitnessError, Steered, is_built_in, resolve
from pytest_pafot.algorithms.plan import Algorithm
from pytest_pafot.algorithms.space import SearchSpace
from pytest_pafot.corpus.reader import Saved, saved_in
from pytest_pafot.execution.crash_records import Leftover
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.runner import LostRun, forks, judged_apart, runner_for
from pytest_pafot.findings.sighting import Seen
from pytest_pafot.findings.verdict import Verdict
from pytest_pafot.model.sight import Sight
from pytest_pafot.oracle.run import Run
from pytest_pafot.searches.bench import Bench, Budget
from pytest_pafot.searches.events import (
    Ending,
    Note,
    Phase,
    Search,
    SearchEvent,
    SearchStarted,
)
from pytest_pafot.searches.harness import Harness, SetupFaultError, no_skip, refusals, skips
from pytest_pafot.searches.made_worse import MadeWorse
from pytest_pafot.searches.refine.steps import refine
from pytest_pafot.searches.replays import Replays
from pytest_pafot.searches.request import build_space
from pytest_pafot.searches.results import Driver, Examiner, State
from pytest_pafot.searches.scenarios import Bred, Numbers
from pytest_pafot.searches.search import LEAST, TimedWatch, Watch, search
from pytest_pafot.searches.store import Store
from pytest_pafot.searches.summary import summary_of
from pytest_pafot.support import monotonic
from pytest_pafot.support.errors import OutOfTime, RequestError, flag
from pytest_pafot.support.process import postponed
from pytest_pafot.support.text import plural
from pytest_pafot.world import WorldError, codec
from pytest_pafot.world.base_world import BaseWorld
from pytest_pafot.world.guard.chance import GENERATORS
from pytest_pafot.world.guard.hang_guard import is_interruption, runs_end_in

# The largest fraction of the time limit that is reserved to shrink findings and to find their moments.
FOR_SIMPLIFYING = 1 / 3

AFTER_A_DEATH = f"the ADS ran in separate processes, as with {flag('isolate')}, because a process has died before"

ENDINGS: Mapping[EndReason, Ending] = MappingProxyType(
    {
        "generations": Ending.GENERATIONS,
        "runs": Ending.RUNS,
        "time": Ending.MAX_TIME,
        "stopped": Ending.FINDINGS,
    }
)
# A run that the time limit stops is reported if it took more than this many times as long as the mean run before it.
SLOW_RUNS = 10


def search_seed(base_seed: int, node_id: str) -> int:
    """Derive the seed of a search from the base seed and the node id of the test."""
    return int.from_bytes(hashlib.sha256(f"{base_seed}:{node_id}".encode()).digest()[:4], "big")


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchResult:
    """The result of one session of a search."""

    summary: Search
    findings: tuple[Seen, ...]
    count: int  # number of distinct new findings, saved or only counted
    first_exception: BaseException | None  # the exception of the first finding; None without one
    # a fault of the set-up, as the exception to raise instead of findings
    fault: BaseException | None
    skip: BaseException | None  # the last skip, if the test function skipped every run
    # True if most runs tested nothing, or if a broken reference prevented every failure from counting
    is_vacuous: bool


class ListenerError(RuntimeError):
    """The error that replaces a consumer's StopIteration, which a generator cannot raise."""

    def __init__(self, error: StopIteration) -> None:
        super().__init__(
            f"the listener for search events raised {error!r}, perhaps from next() without a default. Catch the "
            "exception in the listener."
        )
        self.__cause__ = error


class Events:
    """The events of a search, for a consumer that can raise exceptions.

    Loop over them inside ``with events:``. An exception in the context is raised in the search, which then ends and
    still reports its results.

    Attributes:
        result: the result of the search, available after the last event.
    """

    result: SearchResult

    def __init__(self, happens: Generator[SearchEvent, None, SearchResult]) -> None:
        self._happens = happens
        self._error: BaseException | None = None

    @property
    def is_over(self) -> bool:
        return getgeneratorstate(self._happens) == GEN_CLOSED

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> SearchEvent:
        __tracebackhide__ = True
        error, self._error = self._error, None
        try:
            return next(self._happens) if error is None else self._happens.throw(error)
        except StopIteration as end:
            # The generator returns the result, which a for loop would drop.
            self.result = end.value
            raise
        finally:
            del error  # its traceback refers to this frame

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: object, error: BaseException | None, place: object) -> bool:
        if isinstance(error, StopIteration):
            # A generator would replace it with an error at the line where the search waits.
            error = ListenerError(error)
        # If the search is over, nobody could handle the exception, so it is raised here.
        self._error = None if self.is_over else error
        return not self.is_over


@dataclass(frozen=True, slots=True, kw_only=True)
class Prepared:
    """A search that is ready to run."""

    state: State
    bench: Bench
    store: Store

    def search(
        self,
        algorithm: Algorithm[Any] | RandomSearch,
        *,
        generations: int,
        runs: int | None,
        seed: int,
        stop: Callable[[], bool],
    ) -> Generator[SearchEvent, None, None]:
        """Search until ``stop()`` returns True, without a time limit. Failures are only counted."""
        # A comparison has no corpus, and its failures need no files.
        self.store.only_counts = True
        return search(
            scenarios_of(algorithm, self.bench, generations=generations, runs=runs, seed=seed),
            self.state,
            self.bench,
            self.store,
            Watch(stop),
        )

    def watch(self, node_id: str, limit: float, *, progress_seconds: float) -> TimedWatch:
        return TimedWatch(
            node_id=node_id,
            state=self.state,
            bench=self.bench,
            store=self.store,
            limit=limit,
            most=self.bench.harness.request.settings.stop_after,
            progress_seconds=progress_seconds,
        )


@contextmanager
def prepared(
    harness: Harness,
    *,
    space: SearchSpace | None = None,
    is_steered: bool = True,
    note: Callable[[Run, Verdict], Mapping[str, Any]] | None = None,
) -> Iterator[Prepared]:
    """Build the parts of a search, and stop its processes at the end of this context.

    Raises:
        RequestError: if the fitness does not exist, or the world cannot be used.
    """
    request, seed = harness.request, search_seed(harness.request.settings.seed, harness.node_id)
    # A session that only replays needs no space, so a wrong argument of the search does not prevent it.
    if space is None and request.settings.is_search:
        space = build_space(request, harness.world)
    # The fitness leads the search to collisions for which the ego is responsible.
    is_for_ego = is_steered and request.blame != "any"
    try:
        fitness = Steered(resolve(request.fitness), is_for_ego=is_for_ego)
    except FitnessError as error:
        raise request.error("fitness=...", error) from None
    # Building the job also builds the world, so an environment that cannot be used is reported here.
    job, settings = harness.job(), request.settings
    examiner = Examiner(harness=harness, fitness=fitness, seed=seed, note=note)
    # Forked processes evaluate their own runs. A fitness function of the user is called only in this process, where its
    # errors are reported.
    why_here = _why_judged_here(harness)
    driver: Driver | None = None
    if why_here:
        job = replace(job, remark=f". This process evaluated all runs, because {why_here}")
    else:
        job = replace(job, read=examiner, remark=", which also evaluated them")
        # With a reference, only this process knows whether a failure counts.
        if harness.against is None:
            driver = Driver(examiner=examiner)
            job = replace(job, drive=driver)
    with ExitStack() as stack:
        record = stack.enter_context(harness.recording(job))
        with refusals():
            runner = runner_for(
                job,
                record,
                workers=settings.workers,
                isolate=settings.isolate,
                cluster=harness.cluster,
            )
        # Runs after the search start new processes, which must be stopped as well.
        stack.push(runner.__exit__)
        reference = harness.reference_runner(harness.job(), record, isolate=settings.isolate)
        if reference is not None:
            stack.push(reference.__exit__)
        # The same clock for all parts, which tests replace by one that stands still.
        state = State(clock=monotonic, space=space, began=monotonic())
        yield Prepared(
            state=state,
            bench=Bench(
                harness=harness,
                runner=runner,
                record=record,
                reference=reference,
                driver=driver,
                examiner=examiner,
                budget=Budget(clock=state.clock),
            ),
            store=Store(harness=harness, seed=seed),
        )


def scenarios_of(
    algorithm: Algorithm[Any] | RandomSearch,
    bench: Bench,
    *,
    generations: int | None,
    runs: int | None,
    seed: int,
) -> Bred | Numbers:
    """Return the scenarios of a search, up to a maximum number of generations or runs."""
    if isinstance(algorithm, RandomSearch):
        return Numbers(algorithm=algorithm, seed=seed, runs=runs, bench=bench)
    seeds_matter = (bench.harness.policy.sight or Sight()).is_drawn
    return Bred(
        bench, algorithm, generations=generations, runs=runs, seed=seed, seeds_matter=seeds_matter
    )


def _why_judged_here(harness: Harness) -> str:
    # Return why only this process can evaluate runs, or an empty string if the other processes can, too.
    # It may read what the test has stored in this process.
    if not is_built_in(harness.request.fitness):
        return "the fitness is your own"
    if not harness.needs_only_run:
        return "the test function has arguments other than the run"
    is_apart = harness.cluster is not None  # its workers may be on other machines
    return "the workers were not forked from it" if is_apart or not forks() else ""


# Start to read at `run`. The loop over scenarios is in searches/search.py.
@dataclass(slots=True, kw_only=True)
class SearchSession:
    """One session of a test's search, from the replays to the summary."""

    watch: TimedWatch
    replays: Replays
    # notes on drivers and slow runs, for the summary
    driver_notes: list[str] = field(default_factory=list)
    process_notes: list[str] = field(default_factory=list)  # notes on processes, for the summary
    # only for a search with findings and a reference
    _worse: MadeWorse | None = field(init=False, default=None)

    @property
    def state(self) -> State:
        return self.watch.state

    @property
    def bench(self) -> Bench:
        return self.watch.bench

    @property
    def store(self) -> Store:
        return self.watch.store

    @property
    def limit(self) -> float:
        return self.watch.limit

    @property
    def harness(self) -> Harness:
        return self.bench.harness

    def _events(self, happened: Iterable[SearchEvent | Phase | Note]) -> Iterator[SearchEvent]:
        # An exception of the consumer must not reach the generator that yields, which could take it for an error of the
        # user's world. The generator is closed immediately. Otherwise, it could delay all later interrupts.
        try:
            for event in happened:
                match event:
                    case Phase():
                        yield from self.watch.progress(*event)
                    case Note():  # for example, if the world cannot simulate a careful driver
                        # The same note can come from each finding.
                        if event.text not in self.driver_notes:
                            self.driver_notes.append(event.text)
                    case _:
                        yield event
        finally:
            if isinstance(happened, Generator):
                happened.close()

    def run(self) -> Generator[SearchEvent, None, SearchResult]:
        """Replay saved scenarios, search, compare, refine the findings, and report a summary.

        Raises:
            RequestError: if the search cannot be run as requested.
        """
        __tracebackhide__ = True
        state, bench, store = self.state, self.bench, self.store
        yield SearchStarted(node_id=self.watch.node_id, seed=store.seed)
        began = state.clock()
        bench.budget.end = max(self.limit, began + LEAST)
        # If a process of an earlier session died, run its scenario again before anything else.
        pending = yield from self._retried(self.harness.left_behind())
        ending = Ending.INTERRUPTED
        faults: list[SetupFaultError] = []
        has_consumer = True
        try:
            # Replay saved scenarios, search, and confirm each new failure. The failures that saved scenarios accept
            # must be known before processes are forked, because the processes evaluate their own runs.
            with bench.runner:
                ending = yield from self._searched(saved_in(self.harness.folder), began)
            # Report all findings before the work on them, which takes long and may be cut short.
            yield from self._reported(ending)
            # Compare. With a reference, findings are refined only if they show that the policy became worse.
            yield from self._compared()
            # Refine. Random numbers that this work draws must not affect the tests that follow.
            with GENERATORS.held():
                yield from self._events(refine(state, bench, store, until=self.limit))
        except SetupFaultError as error:
            ending = Ending.ERROR
            faults.append(error)
            yield from self._events(store.withdraw())
            state.forget_findings()
        except BaseException as error:
            has_consumer = not isinstance(error, GeneratorExit)
            is_interrupted = not has_consumer or is_interruption(error)
            ending = Ending.INTERRUPTED if is_interrupted else Ending.ERROR
            raise
        finally:
            # Report the findings and the summary even after an error, including one of the consumer, see Events. An
            # interrupt must not come between the two.
            with postponed():
                reported = self._reported(ending, with_worst=False)
                if has_consumer:
                    yield from reported
                else:  # findings are only saved
                    deque(reported, maxlen=0)
                # The records of dead processes are discarded last: if this session dies, the next one reads them.
                for leftover in pending:
                    leftover.discard()
                summary = self._summary(ending)
                if has_consumer:
                    yield summary
        return self._result(summary, faults)

    def _reported(self, ending: Ending, *, with_worst: bool = True) -> Iterator[SearchEvent]:
        # If the search was cut short, failures that arrived before their turn count. Otherwise, they are forgotten.
        is_cut = ending.is_broken_off or ending is Ending.MAX_TIME
        for settled in self.store.settle(keeps=is_cut):
            self.state.finds[settled.signature] = settled.id
            self.state.counts += settled.counts
        yield from self._events(self.store.release())
        if with_worst:
            yield from self._events(self.store.note_worst(self.state))

    def _compared(self) -> Iterator[SearchEvent]:
        # Without a finding, no comparison could change the result, so none is paid for.
        if self.harness.against is None or self.state.space is None or not self.store.count:
            return
        now = self.state.clock()
        worse = MadeWorse(
            state=self.state,
            bench=self.bench,
            store=self.store,
            end=now + (self.limit - now) / 2,
        )
        self._worse = worse
        yield from self._events(worse.compare(self.state.space))

    def _result(self, summary: Search, faults: Sequence[SetupFaultError]) -> SearchResult:
        __tracebackhide__ = True
        store, state, harness = self.store, self.state, self.harness
        fault: BaseException | None = None
        for each in faults:
            fault = each.shown(harness.world, harness.policy)
        return SearchResult(
            summary=summary,
            findings=tuple(store.findings.values()),
            count=store.count,
            first_exception=store.first_exception,
            fault=fault,
            skip=self._skip(),
            is_vacuous=state.counts.health.vacuous or bool(state.counts.broken),
        )

    def _summary(self, ending: Ending) -> Search:
        bench = self.bench
        self.process_notes += bench.runner.notes
        if bench.record.error:
            self.process_notes.append(str(bench.record.error))
        return summary_of(
            ending,
            node_id=self.watch.node_id,
            state=self.state,
            bench=bench,
            store=self.store,
            paired=None if self._worse is None else self._worse.paired,
            driver_notes=self.driver_notes,
            process_notes=self.process_notes,
        )

    def _skip(self) -> BaseException | None:
        # If the test function skipped every run, run the first skipped scenario again, so that its skip skips the item.
        __tracebackhide__ = True
        state, bench = self.state, self.bench
        if state.first_skipped is None or state.counts.kinds["skipped"] < state.runs:
            return None
        try:
            verdict = bench.finish(bench.run(state.first_skipped))
        except ProcessLostError:  # without a skip to report, the item has its usual result
            return None
        return verdict.exception if verdict.kind == "skipped" else None

    def _retried(self, left: Sequence[Leftover]) -> Generator[SearchEvent, None, list[Leftover]]:
        # Run the scenario of each dead process again, in the same world. The crash records that are returned are
        # discarded at the end of the search. If this session dies, the next one reads them. A process may also have
        # been killed from outside, because a job was cancelled or memory was short. Then its scenario shows nothing
        # about the ADS. It is a finding if a second process dies in it, or if none can be started. It is also a finding
        # if two processes had already died in it, even if both were killed: the cause is probably something that
        # accumulates from run to run, such as memory, which would otherwise never be reported.
        harness, pending = self.harness, list[Leftover]()
        for leftover in left:
            same = [each for each in left if each.scenario == leftover.scenario]
            world, scenario = self._world_of(leftover), leftover.scenario
            assert scenario is not None  # noqa: S101  (the record has an owner, so it could be read)
            if same[0] is not leftover:  # of several records of a scenario, only the first counts
                leftover.discard()
                continue
            pending.append(leftover)
            who = f"a process (pid {leftover.pid}) died while"
            if leftover.reference:  # the reference is the cause, so the ADS is not run again
                self.process_notes.append(
                    f"{who} the reference {leftover.reference} drove in {scenario}, which shows nothing about the "
                    f"ADS. Correct the reference, or use {flag('isolate')} to run it in another process"
                )
                continue
            if world is None:
                self.process_notes.append(
                    f"{who} it ran {scenario!r:.300} in a world that can no longer be built, "
                    f"{dict(leftover.world or {})!r:.200}. The run cannot be repeated, so it is not a finding"
                )
                continue
            deaths = list[LostRun]()
            # The scenario is a finding unless a separate process shows that it can be completed.
            is_well = False
            if harness.request.settings.isolate or forks():
                try:
                    judge = partial(harness.judge_trace, world)
                    raised = judged_apart(harness.job(world), scenario, judge).error
                    # An error of the ADS at its first decision may occur only in the separate process.
                    is_well = raised is None or (raised.tick > 0 and not raised.interrupted)
                except ProcessLostError as error:
                    deaths.append(error)
                except Exception:  # noqa: BLE001, S110  (the first run of the search reports it)
                    pass
            # The session itself has noticed the end of watched processes, and has reported it.
            has_died_twice = sum(not each.is_watched for each in same) > 1
            if has_died_twice or not is_well:
                sighting = self.store.add_crash(leftover, scenario, deaths)
                pending.remove(leftover)
                leftover.discard()
                yield from self._events(self.store.publish(sighting))
                continue
            self.process_notes.append(
                f"{who} it ran {scenario}, but the scenario completed when it was repeated. The process was "
                "probably killed from outside, or ran out of memory"
            )
        return pending

    def _world_of(self, leftover: Leftover) -> BaseWorld | None:
        # Return None if the world cannot be built.
        # Old records have no world. They belong to the test's world.
        if leftover.world in (None, self.harness.job().world_data):
            return self.harness.world
        try:
            return None if codec.is_code(leftover.world) else codec.from_dict(leftover.world)
        except (WorldError, TypeError, ValueError):
            return None

    def _searched(
        self, saved: Sequence[Saved], began: float
    ) -> Generator[SearchEvent, None, Ending]:
        __tracebackhide__ = True
        state, bench, watch, clock = self.state, self.bench, self.watch, self.state.clock
        if state.space is None:
            return Ending.REPLAYS
        request = self.harness.request
        try:
            algorithm = request.algorithm.make(state.space)
        except ValueError as error:
            raise RequestError(str(error)) from None
        state.is_random = isinstance(algorithm, RandomSearch)
        self.store.replayed = frozenset(each.path for each in saved)
        # Saved crashes are not run again in the search: their own items replay them, each in a process of its
        # own.
        state.fatal |= {
            each.finding.scenario for each in saved if each.finding is not None and each.is_crash
        }
        # The earliest end of the loop, however long the work on its findings may take.
        until = began + (self.limit - began) * (1 - FOR_SIMPLIFYING)
        try:
            with runs_end_in(bench.budget.end - clock()):
                state.shown, accepted = self.replays.shown_by(saved)  # Their failures are not new.
        except OutOfTime:  # Without all replays, it is unclear which failures are new.
            return Ending.MAX_TIME
        # Before the search starts processes, which have a copy of the examiner.
        bench.examiner.accepted.update(accepted)
        watch.begin(until)
        runs_before = state.runs
        try:
            scenarios = scenarios_of(
                algorithm,
                bench,
                generations=request.settings.generations,
                runs=request.settings.runs,
                seed=self.store.seed,
            )
            yield from self._events(search(scenarios, state, bench, self.store, watch))
        except FitnessError as error:
            raise RequestError(str(error)) from None
        except skips() as error:
            raise RequestError(no_skip("the fitness", error)) from None
        # The consumer ended the search between two events.
        if state.finished is None:
            return Ending.INTERRUPTED
        lost = clock() - watch.last
        runs = state.runs - runs_before
        mean = (watch.last - watch.began) / (runs + 1)
        if state.finished.reason == "time" and lost > max(1.0, SLOW_RUNS * mean):
            self.driver_notes.append(
                f"{Ending.MAX_TIME} stopped a run after {lost:.1f} s, with {plural(runs, 'run')} before it. To find "
                "out whether a decision hangs, use a longer limit, or a shorter hang_limit of the world"
            )
        return ENDINGS[state.finished.reason]


def isolated_after_a_death(harness: Harness, replays: Replays) -> Harness:
    """Return a harness that isolates the policy if a process of this search has died before."""
    # Only forked processes can receive every factory.
    settings = harness.request.settings
    if not forks() or settings.isolate or not settings.is_search:
        return harness
    # A crash record, or a saved crash that still occurs, means that the policy can end this process, too.
    if harness.left_behind() or any(
        each.is_crash and replays.still_fails(each) for each in saved_in(harness.folder)
    ):
        return replace(
            harness, request=replace(harness.request, settings=replace(settings, isolate=True))
        )
    return harness
