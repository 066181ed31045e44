"""The report of failures: one compact block each, lines that fit, and a summary that names the failures."""

import re
from itertools import takewhile
from xml.etree import ElementTree

import pytest

from pytest_pafot.attribution.takeovers import sentence
from pytest_pafot.corpus.reader import load

EXPLAINED = """
@pafot.search(SHORT, blame="ego")  # stop_after=1
def test_collides(run):
    \"\"\"A property.\"\"\"
    assert not run.collision, run.explain()
"""


@pytest.fixture
def explained(project, shrinking):
    """Return a project whose test explains each failing run."""
    project.write(EXPLAINED)
    return project


def block(result, name):
    """Return the lines of a failure's section, with its title."""
    lines = result.stdout.str().splitlines()
    start = next(
        number
        for number, line in enumerate(lines)
        if re.fullmatch(rf"_+ {re.escape(name)} _+", line)
    )
    titles = (
        number
        for number, line in enumerate(lines)
        if number > start and re.fullmatch(r"[_=]+ .* [_=]+", line)
    )
    return lines[start : next(titles)]


def search(project, *args, **kwargs):
    return project.run_once(*args, **{"runs": 40, "seed": 2, **kwargs})


POLICIES = """
import os
import random

def cruise(seen):
    ahead = [other for other in seen.others if other.lane == seen.ego.lane and other.x > seen.ego.x]
    late = any(other.x - seen.ego.x < 1.5 * (seen.ego.speed - other.speed) for other in ahead)
    return (-6.0 if late else min(28.0 - seen.ego.speed, 2.0)), 0.0

def close(seen):
    return any(abs(other.x - seen.ego.x) < 10 for other in seen.others)

def raises(seen):
    return 1 / (not close(seen)), 0.0

def hangs(seen):
    while close(seen):
        pass
    return 0.0, 0.0

def dies(seen):
    return (os._exit(9) if close(seen) else 0.0), 0.0

def dice(seen):
    acceleration, steering = cruise(seen)
    return (acceleration if random.random() < 0.5 else 2.0), steering

"""
# the policy, the arguments of its search, the body of its test, and what the session says when it finds it
KINDS = {
    "collision": ("cruise", "blame='ego'", "assert not run.collision, run.explain()", "a collision"),
    "check": ("cruise", "", "pafot.check(-run.ego.acceleration, name='braking', at_most=5.0, unit='m/s^2')",
              "a failed check"),
    "measure": ("cruise", "", "assert run.min_ttc > 1.0", "a failed assertion"),
    "error": ("raises", "", "pass", "an error in the policy"),
    "hang": ("hangs", "world=pafot.Highway(hang_limit=0.2)", "pass", "a hang in the policy"),
    "death": ("dies", "isolate=True", "pass", "a process crash"),
    "random": ("dice", "blame='ego'", "assert not run.collision", "a collision"),
}  # fmt: skip


def of_kinds(*kinds):
    """Return a test file with a search for each kind of failure, each of which is found in few runs."""
    test = "@pafot.search(SHORT, ads=lambda: {}, {})  # stop_after=1\ndef test_{}(run):\n    {}\n\n"
    return POLICIES + "".join(test.format(*KINDS[kind][:2], kind, KINDS[kind][2]) for kind in kinds)


def blocks(result):
    """Return the block of each failure, with its title."""
    lines = (
        result.stdout.str().partition(" FAILURES ")[2].partition("= pafot =")[0].splitlines()[1:-1]
    )
    begins = [number for number, line in enumerate(lines) if re.fullmatch("_+ .* _+", line)]
    return [lines[begin:end] for begin, end in zip(begins, [*begins[1:], None], strict=True)]


def of_search(result, name):
    """Return the lines of the summary on a search."""
    first, *rest = (
        result.stdout.str().partition("= pafot =")[2].partition(f"\n{name}")[2].splitlines()
    )
    return [name + first, *takewhile(lambda line: line.startswith("  "), rest)]


@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_of_failure_has_a_short_block_line_and_summary(
    project, examined, monkeypatch, kind
):
    monkeypatch.setenv("COLUMNS", "80")
    project.write(of_kinds(kind))
    result = project.run_once("--pafot-shrink-runs=40", runs=40, seed=2)
    name, (lines,) = f"test_{kind}[saved-{project.only_id}]", blocks(result)
    assert len(lines) <= 12
    assert lines[0].strip("_ ") == name
    assert lines[-1] == f"replay pytest {project.files[0]}"
    before = result.stdout.str().partition(" FAILURES ")[0].splitlines()
    (line,) = [line for line in before if project.only_id in line]
    assert line == f"pafot: found {KINDS[kind][3]}: test_it.py::{name}"
    assert 2 <= len(of_search(result, f"test_it.py::test_{kind}[search]")) <= 8


@pytest.mark.parametrize("columns", [60, 80, 120, 200])
def test_no_line_of_a_block_or_summary_but_its_command_exceeds_the_terminal(
    project, examined, monkeypatch, columns
):
    monkeypatch.setenv("COLUMNS", str(columns))
    # whose texts are short, but whose runs are slow
    kinds = [kind for kind in KINDS if kind not in ("hang", "death")]
    project.write(of_kinds(*kinds))
    result = project.run(runs=40, seed=2)
    told = blocks(result)
    assert len(told) == len(kinds)
    assert all(lines[-1].startswith("replay pytest pafot_corpus/") for lines in told)
    told += [[*of_search(result, f"test_it.py::test_{kind}[search]"), ""] for kind in kinds]
    assert [line for lines in told for line in lines[:-1] if len(line) > columns] == []


