"""Neighbours of a saved scenario that passes: what a replay says then, and ``corpus nearby``."""

import json
import re
import shlex
import subprocess
import sys
from argparse import Namespace

import pytest

import pytest_pafot as pafot
from pytest_pafot.commands.corpus_command import session_of
from pytest_pafot.corpus.writer import CorpusWriteError
from tests.plugin.test_driving_on import filed

POLICIES = """
import os
import pytest_pafot as pafot

def cruising(top):
    return lambda: lambda seen: (min(max(top - seen.ego.speed, -1.0), 1.0), 0.0)

fast = cruising(30.0)

def braking():
    return lambda seen: (-4.0 if seen.ego.speed > 4.0 else 0.0, 0.0)

def careful():
    def decide(seen):
        ahead = [other for other in seen.others if other.lane == seen.ego.lane and other.x > seen.ego.x]
        return (-7.0 if ahead else -4.0) if seen.ego.speed > 0.5 else 0.0, 0.0
    return decide

def dying():
    drive = careful()
    return lambda seen: os._exit(9) if abs(seen.ego.speed - 22.0) > 0.05 and seen.time < 0.1 else drive(seen)
"""
TEST = """
import policies

@pafot.search(world=pafot.Highway(lanes=3), blame="ego", npcs=1, ads=policies.POLICY)
def test_gap(run):
    assert not run.collision
"""


@pytest.fixture
def saved(project):
    """Return a project with a file of a scenario in which a fast ego hit an NPC that slows down ahead."""
    return fixed(project, "careful")


def fixed(project, policy, **more):
    project.write(TEST.replace("POLICY", policy))
    project.pytester.makepyfile(policies=POLICIES)
    filed(project, pafot.Highway(lanes=3).to_dict(), **more)
    project.pytester.makeini("[pytest]\n")
    return project


def replay(project, *args):
    """Return the result of a session that only replays, and the record of the saved scenario."""
    result = project.run("--pafot-json=out.json", *args, generations=0)
    (record,) = json.loads((project.path / "out.json").read_text())["findings"]
    return result, record


def test_a_replay_says_how_many_neighbours_pass_as_well(saved):
    result, record = replay(saved)
    result.assert_outcomes(passed=1, skipped=1)
    assert (record["status"], record["neighbours"]) == ("passes", 10)
    result.stdout.re_match_lines(
        [
            "replayed 1 saved scenario: 1 passes",
            r"  10 neighbours passed, in \d+\.\d s .*",
            "  passes, and so do 10 neighbours: .*",
        ]
    )


@pytest.mark.parametrize(("number", "neighbours"), [(0, 0), (3, 3)])
def test_the_number_is_an_option(saved, number, neighbours):
    _, record = replay(saved, f"--pafot-replay-neighbours={number}")
    assert (record["status"], record["neighbours"]) == ("passes", neighbours)


@pytest.mark.parametrize(("failing", "number"), [(40, 10), (3, 27), (0, 30)])
def test_a_narrow_failure_has_more_neighbours(saved, failing, number):
    file = saved.path / saved.files[0]
    file.write_text(file.read_text().replace("# xfail:", f"neighbours: {{failing: {failing}, of: 40}}\n# xfail:"))
    result, record = replay(saved)
    assert record["neighbours"] == number
    result.stdout.fnmatch_lines([f"  passes, and so do {number} neighbours: *"])
    assert replay(saved, "--pafot-replay-neighbours=4")[1]["neighbours"] == 4


def test_a_neighbour_that_fails_by_the_same_mistake_fails_the_replay(project):
    fixed(project, "braking")
    result, record = replay(project)
    result.assert_outcomes(failed=1, skipped=1)
    assert record["status"] == "still failing, nearby"
    assert record["kind"] == "leader-unanswered"
    scenario = pafot.load(project.path / project.files[0]).scenario
    assert record["scenario"] != json.loads(json.dumps(scenario.plain()))
    result.stdout.fnmatch_lines(
        [
            "replay: still failing, nearby, the saved scenario passes, but *",
            "the neighbour that fails:",
            "scenario:",
            "put it into the file with: python -m pytest_pafot corpus nearby --write *.pafot.yaml",
            "replayed 1 saved scenario: 1 still failing, nearby",
        ]
    )
    off, record = replay(project, "--pafot-replay-neighbours=0")
    off.assert_outcomes(passed=1, skipped=1)
    assert record["status"] == "passes"


