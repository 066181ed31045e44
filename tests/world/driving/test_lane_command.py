"""A planner that names a lane, and a speed or an acceleration: the vehicle drives there as a car does."""

import itertools
import math
import random
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from highway_env.vehicle.controller import ControlledVehicle
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot import Highway, LaneCommand, PositionInstruction, Scenario, World
from pytest_pafot.model.trace import ACCELERATION, HEADING, OFFSET, SPEED, STEERING, Outcome, X, Y
from pytest_pafot.searches.harness import unit_doubt
from tests.helpers.c_library import c_library
from tests.helpers.run_cases import Case, differences
from tests.helpers.tables import table
from tests.world.driving.test_ads import always

BEHIND = Scenario(npcs=[[PositionInstruction(6, 15.0)]], gene_seconds=8.0)


def changing(seed):
    """Return a factory of planners that answer lanes, speeds, accelerations and pairs in turn."""

    def factory():
        rng = random.Random(seed)

        def drive(observation):
            lane, limits = rng.randrange(observation.lanes), {}
            if rng.random() < 0.3:
                limits["lateral_acceleration"] = rng.uniform(0.1, 9.0)
                limits["lateral_jerk"] = rng.uniform(0.1, 50.0)
            drives = (
                LaneCommand(lane=lane, speed=rng.uniform(0, 40), **limits),
                LaneCommand(lane=lane, acceleration=rng.uniform(-12, 8), **limits),
            )
            return rng.choice([*drives, (rng.uniform(-3, 2), rng.uniform(-0.1, 0.1))])

        return drive

    return factory


@table("seed", range(12))
def test_env_step_drives_to_lanes_identically(seed):
    case = replace(Case.random(seed), ego=changing(seed))
    with c_library():
        assert differences(case.run(), case.run_in_gym()) == []


class ToSpeed25(ControlledVehicle):
    def act(self, action=None):
        self.target_speed = 25.0
        super().act()


def test_speed_follows_controller_of_highway_env_vehicles():
    world = Highway(duration=8.0)
    with c_library():
        stock = world.rollout(BEHIND, ToSpeed25)
    mine = world.rollout(BEHIND, always(LaneCommand(lane=1, speed=25.0)))
    assert np.array_equal(mine.states, stock.states)


# --- lane changes under limits, measured by where the car is


def alone(decide, *, speed, seconds, physics_hz=15, ads_hz=15):
    """Return the run of an ego in lane 1 of 4, with an NPC that falls behind."""
    world = Highway(duration=seconds, speed_limit=36.0, physics_hz=physics_hz, ads_hz=ads_hz)
    npcs = [[PositionInstruction(6, 0.0)]]
    scenario = Scenario(npcs=npcs, ego_lane=1, ego_speed=speed, gene_seconds=seconds)
    return world.rollout(scenario, lambda: decide)


def to_lane_2(speed, **limits):
    return lambda seen: LaneCommand(lane=2, speed=speed, **limits)


def pulls(trace):
    """Return lateral accelerations by the centre's path and by the body's turning [m/s^2], 0 before the start."""
    hz, ego = trace.physics_hz, trace.ego
    along, across = np.diff(ego[:, [X, Y]].T) * hz
    speed = np.hypot(along, across)
    course = np.where(speed > 1e-9, np.arctan2(across, along), 0.0)
    moves = (speed > 1e-9) & np.append(True, speed[:-1] > 1e-9)
    by_way = np.where(moves, np.diff(np.unwrap(course), prepend=0.0) * hz * speed, 0.0)
    by_body = np.diff(ego[:, HEADING]) * hz * ego[:-1, SPEED]
    return np.array([np.append(0.0, by_way), np.append(0.0, by_body)])


HZ = [(15, 1), (15, 3), (15, 15), (12, 4), (20, 10), (30, 5), (5, 1)]
lanes, frequencies = st.integers(0, 3), st.sampled_from(HZ)
limits = st.builds(
    lambda most, jerk: {"lateral_acceleration": most, "lateral_jerk": jerk},
    st.sampled_from([0.5, 1.0, 3.0, 4.0]),
    st.sampled_from([1.0, 5.0, 20.0]),
)
goals = st.lists(st.tuples(lanes, st.floats(0, 40)), min_size=5, max_size=5)


@given(goals, st.floats(0, 39), frequencies, limits)
def test_no_turn_is_sharper_than_the_limit(goals, speed, frequency, limits):
    physics_hz, ads_hz = frequency

    def decide(seen):
        lane, speed = goals[int(seen.time / 2.3) % 5]
        return LaneCommand(lane=lane, speed=speed, **limits)

    trace = alone(decide, speed=speed, seconds=20.0, physics_hz=physics_hz, ads_hz=ads_hz)
    # more than 1 at full throttle alone
    assert abs(pulls(trace)).max() <= 1.05 * limits["lateral_acceleration"]


