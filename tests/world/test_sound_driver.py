"""The negative control that changes lanes overtakes only if there is room."""

import math

import pytest

from pytest_pafot.world import Observation, VehicleState
from tests.helpers.sound_driver import SoundLaneChanger

HZ, WIDTH = 15, 4.0
SLOW_LEADER = (90.0, 3, 12.0, 0.0)
QUEUE = tuple((-30.0 * place, 2, 26.0, 0.0) for place in range(1, 9))


def lanes(*others, speed=22.0, seconds=25.0):
    """Return the lane at each tick, the rightmost first; others have distance ahead [m], lane, speed, acceleration."""
    driver, x, y, heading, seen = SoundLaneChanger(), 0.0, 3 * WIDTH, 0.0, []
    for tick in range(round(seconds * HZ)):
        time = tick / HZ
        states = [
            VehicleState(x + (v + gain * time / 2) * time, lane * WIDTH, 0.0, v + gain * time, lane, 5.0, 2.0)
            for x, lane, v, gain in others
        ]
        ego = VehicleState(x, y, heading, speed, round(y / WIDTH), 5.0, 2.0)
        acceleration, steering = driver(Observation(time, ego, tuple(states), 4, WIDTH, 26.8))
        slip = math.atan(math.tan(steering) / 2)
        x, y = x + speed * math.cos(heading + slip) / HZ, y + speed * math.sin(heading + slip) / HZ
        heading, speed = heading + speed * math.sin(slip) / 2.5 / HZ, speed + acceleration / HZ
        seen.append(ego.lane)
    return seen


@pytest.mark.parametrize("beside", [(-250.0, 2, 22.0, 0.0), (0.0, 0, 26.0, 0.0)], ids=["far behind", "two lanes away"])
def test_sound_driver_overtakes_slow_leader_and_comes_back(beside):
    in_lane = lanes(SLOW_LEADER, beside)
    assert set(in_lane) == {2, 3}
    assert in_lane[-1] == 3


def test_it_lets_pass_who_comes_from_behind():
    assert set(lanes(SLOW_LEADER, *QUEUE, seconds=15.0)) == {3}


@pytest.mark.parametrize(("gain", "overtakes"), [(0.0, True), (1.0, False)])
def test_it_reckons_with_one_behind_who_speeds_up(gain, overtakes):
    assert (2 in lanes(SLOW_LEADER, (-60.0, 2, 15.0, gain), seconds=10.0)) == overtakes


@pytest.mark.parametrize(("heading", "brakes"), [(0.0, False), (0.5, True)])
def test_sound_driver_brakes_for_obstacle_on_planned_path(heading, brakes):
    """A vehicle turned on the line reaches 20 cm into the ego's planned path, and not into its present track."""
    driver, ego = SoundLaneChanger(), VehicleState(0.0, WIDTH + 0.5, -0.02, 8.0, 1, 5.0, 2.0)
    standing = VehicleState(15.0, 1.1, heading, 0.0, 0, 5.0, 2.0)
    acceleration, _ = driver(Observation(0.0, ego, (standing,), 4, WIDTH, 26.8))
    assert (acceleration < 0) == brakes
