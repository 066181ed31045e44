"""Attentive NPCs around the ego in situations by hand, and what no NPC of a style does at any tick."""

import math
import random
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from pytest_pafot import Highway, LaneInstruction, NpcLimits, PositionInstruction, Scenario
from pytest_pafot.model.trace import ACCELERATION, SPEED, Outcome, X, Y
from pytest_pafot.model.vehicle_type import STYLES
from pytest_pafot.world.kernel.lanes import Body
from tests.helpers.tables import table
from tests.helpers.world_cases import EGOS, LENGTH, WIDTH, constant_speed, random_scenario

HZ = 20
SPEED_OF_ALL = 20.0
KEPT = 2.0 + 0.4 * SPEED_OF_ALL
"""The gap at which NPCs follow each other at that speed [m]."""


class Scene:
    """An ego at 500 m in lane 1, and NPCs with one Lane-Instruction each, ``(lane, gap, speed, instruction)``.

    The gap is bumper to bumper, negative behind the ego [m].
    """

    def __init__(self, *npcs, traffic="hostile", ego_speed=SPEED_OF_ALL):
        world = Highway(physics_hz=HZ, ads_hz=HZ)
        genes = [instruction.split("@") for *_, instruction in npcs]
        chains = [[LaneInstruction(lane, float(speed))] for lane, speed in genes]
        scenario = Scenario(npcs=chains, gene_seconds=60.0, traffic=traffic)
        common = {"clearance": 3.0, "ego_length": LENGTH, "physics_hz": HZ}
        self.director = world.road.director(scenario, NpcLimits(), frozenset(), **common)
        self.ego = Body(LENGTH, WIDTH)
        self.put(self.ego, 500.0, 1, ego_speed)
        for npc, (lane, gap, speed, _) in zip(self.director.npcs, npcs, strict=True):
            self.put(npc, 500.0 + math.copysign(abs(gap) + LENGTH, gap), lane, speed)

    @staticmethod
    def put(body, x, lane, speed):
        body.place(x, 4.0 * lane, 0.0, speed)
        body.lane = lane

    @property
    def npc(self):
        return self.director.npcs[0]

    @property
    def gap(self):
        return abs(self.npc.x - self.ego.x) - LENGTH

    def drive(self, seconds, acceleration=0.0, sideways=0.0):
        """Drive for a time; return the NPC's acceleration and its distance across from the ego, by tick."""
        rows = []
        for _ in range(round(seconds * HZ)):
            self.director.command(self.ego)
            rows.append((self.npc.acceleration, abs(self.npc.y - self.ego.y)))
            self.ego.acceleration = max(acceleration, -self.ego.speed * HZ)
            self.ego.heading = math.asin(sideways / self.ego.speed) if sideways else 0.0
            for body in (self.ego, *self.director.npcs):
                body.step(1 / HZ)
                body.lane = round(body.y / 4.0)
        return np.array(rows).T


def first(condition):
    """Return the first tick at which a condition holds."""
    assert condition.any()
    return int(np.argmax(condition))


LEADER = (1, 60.0, SPEED_OF_ALL, "keep@20")
FOLLOWER = (1, -KEPT, SPEED_OF_ALL, "keep@20")


def test_npc_follows_ego_as_far_as_other_npcs():
    behind_ego = Scene((1, -50.0, 26.0, "keep@26"))
    behind_npc = Scene((3, -50.0, 26.0, "keep@26"), (3, 1.0, 20.0, "keep@20"))
    behind_ego.drive(30.0)
    behind_npc.drive(30.0)
    assert behind_ego.gap == pytest.approx(KEPT, abs=0.1)
    leader = behind_npc.director.npcs[1]
    assert leader.x - behind_npc.npc.x - LENGTH == pytest.approx(KEPT, abs=0.1)


def test_npc_in_paper_traffic_drives_through_the_ego():
    scene = Scene((1, -50.0, 26.0, "keep@26"), traffic="paper")
    scene.drive(30.0)
    assert scene.npc.x > scene.ego.x


def test_braking_with_somebody_ahead_is_answered_at_once():
    scene = Scene(FOLLOWER, LEADER)
    scene.drive(2.0)
    accelerations, _ = scene.drive(0.3, acceleration=-4.0)
    assert first(accelerations < -0.1) <= 2


@table("ahead", [(), ((2, 20.0, SPEED_OF_ALL, "keep@20"),)])
def test_braking_without_leader_is_answered_one_second_later(ahead):
    """Also with another vehicle in the next lane."""
    scene = Scene((1, -40.0, SPEED_OF_ALL, "keep@20"), *ahead)
    scene.drive(2.0)
    accelerations, _ = scene.drive(5.0, acceleration=-8.0)
    assert 1.0 < first(accelerations < -0.01) / HZ < 2.5
    assert accelerations.min() == pytest.approx(-6.0)


def test_close_follower_answers_exactly_after_its_reaction_time():
    scene = Scene(FOLLOWER)
    scene.drive(3.0)
    accelerations, _ = scene.drive(2.0, acceleration=-2.0)
    assert first(accelerations < -0.1) / HZ == pytest.approx(1.0, abs=2.1 / HZ)


@table("braking", [1.0, 2.0, 3.0])
def test_ego_stopping_gently_for_nothing_is_not_hit(braking):
    scene = Scene(FOLLOWER)
    scene.drive(3.0)
    scene.drive(30.0, acceleration=-braking)
    assert scene.ego.speed == 0.0
    assert 0.5 < scene.gap < 4.0


def test_npc_predicts_position_of_a_steady_ego_exactly():
    """Delayed sight of an ego that does not brake makes no gap smaller or larger."""
    led, alone = Scene((1, -30.0, 26.0, "keep@26"), LEADER), Scene((1, -30.0, 26.0, "keep@26"))
    assert led.drive(4.0)[0] == pytest.approx(alone.drive(4.0)[0], abs=1e-6)


