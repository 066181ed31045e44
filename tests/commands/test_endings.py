"""Commands that a signal ends leave no process and no temporary folder behind."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.helpers.processes import begun
from tests.helpers.sessions import INTERRUPTIBLE

pytestmark = [
    pytest.mark.processes,
    pytest.mark.skipif(
        not Path("/proc/self/environ").exists(), reason="processes are found by their variables"
    ),
]

SLOW = """
import time


def make():
    def drive(observation):
        time.sleep(0.01)
        return 0.0, 0.0

    return drive


def other():
    return lambda observation: (time.sleep(0.01), (1.0, 0.0))[1]
"""
SEARCH = ["search", "slow:make", "--runs", "100000", "--", "--pafot-workers=2"]


def processes_with(mark):
    """Return the ids of the processes that have a variable of the environment and have not ended."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if mark in (folder / "environ").read_bytes().split(b"\0"):
                found.append(int(folder.name))
        except OSError:
            continue  # it ended, or is of a different user
    return found


HANDLED = """
import os, signal, sys

signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in a shell's background job
"""
STARTING = f"""{HANDLED}
if "PYTEST_PAFOT_DRIVES" in os.environ:
    os.kill(os.getpid(), signal.SIGINT)
"""
IMPORTING = f"""{HANDLED}
class Interrupted:
    def find_spec(self, name, *_):
        if name == "MODULE":
            os.kill(os.getpid(), signal.NAME)

sys.meta_path.insert(0, Interrupted())
"""


@pytest.mark.parametrize(("starts", "module", "name", "command"), [
    (IMPORTING, "pytest_pafot.commands.corpus_command", "SIGTERM", ["corpus", "list"]),
    (IMPORTING, "pytest_pafot.support.process", "SIGINT", ["corpus", "list"]),
    (IMPORTING, "pytest_pafot.support.process", "SIGINT", ["search", "slow:make"]),
    (STARTING, "", "SIGINT", ["search", "slow:make"]),  # in the process that drives
])  # fmt: skip
def test_signal_while_a_command_starts_is_told_without_traceback(
    tmp_path, starts, module, name, command
):
    (tmp_path / "sitecustomize.py").write_text(
        starts.replace("MODULE", module).replace("NAME", name)
    )
    environ = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}
    started = [sys.executable, "-m", "pytest_pafot", *command]
    given = {"cwd": tmp_path, "env": environ, "timeout": 60}
    ended = subprocess.run(started, capture_output=True, text=True, check=False, **given)
    expected = 128 + getattr(signal, name), f"{command[0]}: interrupted"
    assert (ended.returncode, ended.stderr.strip()) == expected


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])  # SIGHUP ends the command of an extra
def test_search_ends_all_that_it_began(tmp_path, tmp_path_factory, name):
    check_that_all_ends(tmp_path, tmp_path_factory.mktemp("places"), SEARCH, name)


def check_that_all_ends(folder, places, words, name):
    """Send a signal to a command; nothing is left of its processes, and in its folder for temporary files."""
    (folder / "slow.py").write_text(SLOW)
    own = {
        "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
        "PYTEST_PLUGINS": "pytest_pafot.plugin",
        "TMPDIR": str(places),
    }
    environ, number = {**os.environ, **own}, getattr(signal, name)
    command = [*INTERRUPTIBLE, *words]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with begun(command, cwd=folder, env=environ, **quiet) as process:
        mark, deadline = f"TMPDIR={places}".encode(), time.monotonic() + 60.0
        # Counted once: a process that is just starting its program has no variables for a moment.
        while (count := len(processes_with(mark))) < 3 and time.monotonic() < deadline:
            time.sleep(0.1)
        assert count >= 3
        os.killpg(process.pid, number) if number == signal.SIGINT else process.send_signal(number)
        process.wait(60)
    assert process.returncode == 128 + number
    deadline = time.monotonic() + 60.0
    # what is killed takes a moment to go
    while processes_with(mark) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert processes_with(mark) == []
    assert [each.name for each in places.iterdir() if not each.name.startswith("pytest-")] == []
