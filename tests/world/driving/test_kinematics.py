"""Kinematics observations equal highway-env's own to the last bit; all other observations are highway-env's own."""

from __future__ import annotations

import numpy as np
import pytest
from highway_env.envs.common.observation import observation_factory
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import MDPVehicle
from highway_env.vehicle.kinematics import Vehicle
from hypothesis import given, settings
from hypothesis import strategies as st

from pytest_pafot.model.scenario import PositionInstruction, Scenario
from pytest_pafot.world import World
from pytest_pafot.world.driving.kinematics import FastKinematics, observer
from tests.helpers.stages import oracle
from tests.helpers.world_cases import car

FEATURES = ["presence", "x", "y", "vx", "vy", "heading", "cos_h", "sin_h"]
RANGES = {"x": [-100, 100], "y": [-12, 12], "vx": [-20.0, 40.0], "heading": [-1.5, 1.5], "presence": [0, 2]}


def environment(env_id):
    """Return an environment whose lanes are searched as in a run."""
    world = World(env_id)
    env = world.make().unwrapped
    env.road.network = world.network
    return env


@pytest.fixture(scope="module")
def env():
    return environment("highway-v0")


@pytest.fixture(scope="module")
def intersection():
    return environment("intersection-v0")


configs = st.fixed_dictionaries(
    {"type": st.just("Kinematics")},
    optional={
        "features": st.lists(st.sampled_from(FEATURES), min_size=1, unique=True),
        "vehicles_count": st.integers(2, 12),
        "features_range": st.sampled_from([None, {}, RANGES, {"y": [-4, 4]}]),
        "absolute": st.booleans(),
        "normalize": st.booleans(),
        "clip": st.booleans(),
        "see_behind": st.booleans(),
        "observe_intentions": st.booleans(),
        "include_obstacles": st.booleans(),
        "order": st.just("sorted"),
    },
)
positions = st.tuples(st.floats(0, 700), st.floats(-6, 18))
crossroads = st.tuples(st.floats(-60, 60), st.floats(-60, 60))
motions = st.floats(-4, 4), st.floats(-5, 42)
states = st.tuples(positions, *motions)


@pytest.mark.parametrize("ego_class", [car, oracle(MDPVehicle), oracle(Vehicle)])
@settings(max_examples=50)  # of eleven options, any of which may be left out
@given(config=configs, others=st.lists(states, min_size=1, max_size=9))
def test_observations_equal_those_of_highway_env_exactly(env, config, others, ego_class):
    assert_the_same_is_observed(env, config, others, ego_class)


@settings(max_examples=25)
@given(config=configs, others=st.lists(st.tuples(crossroads, *motions), min_size=1, max_size=9))
def test_intersection_observations_equal_those_of_highway_env(intersection, config, others):
    assert_the_same_is_observed(intersection, config, others, MDPVehicle)


def assert_the_same_is_observed(env, config, others, ego_class):
    env.road.vehicles = [ego_class(env.road, *others[0])]
    env.controlled_vehicles = env.road.vehicles[:1]
    env.road.vehicles += [(car, IDMVehicle)[k % 2](env.road, *other) for k, other in enumerate(others[1:])]
    stock = observation_factory(env, config)
    env.observation_type = observation_factory(env, config)
    fast = observer(env)
    assert type(fast) is FastKinematics
    for _ in range(2):  # highway-env remembers its ranges after the first
        expected, received = stock.observe(), fast()
        assert received.dtype == expected.dtype
        assert received.shape == expected.shape
        assert received.tobytes() == expected.tobytes()


def test_equally_distant_vehicles_come_in_road_order(env):
    ego = car(env.road, (300.0, 4.0), 0.0, 20.0)
    env.road.vehicles = [ego, *(car(env.road, (320.0, y), 0.0, 20.0 + y) for y in (8.0, 0.0, 4.0))]
    env.controlled_vehicles = [ego]
    env.observation_type = observation_factory(env, {"type": "Kinematics", "vehicles_count": 3})
    assert observer(env)().tobytes() == env.observation_type.observe().tobytes()


@pytest.mark.parametrize(
    "config",
    [
        {"type": "OccupancyGrid"},
        {"type": "TimeToCollision"},
        {"type": "LidarObservation"},
        {"type": "Kinematics", "features": ["presence", "x", "cos_d", "sin_d"]},
        {"type": "Kinematics", "features": ["long_off", "lat_off", "ang_off"]},
        {"type": "Kinematics", "order": "shuffled"},
        {"type": "Kinematics", "vehicles_count": 1},
        {"type": "KinematicsGoal", "features": ["x", "y"], "scales": [1, 1], "normalize": False},
        {"type": "MultiAgentObservation", "observation_config": {"type": "Kinematics"}},
    ],
    ids=lambda config: "-".join(map(str, config.values()))[:40],
)
def test_every_other_observation_goes_through_highway_env(env, config):
    env.observation_type = observation_factory(env, config)
    assert observer(env) == env.observation_type.observe


SCENARIO = Scenario(npcs=[[PositionInstruction(1, 25.0)], [PositionInstruction(6, 20.0)]], gene_seconds=4.0)


@pytest.mark.parametrize(
    ("observation", "shape"),
    [
        ({"type": "Kinematics"}, (5, 5)),
        ({"type": "Kinematics", "vehicles_count": 15, "features": FEATURES}, (15, 8)),
        ({"type": "Kinematics", "order": "shuffled", "vehicles_count": 3}, (3, 5)),
        ({"type": "OccupancyGrid"}, (4, 11, 11)),
        ({"type": "TimeToCollision", "horizon": 10}, (3, 3, 10)),
        ({"type": "LidarObservation", "cells": 16}, (16, 2)),
    ],
    ids=lambda value: value["type"] if isinstance(value, dict) else "",
)
def test_policy_observations_match_their_space_and_repeat(observation, shape):
    world = World("highway-v0", config={"observation": observation})

    def rollout():
        seen = []

        def policy(received):
            seen.append(np.array(received))
            return 1

        world.rollout(SCENARIO, lambda: policy)
        return seen

    first, second = rollout(), rollout()
    assert {array.shape for array in first} == {shape}
    assert [array.tobytes() for array in first] == [array.tobytes() for array in second]
    assert len({array.tobytes() for array in first}) > 1


def test_policy_may_change_its_own_observation():
    world = World("highway-v0")
    seen = []

    def policy(observation):
        seen.append(observation.copy())
        observation[:] = np.nan
        return 1

    world.rollout(SCENARIO, lambda: policy)
    assert np.isfinite(seen).all()
