"""Every wrong world, and every scenario that does not fit, gives one clear error: place, expected, received, fix."""

import math

import gymnasium
import highway_env
import numpy as np
import pytest
from highway_env.envs.common import abstract, observation
from highway_env.vehicle.behavior import IDMVehicle

from pytest_pafot import Highway, NpcLimits, PositionInstruction, Scenario, ScenarioError, World
from tests.helpers.refusals import refused
from tests.helpers.stages import mostly_oracle
from tests.helpers.tables import table
from tests.helpers.world_cases import constant_speed


def hold(*cells, speed=20.0, **fields):
    return Scenario(npcs=[[PositionInstruction(cell, speed)] for cell in cells], **fields)


WRONG_HIGHWAYS = {
    "two lanes": ({"lanes": 2}, "lanes"),
    "no whole lanes": ({"lanes": 4.0}, "lanes"),
    "a slow limit": ({"speed_limit": 4}, "speed_limit"),
    "a fast limit": ({"speed_limit": 39}, "speed_limit"),
    "few ticks": ({"physics_hz": 4}, "physics_hz"),
    "decisions between ticks": ({"physics_hz": 1000, "ads_hz": 600}, "ads_hz"),
    "a long run": ({"physics_hz": 127, "ads_hz": 1, "duration": 3600}, "duration"),
    "many ticks": ({"physics_hz": 1000, "duration": 3600}, "duration"),
    "no decisions": ({"ads_hz": 0}, "ads_hz"),
    "no duration": ({"duration": 0}, "duration"),
    "a negative clearance": ({"clearance": -1}, "clearance"),
    "a long headway": ({"headway": 11}, "headway"),
    "no time to decide": ({"hang_limit": 0}, "hang_limit"),
    "limits as a dict": ({"limits": {"jerk": 5}}, "limits"),
    "NPCs faster than highway-env's": (lambda: {"limits": NpcLimits(overspeed=2)}, "speed_limit"),
    "an NPC that drives sideways": (lambda: {"limits": NpcLimits(heading=1)}, "limits.heading"),
    "NPCs slower than the limit": (lambda: {"limits": NpcLimits(overspeed=0.9)}, "limits.overspeed"),
}  # fmt: skip


def wrong_highway(options):
    return Highway(**(options() if callable(options) else options))


FREQUENCIES = [(20, 15), (15, 30), (7, 2)]


def gym_with(physics_hz, ads_hz):
    """Return a world in which an environment has these frequencies."""
    return World("highway-v0", {"simulation_frequency": physics_hz, "policy_frequency": ads_hz})


@table(("physics_hz", "ads_hz"), FREQUENCIES)
def test_frequencies_that_do_not_divide_are_refused(physics_hz, ads_hz):
    with refused("ads_hz"):
        Highway(physics_hz=physics_hz, ads_hz=ads_hz)
    with refused("config.policy_frequency"):
        gym_with(physics_hz, ads_hz).check()


LIMITS = ["acceleration", "braking", "jerk", "lateral_acceleration", "overspeed", "heading"]


@table("name", LIMITS)
@table("value", [0, -1, 1e-300, 1e300, math.nan, math.inf, "5", None, True])
def test_invalid_number_for_a_limit_is_refused(name, value):
    with refused(f"limits.{name}") as caught:
        NpcLimits(**{name: value})
    assert caught.value.received == repr(value)


def image(**options):
    return {"type": "GrayscaleObservation", "observation_shape": [84, 84], "stack_size": 4,
            "weights": [0.2, 0.6, 0.2], **options}  # fmt: skip


def grid(**options):
    return {"type": "OccupancyGrid", **options}


