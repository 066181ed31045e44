"""Braking that avoids a collision: from which of the ego's decisions; by hand, and by closed form in the world."""

from dataclasses import replace

import numpy as np
import pytest

from pytest_pafot import Drive
from pytest_pafot.attribution.mistakes import Avoidance, avoidance, keeping_lane
from pytest_pafot.model.instructions import Cell, PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import LANE, SPEED, Outcome, X
from pytest_pafot.world import Highway
from pytest_pafot.world.reference_drivers import CarefulHuman
from tests.helpers.tables import table
from tests.helpers.traces import LENGTH, collision_at, trace_of, vehicle


def crash(ticks=30, outcome=Outcome.COLLISION):
    """Return a run with the ego at 20 m/s behind an NPC at 10 m/s, which it hits at the last of the ticks."""
    gap = ticks / 15 * 10.0
    ego, npc = vehicle(0.0, 4.0, speed=20.0, ticks=ticks), vehicle(gap + LENGTH, 4.0, speed=10.0, ticks=ticks)
    return trace_of(ego, npc, outcome=outcome)


def braked(hit=None, outcome=Outcome.SAFE, ticks=300, rate=6.0, since=None, lane=1, trace=None, tick=27):
    """Return a run that begins like that of :func:`crash`, in which the ego brakes; with its contact at a tick."""
    trace, since = trace or crash(), since or tick
    states = np.concatenate([trace.states, np.repeat(trace.states[-1:], ticks - trace.ticks, axis=0)])
    states[since:, 0, SPEED] = np.maximum(20.0 - rate / 15 * np.arange(ticks + 1 - since), 0.0)
    states[tick + 1 :, :, X] = states[tick, :, X]  # nobody is nearer than at the decision
    states[40:, 0, LANE] = lane
    states = states[:-1] if outcome is Outcome.END_OF_ROAD else states
    collision = None if hit is None else collision_at(hit, side="rear", cell=Cell.REAR)
    states = states if hit is None else states[: hit + 1]
    return replace(trace, states=states, outcome=outcome if hit is None else Outcome.COLLISION, collision=collision)


def through_another():
    """Return a run in which the ego brakes and passes through the NPC."""
    states = braked().states.copy()
    states[90:100, 0, X] = states[90:100, 1, X]
    return replace(braked(), states=states)


def scanned(trace, successes, otherwise=None):
    """Return the avoidance if braking from these ticks avoids the collision, and the ticks that were tried."""
    tried = []

    def take_over(given, tick, name):
        assert given is trace
        assert name == "steady-braking"
        tried.append(tick)
        return braked(trace=trace, tick=tick, ticks=600) if tick in successes else otherwise or trace

    return avoidance(trace, "leader-unanswered", take_over), tried


def test_latest_decision_that_avoids_the_collision_counts():
    found, tried = scanned(crash(), {3, 12})
    assert found.time == 0.8
    assert tried == [27, 24, 21, 18, 15, 12]


def test_search_stops_ten_seconds_before_the_impact():
    found, tried = scanned(crash(ticks=300), {147})
    assert found is None
    assert (tried[0], tried[-1]) == (297, 150)


@pytest.mark.parametrize("ticks", [30, 20], ids=["elsewhere", "over before"])
def test_a_run_that_does_not_repeat_has_none(ticks):
    other = trace_of(vehicle(1.0, 4.0, speed=20.0, ticks=ticks), vehicle(90.0, 4.0, speed=10.0, ticks=ticks))
    found, tried = scanned(crash(), {24}, otherwise=other)
    assert found is None
    assert tried == [27]


