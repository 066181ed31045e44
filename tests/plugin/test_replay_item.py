"""Replays: labels, drift, xfail, and when a failure is new again."""

import json
import re

import pytest

from tests.plugin.conftest import CONFTEST, labels, shows

KNOWN = """
@pafot.search(genes=2, gene_seconds=5, npcs=1, ego_lane=1, ego_speed=22)
def test_fails(run):
    if run.event_cell != 6 or run.collision:
        return
    LINE
"""
"""A test all of whose failures have one signature."""

FAILS = KNOWN.replace("LINE", "assert run.outcome == 'x'")
PASSES = KNOWN.replace("LINE", "assert run.outcome")


BRAKING = CONFTEST.replace("(0.0, 0.0)", "(-8.0 if observation.ego.speed > 1 else 0.0, 0.0)")
GYM = """
@pafot.search(ads=lambda: lambda observation: 1, world=pafot.World("highway-fast-v0", duration=5.0))  # stop_after=1
def test_fails(run):
    assert run.duration < 1
"""


@pytest.fixture
def saved(shrinking, project):
    """Return a project with one saved scenario, whose search finds only that one."""
    project.write(FAILS)
    project.run_once(runs=20)
    assert len(project.files) == 1
    return project


def edited(project, old, new):
    text = project.only_file.read_text()
    assert old in text
    project.only_file.write_text(text.replace(old, new))


def test_passing_scenario_is_labelled_fixed_but_not_removed(saved):
    before = saved.contents
    saved.write(PASSES)
    result = saved.run("-v", runs=0)
    result.assert_outcomes(passed=1, skipped=1)
    result.stdout.fnmatch_lines(
        ["*saved-* PASSED (passes*)*", "replayed 1 saved scenario: 1 passed"]
    )
    assert saved.contents == before


def test_a_search_counts_a_known_failure_and_passes(saved):
    before = saved.contents
    result = saved.run(runs=20)
    result.assert_outcomes(failed=1, passed=1)
    result.stdout.fnmatch_lines([f"  {saved.only_id}: * (known)."])
    assert saved.contents == before


def test_accepted_failure_lets_the_session_pass(saved):
    saved.accept()
    result = saved.run(runs=20)
    assert result.ret == 0
    result.assert_outcomes(passed=1, xfailed=1)
    result.stdout.fnmatch_lines([f"  {saved.only_id}: * (known)."])


def test_accepted_file_that_passes_fails_until_line_removed(saved):
    saved.accept()
    saved.write(PASSES)
    result = saved.run(runs=0)
    result.assert_outcomes(failed=1, skipped=1)
    result.stdout.fnmatch_lines(
        [
            "[[]XPASS(strict)] planner issue 12",
            f"It did not fail (passes). Remove the line `xfail:` from {saved.files[0]}",
        ]
    )


FIXTURE = """
@pytest.fixture(autouse=True)
def prepared():
    RAISE
"""


@pytest.mark.parametrize(
    ("raises", "outcome"), [("1 / 0", "errors"), ("pytest.xfail('later')", "xfailed")]
)
def test_accepting_a_failure_accepts_no_error_of_a_fixture(saved, raises, outcome):
    saved.accept()
    saved.write(f"{FAILS}\n{FIXTURE.replace('RAISE', raises)}")
    saved.run(runs=0).assert_outcomes(**{outcome: 1}, skipped=1)


OVER = "  warning: *.pafot.yaml: the failure is no longer accepted (planner issue 12, until 2027-01-31). Correct *"


def test_expired_xfail_that_passes_is_only_a_warning(saved):
    saved.accept(until="2027-01-31")
    saved.write(PASSES)
    saved.run("--pafot-today=2027-01-31", runs=0).assert_outcomes(failed=1, skipped=1)
    result = saved.run("--pafot-today=2027-02-01", runs=0)
    result.assert_outcomes(passed=1, skipped=1)
    result.stdout.fnmatch_lines([OVER])


def test_last_xfail_day_is_compared_with_the_calendar(saved):
    saved.accept()
    saved.run(runs=0).assert_outcomes(xfailed=1, skipped=1)
    edited(saved, "9999-12-31", "2026-01-01")
    saved.run(runs=0).assert_outcomes(failed=1, skipped=1)


