"""The loop of a search: sample, simulate, evaluate, learn."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

from pytest_pafot.campaign.bench import Bench
from pytest_pafot.campaign.events import Progress, SearchEvent
from pytest_pafot.campaign.harness import SetupFaultError, cause_of
from pytest_pafot.campaign.made_worse import PAIRS
from pytest_pafot.campaign.refine.simplest import rollouts_for
from pytest_pafot.campaign.results import Counts, Failed, Result, State, lost
from pytest_pafot.campaign.scenarios import FIRST, Bred, Early, Numbers
from pytest_pafot.campaign.store import Store, lose
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.searching.evaluation import (
    CampaignFinished,
    EndReason,
    Evaluated,
    Evaluation,
    GenerationFinished,
    Health,
)
from pytest_pafot.support.errors import OutOfTime
from pytest_pafot.world.guard.hang_guard import runs_end_in

# The time to find and confirm a failure, as a number of runs. The scenario is run, run again, and run in highway-
# env's own environment, which takes about as long as two runs.
RUNS_TO_CONFIRM = 4

RUNS_FOR_MOMENT = 40  # about how many runs it takes to find the moment of a finding

# The time that a search has for its replays, its first run and the confirmation of a finding in it, even if its limit
# is over by then [s]. So a search of a fast policy tests something even with a very short limit.
LEAST = 2.0


@dataclass(slots=True)
class Watch:
    """The limits of a search, and reports on its progress."""

    # This class asks a function, and reports nothing.

    stop: Callable[[], bool] = lambda: False

    def reached(self, scenarios: Bred | Numbers) -> EndReason | None:
        """Return the limit that is reached, or None."""
        return "stopped" if self.stop() else "runs" if scenarios.has_all_runs else None

    def seconds_left(self) -> float:
        """Return the time after which a run ends between two decisions [s]."""
        return math.inf

    def after_event(self) -> Iterator[SearchEvent]:
        """Yield a report of the progress if one is due."""
        yield from ()

    def before_rerun(self, find_id: str) -> Iterator[SearchEvent]:
        """Yield a report of the progress before a finding is run again."""
        yield from ()


@dataclass(slots=True, kw_only=True)
class TimedWatch(Watch):
    """A watch for a search that has a limit or reports its progress."""

    node_id: str  # node id of the search in reports
    state: State
    bench: Bench
    store: Store
    limit: float  # time at which the search has to end, with shrinking, or infinity [s]
    most: int | None  # number of findings after which it ends, or None
    progress_seconds: float  # interval between reports of progress [s]
    began: float = 0.0  # time at which the loop started [s]
    earliest_end: float = math.inf  # earliest time at which it ends for lack of time [s]
    last: float = 0.0  # time of the last event of the plan [s]
    _runs_before: int = 0
    _reported_at: float = field(init=False)
    # The time [s], without what confirmed findings, and the number of runs after the first one, which loads libraries.
    _since: tuple[float, int] | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        self._reported_at = self.state.clock()

    def begin(self, earliest_end: float) -> None:
        """Note the start of the loop, and the earliest time at which it may end [s]."""
        self.began = self.last = self.state.clock()
        self.earliest_end, self._runs_before = earliest_end, self.state.runs

    def reached(self, scenarios: Bred | Numbers) -> EndReason | None:
        if self.most is not None and self.store.count >= self.most:
            return "stopped"
        if scenarios.has_all_runs:
            return "runs"
        return "time" if self.state.clock() >= self._ends() else None

    def seconds_left(self) -> float:
        # The first run gets its time in any case.
        ends = self._ends() if self.store.firm else self.limit
        ends = ends if self.state.runs > self._runs_before else max(ends, self.began + LEAST)
        return ends - self.state.clock()

    def _ends(self) -> float:
        # The time that is left must be enough to simplify the findings so far, or without any, to confirm one in the
        # last run. It is estimated from the runs so far.
        harness, state = self.bench.harness, self.state
        settings, firm = harness.request.settings, self.store.firm
        if self.limit == math.inf:
            return self.earliest_end
        to_simplify = RUNS_TO_CONFIRM + rollouts_for(harness) + RUNS_FOR_MOMENT
        to_compare = 0 if harness.against is None else 2 * PAIRS
        run_seconds = (state.clock() - self.began) * settings.workers / max(state.runs - self._runs_before, 1)
        seconds = (firm * to_simplify + to_compare or RUNS_TO_CONFIRM) * run_seconds
        return max(self.earliest_end, self.limit - seconds)

    def after_event(self) -> Iterator[SearchEvent]:
        self.last = self.state.clock()
        if self._since is None and self.state.runs > self._runs_before:
            self._since = self.last - self.bench.confirm_seconds, self.state.runs
        return self.progress()

    def before_rerun(self, find_id: str) -> Iterator[SearchEvent]:
        return self.progress(f"found {find_id}, running it again")

    @property
    def _run_seconds(self) -> float:
        # The mean time of a run in the process that makes it [s]; 0 if it is not yet known. Confirming a finding is not
        # included: at first most failures are new, and later almost none.
        runner = self.bench.runner
        if runner.in_use:
            return runner.run_seconds
        # The first runs of a cluster come at the same time, after that of one run.
        if self._since is None or (runner.is_elsewhere and not self.state.generation):
            return 0.0
        began, before = self._since
        made = self.state.runs - before
        return (self.state.clock() - self.bench.confirm_seconds - began) / made if made else 0.0

    def progress(self, phase: str = "", of: str = "") -> Iterator[SearchEvent]:
        """Yield a report of the progress if one is due."""
        state, runner = self.state, self.bench.runner
        now = state.clock()
        if now - self._reported_at < self.progress_seconds:
            return
        self._reported_at = now
        settings = self.bench.harness.request.settings
        run_seconds = self._run_seconds
        runs_left = 0 if settings.runs is None else settings.runs - state.runs
        decisions = state.counts.decisions
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
            decision_seconds=run_seconds * state.runs / decisions if decisions else 0.0,
            is_limited=self.limit < math.inf,
            phase=phase,
            of=of,
        )


def search(
    scenarios: Bred | Numbers, state: State, bench: Bench, store: Store, watch: Watch
) -> Generator[SearchEvent, None, None]:
    """Sample and evaluate scenarios, and save each new failure.

    Raises:
        SetupFaultError: if all runs at the start end in the same exception.
        RequestError: for a world, factory, test function or scenario that does not fit.
    """
    began, reason = state.clock(), None
    yield from _record([scenarios.started], state, bench, watch)
    while not scenarios.is_over:
        # Limits count after the first scenario, so that a search tests something.
        reason = watch.reached(scenarios) if state.runs else None
        if reason is not None:
            break
        state.generation = scenarios.generation
        # Drive the next scenario and evaluate it. Other processes may have done so, for several scenarios together.
        try:
            with runs_end_in(watch.seconds_left()):
                done = scenarios.next(state)
        except OutOfTime:
            reason = "time"
            break
        happened: Sequence[SearchEvent] = ()
        match done:
            case Early():
                store.add_early(done.result, done.number, state.known)
                continue
            case Counts():
                assert isinstance(scenarios, Numbers)  # noqa: S101  (an algorithm that learns is told each run)
                state.counts += done
                scenarios.count(done.runs)
                yield from watch.after_event()
            case ProcessLostError():
                result = yield from lose(done, state, bench, store)
                state.take(result)
                happened = scenarios.take(result.evaluation)
            case Result():
                state.take(done)
                yield from _released(state, store)
                failed = done.failed
                # It is on disk before the next scenario, so nothing is lost.
                if failed is not None and failed.signature not in state.known:
                    state.finds[failed.signature] = yield from _confirmed(done, failed, state, bench, store, watch)
                happened = scenarios.take(done.evaluation)
            case Evaluation():
                happened = scenarios.take(done, reused=True)
            case None:  # a process died in it before
                happened = scenarios.take(lost(scenarios.scenario(), None).evaluation, reused=True)
            case _:
                happened = done
        yield from _released(state, store)
        yield from _record(happened, state, bench, watch)
        if isinstance(scenarios, Numbers) and scenarios.number == FIRST:
            check_set_up(state, bench, " at the start")
    # No failure may be counted that neither a finding nor a saved scenario shows, or the search would pass with it.
    failures = state.counts.failures
    if failures.keys() - state.known or sum(each.runs for each in failures.values()) != state.counts.kinds["failed"]:
        raise RuntimeError(f"a failure has no finding: {state.counts!r:.300}. Please report this bug in pytest-pafot")
    if isinstance(scenarios, Numbers) and reason == "runs" and scenarios.number < FIRST:
        check_set_up(state, bench, "")
    yield from _record(scenarios.finished(reason or "generations", state.clock() - began), state, bench, watch)


def _record(happened: Iterable[SearchEvent], state: State, bench: Bench, watch: Watch) -> Iterator[SearchEvent]:
    for event in happened:
        yield event
        match event:
            case Evaluated(reused=True):
                state.counts.health += Health(evaluated=1)
            case GenerationFinished(generation=0, local_generation=0):
                check_set_up(state, bench, " of the first generation")
            case CampaignFinished():
                state.finished = event
        yield from watch.after_event()


def check_set_up(state: State, bench: Bench, where: str) -> None:
    """Check that not all runs so far ended in the same exception.

    Raises:
        SetupFaultError: if they did, and the first of them does so again.
    """
    counts, is_alike, state.is_set_up = state.counts, state.is_alike, True
    if not is_alike or state.first is None:
        return
    try:
        run = bench.run(state.first)
    except ProcessLostError:  # which is no fault of the set-up
        return
    verdict = bench.finish(run)
    if cause_of(run, verdict) in counts.causes:
        judged = counts.causes.total()
        judged_only = " with a verdict" if judged < counts.runs else ""
        raise SetupFaultError(run, verdict, f"all {judged} runs{where}{judged_only}")


def _confirmed(
    result: Result, failed: Failed, state: State, bench: Bench, store: Store, watch: Watch
) -> Generator[SearchEvent, None, str]:
    # The new failure is saved first. Then its scenario is run again, and it is reported or held back.
    sighting = store.add(result, state.generation)
    if isinstance(sighting, str):
        return sighting
    yield from watch.before_rerun(sighting.id)
    sighting = store.confirmed(sighting, *bench.confirm(failed.finding.scenario, failed.trace, failed.signature))
    if not store.is_holding:
        yield from store.publish(sighting)
    return sighting.id


def _released(state: State, store: Store) -> Iterator[SearchEvent]:
    # As soon as two runs differ, the findings that were held back are no fault of the set-up.
    if store.is_holding and not state.is_alike:
        yield from store.release()
