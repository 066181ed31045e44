"""A session's reports to programs: ``--pafot-json``, the summary of a CI job and properties for JUnit."""

import json
import re
from types import SimpleNamespace
from xml.etree import ElementTree

import pytest

from pytest_pafot.corpus.reader import load
from pytest_pafot.corpus.writer import scenario_data
from pytest_pafot.plugin import reporter
from pytest_pafot.plugin.session import exit_code
from pytest_pafot.report.session import Session
from pytest_pafot.report.terminal import add_event
from pytest_pafot.world import codec
from tests.findings.builders import sighting
from tests.helpers.sessions import read_record

TWO = """
@pafot.search(SHORT)
def test_first(run):
    assert run.scenario.id == ""

@pafot.search(SHORT)
def test_second(run):
    assert run.scenario.id == ""
"""

IS_CUT = """
seen = {}

@pafot.search(SHORT)
def test_fails(run):
    number = seen.setdefault(run.scenario.id, len(seen))
    if number > 1:
        raise KeyboardInterrupt
    pafot.check(1.0, name=f"run {number}", at_most=0.0)
"""
"""A search that is interrupted in its third run, after two different findings."""


SEVERAL_KINDS = """
@pafot.search(SHORT)  # stop_after=3
def test_fails(run):
    pafot.check(1.0, name=f"cell {run.event_cell}", at_most=0.0)
"""


def record_of(project, name="pafot.json"):
    return read_record((project.path / name).read_text(encoding="utf-8"))


def recorded(project, *args, **options):
    project.run("--pafot-json=pafot.json", *args, **options)
    return project.record


def properties(project):
    """Return the properties of each test case in JUnit's file, by name."""
    cases = ElementTree.parse(project.path / "junit.xml").getroot().iter("testcase")
    return {
        case.get("name"): {each.get("name"): each.get("value") for each in case.iter("property")}
        for case in cases
    }


def test_a_search_and_its_find_are_recorded(failing):
    record = recorded(failing)
    (search,), (find,) = record.searches, record.findings
    saved = load(failing.only_file)
    assert (record.exit, record.problems) == (pytest.ExitCode.TESTS_FAILED, [])
    assert (search.node_id, search.result, search.finds) == (
        "test_it.py::test_fails[search]",
        "failed",
        [saved.id],
    )
    assert (search.base_seed, search.seed) == (1, saved.found.seed)
    assert search.message.endswith(f": {find.id}")
    expected = f"test_it.py::test_fails[saved-{saved.id}]", "new", "failed"
    assert (find.node_id, find.status, find.result) == expected
    assert (find.file, find.replay) == (failing.files[0], f"python -m pytest {failing.files[0]}")
    assert (find.signature, find.responsible) == (saved.signature.told, saved.expect.responsibility)
    assert find.runs == search.failing > 0


def test_a_finding_without_a_file_is_recorded_with_its_scenario(failing):
    (find,) = recorded(failing, "--pafot-save=none").findings
    assert find.file is None
    failing.run()
    saved = load(failing.only_file)
    assert find.scenario == scenario_data(saved.scenario)
    assert codec.from_dict(find.world) == codec.from_dict(saved.world)


def test_expired_xfail_is_recorded_with_a_warning(saved):
    saved.accept(until="2027-01-31")
    records = [
        recorded(saved, f"--pafot-today={day}", runs=0) for day in ("2027-01-31", "2027-02-01")
    ]
    assert [record.day for record in records] == ["2027-01-31", "2027-02-01"]
    assert [record.findings[0].result for record in records] == ["xfailed", "failed"]
    accepted = {"reason": "planner issue 12", "until": "2027-01-31"}
    assert [record.findings[0].xfail for record in records] == [accepted] * 2
    assert (records[0].exit, records[0].searches, records[0].warnings) == (0, [], [])
    (warning,) = records[1].warnings
    assert warning.startswith(f"{saved.files[0]}: ")


def test_unreadable_file_is_recorded_with_the_reason(saved):
    name = saved.files[0]
    saved.only_file.write_text("pafot: 99\n")
    (find,) = recorded(saved, runs=0).findings
    expected = saved.only_id, name, "error", "failed"
    assert (find.id, find.file, find.status, find.result) == expected
    assert "99" in find.detail


def test_search_that_cannot_start_is_recorded_with_reason(project):
    project.write("@pafot.search(SHORT, ads='nothing')\ndef test_it(run):\n    pass\n")
    (search,) = recorded(project).searches
    assert (search.result, search.reason, search.runs) == ("error", "", 0)
    assert "the fixture 'nothing'" in search.message