@table("leader", [(), (LEADER,)])
def test_ego_moving_in_is_answered_a_second_later(leader):
    scene = Scene((2, -4.0, SPEED_OF_ALL, "keep@20"), *((2, *each[1:]) for each in leader))
    scene.drive(2.0)
    accelerations, across = scene.drive(4.0, sideways=1.0)
    reached = first(across < WIDTH + 0.3)
    assert not accelerations[: reached + HZ].any()
    assert (accelerations[reached + HZ : reached + HZ + 3] < 0.0).any()


def test_npc_moving_in_behind_adjusts_distance_at_once():
    scene = Scene((2, -20.0, 26.0, "left@26"))
    accelerations, across = scene.drive(3.0)
    assert accelerations[0] < 0.0
    assert across[-1] < 0.5
    assert scene.gap > 0.8 * KEPT


speeds = st.floats(2.0, 26.0)


@given(speeds, speeds, st.floats(0.1, 60.0), st.booleans(), st.integers(0, 26))
@example(19.0, 20.0, 6.0, True, 10)
@example(19.0, 20.0, 11.5, True, 10)
@example(25.0, 15.0, 23.0, False, 25)
def test_ego_lane_is_entered_only_with_enough_room(npc_speed, ego_speed, gap, is_ahead, told):
    """Ahead of the ego, the room is for the speed to which the instruction slows the NPC while it moves in."""
    if is_ahead:
        closing = max(ego_speed - min(npc_speed, told), 0.0)
        needed = closing * 0.35 + closing**2 / 12.0
    else:
        closing = max(npc_speed - ego_speed, 0.0)
        needed = 1.5 + 0.5 * closing + closing**2 / 6.0
    needed = max(needed, 1.5)  # within half the clearance the ego is beside it
    assume(abs(gap - needed) > 1e-6)
    scene = Scene((2, gap if is_ahead else -gap, npc_speed, f"left@{told}"), ego_speed=ego_speed)
    scene.director.command(scene.ego)
    assert (scene.npc.heading_for == 1) == (gap > needed)


@table(("style", "gap", "share"), [("assertive", 6.0, 0.3), ("everyday", 11.0, 0.5)])
def test_styles_leave_more_room_ahead_of_the_ego(style, gap, share):
    for speed in (10.0, 18.0, 26.0):
        needed = max(gap, share * speed)
        for room, enters in ((needed - 0.01, False), (needed + 0.01, True)):
            scene = Scene((2, room, speed, f"left@{speed:g}"), traffic=style, ego_speed=speed)
            scene.director.command(scene.ego)
            assert (scene.npc.heading_for == 1) == enters


@table(("speed", "clearance", "expected"), [(20.0, 3.0, 10.0), (20.0, 15.0, 15.0), (0.0, 1.0, 2.0)])
def test_rear_cell_is_where_an_npc_may_follow(speed, clearance, expected):
    npcs, common = [[PositionInstruction(6, speed)]], {"gene_seconds": 30.0, "traffic": "hostile"}
    scenario = Scenario(npcs=npcs, ego_speed=speed, **common)
    trace = Highway(clearance=clearance, headway=3.0).rollout(scenario, constant_speed)
    arrived = trace.arrivals[0][0]
    assert arrived is not None
    gap = trace.ego[arrived, X] - trace.npcs[arrived, 0, X] - LENGTH
    assert gap == pytest.approx(expected, abs=LENGTH / 2)
    usual = Highway(clearance=clearance).rollout(scenario, constant_speed)
    assert usual.outcome is Outcome.COMPLETED


def test_reversing_ego_gets_no_room_for_its_speed():
    scene = Scene((1, -3.5, 3.0, "keep@10"), LEADER, ego_speed=-3.0)
    scene.director.command(scene.ego)
    assert scene.npc.acceleration < 0.0


@given(seed=st.integers(0, 2**32), style=st.sampled_from(["assertive", "everyday"]))
def test_limits_of_a_style_hold_at_every_tick_with_any_ego(seed, style):
    rng, traffic = random.Random(seed), STYLES[style]
    drawn = random_scenario(rng, lanes=4, speed_limit=26.8, npcs=rng.randint(1, 4))
    trace = Highway(duration=15.0).rollout(replace(drawn, traffic=style), rng.choice(EGOS))
    across = abs(np.diff(trace.npcs[..., Y], axis=0)) / trace.dt
    assert across.max(initial=0.0) <= traffic.lateral_speed + 1e-9
    free = unhindered(trace)
    assert trace.npcs[free, ACCELERATION].min(initial=0.0) >= -traffic.braking - 1e-9
    least = traffic.least_speed_share * np.minimum(26.8, trace.ego[:, None, SPEED])
    slow = free & (trace.npcs[..., SPEED] < least - 0.5)
    assert (trace.npcs[slow, ACCELERATION] > 0.0).all(), "who is slower speeds up"


def unhindered(trace):
    """Return by tick and NPC whether its braking is its own: no vehicle was ahead within two lanes for two seconds."""
    x, y = trace.states[..., X], trace.states[..., Y]
    hindering = (x[:, None, :] >= x[:, 1:, None]) & (abs(y[:, None, :] - y[:, 1:, None]) < 10.0)
    # no vehicle hinders itself
    hindering[:, range(trace.npcs.shape[1]), range(1, trace.npcs.shape[1] + 1)] = False
    hindered = hindering.any(axis=2)
    lately = np.array([hindered[max(t - 30, 0) : t + 1].any(axis=0) for t in range(len(hindered))])
    lately[:30] = True
    return ~lately
