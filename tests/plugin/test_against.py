"""A session against a reference: options, files, labels of saved scenarios, and the summary."""

import re
import sys

import pytest

from pytest_pafot.corpus.reader import load
from pytest_pafot.searches import saved_scenario
from tests.helpers.tables import table
from tests.plugin.conftest import labels

KEEPS = "def make():\n    return lambda observation: (0.0, 0.0)\n"
# the lengths differ, so that no stale copy is used
SPEEDS = KEEPS.replace("(0.0, 0.0)", "(1.25, 0.0)")
BREAKS = KEEPS.replace("(0.0, 0.0)", "(-1.0, 0.0)")
TEST = """
import planner

@pafot.search(SHORT, ads=planner.make, shrink_runs=9MORE)  # stop_after=1
def test_keeps_its_speed(run):
    assert run.ego.speed.max() < 22.5
    assert run.ego.speed.min() > 21.5
"""
AGAINST = "--pafot-against=planner_before:make"


def policies(project, now, before):
    project.pytester.makepyfile(planner=now, planner_before=before)


def compared(result):
    """Return how many failures the summary counts as introduced, fixed and unchanged."""
    line = next(line for line in result.outlines if line.startswith("compared with "))
    return [int(number) for number in re.findall(r" (\d+) ", line)][:3]


@pytest.fixture
def changed(project):
    """Return a project whose policy now speeds up, unlike before, with what a session found about it."""
    project.write(TEST.replace("MORE", ""))
    policies(project, SPEEDS, KEEPS)
    project.result = project.run_once(AGAINST)
    return project


def test_regression_is_saved_with_its_passing_reference(changed):
    changed.result.assert_outcomes(failed=2)
    assert load(changed.only_file).expect.against == "planner_before:make"
    assert compared(changed.result) == [1, 0, 0]


ELSEWHERE = """
from zlib import crc32


class Policy:
    number = 0

    def __call__(self, seen):
        self.number += 1
        if self.number == 10:
            self.faster = crc32(repr([other.x for other in seen.others]).encode()) % 2 == PART
        return float(self.number >= 10 and self.faster), 0.0


make = Policy
"""


def test_policy_that_fails_as_often_elsewhere_passes(project, monkeypatch):
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(project.path / "summary.md"))
    project.write(TEST.replace("MORE", ""))
    policies(project, ELSEWHERE.replace("PART", "0"), ELSEWHERE.replace("PART", "1") + "# before")
    result = project.run(AGAINST, "--pafot-json=pafot.json", "--pafot-report=pafot.html")
    result.assert_outcomes(passed=1)
    (search,), (finding,) = project.record.searches, project.record.findings
    assert compared(result) == [0, 0, 0]
    assert project.record.exit == 0
    assert (search.result, search.finds, [*search.no_worse]) == ("passed", [], [finding.id])
    assert (finding.status, finding.file, finding.result) == ("no worse", None, "")
    assert finding.scenario
    counts = [search.paired[name] for name in ("only_new", "only_reference")]
    assert [int(each) for each in re.findall(r"\d+", finding.detail)][-2:] == counts
    for name in ("pafot.html", "summary.md"):
        assert finding.detail in (project.path / name).read_text().replace("\\", "").replace(
            "&#8203;", ""
        )
    assert project.files == []


def test_saved_scenario_label_compares_policy_and_reference(changed):
    for now, before, label, counts in (
        (SPEEDS, KEEPS, "still failing", [1, 0, 0]),
        (SPEEDS, BREAKS, "still failing", [0, 0, 1]),
        (KEEPS, SPEEDS, "passed", [0, 1, 0]),
        (KEEPS, f"{KEEPS}# as now\n", "passed", [0, 0, 0]),
    ):
        policies(changed, now, before)
        result = changed.run(AGAINST, runs=0)
        result.assert_outcomes(skipped=1, **{"failed" if now is SPEEDS else "passed": 1})
        assert (labels(result), compared(result)) == (f"1 {label}", counts)


CRASHES = """
# stop_after=1
@pafot.search(npcs=1, genes=2, gene_seconds=10, blame="ego", ads=planner.make, shrink_runs=0, vehicles="car")
def test_never_collides(run):
    assert not run.collision
"""