@pytest.mark.processes
def test_the_replay_is_the_same_in_a_worker(project):
    fixed(project, "braking")
    assert replay(project)[1] == replay(project, "-n1")[1]


def test_its_failure_may_be_accepted_as_any_other(project):
    fixed(project, "braking")
    file = project.path / project.files[0]
    file.write_text(file.read_text().replace('# xfail: "reason"', 'xfail: "issue 12"'))
    result, record = replay(project)
    result.assert_outcomes(xfailed=1, skipped=1)
    assert record["status"] == "still failing, nearby"


def test_the_search_covers_what_only_a_neighbour_shows(project):
    fixed(project, "braking")
    result = project.run("--pafot-json=out.json", "--pafot-runs=30", generations=None, seed=1)
    record = json.loads((project.path / "out.json").read_text())
    assert [each["kind"] for each in record["findings"] if each["status"] == "new"].count("leader-unanswered") == 0
    assert result.ret == pytest.ExitCode.TESTS_FAILED


@pytest.mark.parametrize("write", [False, True])
def test_the_command_puts_the_neighbour_into_the_file(project, write):
    fixed(project, "braking")
    file = project.path / project.files[0]
    label = "neighbours: {failing: 3, of: 40}\n"  # of the scenario that the neighbour replaces
    before = file.read_text().replace("# xfail:", f"{label}# xfail:")
    file.write_text(before)
    command = session_of(Namespace(what="nearby", write=write, arguments=[]))
    result = project.run(*command[3:], generations=None)
    assert result.ret == 0
    name = file.relative_to(project.path).as_posix()
    result.stdout.fnmatch_lines([f"{'replaced' if write else 'would replace'}: {name}"])
    assert (file.read_text() != before) == write
    assert (label in file.read_text()) == (not write)
    _, record = replay(project)
    assert record["status"] == ("still failing" if write else "still failing, nearby")


def test_the_command_leaves_a_fix_that_holds_alone(saved):
    before = saved.contents
    result = saved.run(*session_of(Namespace(what="nearby", write=True, arguments=[]))[3:], generations=None)
    assert result.ret == 0
    result.stdout.no_fnmatch_line("*replace*")
    assert saved.contents == before


def test_with_a_reference_only_a_neighbour_that_it_passes_counts(project):
    fixed(project, "braking")
    project.write(TEST.replace("policies.POLICY", "policies.braking, against=policies.careful"))
    assert replay(project)[1]["status"] == "still failing, nearby"
    project.write(TEST.replace("policies.POLICY", "policies.braking, against=lambda: policies.braking()"))
    result, record = replay(project)
    assert record["status"] == "fixed before"
    result.assert_outcomes(passed=1, skipped=1)


def test_an_ego_of_another_speed_is_told_in_the_file_and_re_timed_for(saved):
    expect = pafot.load(saved.path / saved.files[0]).expect
    assert 20.0 < expect.ego_mean_speed < 30.0


@pytest.mark.processes
def test_a_death_in_a_neighbour_is_only_reported(project):
    fixed(project, "dying")
    result, record = replay(project, "--pafot-isolate")
    assert record["status"] == "passes"
    assert "in a neighbour, the process ended with exit code 9" in record["detail"]
    result.assert_outcomes(passed=1, skipped=1)


@pytest.mark.processes
@pytest.mark.parametrize("given", [[], ["--pafot-corpus=other", "--pafot-replay-neighbours=20"]], ids=["", "options"])
def test_the_command_that_a_replay_names_puts_the_neighbour_into_the_file(project, given):
    fixed(project, "braking")
    if given:
        (project.path / "pafot_corpus").rename(project.path / "other")
    result, _ = replay(project, *given)
    (told,) = re.findall(r"put it into the file with: python (.*)", result.stdout.str())
    done = subprocess.run(
        [sys.executable, *shlex.split(told)], cwd=project.path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"replaced: {project.files[0]}" in done.stdout
    assert replay(project, *given)[1]["status"] == "still failing"


def test_a_file_that_cannot_be_written_stays_and_is_named(project, monkeypatch):
    fixed(project, "braking")
    before = project.contents

    def refuse(path, finding):
        raise CorpusWriteError(path, "Read-only file system", "mount it")

    monkeypatch.setattr("pytest_pafot.plugin.nearing.rewrite", refuse)
    result = project.run(*session_of(Namespace(what="nearby", write=True, arguments=[]))[3:], generations=None)
    assert result.ret == 1
    result.stdout.fnmatch_lines(["*problem: not replaced: *Read-only file system*"])
    assert project.contents == before