def test_passing_replay_under_other_versions_has_drifted(saved):
    edited(saved, "highway-env: ", "highway-env: 0.")
    saved.write(PASSES)
    result = saved.run("-v", runs=0)
    result.assert_outcomes(passed=1, skipped=1)
    result.stdout.fnmatch_lines(
        [
            "*PASSED (drifted)*",
            "replayed 1 saved scenario: 1 drifted",
            "    highway-env * instead of 0.*",
        ]
    )
    saved.run("--pafot-strict-drift", runs=0).assert_outcomes(failed=1, skipped=1)


def test_replay_without_incident_reports_how_long_it_lasted(project):
    project.write(
        "@pafot.search(SHORT)  # stop_after=1\ndef test_drive(run):\n    assert not run.collision\n"
    )
    project.run_once("--pafot-shrink-runs=0", runs=20)
    project.pytester.makeconftest(BRAKING)
    edited(project, "highway-env: ", "highway-env: 0.")
    result = project.run(runs=0)
    result.stdout.fnmatch_lines(
        ["    *safe for 10.0 s instead of collision at * s; highway-env * instead of 0.*"]
    )


CUT_IN = """
@pafot.search(SHORT)  # stop_after=1
def test_drive(run):
    if run.responsibility == "ego":
        return
    assert not run.collision
"""
"""A test that an NPC makes fail, by an entry close to the ego: an ego that brakes earlier is far from there."""


def test_pass_without_its_situation_is_no_fix(project):
    project.write(CUT_IN)
    project.pytester.makepyfile(before="def make():\n    return lambda seen: (0.0, 0.0)\n")
    project.run_once("--pafot-shrink-runs=0", runs=40)
    project.pytester.makeconftest(BRAKING)
    told = ["--junitxml=junit.xml", "--pafot-report=page.html", "--pafot-json=session.json"]
    result = project.run(*told, "--pafot-against=before:make", runs=0)
    result.assert_outcomes(passed=1, skipped=1)
    missed = "the situation did not occur: before the saved run failed, NPC"
    result.stdout.fnmatch_lines(
        [
            "*1 drifted",
            f"    {missed} ? was * m ahead in the ego's lane *",
            "compared with before:make: *, 0 fixed, 0 unchanged",
        ]
    )
    for name in ("junit.xml", "page.html", "session.json"):
        assert missed in (project.path / name).read_text(), name
    project.run("--pafot-strict-drift", runs=0).assert_outcomes(failed=1, skipped=1)


def test_uneventful_runs_are_compared_by_most_critical_moment(project):
    project.write(
        "@pafot.search(SHORT)  # stop_after=1\ndef test_drive(run):\n    assert run.collision\n"
    )
    project.run_once("--pafot-shrink-runs=0")
    head, _, tail = project.only_file.read_text().partition("time: ")
    project.only_file.write_text(f"{head}time: 99.5,{tail.partition(',')[2]}")
    result = project.run(runs=0)
    result.stdout.fnmatch_lines(
        ["*drifted (safe and most critical at * s instead of safe and most critical at 99.5 s)."]
    )


def test_a_replay_uses_the_world_of_the_file(saved):
    edited(saved, "lanes: 4", "lanes: 3")
    saved.write(PASSES.replace("assert run.outcome", "assert len(run.trace.lanes) == 3"))
    saved.run(runs=0).assert_outcomes(passed=1, skipped=1)


def test_replay_whose_passing_run_is_cut_has_drifted(saved):
    saved.write(
        FAILS.replace("genes=2", "world=pafot.Highway(duration=0.4), genes=2").replace(
            "'x'", "'safe'"
        )
    )
    result = saved.run(runs=0)
    result.assert_outcomes(passed=1, skipped=1)
    result.stdout.fnmatch_lines(["*1 drifted*", "*world.duration is 10.0 in the file, 0.4 now*"])


def check_copies(project, edits):
    """Check that a session names the line of each edited copy of a file, in the same folder, and what is wrong."""
    file, text = project.only_file, project.only_file.read_text()
    for number, (old, new, _) in enumerate(edits):
        assert old in text
        file.with_name(f"copy-{number}.pafot.yaml").write_text(text.replace(old, new))
    file.unlink()
    result = project.run(runs=0)
    result.assert_outcomes(failed=len(edits), skipped=1)
    for number, (*_, told) in enumerate(edits):
        shows(result, f"test_fails[saved-copy-{number}]", f"*copy-{number}.pafot.yaml:{told}")


