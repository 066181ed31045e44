"""Replays that pass are driven on for ten seconds after the end of their file."""

import re
from dataclasses import replace

import pytest

import pytest_pafot as pafot
from pytest_pafot.corpus.writer import write
from pytest_pafot.execution.runner import LostRun, expectation
from pytest_pafot.findings.finding import Finding, Found
from pytest_pafot.findings.verdict import Failure
from pytest_pafot.oracle.run import Check
from pytest_pafot.support.process import installed_versions
from tests.plugin.conftest import labels

SCENARIO = pafot.Scenario(npcs=[[pafot.PositionInstruction(2, 5.0)]], gene_seconds=6.0)
"""An NPC slows down ahead. An ego that never brakes hits it after 5.6 s at 30 m/s, and after 6.5 s at 20 m/s, half a
second after the end."""
POLICIES = """
import os
import random
import pytest_pafot as pafot

def cruising(top):
    return lambda: lambda seen: (min(max(top - seen.ego.speed, -1.0), 1.0), 0.0)

fast, slow, slower = cruising(30.0), cruising(20.0), cruising(19.9)

def braking():
    return lambda seen: (-4.0 if seen.ego.speed > 4.0 else 0.0, 0.0)

def gentle():
    return lambda seen: (-3.9 if seen.ego.speed > 4.0 else 0.0, 0.0)

def late():  # leaves the NPC's lane, and speeds up after the end of the file
    return lambda seen: (-2.0 if seen.time < 7.0 else 2.0, 0.05 if 0.5 < seen.time < 1.0 else 0.0)

def raising():
    drive = braking()
    return lambda seen: drive(seen) if seen.time < 8.0 else 1 / 0

def nudging():  # brakes, and hits the NPC more than two seconds after the end of the file
    drive = braking()
    return lambda seen: drive(seen) if seen.time < 9.0 else (4.0, 0.0)

OWN = random.Random(1)

def dicing():  # accelerates by chance after the end of the file
    drive = braking()
    return lambda seen: drive(seen) if seen.time < 7.0 else (2.0 + OWN.random(), 0.0)

def dying():
    drive = braking()
    return lambda seen: drive(seen) if seen.time < 8.0 else os._exit(9)
"""
WORLD = "pafot.Highway(lanes=3)"
TEST = """
import policies

@pafot.search(world=WORLD, blame="ego", npcs=1)
def test_gap(run):
    assert not run.collision
"""


@pytest.fixture
def saved(project):
    """Return a project with a file of the scenario, in which the fast ego hit the NPC."""
    project.write(TEST.replace("WORLD", WORLD))
    return filed(project)


HIT = Failure(kind="AssertionError", assertion="assert not run.collision")


def filed(project, world=None, failure=HIT, expect=None):
    """Write the policies, and save a failure of the fast ego, by default its collision, in a file with a world."""
    project.pytester.makepyfile(policies=POLICIES)
    namespace = {}
    exec(POLICIES, namespace)
    run = pafot.Run(pafot.Highway(lanes=3).rollout(SCENARIO, namespace["fast"]))
    assert (round(run.collision.time, 1), run.attribution.fault) == (5.6, "leader-unanswered")
    finding = Finding.from_run(
        run,
        failure,
        test="test_it.py::test_gap",
        world=world or pafot.Highway(lanes=3).to_dict(),
        found=Found(seed=0, generation=0, algorithm="random", versions=dict(installed_versions())),
    )
    finding = finding if expect is None else replace(finding, expect=expect)
    path = project.path / "pafot_corpus" / "test_it" / "test_gap" / f"{finding.id}.pafot.yaml"
    path.parent.mkdir(parents=True, exist_ok=True)
    write(path, finding)
    return project


def replay(project, policy, *args, runs=0, before="", **options):
    project.pytester.makeconftest(
        f"import pytest\nimport policies\n{before}\n@pytest.fixture\ndef ads():\n    return policies.{policy}\n"
    )
    return project.run("--pafot-json=pafot.json", *args, runs=runs, **options)


