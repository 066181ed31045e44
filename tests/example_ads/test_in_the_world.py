"""The example policies drive in the worlds for which they are made, each with its own flaw and no other."""

import importlib.util
from dataclasses import replace
from functools import cache

import pytest

from example_ads import blind_lane_change, constant_speed, idm_mobil, ppo
from pytest_pafot import Cell, Highway, PositionInstruction, Scenario, World
from pytest_pafot.model.trace import Outcome
from tests.helpers.stages import oracle

HIGHWAY = Highway(duration=20.0)
LEARNED_ON = World("highway-v0", duration=20.0)

DRIVERS = [
    pytest.param(HIGHWAY, constant_speed.make, id="constant-speed"),
    pytest.param(HIGHWAY, blind_lane_change.make, id="blind-lane-change"),
    pytest.param(HIGHWAY, idm_mobil.make, id="idm-mobil"),
    pytest.param(LEARNED_ON, ppo.make, id="ppo"),
]
if importlib.util.find_spec("fiss_planner"):
    from example_ads import fiss

    DRIVERS.append(pytest.param(HIGHWAY, fiss.make, id="fiss"))


def slow_ones_by_oracle(drivers):
    """Return the drivers, with FISS+ only for ``-m oracle``: it takes longer than all others together."""
    return [oracle(*each.values, id=each.id) if each.id == "fiss" else each for each in drivers]


def one_npc(*genes):
    chain = tuple(PositionInstruction(cell, speed) for cell, speed in genes)
    return Scenario(npcs=(chain,), gene_seconds=10.0)


FASTER_ON_THE_LEFT = one_npc((Cell.FRONT_LEFT, 26.0), (Cell.FRONT_LEFT, 26.0))
BRAKES_AHEAD = one_npc((Cell.FRONT, 10.0), (Cell.FRONT, 10.0))
STAYS_AT_THE_RIGHT = one_npc((Cell.RIGHT, 25.0), (Cell.RIGHT, 25.0))


@cache
def first_run(world, make, scenario):
    """Run a scenario once for all tests that use it; a planning ADS takes some hundred milliseconds for each."""
    return world.rollout(scenario, make)


@pytest.mark.parametrize(("world", "make"), slow_ones_by_oracle(DRIVERS))
def test_faster_vehicle_in_next_lane_is_harmless(world, make):
    trace = first_run(world, make, FASTER_ON_THE_LEFT)
    assert trace.outcome is Outcome.COMPLETED, trace.error
    assert trace.duration == 20.0


@pytest.mark.parametrize(("world", "make"), slow_ones_by_oracle(DRIVERS))
def test_the_same_scenario_gives_the_same_trace(world, make):
    again = replace(world, duration=5.0).rollout(BRAKES_AHEAD, make)
    assert again.ticks > 60
    assert (first_run(world, make, BRAKES_AHEAD).states[: again.ticks + 1] == again.states).all()


def test_constant_speed_runs_into_whoever_brakes_ahead():
    collision = first_run(HIGHWAY, constant_speed.make, BRAKES_AHEAD).collision
    assert (collision.side, collision.cell) == ("front", Cell.FRONT)
    assert collision.ego_speed == pytest.approx(22.0)


@pytest.mark.parametrize(
    ("world", "make"),
    slow_ones_by_oracle([d for d in DRIVERS if d.id not in {"constant-speed", "ppo"}]),
)
def test_capable_drivers_cope_with_braking_vehicle_ahead(world, make):
    assert first_run(world, make, BRAKES_AHEAD).collision is None


def test_blind_lane_changer_hits_vehicle_on_its_right():
    collision = first_run(HIGHWAY, blind_lane_change.make, STAYS_AT_THE_RIGHT).collision
    assert collision.side == "right"
    assert collision.time == pytest.approx(blind_lane_change.SECONDS_PER_LANE, abs=3.0)


@pytest.mark.parametrize(
    ("world", "make"), slow_ones_by_oracle([d for d in DRIVERS if d.id != "blind-lane-change"])
)
def test_all_others_leave_the_vehicle_beside_them_alone(world, make):
    assert first_run(world, make, STAYS_AT_THE_RIGHT).collision is None
