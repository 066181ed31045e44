"""The last chance: which of the ego's decisions it is, and its report; by hand, and by closed form in the world."""

from dataclasses import replace

import numpy as np
import pytest

from pytest_pafot.attribution.last_chance import Avoidance, LastChance, avoidance, last_chance
from pytest_pafot.attribution.responsibility import rss_rule
from pytest_pafot.model.grid import Cell
from pytest_pafot.model.scenario import PositionInstruction, Scenario
from pytest_pafot.model.trace import ACCELERATION, LANE, SPEED, STEERING, Outcome, X
from pytest_pafot.world import Highway
from pytest_pafot.world.reference_drivers import HARD_BRAKING
from tests.helpers.tables import table
from tests.helpers.traces import LENGTH, collision_at, trace_of, vehicle


def crash(ticks=30, outcome=Outcome.COLLISION):
    """Return a run with the ego at 20 m/s behind an NPC at 10 m/s, which it hits at the last of the ticks."""
    gap = ticks / 15 * 10.0
    ego, npc = vehicle(0.0, 4.0, speed=20.0, ticks=ticks), vehicle(gap + LENGTH, 4.0, speed=10.0, ticks=ticks)
    return trace_of(ego, npc, outcome=outcome)


def scanned(trace, chances=(), fault="leader-unanswered", survived=None):
    """Return the last chance if these ticks are chances, and the ticks that were tried."""
    tried = []
    survived = survived or replace(trace, outcome=Outcome.SAFE, collision=None)

    def take_over(given, tick, name):
        assert given is trace
        assert name == "careful-human"
        tried.append(tick)
        return survived if tick in chances else trace

    return last_chance(trace, fault, take_over), tried


def test_latest_decision_that_avoids_the_collision_counts():
    chance, tried = scanned(crash(), chances={3, 12})
    assert chance.time == 0.8
    assert tried == [27, 24, 21, 18, 15, 12]


def test_between_two_decisions_nobody_takes_over():
    chance, tried = scanned(crash(), chances={13, 14})
    assert chance is None
    assert tried == [27, 24, 21, 18, 15, 12, 9, 6, 3, 0]


def test_search_stops_ten_seconds_before_the_impact():
    chance, tried = scanned(crash(ticks=300), chances={147})
    assert chance is None
    assert (tried[0], tried[-1]) == (297, 150)


def test_collision_without_ego_responsibility_counts_as_avoided():
    between = trace_of(
        vehicle(0.0, 4.0, speed=20.0, ticks=30),
        vehicle(20.0 + LENGTH, 4.0, speed=10.0, ticks=30),
        vehicle(-20.0 - LENGTH, 4.0, speed=30.0, ticks=30),
        outcome=Outcome.COLLISION,
    )
    rammed = replace(between, collision=collision_at(30, npc=1, cell=Cell.REAR, side="rear", npc_speed=30.0))
    assert [rss_rule(each).responsibility for each in (between, rammed)] == ["ego", "npc"]
    chance, _ = scanned(between, chances={27}, survived=rammed)
    assert chance.time == 1.8


@pytest.mark.parametrize(("later", "is_escape"), [(0.0, False), (0.5, False), (0.6, True)])
def test_immediate_hit_by_same_npc_is_no_escape(monkeypatch, later, is_escape):
    trace = crash()
    survived = replace(trace, collision=replace(trace.collision, time=2.0 + later))
    monkeypatch.setattr("pytest_pafot.attribution.last_chance.is_ego_responsible", lambda taken: taken is not survived)
    chance, _ = scanned(trace, chances={27}, survived=survived)
    assert (chance is not None) is is_escape


def test_run_where_two_npcs_touch_is_ignored():
    trace = crash()
    assert scanned(trace, chances={27}, survived=replace(trace, outcome=Outcome.INVALID, collision=None))[0] is None


@table(("trace", "fault"), [(crash(), None), (crash(), "entered-lane"), (crash(outcome=Outcome.SAFE), None)])
def test_where_it_would_say_nothing_nothing_is_simulated(trace, fault):
    assert scanned(trace, chances={27}, fault=fault) == (None, [])


