"""Every wrong world, and every scenario that does not fit, gives one clear error: place, expected, received, fix."""

from __future__ import annotations

import math
import re

import gymnasium
import highway_env
import numpy as np
import pytest
from highway_env.envs.common import abstract, observation

from pytest_pafot.model.instructions import PositionInstruction, ScenarioError
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.world import Highway, NpcLimits, World, WorldError
from tests.helpers.stages import mostly_oracle
from tests.helpers.tables import table
from tests.helpers.world_cases import constant_speed


def raises(message, error=WorldError):
    return pytest.raises(error, match=re.escape(message))


def hold(*cells, speed=20.0, **fields):
    return Scenario(npcs=[[PositionInstruction(cell, speed)] for cell in cells], **fields)


@table(("options", "message"), [
    ({"lanes": 2}, "lanes: expected a whole number from 3 to 6, received 2"),
    ({"lanes": 4.0}, "lanes: expected a whole number from 3 to 6, received 4.0"),
    ({"speed_limit": 4}, "speed_limit: expected a number from 5 to 40, received 4"),
    ({"speed_limit": 39}, "speed_limit: expected at most 36.3 m/s, because NPCs can drive 1.1 times the limit"),
    ({"physics_hz": 4}, "physics_hz: expected a whole number from 5 to 1000, received 4"),
    ({"physics_hz": 1000, "ads_hz": 600},
     "Use one of 1, 2, 4, 5, 8, 10, 20, 25, 40, 50, 100, 125, 200, 250, 500, 1000"),
    ({"physics_hz": 127, "ads_hz": 1, "duration": 3600}, "duration: expected at most 3149 s at 127 ticks per second"),
    ({"physics_hz": 1000, "duration": 3600}, "duration: expected at most 400 s at 1000 ticks per second, received 36"),
    ({"ads_hz": 0}, "ads_hz: expected a whole number from 1 to 1000, received 0"),
    ({"duration": 0}, "duration: expected a number from 0.0666667 to 3600, received 0"),
    ({"clearance": -1}, "clearance: expected a number from 0 to 50, received -1"),
    ({"headway": 11}, "headway: expected a number from 0 to 10, received 11"),
    ({"hang_limit": 0}, "hang_limit: expected a number from 0.01 to 86400, received 0"),
    ({"limits": {"jerk": 5}}, "limits: expected a pafot.NpcLimits object, received {'jerk': 5}"),
])  # fmt: skip
def test_wrong_highway_option_is_named_with_its_bounds(options, message):
    with raises(message):
        Highway(**options)


@table(("physics_hz", "ads_hz", "message"), [
    (20, 15, "ads_hz: expected a divisor of physics_hz (20), so that every decision lasts a whole number of ticks, "
             "received 15. Use one of 1, 2, 4, 5, 10, 20, or set physics_hz to 30"),
    (15, 30, "received 30. Use one of 1, 3, 5, 15, or set physics_hz to 30"),
    (7, 2, "received 2. Use one of 1, 7, or set physics_hz to 8"),
])  # fmt: skip
def test_frequencies_that_do_not_divide_are_refused(physics_hz, ads_hz, message):
    with raises(message):
        Highway(physics_hz=physics_hz, ads_hz=ads_hz)
    names = {"physics_hz": "config.simulation_frequency"}
    for old, new in names.items():
        message = message.replace(old, new).replace("ads_hz:", "config.policy_frequency:")
    with raises(message):
        World(
            "highway-v0", config={"simulation_frequency": physics_hz, "policy_frequency": ads_hz}
        ).check()


@table("name", ["acceleration", "braking", "jerk", "lateral_acceleration", "overspeed", "heading"])
@table("value", [0, -1, 1e-300, 1e300, math.nan, math.inf, "5", None, True])
def test_invalid_number_for_a_limit_is_refused(name, value):
    received = re.escape(f"received {value!r}")
    with pytest.raises(
        WorldError,
        match=rf"^limits\.{name}: expected a number from [^,]*(, so that .*)?, {received}$",
    ):
        NpcLimits(**{name: value})


def test_limits_that_contradict_npc_behaviour_are_refused():
    with raises(
        "limits.heading: expected a number from 0.01 to 0.785398, so that no NPC drives sideways, received 1"
    ):
        NpcLimits(heading=1)
    with raises(
        "limits.overspeed: expected a number from 1 to 8, so that NPCs can reach target speeds up to the speed limit"
    ):
        NpcLimits(overspeed=0.9)
    with raises(
        "speed_limit: expected at most 20.0 m/s, because NPCs can drive 2 times the limit, and highway-env's"
    ):
        Highway(limits=NpcLimits(overspeed=2))