def detail(project):
    """Return how the last replay of the only file differs from the file."""
    return project.record.findings[0].detail


def test_slower_ego_with_the_same_mistake_still_fails(saved):
    result = replay(saved, "slow")
    result.assert_outcomes(failed=1, skipped=1)
    assert labels(result) == "1 still failing"
    assert "6.5 s" in detail(saved)


def test_a_collision_at_another_time_still_fails_and_says_when(saved):
    text = saved.only_file.read_text()
    saved.only_file.write_text(re.sub(r"(outcome: collision, time: )[0-9.]+", r"\g<1>4.6", text))
    assert labels(replay(saved, "fast")) == "1 still failing"
    assert re.findall(r"[\d.]+", detail(saved)) == ["5.6", "4.6"]


ACCEPTS_LATER = TEST.replace("not run.collision", "not run.collision or run.collision.time > 6")
"""A test that accepts a collision after the end of the file, as if another party were responsible for it."""


@pytest.mark.parametrize("against", [(), ("--pafot-against=policies:fast",)], ids=["", "reference"])
@pytest.mark.parametrize(
    ("policy", "label"), [("slow", "drifted"), ("nudging", "passed"), ("braking", "passed")]
)
def test_a_pass_is_no_fix_if_the_same_npc_hits_the_ego_soon_after_the_end(
    saved, policy, label, against
):
    saved.write(ACCEPTS_LATER.replace("WORLD", WORLD))
    result = replay(saved, policy, *against)
    result.assert_outcomes(passed=1, skipped=1)
    assert labels(result) == f"1 {label}"
    assert ("policies:fast fails" in detail(saved)) == bool(against)
    assert ("NPC 0" in detail(saved)) == (label == "drifted")


def test_other_failure_after_the_end_is_only_reported(saved):
    result = replay(saved, "raising")
    result.assert_outcomes(passed=1, skipped=1)
    assert labels(result) == "1 passed"
    assert detail(saved).endswith("ads_error at 8.0 s")


DIED = "exit code 9"


def test_death_after_the_end_is_only_reported(saved):
    result = replay(saved, "dying", "--pafot-isolate")
    result.assert_outcomes(passed=1, skipped=1)
    assert (labels(result), DIED in detail(saved)) == ("1 passed", True)
    assert not list(saved.path.rglob("*.running"))


def test_death_after_the_end_ends_one_session_at_most(saved):
    assert replay(saved, "dying", apart=True).ret == 9
    for _ in range(3):
        result = replay(saved, "dying")
        result.assert_outcomes(passed=1, skipped=1)
        assert (labels(result), DIED in detail(saved)) == ("1 passed", True)
    assert len(saved.records) == 1
    replay(saved, "braking")
    assert (detail(saved), saved.records) == ("", [])


def test_reference_that_dies_after_the_end_does_so_once(saved):
    against = "--pafot-against=policies:dying"
    assert replay(saved, "braking", against, apart=True).ret == 9
    for _ in range(3):
        assert labels(replay(saved, "braking", against)) == "1 passed"


@pytest.mark.processes
def test_file_is_not_driven_on_after_death_without_fork(saved, monkeypatch):
    assert replay(saved, "dying", apart=True).ret == 9
    # here, and in sessions of its own
    monkeypatch.setattr("pytest_pafot.execution.runner.METHOD", "spawn")
    before = "import pytest_pafot.execution.runner as pool\npool.METHOD = 'spawn'\n"
    for _ in range(2):
        assert labels(replay(saved, "dying", before=before)) == "1 passed"
        assert detail(saved)


def test_death_after_the_end_of_a_crash_still_fails(project):
    project.write(TEST.replace("WORLD", WORLD))
    died = LostRun(SCENARIO, pid=1, how="ended with exit code 9")
    filed(project, expect=expectation(died))
    result = replay(project, "dying")
    result.assert_outcomes(failed=1, skipped=1)
    assert (labels(result), DIED in detail(project)) == ("1 still failing", True)


