"""A session against a reference: options, files, labels of saved scenarios, and the summary."""

import json
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
    changed.result.stdout.fnmatch_lines(
        [
            "The reference planner_before:make passes this scenario.",
            "compared with planner_before:make: 1 failure introduced, 0 fixed, 0 unchanged",
        ]
    )


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
    told = json.loads((project.path / "pafot.json").read_text())
    (search,), (finding,) = told["searches"], told["findings"]
    paired, id_ = search["paired"], finding["id"]
    counts = (
        f"{paired['only_new']} failed only with this policy, and "
        f"{paired['only_reference']} only with the reference"
    )
    result.stdout.fnmatch_lines(
        [
            f"*found a failed assertion: test_it.py::test_keeps_its_speed?saved-{id_}?*",
            f"  This policy is no worse than planner_before:make: of {paired['runs']} random scenarios, {counts[:6]}*",
            f"  Not counted, because the reference fails as often in other scenarios: {id_} *",
            "compared with planner_before:make: 0 failures introduced, 0 fixed, 0 unchanged, 1 in other scenarios",
        ]
    )
    assert told["exit"] == 0
    assert (search["result"], search["finds"], list(search["no_worse"])) == ("passed", [], [id_])
    assert (finding["status"], finding["file"], finding["result"]) == ("no worse", None, "")
    assert finding["scenario"]
    assert counts in finding["detail"]
    assert counts in (project.path / "pafot.html").read_text()
    summary = (project.path / "summary.md").read_text()
    assert summary.startswith("### pafot: nothing new, 1 no worse")
    assert "\nThis policy is no worse than planner" in summary
    assert f"random scenarios, {counts}." in summary
    assert project.files == []


def test_saved_scenario_label_compares_policy_and_reference(changed):
    for now, before, label, told in (
        (SPEEDS, KEEPS, "still failing", "1 failure introduced, 0 fixed, 0 unchanged"),
        (SPEEDS, BREAKS, "still failing", "0 failures introduced, 0 fixed, 1 unchanged"),
        (KEEPS, SPEEDS, "passed", "0 failures introduced, 1 fixed, 0 unchanged"),
        (KEEPS, f"{KEEPS}# as now\n", "passed", "0 failures introduced, 0 fixed, 0 unchanged"),
    ):
        policies(changed, now, before)
        result = changed.run(AGAINST, runs=0)
        result.assert_outcomes(skipped=1, **{"failed" if now is SPEEDS else "passed": 1})
        result.stdout.fnmatch_lines(
            [f"replayed 1 saved scenario: 1 {label}", f"compared with planner_before:make: {told}"]
        )


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
    result = project.run(AGAINST, "--pafot-json=pafot.json", runs=0)
    worse = f"hits at {speeds[0]:.1f} m/s instead of {speeds[1]:.1f}"
    result.stdout.fnmatch_lines([f"1 of 1 unchanged failure became worse: {saved.id} {worse}"])
    told = json.loads((project.path / "pafot.json").read_text())["findings"][0]
    assert [told[key]["value"] for key in ("severity", "severity_before")] == pytest.approx(
        speeds, abs=1e-3
    )
    assert worse in told["detail"]
    policies(project, brakes, KEEPS)
    project.run(AGAINST, runs=0).stdout.no_fnmatch_line("*became worse*")


def test_common_failure_hides_no_regression_of_same_kind(changed):
    # The old policy failed in the saved scenario, which it recognises by the number of vehicles, and in no other.
    others = len(load(changed.only_file).scenario.npcs)
    policies(
        changed, SPEEDS, SPEEDS.replace("1.25", f"1.25 * (len(observation.others) == {others})")
    )
    result = changed.run(AGAINST)
    result.stdout.fnmatch_lines(
        [
            "replayed 1 saved scenario: 1 still failing",
            "*1 failure introduced, 0 fixed, 1 unchanged",
        ]
    )
    assert len(changed.files) == 2


def test_reference_may_come_from_a_named_fixture(project):
    project.write(
        TEST.replace("MORE", ", against='old_ads'")
        + "\n@pytest.fixture\ndef old_ads():\n    import planner_before\n    return planner_before.make\n"
    )
    policies(project, SPEEDS, KEEPS)
    project.run().stdout.fnmatch_lines(
        ["compared with old_ads: 1 failure introduced, 0 fixed, 0 unchanged"]
    )


def test_unrequested_fixture_as_reference_is_refused(failing):
    failing.run("--pafot-against=old_ads").stdout.fnmatch_lines(
        ["*against: expected module:factory, such as planner_before:make, received 'old_ads'*"]
    )


@pytest.mark.processes
@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")
def test_replay_with_a_reference_that_never_drives_is_an_error(changed):
    never = KEEPS.replace("lambda observation:", "lambda observation, more:")
    for now in (KEEPS, SPEEDS):  # Without the error, the file is fixed, or fails with both.
        policies(changed, now, never)
        result = changed.run(AGAINST, runs=0)
        result.assert_outcomes(failed=1, skipped=1)
        shown = " ".join(result.stdout.str().split())
        assert "against (planner_before:make): the reference failed with TypeError: " in shown
        assert (
            "in this replay and in 10 random scenarios, so it cannot drive at all. Correct the reference, "
            in shown
        )
    npcs = len(load(changed.only_file).scenario.npcs)
    raises = f"        assert len(observation.others) != {npcs}\n        return -1.0, 0.0"
    policies(
        changed, KEEPS, f"def make():\n    def drive(observation):\n{raises}\n    return drive\n"
    )
    # other scenarios have other numbers of NPCs
    changed.write(TEST.replace("MORE", "").replace("SHORT", "genes=2"))
    result = changed.run(AGAINST, runs=0)
    result.assert_outcomes(passed=1, skipped=1)
    assert labels(result) == "1 passed"


def test_next_session_names_reference_that_ended_the_last(project):
    project.write(TEST.replace("MORE", ""))
    policies(
        project, SPEEDS, "import os\n\ndef make():\n    return lambda observation: os._exit(9)\n"
    )
    assert project.run(AGAINST, "-p", "cacheprovider", apart=True).ret == 9
    result = project.run(AGAINST, "-p", "cacheprovider", apart=True)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(
        [
            "*: none of 4 runs failed*the reference also failed.",
            "*note: a process (pid *) died while the reference planner_before:make drove in <Scenario *>*nothing *",
        ]
    )
    assert (project.files, project.records) == ([], [])


def test_search_fails_if_its_reference_always_fails(project):
    project.write(TEST.replace("MORE", ""))
    policies(project, SPEEDS, "def make():\n    return lambda observation: observation.lanes\n")
    result = project.run(AGAINST)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(
        ["the search tested too little:", "the reference itself failed in all its runs, *"]
    )


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
    assert (result.ret, json.loads((project.path / "pafot.json").read_text())["exit"]) == (
        code,
        code,
    )
    if is_itself:
        result.assert_outcomes(failed=1)
        result.stdout.fnmatch_lines(
            ["*against (planner_before:make): expected a different policy*different name*"]
        )
