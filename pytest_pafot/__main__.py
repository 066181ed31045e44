"""The commands of ``python -m pytest_pafot``.

A command whose exit code is a verdict on a policy runs in a child process. The policy could end that process with the
exit code 0, so the child leaves a receipt when the command finishes.
"""

from __future__ import annotations

import signal

if __name__ == "__main__" and hasattr(signal, "pthread_sigmask"):
    # Block Ctrl-C until main_in_child runs. Python would print a traceback while it imports the modules below.
    signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT,))

import argparse
import io
import os
import subprocess
import sys
import tempfile
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from pytest_pafot.support.process import ended_with, leave_receipt, taken_receipt, unfinished


class Command(NamedTuple):
    """A command of ``python -m pytest_pafot``, with a module that defines ``add_arguments`` and ``run``."""

    module: str
    help: str
    about: str
    # whether its exit code is a verdict on a policy, so that it has to leave a receipt
    is_gate: bool = False


# The module of a command is imported only if the command is run.
COMMANDS = MappingProxyType({
    "search": Command(
        "pytest_pafot.commands.search_command",
        "search for traffic in which a policy crashes, without a test",
        "Search for traffic in which a policy crashes. Findings are explained, saved in pafot_found/, and shown on a "
        "web page.",
        is_gate=True,
    ),
    "replay": Command(
        "pytest_pafot.commands.replay_command",
        "run a saved scenario, without a test",
        "Run a saved scenario with a policy. Code that the file names is not run, so you can replay files from anyone.",
        is_gate=True,
    ),
    "corpus": Command(
        "pytest_pafot.commands.corpus_command",
        "list saved scenarios, or accept their failures",
        "List the saved scenarios in folders, or accept their failures until a given day. No scenario is run.",
    ),
    "compare": Command(
        "pytest_pafot.comparison.command",
        "compare search algorithms on a policy",
        "Run each of several search algorithms several times on a policy, and write results, statistics, figures and "
        "a report. You can interrupt the command at any time. The same command then continues where it stopped.",
        is_gate=True,
    ),
    "rate": Command(
        "pytest_pafot.commands.rate_command",
        "count how often a policy crashes in ordinary traffic",
        "Run seeded episodes in the environment's own traffic, without a search, and count the crashes of one policy, "
        "or of several policies on the same seeds.",
        is_gate=True,
    ),
    "export": Command(
        "pytest_pafot.export.exporter",
        "write the run of a finding to files for other tools",
        "Run the scenario of a saved finding again, and write the road and the paths of all vehicles to files.",
    ),})  # fmt: skip

# The commands with an exit code that is a verdict on a policy.
GATES = tuple(name for name, command in COMMANDS.items() if command.is_gate)

# The signals that a command passes on to its child.
ENDS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)

# The environment variable of a child: the id of its parent, and the folder for its receipt.
DRIVES = "PYTEST_PAFOT_DRIVES"


