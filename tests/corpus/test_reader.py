import contextlib
import os
from datetime import date
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.corpus import reader
from pytest_pafot.corpus.reader import load, located, parsed
from pytest_pafot.corpus.writer import text_of
from pytest_pafot.findings.finding import FailureRate
from pytest_pafot.findings.shrink import Shrunk
from pytest_pafot.model.instructions import ScenarioError
from pytest_pafot.model.sight import Sight
from pytest_pafot.model.vehicle_type import TRUCK, VehicleType
from pytest_pafot.support.errors import CorpusError
from pytest_pafot.world import Highway, WorldError, from_dict
from tests.findings.builders import plain_finding
from tests.helpers.tables import table
from tests.helpers.work import calls_in

NAME = "front-2-1f3a9c.pafot.yaml"
TEXT = text_of(plain_finding())
links = pytest.mark.skipif(os.name == "nt", reason="links need rights on Windows")
LOADERS = [yaml.SafeLoader, getattr(yaml, "CSafeLoader", yaml.SafeLoader)]


SHRUNK = plain_finding(
    perception=Sight(latency=0.3, noise={"position": 0.5}, dropout=0.1),
    shrunk=Shrunk(rollouts=41, is_minimal=False, before="2 NPCs"),
    rate=FailureRate(failing=14, runs=20),
    flaky="running it again gave a different run",
)


@pytest.fixture
def path(tmp_path):
    return tmp_path / NAME


def fault(path, content):
    """Return the error about a file, which is the same from both of PyYAML's parsers."""
    content = content.encode() if isinstance(content, str) else content
    errors = []
    for loader in LOADERS:
        with pytest.raises(CorpusError) as caught:
            parsed(path, content, loader)
        errors.append(caught.value)
    assert errors[0].line == errors[1].line
    path.write_bytes(content)
    with pytest.raises(CorpusError) as caught:
        load(path)
    assert str(caught.value).startswith(str(path))
    assert caught.value.fix
    return caught.value


TAKEOVER = "takeover: 1.25"
XFAIL = "# xfail: {reason, until}"
WORLD = TEXT[TEXT.index("world:") : TEXT.index("\n# xfail")]
CHAIN = "[{cell: front-left, speed: 25.0}, {cell: front, speed: 8.0}]"


def swapped(old, new):
    text = TEXT if old in TEXT else text_of(SHRUNK)
    assert text.count(old) == 1
    return text.replace(old, new)


@table("ends", ["\n", "\r\n"])
@table("mark", ["", "\ufeff"])
def test_all_line_endings_and_byte_order_marks_work(path, ends, mark):
    path.write_bytes((mark + TEXT.replace("\n", ends)).encode())
    assert load(path) == plain_finding()


def test_comments_order_and_style_do_not_matter(path):
    document = yaml.safe_load(TEXT)
    path.write_text(
        "# mine\n" + yaml.safe_dump(dict(reversed(document.items())), default_flow_style=False)
    )
    assert load(path) == plain_finding()


def test_the_name_of_the_file_is_the_id(path):
    renamed = path.with_name("cut-in_at.night.pafot.yaml")
    renamed.write_text(TEXT)
    assert load(renamed).id == "cut-in_at.night"


@table("name", ["my case.pafot.yaml", "a[1].pafot.yaml", ".pafot.yaml", "-x.pafot.yaml", "a.yaml"])
def test_name_unfit_for_a_node_id_is_refused(path, name):
    error = fault(path.with_name(name), TEXT)
    assert (error.received, error.fix) == (repr(name), "rename the file")


