"""The loop of a search: sample, simulate, evaluate, learn."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import assert_never

from pytest_pafot.algorithms.evaluation import (
    EndReason,
    Evaluated,
    GenerationFinished,
    Health,
    PlanFinished,
)
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.searches.bench import Bench
from pytest_pafot.searches.events import Progress, SearchEvent
from pytest_pafot.searches.harness import SetupFaultError, cause_of
from pytest_pafot.searches.made_worse import PAIRS
from pytest_pafot.searches.refine.simplest import rollouts_for
from pytest_pafot.searches.results import Counts, Result, State
from pytest_pafot.searches.scenarios import FIRST, Bred, Early, NoScenario, Numbers, Reused
from pytest_pafot.searches.store import OnlyCounted, Saved, Store, record_death
from pytest_pafot.support.errors import OutOfTime
from pytest_pafot.world.guard.hang_guard import runs_end_in

# The time to find and confirm a failure, as a number of runs: the first run, the second run, and a run in
# highway-env's own environment, which takes about as long as two.
RUNS_TO_CONFIRM = 4

RUNS_FOR_MOMENT = 40  # approximate number of runs to find the moment of a finding

# The time that a search always has for replays, its first run and the confirmation of a finding in that run [s]. So a
# search with a fast policy tests something even if the time limit is very short.
LEAST = 2.0


@dataclass(slots=True)
class Watch:
    """The limits of a search, and the reports on its progress."""

    stop: Callable[[], bool] = lambda: False  # returns True to end the search

    def reached(self, scenarios: Bred | Numbers) -> EndReason | None:
        # The caller's own limit comes first, because it may be exact to the run.
        if self.stop():
            return "stopped"
        return "runs" if scenarios.has_all_runs else None

    def seconds_left(self) -> float:
        """Return the time [s] that is left for the next run."""
        return math.inf

    def after_event(self) -> Iterator[SearchEvent]:
        """Yield a progress report if one is due."""
        yield from ()

    def before_rerun(self, find_id: str) -> Iterator[SearchEvent]:
        yield from ()


@dataclass(slots=True, kw_only=True)
class TimedWatch(Watch):
    """A watch with a time limit and progress reports."""

    node_id: str  # node id of the search in reports
    state: State
    bench: Bench
    store: Store
    limit: float  # time at which the search must end, including shrinking, or infinity [s]
    most: int | None  # number of findings after which the search ends, or None
    progress_seconds: float  # interval between progress reports [s]
    began: float = 0.0  # time at which the loop started [s]
    earliest_end: float = math.inf  # earliest time at which the time limit can end the loop [s]
    last: float = 0.0  # time of the last event of the plan [s]
    _runs_before: int = 0
    _reported_at: float = field(init=False)
    # The time without confirmations [s], and the number of runs, both after the first run, which loads libraries.
    _since: tuple[float, int] | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        # The first report comes after an interval, so short searches print none.
        self._reported_at = self.state.clock()

    def begin(self, earliest_end: float) -> None:
        self.began = self.last = self.state.clock()
        self.earliest_end = earliest_end
        self._runs_before = self.state.runs

    def reached(self, scenarios: Bred | Numbers) -> EndReason | None:
        # Findings that are held back do not count yet, because they may turn out to be a fault of the set-up.
        if self.most is not None and self.store.count >= self.most:
            return "stopped"
        if scenarios.has_all_runs:
            return "runs"
        return "time" if self.state.clock() >= self._ends() else None

    def seconds_left(self) -> float:
        # The first run has at least the time LEAST.
        ends = self._ends() if self.store.firm else self.limit
        if self.state.runs <= self._runs_before:
            ends = max(ends, self.began + LEAST)
        return ends - self.state.clock()

    def _ends(self) -> float:
        # The remaining time must be enough to simplify the findings so far or, if there are none, to confirm one in the
        # last run. That time is estimated from the runs so far.
        if self.limit == math.inf:
            return self.earliest_end
        harness = self.bench.harness
        # Each finding that can be shrunk needs its share of the time that is left.
        runs = self.store.firm * (RUNS_TO_CONFIRM + rollouts_for(harness) + RUNS_FOR_MOMENT)
        if harness.against is not None:
            runs += 2 * PAIRS
        elapsed = self.state.clock() - self.began
        runs_so_far = max(self.state.runs - self._runs_before, 1)
        run_seconds = elapsed * harness.request.settings.workers / runs_so_far
        return max(self.earliest_end, self.limit - (runs or RUNS_TO_CONFIRM) * run_seconds)

    def after_event(self) -> Iterator[SearchEvent]:
        self.last = self.state.clock()
        if self._since is None and self.state.runs > self._runs_before:
            self._since = self.last - self.bench.confirm_seconds, self.state.runs
        return self.progress()

    def before_rerun(self, find_id: str) -> Iterator[SearchEvent]:
        return self.progress(f"found {find_id}, running it again")

    @property
    def _run_seconds(self) -> float:
        # The mean time of a run in its process [s], or 0 if it is not yet known. Confirmations are not included,
        # because almost all of them are at the start, when most failures are new.
        runner = self.bench.runner
        # Processes report their own times. The time of this process says nothing about them.
        if runner.in_use:
            return runner.run_seconds
        # The first runs on a cluster finish together, after the time of one run.
        if self._since is None or (runner.is_elsewhere and not self.state.generation):
            return 0.0
        began, before = self._since
        made = self.state.runs - before
        if not made:
            return 0.0
        return (self.state.clock() - self.bench.confirm_seconds - began) / made

    def progress(self, phase: str = "", of: str = "") -> Iterator[SearchEvent]:
        state, runner = self.state, self.bench.runner
        now = state.clock()
        # Each report is a message to the controller, and thousands of runs take less than a second.
        if now - self._reported_at < self.progress_seconds:
            return
        self._reported_at = now
        settings = self.bench.harness.request.settings
        run_seconds = self._run_seconds
        runs_left = 0 if settings.runs is None else settings.runs - state.runs
        decisions = state.counts.decisions
        decision_seconds = 0.0
        if decisions:
            decision_seconds = run_seconds * state.runs / decisions
        yield Progress(
            node_id=self.node_id,
            generation=min(state.generation + 1, settings.generations or state.generation + 1),
            generations=settings.generations,
            runs=state.runs,
            budget=settings.runs,
            failing=state.counts.kinds["failed"],
            finds=self.store.count,
            seconds=state.seconds,
            left=runs_left * run_seconds / max(runner.in_use, 1),
            decision_seconds=decision_seconds,
            is_limited=self.limit < math.inf,
            phase=phase,
            of=of,
        )


def search(
    scenarios: Bred | Numbers, state: State, bench: Bench, store: Store, watch: Watch
) -> Generator[SearchEvent, None, None]:
    """Sample and evaluate scenarios, and save each new failure.

    Raises:
        SetupFaultError: if the first runs all fail with the same exception.
        RequestError: if the world, the factory, the test function or a scenario cannot be used.
    """
    began = state.clock()
    reason: EndReason | None = None
    yield from _record([scenarios.started], state, bench, watch)
    while not scenarios.is_over:
        # Limits apply after the first scenario, so that each search tests something.
        reason = watch.reached(scenarios) if state.runs else None
        if reason is not None:
            break
        state.generation = scenarios.generation
        # Run and evaluate the next scenario. Other processes may already have run it, and several more.
        try:
            with runs_end_in(watch.seconds_left()):
                step = scenarios.next(state)
        except OutOfTime:
            reason = "time"
            break
        happened: Sequence[SearchEvent] = ()
        match step:
            case Early(result, number):
                # Its file is on disk before any other scenario runs. It is counted in its turn.
                store.add_early(result, number, state.known)
                continue
            case Counts():
                assert isinstance(scenarios, Numbers)  # noqa: S101  (algorithms that learn need each evaluation)
                state.counts += step
                scenarios.count(step.runs)
                yield from watch.after_event()
            case Result(ended="lost"):
                # The pool has already run it again, unless it hung, so it is reported without another run.
                yield from record_death(step, state, store)
                state.take(step)
                happened = scenarios.take(step.evaluation)
            case Result():
                state.take(step)
                yield from _released(state, store)
                yield from _saved(step, state, bench, store, watch)
                # Only now may the algorithm propose more: the file is written before the next scenario runs.
                happened = scenarios.take(step.evaluation)
            case Reused(evaluation):
                happened = scenarios.take(evaluation, reused=True)
            case NoScenario(events):
                happened = events
            case _:
                assert_never(step)
        yield from _released(state, store)
        yield from _record(happened, state, bench, watch)
        if isinstance(scenarios, Numbers) and scenarios.number == FIRST:
            check_set_up(state, bench, " at the start")
    _check_all_have_findings(state)
    if isinstance(scenarios, Numbers) and reason == "runs" and scenarios.number < FIRST:
        check_set_up(state, bench, "")
    finished = scenarios.finished(reason or "generations", state.clock() - began)
    yield from _record(finished, state, bench, watch)


def _check_all_have_findings(state: State) -> None:
    # Each counted failure needs a finding or a saved scenario. Otherwise, the search would pass despite the failure.
    failures = state.counts.failures
    runs = sum(each.runs for each in failures.values())
    if failures.keys() - state.known or runs != state.counts.kinds["failed"]:
        raise RuntimeError(
            f"a failure has no finding: {state.counts!r:.300}. Please report this bug in pytest-pafot"
        )


def _record(
    happened: Iterable[SearchEvent], state: State, bench: Bench, watch: Watch
) -> Iterator[SearchEvent]:
    # The event first, then its effects, so that a consumer that stops here has seen it.
    for event in happened:
        yield event
        match event:
            case Evaluated(reused=True):
                state.counts.health += Health(evaluated=1)
            case GenerationFinished(generation=0, local_generation=0):
                check_set_up(state, bench, " of the first generation")
            case PlanFinished():
                state.finished = event
        yield from watch.after_event()


def check_set_up(state: State, bench: Bench, where: str) -> None:
    """Check that the runs so far did not all end in the same exception.

    Raises:
        SetupFaultError: if they did, and the first scenario ends in the exception again.
    """
    counts = state.counts
    is_alike = state.is_alike
    state.is_set_up = True  # Even if the check below raises, the set-up is not checked again.
    if not is_alike or state.first is None:
        return
    try:
        run = bench.run(state.first)
    except ProcessLostError:  # not a fault of the set-up
        return
    verdict = bench.finish(run)
    # If the exception does not come again, the runs had it by chance, so their findings stay.
    if cause_of(run, verdict) in counts.causes:
        judged = counts.causes.total()
        evaluated = "evaluated " if judged < counts.runs else ""
        raise SetupFaultError(run, verdict, f"all {judged} {evaluated}runs{where}")


def _saved(
    result: Result, state: State, bench: Bench, store: Store, watch: Watch
) -> Iterator[SearchEvent]:
    # Save a new failure first. Then run its scenario again, and report it unless findings are held back.
    failed = result.failed
    if failed is None or failed.signature in state.known:
        return
    added = store.add(result, state.generation)
    match added:
        # There is no file to confirm.
        case OnlyCounted():
            pass
        case Saved(seen):
            yield from watch.before_rerun(seen.id)
            seen = store.confirmed(seen, bench.confirm(failed))
            if not store.is_holding:
                yield from store.publish(seen)
        case _:
            assert_never(added)
    # Last, because a finding counts as known only once it is reported or held back.
    state.finds[failed.signature] = added.id


def _released(state: State, store: Store) -> Iterator[SearchEvent]:
    # As soon as two runs differ, it is clear that the set-up has no fault, so report the findings that were held back.
    if store.is_holding and not state.is_alike:
        yield from store.release()
