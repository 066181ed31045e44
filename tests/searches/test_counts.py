"""How runs are counted, and the share of random scenarios that fail by the ego's fault."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

import pytest_pafot as pafot
from example_ads import constant_speed
from pytest_pafot.algorithms.evaluation import Evaluation
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.runner import expectation
from pytest_pafot.findings.finding import signature_of_failure
from pytest_pafot.findings.verdict import Failure, Verdict
from pytest_pafot.model.trace import Outcome
from pytest_pafot.oracle.run import Run
from pytest_pafot.report.terminal import search_lines
from pytest_pafot.searches.results import Counts, Examiner, Result, not_run
from pytest_pafot.searches.store import EarlyFailure, OnlyCounted, Store
from tests.helpers.traces import blamed_on, trace_of, vehicle

KINDS = ("passed", "failed", "npc", "common", "rejected", "skipped", "invalid", "lost")


def no_collision(run):
    assert not run.collision


def explored(genes=2, **arguments):
    return pafot.explore(
        constant_speed.make,
        holds=no_collision,
        seed=0,
        shrink_runs=0,
        gene_seconds=5.0,
        genes=genes,
        **arguments,
    )


def test_random_search_counts_all_valid_scenarios():
    found = explored(runs=40, genes=4, npcs=5)
    valid = [row for row in found.runs if row["verdict"] != "invalid"]
    at_fault = [row for row in valid if row["responsibility"] in ("ego", "both")]
    assert (found.summary.random["at_fault"], found.summary.random["runs"]) == (
        len(at_fault),
        len(valid),
    )
    assert 0 < len(at_fault) < len(valid)
    told = " ".join(search_lines(found.summary))
    by_npcs = sum(row["responsibility"] == "npc" for row in valid)
    assert by_npcs == found.summary.random["otherwise"] > 0
    assert f" {len(at_fault) + by_npcs} of {len(valid)} random scenarios failed: " in told


def is_smooth(run):
    pafot.check(abs(run.ego.jerk), name="jerk", at_most=-1.0)


def is_short(run):
    pafot.check(len(run.npcs), name="npcs", at_most=1)
    assert not run.collision


@pytest.mark.parametrize("holds", [is_smooth, is_short])
def test_failed_check_without_collision_is_no_ego_fault(holds):
    found = pafot.explore(
        constant_speed.make,
        holds=holds,
        seed=5,
        shrink_runs=0,
        gene_seconds=5.0,
        genes=2,
        blame="any",
        runs=20,
    )
    runs = [row for row in found.runs if row["failing"]]
    collided = sum(row["outcome"] == "collision" and row["responsibility"] != "npc" for row in runs)
    assert found.summary.random["at_fault"] == collided
    assert (
        found.summary.random["otherwise"]
        == found.summary.random["checks"]
        == len(runs) - collided
        > 0
    )
    told = " ".join(search_lines(found.summary))
    assert (
        told.count(f" {len(runs)} of {found.summary.random['runs']} random scenarios failed: ") == 1
    )


def test_failures_before_their_turn_are_in_no_share(monkeypatch):
    """The runs beside them that passed are not counted, so the share would be too high."""
    evaluation = replace(not_run(trace_of(vehicle(0)).scenario), discarded=False)
    early = Result(evaluation=evaluation, kind="failed", ended="collision", fails="ego")
    monkeypatch.setattr(Store, "add", lambda *given: OnlyCounted("its id"))
    failures = {"its signature": EarlyFailure(result=early, number=7)}
    (settled,) = Store(harness=None, seed=1, early=failures).settle(keeps=True)
    assert (settled.counts.kinds["failed"], settled.counts.fails.total()) == (1, 0)


def test_early_stopped_search_gives_no_random_share():
    summary = explored(runs=40, stop_after=1).summary
    assert (summary.random["at_fault"], summary.random["runs"], summary.random["otherwise"]) == (
        0,
        0,
        0,
    )


def test_search_of_an_algorithm_that_breeds_gives_no_random_share():
    assert explored(runs=24, algorithm="pafot").summary.random["runs"] == 0


@pytest.mark.parametrize("kind", ["failed", "common", "passed", "rejected"])
@pytest.mark.parametrize("responsible", ["ego", "npc"])
@pytest.mark.parametrize("failure", ["AssertionError", "CheckFailed"])
def test_runs_are_counted_by_how_they_failed(kind, responsible, failure):
    crash = trace_of(vehicle(0, ticks=9), vehicle(0, ticks=9), outcome=Outcome.COLLISION)
    verdict = Verdict(kind=kind, failure=Failure(kind=failure))
    harness = SimpleNamespace(run_of=partial(blamed_on, responsible), judge=lambda run: verdict)
    known = {signature_of_failure(blamed_on(responsible, crash), verdict.failure)}
    counts = Counts.from_result(
        Examiner(harness=harness, fitness=lambda run: 0.0, seed=1)(crash, known)
    )
    is_failure = kind in ("failed", "common")
    how = "ego" if responsible == "ego" else "check" if failure == "CheckFailed" else "otherwise"
    assert counts.fails == ({} if kind == "rejected" else {how if is_failure else "": 1})
    assert (counts.kinds, counts.outcomes, counts.responsibilities) == (
        {kind: 1},
        {"collision": 1},
        {responsible: 1},
    )


@given(st.lists(st.sampled_from(KINDS)), st.integers(0, 9))
def test_counts_of_parts_add_up_to_those_of_the_whole(kinds, cut):
    """Whoever counts which runs, in an order: each sum is the number of runs."""
    crash = trace_of(vehicle(0, ticks=9), vehicle(0, ticks=9), outcome=Outcome.COLLISION)

    def counted(results):
        counts = Counts()
        for number, each in results:
            counts += Counts.from_result(each, number)
        return counts

    def result_of(kind):
        if kind == "lost":
            death = ProcessLostError(crash.scenario, pid=7, how="died")
            signature = expectation(death).signature
            evaluation = replace(not_run(crash.scenario), failing=True, kind=signature)
            return Result(evaluation=evaluation, kind="failed", ended="lost")
        signature = (
            signature_of_failure(Run(crash), Failure(kind="AssertionError"))
            if kind == "failed"
            else None
        )
        evaluation = Evaluation.from_trace(
            crash, fitness=0.0, failing=kind == "failed", kind=signature
        )
        return Result(
            evaluation=evaluation, kind=kind, ended="collision", responsible="npc", decisions=3
        )

    numbered = [*enumerate(map(result_of, kinds), 1)]
    whole, parts = counted(numbered), counted(numbered[:cut])
    parts += counted(numbered[cut:])
    assert parts == whole
    sums = {each.total() for each in (whole.kinds, whole.outcomes, whole.responsibilities)}
    assert sums == {len(kinds)} == {whole.runs} == {whole.health.simulated}
    assert sum(each.runs for each in whole.failures.values()) == kinds.count(
        "failed"
    ) + kinds.count("lost")