MOMENT = "time: 6.6, lanes_to_right: 0, ego_speed: 6.7, npc_speed: 0.8"
BROKEN = [
    ("pafot: 3", "pafot: 2", 1, "pafot"),
    ("pafot: 3", "pafot: 4\nnew_things: []", 1, "pafot"),
    ("pafot: 3", "pafot: 3.0", 1, "pafot"),
    ("test: tests/test_safety.py::test_never_at_fault_in_a_collision", "test:", 11, "test"),
    ("test: tests/test_safety.py::test_never_at_fault_in_a_collision", "test: ' '", 11, "test"),
    (WORLD, "world: highway", 12, "world"),
    (WORLD, "world:", 12, "world"),
    ("lanes: 4, ", "", 12, "world"),
    ("lanes: 4", "lanes: 4, colour: red", 12, "world.colour"),
    ("jerk: 10.0, ", "", 14, "world.limits"),
    ("jerk: 10.0", "yerk: 10.0", 14, "world.limits.yerk"),
    ("{cell: front-left,", "{cell: ahead,", 6, "scenario.npcs.NPC 0[0].cell"),
    ("{cell: front-left,", "{cell: 1,", 6, "scenario.npcs.NPC 0[0].cell"),
    ("{cell: front, speed: 8.0}", "{cell: right, speed: 8.0}", 6, "scenario.npcs.NPC 0[1].cell"),
    ("speed: 8.0", "speed: .nan", 6, "scenario.npcs.NPC 0[1].speed"),
    ("speed: 8.0", "speed: 8.00000001", 6, "scenario.npcs.NPC 0[1].speed"),
    ("speed: 8.0", "speed: 8.0, speedy: 1", 6, "scenario.npcs.NPC 0[1].speedy"),
    ("cell: front, speed: 8.0}", "cell: front}", 6, "scenario.npcs.NPC 0[1]"),
    ("cell: front, speed: 8.0}", "speed: 8.0}", 6, "scenario.npcs.NPC 0[1]"),
    (CHAIN, "[]", 6, "scenario.npcs.NPC 0"),
    (CHAIN, f"{CHAIN}\n    NPC 1: [{{cell: front-left, speed: 8.0}}]", 7, "scenario.npcs.NPC 1[0].cell"),
    (CHAIN, "{cell: front, speed: 8.0}", 6, "scenario.npcs.NPC 0"),
    (CHAIN, f"{CHAIN}\n    NPC 2: {CHAIN}", 7, "scenario.npcs.NPC 2"),
    ("seed: 7", "seed: -7", 3, "scenario.seed"),
    ("seed: 7", "sead: 7", 3, "scenario.sead"),
    ("seed: 7", "gene_seconds: 0\n  seed: 7", 3, "scenario.gene_seconds"),
    ("seed: 7", "gene_seconds: long\n  seed: 7", 3, "scenario.gene_seconds"),
    ("seed: 7", "seed: 7\n  traffic: fast", 4, "scenario.traffic"),
    ("seed: 7", "seed: 7\n  traffic: {style: paper}", 4, "scenario.traffic"),
    ("ego: {lane: 1, speed: 22.0}", "ego: {lane: 2000, speed: 22.0}", 4, "scenario.ego.lane"),
    ("ego: {lane: 1, speed: 22.0}", "ego: {lane: 1}", 4, "scenario.ego"),
    ("outcome: collision", "outcome: crash", 7, "expect.outcome"),
    ("failure: AssertionError, ", "", 7, "expect"),
    ("time: 12.4", "time: soon", 7, "expect.time"),
    ("npc: 0, ", "", 7, "expect"),
    ("npc: 0, ", "npc: 1, ", 7, "expect.npc"),
    ("side: front", "side: top", 8, "expect.side"),
    ("responsibility: ego", "responsibility: all", 8, "expect.responsibility"),
    (TAKEOVER, "takeover: {time: 1.25}", 8, "expect.takeover"),
    (TAKEOVER, "takeover: -1.25", 8, "expect.takeover"),
    ("generation: 17", "generation: -1", 9, "found.generation"),
    ("numpy: 2.4.6", "numpy: 2.4", 10, "found.versions.numpy"),
    ("algorithm: pafot", "algoritm: pafot", 9, "found.algoritm"),
    (XFAIL, "xfail:", 16, "xfail"),
    (XFAIL, "xfail: ''", 16, "xfail"),
    (XFAIL, "xfails: 'planner issue 12'", 16, "xfails"),
    (XFAIL, "xfail: {until: 2027-01-31}", 16, "xfail"),
    (XFAIL, "xfail: {reason: '', until: 2027-01-31}", 16, "xfail.reason"),
    (XFAIL, "xfail: {reason: slow, until: 2027-02-30}", 16, "xfail.until"),
    (XFAIL, "xfail: {reason: slow, til: 2027-01-31}", 16, "xfail.til"),
    (XFAIL, "xfail: {reason: 2027-01-31}", 16, ""),
    (XFAIL, "xfail: {reason: slow, until: [2027-01-31]}", 16, ""),
    (XFAIL, "xfail: {reason: slow, until: 2027-01-31, flaky: true}", 16, "xfail.flaky"),
    (XFAIL, "xfail: {reason: slow}", 16, "xfail"),
    (XFAIL, "xfail: slow", 16, "xfail"),
    ("side: front", "side: front, closing_speed: -1.0", 8, "expect.closing_speed"),
    (XFAIL, "xfail: 2027-01-31", 16, ""),
    (XFAIL, "zzz: 1", 16, "zzz"),
    ("found: {seed: 1234, generation: 17, algorithm: pafot,\n        versions", "# versions", 1, ""),
    ("seed: 7", "seed: 7\n  traffic: null", 4, "scenario.traffic"),
    *((TAKEOVER, f"{TAKEOVER}, {more}", 8, f"expect.{field}") for more, field in [
        ("fault: entered-lane, mistake: moved", "mistake"),
        ("fault: braked-for-nothing, mistake: moved-in-front", "mistake"),
        ("situation: none", "situation"),
        (f"situation: {{npc: 0, gap: 15.0, {MOMENT}}}", "situation"),
        (f"situation: {{npc: 1, gap: 15.0, place: ahead, {MOMENT}}}", "situation.npc"),
        (f"situation: {{npc: 0, gap: .nan, place: ahead, {MOMENT}}}", "situation.gap"),
        (f"situation: {{npc: 0, gap: 15.0, place: front, {MOMENT}}}", "situation.place"),
    ]),
    *(("\n  npcs:", f"\n  vehicles: {given}\n  npcs:", 5, f"scenario.vehicles{field}") for given, field in [
        ("{NPC 0: lorry}", ".NPC 0"),
        ("[truck]", ""),
        ("{NPC 1: truck}", ".NPC 1"),
        ("{NPC 0: {name: bus, length: 12.0}}", ".NPC 0"),
        ("{NPC 0: {name: bus, length: 30.0, width: 2.5}}", ".NPC 0.length"),
        ("{NPC 0: {name: bus, length: 9.0, width: 2.5, height: 3.0}}", ".NPC 0.height"),
    ]),
    ("rollouts: 41", "rollouts: many", 12, "shrunk.rollouts"),
    ("is_minimal: false", "is_minimal: 0", 12, "shrunk.is_minimal"),
    ('flaky: "running it again gave a different run"', 'flaky: " "', 14, "flaky"),
    ("failing: 14, runs", "failing: 21, runs", 13, "rate.failing"),
    ("runs: 20", "runs: 0", 13, "rate.runs"),
    ("latency: 0.3", "latency: -0.3", 11, "perception.latency"),
    # keys with defaults only in the code are required, too
    ("responsibility: ego, ", "", 7, "expect"),
    (",\n        versions: {pytest-pafot: 0.1.0, highway-env: 1.12.1, numpy: 2.4.6}", "", 9, "found"),
    (", is_minimal: false", "", 12, "shrunk"),
]  # fmt: skip


