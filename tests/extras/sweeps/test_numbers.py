"""The numbers of a scenario that a sweep changes: their names, and their values on an axis."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import pytest_pafot as pafot
from pytest_pafot.extras.sweeps.numbers import (
    LEVELS,
    Axis,
    names_in,
    over_of,
    unit_of,
    values_of,
    with_number,
    words_of,
)
from pytest_pafot.model.instructions import CrossingInstruction, Manoeuvre, ScenarioError, Step
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.support.errors import RequestError
from tests.helpers.tables import table

TENTHS = st.integers(1, 50).map(lambda number: number / 10)
CROSSINGS = st.builds(CrossingInstruction, st.just("o1>o3"), TENTHS, TENTHS)
ALONE = st.lists(pafot.strategies.manoeuvres() | CROSSINGS, min_size=1, max_size=3)
SCENARIOS = pafot.strategies.scenarios() | ALONE.map(lambda genes: Scenario(npcs=tuple((gene,) for gene in genes)))


def number_of(scenario, name):
    """Return the number with a name."""
    if not name.startswith("npcs."):
        return {"ego.speed": scenario.ego_speed, "gene_seconds": scenario.gene_seconds}[name]
    _, npc, *path = name.split(".")
    value = scenario.npcs[int(npc)]
    if not path[0].isdecimal():
        (value,) = value
    for part in path:
        value = value[int(part)] if part.isdecimal() else getattr(value, part)
    return value


def begins_by_distance(scenario, name):
    return name.endswith(".after") and number_of(scenario, name.replace(".after", "")).is_by_distance


@given(SCENARIOS, TENTHS, st.data())
def test_every_named_number_can_be_set_and_read_back(scenario, value, data):
    name = data.draw(st.sampled_from(names_in(scenario)))
    before = number_of(scenario, name)
    if begins_by_distance(scenario, name):  # it cannot begin after a time, too
        with pytest.raises(ScenarioError, match="one of gap, headway and after"):
            with_number(scenario, name, value)
        return
    changed = with_number(scenario, name, value)
    assert number_of(changed, name) == value
    assert with_number(changed, name, before) == scenario
    assert unit_of(name) in ("m", "s", "m/s", "m/s^2")


def test_names_say_where_a_number_is():
    steps = (Step(gap=20.0, lane="left"), Step(after=1.0, speed=3.0))
    told = Scenario(npcs=((Manoeuvre(beside=1, ahead=9.0, speed=8.0, steps=steps),),))
    assert names_in(told) == [
        "ego.speed",
        "npcs.0.speed",
        "npcs.0.ahead",
        *(f"npcs.0.steps.0.{name}" for name in ("gap", "after", "lateral_speed", "offset", "acceleration")),
        *(f"npcs.0.steps.1.{name}" for name in ("after", "lateral_speed", "offset", "speed", "acceleration")),
    ]
    on_grid = Scenario(npcs=((pafot.PositionInstruction(1, 9.0), pafot.PositionInstruction(2, 8.0)),))
    assert names_in(on_grid) == ["ego.speed", "gene_seconds", "npcs.0.0.speed", "npcs.0.1.speed"]
    crossing = Scenario(npcs=((CrossingInstruction("o1>o3", 1.0, 8.0),),))
    assert names_in(crossing) == ["ego.speed", "npcs.0.speed", "npcs.0.slot"]


ONE = Scenario(npcs=((pafot.PositionInstruction(1, 9.0),),))


@table(
    "name",
    ["", "ego", "ego.lane", "seed", "npcs", "npcs.0", "npcs.0.speed", "npcs.0.0.cell", "npcs.1.0.speed",
     "npcs.-1.0.speed", "npcs.x.0.speed", "npcs.0.0.speed.x", "gap"],
)  # fmt: skip
def test_unknown_name_is_refused_with_all_names(name):
    with pytest.raises(RequestError, match=r"over: expected one of ego\.speed, gene_seconds, npcs\.0\.0\.speed, rec"):
        with_number(ONE, name, 3.0)


@table(
    ("name", "value"),
    [("ego.speed", -1.0), ("npcs.0.0.speed", -0.1), ("npcs.0.0.speed", 1001.0), ("gene_seconds", 0.0),
     ("ego.speed", math.nan), ("npcs.0.0.speed", math.inf)],
)  # fmt: skip
def test_impossible_value_is_a_scenario_error(name, value):
    with pytest.raises(ScenarioError):
        with_number(ONE, name, value)


def test_number_is_rounded_to_tenths():
    assert with_number(ONE, "npcs.0.0.speed", 3.1416).npcs[0][0].speed == 3.1
    assert math.copysign(1, with_number(ONE, "ego.speed", -0.01).ego_speed) == 1


@table(
    ("given", "values"),
    [
        ("0:60:7", (0, 10, 20, 30, 40, 50, 60)),
        ("60:0:3", (0, 30, 60)),
        ("-1:1:3", (-1, 0, 1)),
        ("0:1:4", (0, 0.3333, 0.6667, 1)),
        ([3, 1, 2.5], (1, 2.5, 3)),
        (range(3), (0, 1, 2)),
        ([np.float64(1), np.int64(2)], (1, 2)),
        (f"1:{LEVELS}:{LEVELS}", tuple(range(1, LEVELS + 1))),
    ],
)
def test_values_are_given_as_ends_and_count_or_as_numbers(given, values):
    assert values_of("gap", given) == values


@table(
    "given",
    ["", "0:60", "0:60:7:1", "a:b:c", "0:60:1", "0:60:2.5", "0:60:-2", f"0:1:{LEVELS + 1}", "nan:1:3", "0:inf:3",
     "1:1:2", "-1e308:1e308:3", [], [1], [1, 1], [1, True], [1, "2"], [1, math.nan], [1, None], range(LEVELS + 1), 5,
     None, {1: 2}],
)  # fmt: skip
def test_other_values_are_refused(given):
    with pytest.raises(
        RequestError, match=r"over: gap: expected first:last:count, such as 0:60:7, or .* 2 to 200 of them"
    ):
        values_of("gap", given)


def test_arguments_name_different_axes():
    assert over_of(["gap=0:60:7", "npcs.0.speed=0:1:2"]) == {"gap": "0:60:7", "npcs.0.speed": "0:1:2"}
    for wrong in (["gap"], ["gap="], ["=0:60:7"], ["gap=0:1:2", "gap=0:1:3"], ["a b=0:1:2"]):
        with pytest.raises(RequestError, match="--over: expected different NAME=FIRST:LAST:COUNT"):
            over_of(wrong)


def test_title_of_an_axis_has_its_unit_if_any():
    assert Axis("gap", (0.0, 1.0), "m").title == "gap [m]"
    assert Axis("side", (-1.0, 1.0), "").title == "side"


@table(
    ("name", "words"),
    [
        ("ego.speed", "First speed of the ego [m/s]"),
        ("npcs.0.2.speed", "Speed of NPC 0 in instruction 2 [m/s]"),
        ("npcs.1.steps.0.headway", "Distance in time of NPC 1, step 0 [s]"),
    ],
)
def test_an_axis_of_a_finding_is_in_words(name, words):
    assert Axis(name, (0.0, 1.0), unit_of(name), words_of(name)).words == words