@pytest.mark.parametrize(("quick", "count"), [(1e12, 2), (-1.0, 0)], ids=["quick", "slow"])
def test_findings_are_recorded_during_the_session_unless_writing_takes_long(
    project, monkeypatch, quick, count
):
    # so it takes long or not, however busy the machine is
    monkeypatch.setattr(reporter, "QUICK", quick)
    monkeypatch.setattr(reporter, "REST", 1e12)
    then = "import shutil; shutil.copy('pafot.json', 'then.json')"
    project.write(IS_CUT.replace("raise KeyboardInterrupt", f"{then}; raise KeyboardInterrupt"))
    record, before = recorded(project, no_reraise_ctrlc=True), record_of(project, "then.json")
    assert (before.exit, len(before.findings)) == (None, count)
    assert (record.exit, record.searches[0].reason) == (pytest.ExitCode.INTERRUPTED, "interrupted")
    assert [find.file for find in record.findings] == project.files
    assert len(record.findings) == 2
    assert record.orphans == []  # What the session has found, it has run.


@pytest.mark.processes
def test_killed_session_records_findings_without_exit_code(project):
    cut = IS_CUT.replace("raise KeyboardInterrupt", "import os; os._exit(9)")
    project.write(cut)
    (project.path / "pafot.json").write_text("of an earlier session")
    project.run("--pafot-json=pafot.json", apart=True, runs=20)
    record = record_of(project)
    assert (record.exit, record.searches[0].reason, len(record.findings)) == (None, "", 2)
    assert record.searches[0].result == ""
    assert (record.searches[0].base_seed, record.findings[0].seed) == (1, record.searches[0].seed)


ABORTS = """
import os

@pafot.search(SHORT, ads=lambda: lambda observation: os.abort())
def test_it(run):
    assert run.ads_error
"""


@pytest.mark.processes
def test_lost_process_is_recorded_alike(project):
    project.write(ABORTS)
    texts = []
    for _ in range(2):
        project.run("--pafot-json=pafot.json", "--pafot-isolate", "--pafot-save=none", runs=2)
        texts.append((project.path / "pafot.json").read_text())
    assert texts[0] == texts[1]
    assert json.loads(texts[0])["findings"]


def test_junit_properties_identify_search_finding_and_replay(failing):
    failing.run("--junitxml=junit.xml")
    find = load(failing.only_file)
    search, found = properties(failing).values()
    told = {"pafot_id": find.id, "pafot_signature": find.signature.text}
    told |= {"pafot_file": failing.files[0], "pafot_severity": "none"}  # of an assertion
    assert search == found == {"pafot_seed": str(find.found.seed), "pafot_base_seed": "1", **told}
    failing.run("--junitxml=junit.xml", runs=0)
    replay = properties(failing)[f"test_fails[saved-{find.id}]"]
    assert replay == {"pafot_seed": str(find.found.seed), **told, "pafot": "still failing"}


def test_junit_names_all_findings_and_unreadable_files(project):
    project.write(SEVERAL_KINDS)
    project.run("--junitxml=junit.xml", "--pafot-shrink-runs=0", runs=80)
    search = properties(project)["test_fails[search]"]
    assert sorted(search["pafot_file"].split(", ")) == project.files
    assert len(project.files) == len(search["pafot_id"].split(", ")) == 3
    (project.path / project.files[0]).write_text("pafot: 99\n")
    project.run("--junitxml=junit.xml", runs=0)
    named = [
        each for each in properties(project).values() if each.get("pafot_file") == project.files[0]
    ]
    assert [set(each) for each in named] == [{"pafot_id", "pafot_file"}]


RECORDING = """
def ads():
    return lambda observation: (0.0, 0.0)

def standing():
    return lambda observation: (-5.0, 0.0)

@pytest.fixture(autouse=True)
def of_setup(record_property):
    record_property("requirement", "REQ-001")

@pytest.fixture
def log(record_property):
    return lambda run: record_property("speed", round(float(run.ego.speed[-1]), 1))

@pafot.search(SHORT, ads=ads, against=standing, world=pafot.Highway(duration=10), shrink_runs=10)
def test_it(run, record_property, record_testsuite_property, record_xml_attribute, log):
    record_property("requirement", "REQ-001")
    record_testsuite_property("suite", "S-1")
    record_xml_attribute("assertions", "2")
    log(run)
    log(run)
    assert run.ego.speed[-1] < 5.0
"""