@table(("old", "new", "line", "field"), BROKEN)
def test_each_broken_rule_is_reported_at_its_place(path, old, new, line, field):
    error = fault(path, swapped(old, new))
    assert (error.line, error.field) == (line, field)


@table(
    "number",
    ["07", "+7", "0x7", "0o7", "0b111", "7_", "1:30", "7.", ".7e+1", "7e0", "7E+0", "\uff17"],
)
def test_number_with_two_possible_readings_is_refused(path, number):
    error = fault(path, swapped("seed: 7", f"seed: {number}"))
    assert error.line == 3


@pytest.mark.parametrize("word", ["yes", "On", "TRUE", "True", "y", "~", "Null"])
def test_word_with_two_possible_readings_is_refused(path, word):
    text = text_of(SHRUNK).replace("is_minimal: false", f"is_minimal: {word}")
    assert fault(path, text).line == text[: text.index("is_minimal")].count("\n") + 1


@table("day", ["2027-01-31", "'2027-01-31'", '"2027-01-31"'])
def test_last_xfail_day_is_read_quoted_or_unquoted(path, day):
    path.write_text(swapped(XFAIL, f"xfail: {{reason: issue 12, until: {day}}}"))
    finding = load(path)
    assert (finding.xfail, finding.xfail_until) == ("issue 12", date(2027, 1, 31))


