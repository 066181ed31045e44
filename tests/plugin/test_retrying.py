"""A scenario in flight when a process died runs again before its ADS is blamed."""

import signal
import sys
import time

import pytest

from pytest_pafot.corpus.reader import load
from pytest_pafot.execution.crash_records import CrashRecord
from pytest_pafot.execution.runner import Apart, in_gym
from pytest_pafot.world import Highway

forks = pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")

OWNER = "test_it.py::test_it"
TEST = "@pafot.search(SHORT, ads=ADS)\ndef test_it(run):\n    pass\n"
INNOCENT = "*note: *(pid *) *<Scenario *>, but *"

ELSEWHERE = """
import os
import signal
import time

SESSION = os.getpid()

def is_elsewhere():
    return os.getpid() != SESSION

def planner(act):
    def drive(observation):
        if is_elsewhere():
            act(observation)
        return 0.0, 0.0
    return lambda: drive
"""


def write(project, act, test=TEST):
    """Write a test whose ADS acts in every process except the session's."""
    project.write(ELSEWHERE + test.replace("ADS", f"planner(lambda observation: {act})"))


def replayed(project):
    """Run a session that searches for nothing new; return its lines, not wrapped."""
    result = project.run(runs=0)
    text = result.stdout.str().replace("\n    ", " ")
    result.stdout.lines[:] = text.splitlines()
    return result


def left_in_the_end(project, count):
    """Return whether this many records remain after the processes of a dead session have ended."""
    until = time.monotonic() + 30
    while len(project.records) != count and time.monotonic() < until:
        time.sleep(0.01)
    return len(project.records) == count


@forks
def test_retried_scenario_that_completes_is_reported_but_unsaved(project):
    write(project, "None")
    project.leave_behind(OWNER)
    result = replayed(project)
    result.assert_outcomes(passed=1)
    result.stdout.fnmatch_lines([INNOCENT])
    assert (project.files, project.records) == ([], [])
    assert "died" not in replayed(project).stdout.str()


@forks
@pytest.mark.processes
def test_session_killed_while_the_scenario_runs_again_is_no_finding(project):
    killed_once = """
import pathlib

def killed_once():
    if not pathlib.Path("killed").exists():
        pathlib.Path("killed").touch()
        for process in (SESSION, os.getpid()):
            os.kill(process, signal.SIGKILL)
"""
    write(project, "killed_once()", killed_once + TEST)
    project.leave_behind(OWNER)
    assert project.run(apart=True).ret == -signal.SIGKILL
    assert left_in_the_end(project, 2), (
        "of the session before and of the process that ran its scenario again"
    )
    replayed(project).stdout.fnmatch_lines([INNOCENT])
    assert (project.files, project.records) == ([], [])


@forks
@pytest.mark.usefixtures("in_highway_env")
def test_no_record_of_the_session_stands_while_another_process_drives_in_highway_env(
    project, monkeypatch, in_highway_env
):
    standing, seen = [], []
    monkeypatch.setattr(CrashRecord, "write", lambda self, *scenarios, **_: standing.append(self))
    monkeypatch.setattr(CrashRecord, "clear", lambda _: standing.clear())
    fetched = Apart._fetched

    def fetch(self, task):
        seen.extend([len(standing)] * (getattr(task, "simulate", None) is in_gym))
        return fetched(self, task)

    monkeypatch.setattr(Apart, "_fetched", fetch)
    write(project, "None", TEST.replace("pass", "assert not run.collision"))
    project.run("--pafot-isolate", runs=12)
    assert seen
    assert not any(seen)


@forks
@pytest.mark.processes
def test_repeated_death_of_sessions_becomes_a_finding(project):
    builds_up = """
RUNS = []

@pafot.search(SHORT, ads=ADS)
def test_it(run, tmp_path):  # with a fixture, the session judges all runs
    RUNS.append(run)
    if not is_elsewhere() and len(RUNS) == 3:
        os._exit(9)
"""
    write(project, "None", builds_up)
    for _ in range(2):
        assert project.run(apart=True, runs=20).ret == 9
    assert project.files == []
    assert left_in_the_end(project, 2), "of both sessions"
    replayed(project)
    assert project.only_id.startswith("crash-")
    assert project.records == []


@forks
@pytest.mark.parametrize("end", ["os._exit(9)", "os.kill(os.getpid(), signal.SIGKILL)"])
def test_scenario_that_kills_again_records_exit_status(project, end):
    write(project, end)
    project.leave_behind(OWNER)
    result = replayed(project)
    result.assert_outcomes(failed=2)
    how = "exit code 9" if "exit" in end else "SIGKILL"
    finding = load(project.only_file)
    assert finding.id.startswith("crash-")
    assert finding.expect.message.endswith(how)
    assert project.records == []


@pytest.mark.parametrize(("act", "world"), [
    ("1 / 0", None), ("time.sleep(60)", Highway(duration=10.0, hang_limit=0.1).to_dict()),
], ids=["the ADS raises there", "it hangs there"])  # fmt: skip
def test_inconclusive_retry_does_not_excuse_the_scenario(project, act, world):
    write(project, act)
    project.leave_behind(OWNER, world=world)
    replayed(project)
    assert project.only_id.startswith("crash-")


def test_record_with_impossible_world_is_reported_only(project):
    write(project, "None")
    project.leave_behind(OWNER, world={"kind": "mine"})
    result = replayed(project)
    result.assert_outcomes(passed=1)
    result.stdout.fnmatch_lines(["*note: *(pid *)*"])
    assert (project.files, project.records) == ([], [])


@forks
def test_retry_uses_the_world_of_the_record(project):
    write(project, "os._exit(9) if observation.time > 6 else None")
    project.leave_behind(OWNER, world=Highway(duration=5.0).to_dict())
    replayed(project).stdout.fnmatch_lines([INNOCENT])
    project.leave_behind(OWNER, world=Highway(duration=10.0).to_dict())
    replayed(project)
    assert load(project.only_file).id.startswith("crash-")
