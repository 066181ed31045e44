from dataclasses import replace
from datetime import date
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings

from pytest_pafot.corpus.reader import load, parse, parsed
from pytest_pafot.corpus.writer import text_of, write
from pytest_pafot.findings.finding import Expect
from pytest_pafot.findings.situation import Situation
from pytest_pafot.model.instructions import Cell, PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Outcome
from pytest_pafot.support.errors import CorpusError
from tests.findings.builders import NASTY_TEXTS, findings, plain_finding
from tests.helpers.tables import table

TRACEBACK = """\
Traceback (most recent call last):
  File "planner.py", line 12, in plan

    return 1 / 0
           ~~^~~
ZeroDivisionError: division by zero
"""


def test_a_file_is_for_people_to_read(snapshot):
    assert text_of(plain_finding()) == snapshot


def of(*, expect=(), scenario=(), **changes):
    """Return a finding with changes, also of what it expects and of its scenario."""
    plain = plain_finding(**changes)
    return replace(
        plain,
        expect=replace(plain.expect, **dict(expect)),
        scenario=replace(plain.scenario, **dict(scenario)),
    )


SITUATION = Situation(
    npc=0, time=6.6, gap=15.0, place="behind", lanes_to_right=-1, ego_speed=6.7, npc_speed=0.8
)


@table(("finding", "line"), [
    (of(xfail='"issue" 12', xfail_until=date(2027, 1, 31)), 'xfail: {reason: "\\"issue\\" 12", until: 2027-01-31}\n'),
    (of(test="tests/t.py::TestX::test_y[4-slow]"), "\ntest: tests/t.py::TestX::test_y[4-slow]\n"),
    (of(expect={"closing_speed": 7.533}), "side: front, closing_speed: 7.533, responsibility"),
    (of(scenario={"gene_seconds": 2.5}), "  ego: {lane: 1, speed: 22.0}\n  gene_seconds: 2.5\n"),
    (of(scenario={"traffic": "hostile"}), "  ego: {lane: 1, speed: 22.0}\n  traffic: hostile\n  npcs:\n"),
    (of(scenario={"traffic": "everyday"}), "  ego: {lane: 1, speed: 22.0}\n  traffic: everyday\n  npcs:\n"),
    (
        of(expect={"situation": SITUATION}),
        "{npc: 0, time: 6.6, gap: 15.0, place: behind, lanes_to_right: -1, ego_speed: 6.7, npc_speed: 0.8}}\n",
    ),
    (of(expect={"takeover": 0.0}), "takeover: 0.0}\n"),
])  # fmt: skip
def test_what_is_not_the_default_is_written_and_read_back(finding, line):
    text = text_of(finding)
    assert line in text.replace("\n         ", " ")
    assert parsed(Path(f"{finding.id}.pafot.yaml"), text.encode()) == finding


CRASH = Expect(
    failure="ZeroDivisionError",
    message="division by zero",
    assertion="division by zero",
    outcome=Outcome.ADS_ERROR,
    time=3.2,
    traceback=TRACEBACK,
)
WITHOUT_COLLISION = Expect(
    failure="AssertionError",
    assertion="run.min_ttc > N",
    outcome=Outcome.COMPLETED,
    time=31.2,
    npc=1,
    cell=Cell.LEFT,
)
NAMED = Scenario(
    npcs=[[PositionInstruction(Cell(cell), 20.0) for cell in row] for row in ((8, 1), (4, 5))]
)


def test_names_tracebacks_and_worst_moments_are_readable(snapshot):
    findings = {
        "cells": plain_finding(scenario=NAMED),
        "traceback": plain_finding(expect=CRASH),
        "no collision": plain_finding(expect=WITHOUT_COLLISION),
    }
    texts = {name: text_of(finding) for name, finding in findings.items()}
    assert {name: text[: text.index("found:")] for name, text in texts.items()} == snapshot


def test_wide_world_is_wrapped_between_its_entries(snapshot):
    config = {
        "observation": {"type": "Kinematics", "features": ["presence"] * 12},
        "action": {"type": "Discrete" * 3},
    }
    world = {
        "kind": "gym",
        "env_id": "own-v0",
        "config": config | {f"key_{index}": index for index in range(18)},
    }
    text = text_of(plain_finding(world=world | {"duration": 40.0, "limits": {}}))
    assert text[text.index("world:") : text.index("\n# xfail")] == snapshot


@settings(max_examples=settings.default.max_examples // 2)  # PyYAML's own parser is slow
@given(findings())
def test_every_finding_is_readable_by_any_yaml_parser(finding):
    text = text_of(finding)
    for base in (yaml.SafeLoader, getattr(yaml, "CSafeLoader", yaml.SafeLoader)):
        assert parsed(Path(f"{finding.id}.pafot.yaml"), text.encode(), base) == finding
    document = yaml.load(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    assert document["test"] == finding.test
    assert document["world"] == finding.world
    assert document["expect"]["failure"] == finding.expect.failure
    assert document["found"]["versions"] == finding.found.versions


@table("text", NASTY_TEXTS)
def test_nasty_texts_survive_everywhere(tmp_path, text):
    expect = replace(
        plain_finding().expect,
        failure=text if text.strip() else "Failed",
        assertion=text,
        message=text,
        traceback=text,
    )
    world = {"a": text, "b": [text, {"c": text}], text[:60]: 1}
    reason = text if text.strip() else None
    finding = plain_finding(
        expect=expect,
        world=world,
        xfail=reason,
        xfail_until=reason and date(2027, 1, 31),
        test=reason or "t",
    )
    path = tmp_path / "front-2-1f3a9c.pafot.yaml"
    path.unlink(missing_ok=True)
    assert write(path, finding)
    assert load(path) == finding


def test_lone_surrogate_is_written_as_the_replacement_character(tmp_path):
    path = tmp_path / "a.pafot.yaml"
    write(path, plain_finding(test="t\udc80"))
    assert load(path).test == "t\ufffd"


@pytest.mark.parametrize("content", [b"<OpenSCENARIO/>", b"", b"x" * 300_000, b"a: 1"])
def test_file_of_another_tool_is_not_said_to_be_broken(content):
    with pytest.raises(CorpusError, match="a different kind of file"):
        parse(Path("run.xosc"), content)
