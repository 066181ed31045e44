"""Versions of the corpus format: files of an earlier one are read for ever as they were when it was written."""

import copy
import json
from dataclasses import asdict, fields, replace
from pathlib import Path

import pytest
import yaml
from hypothesis import given

from pytest_pafot.corpus.format_1 import upgraded
from pytest_pafot.corpus.reader import load, parsed
from pytest_pafot.corpus.schema import LIMITS, WORLDS
from pytest_pafot.corpus.writer import rewrite
from pytest_pafot.corpus.yaml_text import text_of
from pytest_pafot.errors import CorpusError
from pytest_pafot.scenario import Scenario
from pytest_pafot.world import Highway, NpcLimits, World, from_dict
from tests.findings.builders import findings

FOLDER = Path(__file__).with_name("format_1")
EXPECTED = json.loads((FOLDER / "expected.json").read_text(encoding="utf-8"))
"""What the code that wrote version 1 read in each file, with the defaults of its worlds and of highway-env 1.12."""


def plain(value):
    return json.loads(json.dumps(value))


def read(name):
    return load(FOLDER / f"{name}.pafot.yaml")


def test_every_file_has_its_expectation():
    assert {path.name.removesuffix(".pafot.yaml") for path in FOLDER.glob("*.yaml")} == set(EXPECTED)


@pytest.mark.parametrize("name", EXPECTED)
def test_a_file_of_version_1_is_read_as_it_was_then(name):
    finding, expected = read(name), EXPECTED[name]
    for part in ("test", "flaky", "xfail"):
        assert getattr(finding, part) == expected[part]
    for part in ("scenario", "original"):
        scenario = None if expected[part] is None else Scenario.from_canonical(expected[part])
        assert getattr(finding, part) == scenario
    for part in ("expect", "found", "shrunk"):
        value = getattr(finding, part)
        read_back = None if value is None else plain(asdict(value))
        if part == "expect":
            read_back["preventable_by"] = [*value.preventable_by]
        assert read_back is expected[part] or read_back == {**read_back, **expected[part]}
    assert finding.world == {**finding.world, **expected["world"]}


@pytest.mark.parametrize("name", EXPECTED)
def test_a_scenario_of_version_1_runs_as_it_did_then(name):
    finding, expected = read(name), EXPECTED[name]["careful_human"]
    trace = from_dict(dict(finding.world)).rollout_reference(finding.scenario, "careful-human")
    assert (trace.outcome, trace.ticks) == (expected["outcome"], expected["ticks"])
    assert trace.states[-1, :, :2].ravel().tolist() == pytest.approx(expected["last"], abs=1e-3)


@pytest.mark.parametrize("name", EXPECTED)
def test_a_file_of_version_1_that_is_rewritten_is_one_of_version_2_with_the_same_meaning(name, tmp_path):
    path = tmp_path / f"{name}.pafot.yaml"
    path.write_bytes((FOLDER / path.name).read_bytes())
    before = load(path)
    rewrite(path, replace(before, xfail=None))
    assert path.read_text(encoding="utf-8").startswith("pafot: 2 ")
    assert load(path) == before


@pytest.mark.parametrize("name", [name for name in EXPECTED if EXPECTED[name]["world"]["kind"] == "gym"])
def test_the_world_of_version_1_is_the_one_that_is_written_today(name):
    world = read(name).world
    assert from_dict(dict(world)).to_dict() == world


def test_another_default_changes_no_file_of_either_version(monkeypatch):
    for cls, name, value in ((Highway, "lanes", 6), (Highway, "headway", 1.0), (NpcLimits, "jerk", 5.0)):
        parameter = cls.__init__.__kwdefaults__
        monkeypatch.setitem(parameter, name, value)
    assert Highway().lanes == 6
    assert NpcLimits().jerk == 5.0
    for name in ("sparse-highway", "sparse-limits", "collision-shrunk"):
        assert from_dict(dict(read(name).world)).to_dict() == EXPECTED[name]["world"]


def test_another_default_of_an_environment_changes_no_file(monkeypatch):
    from highway_env.envs.highway_env import HighwayEnv

    given = {name: read(name).world for name in ("sparse-gym", "gym-highway")}
    written = World("highway-v0").to_dict()
    defaults = HighwayEnv.default_config()
    changed = defaults | {"lanes_count": 3, "policy_frequency": 5, "duration": 20}
    monkeypatch.setattr(HighwayEnv, "default_config", classmethod(lambda cls: copy.deepcopy(changed)))
    assert World("highway-v0").lanes == 3
    for data in (*given.values(), written):
        world = from_dict(dict(data))
        assert (world.lanes, world.ads_hz, world.longest_run) == (4, 1, 40.0)
        assert world.to_dict()["config"]["lanes_count"] == 4


def test_the_upgrade_is_a_pure_function_of_the_document():
    document = yaml.safe_load((FOLDER / "sparse-gym.pafot.yaml").read_text())
    before = copy.deepcopy(document)
    once, twice = upgraded(document), upgraded(document)
    assert document == before
    assert once == twice
    once["world"]["config"]["observation"]["type"] = "other"
    assert upgraded(document) == twice


@pytest.mark.parametrize(
    "document",
    [None, [], "text", {}, {"world": None}, {"world": []}, {"world": {"kind": []}}, {"world": {"kind": "own", "a": 1}},
     {"world": {"kind": "gym", "env_id": []}}, {"world": {"kind": "gym", "env_id": "highway-v0", "config": []}},
     {"world": {"kind": "gym", "env_id": "highway-v0", "config": {"duration": "x"}}},
     {"world": {"kind": "highway", "limits": 3}}],
)  # fmt: skip
def test_what_is_wrong_with_a_document_stays_for_the_checks(document):
    upgraded(document)
    text = json.dumps({"pafot": 1, **document} if isinstance(document, dict) else document)
    with pytest.raises(CorpusError):
        parsed(Path("a.pafot.yaml"), text.encode())


def test_an_unknown_key_of_a_world_of_version_1_is_refused_at_its_line(tmp_path):
    text = (FOLDER / "sparse-highway.pafot.yaml").read_text()
    with pytest.raises(CorpusError, match=r"a.pafot.yaml:3: world.engine: expected one of kind, lanes, "):
        parsed(Path("a.pafot.yaml"), text.replace("kind: highway", "kind: highway, engine: kernel").encode())


@given(findings())
def test_a_finding_whose_world_is_complete_means_the_same_in_both_versions(finding):
    text = text_of(finding)
    of_1 = text.replace("pafot: 2 ", "pafot: 1 ", 1)
    finding = replace(finding, world=upgraded({"world": dict(finding.world)})["world"])
    assert parsed(Path(f"{finding.id}.pafot.yaml"), of_1.encode()) == finding


def test_version_2_has_every_field_of_the_worlds():
    known = {"highway": Highway, "gym": World}
    for kind, cls in known.items():
        keys, names = WORLDS[kind], {field.name for field in fields(cls) if field.compare}
        assert {*keys.required, *keys.optional} == {"kind", *names}
    assert {*LIMITS.required, *LIMITS.optional} == {field.name for field in fields(NpcLimits)}
    assert tuple(Highway().to_dict()) == WORLDS["highway"].required
    assert tuple(World("highway-v0").to_dict()) == WORLDS["gym"].required
