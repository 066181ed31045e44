"""Would braking have helped? The answer is checked by steps through time with polygons."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from pytest_pafot.attribution.responses import HORIZON, Braking, Emergency, Pursuit
from tests.helpers.polygons import corners, polygons_meet
from tests.helpers.tables import table

HZ = 15
SIZE = (5.0, 2.0)
CALM = Braking(delay=1.0, deceleration=3.0)
HARD = Braking(delay=1.0, deceleration=6.0)
EMERGENCY = Emergency(time_to_contact=2.0, leader_braking=5.0, perception=0.4, braking=HARD)


def pursuit(gap, responder, leader, braking=0.0, *, seconds=30.0, right=0.0, angle=0.0):
    """Return a responder with constant or given speeds and a leader that brakes, until they touch."""
    times = np.arange(round(seconds * HZ) + 1) / HZ
    speeds, own = np.maximum(leader - braking * times, 0.0), np.broadcast_to(responder, times.shape).astype(float)
    ahead = SIZE[0] + gap + np.concatenate(([0.0], np.cumsum(speeds - own)[:-1])) / HZ
    touching = ahead <= SIZE[0]
    end = int(np.argmax(touching)) + 1 if touching.any() and abs(right) <= SIZE[1] else len(ahead)
    flat, turned = np.zeros(end), np.full(end, angle)
    return Pursuit(
        ahead=ahead[:end],
        right=np.full(end, right),
        directions=((flat + 1.0, flat), (np.cos(turned), np.sin(turned))),
        speeds=(own[:end], speeds[:end]),
        sizes=(SIZE, SIZE),
        hz=HZ,
    )


def is_avoided(run, since, response, emergency=None):
    return run.avoided_from(since, response, emergency) is not None


def stopping_gap(speed, response):
    """Return the distance that a driver needs behind a wall [m]."""
    return speed * response.delay + speed**2 / (2 * response.deceleration)


@table("speed", [5.0, 15.0, 25.0])
def test_standing_leader_is_avoidable_from_stopping_distance_on(speed):
    needed = stopping_gap(speed, CALM)
    assert is_avoided(pursuit(needed, speed, 0.0), 0, CALM)
    assert not is_avoided(pursuit(needed - speed / HZ - 0.1, speed, 0.0), 0, CALM)


def test_time_lost_counts():
    run = pursuit(stopping_gap(20.0, CALM) + 5.0, 20.0, 0.0)
    assert is_avoided(run, 0, CALM)
    assert not is_avoided(run, round(0.5 * HZ), CALM)


def test_reaction_due_at_impact_avoids_nothing():
    run = pursuit(5.0, 20.0, 10.0)
    assert len(run.ahead) <= HZ
    assert not is_avoided(run, 0, CALM)


def test_boxes_passing_side_by_side_do_not_touch():
    beside = pursuit(5.0, 20.0, 10.0, right=3.0, seconds=1.0 + 2 / HZ)
    assert (np.abs(beside.right) > SIZE[1]).all()
    assert not is_avoided(beside, 0, CALM), "after the impact the other is in the responder's lane"
    assert is_avoided(beside, 0, Braking(delay=0.0, deceleration=15.0))


def test_slower_driver_beside_another_need_not_brake():
    """Its boxes overlap along the road, which is no headway to restore: only a response to a cut-in restores one."""
    beside = pursuit(-2.0, 10.0, 11.0, right=3.0, seconds=2.0)
    assert not is_avoided(beside, 0, CALM)
    assert is_avoided(beside, 0, replace(CALM, headway=1.0))


def test_boxes_are_as_they_were_turned():
    """A box across the road reaches 1.5 m less far along it, and further to the side."""
    along, across = (pursuit(20.0, 20.0, 10.0, angle=angle, seconds=2.0) for angle in (0.0, math.pi / 2))
    brakes = Braking(delay=1.0, deceleration=3.5)
    assert not is_avoided(along, 0, brakes)
    assert is_avoided(replace(across, right=along.right + 3.4), 0, replace(brakes, deceleration=9.0))


def test_a_leader_keeps_its_speed_after_the_recording():
    run = pursuit(25.0, 20.0, 20.0, 4.0)
    assert is_avoided(run, 0, CALM)
    assert not is_avoided(pursuit(25.0, 20.0, run.speeds[1][-1]), 0, CALM)


@table(("right", "aside", "before", "avoids"), [
    (1.8, 0.0, 13, True),  # 0.87 s: 10 m/s are lost in 1.67 s and 8.3 m, of which 0.83 s are before the impact
    (1.8, 0.0, 11, False),
    (1.8, 1.0, 11, True),  # 0.73 s: 0.2 s after the impact the leader is 2.0 m aside; the ego needs 1.0 of 1.6 m
    (1.8, 1.0, 7, False),  # 0.47 s: the ego is 7.2 m/s faster then, and needs 1.3 m, of which it has gained 0.65 m
    (0.1, -6.0, 12, False),  # it comes back, and would be on the other side after 0.35 s
    (1.99, 0.2, 11, False),  # it hardly moves
])  # fmt: skip
def test_leader_that_moves_out_of_the_way_is_not_hit_any_more(right, aside, before, avoids):
    run = pursuit(30.0, 20.0, 10.0)
    left = np.arange(len(run.right))[::-1] / HZ
    run = replace(run, right=right - aside * left)
    assert run.is_avoided_by_braking(len(run.right) - 1 - before) == avoids


@table(("before", "avoids"), [(9, True), (8, False)])
def test_who_would_touch_only_a_corner_may_stop_alongside(before, avoids):
    """The leader stands aslant, and its corner is in the way by 8 cm, 1.1 m behind its middle.

    The ego touches it when the middles are 3.6 m apart. From 6 m/s, it stops within 3.2 m, and moves 0.4 m in a tick.
    At the impact it is 3.4 m behind, so it needs 9 ticks; to stop 5 m behind, as behind a straight box, it needs 12.
    """
    run = pursuit(20.0, 6.0, 0.0, seconds=3.6, right=3.4, angle=math.pi / 4)
    assert run.is_avoided_by_braking(len(run.right) - 1 - before) == avoids


def test_an_emergency_is_met_by_harder_braking():
    run = pursuit(20.0, 20.0, 20.0, 6.5)
    assert not is_avoided(run, 0, CALM)
    assert is_avoided(run, 0, CALM, EMERGENCY)


def test_what_does_not_last_is_not_perceived():
    run, flash = pursuit(20.0, 20.0, 20.0, 6.5), replace(EMERGENCY, time_to_contact=0.0)
    assert is_avoided(run, 0, CALM, flash)
    assert not is_avoided(run, 0, CALM, replace(flash, perception=5.0))


def test_speeding_up_during_reaction_delay_excuses_nothing():
    speeding = np.minimum(20.0 + np.arange(30 * HZ + 1) / HZ, 30.0)
    assert is_avoided(pursuit(60.0, 20.0, 0.0), 0, HARD)
    assert is_avoided(pursuit(60.0, speeding, 0.0), 0, HARD)


def test_braking_after_impact_does_not_excuse_driver():
    """A driver that braked with 9 m/s^2 before its answer was due did more than the reference would have."""
    times = np.arange(30 * HZ + 1) / HZ
    braked = pursuit(16.0, np.maximum(20.0 - 9.0 * times, 0.0), 4.0)
    assert len(braked.ahead) > 1.4 * HZ
    assert not is_avoided(braked, 0, Braking(delay=1.4, deceleration=6.0))


@pytest.mark.parametrize(("headway", "counted"), [(0.0, 0), (0.5, 4 * HZ)])
def test_driver_that_mastered_cut_in_answers_later_braking(headway, counted):
    """It brakes to the leader's speed as the reference does, which restores a headway. Then the leader brakes again."""
    times = np.arange(30 * HZ + 1) / HZ
    own = np.where(times < 1.0, 20.0, np.maximum(20.0 - 6.0 * (times - 1.0 + 1 / HZ), 14.8))
    leader = np.where(times < 4.0 + 1e-9, 15.0, np.maximum(15.0 - 4.5 * (times - 4.0), 0.0))
    ahead = SIZE[0] + 18.0 + np.concatenate(([0.0], np.cumsum(leader - own)[:-1])) / HZ
    end = int(np.argmax(ahead <= SIZE[0])) + 1
    flat, still = np.zeros(end), (np.ones(end), np.zeros(end))
    run = Pursuit(
        ahead=ahead[:end], right=flat, directions=(still, still), speeds=(own[:end], leader[:end]),
        sizes=(SIZE, SIZE), hz=HZ,
    )  # fmt: skip
    assert run.avoided_from(0, replace(HARD, headway=headway)) == counted


