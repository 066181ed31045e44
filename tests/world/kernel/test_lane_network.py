"""The lanes of a network in plain numbers, and the vehicles on them, against highway-env's own to the last bit."""

from __future__ import annotations

import pickle
from typing import ClassVar

import numpy as np
import pytest
from highway_env.road.lane import StraightLane
from highway_env.road.regulation import RegulatedRoad
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import MDPVehicle

from pytest_pafot import CrossingInstruction, Scenario, World
from pytest_pafot.algorithms import sample
from pytest_pafot.model.trace import SPEED, X
from pytest_pafot.world.driving.vehicles import compiled_network
from pytest_pafot.world.engines import policies
from pytest_pafot.world.kernel.loop import ModelDriver
from tests.helpers.c_library import c_library
from tests.helpers.road_cases import ROADS, OwnEnvironment, space_of, world_of
from tests.helpers.stages import mostly_oracle

BENT = mostly_oracle(ROADS, "intersection-v0", "merge-v1")


@pytest.mark.parametrize("env_id", mostly_oracle(ROADS, "roundabout-v1", "merge-v1"))
def test_each_lane_is_where_highway_env_says(env_id):
    network, rng = World(env_id).make().unwrapped.road.network, np.random.default_rng(0)
    compiled = pickle.loads(pickle.dumps(compiled_network(network)))
    with c_library():
        for number, (index, lane) in enumerate(network.lanes_dict().items()):
            places = zip(rng.uniform(-9, lane.length + 9, 12), rng.normal(0, 4, 12), strict=True)
            for along, across in places:
                compiled.position(number, along, across)
                assert (compiled.x, compiled.y) == tuple(lane.position(along, across)), index
                assert compiled.heading_at(number, along) == lane.heading_at(along)
                place = lane.position(along, across) + rng.normal(0, 20, 2)
                compiled.locate(number, *place)
                assert (compiled.along, compiled.across) == lane.local_coordinates(place)
                assert compiled.is_on(number, *place, 1.0) == lane.on_lane(place, margin=1.0)
                assert compiled.is_reachable(number, *place) == lane.is_reachable_from(place)
                assert compiled.is_after_end(number, *place) == lane.after_end(place)


def swerves(actions):
    """Return the factory of a policy that cycles through actions, with what it has seen in between."""

    def make():
        taken = []
        return lambda seen: taken.append(np.sum(seen)) or actions[len(taken) // 3 % len(actions)]

    return make


class Own(IDMVehicle):
    """IDM with code of its own, which the kernel does not know."""

    def act(self, action=None):
        super().act(action)


@pytest.mark.parametrize("env_id", BENT)
def test_every_kind_of_ego_drives_as_in_steps_of_the_environment(env_id):
    """The bits are equal with the C library's functions: IDM, a class with code of its own, and the policy's actions.

    IDM changes lanes, follows routes, brakes behind obstacles, and yields where the road has rules. The ego of
    lane-keeping-v0 must have a state that only its own class has.
    """
    world = world_of(env_id, duration=20.0)
    space, egos = world.action_space, [IDMVehicle, IDMVehicle, IDMVehicle, Own]
    actions = [np.full(space.shape, 0.01, np.float32)]
    if hasattr(space, "n"):
        actions = [*range(space.n), 1]
    if env_id == "lane-keeping-v0":
        egos = []
    for seed, ads in enumerate([*egos, swerves(actions)]):
        scenario = sample(space_of(world), np.random.default_rng(seed))
        with c_library():
            ours, stocks = world.rollout(scenario, ads), world.rollout_in_gym(scenario, ads)
        for name in ("outcome", "executed", "collision"):
            assert getattr(ours, name) == getattr(stocks, name), ads
        assert ours.states.tobytes() == stocks.states.tobytes(), ads


@pytest.mark.parametrize("env_id", BENT)
def test_the_kernel_moves_the_egos_that_it_knows(env_id, monkeypatch):
    drivers, drive = [], policies.VehiclesOfRun.drive
    noting = lambda run, driver, *given: drivers.append(driver) or drive(run, driver, *given)  # noqa: E731
    monkeypatch.setattr(policies.VehiclesOfRun, "drive", noting)
    world = world_of(env_id, duration=6.0)
    scenario = sample(space_of(world), np.random.default_rng(0))
    for ads in (IDMVehicle, Own, MDPVehicle):
        world.rollout(scenario, ads)
    assert [isinstance(driver, ModelDriver) for driver in drivers] == [True, False, False]


class Yielding(OwnEnvironment):
    """A slow road that leads across one with priority, and on as a faster road."""

    options: ClassVar = {"duration": 20}

    def _reset(self):
        lanes = [
            ("w", "m", StraightLane([-150, 0], [30, 0], speed_limit=10)),
            ("m", "e", StraightLane([30, 0], [400, 0], speed_limit=20)),
            ("n", "s", StraightLane([0, -150], [0, 150], speed_limit=10, priority=1)),
        ]
        self.open(lanes, [-60.0, 0.0], road=RegulatedRoad)


@pytest.fixture
def yielding(register):
    register("Yielding-v0", Yielding)
    return World("Yielding-v0")


def test_ego_that_has_yielded_keeps_the_speed_limit_of_that_place(yielding):
    """highway-env sets the speed that the ego wants to the limit once, when the ego has yielded, and then never again.

    So the ego goes on with 10 m/s where 20 are allowed.
    """
    npc = CrossingInstruction("n>s", 0.1, 8.0, "hold")
    scenario = Scenario(npcs=[[npc]], ego_lane=0, ego_speed=10.0)
    with c_library():
        ours, stocks = yielding.rollout(scenario, IDMVehicle), yielding.rollout(scenario, Own)
    assert ours.states.tobytes() == stocks.states.tobytes()
    assert ours.ego[:, SPEED].min() < 8.0, "it has yielded"
    assert (ours.ego[-1, X] > 60.0, ours.ego[-1, SPEED]) == (True, pytest.approx(10.0, abs=0.1))
