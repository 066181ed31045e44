"""Processes that make runs also read ahead from them, and the results stay the same."""

import pickle
import sys

import pytest

import pytest_pafot as pafot
from pytest_pafot import Cell, Highway, PositionInstruction, Scenario
from pytest_pafot.campaign.tallies import read_ahead
from pytest_pafot.campaign.verdict import FITNESS
from pytest_pafot.execution import runner as execution_runner
from pytest_pafot.searching.evaluation import Evaluation
from pytest_pafot.searching.events import Evaluated
from pytest_pafot.searching.fitness import resolve


def brakes_late(observation):
    """Keep the lane, and brake for a vehicle ahead in it within a second."""
    ego = observation.ego
    gaps = [each.x - ego.x for each in observation.others if each.lane == ego.lane and each.x > ego.x]
    return (-6.0 if min(gaps, default=100.0) < ego.speed else 1.0 if ego.speed < 22.0 else 0.0), 0.0


def avoids_collisions(run):
    assert not run.collision


@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")
@pytest.mark.parametrize(
    "settings",
    [
        pytest.param({"blame": "any"}, marks=pytest.mark.processes),
        pytest.param({"blame": "ego"}, marks=pytest.mark.processes),
        {"fitness": "npcs.ttc", "blame": "ego"},
    ],
)
def test_search_learns_the_same_wherever_runs_are_read(monkeypatch, settings):
    monkeypatch.setattr(execution_runner, "DEAR", 0.0)

    def learnt(workers):
        found = pafot.explore(
            lambda: brakes_late,
            holds=avoids_collisions,
            runs=8,
            workers=workers,
            shrink_rollouts=0,
            neighbours=0,
            **settings,
        )
        return [each for each in found.events if isinstance(each, Evaluated)], [each.id for each in found.findings]

    (here, found), elsewhere = learnt(1), learnt(2)
    assert any(each.evaluation.failing for each in here)
    assert not all(each.evaluation.failing for each in here)
    assert (here, found) == elsewhere


def test_evaluation_computed_in_worker_is_not_computed_again(monkeypatch):
    chains = [[PositionInstruction(Cell.FRONT, 12.0)], [PositionInstruction(Cell.REAR, 26.0)]]
    trace = Highway().rollout(Scenario.repaired(chains, gene_seconds=10.0), lambda: brakes_late)
    fitness = resolve("default")
    expected = Evaluation.of(trace, fitness=fitness(trace), failing=False)
    read_ahead(fitness, trace)
    sent = pickle.loads(pickle.dumps(trace))
    again = sent.reading(FITNESS, lambda trace: pytest.fail("read again"))
    assert Evaluation.of(sent, fitness=again, failing=False) == expected
