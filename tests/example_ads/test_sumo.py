"""The adapter of SUMO's drivers translates lanes, places and speeds; the models are SUMO's own."""

from functools import partial

import pytest

from pytest_pafot import Highway, Observation, Outcome, PositionInstruction, Scenario
from pytest_pafot.world import VehicleState

pytest.importorskip("libsumo", reason='needs pip install "pytest-pafot[sumo]"')

from example_ads import sumo

HIGHWAY = Highway(duration=20.0)


def vehicle(*, x=100.0, lane=1, speed=15.0):
    return VehicleState(x=x, y=lane * 4.0, heading=0.0, speed=speed, lane=lane, length=5.0, width=2.0)


@pytest.fixture
def decide():
    """Return a function that gives the decision of a driver that sees others for the first time."""
    made = []

    def ask(*others, models=("IDM", "LC2013")):
        made.append(sumo.make(*models))
        return made[-1](Observation(0.0, vehicle(), others, 4, 4.0, 26.8, road_length=3000.0))

    yield ask
    for driver in made:
        driver.close()


def test_sumo_without_leader_accelerates_like_driver_model(decide):
    drive = decide(vehicle(x=20.0))
    assert drive.lane == 1
    assert drive.acceleration == pytest.approx(2.6 * (1 - (15 / 26.8) ** 4), rel=0.03)  # 2.6 m/s^2 is SUMO's default


def test_sumo_brakes_behind_a_near_leader(decide):
    assert decide(vehicle(x=112.0, speed=8.0), vehicle(x=112.0, lane=0), vehicle(x=112.0, lane=2)).acceleration < -3


def test_sumo_ignores_vehicles_of_other_lanes(decide):
    assert decide(vehicle(x=112.0, lane=3, speed=0.0)).acceleration > 2


def test_sumo_passes_on_the_left():
    ahead = Scenario(npcs=[[PositionInstruction(2, 16.0)]], gene_seconds=20.0)
    trace = HIGHWAY.rollout(ahead, sumo.make)
    assert trace.outcome is Outcome.SAFE
    assert 0 in {action.lane for action in trace.actions}
    assert abs(trace.ego[:, 1]).min() < 0.5, "the centre of lane 0"


@pytest.mark.parametrize("models", [("EIDM", "SL2015"), ("ACC", "LC2013"), ("Wiedemann", "LC2013")])
def test_any_sumo_model_drives_the_same_scenario_identically(models):
    brakes = Scenario(npcs=[[PositionInstruction(2, 5.0)], [PositionInstruction(4, 20.0)]], gene_seconds=20.0)
    first, second = (HIGHWAY.rollout(brakes, partial(sumo.make, *models)) for _ in range(2))
    assert first.outcome is Outcome.SAFE, first.error
    assert first.actions == second.actions
    assert first.actions[0].acceleration > 0, "whoever is ahead is two seconds ahead, and as fast"