def main_in_child(arguments: list[str]) -> int:
    """Run a command and return its exit code. Commands in :data:`GATES` run in a child process."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # it is closed, for example by `>&-`
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: PTH123, SIM115  (a device, for ever)
    told = os.environ.pop(DRIVES, "")
    if told:
        parent, _, folder = told.partition(":")
        from pytest_pafot.support.process import bound_to  # noqa: PLC0415

        # on other systems, it continues if its parent is killed
        bound_to(int(parent), signal.SIGTERM)
        try:
            _hold_back(False)
            code = main(arguments)
        # after --help or for invalid arguments; a SystemExit of a policy is caught
        except SystemExit as ended:
            code = int(ended.code or 0)
        except KeyboardInterrupt:  # while modules are imported
            code = _interrupted(arguments)
        leave_receipt(folder, code)
        return code
    if not arguments or arguments[0] not in GATES:
        try:
            _hold_back(False)
            return main(arguments)
        except KeyboardInterrupt:
            return _interrupted(arguments)
    child: subprocess.Popen[bytes] | None = None
    received: list[int] = []

    def pass_on(number: int, _: object) -> None:
        received.append(number)
        # Ctrl-C in a terminal reaches both processes, other signals only this one. A second Ctrl-C may arrive twice.
        reached = number == signal.SIGINT and received.count(number) == 1 and _has_terminal()
        if child is not None and not reached:
            with suppress(OSError):  # it may have ended
                child.send_signal(number)

    for number in ENDS:
        # both processes ignore the signals that nohup ignores
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, pass_on)
    with tempfile.TemporaryDirectory(prefix="pafot-") as folder:
        # The same interpreter with the same options.
        environ = {**os.environ, DRIVES: f"{os.getpid()}:{folder}"}
        _hold_back(True)
        try:
            child = subprocess.Popen([sys.executable, *sys.orig_argv[1:]], env=environ)  # noqa: S603  (this command)
            for number in tuple(received):  # before the child existed
                child.send_signal(number)
        finally:
            _hold_back(False)
        left = child.wait()
        received_code = taken_receipt(folder, left)
    if received_code is not None:
        return received_code
    if received:  # Python itself may have ended the child
        sys.stderr.write(f"{arguments[0]}: interrupted\n")
        return 128 + received[0]
    sys.stderr.write(f"{arguments[0]}: {unfinished(left)}\n")
    return ended_with(left) or 2


def _hold_back(is_held: bool) -> None:
    # Block or release ENDS. A child inherits the block, because Python would print a traceback while it starts.
    if hasattr(signal, "pthread_sigmask"):
        how = signal.SIG_BLOCK if is_held else signal.SIG_UNBLOCK
        signal.pthread_sigmask(how, ENDS)


def _interrupted(arguments: list[str]) -> int:
    sys.stderr.write(f"\n{' '.join(arguments[:1])}: interrupted\n")
    return 128 + signal.SIGINT


def _has_terminal() -> bool:
    # Whether this process is in the foreground of a terminal, regardless of its standard input.
    if os.name == "nt":
        return True
    with suppress(OSError), open(os.ctermid(), "rb", buffering=0) as terminal:  # noqa: PTH123  (a device, not a path)
        return os.tcgetpgrp(terminal.fileno()) == os.getpgrp()
    return False


def main(arguments: list[str] | None = None) -> int:
    """Run a command in this process, and return its exit code.

    ``arguments`` defaults to ``sys.argv[1:]``.
    """
    from pytest_pafot.support.process import Ended, interrupted_by_signals  # noqa: PLC0415

    given = sys.argv[1:]
    if arguments is not None:
        given = arguments
    try:
        with interrupted_by_signals(_note):
            return _run(given)
    except KeyboardInterrupt as interrupt:
        with suppress(OSError, ValueError):  # the terminal may have been closed
            saved = "".join(f"; {note}" for note in getattr(interrupt, "__notes__", ()))
            sys.stderr.write(f"\n{' '.join(given[:1])}: interrupted{saved}\n")
        return interrupt.code if isinstance(interrupt, Ended) else 130


def _note(interrupt: KeyboardInterrupt) -> None:
    # Tell the guard of decisions about an interrupt, but only if it is already imported. Importing it takes long.
    note = getattr(sys.modules.get("pytest_pafot.world.guard.hang_guard"), "note_interrupt", None)
    if note is not None:
        note(interrupt)


def _run(given: list[str]) -> int:
    from pytest_pafot.commands.policy_reference import BAD_USE  # noqa: PLC0415
    from pytest_pafot.support.errors import (  # noqa: PLC0415
        AdsFactoryError,
        FieldError,
        RequestError,
    )

    # The errors that the user can correct. A ChildProcessError means that a worker died.
    errors = (RequestError, FieldError, AdsFactoryError, ChildProcessError)
    parser = argparse.ArgumentParser(
        prog="python -m pytest_pafot",
        description="Run a command of pytest-pafot without writing a test.",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND", dest="command")
    asked = next((each for each in given if not each.startswith("-")), "")
    parsers = {
        name: commands.add_parser(name, help=command.help, description=command.about)
        for name, command in COMMANDS.items()
    }
    if asked in COMMANDS:  # the others are listed, but not imported
        module = import_module(COMMANDS[asked].module)
        module.add_arguments(parsers[asked])
        parsers[asked].set_defaults(run=module.run)
    # Split at "--" here: argparse would add the arguments after it to the positional arguments before it.
    own = len(given)
    if given[:1] in (["search"], ["replay"]) and "--" in given:
        own = given.index("--")
    # as in pytest, because 2 means that a policy hung
    bad_use = 4 if asked == "replay" else BAD_USE
    try:
        arguments_given, unknown = parser.parse_known_args(
            given[:own], argparse.Namespace(pytest=given[own + 1 :])
        )
        if unknown:  # The parser itself would print the usage of all commands.
            which = commands.choices[arguments_given.command]
            which.error(
                f"unrecognized arguments: {' '.join(unknown)}. {which.prog} --help lists the options"
            )
    except SystemExit as ended:  # after --help, or after an error
        sys.exit(bad_use if ended.code else 0)
    # A character that the encoding of the output does not have must not end a command.
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        # Policies are imported from the current folder, as in pytest. The folder may have been deleted.
        sys.path.insert(0, str(Path.cwd()))
        try:
            code: int = arguments_given.run(
                arguments_given, ["python", "-m", "pytest_pafot", *given]
            )
        except errors as error:
            sys.stderr.write(f"{arguments_given.command}: {error}\n")
            code = bad_use
        except SystemExit as error:
            sys.stderr.write(
                f"{arguments_given.command}: expected a policy that drives, received SystemExit: {error}. Does the "
                "policy, its factory or its module call sys.exit? Raise an error instead\n"
            )
            code = bad_use
        sys.stdout.flush()
    except OSError as error:
        # neither the current folder nor the standard output has a file name
        if error.filename is not None:
            raise
        return _without_surroundings(arguments_given.command, error)
    return code


def _without_surroundings(command: str, error: OSError) -> int:
    from pytest_pafot.support.files import way_out  # noqa: PLC0415

    with suppress(OSError, ValueError), open(os.devnull, "wb") as nowhere:  # noqa: PTH123  (a device, not a path)
        # otherwise, Python fails to flush the rest when it exits
        os.dup2(nowhere.fileno(), sys.stdout.fileno())
    # such as `| head`, which has read enough, so this is no error
    if isinstance(error, BrokenPipeError):
        return 128 + 13
    expected, fix = "a writable standard output", way_out(error, "or redirect it")
    if isinstance(error, FileNotFoundError):
        expected, fix = "an existing current folder", "Change to a folder that exists"
    sys.stderr.write(f"{command}: expected {expected}, received {error.strerror}. {fix}\n")
    return 2


if __name__ == "__main__":
    sys.exit(main_in_child(sys.argv[1:]))
