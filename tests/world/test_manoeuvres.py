"""NPCs with manoeuvres: their starts, what begins their steps, and how they drive them, on every kind of road."""

from __future__ import annotations

import random
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle

from pytest_pafot import Highway, World
from pytest_pafot.model.driving_style import Traffic
from pytest_pafot.model.instructions import (
    SHIFTS,
    CrossingInstruction,
    LaneInstruction,
    Manoeuvre,
    PositionInstruction,
    ScenarioError,
    Step,
)
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import ACCELERATION, ACROSS, ALONG, LANE, SPEED, STRETCH, Outcome, X, Y
from pytest_pafot.world.guard.own_worlds import base_world
from tests.helpers import road_cases
from tests.helpers.c_library import c_library
from tests.helpers.run_cases import differences
from tests.helpers.tables import table
from tests.helpers.world_cases import EGOS, LENGTH, TRAFFICS, constant_speed, stopping, violations

HIGHWAY = Highway(duration=12.0)
MERGE = World("merge-v0", planner_hz=5, duration=6.0)
ROUNDABOUT = World("roundabout-v0", planner_hz=5, duration=6.0)
INTERSECTION = World("intersection-v0", planner_hz=5, duration=6.0)
RACETRACK = World("racetrack-v0", planner_hz=5, duration=6.0)


def beside(*steps, lanes=1, ahead=30.0, speed=20.0):
    """Return a manoeuvre that starts 30 m ahead in the lane to the right of the ego, as fast as the ego."""
    return Manoeuvre(beside=lanes, ahead=ahead, speed=speed, steps=steps)


def scenario(*npcs, **fields):
    """Return a scenario of manoeuvres and of chains of other genes, in which the ego starts in lane 1 at 20 m/s."""
    chains = [(npc,) if isinstance(npc, Manoeuvre) else npc for npc in npcs]
    return Scenario(npcs=chains, **({"ego_lane": 1, "ego_speed": 20.0} | fields))


def drive(*npcs, ads=constant_speed, world=HIGHWAY, **fields):
    return world.rollout(scenario(*npcs, **fields), ads)


def gaps(trace, npc=0, length=LENGTH):
    """Return the gap between the ego and an NPC at each tick on a straight road [m]; negative behind the ego."""
    distance = trace.npcs[:, npc, X] - trace.ego[:, X]
    return np.sign(distance) * np.maximum(np.abs(distance) - (length + LENGTH) / 2, 0.0)


def first_tick(values, wanted):
    """Return the first tick at which values have reached a value from the side on which they begin."""
    missing = np.asarray(values) - wanted
    missing[np.abs(missing) < 1e-9] = 0.0
    reached = (missing == 0.0) | (np.sign(missing) != np.sign(missing[0]))
    assert reached.any(), "it is never reached"
    return int(np.argmax(reached))


def along_gaps(trace, npc):
    """Return the gap between the ego and an NPC along a bent way at each tick [m]; negative behind the ego."""
    distance = (trace.track[:, npc + 1, ALONG] - trace.track[:, 0, ALONG]) * trace.track[:, 0, STRETCH]
    return np.sign(distance) * (np.abs(distance) - LENGTH)


# --- starts


class Truck(Vehicle):
    """A vehicle class that is longer than an NPC, and keeps its speed."""

    LENGTH = 16.0


@pytest.mark.parametrize(("ads", "length"), [(constant_speed, 5.0), (Truck, 16.0)], ids=["car", "truck"])
def test_npc_starts_at_its_distance_lane_and_speed(ads, length):
    npcs = beside(ahead=12.5, speed=7.3), beside(lanes=-1, ahead=-3.0, speed=26.8), beside(lanes=2, ahead=0.0)
    trace = drive(*npcs, ads=ads, world=Highway(duration=0.2))
    assert [gaps(trace, npc, length)[0] for npc in range(2)] == pytest.approx([12.5, -3.0])
    assert trace.npcs[0, 2, X] == trace.ego[0, X]
    assert trace.npcs[0, :, LANE].tolist() == [2, 0, 3]
    assert trace.npcs[0, :, SPEED].tolist() == [7.3, 26.8, 20.0]


