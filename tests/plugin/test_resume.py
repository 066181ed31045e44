"""The option --pafot-resume: sessions of one long search."""

import json
import os
import sys

import pytest

from pytest_pafot.campaign import state_file

SOURCE = """
@pafot.search(SHORT, shrink_rollouts=10, ads=lambda: lambda observation: (0.0, 0.0))
def test_it(run):
    assert not run.collision
"""

ALWAYS = SOURCE.replace("not run.collision", "run.duration < 1")
"""A test that fails for every run in the same way, so that its search has one finding."""

ONLY, OTHER = "test_it.py::test_it[search]", "test_it.py::test_other[search]"

KILLED = """
import os, signal
import pytest_pafot as pafot

SEEN = []

def ads():
    def drive(observation):
        SEEN.append(observation)
        if len(SEEN) == int(os.environ.get("KILL_AT", -1)):
            os.kill(os.getpid(), signal.SIGKILL)
        return 0.0, 0.0
    return drive

@pafot.search(SHORT, shrink_rollouts=10, ads=ads)
def test_it(run):
    assert not run.collision
"""


def night(project, *args, runs, **options):
    return project.run("--pafot-resume=states", f"--pafot-runs={runs}", *args, generations=None, **options)


def forget(project):
    found = project.contents
    project.forget()
    for path in project.path.glob("states/*"):
        path.unlink()
    return found


def test_four_resumed_sessions_equal_one_long_session(project):
    project.write(SOURCE)
    project.run("--pafot-runs=16", generations=None)
    whole = forget(project)
    assert whole
    for _ in range(4):
        result = night(project, runs=4)
    assert project.contents == whole
    result.stdout.fnmatch_lines(["*resumed after 12 runs of earlier sessions*"])
    (state,) = project.path.glob("states/*.json")
    assert state.name.startswith("test_it.py.test_it~")


def test_resumed_session_without_new_finding_passes(project):
    project.write(ALWAYS)
    first = night(project, runs=4)
    first.assert_outcomes(failed=1 + len(project.files))
    again = night(project, ONLY, runs=1)
    again.assert_outcomes(passed=1)


def test_unsaved_finding_fails_every_session_and_is_saved_later(project):
    project.write(ALWAYS)
    for runs in (10, 1):
        session = night(project, "--pafot-save=none", runs=runs)
        assert session.ret == 1
        session.stdout.fnmatch_lines(["*1 new finding*", "*not saved: --pafot-save=none"])
    assert not project.contents
    night(project, runs=1).stdout.fnmatch_lines(["*1 new finding, saved in*"])
    assert project.contents


def test_resumed_base_seed_stays_the_same_unless_given(project):
    project.write(SOURCE)
    for _ in range(2):
        night(project, ONLY, runs=1, seed=None).stdout.fnmatch_lines(["*base seed 0*"])
    refused = night(project, ONLY, runs=1, seed=4)
    refused.assert_outcomes(failed=1)
    refused.stdout.fnmatch_lines(["*seed 0 in the file, 4 now*"])


def test_invalid_state_fails_only_its_own_search(project):
    project.write(ALWAYS + ALWAYS.replace("test_it", "test_other"))
    night(project, ONLY, OTHER, runs=4)
    (state,) = project.path.glob("states/*test_it~*")
    state.write_text("{")
    result = night(project, ONLY, OTHER, "-v", runs=4)
    result.assert_outcomes(failed=1, passed=1)
    result.stdout.fnmatch_lines([f"*{state.name}: expected the JSON of a search's state*delete the file*"])
    assert state.read_text() == "{"


def test_replaying_session_does_not_change_the_state(project):
    project.write(SOURCE)
    night(project, runs=4)
    (state,) = project.path.glob("states/*")
    before = state.read_bytes()
    project.run("--pafot-resume=states", generations=0)
    assert state.read_bytes() == before


@pytest.mark.processes
def test_workers_resume_each_search_with_same_files(project):
    project.write(SOURCE + SOURCE.replace("test_it", "test_other"))
    project.run("--pafot-runs=24", generations=None)
    whole = forget(project)
    for _ in range(2):
        night(project, "-n2", runs=12)
    assert project.contents == whole
    assert len(list(project.path.glob("states/*.json"))) == 2


@pytest.mark.processes
@pytest.mark.skipif(sys.platform == "win32", reason="there is no SIGKILL")
@pytest.mark.parametrize("kill_at", [3, 300, 900])
def test_killed_session_resumes_and_leaves_the_same_files(project, monkeypatch, kill_at):
    project.write(KILLED)
    project.run_once("--pafot-runs=24", generations=None)
    whole = forget(project)
    assert whole
    monkeypatch.setenv("KILL_AT", str(kill_at))
    assert night(project, runs=24, apart=True).ret == -9
    (state,) = project.path.glob("states/*.json")
    monkeypatch.delenv("KILL_AT")
    done = simulated(state)
    night(project, runs=24 - done)
    assert simulated(state) == 24
    assert project.contents == whole
    assert os.listdir(project.path / "states") == [state.name]  # noqa: PTH208


@pytest.mark.processes
@pytest.mark.skipif(sys.platform == "win32", reason="there is no SIGKILL")
def test_killed_shrinking_goes_on_and_leaves_the_same_files(project, monkeypatch):
    project.write(KILLED.replace("shrink_rollouts=10", "shrink_rollouts=60"))
    project.run("--pafot-runs=9", generations=None)
    whole = forget(project)
    assert whole
    monkeypatch.setattr(state_file, "SHARE", 0)  # these runs are so fast that not each answer is stored
    monkeypatch.setenv("KILL_AT", "800")  # each run takes some 50 decisions, so this is while a finding is shrunk
    assert night(project, runs=8, apart=True).ret == -9
    (state,) = project.path.glob("states/*.json")
    _, _, finds, *_ = json.loads(state.read_text())["counts"]
    assert any(len(answers) > 3 for *_, answers in finds)
    monkeypatch.delenv("KILL_AT")
    night(project, runs=1)
    assert simulated(state) == 9
    assert project.contents == whole


OUTER = """
import os, subprocess, sys
import pytest_pafot as pafot

def ads():
    def drive(observation):
        if os.environ.pop("OUTER", ""):
            options = ["-p", "pafot", "--pafot-resume=states", "--pafot-runs=4", "--pafot-seed=1"]
            inner = subprocess.run([sys.executable, "-m", "pytest", *options], capture_output=True, text=True)
            with open("inner.txt", "w") as file:
                file.write(inner.stdout)
        return 0.0, 0.0
    return drive

@pafot.search(SHORT, shrink_rollouts=10, ads=ads)
def test_it(run):
    assert run.duration > 1
"""


@pytest.mark.processes
def test_second_session_with_the_same_state_is_refused(project, monkeypatch):
    project.write(OUTER)
    monkeypatch.setenv("OUTER", "1")
    night(project, runs=8, apart=True).assert_outcomes(passed=1)
    (state,) = project.path.glob("states/*")
    told = (project.path / "inner.txt").read_text()
    assert f"{state.name}: expected a search that no other session runs now, received one that is running" in told
    assert "wait until that session has ended, or give another folder with --pafot-resume" in told
    assert simulated(state) == 8


def simulated(state):
    """Return the number of runs in a state."""
    return json.loads(state.read_text())["sums"][3]
