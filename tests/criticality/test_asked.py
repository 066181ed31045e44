"""Whether a run with manoeuvres came up as it was asked for, against a second computation from the positions alone."""

from __future__ import annotations

import math
import random
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from pytest_pafot import Highway
from pytest_pafot.criticality.asked import asked
from pytest_pafot.model.driving_style import Traffic
from pytest_pafot.model.instructions import Manoeuvre, PositionInstruction, Step
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import ALONG, SPEED, STRETCH, Outcome, X, Y
from pytest_pafot.oracle.run import Run
from tests.helpers.tables import table
from tests.helpers.world_cases import constant_speed, stopping
from tests.world.test_manoeuvres import in_a_bend

HIGHWAY = Highway(duration=12.0)


def drive(*steps, beside=1, ahead=30.0, speed=15.0, ads=constant_speed, world=HIGHWAY, **fields):
    """Return the run of an NPC that starts 30 m ahead in the lane to the right, 5 m/s slower than the ego."""
    npc = Manoeuvre(beside=beside, ahead=ahead, speed=speed, steps=steps)
    return world.rollout(Scenario(npcs=((npc,),), **({"ego_speed": 20.0} | fields)), ads)


def missed(trace):
    """Return what was not as asked, in words."""
    return [each.words for each in asked(trace) if not each.is_met]


def measured(trace, npc=0):
    """Return what each step of an NPC that began asked for and what it was, from positions at 15 Hz, by its name.

    Speeds and accelerations are differences of positions, so that they differ by half a tick from those in the trace.
    """
    hz, x, y = trace.physics_hz, trace.states[..., X], trace.states[..., Y]
    speeds = np.hypot(np.diff(x, axis=0), np.diff(y, axis=0)) * hz
    steps, begun = trace.scenario.npcs[npc][0].steps, trace.begun[npc]
    speed, found = trace.scenario.npcs[npc][0].speed, []
    timed = [not each.is_by_distance for each in steps]
    for number, (step, begin) in enumerate(zip(steps, begun, strict=False)):
        # A timed step begins after all before it were done.
        after = [later for later in range(number + 1, len(begun)) if timed[later]]
        waits = len(begun) < len(steps) and trace.outcome is not Outcome.COLLISION
        end = begun[after[0]] if after else trace.ticks if waits else trace.arrivals[npc][0]
        beside = steps[number + 1 : after[0] if after else len(begun)]
        now = min(begin, trace.ticks - 1)
        distance, facts = x[begin, npc + 1] - x[begin, 0], {}
        gap = math.copysign(max(abs(distance) - 5.0, 0.0), distance)
        if step.gap is not None:
            facts["gap"] = step.gap, gap, 1.0 + 0.05 * abs(step.gap)
        if step.headway is not None:
            rear = speeds[now, 0 if gap > 0 else npc + 1]
            facts["headway"] = step.headway, gap / max(rear, 0.1), 0.1 + 0.05 * abs(step.headway)
        if number == 0 or not step.is_by_distance:
            facts["speed"] = speed, speeds[now, npc + 1], 1.0
        change = 0.0 if step.speed is None else step.speed - trace.states[begin, npc + 1, SPEED]
        speed = speed if step.speed is None else step.speed
        if end is not None:
            if step.lane != "keep" and not any(each.lane != "keep" for each in beside):
                aside = np.abs(np.diff(y[begin : end + 1, npc + 1])) * hz
                facts["lateral speed"] = step.lateral_speed, max(aside, default=0.0), 0.2 + 0.1 * step.lateral_speed
            if abs(change) >= 3 and all(each.speed is None for each in beside):
                rates = np.diff(speeds[begin : end + 1, npc + 1]) * hz * np.sign(change)
                facts["acceleration"] = step.acceleration, max(rates, default=0.0), 0.2 * step.acceleration
        found.append(facts)
    return found


def random_steps(rng):
    """Return steps of which each has time to be done, most of them with another lane or speed."""
    for _ in range(rng.randint(1, 3)):
        trigger = rng.choice([{"after": 0.5}, {"gap": rng.choice([10.0, 24.0])}, {"headway": rng.choice([-0.5, 1.0])}])
        speed = rng.choice([None, rng.choice([12.0, 18.0, 22.0, 26.0])])
        lane, acceleration = rng.choice(["keep", "right"]), rng.choice([2.0, 4.0, 9.0])
        yield Step(
            **trigger, lane=lane, lateral_speed=rng.choice([0.8, 2.0, 4.5]), speed=speed, acceleration=acceleration
        )