@pytest.mark.parametrize("ticks", [30, 20], ids=["elsewhere", "over before"])
def test_a_run_that_does_not_repeat_has_none(ticks):
    other = trace_of(vehicle(1.0, 4.0, speed=20.0, ticks=ticks), vehicle(90.0, 4.0, speed=10.0, ticks=ticks))
    chance, tried = scanned(crash(), chances={27}, survived=other)
    assert chance is None
    assert tried == [27]


def braked(hit=None, outcome=Outcome.SAFE, ticks=300, rate=6.0, since=27, lane=1):
    """Return a run that begins like that of :func:`crash`, in which the ego brakes; with its contact at a tick."""
    trace = crash()
    states = np.concatenate([trace.states, np.repeat(trace.states[-1:], ticks - 30, axis=0)])
    states[since:, 0, SPEED] = np.maximum(20.0 - rate / 15 * np.arange(ticks + 1 - since), 0.0)
    states[28:, :, X] = states[27, :, X]  # nobody is nearer than at the decision
    states[40:, 0, LANE] = lane
    states = states[:-1] if outcome is Outcome.END_OF_ROAD else states
    collision = None if hit is None else collision_at(hit, side="rear", cell=Cell.REAR)
    states = states if hit is None else states[: hit + 1]
    return replace(trace, states=states, outcome=outcome if hit is None else Outcome.COLLISION, collision=collision)


@table(
    ("taken", "is_free"),
    [
        (braked(), True),
        (braked(hit=27 + 180), False),
        (braked(hit=27 + 181), True),
        (braked(outcome=Outcome.INVALID, ticks=60), False),
        (braked(outcome=Outcome.INVALID), True),
        (braked(outcome=Outcome.ADS_ERROR, ticks=60), False),
        (braked(outcome=Outcome.HANG, ticks=60), False),
        (braked(outcome=Outcome.END_OF_ROAD, ticks=30), False),
        (braked(outcome=Outcome.END_OF_ROAD, ticks=60), True),
        (braked(rate=8.0), False),
        (braked(rate=4.5), False),
        (braked(rate=6.3), True),
        (braked(since=29), True),
        (braked(since=60), False),
        (braked(lane=0), False),
    ],
)
def test_braking_avoids_only_if_ego_brakes_untouched(taken, is_free):
    """A contact from behind counts, too. A run that ends before the impact, or without its driver, shows nothing."""
    names = []

    def take_over(trace, tick, name):
        names.append(name)
        return taken if tick == 27 else trace

    found = avoidance(crash(), "leader-unanswered", take_over)
    assert found == (Avoidance(time=1.8, braking=6.0) if is_free else None)
    assert {*names} == {"steady-braking"}


@table(("npc_speed", "is_free"), [(10.0, False), (17.0, True)])
def test_run_that_ends_before_ego_stands_is_driven_on(npc_speed, is_free):
    """At its end the ego is 2 m behind the NPC with 17.6 m/s, and brakes."""
    taken = braked(ticks=33)
    states = taken.states.copy()
    states[28:, 1, SPEED] = npc_speed
    taken = replace(taken, states=states)
    found = avoidance(crash(), "leader-unanswered", lambda trace, tick, name: taken if tick == 27 else trace)
    assert (found is not None) == is_free


def test_braking_through_another_vehicle_avoids_nothing():
    through = braked()
    states = through.states.copy()
    states[90:100, 0, X] = states[90:100, 1, X]
    taken = replace(through, states=states)
    assert avoidance(crash(), "leader-unanswered", lambda trace, tick, name: taken if tick == 27 else trace) is None


class Declares:
    """A world in which each driver avoids the collision, and which refuses names that it does not declare."""

    def __init__(self, *drivers, also=()):
        self.reference_drivers, self.takes_over = drivers, also

    def take_over(self, trace, tick, name):
        assert name in (*self.reference_drivers, *self.takes_over)
        return braked() if tick == 27 else trace


