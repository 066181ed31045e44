"""The report of failures: one compact block each, lines that fit, and a summary that names the failures."""

import re
from xml.etree import ElementTree

import pytest

from pytest_pafot.attribution.takeovers import sentence
from pytest_pafot.corpus.reader import load
from tests.helpers.sessions import read_record

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
    start = next(number for number, line in enumerate(lines) if re.fullmatch(rf"_+ {re.escape(name)} _+", line))
    titles = (number for number, line in enumerate(lines) if number > start and re.fullmatch(r"[_=]+ .* [_=]+", line))
    return lines[start : next(titles)]


def search(project, *args, **kwargs):
    return project.run_once(*args, **{"runs": 40, "seed": 2, **kwargs})


@pytest.mark.parametrize(("columns", "at_most"), [(60, 24), (80, 20), (120, 20)])
def test_finding_report_fits_terminal_and_line_limit(explained, monkeypatch, columns, at_most):
    monkeypatch.setenv("COLUMNS", str(columns))
    lines = block(search(explained), f"test_collides[saved-{explained.only_id}]")
    assert len(lines) <= at_most
    assert [line for line in lines if len(line) > columns] == [
        line for line in lines if line.startswith("saved as") and len(line) > columns
    ]


def test_scenario_is_explained_without_what_the_file_has(shrinking, failing):
    lines = block(search(failing), f"test_fails[saved-{failing.only_id}]")
    assert "no collision in 5.0 s" in lines
    assert not any(line.startswith("  scenario ") for line in lines)


def test_the_words_of_a_message_are_not_broken(explained, monkeypatch):
    wide = " ".join(search(explained).stdout.str().replace("E   ", " ").split())
    explained.only_file.unlink()
    monkeypatch.setenv("COLUMNS", "60")
    narrow = " ".join(search(explained).stdout.str().replace("E   ", " ").split())
    told = re.findall(r"AssertionError: .*? The ego is responsible\.", wide)
    assert told
    assert all(each in narrow for each in told)


def test_finding_with_a_takeover_keeps_its_recorded_property(explained):
    recording = "(run, record_property):\n    record_property('speed', 1)"
    explained.write(EXPLAINED.replace("(run):", recording))
    search(explained, "--junitxml=junit.xml", "-ojunit_family=xunit1")
    assert load(explained.only_file).expect.takeover is not None
    cases = ElementTree.parse(explained.path / "junit.xml").getroot().iter("testcase")
    assert [sum(each.get("name") == "speed" for each in case.iter("property")) for case in cases] == [1, 1]


def test_record_contains_explanation_and_takeover_of_the_collision(explained):
    results = [search(explained, "--pafot-json=1.json"), search(explained, "--pafot-json=2.json", runs=0)]
    records = [read_record((explained.path / name).read_text(encoding="utf-8")) for name in ("1.json", "2.json")]
    found, replayed = (record.findings[0].sentences for record in records)
    assert found == replayed
    for result in results:
        lines = block(result, f"test_collides[saved-{explained.only_id}]")
        assert {f"E       {found[0]}", f"E       {found[-1]}"} <= {*lines}
    assert found[-2] == sentence(load(explained.only_file).expect.takeover)


def test_an_id_is_not_repeated_without_need(explained):
    text = search(explained).stdout.str()
    told = [line for line in text.splitlines() if explained.only_id in line]
    assert len(told) == 6  # announced, with its command; search: block; finding: title, file, summary


@pytest.mark.parametrize("flag", ["-v", "--tb=long"])
def test_frames_are_shown_in_full_if_requested(explained, flag):
    lines = block(search(explained, flag), f"test_collides[saved-{explained.only_id}]")
    assert any(line.startswith("run = <Run collision") for line in lines)
    assert '"""A property."""' in [line.strip() for line in lines]


