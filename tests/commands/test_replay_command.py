"""The command `python -m pytest_pafot replay`: a saved file that came by mail, with no project around it."""

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pytest_pafot.__main__ import main
from tests.helpers.processes import begun
from tests.helpers.sessions import Copy, command_in_a_copy

SAVED = Path(__file__).parents[1] / "corpus/saved"
POLICIES = """\
import time
from pathlib import Path

import pytest_pafot as pafot


class Idle:
    def __call__(self, observation):
        return 0.0, 0.0


class Stopping:
    def __call__(self, observation):
        return -5.0, 0.0


class Sleeping:
    def __call__(self, observation):
        Path("driving").touch()
        time.sleep(10.0)
        return 0.0, 0.0


def steers():
    return lambda observation: 1


def keeps_a_gap(run):
    assert run.min_ttc > 40.0
"""
ACCEPTED = "collision-xfail.pafot.yaml"
"""The file of a collision that others have accepted."""


@pytest.fixture
def here(tmp_path, monkeypatch):
    (tmp_path / "policies.py").write_text(POLICIES)
    for path in SAVED.glob("*.pafot.yaml"):
        shutil.copy(path, tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(subprocess, "Popen", Copy)
    return tmp_path


@pytest.mark.processes
@pytest.mark.parametrize(("arguments", "code", "told"), [
    ([ACCEPTED, "--ads", "policies:Idle"], 1, "1 still failing"),
    ([ACCEPTED, "--ads", "policies:Stopping"], 0, "1 passed"),
    (["gym-roundabout", "--ads", "policies:steers"], 1, "1 failed"),
    (["gym-roundabout.pafot.yaml", "--ads", "policies:steers", "--world=roundabout-v0"], 1, "1 failed"),
    (["property-of-a-class-with-parameters", "--ads", "policies:Idle", "--check", "policies:keeps_a_gap"], 1, "1 fa"),
    (["crash", "--ads", "policies:Stopping", "--report=page.html", "--", "--pafot-today=2027-01-31"], 0, "page.html ("),
])  # fmt: skip
def test_a_saved_file_is_replayed_without_its_project(here, arguments, code, told):
    before = {*here.rglob("*")}
    done = command_in_a_copy("pytest_pafot", "replay", *arguments)
    assert (done.code, told in done.out) == (code, True), done.out + done.err
    name = arguments[0].removesuffix(".pafot.yaml")
    assert re.match(rf"{name}\.pafot\.yaml: .* 0\.1\.0\. .* policies:\w+\n", done.out)
    new = {path.relative_to(here).parts[0] for path in {*here.rglob("*")} - before}
    assert new <= {"__pycache__", "page.html"}


@pytest.mark.parametrize("arguments", [
    [ACCEPTED], [ACCEPTED, "--ads", "policies:Idel"], ["flaky", "--ads", "policies:Idle"],
    ["nobody", "--ads", "policies:Idle"],
])  # fmt: skip
def test_what_cannot_be_replayed_has_the_exit_code_of_wrong_use(here, capsys, arguments):
    assert main(["replay", *arguments]) == 4
    assert capsys.readouterr().err.startswith("replay: ")


def test_a_wrong_option_of_a_replay_is_told_with_its_usage(capsys):
    with pytest.raises(SystemExit, match="4"):
        main(["replay", ACCEPTED, "--adz", "policies:Idle"])
    assert capsys.readouterr().err.startswith("usage: python -m pytest_pafot replay ")


@pytest.mark.processes
@pytest.mark.skipif(os.name == "nt", reason="a group of processes has no signals there")
def test_an_interrupted_replay_ends_without_traceback(here):
    words = ["-m", "pytest_pafot", "replay", ACCEPTED, "--ads", "policies:Sleeping"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
    with begun([sys.executable, *words], **quiet) as replay:
        deadline = time.monotonic() + 60.0
        while not (here / "driving").exists() and time.monotonic() < deadline:
            time.sleep(0.1)
        os.killpg(replay.pid, signal.SIGINT)
        error = replay.communicate(timeout=60)[1]
    assert (replay.returncode, error) == (130, "\nreplay: interrupted\n")
