"""Worlds as plain data: what a corpus file may contain, and what not."""

import json
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot import Highway, NpcLimits, PositionInstruction, Scenario, VehicleType, World
from pytest_pafot.model.vehicle_type import CAR, TRUCK, VAN
from pytest_pafot.world import from_dict
from pytest_pafot.world.codec import describe_limits, describe_world_change, world_of_file
from tests.helpers.refusals import refused
from tests.helpers.tables import table

POSITIVE = dict.fromkeys(("acceleration", "braking", "jerk", "lateral_acceleration"), st.floats(0.1, 20))  # fmt: skip
limits = st.builds(NpcLimits, **POSITIVE, overspeed=st.floats(1, 1.4), heading=st.floats(0.01, 0.78))  # fmt: skip
shared = {
    "clearance": st.floats(0, 50),
    "headway": st.floats(0, 10),
    "limits": limits,
    "hang_limit": st.floats(0.01, 1000),
    "ego": st.sampled_from([CAR, TRUCK, VehicleType(name="bus", length=11, width=2.5, braking=6)]),
}
highways = st.tuples(st.integers(1, 20), st.integers(5, 50)).flatmap(
    lambda hz: st.builds(
        Highway, lanes=st.integers(3, 6), speed_limit=st.floats(5, 28), physics_hz=st.just(hz[0] * hz[1]),
        ads_hz=st.just(hz[0]), duration=st.one_of(st.integers(1, 400), st.floats(1, 400)), **shared,
    )
)  # fmt: skip
options = {
    "lanes_count": st.integers(3, 6),
    "duration": st.integers(1, 60),
    "scaling": st.floats(0.1, 10),
    "action": st.just({"type": "DiscreteMetaAction", "target_speeds": [0, 10, 20]}),
    "initial_lane_id": st.none() | st.integers(0, 2),
}
gyms = st.builds(
    World, st.sampled_from(["highway-v0", "highway-fast-v0"]),
    config=st.none() | st.fixed_dictionaries({}, optional=options), duration=st.none() | st.floats(0.2, 60), **shared,
)  # fmt: skip


@given(highways | gyms)
def test_world_read_from_its_data_is_the_same(world):
    data = world.to_dict()
    written = json.dumps(data)
    assert json.loads(written) == data, "the data is plain"
    again = from_dict(json.loads(written))
    assert type(again) is type(world)
    assert again.rules == world.rules
    assert again.to_dict() == data


GYM = {"kind": "gym", "env_id": "highway-v0"}


GYM = {"kind": "gym", "env_id": "highway-v0"}


def test_fields_that_are_missing_have_their_defaults_and_no_ego_is_a_car():
    assert from_dict({"kind": "highway"}) == Highway()
    assert from_dict(GYM) == World("highway-v0")
    limited = from_dict({"kind": "highway", "limits": {"jerk": 5}})
    assert limited == Highway(limits=NpcLimits(jerk=5))
    assert "ego" not in Highway().to_dict() | World("highway-v0", ego="car").to_dict()
    assert Highway(ego=TRUCK).to_dict()["ego"] == "truck"
    assert from_dict({**GYM, "ego": "van"}) == World("highway-v0", ego=VAN)
    from_dict({"kind": "gym", "env_id": "not-registered-v0"})  # makes no environment


def test_reading_and_writing_leave_the_data_unchanged():
    data = {**GYM, "config": {"centering_position": [0.1, 0.2]}, "limits": {"jerk": 5.0}}
    text = json.dumps(data)
    world = from_dict(data)
    world.to_dict()["config"]["centering_position"].append(3)
    assert json.dumps(data) == text
    assert world.config == {"centering_position": [0.1, 0.2]}


def test_tuples_and_arrays_become_lists_with_equal_meaning():
    shown = {"type": "GrayscaleObservation", "stack_size": 2, "observation_shape": (32, 16)}
    shown["weights"] = np.array([0.25, 0.5, 0.25])
    action = {"type": "ContinuousAction", "acceleration_range": (-3, 3)}
    world = World("highway-v0", config={"action": action, "observation": shown})
    assert world.config["observation"]["observation_shape"] == [32, 16]
    assert world.config["observation"]["weights"] == [0.25, 0.5, 0.25]
    env = from_dict(json.loads(json.dumps(world.to_dict()))).make().unwrapped
    assert env.observation_space.shape == (2, 32, 16)


