"""The share of a search's first random scenarios that fail by the ego's fault."""

import pytest

import pytest_pafot as pafot
from example_ads import constant_speed
from pytest_pafot.campaign.events import Judged
from pytest_pafot.campaign.judging import evaluated
from pytest_pafot.campaign.state import RandomRuns
from pytest_pafot.campaign.tallies import Digested, Tally
from pytest_pafot.findings.signature import Failure
from pytest_pafot.findings.verdict import Verdict
from pytest_pafot.model.trace import Outcome
from pytest_pafot.report.terminal import search_lines
from pytest_pafot.searching.evaluation import Evaluated
from tests.helpers.traces import blamed_on, trace_of, vehicle


def no_collision(run):
    assert not run.collision


def explored(**arguments):
    return pafot.explore(
        constant_speed.make, holds=no_collision, seed=0, shrink_rollouts=0, gene_seconds=5.0, genes=2, **arguments
    )


def test_random_search_counts_all_valid_scenarios():
    judged = []
    found = explored(
        runs=40, algorithm="random", on_event=lambda event: judged.append(event) if isinstance(event, Judged) else None
    )
    last = {each.run.trace.scenario.id: each for each in judged}.values()
    valid = [each for each in last if each.verdict.kind != "invalid"]
    at_fault = [each for each in valid if each.run.responsibility in ("ego", "both")]
    assert (found.summary.random["at_fault"], found.summary.random["runs"]) == (len(at_fault), len(valid))
    assert 0 < len(at_fault) < len(valid)
    told = " ".join(search_lines(found.summary))
    by_npcs = sum(each.run.responsibility == "npc" for each in valid)
    assert by_npcs == found.summary.random["otherwise"] > 0
    assert f" %); {by_npcs} failed in other ways" in told
    assert f"random scenarios: {len(at_fault)} of {len(valid)} failed by the ego's fault, " in told


def is_smooth(run):
    pafot.check(abs(run.ego.jerk), name="jerk", at_most=-1.0)


def is_short(run):
    pafot.check(len(run.npcs), name="npcs", at_most=1)
    assert not run.collision


@pytest.mark.parametrize("holds", [is_smooth, is_short])
def test_failed_check_without_collision_is_no_ego_fault(holds):
    judged = []
    found = pafot.explore(
        constant_speed.make, holds=holds, seed=5, shrink_rollouts=0, gene_seconds=5.0, genes=2, blame="any", runs=20,
        algorithm="random", on_event=lambda event: judged.append(event) if isinstance(event, Judged) else None,
    )  # fmt: skip
    runs = {each.run.trace.scenario.id: each.run for each in judged if each.verdict.failed}.values()
    collided = sum(run.collision is not None and run.responsibility != "npc" for run in runs)
    assert found.summary.random["at_fault"] == collided
    assert found.summary.random["otherwise"] == found.summary.random["checks"] == len(runs) - collided > 0
    told = " ".join(search_lines(found.summary))
    assert " failed by the ego's fault, " in told
    assert told.count(f"; {len(runs) - collided} more failed a check") == 1


def test_early_stopped_search_gives_no_random_share():
    summary = explored(runs=40, stop_after=1).summary
    assert (summary.random["at_fault"], summary.random["runs"], summary.random["otherwise"]) == (0, 0, 0)


def test_search_of_an_algorithm_that_breeds_gives_no_random_share():
    assert explored(runs=24, algorithm="pafot").summary.random["runs"] == 0


@pytest.mark.parametrize("kind", ["failed", "unpreventable", "passed", "rejected"])
@pytest.mark.parametrize("responsible", ["ego", "npc"])
@pytest.mark.parametrize("failure", ["AssertionError", "CheckFailed"])
def test_session_and_processes_count_the_same_runs_as_failures_of_the_ego(kind, responsible, failure):
    crash = trace_of(vehicle(0, ticks=9), vehicle(0, ticks=9), outcome=Outcome.COLLISION)
    run, verdict = blamed_on(responsible, crash), Verdict(kind=kind, failure=Failure(kind=failure))
    judged, evaluation = Judged.here(run, verdict), evaluated(run, verdict, None, lambda run: 0.0)
    here, elsewhere = RandomRuns(), RandomRuns()
    here.most = elsewhere.most = 1
    here.see(judged)
    here.see(Evaluated(generation=0, local_generation=0, index=0, evaluation=evaluation, reused=False))
    digested = Digested(
        evaluation=evaluation, event=judged, facts=None, signature=None, manner=None, decisions=0, caught=(), doubt=""
    )
    elsewhere.take(*Tally.of([digested], first=0).random)
    counts = [(each.evaluated, each.runs, each.at_fault, each.otherwise, each.checks) for each in (here, elsewhere)]
    assert counts[0] == counts[1]
    is_failure = kind in ("failed", "unpreventable")
    assert here.checks == (is_failure and responsible == "npc" and failure == "CheckFailed")