def test_properties_of_a_marked_test_are_those_of_one_run(project):
    project.write(RECORDING)
    arguments = ["--junitxml=junit.xml", "-ojunit_family=xunit1", "--pafot-stop-after=1"]
    arguments.append("-Wignore::pytest.PytestExperimentalApiWarning")
    project.run(*arguments)

    def recorded():
        root = ElementTree.parse(project.path / "junit.xml").getroot()
        suite = root.findall("testsuite/properties/property")
        assert [(each.get("name"), each.get("value")) for each in suite] == [("suite", "S-1")]
        of_cases = {}
        for case in root.iter("testcase"):
            pairs = [(each.get("name"), each.get("value")) for each in case.iter("property")]
            of_cases[case.get("name")] = [each for each in pairs if "pafot" not in each[0]]
        return of_cases

    saved = load(project.only_file)
    one = [("requirement", "REQ-001")] * 2 + [("speed", "22.0")] * 2
    names = ["test_it[search]", f"test_it[saved-{saved.id}]"]
    assert recorded() == dict.fromkeys(names, one)
    project.run(*arguments, runs=0)
    assert recorded()[names[1]] == one  # and not those of the run of the reference, which came last


@pytest.fixture
def summary(project, monkeypatch):
    """Return the file for the summary of a step, which already has an earlier command's text."""
    path = project.path / "summary.md"
    path.write_text("before\n")
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(path))
    return path


def test_the_summary_of_a_job_is_appended_to_if_it_can_be_written(summary, failing, monkeypatch):
    recorded(failing)
    assert summary.read_text().startswith("before\n### pafot: 1 new\n")
    assert f"<br>`python -m pytest {failing.files[0]}`\n" in summary.read_text()
    failing.forget()
    # as the operating system reads the path, which `..` after a link leads elsewhere
    (failing.path / "other" / "inner").mkdir(parents=True)
    (failing.path / "link").symlink_to("other/inner")
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(failing.path / "link" / ".." / "summary.md"))
    failing.run()
    assert (failing.path / "other" / "summary.md").exists()
    failing.forget()
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(failing.path / "none" / "summary.md"))
    (failing.path / "taken").mkdir()
    result = failing.run("--pafot-json=taken")
    result.assert_outcomes(failed=2)
    result.stdout.fnmatch_lines_random(
        ["  problem: GITHUB_STEP_SUMMARY=*", "  problem: --pafot-json=taken: *"]
    )


def test_a_job_on_github_tells_five_findings_and_escapes_what_commands_mean(
    summary, project, monkeypatch
):
    monkeypatch.setenv("GITHUB_ACTIONS", "true")
    project.write(
        "@pytest.mark.parametrize('n', range(6))\n@pafot.search(SHORT)  # stop_after=1\ndef test_a(run, n):\n"
        "    assert not run.collision, run.explain()\n\n"
        "def broken():\n    def decide(observation):\n        if observation.time > 2:\n"
        "            raise ValueError('50 % done\\n::warning::x, y')\n        return 0.0, 0.0\n    return decide\n\n"
        "@pafot.search(SHORT, ads=broken)  # stop_after=1\ndef test_b(run):\n    pass\n",
        name="test_50%,x",
    )
    result = project.run("--pafot-report=out.html", runs=12)
    lines = [line for line in result.outlines if line.startswith("::")]
    assert len(lines) == 6
    for line in lines[:5]:
        command, text = re.fullmatch(
            r"::error file=test_50%25%2Cx\.py,title=[a-z0-9-]+::(.*?)%0A(.*)", line
        ).groups()
        assert command
        assert text.count("%0A") >= 1  # the sentences
        assert text.replace("%0A", "").replace("%25", "").count("%") == 0
    assert lines[5].startswith("::notice title=pafot::2 ")
    assert summary.read_text().count("\n- `test_50%,x.py::test_") == 5

    project.forget()
    result = project.run("-k", "test_b")
    (line,) = [line for line in result.outlines if line.startswith("::")]
    assert re.search(r"::.* s: ValueError: 50 %25", line)
    assert not any(
        each.startswith("::warning")
        for each in [*result.outlines, *summary.read_text().splitlines()]
    )


def test_second_interrupt_leaves_the_code_of_the_first():
    # pytest has not noted the first Ctrl-C yet
    session = SimpleNamespace(exitstatus=pytest.ExitCode.OK)
    assert exit_code(session) == 0
    try:
        raise KeyboardInterrupt
    except KeyboardInterrupt:
        assert exit_code(session) == 2


def test_what_is_left_to_shrink_of_a_new_finding_is_still_known_after_its_replay_alone():
    session = Session()

    def left(**seen):
        add_event(session, sighting("a", node_id="a", **seen), "t.py::t[search]")
        return session.seen["a"].unshrunk

    assert left(unshrunk="not confirmed") == "not confirmed"
    assert left() == ""  # it was confirmed
    assert left(unshrunk="not simplified") == "not simplified"
    assert left(label="still failing") == "not simplified"
