"""Scenarios with manoeuvres are saved and read like others, and as strictly."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given

from pytest_pafot.corpus.reader import parsed
from pytest_pafot.corpus.writer import text_of
from pytest_pafot.model.instructions import LaneInstruction, Manoeuvre, Step
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.strategies import manoeuvres
from pytest_pafot.support.errors import CorpusError
from tests.findings.builders import plain_finding
from tests.helpers.mutations import misread
from tests.helpers.tables import table

PATH = Path("front-2-1f3a9c.pafot.yaml")
CUT_IN = Manoeuvre(
    beside=-1, ahead=30.0, speed=20.0, steps=(Step(gap=20.0, lane="right"), Step(after=1.5, speed=5.0), Step())
)
ASKED = Scenario(npcs=((CUT_IN,), (Manoeuvre(beside=1, ahead=-7.5, speed=12.0),), (LaneInstruction("keep", 20.0),)))
TEXT = text_of(plain_finding(scenario=ASKED))


def test_manoeuvre_is_written_without_defaults():
    lines = TEXT[TEXT.index("  npcs:") : TEXT.index("expect:")].splitlines()
    assert lines[1:] == [
        "    - - {beside: -1, ahead: 30.0, speed: 20.0, "
        "steps: [{gap: 20.0, lane: right}, {after: 1.5, speed: 5.0}, {}]}",
        "    - - {beside: 1, ahead: -7.5, speed: 12.0}",
        "    - - {lane: keep, speed: 20.0}",
    ]
    assert parsed(PATH, TEXT.encode()) == plain_finding(scenario=ASKED)
    assert misread(TEXT, parsed(PATH, TEXT.encode())) == []


@given(manoeuvres(max_steps=16), manoeuvres())
def test_what_is_written_is_read(one, other):
    finding = plain_finding(scenario=Scenario(npcs=((one,), (other,))), original=Scenario(npcs=((other,),)))
    assert parsed(PATH, text_of(finding).encode()) == finding


@table(
    ("old", "new", "field", "expected"),
    [
        ("ahead: 30.0, ", "", "scenario.npcs[0][0]", "the key 'ahead'"),
        ("beside: -1", "beside: 9", "scenario.npcs[0][0].beside", "a whole number of lanes from -8 to 8"),
        ("beside: -1", "beside: -1.0", "scenario.npcs[0][0].beside", "a whole number"),
        ("ahead: 30.0", "ahead: 30.05", "scenario.npcs[0][0].ahead", "a number from -500 to 500 in steps of 0.1"),
        ("ahead: 30.0", "ahead: 30.00000001", "scenario.npcs[0][0].ahead", ""),
        ("speed: 20.0, steps", "speed: -1, steps", "scenario.npcs[0][0].speed", "a finite number, at least 0"),
        ("speed: 20.0, steps", "speed: 20.0, stops", "scenario.npcs[0][0].stops", "one of beside, ahead, speed, steps"),
        ("{gap: 20.0,", "{gap: soon,", "scenario.npcs[0][0].steps[0].gap", "a finite number"),
        ("{gap: 20.0,", "{gap: 20.0, headway: 1.0,", "scenario.npcs[0][0].steps[0]", "one of gap, headway and after"),
        ("lane: right", "lane: middle", "scenario.npcs[0][0].steps[0].lane", "one of keep, left, right"),
        ("{after: 1.5,", "{before: 1.5,", "scenario.npcs[0][0].steps[1].before", "one of gap, headway, after"),
        ("{after: 1.5,", "{after: 1.50000001,", "scenario.npcs[0][0].steps[1].after", ""),
        (", {}]", ", 3]", "scenario.npcs[0][0].steps[2]", ""),
        ("[{gap: 20.0, lane: right}, {after: 1.5, speed: 5.0}, {}]", "5", "scenario.npcs[0][0].steps", ""),
        ("    - - {beside: 1,", "      - {beside: 1,", "scenario.npcs[0][1]", "one Manoeuvre"),
    ],
)
def test_each_broken_rule_is_reported_at_its_field(old, new, field, expected):
    assert TEXT.count(old) == 1
    with pytest.raises(CorpusError) as caught:
        parsed(PATH, TEXT.replace(old, new).encode())
    assert caught.value.field == field
    assert caught.value.expected.startswith(expected)