MANY = {"type": "TupleObservation", "observation_configs": [{"type": "Kinematics"}] * 20}
VERY_SLOW = {
    "lanes": ("highway-v0", {"lanes_count": 3_000_000}, "lanes_count"),
    "egos": ("exit-v0", {"controlled_vehicles": 10**9}, "controlled_vehicles"),
    "a circle": ("roundabout-generic-v0", {"roundabout_radius": 10**5}, "roundabout_radius"),
    "a merge": ("merge-generic-v0", {"after_merge_length": 10**6}, "after_merge_length"),
    "a circuit": ("racetrack-oval-v0", {"length": 10**4}, "length"),
    "ticks": ("intersection-v0", {"simulation_frequency": 10**9}, "simulation_frequency"),
    "time to collision": ("two-way-v0", {"observation": {"type": "TimeToCollision", "horizon": 1000},
                                         "policy_frequency": 1000, "simulation_frequency": 1000}, "observation"),
    **{name: ("highway-v0", {"observation": observation}, f"observation{field}") for name, observation, field in (
        ("vehicles", {"type": "Kinematics", "vehicles_count": 10**9}, ".vehicles_count"),
        ("cells", grid(grid_step=[1e-3, 1e-3]), ".grid_step"),
        ("pixels", image(observation_shape=[10**6, 10**6]), ".observation_shape"),
        ("features", {"type": "Kinematics", "vehicles_count": 1000, "features": ["x"] * 50_000}, ".features"),
        ("features as a text", grid(features="x" * 100_000), ".features"),
        ("a number as steps", grid(grid_step=0.001), ".grid_step"),
        ("an infinite grid", grid(grid_size=[[-math.inf, math.inf], [0, 1]]), ".grid_step"),
        ("tiny steps", grid(grid_size=[[0, 0.1]] * 2, grid_step=[1e-3] * 2), ".grid_step"),
        ("a tiny scale", image(scaling=1e-5), ".scaling"),
        ("weights", image(weights=[[0.1] * 5000] * 3), ".weights"),
        ("numbers", image(observation_shape=[2000, 2000], stack_size=100), ""),
        ("dimensions", image(observation_shape=[500, 500, 500], stack_size=1), ".observation_shape"),
        ("tuples", {"type": "TupleObservation", "observation_configs": [MANY] * 20}, ""),
    )},
}  # fmt: skip


def check(env_id, config):
    World(env_id, config=config).check()


@table("config", [
    {"observation": {"type": "Kinematics", "vehicles_count": 100,
                     "features": ["x", "y", "vx", "vy", "heading", "cos_h", "sin_h"]}},
    {"observation": {"type": "OccupancyGrid", "grid_size": [[-32, 32], [-32, 32]], "grid_step": [0.5, 0.5]}},
    {"observation": {"type": "LidarObservation", "cells": 3600}},
    {"observation": {"type": "TimeToCollision", "horizon": 10}},
    {"observation": {"type": "TupleObservation",
                     "observation_configs": [{"type": "Kinematics"}, {"type": "LidarObservation"}]}},
    {"vehicles_count": 3_000_000},  # there is no random traffic
    # Options of other types of observations or actions have no effect.
    {"observation": {"type": "OccupancyGrid", "vehicles_count": 15, "features_range": {"x": [-100, 100]}}},
    {"observation": {"type": "Kinematics", "flatten": False}},
    {"action": {"type": "ContinuousAction", "target_speeds": [0, 5, 10]}},
])  # fmt: skip
def test_large_or_unused_options_that_cost_no_time_are_accepted(config):
    World("highway-v0", config=config).check()


NO_IDS = ["", None, 7, "my_module:highway-v0", ":", "os:system"]


ENVIRONMENTS = sorted(
    name for name, spec in gymnasium.registry.items() if "highway_env" in str(spec.entry_point)
)
ALWAYS = "highway-fast-v0", "intersection-multi-agent-v0", "lane-keeping-v0", "parking-v0"


@pytest.mark.parametrize("env_id", mostly_oracle(ENVIRONMENTS, *ALWAYS))
def test_every_highway_env_environment_runs_or_is_refused(env_id):
    world = World(env_id)
    is_parking = env_id.startswith("parking")
    if is_parking or "multi-agent" in env_id:
        with refused(env_id if is_parking else "config.controlled_vehicles"):
            world.check()
    else:
        world.check()
        assert (world.start is None) == env_id.startswith("highway-")