def test_common_failure_reports_harder_hits_than_the_reference(project):
    project.write("import planner\n" + CRASHES)
    brakes = KEEPS.replace("0.0, 0.0", "-1.0, 0.0")
    policies(project, KEEPS, brakes)
    project.run(runs=16, seed=2)
    saved = saved_scenario.load(project.only_file)
    speeds = [
        saved.replay(lambda policy=policy: lambda seen: (policy, 0.0)).collision.closing_speed
        for policy in (0.0, -1.0)
    ]
    assert speeds[0] > speeds[1] + 1.0
    for now, before, is_worse in ((KEEPS, brakes, True), (brakes, KEEPS, False)):
        policies(project, now, before)
        result = project.run(AGAINST, "--pafot-json=pafot.json", runs=0)
        (told,) = project.record.findings
        values = [told[key]["value"] for key in ("severity", "severity_before")]
        assert values == pytest.approx(speeds if is_worse else speeds[::-1], abs=1e-3)
        numbers = f"{speeds[0]:.1f} m/s instead of {speeds[1]:.1f}"
        assert [numbers in text for text in (told.detail, result.stdout.str())] == [is_worse] * 2


def test_common_failure_hides_no_regression_of_same_kind(changed):
    # The old policy failed in the saved scenario, which it recognises by the number of vehicles, and in no other.
    others = len(load(changed.only_file).scenario.npcs)
    before = SPEEDS.replace("1.25", f"1.25 * (len(observation.others) == {others})")
    policies(changed, SPEEDS, before)
    result = changed.run(AGAINST)
    assert (labels(result), compared(result)) == ("1 still failing", [1, 0, 1])
    assert len(changed.files) == 2


def test_reference_may_come_from_a_named_fixture(project):
    project.write(
        TEST.replace("MORE", ", against='old_ads'")
        + "\n@pytest.fixture\ndef old_ads():\n    import planner_before\n    return planner_before.make\n"
    )
    policies(project, SPEEDS, KEEPS)
    assert compared(project.run()) == [1, 0, 0]


def test_unrequested_fixture_as_reference_is_refused(failing):
    failing.run("--pafot-against=old_ads").assert_outcomes(errors=1)
    assert failing.files == []


@pytest.mark.processes
@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")
def test_replay_with_a_reference_that_never_drives_is_an_error(changed):
    never = KEEPS.replace("lambda observation:", "lambda observation, more:")
    for now in (KEEPS, SPEEDS):  # Without the error, the file is fixed, or fails with both.
        policies(changed, now, never)
        changed.run(AGAINST, "--pafot-json=pafot.json", runs=0).assert_outcomes(failed=1, skipped=1)
        assert changed.record.findings[0].status == "error"
    npcs = len(load(changed.only_file).scenario.npcs)
    raises = f"        assert len(observation.others) != {npcs}\n        return -1.0, 0.0"
    drives = f"def make():\n    def drive(observation):\n{raises}\n    return drive\n"
    policies(changed, KEEPS, drives)
    # other scenarios have other numbers of NPCs
    changed.write(TEST.replace("MORE", "").replace("SHORT", "genes=2"))
    result = changed.run(AGAINST, runs=0)
    result.assert_outcomes(passed=1, skipped=1)
    assert labels(result) == "1 passed"


def test_next_session_names_reference_that_ended_the_last(project):
    project.write(TEST.replace("MORE", ""))
    before = "import os\n\ndef make():\n    return lambda observation: os._exit(9)\n"
    policies(project, SPEEDS, before)
    assert project.run(AGAINST, "-p", "cacheprovider", apart=True).ret == 9
    result = project.run(AGAINST, "-p", "cacheprovider", apart=True)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*note:* planner_before:make *<Scenario *>*"])
    assert (project.files, project.records) == ([], [])


def test_search_fails_if_its_reference_always_fails(project):
    project.write(TEST.replace("MORE", ""))
    policies(project, SPEEDS, "def make():\n    return lambda observation: observation.lanes\n")
    project.run(AGAINST).assert_outcomes(failed=1)


@table(("now", "before", "is_itself"), [
    ("from core import make\n", "from core import make\n", True),
    (KEEPS, KEEPS, True),
    (KEEPS, f"{KEEPS}# another text\n", False),
    (KEEPS, "from planner import make\n", True),
])  # fmt: skip
def test_policy_is_not_compared_with_itself(project, now, before, is_itself):
    project.pytester.makepyfile(core=KEEPS)
    project.write(TEST.replace("MORE", ""))
    policies(project, now, before)
    result = project.run(AGAINST, "-p", "no:cacheprovider", "--pafot-json=pafot.json")
    code = pytest.ExitCode.USAGE_ERROR if is_itself else pytest.ExitCode.OK
    assert (result.ret, project.record.exit) == (code, code)
