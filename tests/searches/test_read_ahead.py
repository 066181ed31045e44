"""Processes that make runs also read ahead from them, and the results stay the same."""

import sys

import pytest

import pytest_pafot as pafot
from pytest_pafot.algorithms.evaluation import Evaluated
from pytest_pafot.execution import runner as execution_runner


def brakes_late(observation):
    """Keep the lane, and brake for a vehicle ahead in it within a second."""
    ego = observation.ego
    gaps = [
        each.x - ego.x for each in observation.others if each.lane == ego.lane and each.x > ego.x
    ]
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
            lambda: brakes_late,
            holds=avoids_collisions,
            runs=8,
            workers=workers,
            shrink_runs=0,
            **settings,
        )
        return [each for each in found.events if isinstance(each, Evaluated)], [
            each.id for each in found.findings
        ]

    (here, found), elsewhere = learnt(1), learnt(2)
    assert any(each.evaluation.failing for each in here)
    assert not all(each.evaluation.failing for each in here)
    assert (here, found) == elsewhere
