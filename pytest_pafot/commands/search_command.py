"""``python -m pytest_pafot search``: a search without test files, in a pytest session with temporary test files.

The session runs the two files that ``--write-test`` writes, from a temporary folder. Findings are saved where the test
of ``--write-test`` finds them, so they are its regression tests.
"""

from __future__ import annotations

import argparse
import json
import keyword
import os
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from pytest_pafot.campaign.options import BY_NAME, OF_COMMAND, OPTIONS, RUNS
from pytest_pafot.campaign.request import BLAMES
from pytest_pafot.commands.policy_reference import (
    ABOUT_POLICIES,
    BAD_USE,
    add_world_arguments,
    ads_factory,
    check_function,
    chosen_world,
    config_of,
    whole_name,
)
from pytest_pafot.corpus.layout import CORPUS, files_below
from pytest_pafot.model.vehicle_type import STYLES
from pytest_pafot.support.errors import OF_SEARCH, RequestError, flag
from pytest_pafot.support.files import way_out, write_if_free
from pytest_pafot.support.process import Ended, taken_receipt, undisturbed, unfinished
from pytest_pafot.support.references import PLANNER

TEST = "test_safety.py"
PAGE = "pafot.html"
OWN = ("runs", "seed", "report", "against")
"""The options of pytest that have a short name here."""
TESTS_FAILED, STUCK, USAGE_ERROR = 1, 2, 4
"""Exit codes of pytest; a session whose policy hangs ends itself with the second. They are copied, because importing
pytest would slow down the help of commands."""
LAST_SECONDS = 30
"""The time that an interrupted session has for its summary [s]. After that it is killed."""
PYTEST = """
import os, signal, sys
parent, folder = int(sys.argv.pop(1)), sys.argv[1]
if sys.platform == "linux":  # elsewhere the session goes on if the command is killed
    import ctypes
    ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG
    if os.getppid() != parent:  # it was killed before that
        sys.exit(128 + signal.SIGTERM)
try:
    import pytest
    code = int(pytest.main())
    sys.stdout.flush()
except KeyboardInterrupt:  # before there was a session; the command says so
    code = 2
except BrokenPipeError:  # as of `| head`; else Python fails to flush the rest when it exits
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    code = 1
from pytest_pafot.support.process import leave_receipt  # only now: pytest rewrites the assertions of what it imports
leave_receipt(folder, code)
sys.exit(code)
"""
"""``python -m pytest``, as a process that leaves a receipt: a policy may end it with the exit code 0.

It ends with the process that started it, whose id is its first argument. Its receipt goes into the folder of its tests,
which is its second one."""
NO_TESTS = "[pytest]\n"
"""An empty configuration of pytest, so that the project's settings do not apply to the session."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    of_whom = "drive with this policy: module:factory, such as planner:Planner, or module:factory:argument"
    parser.add_argument("ads", metavar="ADS", help=of_whom)
    add_world_arguments(parser, "default: a highway, in SI units")
    of_traffic = "set how the other vehicles drive (default: hostile)"
    parser.add_argument("--traffic", choices=tuple(STYLES), help=of_traffic)
    of_runs = f"stop after N runs (default: {RUNS})"
    parser.add_argument("--runs", flag("runs"), type=BY_NAME["runs"].read, metavar="N", help=of_runs)
    of_seed = "draw the scenarios of this seed (default: 0)"
    parser.add_argument("--seed", flag("seed"), type=BY_NAME["seed"].read, metavar="N", help=of_seed)
    of_blame = "count these collisions as failures. any: all; ego: all but those by the fault of an NPC alone "
    of_blame += "(default: %(default)s)"
    parser.add_argument("--blame", choices=BLAMES, default="ego", help=of_blame)
    of_against = "count only failures that a reference passes, a second policy: module:factory[:argument]"
    parser.add_argument("--against", flag("against"), metavar="REFERENCE", help=of_against)
    of_check = "call this function of a run, which asserts what must hold (default: that there is no collision)"
    parser.add_argument("--check", metavar="MODULE:FUNCTION", help=of_check)
    of_report = "write the findings to this web page (default: %(default)s)"
    parser.add_argument(
        "--report", flag("report"), type=BY_NAME["report"].read, metavar="FILE", default=PAGE, help=of_report
    )
    of_test = f"write {TEST} here for `pytest`, and do not search"
    parser.add_argument("--write-test", action="store_true", help=of_test)
    parser.add_argument(flag("corpus"), dest="corpus", default=CORPUS, help=argparse.SUPPRESS)
    # Messages of the session name options of pytest. All that do something in a search are options here, too.
    for option in OPTIONS:
        if option.name not in (*OWN, "corpus", "allow_orphans"):
            given: dict[str, Any] = {"nargs": 0 if option.kind == "switch" else None, "help": argparse.SUPPRESS}
            parser.add_argument(option.flag, action=_ForPytest, dest="options", default=[], **given)
    of_others = f"The options of this package for pytest, such as {flag('isolate')}, are options here, too: "
    of_others += "`pytest --help` lists them."
    of_exit = "The exit code is 1 if the search has found something or failed, 2 for wrong arguments, else 0."
    parser.epilog = f"{ABOUT_POLICIES} {of_others} {of_exit}"
    parser.usage = "%(prog)s ADS [option ...] [-- option of pytest ...]"


class _ForPytest(argparse.Action):
    """An option that the session gets as it is."""

    def __call__(self, _: object, namespace: argparse.Namespace, value: Any, name: str | None = None) -> None:
        namespace.options = [*namespace.options, str(name) if value == [] else f"{name}={value}"]


def run(arguments: argparse.Namespace, command: Sequence[str]) -> int:
    """Run the search, or with ``--write-test`` write the test that runs it. Return the exit code."""
    test = _test(arguments)
    if arguments.write_test:
        return _write_test(test)
    against = arguments.against
    if against is not None:
        ads_factory(against, "--against")
        against = whole_name(against)
    given = {name: getattr(arguments, name) for name in OWN}
    corpus = Path.cwd() / arguments.corpus  # The tests are not in this folder.
    given |= {"against": against, "corpus": corpus}
    options = [f"{flag(name)}={value}" for name, value in given.items() if value is not None]
    with tempfile.TemporaryDirectory(prefix="pafot-") as folder:
        for name, text in {TEST: test, "pytest.ini": NO_TESTS}.items():
            (Path(folder) / name).write_text(text, encoding="utf-8")
        fixed = [f"--rootdir={folder}", "-pno:cacheprovider", "-rN"]
        session = [sys.executable, "-c", PYTEST, str(os.getpid()), folder, *fixed, *options]
        environ = {OF_COMMAND: arguments.ads, OF_SEARCH: shlex.join(command)}
        code = _code_of([*session, *arguments.options, *arguments.pytest], {**os.environ, **environ}, folder)
    if code == TESTS_FAILED and files_below(corpus / Path(TEST).stem):
        replay = "pytest FILE" if arguments.corpus == CORPUS else f"pytest FILE {flag('corpus', corpus)}"
        kept = f"and commit {TEST} and {arguments.corpus}/; `{replay}` needs them, too"
        own = command[: command.index("--")] if "--" in command else command
        again = [*own, "--write-test"]
        sys.stdout.write(f"keep it as a test: {shlex.join(again)}, {kept}\n")
    return BAD_USE if code == USAGE_ERROR else code


def _code_of(session: Sequence[str], environ: Mapping[str, str], folder: str) -> int:
    """Run a session with its tests in a folder; return its exit code. An interrupt of this process ends the session.

    A session has LAST_SECONDS for its summary and page, and is killed then.

    Raises:
        ChildProcessError: if the session did not come to its end.
    """
    with subprocess.Popen(session, env=environ) as process:  # noqa: S603  (the user's own arguments)
        try:
            left = process.wait()
        except KeyboardInterrupt as interrupt:
            if not isinstance(interrupt, Ended):  # The session has received Ctrl-C as well, and a second one ends it.
                with suppress(subprocess.TimeoutExpired):
                    process.wait(LAST_SECONDS)
            raise
        finally:
            with undisturbed():
                process.terminate()
                try:
                    process.wait(LAST_SECONDS)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()
    code = taken_receipt(folder, left)
    if code is None and left != STUCK:
        raise ChildProcessError(unfinished(left))
    return left if code is None else code


def _write_test(text: str) -> int:
    """Write the file of a test, which has to be new. Return the exit code.

    Raises:
        RequestError: if the file is there or cannot be written.
    """
    here, elsewhere = Path.cwd(), "run the command in another folder"
    try:
        if not write_if_free(here / TEST, text.encode()):
            raise RequestError(
                f"--write-test: expected a folder without {TEST}, received {here}; {elsewhere}, or write the test by "
                "hand"
            )
    except OSError as error:
        raise RequestError(
            f"--write-test: expected a folder in which {TEST} can be written, received {here}: "
            f"{error.strerror or error}; {way_out(error, f'or {elsewhere}')}"
        ) from None
    sys.stdout.write(f"{TEST}\n")
    return 0


def _test(arguments: argparse.Namespace) -> str:
    """Return the content of the file with the test."""
    ads_factory(arguments.ads, "ADS")
    _check_module(arguments.ads, "ADS")
    given = [f"ads={json.dumps(whole_name(arguments.ads))}"]
    given += [] if arguments.blame == "any" else [f'blame="{arguments.blame}"']
    of_world, imports = _world(arguments)
    given += of_world
    given += [] if arguments.traffic is None else [f'traffic="{arguments.traffic}"']
    name, holds = "never_at_fault_in_a_collision", "assert not run.collision, run.explain()"
    if arguments.blame != "ego":
        name = "never_in_a_collision"
    if arguments.check is not None:
        check_function(arguments.check)
        name = arguments.check.partition(":")[2]
        holds, imports = "return holds(run)", imports + _import(arguments.check, "--check")
    name = name if name.startswith("test") else f"test_{name}"
    return (
        f"import pytest_pafot as pafot\n{imports}\n\n@pafot.search({', '.join(given)})\ndef {name}(run):\n    {holds}\n"
    )


def _world(arguments: argparse.Namespace) -> tuple[list[str], str]:
    """Return the argument of the mark for the world, and the import that registers its environment, if any."""
    config, is_planner = config_of(arguments.config), arguments.ads.endswith(PLANNER)
    world = chosen_world(arguments.world, arguments.config, [arguments.ads], is_planner=is_planner)
    if world is None:
        return [], ""
    module, _, name = arguments.world.partition(":")
    if name and getattr(world, "env_id", "") != name:
        _check_module(arguments.world, "--world")
        return [f"world={json.dumps(arguments.world)}"], ""
    of_config = "" if config is None else f", config={config!r}"
    of_planner = "" if world.planner_hz is None else f", planner_hz={world.planner_hz}"
    return [f"world=pafot.World({world.env_id!r}{of_config}{of_planner})"], f"import {module}\n" if name else ""


def _check_module(reference: str, option: str) -> None:
    """Refuse the name of an object in the file of the search itself, which hides a file of that name."""
    if reference.partition(":")[0] == Path(TEST).stem:
        raise RequestError(f"{option}: expected a module other than {TEST}, received {reference}; rename it")


def _import(reference: str, option: str) -> str:
    """Return the import of a function. Its alias hides no fixture, and is no test or hook for pytest."""
    _check_module(reference, option)
    module, name = reference.split(":")
    for part in (*module.split("."), name):
        if not part.isidentifier() or keyword.iskeyword(part):
            received = f"{part!r} in {reference}"
            raise RequestError(f"{option}: expected names that `import` takes, received {received}; rename it")
    return f"from {module} import {name} as holds\n"