@table(
    ("world", "driver", "brakes"),
    [
        (Declares("calm", "careful-human", also=("steady-braking",)), "careful-human", True),
        (Declares("calm", "quick"), "calm", False),
        (Declares("steady-braking", "calm"), "calm", True),
        (Declares(also=("steady-braking",)), None, True),
    ],
)
def test_only_drivers_that_world_declares_take_over(world, driver, brakes):
    trace = crash()
    chance = last_chance(trace, "leader-unanswered", world.take_over)
    assert (chance and chance.driver) == driver
    assert driver is None or f": {driver} " in chance.sentence
    assert (avoidance(trace, "leader-unanswered", world.take_over) is not None) is brakes


@table("outcome", [Outcome.ADS_ERROR, Outcome.HANG])
def test_driver_that_fails_itself_is_no_chance(outcome):
    trace = crash()
    assert scanned(trace, chances={27}, survived=replace(trace, outcome=outcome, collision=None))[0] is None


@table("fault", [None, "entered-lane", "braked-for-nothing", "stopped-for-nothing"])
def test_braking_is_not_tried_for_other_faults(fault):
    assert avoidance(crash(), fault, lambda *_: pytest.fail("simulated")) is None


def test_last_chance_reports_driver_and_ego_actions():
    trace = crash()
    states, taken = trace.states.copy(), trace.states.copy()
    states[13, 0, [ACCELERATION, STEERING]] = 0.8, -0.00012
    taken[13, 0, [ACCELERATION, STEERING]] = -4.00049, 0.0126
    trace, survived = replace(trace, states=states), replace(trace, states=taken, outcome=Outcome.SAFE, collision=None)
    chance, _ = scanned(trace, chances={12}, survived=survived)
    assert chance == LastChance(time=0.8, driver="careful-human", action=(-4.0, 0.013), ego_action=(0.8, 0.0))
    assert chance.sentence == (
        "Last chance at 0.8 s: careful-human brakes at 4.0 m/s^2, the ego accelerates at 0.8 m/s^2"
    )


def test_who_neither_brakes_nor_accelerates_keeps_its_speed():
    chance = LastChance(time=3.0, driver="careful-human", action=(1.5, 0.0), ego_action=(-0.04, 0.0))
    assert chance.sentence == ("Last chance at 3.0 s: careful-human accelerates at 1.5 m/s^2, the ego keeps its speed")


@pytest.mark.parametrize("closing", [3.0, 5.0])
def test_last_chance_is_where_full_braking_still_suffices(closing):
    """The leader has arrived ahead and keeps its speed, so the textbook formula gives the distance.

    The driver expects full braking by then: the time to collision has been below 2 s for 1.43 s.
    """
    world = Highway(clearance=30.0)  # at that gap the leader has arrived
    scenario = Scenario(npcs=[[PositionInstruction(2, 22.0 - closing)]], ego_speed=22.0, gene_seconds=20.0)
    trace = world.rollout(scenario, lambda: lambda observation: (0.0, 0.0))
    gap = trace.npcs[:, 0, X] - trace.ego[:, X] - LENGTH
    decisions = range(0, trace.ticks, 3)
    needed = closing**2 / (2 * HARD_BRAKING) + closing * trace.dt / 2  # a tick's speed is the one at its beginning
    assert trace.npcs[-45:, 0, SPEED] == pytest.approx(22.0 - closing, abs=0.01)
    expected = max(tick for tick in decisions if gap[tick] > needed)
    chance = last_chance(trace, rss_rule(trace).fault, world.take_over)
    assert chance.time == round(expected / 15, 3)
    assert chance.action[0] == pytest.approx(-HARD_BRAKING, abs=0.001)
    assert chance.ego_action == (0.0, 0.0)
    needed = closing**2 / (2 * 6.0) + closing * trace.dt / 2
    expected = max(tick for tick in decisions if gap[tick] > needed)
    assert avoidance(trace, "leader-unanswered", world.take_over).time == round(expected / 15, 3)