@table(("env_id", "config", "message"), [
    ("highway-v0", {"lanes_count": 3_000_000}, "config.lanes_count: expected at most 20, so that "),
    ("exit-v0", {"controlled_vehicles": 10**9}, "config.controlled_vehicles: expected at most 10, so that "),
    ("roundabout-generic-v0", {"roundabout_radius": 10**5}, "config.roundabout_radius: expected at most 1000, "),
    ("merge-generic-v0", {"after_merge_length": 10**6}, "config.after_merge_length: expected at most 5000, so "),
    ("racetrack-oval-v0", {"length": 10**4}, "config.length: expected at most 2000, so that "),
    ("intersection-v0", {"simulation_frequency": 10**9}, "config.simulation_frequency: expected a whole number "),
    ("highway-v0", {"observation": {"type": "Kinematics", "vehicles_count": 10**9}},
     "config.observation.vehicles_count: expected at most 1000, so that "),
    ("highway-v0", {"observation": {"type": "OccupancyGrid", "grid_step": [1e-3, 1e-3]}},
     "config.observation.grid_step: expected at most 250,000 cells, received 3,025,000,000 cells"),
    ("highway-v0", {"observation": {"type": "GrayscaleObservation", "observation_shape": [10**6, 10**6],
                                    "stack_size": 4, "weights": [0.2, 0.6, 0.2]}},
     "config.observation.observation_shape: expected at most 2000, so that "),
    ("highway-v0", {"observation": {"type": "Kinematics", "vehicles_count": 1000, "features": ["x"] * 50_000}},
     "config.observation.features: expected at most 50 entries, so that "),
    ("highway-v0", {"observation": {"type": "OccupancyGrid", "features": "x" * 100_000}},
     "config.observation.features: expected at most 50 entries, so that "),
    ("highway-v0", {"observation": {"type": "OccupancyGrid", "grid_step": 0.001}},
     "config.observation.grid_step: expected at most 250,000 cells, received infinitely many cells"),
    ("highway-v0", {"observation": {"type": "OccupancyGrid", "grid_size": [[-math.inf, math.inf], [0, 1]]}},
     "config.observation.grid_step: expected at most 250,000 cells, received infinitely many cells"),
    ("highway-v0", {"observation": {"type": "OccupancyGrid", "grid_size": [[0, 0.1]] * 2, "grid_step": [1e-3] * 2}},
     "config.observation.grid_step: expected at least 0.05, so that "),
    ("highway-v0", {"observation": {"type": "GrayscaleObservation", "observation_shape": [84, 84], "stack_size": 4,
                                    "weights": [0.2, 0.6, 0.2], "scaling": 1e-5}},
     "config.observation.scaling: expected at least 0.01, so that "),
    ("highway-v0", {"observation": {"type": "GrayscaleObservation", "observation_shape": [84, 84], "stack_size": 4,
                                    "weights": [[0.1] * 5000] * 3}},
     "config.observation.weights: expected one number for each colour, so that "),
    ("highway-v0", {"observation": {"type": "GrayscaleObservation", "observation_shape": [2000, 2000],
                                    "stack_size": 100, "weights": [0.2, 0.6, 0.2]}},
     "config.observation: expected at most 10,000,000 numbers, received about 400,000,000. Use fewer features, "),
    ("highway-v0", {"observation": {"type": "GrayscaleObservation", "observation_shape": [500, 500, 500],
                                    "stack_size": 1, "weights": [0.2, 0.6, 0.2]}},
     "config.observation.observation_shape: expected at most 2 entries, so that "),
    ("two-way-v0", {"observation": {"type": "TimeToCollision", "horizon": 1000}, "policy_frequency": 1000,
                    "simulation_frequency": 1000}, "config.observation: expected at most 10,000,000 numbers, "),
    ("highway-v0", {"observation": {"type": "TupleObservation", "observation_configs": [
        {"type": "TupleObservation", "observation_configs": [{"type": "Kinematics"}] * 20}] * 20}},
     "config.observation: expected at most 10,000,000 numbers, "),
])  # fmt: skip
def test_very_slow_environment_is_refused_at_once(env_id, config, message):
    with raises(message):
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


@table("env_id", ["", None, 7, "my_module:highway-v0", ":", "os:system"])
def test_environment_id_with_module_is_refused_before_import(env_id):
    with raises(f"received {env_id!r}. First import the module that registers the environment"):
        World(env_id)