def test_invalid_world_or_scenario_fails_item_with_line(saved):
    edits = [
        (
            "lanes: 4",
            "lanes: 40",
            "15: world.lanes: expected a whole number from 3 to 6, received 40. Correct *",
        ),
        (
            "overspeed: 1.1",
            "overspeed: 2.0",
            "15: world.speed_limit: expected at most 20.0 m/s, because *",
        ),
        (
            "lane: 1, speed",
            "lane: 9, speed",
            "4: scenario.ego.lane: expected a lane from 0 to 3, received 9. *",
        ),
        (
            "cell: rear, speed: 0.0",
            "cell: rear, speed: 99.0",
            "7: scenario.npcs.NPC 0[[]0].speed: expected at most the *",
        ),
        (
            "gene_seconds: 5.0",
            "gene_seconds: 5.01",
            "5: scenario.gene_seconds: expected a whole number of ticks *",
        ),
    ]
    check_copies(saved, edits)


def test_environment_creation_failure_is_reported_with_line(project):
    project.write(GYM)
    project.run_once()
    edits = [
        (
            "lanes_count: 3",
            "lanes_count: many",
            "25: world.config: expected a configuration that the environment *",
        ),
        (
            "lanes_count: 3",
            "lanes_cound: 3",
            "25: world.config: expected options of highway-fast-v0, received lanes_c*",
        ),
        (
            "highway-fast-v0",
            "highway-slow-v0",
            "24: world.env_id: expected a registered environment, received *",
        ),
    ]
    check_copies(project, edits)


def test_a_rejected_replay_is_skipped_and_not_green(saved):
    saved.write(PASSES.replace("!= 6", "== 6").replace("        return", "        pafot.reject()"))
    saved.run(runs=0).assert_outcomes(skipped=2)


def test_a_flaky_replay_without_a_rate_is_never_called_fixed(project):
    project.write(
        """
calls = []

def flaky():
    calls.append(1)
    brake = -3.0 if len(calls) % 2 else 0.0
    return lambda observation: (brake, 0.0)

@pafot.search(SHORT, ads=flaky)  # stop_after=1
def test_brakes(run):
    assert run.hardest_brake < 1
"""
    )
    result = project.run()
    result.stdout.fnmatch_lines(["*Flaky: running it again gave a different run*"])
    file = project.only_file
    file.write_text(re.sub(r"(?m)^rate: .*\n", "", file.read_text()))
    project.write(
        (project.path / "test_it.py")
        .read_text()
        .replace("if len(calls) % 2", "if len(calls) % 2 == 0")
    )
    result = project.run(runs=0)
    result.assert_outcomes(failed=1, skipped=1)
    assert labels(result) == "1 flaky"


OTHER_WORLD = "run in the file's world, not the test's: world.lanes is 4 in the file, 5 now"


def test_replay_says_that_the_test_names_another_world(saved):
    saved.run("-v", runs=0).stdout.no_fnmatch_line("*in the file's world*")
    saved.write(
        FAILS.replace("@pafot.search(", "@pafot.search(world=pafot.Highway(lanes=5, duration=10), ")
    )
    result = saved.run("-v", "--pafot-json=pafot.json", runs=0)
    result.assert_outcomes(failed=1, skipped=1)
    assert f"Result of the replay: still failing ({OTHER_WORLD}" in " ".join(
        result.stdout.str().split()
    )
    assert (
        json.loads((saved.path / "pafot.json").read_text())["findings"][0]["detail"] == OTHER_WORLD
    )
    saved.write(
        PASSES.replace(
            "@pafot.search(", "@pafot.search(world=pafot.Highway(lanes=5, duration=10), "
        )
    )
    result = saved.run(runs=0)
    assert OTHER_WORLD in " ".join(result.stdout.str().split())
    assert labels(result) == "1 passed"