def test_npc_starts_at_its_distance_along_a_bent_way():
    for world, ahead, behind in ((MERGE, 30.0, -20.0), (ROUNDABOUT, 20.0, -10.0)):
        lane, speed = world.start
        npcs = beside(lanes=0, ahead=ahead, speed=8.0), beside(lanes=0, ahead=behind, speed=8.0)
        trace = drive(*npcs, world=world, ego_lane=lane, ego_speed=speed)
        assert [along_gaps(trace, npc)[0] for npc in range(2)] == pytest.approx([ahead, behind], abs=1e-6)


def test_npc_without_steps_keeps_lane_and_speed():
    trace = drive(beside(speed=13.4))
    assert (trace.begun, trace.arrivals) == (((),), ((0,),))
    assert np.ptp(trace.npcs[:, 0, SPEED]) == np.ptp(trace.npcs[:, 0, Y]) == 0.0


# --- what begins a step


def test_gap_is_between_bumpers_of_any_ego():
    trace = drive(beside(Step(gap=20.0), speed=15.0), ads=Truck)
    assert trace.begun == ((first_tick(gaps(trace, length=Truck.LENGTH), 20.0),),)


@table(
    ("ahead", "speed", "step"),
    [
        (40.0, 15.0, {"gap": 20.0}),
        (10.0, 25.0, {"gap": 20.0}),
        (20.0, 15.0, {"gap": 20.0}),
        (20.0, 20.0, {"gap": 20.0}),
        (-40.0, 25.0, {"gap": -10.0}),
        (-10.0, 15.0, {"gap": -20.3}),
        (-10.0, 25.0, {"gap": 0.0}),
        (20.0, 15.0, {"gap": 0.0}),
        (-10.0, 26.0, {"gap": 15.0}),
        (20.0, 14.0, {"gap": -15.0}),
        (30.0, 15.0, {"headway": 1.0}),
        (10.0, 25.0, {"headway": 1.0}),
        (20.0, 25.0, {"headway": 1.0}),
        (-30.0, 25.0, {"headway": -0.5}),
        (-10.0, 16.0, {"headway": -1.5}),
        (-10.0, 26.0, {"headway": 0.5}),
    ],
)
def test_step_begins_as_distance_is_reached_from_either_side(ahead, speed, step):
    trace = drive(beside(Step(**step, lane="right"), ahead=ahead, speed=speed))
    distance = gaps(trace)
    rear = np.where(distance > 0, trace.ego[:, SPEED], trace.npcs[:, 0, SPEED])
    ((begun,),) = trace.begun
    assert begun == first_tick(distance if "gap" in step else distance / rear, *step.values())
    assert (begun == 0) == (ahead == 20.0 and step in ({"gap": 20.0}, {"headway": 1.0}))
    assert np.all(trace.npcs[: begun + 1, 0, Y] == 8.0)
    assert trace.npcs[begun + 1, 0, Y] > 8.0 or trace.npcs[begun + 2, 0, Y] > 8.0


def test_distance_that_is_never_reached_begins_no_step():
    trace = drive(beside(Step(gap=20.0, speed=0.0), Step(speed=10.0), speed=25.0))
    assert (trace.begun, trace.arrivals) == (((),), ((None,),))
    assert np.all(trace.npcs[:, 0, SPEED] == 25.0)


def test_side_counts_from_when_the_step_is_awaited():
    """The gap passes 20 m during the first step and again after it; only the second time begins a step."""
    trace = drive(beside(Step(gap=10.0, speed=26.0), Step(gap=20.0, speed=20.0), speed=15.0))
    (first, second), distance = trace.begun[0], gaps(trace)
    assert first == first_tick(distance, 10.0)
    assert second == first + first_tick(distance[first:], 20.0)


def test_standing_vehicles_have_a_finite_headway():
    ahead = drive(beside(Step(headway=2.0, speed=5.0), lanes=0, ahead=5.0), ego_speed=0.0)
    behind = drive(beside(Step(speed=0.0), Step(headway=-2.0, speed=5.0), ahead=-30.0))
    assert ahead.begun == ((),)
    assert len(behind.begun[0]) == 2