SLOW = {"name": "slow", "length": 9, "width": 2, "braking": 5}
FAULTY = {
    "no mapping": (None, "world"),
    "nothing": ({}, "world.kind"),
    "another kind": ({"kind": "carla"}, "world.kind"),
    **{f"a kind from code: {kind}": ({"kind": kind, "data": {"lanes": 3}}, "world.kind")
       for kind in ("rings", "tests.world.test_codec:Ring", "os:system", "", None)},
    "a simulator without data": ({"kind": "sumo"}, "world (kind sumo)"),
    "a simulator with fields": ({"kind": "sumo", "lanes": 3}, "world (kind sumo)"),
    "an unknown ego": ({"kind": "highway", "ego": "tram"}, ""),
    "an ego with weak brakes": ({"kind": "highway", "ego": SLOW}, "ego"),
    "wrappers": ({**GYM, "wrappers": ["FlattenObservation"]}, "world.wrappers"),
    "an unknown field": ({"kind": "highway", "lane": 3}, "world (kind highway)"),
    "too many lanes": ({"kind": "highway", "lanes": 9}, "lanes"),
    "a number as limits": ({"kind": "highway", "limits": 5}, "world.limits"),
    "an unknown limit": ({"kind": "highway", "limits": {"yerk": 5}}, "world.limits"),
    "a text as a limit": ({"kind": "highway", "limits": {"jerk": "x"}}, "limits.jerk"),
    "no environment": ({"kind": "gym"}, ""),
    "an environment from code": ({"kind": "gym", "env_id": "os:system"}, "env_id"),
    "a list as a configuration": ({**GYM, "config": []}, "config"),
}  # fmt: skip


@table(("data", "field"), FAULTY.values())
def test_faulty_data_is_refused_with_its_place(data, field):
    with refused(field):
        from_dict(data)


CODE = ["os.system", "antigravity.fly", "highway_env.vehicle", "highway_env_evil.vehicle.X"]


def gym_with(vehicle_class):
    return from_dict({**GYM, "config": {"other_vehicles_type": vehicle_class}})


@table("path", [*CODE, 3, None, CODE[:1]])
def test_file_may_not_name_code_outside_highway_env(path):
    before = set(sys.modules)
    with refused("world.config.other_vehicles_type"):
        gym_with(path)
    assert set(sys.modules) == before


def test_file_may_name_highway_env_vehicle_classes():
    world, seen = gym_with("highway_env.vehicle.behavior.AggressiveVehicle"), []

    def looking(env):
        return lambda _: seen.append(type(env.road.vehicles[1]).__name__) or 1

    world.rollout(Scenario(npcs=[[PositionInstruction(1, 20.0)]], gene_seconds=1.0), looking)
    assert seen == ["AggressiveVehicle"]


SIX_GENES = Scenario(npcs=((PositionInstruction(1, 20.0),) * 6,))
"""A scenario of a minute, if the world allows such a length."""


def test_file_cannot_exceed_time_limits_of_the_test():
    data = Highway(duration=60.0, hang_limit=86400.0).to_dict()
    own = Highway(duration=20.0, hang_limit=5.0)
    assert world_of_file(data, SIX_GENES, own) == Highway(duration=20.0, hang_limit=5.0)
    assert len(describe_limits(data, SIX_GENES, own)) == 1
    assert world_of_file(data, SIX_GENES).hang_limit == 600.0
    fast = Highway(duration=60.0, physics_hz=1000).to_dict()
    assert world_of_file(fast, SIX_GENES, own).duration == pytest.approx(20 * 15 / 1000)


def test_file_within_limits_of_the_test_is_unchanged():
    short = Scenario(npcs=((PositionInstruction(1, 20.0),) * 2,))
    data = Highway(duration=60.0, hang_limit=5.0).to_dict()
    for limits_ in (
        {"duration": 20.0},
        {"duration": 60.0, "hang_limit": 5.0},
        {"duration": 3600.0},
    ):
        own = Highway(**limits_)
        assert world_of_file(data, short, own) == Highway(duration=60.0, hang_limit=5.0)
        assert describe_limits(data, short, own) == []


@table("config", [
    {"simulation_frequency": 1000, "policy_frequency": 1, "duration": 400}, {"duration": 10**400}, {}, None,
])  # fmt: skip
def test_gym_world_is_cut_before_environment_is_made(config):
    world = world_of_file(
        {**GYM, "config": config, "duration": None}, SIX_GENES, Highway(duration=20.0)
    )
    ticks = (config or {}).get("simulation_frequency", 15)
    assert world.duration == pytest.approx(20 * 15 / ticks, rel=1e-9)
    assert "environment" not in vars(world)


def test_duration_that_the_road_cuts_is_no_change():
    own = World("intersection-v0", planner_hz=5, config={"destination": "o1", "duration": 20})
    data = own.to_dict()
    assert (data["duration"], own.longest_run < 20.0) == (20.0, True)
    assert describe_limits(data, SIX_GENES, own) == []
    assert describe_world_change(data, SIX_GENES, own) == []
    assert describe_limits({**data, "duration": 25.0}, SIX_GENES, own)
