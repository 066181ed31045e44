"""Observations equal highway-env's own to the last bit, compiled or interpreted, or are highway-env's own."""

import functools
from contextlib import nullcontext

import numpy as np
import pytest
from highway_env.envs.common.observation import observation_factory
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import MDPVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Landmark, Obstacle
from hypothesis import given, settings
from hypothesis import strategies as st

from pytest_pafot import PositionInstruction, Scenario, World
from pytest_pafot.world.driving.environment import FastTable, observer
from pytest_pafot.world.driving.vehicles import SearchedLanes, StockVehicle
from pytest_pafot.world.kernel.lane_network import FEATURES
from tests.helpers.c_library import c_library
from tests.helpers.interpreted import InterpretedWorld
from tests.helpers.road_cases import ROADS
from tests.helpers.stages import mostly_oracle

ranges = st.dictionaries(
    st.sampled_from(FEATURES),
    st.tuples(st.integers(-40, 0) | st.floats(-3, 0), st.floats(1, 100)),
    max_size=5,
)


def tables(kind):
    """Return a strategy for tables with all options that are supported."""
    names = "absolute", "normalize", "clip", "see_behind", "observe_intentions", "include_obstacles"
    options = {
        "features": st.lists(st.sampled_from(FEATURES), min_size=1, unique=True),
        "vehicles_count": st.integers(1, 8),
        "features_range": st.none() | ranges,
        "order": st.just("sorted"),
        **dict.fromkeys(names, st.booleans()),
    }
    return st.fixed_dictionaries({"type": st.just(kind)}, optional=options)


shares = st.floats(0, 1, exclude_max=True)
# The lane, the distance along it and across it, the angle to it, the speed, and where its route ends, if it has one.
vehicles = st.tuples(
    *(
        shares,
        st.floats(-10, 200),
        st.just(0.0) | st.floats(-9, 9),
        st.just(0.0) | st.floats(-4, 4),
    ),
    *(st.sampled_from([0.0, 20.0]) | st.floats(-5, 42), st.none() | shares),
)


@functools.cache
def environment(env_id):
    env = World(env_id).make().unwrapped
    env.road.network = SearchedLanes(env.road.network)  # NPCs need it
    return env


def placed(kind, road, state):
    lane_share, along, across, angle, speed, route_share = state
    lanes, nodes = road.network.lanes_list(), list(road.network.graph)
    lane = lanes[int(lane_share * len(lanes))]
    position, heading = lane.position(along, across), float(lane.heading_at(along) + angle)
    made = kind(road, position, heading, speed)
    if route_share is not None and hasattr(made, "plan_route_to"):
        made.plan_route_to(nodes[int(route_share * len(nodes))])
    return made


def populate(env, ego_class, states, objects=()):
    """Put vehicles of three classes on an environment's road, the ego somewhere among them, and objects."""
    ego = placed(ego_class, env.road, states[0])
    kinds, things = (StockVehicle, IDMVehicle, MDPVehicle), (Obstacle, Landmark)
    others = [placed(kinds[k % 3], env.road, state) for k, state in enumerate(states[1:])]
    env.road.vehicles = [*others[:2], ego, *others[2:]]
    env.road.vehicles[-1].LENGTH = 12.0
    env.road.objects = [placed(things[k % 2], env.road, each) for k, each in enumerate(objects)]
    env.controlled_vehicles = [ego]


@pytest.fixture(scope="module")
def observers():
    """Return the function that is tested in the kernel of this process and in the interpreted one."""
    interpreted = InterpretedWorld()
    with interpreted.in_place():
        from pytest_pafot.world.driving import environment as observations
    return [(observer, nullcontext), (observations.observer, interpreted.in_place)]


def assert_the_same_is_observed(env, config, observers):
    stock = observation_factory(env, config)
    with c_library():
        expected = [stock.observe() for _ in range(2)]  # it keeps its ranges after the first
        for make, in_place in observers:
            with in_place():
                env.observation_type = observation_factory(env, config)
                fast = make(env)
                env.observation_type.observe = None  # must not be called
                received = [fast() for _ in range(2)]
            for own, each in zip(received, expected, strict=True):
                assert own.tobytes() == each.tobytes()
                assert (own.dtype, own.shape) == (each.dtype, each.shape)
            ranges = [vars(each).get("features_range") for each in (env.observation_type, stock)]
            assert ranges[0] == ranges[1]


