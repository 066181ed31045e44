"""A planner that names a lane, and a speed or an acceleration, is driven there as highway-env's vehicles drive."""

from __future__ import annotations

import math
import random
import re
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from highway_env.vehicle.controller import ControlledVehicle

from pytest_pafot import Drive, Highway, PositionInstruction, Scenario, World
from pytest_pafot.campaign.setup_fault import unit_doubt
from pytest_pafot.model.trace import ACCELERATION, OFFSET, SPEED, STEERING, Outcome, Y
from pytest_pafot.world.engines.selection import rollout_planner
from tests.helpers.c_library import c_library
from tests.helpers.engine_cases import Case, differences
from tests.helpers.tables import table

BEHIND = Scenario(npcs=[[PositionInstruction(6, 15.0)]], gene_seconds=8.0)


def always(action):
    return lambda: lambda observation: action


def changing(seed):
    """Lanes, speeds, accelerations and pairs in turn."""

    def factory():
        rng = random.Random(seed)

        def drive(observation):
            lane = rng.randrange(observation.lanes)
            drives = Drive(lane=lane, speed=rng.uniform(0, 40)), Drive(lane=lane, acceleration=rng.uniform(-12, 8))
            return rng.choice([*drives, (rng.uniform(-3, 2), rng.uniform(-0.1, 0.1))])

        return drive

    return factory


@table("seed", range(12))
def test_both_engines_drive_to_lanes_the_same_to_the_last_bit(seed):
    case = replace(Case.random(seed), ego=changing(seed))
    assert differences(case.run("kernel"), case.run("highway-env")) == []


def test_env_step_of_highway_env_drives_to_lanes_the_same():
    for seed in range(4):
        case = replace(Case.random(seed), ego=changing(seed))
        fast, stock = case.run("kernel"), case.world.rollout_in_gym(case.scenario, case.ego)
        assert (fast.outcome, fast.actions) == (stock.outcome, stock.actions)
        assert abs(fast.states[..., :2] - stock.states[..., :2]).max() < 0.01


class ToLane2At25(ControlledVehicle):
    """highway-env's own controllers, with a goal."""

    def act(self, action=None):
        self.target_lane_index = (*self.lane_index[:2], 2)
        self.target_speed = 25.0
        super().act()


def test_the_controllers_are_those_of_highway_envs_controlled_vehicles():
    world = Highway(duration=8.0)
    with c_library():
        stock = world.rollout(BEHIND, ToLane2At25)
    mine = world.rollout(BEHIND, always(Drive(lane=2, speed=25.0)))
    assert np.array_equal(mine.states, stock.states)


def test_a_lane_is_reached_within_three_seconds_and_kept_at_the_speed_that_is_wanted():
    ego = Highway(duration=8.0).rollout(BEHIND, always(Drive(lane=np.int64(2), speed=25))).ego
    assert abs(ego[0, Y] - 8.0) == 4.0
    assert abs(ego[45:, Y] - 8.0).max() < 0.2
    assert abs(ego[-1, SPEED] - 25.0) < 0.01


@table("lane", [2.0, np.float32(2), np.int64(2), Fraction(2)])
def test_a_lane_is_a_whole_number_of_any_kind(lane):
    (action, *_) = Highway(duration=1.0).rollout(BEHIND, always(Drive(lane=lane, speed=25.0))).actions
    assert (action, type(action.lane)) == (Drive(lane=2, speed=25.0), int)


def test_an_acceleration_is_held_as_far_as_it_has_an_effect_and_never_into_reverse():
    trace = Highway(duration=8.0).rollout(BEHIND, always(Drive(lane=1, acceleration=-20.0)))
    assert trace.ego[1, ACCELERATION] == -9.81
    assert trace.ego[:, SPEED].min() == trace.ego[-1, SPEED] == 0.0
    assert set(trace.actions) == {Drive(lane=1, acceleration=-20.0)}


def test_a_pair_after_a_drive_is_held_as_any_pair():
    actions = [Drive(lane=2, speed=25.0), (0.5, 0.01)]
    ego = Highway(duration=2.0).rollout(BEHIND, lambda: lambda seen: actions[seen.time > 1.0]).ego
    assert len(set(ego[4:16, STEERING].tolist())) == 12, "steers anew in every tick"
    assert set(ego[-9:, STEERING].tolist()) == {0.01}
    assert set(ego[-9:, ACCELERATION].tolist()) == {0.5}


