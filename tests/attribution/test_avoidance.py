"""Would braking have helped? Checked against stepping through time."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.attribution.avoidance import Braking, Chase, Emergency

HZ = 15
CALM = Braking(delay=1.0, deceleration=3.0)
EMERGENCY = Emergency(
    time_to_contact=2.0, leader_braking=5.0, perception=0.4, braking=Braking(delay=1.0, deceleration=6.0)
)


def chase(gap, follower, leader, braking=0.0, *, seconds=30.0, abreast=True):
    """A follower at constant speed and a leader that brakes, until they touch."""
    times = np.arange(round(seconds * HZ) + 1) / HZ
    speeds = np.maximum(leader - braking * times, 0.0)
    gaps = gap + np.concatenate(([0.0], np.cumsum(speeds - follower)[:-1])) / HZ
    end = int(np.argmax(gaps <= 0)) + 1 if (gaps <= 0).any() else len(gaps)
    return Chase(
        gap=gaps[:end],
        abreast=np.full(end, abreast),
        follower=np.full(end, float(follower)),
        leader=speeds[:end],
        leader_acceleration=np.where(speeds[:end] > 0, -braking, 0.0),
        hz=HZ,
    )


def stopping_gap(speed, response):
    """Room that a driver needs behind a wall [m]."""
    return speed * response.delay + speed**2 / (2 * response.deceleration)


@pytest.mark.parametrize("speed", [5.0, 15.0, 25.0])
def test_standing_leaders_are_avoided_from_the_stopping_distance_on(speed):
    needed = stopping_gap(speed, CALM)
    assert chase(needed + speed / HZ + 0.1, speed, 0.0).is_avoided(0, CALM)
    assert not chase(needed - 0.1, speed, 0.0).is_avoided(0, CALM)


def test_time_lost_counts():
    run = chase(stopping_gap(20.0, CALM) + 5.0, 20.0, 0.0)
    assert run.is_avoided(0, CALM)
    assert not run.is_avoided(round(0.5 * HZ), CALM)


def test_a_contact_before_the_brakes_act_cannot_be_avoided():
    assert not chase(5.0, 20.0, 10.0).is_avoided(0, CALM)


def test_boxes_that_pass_beside_each_other_do_not_touch():
    assert chase(5.0, 20.0, 10.0, abreast=False).is_avoided(0, CALM)


def test_a_leader_goes_on_braking_as_it_did_after_the_recording():
    """The follower is off the leader when the recording ends, and would hit it afterwards."""
    slows, keeps = chase(25.0, 20.0, 20.0, 4.0), chase(25.0, 20.0, 20.0, 4.0)
    keeps = Chase(
        gap=keeps.gap,
        abreast=keeps.abreast,
        follower=keeps.follower,
        leader=keeps.leader,
        leader_acceleration=np.zeros(len(keeps.gap)),
        hz=HZ,
    )
    assert not slows.is_avoided(0, CALM)
    assert keeps.is_avoided(0, CALM)


def test_an_emergency_is_met_by_harder_braking():
    run = chase(35.0, 20.0, 20.0, 6.5)
    assert not run.is_avoided(0, CALM)
    assert run.is_avoided(0, CALM, EMERGENCY)


def test_what_does_not_last_is_not_perceived():
    run = chase(31.0, 20.0, 20.0, 4.0)
    flash = run.leader_acceleration.copy()
    flash[:4] = -9.0
    assert not Chase(
        gap=run.gap, abreast=run.abreast, follower=run.follower, leader=run.leader, leader_acceleration=flash, hz=HZ
    ).is_avoided(0, CALM, Emergency(time_to_contact=0.0, leader_braking=5.0, perception=0.4, braking=EMERGENCY.braking))


def test_a_follower_that_speeds_up_in_the_delay_is_not_excused_by_it():
    run = chase(60.0, 20.0, 0.0)
    faster = np.linspace(20.0, 30.0, len(run.gap))
    accelerating = Chase(
        gap=run.gap,
        abreast=run.abreast,
        follower=faster,
        leader=run.leader,
        leader_acceleration=run.leader_acceleration,
        hz=HZ,
    )
    assert accelerating.is_avoided(0, CALM) == run.is_avoided(0, CALM)


@given(gap=st.floats(1, 100), follower=st.floats(1, 35), leader=st.floats(0, 35), braking=st.floats(0, 8))
def test_it_agrees_with_stepping_through_time(gap, follower, leader, braking):
    run = chase(gap, follower, leader, braking, seconds=20.0)
    room, speed, other = gap, float(follower), float(leader)
    last = -run.leader_acceleration[-1]
    touched = False
    for tick in range(len(run.gap) + 12 * HZ):
        touched |= room <= 0
        room += (other - speed) / HZ
        if tick >= CALM.delay * HZ:
            speed = max(speed - CALM.deceleration / HZ, 0.0)
        slows = braking if tick < len(run.gap) - 1 else last
        other = max(other - slows / HZ, 0.0)
    assert run.is_avoided(0, CALM) != touched or math.isclose(room, 0.0, abs_tol=1e-6)


@given(gap=st.floats(1, 100), follower=st.floats(1, 35), leader=st.floats(0, 35), braking=st.floats(0, 8))
def test_more_braking_never_hurts(gap, follower, leader, braking):
    run = chase(gap, follower, leader, braking)
    harder = Braking(delay=CALM.delay, deceleration=6.0)
    assert run.is_avoided(0, harder) >= run.is_avoided(0, CALM, EMERGENCY) >= run.is_avoided(0, CALM)
