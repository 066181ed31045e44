"""Interrupted merges of files: no finding is lost, whatever ends the merge."""

from dataclasses import replace
from pathlib import Path

import pytest

from pytest_pafot.campaign import merging
from pytest_pafot.campaign.merging import Candidate, join
from pytest_pafot.corpus.saved import saved_in
from pytest_pafot.corpus.writer import write
from pytest_pafot.model.scenario import PositionInstruction, Scenario
from tests.findings.builders import plain_finding

OWN = {"a-111111": (30.0, "front"), "a-111111-2": (20.0, "rear"), "b-222222": (25.0, "left")}
"""Findings of the corpus: the speed of the only instruction, and the side hit. The first two will swap names."""
OTHERS = {"b-222222": (10.0, "left"), "a-111111": (40.0, "right")}
"""Findings of the other folder: a simpler one of a known kind, and one of a new kind."""
MERGED = {"a-111111": 20.0, "a-111111-2": 30.0, "a-111111-3": 40.0, "b-222222": 10.0}
STEPS = 7
"""Four files are written, and three of them replace others."""


class Killed(BaseException):
    """The end of the process."""


def speed(finding):
    return finding.scenario.npcs[0][0].speed


def put(folder, findings):
    for id_, (of_npc, side) in findings.items():
        scenario = Scenario(npcs=[[PositionInstruction(6, of_npc)]])
        expect = replace(plain_finding().expect, side=side)
        assert write(folder / f"{id_}.pafot.yaml", plain_finding(id=id_, scenario=scenario, expect=expect))


def merge(own, *others):
    saved = [each for folder in (own, *others) for each in saved_in(folder)]
    candidates = [Candidate(saved=each, finding=each.finding, kind=each.finding.signature) for each in saved]
    old = {each.path for each in saved_in(own)}
    return merging._write(join(candidates), own, old)


def contents(folder):
    return {each.id: speed(each.finding) for each in saved_in(folder)}


@pytest.fixture
def folders(tmp_path):
    put(tmp_path / "own", OWN)
    put(tmp_path / "other", OTHERS)
    return tmp_path / "own", tmp_path / "other"


def test_merge_swaps_names_and_replaces_findings_by_simpler(folders):
    assert merge(*folders) == []
    assert contents(folders[0]) == MERGED


@pytest.mark.parametrize("number", range(STEPS + 1))
def test_killed_merge_loses_nothing_and_can_be_continued(folders, monkeypatch, number):
    calls = [0]

    def counted(name):
        act = getattr(Path, name)

        def acts(path, *arguments, **options):
            calls[0] += not path.name.endswith(".tmp") or name == "replace"
            if calls[0] == number + 1:
                calls[0] += 1
                raise Killed
            return act(path, *arguments, **options)

        monkeypatch.setattr(Path, name, acts)

    counted("replace")
    counted("unlink")
    killed = False
    try:
        merge(*folders)
    except Killed:
        killed = True
    monkeypatch.undo()
    own, other = folders
    assert {20.0, 30.0} <= set(contents(own).values())
    assert {25.0, 10.0} & set(contents(own).values())
    assert killed == (number < STEPS)
    assert merge(own, other) == []
    assert contents(own) == MERGED