@table(("taken", "is_free"), [
    (braked(), True),
    (braked(hit=27 + 180), False),
    (braked(hit=27 + 181), True),
    (braked(outcome=Outcome.INVALID, ticks=60), False),
    (braked(outcome=Outcome.INVALID), True),
    (braked(outcome=Outcome.ADS_ERROR, ticks=60), False),
    (braked(outcome=Outcome.END_OF_ROAD, ticks=60), False),
    (braked(ticks=27 + 181), True),
    (braked(ticks=27 + 180), False),
    (braked(rate=8.0), False),
    (braked(rate=4.5), False),
    (braked(rate=6.3), True),
    (braked(since=29), True),
    (braked(since=60), False),
    (braked(lane=0), False),
    (through_another(), False),
])  # fmt: skip
def test_braking_avoids_only_if_ego_brakes_untouched(taken, is_free):
    """A contact from behind counts, too. A run that ends before, or without its driver, shows nothing."""
    names = []

    def take_over(trace, tick, name):
        names.append(name)
        return taken if tick == 27 else trace

    found = avoidance(crash(), "leader-unanswered", take_over)
    assert found == (Avoidance(time=1.8, braking=6.0) if is_free else None)
    assert {*names} == {"steady-braking"}


class Lasting:
    """A function that lets a driver take over in short runs, and in longer ones if it can go on."""

    def __init__(self, short, longer):
        self.short, self.longer, self.asked = short, longer, []
        self.drivers = ("steady-braking", "careful-human")

    def __call__(self, trace, tick, name):
        return self.short if tick == 27 else trace

    def lasting(self, seconds):
        self.asked.append(seconds)
        return None if self.longer is None else lambda *_: self.longer


@table(("short", "longer", "is_free"), [
    (braked(ticks=33), braked(), True),
    (braked(ticks=33), None, False),
    (braked(ticks=33), braked(hit=100), False),
    (braked(ticks=33), braked(ticks=60), False),
    (braked(ticks=33), braked(outcome=Outcome.END_OF_ROAD, ticks=60), False),
    (braked(ticks=33), braked(since=60), False),
    (braked(ticks=40), braked(lane=0), False),
    (braked(ticks=40), braked(since=29), False),  # the longer run begins otherwise
])  # fmt: skip
def test_run_that_ends_before_twelve_seconds_is_driven_on(short, longer, is_free):
    take_over = Lasting(short, longer)
    assert (avoidance(crash(), "leader-unanswered", take_over) is not None) == is_free
    assert take_over.asked == [pytest.approx(27 / 15 + 12.0, abs=0.2)]


@table("short", [braked(), braked(ticks=60, rate=3.0), braked(hit=50)])
def test_only_braking_that_helps_so_far_is_driven_on(short):
    take_over = Lasting(short, braked())
    avoidance(crash(), "leader-unanswered", take_over)
    assert take_over.asked == []


def test_built_in_world_drives_the_braking_ego_on():
    """The scenario ends 0.6 s after the impact, and the leader with its single instruction keeps its speed."""
    world = Highway(clearance=30.0)
    found = []
    for seconds in (11.0, 30.0):
        scenario = Scenario(npcs=[[PositionInstruction(2, 12.0)]], ego_speed=22.0, gene_seconds=seconds)
        trace = world.rollout(scenario, lambda: lambda observation: (0.0, 0.0))
        assert trace.collision is not None
        found.append(avoidance(trace, "leader-unanswered", world.take_over))
    short, whole = found
    assert short == whole
    assert short is not None


@table(("taken", "is_free"), [
    (braked(), True),
    (braked(rate=1.0), True),  # this driver need not brake
    (braked(lane=0), False),
    (braked(hit=27 + 180), False),
    (braked(ticks=60), False),  # it ends before 12 s are over
    (crash(), False),
    (trace_of(vehicle(1.0, 4.0, speed=20.0, ticks=300), vehicle(90.0, 4.0, speed=10.0, ticks=300)), False),
])  # fmt: skip
def test_a_careful_driver_who_keeps_the_lane_avoids_only_untouched(taken, is_free):
    names = []

    def take_over(trace, tick, name):
        names.append((tick, name))
        return taken

    assert keeping_lane(crash(), 27, take_over) == (Avoidance(time=1.8) if is_free else None)
    assert names == [(27, "careful-human")]
    take_over.drivers = ("steady-braking",)
    assert keeping_lane(crash(), 27, take_over) is None
    assert keeping_lane(crash(outcome=Outcome.SAFE), 27, lambda *_: pytest.fail("simulated")) is None