@pytest.mark.parametrize("hz", [5, 15])
def test_after_counts_from_the_end_of_the_step_before(hz):
    """A step ends at its speed; a step without a delay follows at the next tick."""
    steps = Step(after=1.0, speed=15.0), Step(after=2.0, speed=20.0), Step(speed=15.0)
    trace = drive(beside(*steps), world=Highway(duration=14.0, physics_hz=hz, ads_hz=5))
    first, second, third = trace.begun[0]
    speeds, (done,) = trace.npcs[:, 0, SPEED], trace.arrivals[0]
    ends = [
        begin + int(np.argmax(np.abs(speeds[begin:] - step.speed) <= 0.2))
        for begin, step in zip(trace.begun[0], steps, strict=True)
    ]
    assert (first, second, third, done) == (hz, ends[0] + 2 * hz, ends[1] + 1, ends[2])


def test_step_by_distance_begins_while_the_one_before_goes_on():
    """The NPC brakes in the middle of its change of lanes, and then has the lane of one and the speed of the other."""
    steps = Step(lane="left", lateral_speed=1.0), Step(gap=25.0, speed=12.0)
    trace = drive(beside(*steps, speed=15.0))
    first, second = trace.begun[0]
    assert first == 0
    assert 4.5 < trace.npcs[second, 0, Y] < 7.5
    assert trace.npcs[second, 0, SPEED] == 15.0
    assert trace.npcs[-1, 0, [Y, SPEED]] == pytest.approx([4.0, 12.0], abs=0.2)


def test_steps_by_the_same_distance_begin_together():
    steps = Step(gap=20.0, lane="right"), Step(gap=20.0, speed=10.0), Step(after=1.0, speed=15.0)
    trace = drive(beside(*steps, speed=15.0))
    first, second, third = trace.begun[0]
    assert first == second < third
    assert trace.npcs[third, 0, [Y, SPEED]] == pytest.approx([12.0, 10.0], abs=0.2)


# --- how a step is driven


@pytest.mark.parametrize(("start", "end"), [(25.0, 5.0), (5.0, 25.0)])
def test_speed_changes_with_the_acceleration_asked_for(start, end):
    for wanted in (1.5, 3.0, 4.9):
        trace = drive(beside(Step(speed=end, acceleration=wanted), speed=start), world=Highway(duration=20.0))
        rates = np.diff(trace.npcs[:, 0, SPEED]) * trace.physics_hz
        assert np.abs(rates).max() == pytest.approx(wanted)
        assert np.mean(np.isclose(np.abs(rates[: trace.arrivals[0][0]]), wanted)) > 0.5
        assert trace.npcs[-1, 0, SPEED] == pytest.approx(end, abs=0.2)


@table("wanted", [0.4, 1.0, 1.5, 2.5])
def test_lanes_are_changed_with_the_lateral_speed_asked_for(wanted):
    trace = drive(beside(Step(lane="left", lateral_speed=wanted)))
    across = np.abs(np.diff(trace.npcs[:, 0, Y])) * trace.physics_hz
    assert across.max() == pytest.approx(wanted, abs=0.05)
    assert across.max() <= wanted + 1e-9
    assert trace.npcs[trace.arrivals[0][0], 0, Y] == pytest.approx(4.0, abs=0.2)
    assert trace.npcs[-1, 0, Y] == pytest.approx(4.0, abs=0.2)


@table("offset", [-1.0, -0.4, 0.7])
def test_offset_is_kept_until_the_next_step(offset):
    trace = drive(beside(Step(lane="right", offset=offset), Step(after=2.0)))
    assert trace.npcs[trace.begun[0][1], 0, Y] == pytest.approx(12.0 + offset, abs=0.05)
    assert trace.npcs[-1, 0, Y] == pytest.approx(12.0, abs=0.05)


def test_lane_and_speed_of_a_step_build_on_those_before():
    steps = Step(lane="left", speed=15.0), Step(lane="left"), Step(lane="right", speed=20.0)
    trace = drive(beside(*steps, lanes=3), world=Highway(duration=25.0), ego_lane=0)
    assert trace.npcs[list(trace.begun[0]), 0, LANE].tolist() == [3, 2, 1]
    assert trace.npcs[[*trace.begun[0], -1], 0, SPEED] == pytest.approx([20.0, 15.0, 15.0, 20.0], abs=0.25)
    assert trace.npcs[-1, 0, LANE] == 2