@table(
    ("drive", "said"),
    [
        (Drive(lane=4, speed=20.0), "a lane from 0, at the left, to 3"),
        (Drive(lane=-1, speed=20.0), "a lane from 0, at the left, to 3"),
        (Drive(lane=10**30, speed=20.0), "a lane from 0, at the left, to 3"),
        (Drive(lane=1), r"either a speed \[m/s\] or an acceleration \[m/s\^2\]"),
        (Drive(lane=1, speed=20.0, acceleration=0.0), "either a speed"),
        (Drive(lane=1, speed=-0.1), "a speed of at least 0 m/s"),
        (Drive(lane=1, speed=math.nan), "finite numbers"),
        (Drive(lane=1, acceleration=math.inf), "finite numbers"),
        (Drive(lane=1.5, speed=20.0), "numbers, that of the lane a whole one"),
        (Drive(lane=True, speed=20.0), "numbers, that of the lane a whole one"),
        (Drive(lane=None, speed=20.0), "numbers, that of the lane a whole one"),
        (Drive(lane=1, speed="20"), "numbers, that of the lane a whole one"),
        (Drive(lane=1, acceleration=10**400), "numbers, that of the lane a whole one"),
    ],
)
@table("engine", ["kernel", "highway-env"])
def test_a_drive_that_says_nothing_or_where_there_is_no_lane_is_a_bad_action(drive, said, engine):
    error = Highway(engine=engine).rollout(BEHIND, always(drive)).error
    assert error.kind == "BadAction"
    assert re.match(f"expected pafot.Drive with {said}.*, received Drive", error.message)


def test_policies_of_an_environment_answer_in_its_own_actions():
    error = World("highway-v0").rollout(BEHIND, always(Drive(lane=1, speed=20.0))).error
    assert error.kind == "BadAction"
    assert error.message.endswith(
        "; pafot.Drive is for planners in SI units, which drive in pafot.Highway, that is without world="
    )


def test_speeds_in_kilometres_an_hour_are_doubted():
    trace = Highway(duration=1.0).rollout(BEHIND, always(Drive(lane=1, speed=90.0)))
    assert unit_doubt(trace).startswith("the ADS asked for a speed of 90, in m/s")
    assert unit_doubt(Highway(duration=1.0).rollout(BEHIND, always(Drive(lane=1, speed=25.0)))) == ""


class Weaving:
    """Decides for many runs at once, with lanes for some and pairs for others."""

    def __call__(self, seen):
        lane = int(seen.time) % seen.lanes
        return (0.1, 0.0) if len(seen.others) == 2 else Drive(lane=lane, speed=24.0)

    def batch(self, observations):
        return tuple(map(self, observations))


def test_batches_may_answer_with_drives_and_pairs_in_any_order():
    world, two = Highway(duration=6.0), replace(BEHIND, npcs=[*BEHIND.npcs, [PositionInstruction(2, 20.0)]])
    together = world.rollout_batch([BEHIND, two, BEHIND], Weaving)
    assert [differences(a, world.rollout(a.scenario, Weaving)) for a in together] == [[], [], []]


def test_decisions_that_were_recorded_are_driven_again():
    world = Highway(duration=6.0)
    trace = world.rollout(BEHIND, Weaving)
    again = world.rollout(BEHIND, lambda: Weaving().__call__, decisions=trace.actions[:20])
    assert differences(trace, again) == []


# --- on roads that bend, which a planner sees as if they were straight


def driven_on(env_id, action, seconds=6.0):
    world = World(env_id, duration=seconds)
    lane, speed = world.start
    scenario = Scenario(npcs=[[PositionInstruction(6, 1.0)]], ego_lane=lane, ego_speed=speed, gene_seconds=seconds)
    rules = replace(world.rules, ads_hz=world.rules.physics_hz)
    return world, rollout_planner(world, rules, scenario, action)


@pytest.mark.parametrize("env_id", ["roundabout-v0", "racetrack-v0"])
def test_a_lane_that_bends_is_kept(env_id):
    _, trace = driven_on(env_id, lambda seen: Drive(lane=seen.ego.lane, speed=12.0), 12.0)
    assert trace.outcome in (Outcome.SAFE, Outcome.END_OF_ROAD)
    turned = abs(np.diff(np.unwrap(trace.ego[:, 2]))).sum()
    assert turned > 0.3, "it did bend"
    assert abs(trace.track[:, 0, OFFSET]).max() < 0.6


def test_another_lane_of_a_bend_is_driven_to():
    seen = []
    _, trace = driven_on("racetrack-v0", lambda now: seen.append(now) or Drive(lane=int(now.time < 4), speed=9.0), 9.0)
    assert trace.outcome is Outcome.SAFE
    kept = [abs(now.ego.y - now.lane_centres[now.time < 4]) for now in seen if now.time % 4 > 3]
    assert max(kept) < 0.4


def test_a_lane_that_is_not_there_yet_or_any_more_is_a_bad_action():
    world, trace = driven_on("merge-v0", lambda seen: Drive(lane=2, speed=20.0))
    assert world.lanes == 3
    assert trace.error.message.startswith("expected pafot.Drive with a lane that exists at ")
