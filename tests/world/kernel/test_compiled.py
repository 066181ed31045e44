"""The compiled kernel: it is that of the present source, and gives the same traces as the interpreted source."""

from __future__ import annotations

import pickle
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle

from pytest_pafot import Highway, PositionInstruction, Scenario, World
from pytest_pafot.model.driving_style import STYLES, Traffic
from pytest_pafot.model.instructions import CrossingInstruction, Free, Manoeuvre, Recorded, Step, Track
from pytest_pafot.searching import sample
from pytest_pafot.world import kernel
from pytest_pafot.world.kernel import bodies
from tests.helpers.interpreted import InterpretedWorld
from tests.helpers.road_cases import space_of, world_of
from tests.helpers.run_cases import Case, digest
from tests.helpers.stages import mostly_oracle, oracle


@pytest.fixture(scope="module")
def interpreted():
    return InterpretedWorld()


@pytest.mark.parametrize("seeds", [range(12), oracle(range(12, 40))], ids=str)
def test_interpreted_and_compiled_kernel_give_same_traces(interpreted, seeds):
    for case in map(Case.random, seeds):
        compiled = digest(case.run())
        with interpreted.in_place():
            world = interpreted.room.from_dict(case.world.to_dict())
            assert digest(replace(case, world=world).run()) == compiled


@pytest.mark.parametrize("style", mostly_oracle(STYLES, STYLES[0]))
def test_interpreted_and_compiled_npcs_match_in_bends(interpreted, style):
    world = world_of("roundabout-v1", duration=6.0)
    scenario = sample(space_of(world, traffic=style), np.random.default_rng(2))
    compiled = digest(world.rollout(scenario, IDMVehicle))
    with interpreted.in_place():
        again = interpreted.room.from_dict(world.to_dict())
        assert digest(again.rollout(scenario, IDMVehicle)) == compiled


def test_interpreted_and_compiled_npcs_cross_the_same(interpreted):
    world = world_of("intersection-v0")
    crossing = [CrossingInstruction("o1>o3", 0.5, 7.0)], [CrossingInstruction("o3>o0", 1.5, 8.0, "hold")]
    on_grid = [PositionInstruction(2, 8.0)]
    scenario = Scenario(npcs=[*crossing, on_grid], ego_lane=0, ego_speed=10.0)
    compiled = digest(world.rollout(scenario, IDMVehicle))
    with interpreted.in_place():
        again = interpreted.room.from_dict(world.to_dict())
        assert digest(again.rollout(scenario, IDMVehicle)) == compiled


def test_interpreted_and_compiled_npcs_do_the_same_manoeuvres(interpreted):
    beside = Step(gap=10.0, lane="right", offset=0.3), Step(headway=0.5, speed=2.0, acceleration=6.0), Step(after=0.5)
    ahead = Manoeuvre(beside=0, ahead=15.0, speed=6.0, steps=(Step(headway=1.0, speed=3.0, lateral_speed=0.8),))
    crossing = CrossingInstruction("o1>o3", 2.5, 7.0)
    for world, ego_lane, npcs in (
        (Highway(duration=6.0), 1, (Manoeuvre(beside=-1, ahead=20.0, speed=5.0, steps=beside), ahead)),
        (world_of("intersection-v0"), 0, (crossing, ahead)),
    ):
        for style in ("paper", "hostile"):
            traffic, chains = Traffic(style), [[npc] for npc in npcs]
            scenario = Scenario(npcs=chains, ego_lane=ego_lane, ego_speed=10.0, traffic=traffic)
            compiled = digest(world.rollout(scenario, IDMVehicle))
            with interpreted.in_place():
                again = interpreted.room.from_dict(world.to_dict())
                assert digest(again.rollout(scenario, IDMVehicle)) == compiled


def test_interpreted_and_compiled_npcs_drive_as_recorded_the_same(interpreted):
    tracks = [
        Track.of([[x + 2.2 * row, 4.0 * lane - aside * row, 0.001 * row, 22.0] for row in range(101)])
        for x, lane, aside in ((-20, 0, 0.0), (15, 1, 0.05), (40, 0, 0.0), (0, 0, 0.0))
    ]
    step = Step(after=3.0, lane="left")
    npcs = [
        [Recorded(track=tracks[0])],
        [Recorded(track=tracks[1], pace=0.95)],
        [Recorded(track=tracks[2], steps=(step,))],
    ]
    world, scenario = Highway(), Scenario(npcs=npcs, ego_track=tracks[3])
    trace = world.rollout(scenario, IDMVehicle)
    assert any(tick is not None for tick in trace.handed_over)
    with interpreted.in_place():
        again = interpreted.room.from_dict(world.to_dict())
        assert digest(again.rollout(scenario, IDMVehicle)) == digest(trace)


def test_interpreted_and_compiled_npcs_with_drivers_and_tracks_match_in_bends(interpreted):
    track = Track.of([[45.0 + 0.7 * row, 0.0, 0.0, 7.0] for row in range(61)])
    free = [
        Free(beside=0, ahead=ahead, speed=8.0, driver=driver) for ahead, driver in ((15.0, "own"), (-20.0, "mobil"))
    ]
    world = World("racetrack-v0", duration=8.0, planner_hz=5)
    scenario = Scenario(npcs=[*([each] for each in free), [Recorded(track=track)]], ego_lane=1, ego_speed=10.0)
    trace = world.with_drivers({"own": lambda: keeping}).rollout(scenario, IDMVehicle)
    assert trace.handed_over[2] is not None
    with interpreted.in_place():
        again = interpreted.room.from_dict(world.to_dict()).with_drivers({"own": lambda: keeping})
        assert digest(again.rollout(scenario, IDMVehicle)) == digest(trace)


def keeping(seen):
    """Follow the lane at the same speed, by a pair, which is of the same class for both kernels."""
    return 0.0, -0.1 * (seen.ego.y - 5.0 * seen.ego.lane) - 0.3 * seen.ego.heading


def test_the_kernel_knows_highway_envs_vehicles():
    from pytest_pafot.model.vehicle_type import CAR

    assert (CAR.length, CAR.width) == (Vehicle.LENGTH, Vehicle.WIDTH)
    body = bodies.Body(5.0, 2.0)
    body.place(0.0, 0.0, 0.0, Vehicle.MAX_SPEED + 1)
    body.acceleration = 3.0
    body.step(0.1)
    assert (body.acceleration, Vehicle.MIN_SPEED) == (-1.0, -Vehicle.MAX_SPEED)


@pytest.mark.skipif(not kernel.is_compiled(), reason="the kernel is not compiled here")
def test_compiled_kernel_matches_the_present_source():
    folder = Path(kernel.__file__).parent
    for name in kernel.MODULES:
        compiled = Path(import_module(f"{kernel.__name__}.{name}").__file__).stat().st_mtime
        for source in (folder / f"{name}.py", folder / f"{name}.pxd"):
            assert source.stat().st_mtime <= compiled + 1, f"{source.name} is newer; run: python -m pip install ."


def test_every_kernel_module_has_types_for_compiler():
    folder = Path(kernel.__file__).parent
    names = {path.stem for path in folder.glob("*.py")} - {"__init__"}
    assert names == set(kernel.MODULES) == {path.stem for path in folder.glob("*.pxd")}


def test_road_and_lanes_can_be_pickled():
    world = Highway()
    again = pickle.loads(pickle.dumps(world.rules))
    assert again == world.rules
    assert (again.road.grid.count, again.road.grid.width) == (4, 4.0)