def test_no_step_asks_for_more_than_an_npc_can_do():
    wild = {"lateral_speed": 5.0, "acceleration": 20.0}
    steps = Step(lane="left", speed=0.0, **wild), Step(lane="left", speed=26.8, **wild)
    trace = drive(beside(*steps, lanes=2, speed=26.8))
    assert violations(trace, HIGHWAY.limits, HIGHWAY.speed_limit) == []
    assert (trace.npcs[:, 0, ACCELERATION].min(), trace.npcs[:, 0, ACCELERATION].max()) == (-8.0, 5.0)


def test_only_the_papers_traffic_drives_into_the_ego():
    """The NPC is level with the ego and moves over: in other traffic it waits for room, which never comes."""
    outcomes = {}
    for traffic in (Traffic("paper"), Traffic("hostile"), Traffic("everyday")):
        trace = drive(beside(Step(lane="left"), ahead=0.0), traffic=traffic)
        outcomes[traffic.style] = trace.outcome, trace.arrivals
    waits = Outcome.SAFE, ((None,),)
    assert outcomes == {"paper": (Outcome.COLLISION, ((None,),)), "hostile": waits, "everyday": waits}


def random_step(rng, top, offset):
    name, low, high = rng.choice([("after", 0, 30), ("gap", -300, 600), ("headway", -9, 30)])
    return Step(
        **{name: rng.randint(low, high) / 10},
        lane=rng.choice(SHIFTS),
        lateral_speed=rng.randint(1, 50) / 10,
        offset=rng.randint(-offset, offset) / 10,
        speed=rng.choice([None, rng.randint(0, int(10 * top)) / 10]),
        acceleration=rng.randint(1, 200) / 10,
    )


def random_scenarios(world, seed, count, *others, offset=4):
    """Yield random scenarios of one or two manoeuvres, and of other chains, that fit a world."""
    rng, top, lanes = random.Random(seed), world.speed_limit, getattr(world, "lanes", 0)
    while count:
        npcs = [
            beside(
                *(random_step(rng, top, offset) for _ in range(rng.randint(1, 4))),
                lanes=rng.choice([-1, 0, 1]),
                ahead=rng.randint(-600, 800) / 10 or 1.0,
                speed=rng.randint(0, int(10 * top)) / 10,
            )
            for _ in range(rng.randint(1, 2))
        ]
        lane = rng.randrange(lanes) if lanes else world.start[0]
        traffic = rng.choice(TRAFFICS)
        each = scenario(*npcs, *others, ego_lane=lane, ego_speed=rng.choice([0.3, 0.8]) * top, traffic=traffic)
        if fits(world, each):
            count -= 1
            yield each


def fits(world, each):
    try:
        world.check_fits(each)
    except ScenarioError:
        return False
    return True


def test_limits_hold_whatever_is_asked_for():
    outcomes = set()
    for number, each in enumerate(random_scenarios(HIGHWAY, 1, 40)):
        trace = HIGHWAY.rollout(each, EGOS[number % 4])
        assert violations(trace, HIGHWAY.limits, HIGHWAY.speed_limit) == [], each.canonical()
        again = HIGHWAY.rollout(trace.executed, EGOS[number % 4])
        assert (again.states.tobytes(), again.begun) == (trace.states.tobytes(), trace.begun)
        outcomes.add(trace.outcome)
    assert {Outcome.SAFE, Outcome.COLLISION} <= outcomes


@pytest.mark.parametrize("world", [MERGE, ROUNDABOUT], ids=lambda world: world.env_id)
def test_limits_hold_in_bends_whatever_is_asked_for(world):
    for each in random_scenarios(world, 2, 5, offset=0):
        trace = world.rollout(each, constant_speed)
        assert road_cases.violations(trace, world) == [], each.canonical()


# --- refused by the world

APART = "a start at least 0.5 m from {}"