@given(goals, st.floats(0.5, 3.0), st.floats(1, 39), frequencies, limits)
def test_lateral_acceleration_changes_within_limit_at_constant_speed(
    goals, every, speed, frequency, limits
):
    physics_hz, ads_hz = frequency

    def decide(seen):
        return LaneCommand(lane=goals[int(seen.time / every) % 5][0], speed=speed, **limits)

    trace = alone(decide, speed=speed, seconds=20.0, physics_hz=physics_hz, ads_hz=ads_hz)
    assert abs(np.diff(pulls(trace)) * physics_hz).max() <= limits["lateral_jerk"]


@table(("speed", "seconds"),
       [(2.0, 7.5), (5.0, 4.5), (7.0, 4.0), (10.0, 4.0), (20.0, 4.0), (30.0, 4.0), (39.0, 4.0)])  # fmt: skip
@table("physics_hz", [5, 15, 60])
def test_next_lane_is_reached_in_time_without_overshoot(speed, seconds, physics_hz):
    rates = {"physics_hz": physics_hz, "ads_hz": 5}
    y = alone(to_lane_2(speed), speed=speed, seconds=12.0, **rates).ego[:, Y]
    assert abs(y[round(seconds * physics_hz) :] - 8.0).max() < 0.2
    assert y.max() < 8.01
    assert y[physics_hz // 5] - 4.0 < 0.05, "after 0.2 s it has hardly begun"


@given(st.floats(0.1, 4.0), st.floats(3, 39), st.sampled_from([5, 15, 30]), limits)
def test_lane_change_back_does_not_overshoot_either_lane(turns, speed, physics_hz, limits):
    def decide(seen):
        return LaneCommand(lane=2 if seen.time < turns else 1, speed=speed, **limits)

    y = alone(decide, speed=speed, seconds=40.0, physics_hz=physics_hz, ads_hz=5).ego[:, Y]
    assert y.max() < 8.01
    assert y.min() > 3.99
    assert abs(y[-1] - 4.0) < 0.01


@table("speed", [0.0, 1.0, 10.0, 30.0])
def test_lane_change_does_not_depend_on_decision_rate(speed):
    ads = to_lane_2(speed)
    runs = [alone(ads, speed=speed, seconds=6.0, ads_hz=hz).states for hz in (1, 3, 5, 15)]
    assert all(np.array_equal(runs[0], run) for run in runs)


def test_standing_car_changes_lanes_once_it_moves():
    def decide(seen):
        return LaneCommand(lane=2, speed=0.0 if seen.time < 3.0 else 15.0)

    trace = alone(decide, speed=0.0, seconds=12.0)
    stands, last = trace.ego[:46], trace.ego[-1]
    assert (stands[:, [X, Y, HEADING, SPEED]] == stands[0, [X, Y, HEADING, SPEED]]).all()
    assert abs(last[Y] - 8.0) < 0.1


@table(("angle", "speed"), [(0.7, 1.0), (-0.7, 8.0), (-0.1, 15.0), (0.03, 25.0), (0.1, 25.0)])
def test_drive_takes_over_from_any_steering(angle, speed):
    def decide(seen):
        return (0.0, angle) if seen.time < 1.0 else LaneCommand(lane=1, speed=speed)

    trace = alone(decide, speed=speed, seconds=60.0)
    assert abs(pulls(trace)[0, 18:]).max() <= 2.5
    last = trace.ego[-1]
    assert (abs(last[Y] - 4.0), abs(math.remainder(last[HEADING], math.tau))) < (0.05, 0.01)


def seconds_to_next_lane(*, speed=25.0, **limits):
    y = alone(to_lane_2(speed, **limits), speed=speed, seconds=15.0).ego[:, Y]
    return np.flatnonzero(abs(y - 8.0) > 0.2).max() / 15


@table("speed", [10.0, 25.0])
@table("jerk", [0.1, 0.5, 3.0, 20.0])
def test_larger_acceleration_limit_never_slows_lane_change(speed, jerk):
    """The jerk limit decides then: a change of 4 m under a jerk j takes at least (32 * 4 / j)^(1/3) seconds."""
    limits = (0.5, 1.0, 2.5, 5.0, 10.0, 100.0)
    given = {"speed": speed, "lateral_jerk": jerk}
    times = [seconds_to_next_lane(**given, lateral_acceleration=most) for most in limits]
    assert all(later < 1.05 * sooner for sooner, later in itertools.pairwise(times))
    assert times[-1] < 1.25 * max((128.0 / jerk) ** (1 / 3), 1.9)


@table("lane", [2.0, np.float32(2), np.int64(2), Fraction(2)])
def test_lane_may_be_any_whole_number_type(lane):
    ads = always(LaneCommand(lane=lane, speed=25.0))
    (action, *_) = Highway(duration=1.0).rollout(BEHIND, ads).actions
    assert (action, type(action.lane)) == (LaneCommand(lane=2, speed=25.0), int)


def test_acceleration_is_limited_and_never_reverses():
    trace = Highway(duration=8.0).rollout(BEHIND, always(LaneCommand(lane=1, acceleration=-20.0)))
    assert trace.ego[1, ACCELERATION] == -9.81
    assert trace.ego[:, SPEED].min() == trace.ego[-1, SPEED] == 0.0
    assert set(trace.actions) == {LaneCommand(lane=1, acceleration=-20.0)}


def test_pair_after_a_drive_is_held_as_usual():
    actions = [LaneCommand(lane=2, speed=25.0), (0.5, 0.01)]
    ego = Highway(duration=2.0).rollout(BEHIND, lambda: lambda seen: actions[seen.time > 1.0]).ego
    assert len(set(ego[4:16, STEERING].tolist())) == 12, "steers anew in every tick"
    assert set(ego[-9:, STEERING].tolist()) == {0.01}
    assert set(ego[-9:, ACCELERATION].tolist()) == {0.5}


IN_LANE = {"lane": 1, "speed": 20.0}
BAD = {
    "a lane beyond the last": {"lane": 4, "speed": 20.0},
    "a negative lane": {"lane": -1, "speed": 20.0},
    "no speed": {"lane": 1},
    "a speed and an acceleration": {**IN_LANE, "acceleration": 0.0},
    "a negative speed": {"lane": 1, "speed": -0.1},
    "no number": {"lane": 1, "speed": math.nan},
    "half a lane": {"lane": 1.5, "speed": 20.0},
    "a truth value as a lane": {"lane": True, "speed": 20.0},
    "a text as a speed": {"lane": 1, "speed": "20"},
    "no lateral acceleration": {**IN_LANE, "lateral_acceleration": 0.0},
    "a lateral acceleration that is no number": {**IN_LANE, "lateral_acceleration": math.nan},
    "a negative jerk": {**IN_LANE, "lateral_jerk": -5.0},
}


def error_of(given, world=Highway()):  # noqa: B008  (a frozen value)
    return world.rollout(BEHIND, always(LaneCommand(**given))).error


def error_of_missing_lane():
    return driven_on("merge-v0", lambda seen: LaneCommand(lane=2, speed=20.0)).error


def test_empty_drive_or_missing_lane_or_one_in_an_environment_is_bad_action():
    errors = [*map(error_of, BAD.values()), error_of(IN_LANE, World("highway-v0"))]
    assert {error.kind for error in errors} == {"BadAction"}
    assert World("merge-v0").lanes == 3
    assert error_of_missing_lane().kind == "BadAction", "at that moment"


def doubt_at(speed):
    trace = Highway(duration=1.0).rollout(BEHIND, always(LaneCommand(lane=1, speed=speed)))
    return unit_doubt(trace)


def test_speeds_in_kilometres_an_hour_are_doubted():
    assert doubt_at(90.0)
    assert doubt_at(25.0) == ""


# --- on roads that bend, which a planner sees as if they were straight


def driven_on(env_id, action, seconds=6.0):
    world, npcs = World(env_id, duration=seconds, planner_hz=15), [[PositionInstruction(6, 1.0)]]
    lane, speed = world.start
    scenario = Scenario(npcs=npcs, ego_lane=lane, ego_speed=speed, gene_seconds=seconds)
    return world.rollout(scenario, lambda: action)


@pytest.mark.parametrize("env_id", ["roundabout-v0", "racetrack-v0"])
def test_a_lane_that_bends_is_kept(env_id):
    trace = driven_on(env_id, lambda seen: LaneCommand(lane=seen.ego.lane, speed=12.0), 12.0)
    assert trace.outcome in (Outcome.COMPLETED, Outcome.END_OF_ROAD)
    turned = abs(np.diff(np.unwrap(trace.ego[:, 2]))).sum()
    assert turned > 0.3, "it did bend"
    assert abs(trace.track[:, 0, OFFSET]).max() < 0.6


def test_another_lane_of_a_bend_is_driven_to():
    seen = []

    def decide(now):
        seen.append(now)
        return LaneCommand(lane=int(now.time < 4), speed=9.0)

    assert driven_on("racetrack-v0", decide, 9.0).outcome is Outcome.COMPLETED
    kept = [abs(now.ego.y - now.lane_centres[now.time < 4]) for now in seen if now.time % 4 > 3.9]
    assert max(kept) < 0.4
