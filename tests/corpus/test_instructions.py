"""Scenarios with NPCs that cross, and NPCs in lanes, are saved and read like others, and as strictly."""

from pathlib import Path

import pytest

from pytest_pafot.corpus.reader import parsed
from pytest_pafot.corpus.writer import text_of
from pytest_pafot.findings.finding import Expect
from pytest_pafot.findings.situation import ZoneSituation
from pytest_pafot.model.instructions import (
    CrossingInstruction,
    LaneInstruction,
    PositionInstruction,
)
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Outcome
from pytest_pafot.support.errors import CorpusError
from tests.findings.builders import plain_finding
from tests.helpers.tables import table

PATH = Path("did-not-give-way-left-1f3a9c.pafot.yaml")
SITUATION = ZoneSituation(
    npc=0, time=4.2, npc_enters=1.8, ego_enters=2.0, ego_speed=10.0, npc_speed=8.6
)
CROSSES = Scenario(
    npcs=(
        (CrossingInstruction("o1>o3", 0.5, 8.6),),
        (PositionInstruction(6, 8.0),),
        (CrossingInstruction("o3>o1", -1.0, 5.0, "hold"),),
    ),
    ego_lane=0,
    ego_speed=10.0,
)


def finding_at_zone(**changes):
    expect = Expect(
        failure="AssertionError",
        outcome=Outcome.COLLISION,
        time=6.2,
        npc=0,
        zone="crossing from the left",
        side="left",
        responsibility="ego",
        situation=SITUATION,
    )
    return plain_finding(
        **({"id": PATH.name.partition(".")[0], "scenario": CROSSES, "expect": expect} | changes)
    )


TEXT = text_of(finding_at_zone())


def test_instructions_are_written_without_defaults():
    lines = TEXT[TEXT.index("  npcs:") : TEXT.index("expect:")].splitlines()
    assert lines == [
        "  npcs:",
        "    NPC 0: [{zone: o1>o3, slot: 0.5, speed: 8.6}]",
        "    NPC 1: [{cell: rear, speed: 8.0}]",
        "    NPC 2: [{zone: o3>o1, slot: -1.0, speed: 5.0, act: hold}]",
    ]
    assert "npc: 0, zone: crossing from the left, side: left," in TEXT
    assert (
        "situation: {npc: 0, time: 4.2, npc_enters: 1.8, ego_enters: 2.0, ego_speed: 10.0, npc_speed: 8.6}"
        in TEXT
    )
    assert parsed(PATH, TEXT.encode()) == finding_at_zone()


def test_redundant_act_is_read_without_error():
    text = TEXT.replace("speed: 8.6}]", "speed: 8.6, act: pass}]")
    assert text != TEXT
    assert parsed(PATH, text.encode()) == finding_at_zone()


@table(("old", "new", "field", "expected"), [
    ("slot: 0.5, ", "", "scenario.npcs.NPC 0[0]", "the key 'slot'"),
    ("speed: 8.6}]", "speed: 8.6, act: wave}]", "scenario.npcs.NPC 0[0].act", "'pass', 'hold', 'stop' or 'late'"),
    ("speed: 8.6}]", "speed: 8.6, acts: hold}]", "scenario.npcs.NPC 0[0].acts",
     "the key 'zone', 'slot', 'speed' or 'act' of a CrossingInstruction"),
    ("speed: 8.6}]", "speed: 8.60000001}]", "scenario.npcs.NPC 0[0].speed", "a multiple of 0.1 m/s"),
    ("slot: 0.5", "slot: 0.50000001", "scenario.npcs.NPC 0[0].slot", "a multiple of 0.1 s"),
    ("slot: 0.5", "slot: 5.1", "scenario.npcs.NPC 0[0].slot", "a time from -5 to 5 s relative to the ego"),
    ("slot: 0.5", "slot: soon", "scenario.npcs.NPC 0[0].slot", "a number from -1,000,000,000"),
    ("zone: o1>o3,", "zone: o1,", "scenario.npcs.NPC 0[0].zone", "the entry and exit of a path"),
    ("zone: o1>o3,", "zone: o1>o3, cell: front,", "scenario.npcs.NPC 0[0].zone",
     "the key 'cell' or 'speed' of a PositionInstruction"),
    ("8.6}]", "8.6}, {cell: rear, speed: 8}]", "scenario.npcs.NPC 0[1].cell",
     "a CrossingInstruction, as in npcs[0][0]"),
    ("8.0}]\n    NPC 2: [{zone", "8.0}, {zone", "scenario.npcs.NPC 1[1]", "a PositionInstruction, as in npcs[1][0]"),
    ("8.6}]", "8.6}, {lane: keep, speed: 8}]", "scenario.npcs.NPC 0[1]", "a CrossingInstruction, as in npcs[0][0]"),
    ("zone: crossing from the left, ", "", "expect", "the key 'cell'"),
    ("zone: crossing from the left", "zone: crossing from above", "expect.zone",
     "'crossing from the left', 'crossing from the right'"),
    ("npc_enters: 1.8, ", "npc_enters: .inf, ", "expect.situation.npc_enters", "a number from -1,000,000,000"),
    (", ego_enters: 2.0", "", "expect.situation", "the key 'ego_enters'"),
    ("npc_enters: 1.8", "npc_enters: 1.8, gap: 0", "expect.situation.gap", "the key 'npc', 'time', 'npc_enters'"),
])  # fmt: skip
def test_each_broken_rule_is_reported_at_its_field(old, new, field, expected):
    assert TEXT.count(old) == 1
    with pytest.raises(CorpusError) as caught:
        parsed(PATH, TEXT.replace(old, new).encode())
    assert caught.value.field == field
    assert caught.value.expected.startswith(expected)


LANES = Scenario(npcs=[[LaneInstruction("left", 22.3), LaneInstruction("keep", 24.1)]])
IN_LANES = text_of(plain_finding(scenario=LANES))


@table(("wrong", "message"), [
    ("{lane: up, speed: 22.3}", r"scenario.npcs.NPC 0\[0\].lane: expected 'keep', 'left' or 'right', received 'up'"),
    ("{cell: front, lane: left, speed: 1.0}", r"scenario.npcs.NPC 0\[0\].lane: expected the key 'cell' or 'speed'"),
    ("{cell: front, speed: 22.3}", r"npcs.NPC 0\[1\].*: expected a PositionInstruction, as in npcs\[0\]\[0\]"),
    ("{lane: left, speed: 22.35}", r"speed: expected a non-negative multiple of 0.1 m/s"),
])  # fmt: skip
def test_broken_rule_of_lanes_is_reported_at_its_place(wrong, message):
    assert "    NPC 0: [{lane: left, speed: 22.3}, {lane: keep, speed: 24.1}]\n" in IN_LANES
    with pytest.raises(CorpusError, match=message):
        parsed(PATH, IN_LANES.replace("{lane: left, speed: 22.3}", wrong).encode())