ALWAYS = "highway-v0", "merge-v1", "racetrack-v1", "intersection-v1", "lane-keeping-v0"
several, few = st.lists(vehicles, min_size=1, max_size=8), st.lists(vehicles, max_size=2)
kinds = st.sampled_from([StockVehicle, MDPVehicle, Vehicle])


@pytest.mark.parametrize("env_id", mostly_oracle(("highway-v0", *ROADS), *ALWAYS))
@settings(max_examples=6)
@given(config=tables("Kinematics"), states=several, objects=few, ego=kinds)
def test_tables_equal_those_of_highway_env(env_id, observers, config, states, objects, ego):
    populate(environment(env_id), ego, states, objects)
    assert_the_same_is_observed(environment(env_id), config, observers)


@settings(max_examples=15)
@given(config=tables("ExitObservation"), states=several, objects=few)
def test_tables_with_an_exit_equal_those_of_highway_env(observers, config, states, objects):
    populate(environment("exit-v1"), MDPVehicle, states, objects)
    assert_the_same_is_observed(environment("exit-v1"), config, observers)


@pytest.mark.parametrize("feature", ["cos_d", "sin_d"])
def test_destination_is_seen_up_to_the_end_of_the_route(observers, feature):
    """Half a metre before it and 0.3 m to the side of it, its direction is still known."""
    env, index = environment("intersection-v1"), ("o0", "ir0", 0)
    lane = env.road.network.get_lane(index)
    ego = MDPVehicle(env.road, lane.position(lane.length - 0.4, 0.3), lane.heading_at(0.0), 8.0)
    ego.route = [index]
    env.road.vehicles = env.controlled_vehicles = [ego]
    config = {"type": "Kinematics", "features": [feature]}
    assert_the_same_is_observed(env, config | {"absolute": True}, observers)
    x, y = (lane.position(lane.length, 0.0) - ego.position) / 0.5
    env.observation_type = observation_factory(env, config)
    assert observer(env)()[0, 0] == pytest.approx(x if feature == "cos_d" else y, abs=1e-6)


@pytest.fixture
def env():
    return environment("highway-v0")


def observe(env, *others, **config):
    """Return what an ego observes of other vehicles, as this package and as highway-env do it."""
    ego = StockVehicle(env.road, (300.0, 4.0), 0.0, 20.0)
    env.road.vehicles, env.controlled_vehicles = [ego, *others], [ego]
    env.observation_type = observation_factory(env, {"type": "Kinematics", **config})
    fast = observer(env)
    assert isinstance(fast, FastTable)
    return fast().tobytes(), env.observation_type.observe().tobytes()


def test_equally_distant_vehicles_come_in_road_order(env):
    others = [StockVehicle(env.road, (320.0, y), 0.0, 20.0 + y) for y in (8.0, 0.0, 4.0)]
    own, stock = observe(env, *others, vehicles_count=3)
    assert own == stock


@pytest.mark.parametrize("config", [
    {"type": "LidarObservation"},
    {"type": "Kinematics", "order": "shuffled"},
    {"type": "Kinematics", "features": ["x", "x"]},
    {"type": "Kinematics", "vehicles_count": 0},
    {"type": "OccupancyGrid"},
    {"type": "TimeToCollision"},
    {"type": "KinematicsGoal", "features": ["x", "y"], "scales": [1, 1], "normalize": False},
    {"type": "MultiAgentObservation", "observation_config": {"type": "Kinematics"}},
])  # fmt: skip
def test_every_other_observation_is_left_to_highway_env(env, config):
    env.observation_type = observation_factory(env, config)
    assert observer(env) == env.observation_type.observe


class Ghost(Vehicle):
    def to_dict(self, *args, **kwargs):
        return {**super().to_dict(*args, **kwargs), "x": 7.0}


def test_vehicle_that_describes_itself_is_left_to_highway_env(env):
    own, stock = observe(env, Ghost(env.road, (320.0, 4.0)))
    assert own == stock


def test_policy_may_change_its_own_observation():
    seen, npcs = [], [[PositionInstruction(1, 25.0)], [PositionInstruction(6, 20.0)]]

    def policy(observation):
        seen.append(observation.copy())
        observation[:] = np.nan
        return 1

    World("highway-v0").rollout(Scenario(npcs=npcs, gene_seconds=4.0), lambda: policy)
    assert np.isfinite(seen).all()