def test_everything_asked_for_is_measured_as_from_positions():
    rng, names, results, world = random.Random(2), set(), set(), Highway(lanes=6, duration=12.0)
    for _ in range(60):
        start = {"ahead": rng.choice([-20.0, 15.0, 30.0]), "speed": rng.choice([15.0, 24.0])}
        trace = drive(*random_steps(rng), **start, world=world, ads=rng.choice([constant_speed, stopping]))
        second = measured(trace)
        for each in asked(trace):
            if each.what in ("ego speed", "step", "end"):
                continue
            wanted, was, tolerance = second[each.step].pop(each.what)
            near = 0.5 if each.what != "acceleration" else 0.8
            assert (each.asked, each.tolerance, each.npc) == (wanted, pytest.approx(tolerance), 0)
            assert each.was == pytest.approx(was, abs=near), trace.scenario.canonical()
            assert each.is_met == (abs(was - wanted) <= tolerance) or abs(abs(was - wanted) - tolerance) < near
            names.add(each.what)
            results.add(each.is_met)
        assert not any(second), "nothing is left out"
        never = len(trace.begun[0]) < len(trace.scenario.npcs[0][0].steps)
        unfinished = trace.arrivals == ((None,),) and trace.collision is None
        whats = {each.what for each in asked(trace)}
        assert ("step" in whats, "end" in whats) == (never, unfinished and not never), trace.scenario.canonical()
    assert names == {"gap", "headway", "speed", "lateral speed", "acceleration"}
    assert results == {True, False}


def test_run_as_asked_meets_every_part():
    trace = drive(
        Step(gap=20.0, lane="right", lateral_speed=1.2), Step(headway=0.5, speed=10.0), Step(after=1.0, speed=15.0)
    )
    assert Run(trace).as_asked
    whats = ["ego speed", "gap", "speed", "lateral speed", "headway", "acceleration", "speed", "acceleration"]
    assert [each.what for each in asked(trace)] == whats
    assert [each.step for each in asked(trace)] == [0, 0, 0, 0, 1, 1, 2, 2]


def test_without_manoeuvres_there_is_nothing_to_ask():
    trace = HIGHWAY.rollout(Scenario(npcs=[[PositionInstruction(2, 15.0)]]), constant_speed)
    assert asked(trace) == ()
    assert Run(trace).as_asked


# --- not as asked


def test_ego_that_sped_up_meets_another_situation():
    """The gap is as asked, but not the speed with which the ego comes nearer."""

    def hurrying():
        return lambda observation: (2.0, 0.0)

    trace = drive(Step(gap=20.0, speed=10.0), ads=hurrying)
    speed = trace.ego[trace.begun[0][0], 3]
    assert speed > 22.0
    assert missed(trace) == [f"ego speed asked 20 m/s, was {speed:.1f} m/s"]
    assert asked(drive(Step(after=2.0, speed=10.0), ads=hurrying))[0].what == "speed", "only distances depend on it"


def test_ego_may_react_after_the_first_distance_of_any_npc():
    """Its speed is what it is when the NPC with the higher number begins its step, which is earlier."""

    def reacting():
        return lambda observation: (-4.0 if observation.time > 1 else 0.0, 0.0)

    late, early = (
        Manoeuvre(beside=each, ahead=30.0, speed=10.0, steps=(Step(gap=gap),)) for each, gap in ((1, 12.0), (-1, 25.0))
    )
    trace = HIGHWAY.rollout(Scenario(npcs=((late,), (early,)), ego_speed=20.0), reacting)
    assert trace.ego[trace.begun[0][0], 3] < 19.0
    assert [(each.npc, each.is_met) for each in asked(trace) if each.what == "ego speed"] == [(1, True)]


@table(
    ("steps", "fields", "words"),
    [
        ([{"gap": 20.0}], {"speed": 25.0}, ["step 0 did not come up"]),
        ([{}, {"headway": 0.2}, {}], {"speed": 25.0}, ["step 1 did not come up"]),
        ([{"speed": 0.0, "acceleration": 1.0}], {}, ["step 0 was not done"]),
        ([{"lane": "left"}], {"ahead": 0.0, "speed": 20.0, "traffic": Traffic("hostile")}, ["step 0 was not done"]),
        ([{"lane": "left"}], {"beside": -1}, ["step 0 was for a lane that the road does not have"]),
        ([{"speed": 0.0, "acceleration": 12.0}], {}, ["acceleration asked 12 m/s^2, was 8.0 m/s^2"]),
        ([{"lane": "right", "lateral_speed": 5.0}], {}, ["lateral speed asked 5 m/s, was 3.2 m/s"]),
        ([{"gap": 40.0, "speed": 26.0}], {"speed": 26.0, "ahead": 45.0}, ["step 0 did not come up"]),
    ],
)  # fmt: skip
def test_what_was_not_as_asked_is_named(steps, fields, words):
    trace = drive(*(Step(**step) for step in steps), **fields)
    assert trace.outcome is Outcome.SAFE
    assert missed(trace) == words
    assert Run(trace).as_asked is False
    assert f"    not as asked: {words[0]}" in Run(trace).explain().splitlines()


def test_step_without_time_before_a_collision_is_not_evaluated():
    trace = drive(Step(gap=2.0, speed=0.0, acceleration=8.0), beside=0, ahead=10.0, speed=16.0)
    assert trace.outcome is Outcome.COLLISION
    assert trace.duration - trace.begun[0][0] * trace.dt < 0.5
    assert trace.arrivals == ((None,),)
    assert [each.what for each in asked(trace)] == ["ego speed", "gap", "speed"]
    assert Run(trace).as_asked


