"""Manoeuvres and their steps: which are valid, what they say in words, and the errors about the others."""

from __future__ import annotations

import json
import math
import pickle

import numpy as np
import pytest
from hypothesis import given

from pytest_pafot import strategies
from pytest_pafot.model.instructions import (
    MOST_STEPS,
    LaneInstruction,
    Manoeuvre,
    PositionInstruction,
    ScenarioError,
    Step,
)
from pytest_pafot.model.scenario import Scenario, retimed
from tests.helpers.tables import table

CUT_IN = Manoeuvre(
    beside=-1,
    ahead=30.0,
    speed=20.0,
    steps=(Step(gap=20.0, lane="right"), Step(headway=-0.5, speed=5.0, acceleration=6.0), Step(after=1.5, offset=-0.5)),
)


def manoeuvre(**changes):
    return Manoeuvre(**({"beside": 0, "ahead": 30.0, "speed": 20.0} | changes))


def in_scenario(each, **fields):
    return Scenario(npcs=((each,),), **fields)


# --- valid ones


def test_plain_and_numpy_numbers_are_the_same():
    plain = manoeuvre(beside=1, ahead=-7, speed=3, steps=[Step(gap=12, offset=-1, speed=0)])
    others = Step(gap=np.float64(12), offset=np.int64(-1), speed=np.float64(0.0))
    assert manoeuvre(beside=np.int64(1), ahead=np.float64(-7), speed=np.int32(3), steps=others) == plain
    assert [type(value) for value in (plain.beside, plain.ahead, plain.speed)] == [int, float, float]


def test_numbers_are_exact_tenths_without_negative_zero():
    step = Step(headway=0.1 + 0.2, offset=-0.0, acceleration=3 * 1.1)
    assert (step.headway, step.acceleration) == (0.3, 3.3)
    assert math.copysign(1.0, step.offset) == 1.0


def test_a_gap_of_zero_is_a_distance():
    assert [Step(gap=0.0).is_by_distance, Step(headway=0.0).is_by_distance, Step().is_by_distance] == [
        True,
        True,
        False,
    ]


@table(
    ("each", "words"),
    [
        (manoeuvre(), "30 m ahead, in lane"),
        (manoeuvre(ahead=-7.5, beside=1), "7.5 m behind, 1 lane right"),
        (manoeuvre(ahead=0.0, beside=-2), "level, 2 lanes left"),
        (manoeuvre(steps=(Step(),)), "30 m ahead, in lane; hold"),
        (
            CUT_IN,
            "30 m ahead, 1 lane left; at a gap of 20 m right at 1.5 m/s; "
            "at a headway of 0.5 s behind to 5 m/s at 6 m/s^2; 1.5 s later 0.5 m left of the centre",
        ),
    ],
)
def test_goal_says_the_start_and_each_step(each, words):
    assert each.goal == words


# --- refused ones


@table(
    ("fields", "field", "expected", "received"),
    [
        ({"gap": 500.1}, "gap", "a number from -500 to 500 in steps of 0.1", "500.1"),
        ({"gap": 20.05}, "gap", "a number from -500 to 500 in steps of 0.1", "20.05"),
        ({"gap": math.nan}, "gap", "a finite number", "nan"),
        ({"gap": "20"}, "gap", "a finite number", "'20'"),
        ({"gap": True}, "gap", "a finite number", "True"),
        ({"headway": -20.1}, "headway", "a number from -20 to 20 in steps of 0.1", "-20.1"),
        ({"headway": -math.inf}, "headway", "a finite number", "-inf"),
        ({"after": -0.1}, "after", "a number from 0 to 600 in steps of 0.1", "-0.1"),
        ({"after": 10**400}, "after", "a finite number", repr(10**400)),
        ({"lateral_speed": 0.0}, "lateral_speed", "a number from 0.1 to 5 in steps of 0.1", "0.0"),
        ({"offset": 2.0}, "offset", "a number from -1.9 to 1.9 in steps of 0.1", "2.0"),
        ({"speed": -0.1}, "speed", "a number from 0 to 1000 in steps of 0.1", "-0.1"),
        ({"acceleration": -3.0}, "acceleration", "a number from 0.1 to 20 in steps of 0.1", "-3.0"),
        ({"lane": "middle"}, "lane", "one of keep, left, right", "'middle'"),
        ({"lane": 1}, "lane", "one of keep, left, right", "1"),
        ({"gap": 5.0, "headway": 1.0}, "step", "one of gap, headway and after", "gap and headway"),
        ({"headway": 0.0, "after": 1.0}, "step", "one of gap, headway and after", "headway and after"),
    ],
)
def test_each_wrong_value_of_a_step_is_refused(fields, field, expected, received):
    with pytest.raises(ScenarioError) as caught:
        Step(**fields)
    assert (caught.value.field, caught.value.expected, caught.value.received) == (field, expected, received)


