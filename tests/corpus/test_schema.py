"""The stored format: saved files keep their meaning when the defaults of worlds change."""

import copy
from dataclasses import fields
from pathlib import Path

import pytest

from pytest_pafot.corpus.reader import LIMITS, WORLDS, load
from pytest_pafot.corpus.writer import text_of
from pytest_pafot.world import Highway, NpcLimits, World, from_dict

FILES = sorted(Path(__file__).with_name("saved").glob("*.pafot.yaml"))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_saved_file_is_rewritten_byte_for_byte(path):
    finding = load(path)
    assert text_of(finding) == path.read_text(encoding="utf-8")
    assert (
        finding.world["kind"] == "own" or from_dict(dict(finding.world)).to_dict() == finding.world
    )


def test_another_default_changes_no_saved_world(monkeypatch):
    from highway_env.envs.highway_env import HighwayEnv

    written = [Highway().to_dict(), World("highway-v0").to_dict()]
    for cls, name, value in (
        (Highway, "lanes", 6),
        (Highway, "headway", 1.0),
        (NpcLimits, "jerk", 5.0),
    ):
        monkeypatch.setitem(cls.__init__.__kwdefaults__, name, value)
    changed = HighwayEnv.default_config() | {
        "lanes_count": 3,
        "policy_frequency": 5,
        "duration": 20,
    }
    monkeypatch.setattr(
        HighwayEnv, "default_config", classmethod(lambda cls: copy.deepcopy(changed))
    )
    assert (Highway().lanes, NpcLimits().jerk, World("highway-v0").lanes) == (6, 5.0, 3)
    assert [from_dict(copy.deepcopy(data)).to_dict() for data in written] == written
    assert from_dict(copy.deepcopy(written[1])).longest_run == 40.0


def test_the_format_has_every_field_of_the_worlds():
    known = {"highway": Highway, "gym": World}
    for kind, cls in known.items():
        keys, names = WORLDS[kind], {field.name for field in fields(cls) if field.compare}
        assert {*keys.required, *keys.optional} == {"kind", *names}
    assert {*LIMITS.required, *LIMITS.optional} == {field.name for field in fields(NpcLimits)}
    assert tuple(Highway().to_dict()) == WORLDS["highway"].required
    assert tuple(World("highway-v0").to_dict()) == WORLDS["gym"].required
