"""The example policies for junctions know their roads, give way, and drive on if no vehicle comes."""

import math

import numpy as np
import pytest

import pytest_pafot as pafot
from example_ads import intersection_policy, roundabout_policy
from pytest_pafot import CrossingInstruction, Scenario
from tests.helpers.tables import table


def left_turn(*others, place=-40.0, speed=9.0):
    """Return intersection-v0's observation of the ego at a place on its way, and of others at x, y, vx, vy."""
    (x, y), (to_x, to_y) = intersection_policy.position(place), intersection_policy.position(place + 0.1)
    heading = math.atan2(to_y - y, to_x - x)
    rows = [(x, y, speed * math.cos(heading), speed * math.sin(heading)), *others]
    seen = np.zeros((15, 7))
    seen[: len(rows), 0] = 1.0
    seen[: len(rows), 1:5] = np.array(rows) / (100.0, 100.0, 20.0, 20.0)
    return seen


def test_it_knows_its_way_through_the_intersection():
    lanes = pafot.World("intersection-v0").network
    for place in np.arange(-60.0, 40.0, 3.0):
        point = intersection_policy.position(place)
        assert intersection_policy.along(*point) == pytest.approx(place)
        indices = [("o0", "ir0", 0), ("ir0", "il1", 0), ("il1", "o1", 0)]
        assert min(lanes.get_lane(index).distance(np.array(point)) for index in indices) < 1e-6


@table(
    ("others", "action"),
    [
        ([], intersection_policy.FASTER),
        ([(-2.0, -60.0, 0.0, 9.0)], intersection_policy.FASTER),  # oncoming, and far away
        ([(-2.0, -14.0, 0.0, 9.0)], intersection_policy.SLOWER),  # oncoming, and soon there
        ([(30.0, -2.0, -9.0, 0.0)], intersection_policy.SLOWER),  # from the right
        ([(-14.0, 2.0, 4.0, 0.0)], intersection_policy.SLOWER),  # from the left, and slow
        ([(2.0, 12.0, 0.0, 0.0)], intersection_policy.SLOWER),  # stands ahead
    ],
)
def test_it_looks_whether_anybody_comes(others, action):
    assert intersection_policy.make()(left_turn(*others, place=-24.0)) == action


def test_it_waits_at_the_line_and_goes_on():
    policy, oncoming = intersection_policy.make(), (-2.0, -10.0, 0.0, 8.0)
    actions = [policy(left_turn(oncoming, place=place, speed=speed)) for place, speed in ((-26, 9), (-19, 5), (-16, 0))]
    assert actions == [intersection_policy.SLOWER, intersection_policy.SLOWER, intersection_policy.IDLE]
    assert policy(left_turn((-2.0, 30.0, 0.0, 8.0), place=-16.0, speed=0.0)) == intersection_policy.FASTER


def entry(*others, y=40.0, speed=8.0):
    """Return roundabout-v0's observation of the ego at y on the south road, and of others at x, y, vx, vy."""
    seen = np.zeros((5, 5))
    rows = [(2.0, y, 0.0, -speed), *others]
    seen[: len(rows), 0] = 1.0
    seen[: len(rows), 1:] = np.array(rows) / (100.0, 100.0, 15.0, 15.0)
    return seen


@table(
    ("others", "action"),
    [
        ([], roundabout_policy.IDLE),
        ([(-24.0, 0.0, 0.0, 7.0)], roundabout_policy.IDLE),  # arrives long after the ego
        ([(-10.0, 22.0, 8.0, 4.0)], roundabout_policy.SLOWER),  # arrives with it
        ([(-28.0, 10.0, 12.0, 0.0)], roundabout_policy.SLOWER),  # enters on the left, and is fast
        ([(24.0, 0.0, 0.0, -9.0)], roundabout_policy.IDLE),  # has passed
        ([(2.0, 26.0, 0.0, -3.0)], roundabout_policy.SLOWER),  # ahead
    ],
)
def test_ego_gives_way_to_vehicle_on_the_ring(others, action):
    assert roundabout_policy.make()(entry(*others)) == action


def test_standing_ego_enters_ring_when_it_is_free():
    assert roundabout_policy.make()(entry(y=32.0, speed=0.0)) == roundabout_policy.FASTER


@pytest.mark.parametrize(
    ("env_id", "policy"), [("intersection-v0", intersection_policy), ("roundabout-v0", roundabout_policy)]
)
def test_they_see_who_crosses_in_their_environments(env_id, policy):
    world, seen = pafot.World(env_id), []

    def ads():
        decide = policy.make()
        return lambda observation: seen.append(observation) or decide(observation)

    lane, speed = world.start
    npcs = [
        [CrossingInstruction(world.crossings.zones[0].way, 0.0, 7.0)],
        [CrossingInstruction(world.crossings.zones[-1].way, 2.0, 6.0)],
    ]
    trace = world.rollout(Scenario(npcs=npcs, ego_lane=lane, ego_speed=speed), ads)
    assert trace.outcome == "safe"
    assert trace.ego[:, 3].min() < 6.0  # it gave way
    before = [
        number
        for number in range(len(seen))
        if trace.track[15 * number, 0, 0] < min(zone.ego[0] for zone in trace.zones)
    ]
    assert len(before) > 4
    assert all(seen[number][:, 0].sum() == 3 for number in before)


@pytest.mark.parametrize("env_id", ["intersection-v1", "intersection-v2"])
def test_other_versions_show_who_crosses_as_well(env_id):
    world, seen = pafot.World(env_id), []
    lane, speed = world.start
    npcs = [[CrossingInstruction("o1>o3", 0.0, 7.0)], [CrossingInstruction("o3>o1", 2.0, 6.0)]]
    nothing = 1 if env_id.endswith("2") else np.zeros(2)
    trace = world.rollout(
        Scenario(npcs=npcs, ego_lane=lane, ego_speed=speed),
        lambda: lambda observation: seen.append(observation) or nothing,
    )
    enters = min(zone.ego[0] for zone in trace.zones)
    before = [now for number, now in enumerate(seen) if trace.track[15 * number, 0, 0] < enters]
    assert [now[:, 0].sum() for now in before] == [3.0] * len(before)
    assert len(before) > 4