@table(
    ("fields", "field", "expected", "received"),
    [
        ({"beside": 9}, "beside", "a whole number of lanes from -8 to 8, positive to the right", "9"),
        ({"beside": 0.5}, "beside", "a whole number of lanes from -8 to 8, positive to the right", "0.5"),
        ({"beside": "left"}, "beside", "a whole number of lanes from -8 to 8, positive to the right", "'left'"),
        ({"ahead": 500.1}, "ahead", "a number from -500 to 500 in steps of 0.1", "500.1"),
        ({"ahead": 1.23}, "ahead", "a number from -500 to 500 in steps of 0.1", "1.23"),
        ({"ahead": 0.0}, "ahead", "a distance other than 0 in the ego's lane", "0"),
        ({"speed": -1.0}, "speed", "m/s, at least 0 and in steps of 0.1", "-1.0"),
        ({"speed": None}, "speed", "a finite number", "None"),
        ({"steps": [{"gap": 5.0}]}, "steps", f"at most {MOST_STEPS} of pafot.Step(...)", "[{'gap': 5.0}]"),
        ({"steps": None}, "steps", f"at most {MOST_STEPS} of pafot.Step(...)", "None"),
        ({"steps": (Step(),) * 17}, "steps", f"at most {MOST_STEPS} of pafot.Step(...)", repr((Step(),) * 17)),
    ],
)
def test_each_wrong_value_of_a_manoeuvre_is_refused(fields, field, expected, received):
    with pytest.raises(ScenarioError) as caught:
        manoeuvre(**fields)
    assert (caught.value.field, caught.value.expected, caught.value.received) == (field, expected, received)


@table(
    ("fields", "fix"),
    [
        ({"gap": 512.3}, "the nearest is 500"),
        ({"gap": 20.06}, "the nearest is 20.1"),
        ({"acceleration": -1e300}, "the nearest is 0.1"),
    ],
)
def test_refusal_gives_the_nearest_number(fields, fix):
    with pytest.raises(ScenarioError, match=f"; {fix}$"):
        Step(**fields)


def test_manoeuvre_is_the_only_gene_of_its_npc():
    for chain, field in (
        ((CUT_IN, CUT_IN), "npcs[0][1]"),
        ((CUT_IN, LaneInstruction("keep", 20.0)), "npcs[0][1]"),
        ((PositionInstruction(2, 20.0), CUT_IN), "npcs[0][1]"),
    ):
        with pytest.raises(ScenarioError) as caught:
            Scenario(npcs=(chain,))
        assert caught.value.field == field


# --- in scenarios


def test_manoeuvre_lasts_for_the_whole_run():
    scenario = Scenario(npcs=((CUT_IN,), (PositionInstruction(6, 20.0),) * 3))
    assert scenario.seconds == math.inf
    assert scenario.truncated(1).npcs[0] == (CUT_IN,)
    assert retimed((CUT_IN,), 10.0, 2.5) == (CUT_IN,)
    assert scenario.rechained(scenario.npcs, gene_seconds=2.0).npcs == scenario.npcs


def test_canonical_text_contains_what_differs_from_the_defaults():
    plain = json.loads(in_scenario(CUT_IN).canonical())
    steps = [
        {"gap": 20.0, "lane": "right"},
        {"headway": -0.5, "speed": 5.0, "acceleration": 6.0},
        {"after": 1.5, "offset": -0.5},
    ]
    assert plain[0] == [[["manoeuvre", 20.0, -1, 30.0, steps]]]


@given(strategies.manoeuvres(), strategies.manoeuvres())
def test_canonical_text_and_pickle_give_the_same_manoeuvre(one, other):
    first, second = in_scenario(one), in_scenario(other)
    for again in (Scenario.from_canonical(json.loads(first.canonical())), pickle.loads(pickle.dumps(first))):
        assert again == first
        assert (hash(again), again.id, again.npcs[0][0].text) == (hash(first), first.id, one.text)
    assert (first == second) == (one == other) == (first.canonical() == second.canonical()) == (one.code == other.code)


@given(strategies.manoeuvres(beside=[2], max_distance=5.0, max_steps=1, min_speed=3.0, max_speed=4.0))
def test_strategy_keeps_to_its_bounds(each):
    assert each.beside == 2
    assert 1.0 <= abs(each.ahead) <= 5.0
    assert len(each.steps) <= 1
    assert all(3.0 <= speed <= 4.0 for speed in (each.speed, *(step.speed or 3.0 for step in each.steps)))


@table("bounds", [{"beside": ()}, {"max_distance": 0.9}, {"max_steps": 17}, {"max_steps": -1}, {"min_speed": 30.0}])
def test_strategy_without_manoeuvres_is_refused(bounds):
    with pytest.raises(ValueError, match="expected"):
        strategies.manoeuvres(**bounds)
