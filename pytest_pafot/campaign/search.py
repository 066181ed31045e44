"""The loop of a search: draw, drive, judge, learn.

What is around it, such as the replays of saved scenarios and the simplification of findings, is in
:mod:`pytest_pafot.campaign.search_session`.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator, Sequence

from pytest_pafot.campaign.bench import Bench
from pytest_pafot.campaign.events import Judged, SearchEvent
from pytest_pafot.campaign.judging import caught_in, unknown
from pytest_pafot.campaign.scenarios import FIRST, Bred, Numbers, PendingFailure
from pytest_pafot.campaign.setup_fault import unit_doubt
from pytest_pafot.campaign.state import State, lose
from pytest_pafot.campaign.store import Store
from pytest_pafot.campaign.tallies import Tally
from pytest_pafot.campaign.watch import Watch
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.scenario_pool import expectation
from pytest_pafot.findings.finding import failed_as
from pytest_pafot.findings.verdict import Verdict
from pytest_pafot.oracle.run import Run
from pytest_pafot.searching.evaluation import Evaluation, Event
from pytest_pafot.support.errors import OutOfTime
from pytest_pafot.world.guard.hang_guard import runs_end_in


def search(
    scenarios: Bred | Numbers, state: State, bench: Bench, store: Store, watch: Watch
) -> Generator[SearchEvent, None, None]:
    """Draw scenarios, drive and judge them, let the algorithm learn, and save each new failure; yield what happens.

    Raises:
        SetupFaultError: if all runs at the beginning end in the same exception.
        RequestError: for a world, factory, test function or scenario that does not fit.
    """
    began, reason = state.clock(), None
    first = state.first_generation
    yield from _counted([scenarios.started], state, watch)
    while not scenarios.is_over:
        # Limits count after the first scenario, so that a search tests something.
        reason = watch.reached(scenarios) if state.runs else None
        if reason is not None:
            break
        state.generation = scenarios.generation
        state.number = state.generation if isinstance(scenarios, Numbers) else state.runs
        # Drive the next scenario and judge it. Other processes may have done so, for several scenarios at once. Until
        # two runs differ, this process must see each failure, since it may be a fault of the set-up.
        happened: Sequence[Event] = ()
        try:
            with runs_end_in(watch.seconds_left()):
                done = scenarios.next(state.fatal, None if first.is_alike else (state.shown, state.finds))
                if isinstance(done, Run):
                    happened = scenarios.take((yield from _judge_and_count(done, state, bench, store, watch)))
        except OutOfTime:
            reason = "time"
            break
        match done:
            case Run():
                pass
            case Evaluation():
                happened = scenarios.take(done, reused=True)
            case Tally():
                yield from done.judged or ()
                bench.counted_decisions += done.decisions
                state.take_tally(done)
                evaluated, *happened = scenarios.take_tally(done)
                yield evaluated  # which the state has counted
                yield from watch.after_event()
            case PendingFailure():
                store.add_pending(done, {*state.shown, *state.finds})
                continue
            case ProcessLostError() | None:  # It died or hung now, or in the same scenario before.
                first.is_alike = False
                yield from _released(state, store)
                expect = None
                if done is not None:
                    kind = yield from lose(done, state, bench, store, 1)
                    state.counts.add(kind, "lost")
                    expect = expectation(done) if kind == "failed" else None
                happened = scenarios.take(unknown(scenarios.scenario(), expect), reused=done is None)
            case _:
                happened = done
        yield from _released(state, store)
        yield from _counted(happened, state, watch)
        if isinstance(scenarios, Numbers) and scenarios.number >= FIRST and first.is_alike:
            first.end(" at the beginning")
    if isinstance(scenarios, Numbers) and first.is_alike and reason == "runs":
        first.end("")
    yield from _counted(scenarios.finished(reason or "generations", state.clock() - began), state, watch)


def _counted(happened: Iterable[Event], state: State, watch: Watch) -> Iterator[SearchEvent]:
    """Yield events of the plan, and count what they say."""
    for event in happened:
        yield event
        state.see(event)
        yield from watch.after_event()


def _judge_and_count(
    run: Run, state: State, bench: Bench, store: Store, watch: Watch
) -> Generator[SearchEvent, None, Evaluation]:
    """Judge and count a run, and save a new failure before the next run; return what the algorithm sees of it."""
    __tracebackhide__ = True
    verdict = bench.finish(run)
    judged = Judged.here(run, verdict)
    yield judged
    state.see(judged)
    doubt = unit_doubt(run.trace) if run.facts is None else run.facts.doubt
    state.take(run, verdict, caught_in(verdict), doubt)
    yield from _released(state, store)
    signature = None
    if verdict.failed and verdict.failure is not None:
        signature, manner = failed_as(run, verdict.failure)
        state.see_manner(signature, manner, run.scenario.id)
        if state.knows(signature):
            state.repeat(signature)
        else:
            found = yield from save_and_confirm(run, verdict, state.generation, bench, store, watch)
            state.add(signature, found)
        state.see_severity(signature, verdict.severity, state.number)
    return bench.evaluation(run, verdict, signature)


def save_and_confirm(
    run: Run, verdict: Verdict, generation: int, bench: Bench, store: Store, watch: Watch
) -> Generator[SearchEvent, None, str]:
    """Save a new failure, run its scenario again to confirm it, and report it or hold it back; return its id."""
    sighting = store.add(run, verdict, generation)
    if isinstance(sighting, str):
        return sighting
    # It is saved before it is confirmed, so that nothing is lost if the session dies in the second run.
    if not verdict.is_timed:
        yield from watch.before_rerun(sighting.id)
        try:
            if differs := bench.confirm(run):
                sighting = store.call_flaky(sighting, differs)
        except OutOfTime:
            sighting = store.call_unconfirmed(sighting)
    if not store.is_holding:
        yield from store.publish(sighting)
    return sighting.id


def _released(state: State, store: Store) -> Iterator[SearchEvent]:
    """Report the findings that were held back, as soon as two runs differ, which is no fault of the set-up."""
    if store.is_holding and not state.first_generation.is_alike:
        yield from store.release()