@table("is_kept", [True, False])
def test_a_careful_driver_must_keep_the_lane_in_the_part_that_is_driven_on_too(is_kept):
    longer = braked()
    states = longer.states.copy()
    states[100:, 0, LANE] = 1 if is_kept else 0
    take_over = Lasting(braked(ticks=60), replace(longer, states=states))
    assert keeping_lane(crash(), 27, take_over) == (Avoidance(time=1.8) if is_kept else None)


@table(("cell", "is_free"), [(Cell.LEFT, True), (Cell.FRONT, True), (Cell.REAR, False)])
def test_keeping_the_lane_avoids_a_vehicle_beside_or_ahead_but_not_one_that_comes_from_behind(cell, is_free):
    """The ego begins to move to the left at 4 s. A vehicle from behind that does not brake hits it in its lane."""
    world = Highway(clearance=30.0 if cell is Cell.REAR else 3.0)
    speed = 26.0 if cell is Cell.REAR else 14.0
    scenario = Scenario(npcs=[[PositionInstruction(int(cell), speed)]], ego_speed=18.0, gene_seconds=30.0)
    trace = world.rollout(scenario, lambda: lambda seen: Drive(lane=int(seen.time < 4.0), acceleration=0.0))
    hit = replace(trace, outcome=Outcome.COLLISION, collision=trace.collision or collision_at(trace.ticks))
    found = keeping_lane(hit, round(4.0 * trace.physics_hz), world.take_over)
    assert found == (Avoidance(time=4.0) if is_free else None)


@table("fault", [None, "entered-lane", "braked-for-nothing", "stopped-for-nothing"])
def test_braking_is_not_tried_for_other_faults_or_without_a_collision(fault):
    assert avoidance(crash(), fault, lambda *_: pytest.fail("simulated")) is None
    assert avoidance(crash(outcome=Outcome.SAFE), "leader-unanswered", lambda *_: pytest.fail("simulated")) is None


@pytest.mark.parametrize("closing", [3.0, 5.0])
def test_braking_avoids_while_the_distance_suffices(closing):
    """The leader has arrived ahead and keeps its speed, so the textbook formula gives the distance."""
    world = Highway(clearance=30.0)  # at that gap the leader has arrived
    scenario = Scenario(npcs=[[PositionInstruction(2, 22.0 - closing)]], ego_speed=22.0, gene_seconds=20.0)
    trace = world.rollout(scenario, lambda: lambda observation: (0.0, 0.0))
    gap = trace.npcs[:, 0, X] - trace.ego[:, X] - LENGTH
    needed = closing**2 / (2 * 6.0) + closing * trace.dt / 2  # a tick's speed is the one at its beginning
    assert trace.npcs[-45:, 0, SPEED] == pytest.approx(22.0 - closing, abs=0.01)
    expected = max(tick for tick in range(0, trace.ticks, 3) if gap[tick] > needed)
    assert avoidance(trace, "leader-unanswered", world.take_over).time == round(expected / 15, 3)


def test_careful_human_keeps_braking_for_a_motorcycle_that_is_over_the_line_and_not_yet_in_its_way():
    """Its centre is nearer than half a lane, and its box is narrow."""
    chain = [PositionInstruction(cell, speed) for cell, speed in ((2, 0.0), (1, 18.0), (1, 18.0), (1, 18.0), (2, 0.0))]
    scenario = Scenario(npcs=[chain], gene_seconds=4.0, vehicles=("motorcycle",))
    assert Highway(ads_hz=15).rollout(scenario, CarefulHuman).outcome is Outcome.SAFE
