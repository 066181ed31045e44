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
    assert parsed(PATH, TEXT.encode()) == finding_at_zone()


def test_redundant_act_is_read_without_error():
    text = TEXT.replace("speed: 8.6}]", "speed: 8.6, act: pass}]")
    assert text != TEXT
    assert parsed(PATH, text.encode()) == finding_at_zone()


CROSSING = [
    ("slot: 0.5, ", "", "scenario.npcs.NPC 0[0]"),
    ("speed: 8.6}]", "speed: 8.6, act: wave}]", "scenario.npcs.NPC 0[0].act"),
    ("speed: 8.6}]", "speed: 8.6, acts: hold}]", "scenario.npcs.NPC 0[0].acts"),
    ("speed: 8.6}]", "speed: 8.60000001}]", "scenario.npcs.NPC 0[0].speed"),
    ("slot: 0.5", "slot: 0.50000001", "scenario.npcs.NPC 0[0].slot"),
    ("slot: 0.5", "slot: 5.1", "scenario.npcs.NPC 0[0].slot"),
    ("slot: 0.5", "slot: soon", "scenario.npcs.NPC 0[0].slot"),
    ("zone: o1>o3,", "zone: o1,", "scenario.npcs.NPC 0[0].zone"),
    ("zone: o1>o3,", "zone: o1>o3, cell: front,", "scenario.npcs.NPC 0[0].zone"),
    ("8.6}]", "8.6}, {cell: rear, speed: 8}]", "scenario.npcs.NPC 0[1].cell"),
    ("8.0}]\n    NPC 2: [{zone", "8.0}, {zone", "scenario.npcs.NPC 1[1]"),
    ("8.6}]", "8.6}, {lane: keep, speed: 8}]", "scenario.npcs.NPC 0[1]"),
    ("zone: crossing from the left, ", "", "expect"),
    ("zone: crossing from the left", "zone: crossing from above", "expect.zone"),
    ("npc_enters: 1.8, ", "npc_enters: .inf, ", "expect.situation.npc_enters"),
    (", ego_enters: 2.0", "", "expect.situation"),
    ("npc_enters: 1.8", "npc_enters: 1.8, gap: 0", "expect.situation.gap"),
]  # fmt: skip
LANES = Scenario(npcs=[[LaneInstruction("left", 22.3), LaneInstruction("keep", 24.1)]])
IN_LANES = text_of(plain_finding(scenario=LANES))
LEFT = "{lane: left, speed: 22.3}"
BROKEN = [(TEXT, *row) for row in CROSSING] + [
    (IN_LANES, LEFT, "{lane: up, speed: 22.3}", "scenario.npcs.NPC 0[0].lane"),
    (IN_LANES, LEFT, "{cell: front, lane: left, speed: 1.0}", "scenario.npcs.NPC 0[0].lane"),
    (IN_LANES, LEFT, "{cell: front, speed: 22.3}", "scenario.npcs.NPC 0[1]"),
    (IN_LANES, LEFT, "{lane: left, speed: 22.35}", "scenario.npcs.NPC 0[0].speed"),
]


@table(("text", "old", "new", "field"), BROKEN)
def test_each_broken_rule_is_reported_at_its_field(text, old, new, field):
    assert text.count(old) == 1
    with pytest.raises(CorpusError) as caught:
        parsed(PATH, text.replace(old, new).encode())
    assert caught.value.field == field