def test_environment_does_not_change_highway_env_vehicle_classes():
    """intersection-v2 writes to the class IDMVehicle when it is made and whenever it is reset."""
    slow = hold(2, speed=5.0, ego_lane=0, ego_speed=5.0, gene_seconds=1.0)
    World("intersection-v2", duration=1.0).rollout(slow, lambda: IDMVehicle)
    names = "DISTANCE_WANTED", "COMFORT_ACC_MAX", "COMFORT_ACC_MIN"
    assert [getattr(IDMVehicle, name) for name in names] == [10.0, 3.0, -5.0]


UNKNOWN = {
    "highway-v9": "'highway-v0'", "Merge-v1": "'merge-v1'", "round-about-v0": "'roundabout-v0'", "CartPole-v9": None,
    "highway": ..., "highway-v99": ..., "Highway-v0": ..., "nope-v0": ..., "highway-v0 ": ..., "MetaDrive-v0": ...,
}  # fmt: skip


@table(
    ("env_id", "meant"), [*UNKNOWN.items(), ("CartPole-v1", ...), *((each, ...) for each in NO_IDS)]
)
def test_environment_that_no_world_accepts_is_refused_with_a_similar_one(env_id, meant):
    with refused("env_id") as caught:
        World(env_id).check()
    if meant is not ...:
        assert meant is None or meant in caught.value.fix
        assert meant or not any(name in caught.value.fix for name in ("'highway-v0'", "CartPole"))


SEVERAL = {"type": "MultiAgentAction", "action_config": {"type": "DiscreteMetaAction"}}
WRONG_CONFIGS = {
    "no dict": ([], "config"),
    "a name that is nearly right": ({"lane_count": 3}, "config"),
    "another name": ({"zebra": 3}, "config"),
    "a number as a key": ({1: 2}, "config"),
    "a class": ({"action": {"target_speeds": object}}, "config.action.target_speeds"),
    "an unknown observation": ({"observation": {"type": "Nope"}}, "config"),
    "an action without a type": ({"action": {}}, "config"),
    "no lanes": ({"lanes_count": 0}, "config"),
    "ticks that are no whole number": ({"simulation_frequency": 15.5}, "config.simulation_frequency"),
    "no decisions": ({"policy_frequency": 0}, "config.policy_frequency"),
    "a negative duration": ({"duration": -1}, "config.duration"),
    "a duration beyond the road": ({"duration": 300}, "duration"),
    "two egos": ({"controlled_vehicles": 2}, "config.controlled_vehicles"),
    "manual control": ({"manual_control": True}, "config.manual_control"),
    "a text as a reward": ({"collision_reward": "-1"}, "config.collision_reward"),
    "an option of an observation": ({"observation": {"type": "Kinematics", "vehicle_count": 7}}, "config.observation"),
    "another spelling": ({"observation": {"type": "Kinematics", "normalise": False}}, "config.observation"),
    "an observation in another": ({"observation": {"type": "MultiAgentObservation", "observation_config": {
        "type": "Kinematics", "oder": ""}}}, "config.observation.observation_config"),
    "an observation in a list": ({"observation": {"type": "TupleObservation", "observation_configs": [
        {"type": "Kinematics", "clips": True}]}}, "config.observation.observation_configs[0]"),
    "another option of an observation": ({"observation": {"type": "Kinematics", "zebra": 7}}, "config.observation"),
    "an option of an action": ({"action": {"type": "DiscreteMetaAction", "target_speed": [10, 20]}}, "config.action"),
    "an action in another": ({"action": {"type": "MultiAgentAction", "action_config": {
        "type": "ContinuousAction", "laterl": True}}}, "config.action.action_config"),
    "an action for several vehicles": ({"action": SEVERAL}, "config.action"),
}  # fmt: skip