def test_scenario_is_explained_without_what_the_file_has(shrinking, failing):
    lines = block(search(failing), f"test_fails[saved-{failing.only_id}]")
    assert not any(line.startswith("  scenario ") for line in lines)


def test_the_words_of_a_message_are_not_broken(explained, monkeypatch):
    wide = " ".join(search(explained).stdout.str().split())
    explained.only_file.unlink()
    monkeypatch.setenv("COLUMNS", "60")
    narrow = " ".join(search(explained).stdout.str().split())
    told = re.findall(r"The ego hit .*?\.", wide)
    assert told
    assert all(each in narrow for each in told)


def test_all_outputs_of_a_session_tell_the_same_of_a_finding(explained):
    recording = "(run, record_property):\n    record_property('speed', 1)"
    explained.write(EXPLAINED.replace("(run):", recording))
    explained.write("def test_other():\n    '''Other.'''\n    assert 1 == 2\n", name="test_other")
    outputs = ("--junitxml=junit.xml", "-ojunit_family=xunit1", "--pafot-json=pafot.json")
    result = search(explained, *outputs)
    id_, file = explained.only_id, explained.files[0]
    # announced; title, command; summary of the search; both lines of pytest's short summary
    assert sum(id_ in line for line in result.outlines) == 6
    found = explained.record.findings[0].sentences
    assert found[-1].endswith(sentence(load(explained.only_file).expect.takeover))
    searched, saved, _ = ElementTree.parse(explained.path / "junit.xml").getroot().iter("testcase")
    for case in (searched, saved):
        assert [each.get("name") for each in case.iter("property")].count("speed") == 1
    assert id_ in searched.find("failure").get("message")
    assert "NPC " in saved.find("failure").get("message")
    assert f"replay pytest {file}" in saved.find("failure").text
    assert {each.get("name"): each.get("value") for each in saved.iter("property")}[
        "pafot_file"
    ] == file
    assert "'''Other.'''" in [line.strip() for line in block(result, "test_other")]
    again = search(explained, *outputs, runs=0)
    assert explained.record.findings[0].sentences == found
    for each in (result, again):
        assert {*found} <= {*block(each, f"test_collides[saved-{id_}]")}


@pytest.mark.parametrize("flag", ["-v", "--tb=long"])
def test_frames_are_shown_in_full_if_requested(explained, flag):
    lines = block(search(explained, flag), f"test_collides[saved-{explained.only_id}]")
    assert any(line.startswith("run = <Run collision") for line in lines)
    assert '"""A property."""' in [line.strip() for line in lines]


@pytest.mark.processes
def test_workers_fit_their_lines_to_the_terminal(explained, monkeypatch):
    pytest.importorskip("xdist")
    monkeypatch.setenv("COLUMNS", "60")
    monkeypatch.setenv("CI", "1")
    result = search(explained, "-n1")
    ((*told, command),) = blocks(result)
    assert command.startswith("replay ")
    assert len(told) > 1
    # The line of pytest-xdist on the worker has the path of the interpreter.
    assert max(len(line) for line in told if not line.startswith("[gw")) <= 60


PRINTS = """
@pytest.fixture
def ads():
    def decide(observation):
        print("x" * 10_000)
        return 0.0, 0.0
    print("begun")
    return lambda: decide

@pafot.search(SHORT, blame="ego")  # stop_after=1
def test_collides(run):
    assert not run.collision
"""


@pytest.mark.parametrize("options", [(), ("--pafot-isolate",), ("--pafot-workers=2",), ("-n2",)])
def test_policy_that_prints_much_leaves_the_ends_of_its_output(project, shrinking, options):
    if options == ("-n2",):
        pytest.importorskip("xdist")
    project.write(PRINTS)
    first = search(project, "-v", *options)
    assert first.ret == 1
    assert len(first.stdout.str()) < 100_000
    first.stdout.fnmatch_lines(["*begun", "*pytest -s*"])
    replayed = search(project, *options, runs=0)
    assert replayed.ret == 1
    assert len(replayed.stdout.str()) < 100_000
    replayed.stdout.fnmatch_lines(["*pytest -s*"])


KEPT = """
TEXTS = []

@pytest.fixture
def ads(request):
    add = request.node.add_report_section  # pytest keeps what it is given here to the end of the session
    request.node.add_report_section = lambda when, key, text: (TEXTS.append(text), add(when, key, text))
    return lambda: lambda observation: (print("x" * 10_000), (0.0, 0.0))[1]

@pafot.search(SHORT)
def test_passes(run): pass

def test_texts():
    assert ["pytest -s" in each for each in TEXTS if each] == [True]
    assert max(map(len, TEXTS)) < 50_000
"""


@pytest.mark.parametrize(
    "options", [(), ("--capture=sys",), ("--capture=tee-sys",), ("--pafot-isolate",)]
)
def test_item_that_passed_keeps_only_the_ends_of_its_output(project, options):
    project.write(KEPT)
    project.run(*options).assert_outcomes(passed=2)
