"""The compiled kernel gives the same traces as the interpreted source."""

from pathlib import Path

import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle

from pytest_pafot import CrossingInstruction, PositionInstruction, Scenario
from pytest_pafot.algorithms import sample
from pytest_pafot.model.vehicle_type import STYLES
from pytest_pafot.world import kernel
from pytest_pafot.world.kernel import lanes
from tests.helpers.interpreted import InterpretedWorld
from tests.helpers.road_cases import space_of, world_of
from tests.helpers.run_cases import Case, digest
from tests.helpers.stages import mostly_oracle, oracle


@pytest.fixture(scope="module")
def interpreted():
    return InterpretedWorld()


def assert_same(interpreted, world, scenario, ego=IDMVehicle):
    compiled = digest(world.rollout(scenario, ego))
    with interpreted.in_place():
        assert (
            digest(interpreted.room.from_dict(world.to_dict()).rollout(scenario, ego)) == compiled
        )


@pytest.mark.parametrize("seeds", [range(12), oracle(range(12, 40))], ids=str)
def test_interpreted_and_compiled_kernel_give_same_traces(interpreted, seeds):
    for case in map(Case.random, seeds):
        assert_same(interpreted, case.world, case.scenario, case.ego)


@pytest.mark.parametrize("style", mostly_oracle(STYLES, "paper"))
def test_interpreted_and_compiled_npcs_match_in_bends(interpreted, style):
    world = world_of("roundabout-v1", duration=6.0)
    scenario = sample(space_of(world, traffic=style), np.random.default_rng(2))
    assert_same(interpreted, world, scenario)


def test_interpreted_and_compiled_npcs_cross_the_same(interpreted):
    world = world_of("intersection-v0")
    crossing = (
        [CrossingInstruction("o1>o3", 0.5, 7.0)],
        [CrossingInstruction("o3>o0", 1.5, 8.0, "hold")],
    )
    scenario = Scenario(npcs=[*crossing, [PositionInstruction(2, 8.0)]], ego_lane=0, ego_speed=10.0)
    assert_same(interpreted, world, scenario)


def test_the_kernel_knows_highway_envs_vehicles():
    from pytest_pafot.model.vehicle_type import CAR

    assert (CAR.length, CAR.width) == (Vehicle.LENGTH, Vehicle.WIDTH)
    body = lanes.Body(5.0, 2.0)
    body.place(0.0, 0.0, 0.0, Vehicle.MAX_SPEED + 1)
    body.acceleration = 3.0
    body.step(0.1)
    assert (body.acceleration, Vehicle.MIN_SPEED) == (-1.0, -Vehicle.MAX_SPEED)


def test_every_kernel_module_has_types_for_compiler():
    folder = Path(kernel.__file__).parent
    names = {path.stem for path in folder.glob("*.py")} - {"__init__"}
    assert names == {path.stem for path in folder.glob("*.pxd")}