def test_frames_of_other_tests_are_unchanged(explained):
    explained.write("def test_other():\n    '''Other.'''\n    assert 1 == 2\n", name="test_other")
    assert "'''Other.'''" in [line.strip() for line in block(search(explained), "test_other")]


def test_junit_contains_message_and_file_name(explained):
    search(explained, "--junitxml=junit.xml")
    cases = ElementTree.parse(explained.path / "junit.xml").getroot().iter("testcase")
    searched, saved = (case for case in cases)
    assert searched.find("failure").get("message").startswith("Failed: 1 new finding in ")
    assert "collision after " in saved.find("failure").get("message")
    assert "The ego is responsible." in saved.find("failure").text
    named = {each.get("name"): each.get("value") for each in saved.iter("property")}
    assert named["pafot_file"] == explained.files[0]


RED = "\x1b[31m"


def red_lines(result):
    """Return the lines of the messages of failures, and of these the red ones, both without colours."""
    message = [line for line in result.outlines if re.match(r"(\x1b\[[\d;]*m)*E  ", line)]
    return [[re.sub(r"\x1b\[[\d;]*m", "", line) for line in message if RED in line or not is_red] for is_red in (0, 1)]


@pytest.mark.parametrize("options", [(), pytest.param(("-n1",), marks=pytest.mark.processes)])
def test_only_headline_verdict_and_deed_of_a_message_are_red(explained, monkeypatch, options):
    monkeypatch.setenv("COLUMNS", "80")
    plain = [line for line in search(explained, *options, "--color=no").outlines if line.startswith("E  ")]
    explained.forget()
    lines, red = red_lines(search(explained, *options, "--color=yes"))
    assert lines == plain
    starts = ("E   AssertionError: collision after", "E       The ego is responsible.")
    assert [any(line.startswith(start) for line in red) for start in starts] == [True, True]
    assert any("The ego kept 22.0 m/s and did not brake" in line for line in red)
    assert "E       at the impact: " in "".join(lines)
    assert not any("at the impact" in line or "from [s]" in line for line in red)
    rest = lines[1] if lines[1].startswith("E     ") and lines[1][6] != " " else None
    assert rest is None or rest in red  # the rest of a headline that is wrapped has its colour, too


@pytest.mark.processes
def test_workers_fit_their_lines_to_the_terminal(explained, monkeypatch):
    pytest.importorskip("xdist")
    monkeypatch.setenv("COLUMNS", "60")
    monkeypatch.setenv("CI", "1")
    result = search(explained, "-n1")
    lines = result.stdout.str().splitlines()
    told = [line for line in lines if line.startswith("E  ")]
    assert told
    assert max(map(len, told)) <= 60


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
    first = search(project, *options)
    assert first.ret == 1
    assert len(first.stdout.str()) < 100_000
    first.stdout.fnmatch_lines(["*begun", "*characters of output are left out; pytest -s shows all*"])
    replayed = search(project, *options, runs=0)
    assert replayed.ret == 1
    assert len(replayed.stdout.str()) < 100_000
    replayed.stdout.fnmatch_lines(["*characters of output are left out; pytest -s shows all*"])


KEPT = """
TEXTS = []

@pytest.fixture
def ads(request):
    add = request.node.add_report_section  # pytest keeps what it is given here to the end of the session
    request.node.add_report_section = lambda when, key, text: (TEXTS.append(text), add(when, key, text))
    return lambda: lambda observation: (print("x" * 10_000), (0.0, 0.0))[1]

@pafot.search(SHORT)
def test_passes(run):
    pass

def test_texts():
    assert ["characters of output are left out" in each for each in TEXTS if each] == [True]
    assert max(map(len, TEXTS)) < 50_000
"""


@pytest.mark.parametrize("options", [(), ("--capture=sys",), ("--capture=tee-sys",), ("--pafot-isolate",)])
def test_item_that_passed_keeps_only_the_ends_of_its_output(project, options):
    project.write(KEPT)
    project.run(*options).assert_outcomes(passed=2)
