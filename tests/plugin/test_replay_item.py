"""Replays: labels, drift, xfail, and when a failure is new again."""

import re

import pytest

from tests.plugin.conftest import CONFTEST, labels

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
    assert "PASSED (passes" in result.stdout.str()
    assert labels(result) == "1 passed"
    assert saved.contents == before


@pytest.mark.parametrize("is_accepted", [False, True])
def test_a_search_counts_a_known_failure_and_passes(saved, is_accepted):
    if is_accepted:
        saved.accept()
    before = saved.contents
    result = saved.run(runs=20)
    result.assert_outcomes(passed=1, **{"xfailed" if is_accepted else "failed": 1})
    result.stdout.fnmatch_lines([f"  {saved.only_id}: * (known)."])
    assert (result.ret == 0) == is_accepted
    assert saved.contents == before


def test_accepted_file_that_passes_fails_until_line_removed(saved):
    saved.accept()
    saved.write(PASSES)
    result = saved.run(runs=0)
    result.assert_outcomes(failed=1, skipped=1)
    result.stdout.fnmatch_lines(["*XPASS(strict)*", f"*`xfail:` from {saved.files[0]}"])


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


def test_expired_xfail_that_passes_is_only_a_warning(saved):
    saved.accept(until="2027-01-31")
    saved.write(PASSES)
    saved.run("--pafot-today=2027-01-31", runs=0).assert_outcomes(failed=1, skipped=1)
    result = saved.run("--pafot-today=2027-02-01", "--pafot-json=pafot.json", runs=0)
    result.assert_outcomes(passed=1, skipped=1)
    assert ["2027-01-31" in each for each in saved.record.warnings] == [True]


def test_last_xfail_day_is_compared_with_the_calendar(saved):
    saved.accept()
    saved.run(runs=0).assert_outcomes(xfailed=1, skipped=1)
    edited(saved, "9999-12-31", "2026-01-01")
    saved.run(runs=0).assert_outcomes(failed=1, skipped=1)


def test_passing_replay_under_other_versions_has_drifted(saved):
    edited(saved, "highway-env: ", "highway-env: 0.")
    saved.write(PASSES)
    result = saved.run("-v", "--pafot-json=pafot.json", runs=0)
    result.assert_outcomes(passed=1, skipped=1)
    assert "PASSED (drifted)" in result.stdout.str()
    assert labels(result) == "1 drifted"
    assert saved.record.findings[0].detail.startswith("highway-env ")
    saved.run("--pafot-strict-drift", runs=0).assert_outcomes(failed=1, skipped=1)


def test_replay_without_incident_reports_how_long_it_lasted(project):
    project.write(
        "@pafot.search(SHORT)  # stop_after=1\ndef test_drive(run):\n    assert not run.collision\n"
    )
    project.run_once("--pafot-shrink-runs=0", runs=20)
    project.pytester.makeconftest(BRAKING)
    edited(project, "highway-env: ", "highway-env: 0.")
    project.run("--pafot-json=pafot.json", runs=0)
    assert "safe for 10.0 s " in project.record.findings[0].detail


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
    written = ["--junitxml=junit.xml", "--pafot-report=page.html", "--pafot-json=pafot.json"]
    result = project.run(*written, "--pafot-against=before:make", runs=0)
    result.assert_outcomes(passed=1, skipped=1)
    assert labels(result) == "1 drifted"
    result.stdout.fnmatch_lines(["* 0 fixed, 0 unchanged"])
    missed = project.record.findings[0].detail.partition(";")[0].replace("'", "")
    for name in ("junit.xml", "page.html"):
        assert missed[:40] in (project.path / name).read_text(), name
    project.run("--pafot-strict-drift", runs=0).assert_outcomes(failed=1, skipped=1)


def test_uneventful_runs_are_compared_by_most_critical_moment(project):
    project.write(
        "@pafot.search(SHORT)  # stop_after=1\ndef test_drive(run):\n    assert run.collision\n"
    )
    project.run_once("--pafot-shrink-runs=0")
    head, _, tail = project.only_file.read_text().partition("time: ")
    project.only_file.write_text(f"{head}time: 99.5,{tail.partition(',')[2]}")
    project.run("--pafot-json=pafot.json", runs=0)
    (found,) = project.record.findings
    assert (found.status, found.detail.endswith(" 99.5 s")) == ("drifted", True)


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
    result = saved.run("--pafot-json=pafot.json", runs=0)
    result.assert_outcomes(passed=1, skipped=1)
    assert labels(result) == "1 drifted"
    assert "world.duration" in saved.record.findings[0].detail


def test_invalid_world_or_scenario_fails_item_with_line(saved):
    edits = [
        ("lanes: 4", "lanes: 40", "15: world.lanes: "),
        ("overspeed: 1.1", "overspeed: 2.0", "15: world.speed_limit: "),
        ("lane: 1, speed", "lane: 9, speed", "4: scenario.ego.lane: "),
        ("cell: rear, speed: 0.0", "cell: rear, speed: 99.0", "7: scenario.npcs.NPC 0[0].speed: "),
        ("gene_seconds: 5.0", "gene_seconds: 5.01", "5: scenario.gene_seconds: "),
    ]
    file, text = saved.only_file, saved.only_file.read_text()
    for number, (old, new, _) in enumerate(edits):
        assert old in text
        file.with_name(f"copy-{number}.pafot.yaml").write_text(text.replace(old, new))
    file.unlink()
    result = saved.run("--pafot-json=pafot.json", runs=0)
    result.assert_outcomes(failed=len(edits), skipped=1)
    for number, ((*_, place), found) in enumerate(zip(edits, saved.record.findings, strict=True)):
        assert f"copy-{number}.pafot.yaml:{place}" in found.detail


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
    project.run()
    file = project.only_file
    assert "\nflaky: " in file.read_text()
    file.write_text(re.sub(r"(?m)^rate: .*\n", "", file.read_text()))
    project.write(
        (project.path / "test_it.py")
        .read_text()
        .replace("if len(calls) % 2", "if len(calls) % 2 == 0")
    )
    result = project.run(runs=0)
    result.assert_outcomes(failed=1, skipped=1)
    assert labels(result) == "1 flaky"


def test_replay_says_that_the_test_names_another_world_or_traffic(saved):
    def detail(arguments, source):
        saved.write(source.replace("@pafot.search(", f"@pafot.search({arguments}"))
        saved.run("--pafot-json=pafot.json", runs=0)
        return saved.record.findings[0].detail

    assert detail("", FAILS) == ""
    assert detail("traffic='paper', ", FAILS) == ""
    other = detail("world=pafot.Highway(lanes=5, duration=10), ", FAILS)
    assert "world.lanes is 4 in the file, 5 now" in other
    assert detail("world=pafot.Highway(lanes=5, duration=10), ", PASSES) == other
    assert "paper instead of everyday" in detail("traffic='everyday', ", FAILS)


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
    assert ("12; flaky: " in accepted.stdout.str()) == (passes == PASSES_ALWAYS)
    assert "`xfail:`" not in accepted.stdout.str()
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
    edited(project, "found: ", "xfail: {reason: known, until: 2999-12-31}\nfound: ")
    result = project.run(runs=0)
    result.assert_outcomes(failed=1, skipped=1)
    result.stdout.fnmatch_lines(["*Toy.states, tick 20: *"])