def test_collision_does_not_change_what_came_up_as_asked():
    """The NPC does the same, whether the ego hits it in the middle of its step or lets it finish."""

    def braking():
        return lambda seen: (-8.0 if seen.others[0].x - seen.ego.x < 29.0 else 0.0, 0.0)

    answers, crashes, fields = set(), 0, {"ahead": 40.0, "ego_speed": 14.0, "world": Highway(duration=30.0)}
    for speed, lateral_speed, slower in product([3.0, 6.0, 10.0], [1.0, 2.0, 3.0], [None, 2.0]):
        step = Step(gap=25.0, lane="left", lateral_speed=lateral_speed, speed=slower, acceleration=10.5)
        hit, safe = (drive(step, speed=speed, ads=ads, **fields) for ads in (constant_speed, braking))
        assert safe.outcome is Outcome.SAFE
        if hit.arrivals == ((None,),):
            crashes += hit.outcome is Outcome.COLLISION
            assert missed(hit) == missed(safe)
            answers.add(tuple(each.what for each in asked(hit) if not each.is_met))
    assert crashes > 10
    assert answers == {(), ("lateral speed",), ("acceleration",), ("lateral speed", "acceleration")}


def test_collision_with_one_npc_leaves_the_steps_of_others_no_time():
    first = Manoeuvre(beside=1, ahead=30.0, speed=10.0, steps=(Step(gap=20.0, lane="left", lateral_speed=2.0),))
    second = Manoeuvre(beside=1, ahead=90.0, speed=10.0, steps=(Step(gap=5.0, lane="left"),))
    trace = HIGHWAY.rollout(Scenario(npcs=((first,), (second,)), ego_speed=20.0), constant_speed)
    assert trace.outcome is Outcome.COLLISION
    assert [len(begun) for begun in trace.begun] == [1, 0]
    assert missed(trace) == []


def test_lateral_speed_that_grows_with_the_speed_has_not_built_up():
    pulls_out = Step(gap=3.0, lane="left", lateral_speed=1.0, speed=5.0, acceleration=0.5)

    def swerving():
        return lambda seen: (0.0, 0.03 if seen.time > 2.1 else 0.0)

    trace = drive(pulls_out, ahead=60.0, speed=0.0, ads=swerving)
    assert trace.outcome is Outcome.COLLISION
    assert missed(trace) == []


def test_ego_off_the_road_leaves_a_step_no_time():
    trace = in_a_bend(Step(gap=14.0), Step(after=5.0, speed=2.0))
    assert "step" in {each.what for each in asked(trace)}
    left = replace(trace, outcome=Outcome.OFF_ROAD, off_road_tick=trace.ticks)
    assert "step" not in {each.what for each in asked(left)}


def test_steps_that_overlap_are_judged_by_what_they_did():
    def answering():
        return lambda observation: (-5.0 if observation.time > 1.5 else 0.0, 0.0)

    steps = Step(gap=25, lane="left", lateral_speed=2.0), Step(gap=24, speed=10.0), Step(after=1.0, speed=20.0)
    whats = [each.what for each in asked(drive(*steps, ads=answering)) if each.what != "ego speed"]
    assert whats == ["gap", "speed", "lateral speed", "gap", "acceleration", "speed", "acceleration"]
    assert missed(drive(*steps, ads=answering)) == []
    begun_twice = drive(Step(gap=25, speed=5.0), Step(gap=24, speed=10.0), ads=answering)
    assert [each.step for each in asked(begun_twice) if each.what == "acceleration"] == [1], "the first had no time"


def test_npc_that_others_slow_down_begins_at_another_speed():
    """In hostile traffic it brakes behind the ego, which brakes first."""
    trace = drive(
        Step(after=4.0, speed=5.0), beside=0, ahead=-25.0, speed=24.0, traffic=Traffic("hostile"), ads=stopping
    )
    words = missed(trace)
    assert words[0].startswith("speed asked 24 m/s, was ")


def test_gap_in_a_bend_is_in_metres_of_the_egos_lane():
    trace = in_a_bend(Step(gap=14.0))
    own, other = trace.track[trace.begun[0][0], :2]
    gap = next(each for each in asked(trace) if each.what == "gap")
    assert gap.was == pytest.approx((other[ALONG] - own[ALONG]) * own[STRETCH] - 5.0)
    assert gap.is_met


def test_run_explains_when_each_step_began():
    lines = Run(drive(Step(gap=20.0, lane="right"), Step(gap=-90.0, speed=5.0))).explain().splitlines()
    assert "  NPC 0: 30 m ahead, 1 lane right, 15.0 m/s" in lines
    assert "     2.0 s  at a gap of 20 m right at 1.5 m/s" in lines
    assert "     never  at a gap of 90 m behind to 5 m/s at 3 m/s^2" in lines
    assert "    not as asked: step 1 did not come up" in lines