def test_replay_says_that_the_test_names_other_traffic(saved):
    saved.write(FAILS.replace("@pafot.search(", "@pafot.search(traffic='everyday', "))
    shown = " ".join(saved.run(runs=0).stdout.str().split())
    named = "paper instead of everyday"
    assert f"still failing (run in the file's traffic, not the test's: {named}" in shown
    saved.write(FAILS.replace("@pafot.search(", "@pafot.search(traffic='paper', "))
    assert "in the file's traffic" not in saved.run(runs=0).stdout.str()


CHANCE = """
import os

SEEN = []

def sometimes():
    SEEN.append(1)
    brake = -3.0 if len(SEEN) > int(os.environ["PASSES"]) else 0.0
    return lambda observation: (brake, 0.0)

@pafot.search(SHORT, ads=sometimes)  # stop_after=1
def test_brakes(run):
    assert run.hardest_brake < 1
"""

FAILS_ALWAYS, PASSES_ALWAYS = "0", "1000"


@pytest.fixture
def by_chance(project, monkeypatch):
    """Save an accepted finding whose file says that it is flaky. Return a function that sets how many runs pass."""
    project.write(CHANCE)
    monkeypatch.setenv("PASSES", FAILS_ALWAYS)
    project.run()
    project.accept(until="2027-01-31")
    edited(project, "xfail: ", 'flaky: "another run"\nxfail: ')
    return lambda passes: monkeypatch.setenv("PASSES", passes)


@pytest.mark.parametrize("passes", [FAILS_ALWAYS, PASSES_ALWAYS, "1"])
def test_an_accepted_flaky_failure_never_fails_by_chance(project, by_chance, passes):
    by_chance(passes)
    accepted = project.run("--pafot-today=2027-01-31", "-rx", runs=0)
    accepted.assert_outcomes(xfailed=1, skipped=1)
    assert ("planner issue 12; flaky: it passed this time" in accepted.stdout.str()) == (
        passes == PASSES_ALWAYS
    )
    assert "Remove the line" not in accepted.stdout.str()
    over = project.run("--pafot-today=2027-02-01", runs=0)
    over.assert_outcomes(**{"passed" if passes == PASSES_ALWAYS else "failed": 1}, skipped=1)


def test_a_search_finds_no_accepted_flaky_failure_again(project, by_chance):
    before = project.contents
    by_chance("4")  # The replay passes, and later runs of the search fail in the same way.
    result = project.run("--pafot-today=2027-01-31", "test_it.py::test_brakes[search]", runs=8)
    result.assert_outcomes(passed=1)
    result.stdout.fnmatch_lines([f"  {project.only_id}: * (known)."])
    assert project.contents == before
    over = project.run("--pafot-today=2027-02-01", "test_it.py::test_brakes[search]", runs=8)
    assert over.ret == pytest.ExitCode.TESTS_FAILED


SIMULATOR = """
import math
import os
import pytest_pafot as pafot

class Toy(pafot.Simulator):
    hz = 15

    def start(self, vehicles, seed):
        self.cars, self.tick = [[each.x, each.y, each.heading, each.speed] for each in vehicles], 0

    def step(self, controls):
        self.tick += 1
        self.cars = [[each.x, each.y, each.heading, each.speed] for each in controls]
        if self.tick >= int(os.environ["JUMPS_AT"]):
            self.cars[1][0] += 49.0

    def states(self):
        return self.cars

@pafot.search(ads=lambda: lambda seen: (0.0, 0.0), world=pafot.SimulatorWorld(Toy), shrink_runs=0)
def test_drives(run):
    assert not run.collision
"""
"""A search in a simulator in which a vehicle jumps from a tick on."""


def test_replay_in_which_a_simulator_lets_a_vehicle_jump_fails_even_if_its_failure_is_accepted(
    project, monkeypatch
):
    project.pytester.makepyfile(test_it=SIMULATOR)
    monkeypatch.setenv("JUMPS_AT", "10000")
    project.run_once("--pafot-stop-after=1", runs=20)
    monkeypatch.setenv("JUMPS_AT", "20")
    told = [
        "the replay cannot show whether the policy drives well: Toy.states, tick 20: NPC 0 moved *"
    ]
    project.run(runs=0).stdout.fnmatch_lines(told)
    edited(project, "found: ", "xfail: {reason: known, until: 2999-12-31}\nfound: ")
    result = project.run(runs=0)
    result.assert_outcomes(failed=1, skipped=1)
    result.stdout.fnmatch_lines(told)