@pytest.mark.parametrize(
    "env_id",
    mostly_oracle(
        sorted(
            env_id
            for env_id, spec in gymnasium.registry.items()
            if "highway_env" in str(spec.entry_point)
        ),
        "highway-fast-v0",
        "intersection-multi-agent-v0",
        "lane-keeping-v0",
        "parking-v0",
    ),
)
def test_every_highway_env_environment_runs_or_says_why(env_id):
    world = World(env_id)
    if "multi-agent" in env_id:
        with raises("config.controlled_vehicles: expected 1, the ego, received 2"):
            world.check()
    elif env_id.startswith("parking"):
        with raises(
            f"{env_id}: expected an ego that starts in a lane and faces along it, because the grid"
        ):
            world.check()
    else:
        world.check()
        assert (world.start is None) == env_id.startswith("highway-")


def test_environment_does_not_change_highway_env_vehicle_classes():
    """intersection-v2 writes to the class IDMVehicle when it is made and whenever it is reset."""
    from highway_env.vehicle.behavior import IDMVehicle

    world = World("intersection-v2", duration=1.0)
    world.rollout(
        hold(2, speed=5.0, ego_lane=0, ego_speed=5.0, gene_seconds=1.0), lambda: IDMVehicle
    )
    assert (IDMVehicle.DISTANCE_WANTED, IDMVehicle.COMFORT_ACC_MAX, IDMVehicle.COMFORT_ACC_MIN) == (
        10.0,
        3.0,
        -5.0,
    )


def test_environment_of_another_library_is_refused():
    with raises(
        "highway-env's AbstractEnv, received 'CartPole-v1' (CartPoleEnv). Write a pafot.Simulator"
    ):
        World("CartPole-v1").check()


@table(
    ("env_id", "meant"),
    [("highway-v9", "highway-v0"), ("Merge-v1", "merge-v1"), ("round-about-v0", "roundabout-v0"), ("CartPole-v9", None),
     *((each, ...) for each in ("highway", "highway-v99", "Highway-v0", "nope-v0", "highway-v0 ", "MetaDrive-v0"))],
)  # fmt: skip
def test_unknown_environment_id_lists_the_straight_roads_and_suggests_one_that_a_world_accepts(
    env_id, meant
):
    with pytest.raises(WorldError) as caught:
        World(env_id).check()
    message = str(caught.value)
    roads = "highway-env's straight roads are in highway-fast-v0 and highway-v0. To use your own"
    assert f"received {env_id!r}. " in message
    assert roads in message
    assert (
        'write a pafot.Simulator, and use it in a pafot.SimulatorWorld (see the page "A simulator of your own")'
        in message
    )
    assert meant is ... or ("Did you mean" in message) == (meant is not None)
    assert not isinstance(meant, str) or f"Did you mean {meant!r}?" in message


@table(("config", "message"), [
    ([], "config: expected a dict of the environment's options, received []"),
    ({"lane_count": 3}, "config: expected options of highway-v0, received lane_count. Did you mean 'lanes_count'?"),
    ({"zebra": 3}, "config: expected options of highway-v0, received zebra. The options are action, centering_p"),
    ({1: 2}, "config: expected strings as keys, received 1"),
    ({"action": {"target_speeds": object}}, "config.action.target_speeds: expected JSON-compatible data, received"),
    ({"observation": {"type": "Nope"}}, "raised ValueError: Unknown observation type"),
    ({"action": {}}, "raised KeyError: 'type'"),
    ({"lanes_count": 0}, "config: expected a configuration that the environment highway-v0 accepts, received"),
    ({"simulation_frequency": 15.5}, "config.simulation_frequency: expected a whole number from 5 to 1000"),
    ({"policy_frequency": 0}, "config.policy_frequency: expected a whole number from 1 to 1000, received 0"),
    ({"duration": -1}, "config.duration: expected a number from 0.0666667 to 3600, received -1"),
    ({"duration": 300}, "duration: expected at most 240 s on a road of 10000 m, received 300"),
    ({"controlled_vehicles": 2}, "config.controlled_vehicles: expected 1, the ego, received 2"),
    ({"manual_control": True}, "config.manual_control: expected False, because the policy drives, received True"),
    ({"collision_reward": "-1"}, "config.collision_reward: expected a number such as -1, received '-1'"),
    ({"observation": {"type": "Kinematics", "vehicle_count": 7}},
     "config.observation: expected a highway-env option, received vehicle_count. Did you mean 'v"),
    ({"observation": {"type": "Kinematics", "normalise": False}}, "Did you mean 'normalize'?"),
    ({"observation": {"type": "MultiAgentObservation", "observation_config": {"type": "Kinematics", "oder": ""}}},
     "config.observation.observation_config: expected a highway-env option, received oder. Did you"),
    ({"observation": {"type": "TupleObservation", "observation_configs": [{"type": "Kinematics", "clips": True}]}},
     "config.observation.observation_configs[0]: expected a highway-env option, received clips. Did you"),
    ({"observation": {"type": "Kinematics", "zebra": 7}}, "received zebra. The options are absolute, align_to"),
    ({"action": {"type": "DiscreteMetaAction", "target_speed": [10, 20]}},
     "config.action: expected a highway-env option, received target_speed. Did you mean 'target_speeds'?"),
    ({"action": {"type": "MultiAgentAction", "action_config": {"type": "ContinuousAction", "laterl": True}}},
     "config.action.action_config: expected a highway-env option, received laterl. Did you mean 'l"),
])  # fmt: skip
def test_wrong_configuration_is_named_with_what_was_expected(config, message):
    with raises(message):
        World("highway-v0", config=config).check()