def check_config(config):
    World("highway-v0", config=config).rollout(hold(1), lambda: lambda observation: (1,))


def test_custom_observations_and_environments_define_own_options(register, monkeypatch):
    class Own(highway_env.envs.HighwayEnv):
        @classmethod
        def default_config(cls):
            return super().default_config() | {
                "observation": {"type": "Kinematics", "seen_from": "above"}
            }

    class Sight(observation.KinematicObservation):
        pass

    register("own-sight-v0", entry_point=Own)
    World("own-sight-v0", {"observation": {"type": "Kinematics", "seen_from": "below"}}).check()
    monkeypatch.setattr(abstract, "observation_factory", lambda env, config: Sight(env))
    World("highway-v0", {"observation": {"type": "Sight", "zebra": 1}}).check()


WRONG_GYMS = {
    "no duration": ({"duration": 0}, "duration"),
    "less than a decision": ({"duration": 0.1}, "duration"),
    "a long run": ({"duration": 3600, "config": {"simulation_frequency": 1000, "policy_frequency": 1}}, "duration"),
    "no clearance": ({"clearance": None}, "clearance"),
    "a negative headway": ({"headway": -0.1}, "headway"),
}  # fmt: skip


def check_options(options):
    World("highway-fast-v0", **options).check()


TABLES = [
    (wrong_highway, WRONG_HIGHWAYS),
    (check, VERY_SLOW),
    (check_config, WRONG_CONFIGS),
    (check_options, WRONG_GYMS),
]


@pytest.mark.parametrize(("call", "rows"), TABLES)
def test_wrong_options_and_very_slow_environments_are_refused_by_name(call, rows):
    for name, (*given, field) in rows.items():
        with refused(f"config.{field}" if call is check else field):
            call(*given)
            pytest.fail(name)


def test_the_callers_configuration_is_neither_changed_nor_followed():
    speeds = {"type": "DiscreteMetaAction", "target_speeds": np.array([10.0, 20.0])}
    config = {"action": speeds, "lanes_count": 3}
    world = World("highway-v0", config=config)
    config["lanes_count"] = 6
    config["action"]["type"] = "Nope"
    assert world.lanes == 3
    world.rollout(hold(1), lambda: lambda observation: 1)
    assert set(config) == {"action", "lanes_count"}


UNFITTING = {
    "none": (None, "scenario"),
    "no such lane": (hold(1, ego_lane=4), "ego_lane"),
    "more NPCs than cells": (hold(*range(1, 7), ego_lane=0), "npcs"),
    "a fast ego": (hold(1, ego_speed=33.5), "ego_speed"),
    "genes between ticks": (hold(1, gene_seconds=0.15), "gene_seconds"),
    "an NPC above the limit": (hold(1, speed=30.5), "npcs[0][0].speed"),  # less than the top speed
}


@table(("scenario", "field"), UNFITTING.values())
@table("world", [Highway(), World("highway-v0")])
def test_unfitting_scenario_is_refused_with_its_field(world, scenario, field):
    with refused(field, ScenarioError):
        world.rollout(scenario, constant_speed)


def test_nearest_gene_duration_from_error_is_accepted():
    with refused("gene_seconds", ScenarioError) as caught:
        Highway().rollout(hold(1, gene_seconds=0.15), constant_speed)
    nearest = float(caught.value.fix.rsplit(" ", 2)[1])
    trace = Highway().rollout(hold(1, gene_seconds=nearest), constant_speed)
    assert trace.ticks == round(nearest * 15)


def test_the_worlds_are_frozen_values():
    assert Highway(lanes=5) == Highway(lanes=5) != Highway()
    three = {"lanes_count": 3}
    assert World("highway-v0", config=three) == World("highway-v0", config={**three})
    assert hash(Highway(lanes=5)) == hash(Highway(lanes=5))
    for world in (Highway(), World("highway-v0")):
        with pytest.raises(AttributeError):
            world.headway = 3.0