speeds = st.floats(0, 35)


@given(
    gap=st.floats(1, 50), own=st.floats(15, 35), leader=st.floats(0, 20), braking=st.floats(0, 8),
    right=st.floats(-1.9, 1.9), angle=st.floats(-0.3, 0.3),
)  # fmt: skip
def test_it_agrees_with_stepping_through_time(gap, own, leader, braking, right, angle):
    run = pursuit(gap, own, leader, braking, seconds=10.0, right=right, angle=angle)
    end, touched, place, other, speed = len(run.ahead) - 1, False, 0.0, float(run.ahead[0]), float(own)
    assume(HZ < end < 10 * HZ)
    for tick in range(end + round(HORIZON * HZ) + 1):
        leads = float(run.speeds[1][min(tick, end)])
        side, turned = (right, angle) if tick <= end else (0.0, 0.0)
        boxes = corners((place, 0.0, 0.0)), corners((other, side, turned))
        touched |= abs(other - place) < 6.0 and polygons_meet(*boxes)
        if touched or (tick >= end and speed <= leads):
            break
        place, other = place + speed / HZ, other + leads / HZ
        speed = max(speed - 3.0 / HZ, 0.0) if tick + 1 >= HZ and speed > leads else speed
    assert is_avoided(run, 0, CALM) != touched
