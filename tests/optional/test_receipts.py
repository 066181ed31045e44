"""A command ends with 0 only if it came to its end, whatever the policy does; a signal ends all of it."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.commands.test_endings import check_that_all_ends
from tests.commands.test_receipt import ENDINGS, check_ending, ended
from tests.helpers.sessions import Copy, command_in_a_copy

pytestmark = pytest.mark.processes

COMMANDS = {
    "rate": "rate --ads planner:make@planner --world highway-fast-v0 --episodes 8 --workers 1 --fail-above 60%",
    "compare": "compare --ads planner:make --algorithms random --runs 1 --seconds 20 --workers 1 --out out",
}
LONG = {
    "compare": "compare --ads slow:make --algorithms random --runs 4 --out out --workers=2",
    "rate": "rate --ads slow:make@planner --world highway-fast-v0 --workers=2",
}


# The commands have the parent in common, which the search is tested with in every way. What is their own is where they
# call the policy, and whether they let an exception of it through.
EACH = [
    *((place, "sys.exit(0)") for place in ENDINGS),
    ("IN_DECISION", "os._exit(0)"),
    ("ON_IMPORT", "os._exit(0)"),
]


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(("place", "how"), EACH)
def test_a_policy_that_ends_its_process_is_no_success(tmp_path, command, place, how):
    check_ending(tmp_path, COMMANDS[command], place, how)


@pytest.mark.skipif(
    not Path("/proc/self/environ").exists(), reason="processes are found by their variables"
)
@pytest.mark.parametrize(("command", "name"), [("compare", "SIGINT"), ("rate", "SIGTERM")])
def test_command_ends_all_that_it_began(tmp_path, tmp_path_factory, command, name):
    check_that_all_ends(tmp_path, tmp_path_factory.mktemp("places"), LONG[command].split(), name)


def test_commands_that_come_to_their_end_keep_their_codes(tmp_path):
    assert {command: ended(tmp_path, line)[0] for command, line in COMMANDS.items()} == {
        "rate": 1,
        "compare": 0,
    }


def test_wrong_arguments_and_help_keep_their_codes(tmp_path):
    def code(*arguments):
        return command_in_a_copy("pytest_pafot", *arguments, folder=tmp_path).code

    assert [code("compare", "--help"), code("rate", "--hel"), code("rate", "--nothing")] == [
        0,
        0,
        2,
    ]


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_a_child_that_an_interrupt_ends_without_a_receipt_is_no_fault_of_the_policy(tmp_path):
    how = "signal.signal(signal.SIGTERM, signal.SIG_IGN); os.kill(os.getppid(), signal.SIGTERM); os._exit(1)"
    assert ended(tmp_path, COMMANDS["rate"], ON_IMPORT=how) == (143, "rate: interrupted\n")


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
def test_a_signal_to_the_command_ends_the_process_that_drives(tmp_path, number):
    line = [
        sys.executable,
        "-m",
        "pytest_pafot",
        *COMMANDS["rate"].replace("episodes 8", "episodes 800").split(),
    ]
    (tmp_path / "planner.py").write_text(
        "import os, time\ndef make():\n    open(f'pid-{os.getpid()}', 'w').close()\n    time.sleep(0.1)\n"
        "    return lambda seen: (0.0, 0.0)\n"
    )
    process = Copy(line, cwd=tmp_path, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    while not (begun := list(tmp_path.glob("pid-*"))):
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(number)
    _, told = process.communicate(timeout=60)  # until the process that drives has ended, too
    assert process.returncode == (-9 if number == signal.SIGKILL else 128 + number)
    assert "rate: interrupted" in told
    # then nobody may have waited for it yet, though its output is closed
    if number != signal.SIGKILL:
        with pytest.raises(ProcessLookupError):
            os.kill(int(begun[0].name.removeprefix("pid-")), 0)