def test_custom_observations_and_environments_define_own_options(register, monkeypatch):
    class Own(highway_env.envs.HighwayEnv):
        @classmethod
        def default_config(cls):
            return {
                **super().default_config(),
                "observation": {"type": "Kinematics", "seen_from": "above"},
            }

    class Sight(observation.KinematicObservation):
        pass

    register("own-sight-v0", entry_point=Own)
    World(
        "own-sight-v0", config={"observation": {"type": "Kinematics", "seen_from": "below"}}
    ).check()
    monkeypatch.setattr(abstract, "observation_factory", lambda env, config: Sight(env))
    World("highway-v0", config={"observation": {"type": "Sight", "zebra": 1}}).check()


def test_an_action_for_several_vehicles_has_no_ego():
    config = {
        "action": {"type": "MultiAgentAction", "action_config": {"type": "DiscreteMetaAction"}}
    }
    with raises(
        "config.action: expected a discrete or continuous action space for one vehicle, received Tuple"
    ):
        World("highway-v0", config=config).rollout(hold(1), lambda: lambda observation: (1,))


@table(("options", "message"), [
    ({"duration": 0}, "duration: expected a number from 0.1 to 3600, received 0"),
    ({"duration": 0.1}, "duration: expected a number from 0.2 to 3600, received 0.1"),
    ({"duration": 3600, "config": {"simulation_frequency": 1000, "policy_frequency": 1}},
     "duration: expected at most 400 s at 1000 ticks per second, received 3600"),
    ({"clearance": None}, "clearance: expected a number from 0 to 50, received None"),
    ({"headway": -0.1}, "headway: expected a number from 0 to 10, received -0.1"),
])  # fmt: skip
def test_wrong_gym_world_option_is_named_with_bounds(options, message):
    with raises(message):
        World("highway-fast-v0", **options).check()


def test_the_callers_configuration_is_neither_changed_nor_followed():
    config = {
        "action": {"type": "DiscreteMetaAction", "target_speeds": np.array([10.0, 20.0])},
        "lanes_count": 3,
    }
    world = World("highway-v0", config=config)
    config["lanes_count"] = 6
    config["action"]["type"] = "Nope"
    assert world.lanes == 3
    world.rollout(hold(1), lambda: lambda observation: 1)
    assert set(config) == {"action", "lanes_count"}


@table(("scenario", "message"), [
    (None, "scenario: expected a Scenario, received None"),
    (hold(1, ego_lane=4), "ego_lane: expected a lane from 0 to 3, received 4. The road has 4 lanes"),
    (hold(*range(1, 7), ego_lane=0), "npcs: expected at most 5 NPCs, one for each cell around lane 0"),
    (hold(1, ego_speed=33.5), "ego_speed: expected at most "),
    (hold(1, gene_seconds=0.15), "gene_seconds: expected a whole number of ticks of 1/15 s, received 0.15. The"),
    # less than the top speed
    (hold(1, speed=30.5), "npcs[0][0].speed: expected at most the speed limit of "),
])  # fmt: skip
@table("world", [Highway(), World("highway-v0")])
def test_unfitting_scenario_is_refused_with_its_field(world, scenario, message):
    with raises(message, ScenarioError):
        world.rollout(scenario, constant_speed)


def test_nearest_gene_duration_from_error_is_accepted():
    with pytest.raises(ScenarioError) as caught:
        Highway().rollout(hold(1, gene_seconds=0.15), constant_speed)
    nearest = float(str(caught.value).rsplit(" ", 2)[1])
    assert Highway().rollout(hold(1, gene_seconds=nearest), constant_speed).ticks == round(
        nearest * 15
    )


def test_the_worlds_are_frozen_values():
    assert Highway(lanes=5) == Highway(lanes=5) != Highway()
    assert World("highway-v0", config={"lanes_count": 3}) == World(
        "highway-v0", config={"lanes_count": 3}
    )
    assert {hash(Highway(lanes=5)), hash(Highway(lanes=5))} == {hash(Highway(lanes=5))}
    for world in (Highway(), World("highway-v0")):
        with pytest.raises(AttributeError):
            world.headway = 3.0