@table(
    ("world", "npcs", "field", "expected", "received"),
    [
        (HIGHWAY, [beside(lanes=-2)], "npcs[0][0].beside", "a lane that exists 35 m from the ego's start", "lane -1"),
        (HIGHWAY, [beside(lanes=3)], "npcs[0][0].beside", "a lane that exists 35 m from the ego's start", "lane 4"),
        (HIGHWAY, [beside(ahead=-300.0)], "npcs[0][0].beside", "a lane that exists -305 m from the ego's st", "lane 2"),
        (MERGE, [beside()], "npcs[0][0].beside", "a lane that exists 35 m from the ego's start", "lane 2"),
        (HIGHWAY, [beside(speed=26.9)], "npcs[0][0].speed", "at most the speed limit of 26.8 m/s", "26.9"),
        (HIGHWAY, [beside(lanes=0, ahead=0.4)], "npcs[0]", APART.format("the ego"), "0.4 m in the same lane"),
        (HIGHWAY, [beside(lanes=0, ahead=-0.4)], "npcs[0]", APART.format("the ego"), "0.4 m in the same lane"),
        (HIGHWAY, [beside(), beside(ahead=35.4)], "npcs[1]", APART.format("npcs[0]"), "0.4 m in the same lane"),
        (
            HIGHWAY,
            [[PositionInstruction(2, 20.0)], beside(lanes=0, ahead=42.0)],
            "npcs[1]", APART.format("npcs[0]"), "-3.0 m in the same lane",
        ),
        (
            HIGHWAY,
            [beside(ahead=0.0), [PositionInstruction(4, 20.0)]],
            "npcs[1]", APART.format("npcs[0]"), "-5.0 m in the same lane",
        ),
    ],
)  # fmt: skip
def test_manoeuvre_that_does_not_fit_the_road_is_refused(world, npcs, field, expected, received):
    with pytest.raises(ScenarioError) as caught:
        drive(*npcs, world=world)
    assert caught.value.field == field
    assert caught.value.expected.startswith(expected)
    assert caught.value.received == received


def test_starts_half_a_metre_apart_are_accepted():
    npcs = beside(lanes=0, ahead=0.5), beside(lanes=0, ahead=6.0), beside(lanes=0, ahead=-0.5), beside(ahead=0.0)
    assert drive(*npcs).outcome is Outcome.SAFE


# --- among others


def test_npcs_with_other_instructions_start_and_drive_as_usual():
    in_lanes, on_grid = [LaneInstruction("keep", 24.0)], [PositionInstruction(6, 20.0)]
    together, alone = drive(in_lanes, beside(Step(lane="right")), on_grid), drive(in_lanes, on_grid)
    assert together.duration == HIGHWAY.duration > alone.duration, "a manoeuvre lasts for the whole run"
    assert np.array_equal(together.npcs[: alone.ticks + 1, [0, 2]], alone.npcs)
    assert together.begun == ((), (0,), ())
    assert (together.arrivals[0], together.arrivals[2]) == alone.arrivals
    assert together.executed == together.scenario


def test_npc_in_lanes_starts_where_no_manoeuvre_does():
    """Its first cell is ahead to the left of the ego, and the manoeuvre starts in that direction."""
    trace = drive(beside(lanes=-1, ahead=5.0), [LaneInstruction("keep", 20.0)])
    assert trace.npcs[0, :, LANE].tolist() == [0, 1]


def braking():
    """Return an ADS that brakes gently."""
    return lambda observation: (-1.0, 0.0)


def test_npcs_cross_before_and_after_one_with_a_manoeuvre():
    """The records of each NPC have its number in the scenario."""
    lane, speed = INTERSECTION.start
    left, right = [CrossingInstruction("o1>o3", 2.5, 8.0)], [CrossingInstruction("o3>o1", -3.0, 7.0, "hold")]
    follows = beside(Step(gap=-10.0, speed=5.0), lanes=0, ahead=-15.0, speed=10.0)
    npcs = left, follows, [PositionInstruction(2, 8.0)], right
    trace = drive(*npcs, world=INTERSECTION, ads=braking, ego_lane=lane, ego_speed=speed)
    assert trace.begun == ((), (first_tick(along_gaps(trace, 1), -10.0),), (), ())
    assert trace.executed.npcs[1] == (follows,)
    assert np.isnan(trace.on_way[:, [1, 2]]).all()
    assert not np.isnan(trace.on_way[:, [0, 3]]).any()


