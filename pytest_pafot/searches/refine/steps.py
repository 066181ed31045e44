"""The work on a search's findings after its last run.

Each finding has already been saved and reported. Each step updates the file and the report.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import assert_never

from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.findings.finding import Expect, ending
from pytest_pafot.findings.shrink import OutOfBudget, Shrunk, described
from pytest_pafot.findings.sighting import ENDED_OTHERWISE, Finished, Seen
from pytest_pafot.findings.verdict import Verdict
from pytest_pafot.oracle.run import Run
from pytest_pafot.searches.bench import Bench, Differs, NoTime, Same
from pytest_pafot.searches.events import Note, Phase, Refining
from pytest_pafot.searches.harness import headline
from pytest_pafot.searches.refine.moment import with_conditions, with_moment
from pytest_pafot.searches.refine.simplest import (
    Simplest,
    Turn,
    failure_rate,
    shows,
    simplest_of,
)
from pytest_pafot.searches.results import State
from pytest_pafot.searches.store import Store, record_death
from pytest_pafot.support.errors import DriverError, OutOfTime
from pytest_pafot.support.text import one_line
from pytest_pafot.world.guard.hang_guard import is_interruption, runs_end_in

# The number of decisions that work on findings can always request, even after a short search.
LEAST_DECISIONS = 2000

# The fraction of these decisions that shrinking can use. The rest are for the examination of findings.
FOR_SHRINKING = 0.75

# The steps that examine the simplest scenario of a finding, by their subject. If a step runs out of time or raises an
# error, the others are skipped for this finding.
EXAMINATIONS = {"decisions": with_moment, "conditions": with_conditions}


def refine(state: State, bench: Bench, store: Store, *, until: float = math.inf) -> Refining[None]:
    """Shrink, confirm and examine the findings in the order of discovery, before the time ``until`` [s]."""
    __tracebackhide__ = True
    before = bench.decisions
    budget = bench.budget
    budget.end = until
    budget.asked = 0
    # Unless the user sets a limit, this work can request as many decisions as the search did.
    budget.most = math.inf
    if not bench.harness.request.settings.shrink_runs:
        budget.most = max(state.counts.decisions, LEAST_DECISIONS)
    with bench.runner:
        # Shrink and confirm each finding, and try a careful driver. Skip findings that cannot be shrunk: crashes, those
        # that depend on wall-clock time, and flaky ones that are not random.
        try:
            refined = yield from _in_turns(state, bench, store)
        finally:
            state.shrink_decisions = bench.decisions - before
        # Examine the decisions that led to findings with repeatable runs.
        try:
            for sighting in list(store.findings.values()):
                if sighting.is_firm and (sighting.id in refined or budget.is_at_limit):
                    yield from _examined(sighting, state, bench, store)
        finally:
            state.moment_decisions = bench.decisions - before - state.shrink_decisions


def _in_turns(state: State, bench: Bench, store: Store) -> Refining[set[str]]:
    # A turn has an equal part of the remaining time and decisions. What it does not use goes to the next findings.
    done = set[str]()
    budget = bench.budget
    was_at_limit = budget.is_at_limit
    waiting = [id_ for id_, each in store.findings.items() if each.is_firm or each.is_random]
    for sharing, id_ in zip(range(len(waiting), 0, -1), waiting, strict=True):
        # The flag says of each turn whether the limit ended it, and at the end whether it ended any turn.
        budget.is_at_limit = False
        now = bench.clock()
        left = budget.end - now
        most = FOR_SHRINKING * budget.most - budget.asked
        is_done = False
        try:
            with runs_end_in(max(left, 0.0)):
                turn = Turn(end=now + left / sharing, most=budget.asked + most / sharing)
                is_done = yield from _simplified(store.findings[id_], state, bench, store, turn)
        except (OutOfTime, OutOfBudget):  # The finding stays as it is, or as far as it was shrunk.
            pass
        except ProcessLostError as error:
            store.call_flaky(store.findings[id_], f"the process that ran it again {error.end}")
            yield from record_death(bench.died(error), state, store)
            is_done = True
        if is_done:
            done.add(id_)
        else:
            sighting = store.findings[id_]
            how_far = "not" if sighting.finding.shrunk is None else "only partly"
            why = "the limit was reached" if budget.is_at_limit else "the time ran out"
            cut = f"it was {how_far} simplified, because {why}"
            yield from store.publish(replace(sighting, unshrunk=sighting.unshrunk or cut))
        was_at_limit = was_at_limit or budget.is_at_limit
    budget.is_at_limit = was_at_limit
    return done


@dataclass(frozen=True, slots=True, kw_only=True)
class Confirmed:
    """The simplest scenario of a finding, whose second run did not differ, with its run and verdict."""

    simplest: Simplest
    run: Run
    verdict: Verdict


def _simplified(
    sighting: Seen, state: State, bench: Bench, store: Store, turn: Turn
) -> Refining[bool]:
    # Return True if nothing is left to do.
    __tracebackhide__ = True
    original = sighting.finding.scenario
    # Measure how often the scenario fails if the policy draws random numbers. Another thread of this process may have
    # drawn them in one run, but probably not in two.
    is_new = sighting.is_random and sighting.finding.rate is None
    if is_new and (sighting.is_flaky or bench.rerun(original).trace.drew):
        rate = yield from failure_rate(sighting, original, state, bench)
        sighting = replace(sighting, finding=replace(sighting.finding, rate=rate))
        sighting = store.rewritten(sighting)
        yield from store.publish(sighting)
    if sighting.is_flaky:
        return True
    # Find the simplest scenario that fails in the same way, and run it again.
    simplest = yield from simplest_of(sighting, original, state, bench, store, turn)
    # Even if shrinking reached its limit, a careful driver is tried with the decisions that are left.
    may_go_on = bench.budget.is_at_limit and bench.budget.asked < bench.budget.most
    if simplest.is_cut and simplest.scenario == original and not may_go_on:
        return False
    outcome = yield from _confirmed(sighting, simplest, state, bench)
    if isinstance(outcome, Differs) and simplest.scenario != original:
        # The simplified scenario is not repeatable, so return to the original scenario, which may be flaky, too.
        shrunk = Shrunk(rollouts=simplest.shrunk.rollouts, is_minimal=False)
        simplest = replace(simplest, scenario=original, shrunk=shrunk, is_cut=False)
        outcome = yield from _confirmed(sighting, simplest, state, bench)
    match outcome:
        case Differs(why=why):
            sighting = store.call_flaky(sighting, why)
            yield from store.publish(sighting)
            if sighting.is_random:  # its first runs were the same by chance
                return (yield from _simplified(sighting, state, bench, store, turn))
            return True
        case Confirmed():
            # Replace the scenario in the file by the simplest one, and add what a careful driver would have done.
            refined = yield from _with_takeover(sighting, outcome, bench)
            if refined is not sighting:
                yield from store.publish(store.rewritten(refined))
            return not simplest.is_cut
        case _:
            assert_never(outcome)


def _confirmed(
    sighting: Seen, simplest: Simplest, state: State, bench: Bench
) -> Refining[Confirmed | Differs]:
    # Run the simplest scenario again, and measure how often it fails if its failures are random.
    __tracebackhide__ = True
    scenario = simplest.scenario
    rate = sighting.finding.rate
    is_original = scenario == sighting.finding.scenario
    run = bench.run(scenario)
    verdict = bench.finish(run)
    if not shows(sighting, run, verdict, state, bench):
        if verdict.kind == "common":
            return Differs(why="the reference failed when it ran again")
        return Differs(why=f"{ENDED_OTHERWISE}: {ending(run)}")
    # The search has already confirmed the original scenario, unless it had no time for that.
    if not is_original or sighting.unshrunk:
        confirmation = bench.repeat(scenario, run.trace)
        match confirmation:
            case Same():
                pass
            case Differs():
                return confirmation
            case NoTime():
                raise OutOfTime
            case _:
                assert_never(confirmation)
    if rate is not None and not is_original:
        rate = yield from failure_rate(sighting, scenario, state, bench)
    return Confirmed(simplest=replace(simplest, rate=rate), run=run, verdict=verdict)


def _examined(sighting: Seen, state: State, bench: Bench, store: Store) -> Refining[None]:
    # An error here must not end the search, because a user's simulator may only support scenarios of a search.
    __tracebackhide__ = True
    budget = bench.budget
    for about, step in EXAMINATIONS.items():
        try:
            budget.check()
            with runs_end_in(budget.end - bench.clock()):
                sighting = yield from step(sighting, state, bench)
                yield from store.publish(sighting)
        except OutOfBudget:  # the summary reports it
            return
        except OutOfTime:
            yield Note(
                f"the {about} of saved-{sighting.id} were not examined, because the time ran out"
            )
            return
        except Exception as error:
            if is_interruption(error):
                raise
            why = one_line(f"{type(error).__name__}: {error}")
            yield Note(f"the {about} of saved-{sighting.id} were not examined: {why}")
            return


def _with_takeover(sighting: Seen, confirmed: Confirmed, bench: Bench) -> Refining[Seen]:
    # Add what a careful driver could have avoided by taking over in the confirmed scenario.
    run = confirmed.run
    verdict = confirmed.verdict
    scenario = confirmed.simplest.scenario
    shrunk = confirmed.simplest.shrunk
    if verdict.failure is None or verdict.exception is None:
        return sighting
    before = replace(sighting.finding, rate=confirmed.simplest.rate)
    if scenario != before.scenario:
        shrunk = replace(shrunk, before=described(before.scenario, before.longest_run))
    yield Phase(f"replaying saved-{sighting.id} with a careful driver", sighting.id)
    takeover = None
    try:
        # The driver avoids collisions, so it is not tried for failed checks or for failures that nothing measures.
        if verdict.failure.check is None and verdict.severity is not None:
            takeover = run.takeover
    except DriverError as error:  # the world cannot simulate the driver
        yield Note(f"{error}. Findings do not state what this driver would have done")
    # The file now describes the simplest scenario. Only its id and its origin are those of the first run.
    finding = replace(
        before,
        scenario=scenario,
        expect=Expect.from_run(
            run,
            verdict.failure,
            takeover=takeover,
            against=before.expect.against,
            root=str(bench.harness.root),
        ),
        shrunk=shrunk if shrunk.rollouts else None,
    )
    # If nothing has changed, the caller does not write the file again.
    if finding == before and not sighting.unshrunk:
        return sighting
    ended = Finished(run=run, verdict=verdict)
    sighting = sighting.with_observed(ended=ended, severity=verdict.severity)
    line = finding.with_sight(headline(run, verdict))
    return replace(sighting, finding=finding, headline=line, unshrunk="")
