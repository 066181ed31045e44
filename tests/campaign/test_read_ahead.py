"""Processes that make runs also read ahead from them, and the results stay the same."""

import pickle
import sys

import pytest

import pytest_pafot as pafot
from pytest_pafot import Cell, Highway, PositionInstruction, Scenario
from pytest_pafot.campaign.judging import evaluated
from pytest_pafot.campaign.tallies import Reader
from pytest_pafot.execution import runner as execution_runner
from pytest_pafot.findings.verdict import Verdict
from pytest_pafot.oracle import run as oracle_run
from pytest_pafot.oracle.run import Run
from pytest_pafot.searching import evaluation
from pytest_pafot.searching.evaluation import Evaluated
from pytest_pafot.searching.fitness import Steered, resolve


def brakes_late(observation):
    """Keep the lane, and brake for a vehicle ahead in it within a second."""
    ego = observation.ego
    gaps = [each.x - ego.x for each in observation.others if each.lane == ego.lane and each.x > ego.x]
    return (-6.0 if min(gaps, default=100.0) < ego.speed else 1.0 if ego.speed < 22.0 else 0.0), 0.0


def avoids_collisions(run):
    assert not run.collision


@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")
@pytest.mark.parametrize("settings", [
    pytest.param({"blame": "any"}, marks=pytest.mark.processes),
    pytest.param({"blame": "ego"}, marks=pytest.mark.processes),
    {"fitness": "npcs.ttc", "blame": "ego"},
])  # fmt: skip
def test_search_learns_the_same_wherever_runs_are_read(monkeypatch, settings):
    monkeypatch.setattr(execution_runner, "DEAR", 0.0)

    def learnt(workers):
        found = pafot.explore(
            lambda: brakes_late, holds=avoids_collisions, runs=8, workers=workers, shrink_rollouts=0, **settings
        )
        return [each for each in found.events if isinstance(each, Evaluated)], [each.id for each in found.findings]

    (here, found), elsewhere = learnt(1), learnt(2)
    assert any(each.evaluation.failing for each in here)
    assert not all(each.evaluation.failing for each in here)
    assert (here, found) == elsewhere


@pytest.mark.parametrize("is_own", [False, True], ids=["built-in fitness", "own fitness"])
def test_what_a_process_reads_of_a_run_is_not_computed_again(monkeypatch, is_own):
    chains = [[PositionInstruction(Cell.FRONT, 12.0)], [PositionInstruction(Cell.REAR, 26.0)]]
    trace = Highway().rollout(Scenario.repaired(chains, gene_seconds=10.0), lambda: brakes_late)
    fitness, passed = Steered(resolve("default")), Verdict(kind="passed")
    expected = evaluated(Run(trace), passed, None, fitness)
    read = Reader(harness=None, fitness=None if is_own else fitness, has_table=False)
    sent = pickle.loads(pickle.dumps(read(trace)))
    monkeypatch.setattr(evaluation, "has_interaction", lambda trace: pytest.fail("read again"))
    monkeypatch.setattr(oracle_run, "attributed", lambda trace: pytest.fail("read again"))
    computed = []
    own = lambda run: computed.append(run) or fitness(run)  # noqa: E731
    run = Run(sent.trace, facts=sent)
    assert evaluated(run, passed, None, own) == expected
    assert len(computed) == is_own
    assert run.attribution == sent.attribution