NO_DOCUMENTS = [
    (b"", None),
    (b" \r\n\n", None),
    (b"# only a comment\n", 2),
    (b"pafot: 1\ntest: caf\xe9\n", 2),
    ("pafot: 1".encode("utf-16"), 1),
    (b"pafot: 1\ntest: a\x00b\n", 2),
    (b"pafot: 1\ntest: {a\n", 3),
    (b"pafot: 1\n<<<<<<< HEAD\ntest: a\n=======\n", 3),
    (b"pafot: 1\n---\npafot: 1\n", 2),
    (b"just text", 1),
    (b"- a\n- b\n", 1),
    (b"test: a\n", 1),
    (b"pafot: 1\npafot: 1\n", 2),
    (b"pafot: 1\n1: 2\n", 2),
    (b"pafot: 1\ntest: 2026-11-20\n", 2),
    (b"pafot: 1\n<<: {a: 1}\n", 2),
    (b"pafot: 1\ntest: " + b"9" * 5000 + b"\n", 2),
    (b"pafot: 1\ntest: *a\n", 2),
    (b"pafot: 1\ntest: &a 1\n", 2),
    (b"pafot: 1\ntest: !!str 1\n", 2),
    (b"pafot: 1\ntest: !!python/object/apply:os.system ['true']\n", 2),
    ((TEXT + "#" * 256 * 1024).encode(), None),
    (f"version https://git-lfs.github.com/spec/v1\noid sha256:{'0' * 64}\nsize 7\n".encode(), None),
]  # fmt: skip


@table(("content", "line"), NO_DOCUMENTS)
def test_what_is_no_plain_document_is_refused(path, content, line):
    assert fault(path, content).line == line


def test_billion_laughs_file_is_refused_without_expansion(path):
    laughs = ["a0: &a0 [lol]"] + [
        f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 12)
    ]
    text, errors = "pafot: 1\n" + "\n".join(laughs), []
    assert calls_in(lambda: errors.append(fault(path, text))) < 10_000
    assert errors[0].expected == fault(path, "a: &a 1").expected