def test_failure_by_chance_after_the_end_is_flaky(saved):
    assert labels(replay(saved, "dicing")) == "1 flaky"


def test_pass_without_its_situation_is_driven_on_too(saved):
    path = saved.only_file
    # it was far faster than the NPC
    path.write_text(path.read_text().replace("ego_speed: ", "ego_speed: 9"))
    assert labels(replay(saved, "braking")) == "1 drifted"
    assert labels(replay(saved, "slow")) == "1 still failing"


def test_check_that_fails_after_the_end_still_fails(project):
    check = "run.ego.speed, name='speed', at_most=24.0"
    project.write(
        TEST.replace("WORLD", WORLD).replace("assert not run.collision", f"pafot.check({check})")
    )
    broken = Check(name="speed", value=30.0, margin=-0.25, at_most=24.0, time=5.6)
    failure = Failure(kind="CheckFailed", message=str(broken), assertion="speed", check=broken)
    filed(project, failure=failure)
    assert labels(replay(project, "late")) == "1 still failing"
    assert "speed failed at " in detail(project)
    assert labels(replay(project, "braking")) == "1 passed"


@pytest.mark.parametrize(
    "broken",
    [
        "pafot.check(way, name='way', at_most=100.0)",
        "assert run.ego.speed.sum() / run.trace.physics_hz < 100",
    ],
)
def test_value_that_grows_with_the_run_is_not_judged_later(project, broken):
    body = f"way = float(run.ego.speed.sum() / run.trace.physics_hz)\n    {broken}"
    project.write(TEST.replace("WORLD", WORLD).replace("assert not run.collision", body))
    measured = Check(name="way", value=167.0, margin=-0.67, at_most=100.0)
    failure = Failure(kind="AssertionError", assertion=broken)
    if "check" in broken:
        failure = Failure(
            kind="CheckFailed", message=str(measured), assertion="way", check=measured
        )
    filed(project, failure=failure)
    result = replay(project, "braking")
    assert labels(result) == "1 passed"
    assert detail(project) == ""
    replay(project, "slow").assert_outcomes(failed=1, skipped=1)


def test_error_of_the_test_after_the_end_is_named(saved):
    body = "missing = {}['lane'] if run.duration > 10.0 else None\n    assert not run.collision"
    saved.write(TEST.replace("WORLD", WORLD).replace("assert not run.collision", body))
    result = replay(saved, "braking")
    assert labels(result) == "1 passed"
    assert "KeyError: 'lane'" in detail(saved)


def test_accepted_failure_stays_accepted_with_a_slower_ego(saved):
    saved.accept()
    replay(saved, "slow").assert_outcomes(xfailed=1, skipped=1)


@pytest.mark.parametrize(("now", "before", "label", "reference"), [
    ("fast", "slow", "still failing", "fails"),
    ("slow", "slower", "still failing", "fails"),
    ("slow", "braking", "still failing", "passes"),
    ("braking", "slow", "passed", "fails"),
    ("braking", "gentle", "passed", "passes"),
    ("braking", "raising", "passed", "passes"),
])  # fmt: skip
def test_reference_is_driven_on_as_well(saved, now, before, label, reference):
    result = replay(saved, now, f"--pafot-against=policies:{before}")
    assert labels(result) == f"1 {label}"
    assert f"policies:{before} {reference}" in detail(saved)


def test_property_that_a_test_records_is_that_of_the_file(saved):
    body = "record_property('seconds', run.duration)\n    assert not run.collision"
    source = TEST.replace("WORLD", WORLD).replace("(run)", "(run, record_property)")
    saved.write(source.replace("assert not run.collision", body))
    replay(saved, "braking", "--junitxml=junit.xml", "-o", "junit_family=xunit1")
    text = (saved.path / "junit.xml").read_text()
    assert (text.count('name="seconds"'), 'name="seconds" value="6.0"' in text) == (1, True)