def in_a_bend(*steps):
    """Return the run of an NPC 18 m ahead of an IDM ego of the same speed, which comes nearer on the inside of a bend.

    There, 1 m of the ego's way is less than 0.8 m in its lane.
    """
    npc = beside(*steps, lanes=0, ahead=18.0, speed=8.0)
    return drive(npc, world=RACETRACK, ads=IDMVehicle, ego_lane=1, ego_speed=8.0)


def test_gap_in_a_bend_is_in_metres_of_the_egos_lane():
    trace = in_a_bend(Step(gap=14.0, speed=2.0))
    ((begun,),) = trace.begun
    assert trace.track[begun, 0, STRETCH] < 0.8
    assert along_gaps(trace, 0)[begun] == pytest.approx(14.0, abs=0.5)
    assert trace.npcs[-1, 0, SPEED] < 7.5 == pytest.approx(trace.npcs[begun, 0, SPEED], abs=0.6)


def test_npc_enters_the_lane_that_merges_and_leaves_it():
    lane, speed = MERGE.start
    steps = Step(lane="left", lateral_speed=2.0), Step(after=0.5, lane="right", speed=20.0)
    npc = beside(*steps, lanes=0, ahead=20.0, speed=25.0)
    trace = drive(npc, world=MERGE, ego_lane=lane, ego_speed=speed - 10.0)
    across = np.abs(np.diff(trace.track[:, 1, ACROSS])) * trace.physics_hz
    first, second = trace.begun[0]
    assert trace.npcs[[first, second, -1], 0, LANE].tolist() == [1, 0, 1]
    assert [across[:second].max(), across[second:].max()] == pytest.approx([2.0, 1.5], abs=0.05)
    assert trace.npcs[-1, 0, SPEED] == pytest.approx(20.0, abs=0.3)


def test_npc_leaves_a_lane_that_ends_whatever_it_was_asked_for():
    """In the paper's traffic, in which it gives way to nobody."""
    npc = Manoeuvre(beside=0, ahead=200.0, speed=20.0, steps=(Step(lane="right", lateral_speed=2.0),))
    world = World("merge-v0", planner_hz=5, duration=14.0)
    lane, speed = world.start
    trace = world.rollout(Scenario(npcs=((npc,),), ego_lane=lane, ego_speed=speed), constant_speed)
    lanes = trace.npcs[:, 0, LANE]
    assert lanes.max() > lane, "it was in the lane that ends"
    assert lanes.min() >= 0
    assert lanes[-1] == lane


# --- the same run everywhere

OF_EACH_ROAD = (HIGHWAY, MERGE, ROUNDABOUT, INTERSECTION)


def runs_of(world):
    """Return random scenarios for a world, the last one with another NPC."""
    kinds = {HIGHWAY: LaneInstruction("left", 20.0), INTERSECTION: CrossingInstruction("o1>o3", 0.5, 7.0)}
    others = [[kinds[world]]] if world in kinds else []
    return [*random_scenarios(world, 3, 1), *random_scenarios(world, 4, 1, *others)]


@pytest.mark.parametrize("world", OF_EACH_ROAD, ids=lambda world: getattr(world, "env_id", "Highway"))
def test_run_equals_that_of_env_step_to_the_last_bit(world):
    for each in runs_of(world):
        with c_library():
            trace, again = world.rollout(each, stopping), world.rollout_in_gym(each, stopping)
        assert differences(trace, again) == [], each.canonical()


def test_steps_begin_in_their_order():
    for each in random_scenarios(HIGHWAY, 5, 10):
        for begun, npc in zip(HIGHWAY.rollout(each, constant_speed).begun, each.npcs, strict=True):
            assert all(one <= other for one, other in pairwise(begun))
            assert len(begun) <= len(npc[0].steps)


def test_world_that_does_not_mention_manoeuvres_has_none():
    assert not base_world(SimpleNamespace(has_lane_instructions=True)).has_manoeuvres
    assert Highway().has_manoeuvres