@pytest.mark.parametrize("opening", ["[", "{a: ", "- ", "? "])
def test_nesting_without_end_is_refused(path, opening):
    text = "pafot: 1\nworld: \n  " + opening * (40_000 // len(opening))
    assert calls_in(lambda: fault(path, text)) < 40_000


NESTED = f"pafot: 3\nworld: {'[' * 30}{']' * 30}\n"


@table("levels", range(14, 20))
def test_deeply_nested_world_is_refused_beyond_a_limit(path, levels):
    text = text_of(plain_finding(world={"kind": "own", "data": "x"})).replace(
        "data: x", f"data: {'[' * levels}{']' * levels}"
    )
    if levels < 16:
        assert parsed(path, text.encode()).world["kind"] == "own"
    else:
        assert "levels of nesting" in fault(path, text).expected


def test_too_many_values_are_refused_at_their_line(path, monkeypatch):
    assert reader.MOST_VALUES == 40_000
    monkeypatch.setattr(reader, "MOST_VALUES", 400)
    for values in ("1," * 400, "[]," * 400, "{a: 1}," * 200):
        error = fault(path, f"pafot: 3\nworld: {{kind: own, data: [{values}]}}\n")
        assert ("400" in error.expected, error.line) == (True, 2)


def test_a_sparse_file_of_any_size_costs_nothing(path):
    with path.open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(CorpusError, match="256 KiB"):
        load(path)


def loop(path):
    other = path.with_name("other.pafot.yaml")
    path.symlink_to(other)
    other.symlink_to(path)


NO_FILES = {"nothing": Path, "loop of links": loop, "folder": Path.mkdir, "pipe": os.mkfifo}


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
@pytest.mark.parametrize("make", NO_FILES.values(), ids=NO_FILES)
def test_what_is_no_file_is_a_corpus_error_and_does_not_block(path, make):
    make(path)
    with pytest.raises(CorpusError):
        load(path)


SECRETS = {
    "passwd": b"root:x:0:0:HUSH:/root:/bin/bash\n",
    "mapping": b"HUSH: HUSH\ntoken: [HUSH]\n",
    "own key": b"pafot: {token: HUSH}\nHUSH: 1\n",
    "JSON": b'{"HUSH": "HUSH", "pafot": "HUSH"}',
    "alias": b"a: *HUSH\n",
    "tag": b"a: !HUSH 1\n",
    "number": b"HUSH: 0x4855\n",
    "key of another type": b"0x48555348: 1\n",
    "syntax": b"HUSH: [HUSH\nHUSH: %HUSH\n",
    "not UTF-8": b"HUSH \xa4 HUSH\n",
    "not text": b"HUSH\x1b\x00HUSH",
    "a scenario further down": b"HUSH HUSH: [\npafot: 3\nHUSH: HUSH\n",
}


@table("secret", SECRETS.values())
def test_error_shows_no_content_of_a_foreign_file(path, secret):
    error = fault(path, secret)
    text = str(error).replace(str(path), "")
    assert not any(word in text for word in ("HUSH", "github", "48", "20", "a4", "1b", "001B")), (
        text
    )
    assert "\n" not in text


def test_error_in_saved_scenario_shows_the_wrong_value(path):
    assert "'oops'" in str(fault(path, f"# mine\n\n{swapped('seed: 7', 'seed: oops')}"))
    late = swapped("pafot: 3", "#").replace("seed: 7", "seed: oops") + "pafot: 3\n"
    assert "'oops'" in str(fault(path, late))


@pytest.fixture
def place(tmp_path):
    """Return the path of a file in a corpus, and make all its folders."""
    place = tmp_path / "project" / "pafot_corpus" / "test_it" / "test_it" / NAME
    place.parent.mkdir(parents=True)
    return place


def refused(place):
    with pytest.raises(CorpusError) as caught:
        load(place)
    assert (caught.value.path, "link" in caught.value.received) == (place, True)


@links
@pytest.mark.parametrize(
    "target", ["secret", "valid.pafot.yaml", "none", "/dev/zero", "/proc/self/environ", "/", "pipe"]
)
def test_link_out_of_the_corpus_is_refused(tmp_path, place, target):
    (tmp_path / "secret").write_text("HUSH")
    (tmp_path / "valid.pafot.yaml").write_text(TEXT)
    os.mkfifo(tmp_path / "pipe")
    place.symlink_to(tmp_path / target)
    refused(place)
    place.unlink()
    (place.parent / "one").symlink_to(tmp_path / target)
    place.symlink_to("one")  # a chain
    refused(place)


@links
@pytest.mark.parametrize("level", [0, 1])
def test_file_in_folder_linked_outside_corpus_is_refused(tmp_path, place, level):
    place.write_text(TEXT)
    folder = place.parents[level]
    folder.rename(tmp_path / folder.name)
    folder.symlink_to(tmp_path / folder.name)
    refused(place)


@links
def test_links_to_saved_scenarios_within_corpus_are_read(place):
    real = place.parents[1] / "test_other" / "front-2-1f3a9c.pafot.yaml"
    real.parent.mkdir()
    real.write_text(TEXT)
    place.symlink_to(real)
    assert load(place) == plain_finding()
    place.unlink()
    place.parent.rmdir()
    place.parent.symlink_to("test_other")
    assert load(place) == plain_finding()
    place.with_name("two.pafot.yaml").symlink_to("notes.txt")
    refused(place.with_name("two.pafot.yaml"))


@links
def test_links_by_git_annex_and_build_systems_work(tmp_path, place):
    store = tmp_path / "project" / ".git" / "annex" / "objects" / "k" / "SHA256E-s9--1f.yaml"
    store.parent.mkdir(parents=True)
    store.write_text(TEXT)
    place.symlink_to(os.path.relpath(store, place.parent))
    assert load(place) == plain_finding()
    place.unlink()
    source = tmp_path / "source" / place.relative_to(tmp_path / "project")
    source.parent.mkdir(parents=True)
    source.write_text(TEXT)
    place.symlink_to(source)
    assert load(place) == plain_finding()


def test_a_file_cut_short_anywhere_is_refused(path):
    def is_read(text):
        with contextlib.suppress(CorpusError):
            return parsed(path, text.encode()) is not None

    assert [
        cut
        for cut in range(0, len(TEXT) - len("# xfail: {reason, until}\n") - 1, 7)
        if is_read(TEXT[:cut])
    ] == []


@given(st.binary(max_size=200))
def test_no_content_gives_any_other_error(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / NAME
    with pytest.raises(CorpusError):
        parsed(path, content)


@given(st.data())
def test_no_damage_gives_any_other_error(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / NAME
    start = data.draw(st.integers(0, len(TEXT)))
    end = data.draw(st.integers(start, min(len(TEXT), start + 30)))
    patch = data.draw(st.text("{}[]:,-# \n\t'\"&*!|>?%@.~01ae", max_size=8))
    with contextlib.suppress(CorpusError):
        parsed(path, (TEXT[:start] + patch + TEXT[end:]).encode())


def test_file_contains_perception_shrinking_and_flakiness(path):
    assert (
        "\nperception: {latency: 0.3, noise: {position: 0.5}, dropout: 0.1}\n"
        'shrunk: {rollouts: 41, is_minimal: false, before: "2 NPCs"}\n'
        "rate: {failing: 14, runs: 20}\n"
        'flaky: "running it again gave a different run"\n'
    ) in text_of(SHRUNK)
    path.write_text(text_of(SHRUNK))
    assert load(path) == SHRUNK


def test_the_egos_own_vehicle_is_read_strictly(path):
    for ego in (TRUCK, VehicleType(name="bus", length=11.5, width=2.5, braking=7.5)):
        path.write_text(text_of(plain_finding(world=Highway(ego=ego).to_dict())))
        assert from_dict(load(path).world) == Highway(ego=ego)
    world = {**Highway().to_dict(), "ego": {"name": "bus", "length": 12.0}}
    assert fault(path, text_of(plain_finding(world=world))).field == "world.ego"


LOCATED = [
    ("scenario", ScenarioError("ego_speed", "less", "22"), 4, "scenario.ego.speed"),
    ("scenario", ScenarioError("npcs[0][1].speed", "less", "8", "write 7.9"), 6, "scenario.npcs.NPC 0[1].speed"),
    ("world", WorldError("lanes", "more", "4"), 12, "world.lanes"),
    ("world", WorldError("limits.jerk", "more", "1"), 14, "world.limits.jerk"),
    ("world", WorldError("merge-v0", "a road", "none"), 12, "world"),
    ("world", TypeError("no road, received none"), 12, "world"),
]  # fmt: skip


@table(("part", "error", "line", "field"), LOCATED)
def test_errors_of_a_world_are_given_a_line(path, part, error, line, field):
    path.write_text(TEXT)
    fault = located(path, part, error)
    assert (fault.line, fault.field) == (line, field)
