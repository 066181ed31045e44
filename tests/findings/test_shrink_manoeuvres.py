"""Shrinking manoeuvres, with predicates instead of runs."""

from __future__ import annotations

from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.findings.shrink import instructions, sort_key
from pytest_pafot.model.instructions import Manoeuvre, PositionInstruction, Step
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.strategies import manoeuvres
from tests.helpers.shrinking import shrink
from tests.helpers.tables import table

BUSY = Manoeuvre(
    beside=1,
    ahead=33.3,
    speed=17.3,
    steps=(
        Step(lane="right", lateral_speed=0.7),
        Step(gap=21.7, lane="left", offset=-0.4, speed=9.1, acceleration=6.2),
        Step(headway=1.3, speed=23.0),
    ),
)


def scenario(*npcs):
    return Scenario(npcs=tuple(npc if isinstance(npc, tuple) else (npc,) for npc in npcs))


def shrunk(given, fails, *, rollouts=2000):
    """Shrink by a predicate of the first manoeuvre; return the result's, after checks that hold for each result."""
    asked = []

    def attempt(candidate):
        asked.append(candidate)
        return candidate if fails(candidate) else None

    simplest, how = shrink(given, attempt, rollouts=rollouts, top_speed=26.8)
    assert len(asked) == len(set(asked)) == how.rollouts <= rollouts
    assert fails(simplest)
    assert sort_key(simplest) <= sort_key(given)
    assert Scenario.from_canonical(simplest.plain()) == simplest  # with all checks
    return simplest


def some(test):
    """Return a predicate that is true if a test holds for a step of a manoeuvre."""
    return lambda each: any(test(step) for (gene, *_) in each.npcs if type(gene) is Manoeuvre for step in gene.steps)


@table(
    ("test", "step"),
    [
        (lambda step: step.gap is not None, Step(gap=20.0)),
        (lambda step: (step.gap or 0) > 20, Step(gap=22.0)),
        (lambda step: (step.gap or 0) > 20 and step.offset < 0, Step(gap=22.0, offset=-0.4)),
        (lambda step: step.acceleration > 4 and step.gap, Step(gap=20.0, acceleration=6.2)),
        (lambda step: (step.headway or 0) > 1, Step(headway=1.3)),
        (lambda step: step.headway is not None, Step(headway=0.0)),
        (lambda step: step.lane == "right", Step(lane="right")),
        (lambda step: 8 < (step.speed or 0) < 12, Step(gap=20.0, speed=10.0)),
        (lambda step: step.lateral_speed < 1, Step(lateral_speed=0.7)),
    ],
)
def test_only_the_step_that_is_needed_remains_with_plain_numbers(test, step):
    simplest = shrunk(scenario(BUSY, (PositionInstruction(6, 20.0),) * 3), some(test))
    ((manoeuvre,),) = simplest.npcs
    assert manoeuvre.steps == (step,)
    assert manoeuvre.ahead == 35.0
    assert instructions(simplest) == 2


def test_two_steps_stay_in_their_order_if_both_are_needed():
    def fails(each):
        steps = [step for (gene, *_) in each.npcs if type(gene) is Manoeuvre for step in gene.steps]
        return any(step.lane == "right" for step in steps) and bool(steps) and steps[-1].headway is not None

    (found,) = shrunk(scenario(BUSY), fails).npcs[0]
    assert [step.trigger for step in found.steps] == ["", "at a headway of 0 s"]


def test_start_in_the_egos_lane_never_becomes_level_with_it():
    near = Manoeuvre(beside=0, ahead=2.4, speed=20.0)
    (found,) = shrunk(scenario(near), lambda each: type(each.npcs[0][0]) is Manoeuvre).npcs[0]
    assert found == replace(near, ahead=2.0)
    (found,) = shrunk(scenario(replace(near, beside=1)), lambda each: type(each.npcs[0][0]) is Manoeuvre).npcs[0]
    assert found.ahead == 0.0


@table(
    ("simple", "rough"),
    [
        ({"steps": ()}, {"steps": (Step(),)}),
        ({"steps": (Step(gap=20.0),)}, {"steps": (Step(gap=21.0),)}),
        ({"steps": (Step(gap=21.0),)}, {"steps": (Step(gap=20.5),)}),
        ({"steps": (Step(headway=1.0),)}, {"steps": (Step(headway=1.1),)}),
        ({"steps": (Step(),)}, {"steps": (Step(lateral_speed=1.0),)}),
        ({"steps": (Step(),)}, {"steps": (Step(offset=1.0),)}),
        ({"steps": (Step(),)}, {"steps": (Step(acceleration=4.0),)}),
        ({"ahead": 30.0}, {"ahead": 31.0}),
        ({"speed": 20.0}, {"speed": 21.0}),
    ],
)
def test_simpler_means_fewer_steps_then_plainer_numbers(simple, rough):
    plain = Manoeuvre(beside=1, ahead=30.0, speed=20.0)
    assert sort_key(scenario(replace(plain, **simple))) < sort_key(scenario(replace(plain, **rough)))


@given(st.lists(manoeuvres(), min_size=1, max_size=2), st.floats(-20, 60))
def test_shrinking_ends_with_a_valid_failing_scenario(npcs, gap):
    given_one, closer = scenario(*npcs), some(lambda step: step.gap is not None and step.gap <= gap)
    shrunk(given_one, lambda each: each == given_one or closer(each), rollouts=200)
