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
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
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
from pytest_pafot.model.vehicle_type import STYLES, named_vehicles
from pytest_pafot.support.errors import OF_SEARCH, FieldError, RequestError, flag
from pytest_pafot.support.files import way_out, write_if_free
from pytest_pafot.support.process import Ended, taken_receipt, undisturbed, unfinished
from pytest_pafot.support.references import PLANNER
from pytest_pafot.support.text import one_line, visible

CONFTEST, TEST = "conftest.py", "test_safety.py"
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
PLACE = 4
"""Where in the command of a session the folder of its tests is."""
NO_TESTS = "[pytest]\n"
"""An empty configuration of pytest, so that the project's settings do not apply to the session."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    of_whom = "drive with this policy: module:factory, such as planner:Planner, or module:factory:argument"
    parser.add_argument("ads", metavar="ADS", help=of_whom)
    add_world_arguments(parser, "default: a highway, in SI units")
    of_traffic = "set how the other vehicles drive (default: hostile)"
    parser.add_argument("--traffic", choices=tuple(STYLES), help=of_traffic)
    of_vehicles = "let NPCs be these vehicles, such as car,truck (default: all ready ones that fit the road)"
    parser.add_argument("--vehicles", metavar="A,B", help=of_vehicles)
    of_runs = f"stop after N runs (default: {RUNS})"
    parser.add_argument("--runs", flag("runs"), type=BY_NAME["runs"].read, metavar="N", help=of_runs)
    of_seed = "draw the scenarios of this seed (default: 0)"
    parser.add_argument("--seed", flag("seed"), type=BY_NAME["seed"].read, metavar="N", help=of_seed)
    of_blame = "count these collisions as failures. any: all; ego: all but those by the fault of an NPC alone; "
    of_blame += (
        "preventable: of these, those that a reference driver prevents; avoidable: those of ego, and those that "
    )
    of_blame += "braking late, but hard, avoids (default: %(default)s)"
    parser.add_argument("--blame", choices=BLAMES, default="ego", help=of_blame)
    of_against = "count only failures that a reference passes, a second policy: module:factory[:argument]"
    parser.add_argument("--against", flag("against"), metavar="REFERENCE", help=of_against)
    of_check = "call this function of a run, which asserts what must hold (default: that there is no collision)"
    parser.add_argument("--check", metavar="MODULE:FUNCTION", help=of_check)
    of_report = "write the findings to this web page (default: %(default)s)"
    parser.add_argument(
        "--report", flag("report"), type=BY_NAME["report"].read, metavar="FILE", default=PAGE, help=of_report
    )
    of_test = f"write {CONFTEST} and {TEST} here for `pytest`, and do not search"
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
    here = Path.cwd()
    files = {CONFTEST: _conftest(arguments), TEST: _test(arguments)}
    if arguments.write_test:
        return _write_test(here, files, arguments.ads)
    against = arguments.against
    if against is not None:
        ads_factory(against, "--against")
        against = whole_name(against)
    given = {name: getattr(arguments, name) for name in OWN}
    corpus = here / arguments.corpus  # The tests are not in this folder.
    given |= {"against": against, "corpus": corpus}
    options = [f"{flag(name)}={value}" for name, value in given.items() if value is not None]
    with _session(files) as session:
        environ = {OF_COMMAND: arguments.ads, OF_SEARCH: shlex.join(command)}
        code = _code_of([*session, *options, *arguments.options, *arguments.pytest], {**os.environ, **environ})
    if code == TESTS_FAILED and files_below(corpus / Path(TEST).stem):
        replay = "pytest FILE" if arguments.corpus == CORPUS else f"pytest FILE {flag('corpus', corpus)}"
        kept = f"and commit {CONFTEST}, {TEST} and {arguments.corpus}/; `{replay}` needs them, too"
        own = command[: command.index("--")] if "--" in command else command
        again = [*own, "--write-test"]
        sys.stdout.write(f"keep it as a test: {shlex.join(again)}, {kept}\n")
    return BAD_USE if code == USAGE_ERROR else code


@contextmanager
def _session(files: Mapping[str, str]) -> Iterator[list[str]]:
    """Write the files of a test into a temporary folder, and provide the start of a pytest command that runs it."""
    with tempfile.TemporaryDirectory(prefix="pafot-") as folder:
        for name, text in {**files, "pytest.ini": NO_TESTS}.items():
            (Path(folder) / name).write_text(text, encoding="utf-8")
        fixed = [f"--rootdir={folder}", "-pno:cacheprovider", "-rN"]
        yield [sys.executable, "-c", PYTEST, str(os.getpid()), folder, *fixed]


def _code_of(session: Sequence[str], environ: Mapping[str, str], output: int | None = None) -> int:
    """Run the session of a command and return its exit code. If this process is interrupted, the session ends before.

    A session has LAST_SECONDS for its summary and page, and is killed then. ``output`` is a file for all that it
    prints, by default that of this process.

    Raises:
        ChildProcessError: if the session did not come to its end.
    """
    with subprocess.Popen(  # noqa: S603  (the user's own arguments)
        session, env=environ, stdout=output, stderr=output
    ) as process:
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
    code = taken_receipt(session[PLACE], left)
    if code is None and left != STUCK:
        raise ChildProcessError(unfinished(left))
    return left if code is None else code


def _write_test(here: Path, files: Mapping[str, str], ads: str) -> int:
    """Write the files of a test, which have to be new, after a few runs of the test. Return the exit code.

    Raises:
        RequestError: if a file is there or cannot be written, or if the test cannot run.
    """
    there = [name for name in files if os.path.lexists(here / name)]
    if there:
        raise RequestError(
            f"--write-test: expected a folder without {' and '.join(there)}, received {here}; run the command in "
            "another folder, or write the test by hand"
        )
    _check_that_it_runs(files, ads)
    written: list[str] = []
    try:
        for name, text in files.items():
            if not write_if_free(here / name, text.encode()):
                raise OSError(f"{name} was written meanwhile")
            written.append(name)
    except OSError as error:
        for name in written:
            (here / name).unlink(missing_ok=True)
        fix = way_out(error, "or run the command in another folder")
        raise RequestError(
            f"--write-test: expected a folder in which {' and '.join(files)} can be written, received {here}: "
            f"{error.strerror or error}; {fix}"
        ) from None
    sys.stdout.write("".join(f"{name}\n" for name in files))
    return 0


def _check_that_it_runs(files: Mapping[str, str], ads: str) -> None:
    """Run a test on a few scenarios, so that only a test that can run is written. A failing run is a finding, no error.

    Raises:
        RequestError: if the test cannot run.
    """
    with tempfile.TemporaryDirectory(prefix="pafot-") as scratch, tempfile.TemporaryFile() as output:
        told, environ = Path(scratch, "pafot.json"), {**os.environ, OF_COMMAND: ads}
        given = {"runs": 4, "seed": 0, "save": "none", "shrink_rollouts": 0, "json": told}
        once = [f"{flag(name)}={value}" for name, value in given.items()]
        with _session(files) as session:
            code = _code_of([*session, *once, f"{flag('corpus')}={scratch}", "-q"], environ, output.fileno())
        record = json.loads(told.read_bytes()) if told.exists() else {"searches": []}
        output.seek(0)
        words = output.read().decode("utf-8", "replace").splitlines()
    if code == 0 or any(search["finds"] for search in record["searches"]):
        return
    errors = [line[1:].strip() for line in words if line.startswith("E ")]
    received = next((search["message"] for search in record["searches"] if search["message"]), " ".join(errors[-1:]))
    raise RequestError(
        f"--write-test: expected a test that can run, received {one_line(visible(received or 'no test'))}; nothing was "
        "written: correct it, and see more by the same command without --write-test"
    )


def _conftest(arguments: argparse.Namespace) -> str:
    """Return the content of the conftest.py with the fixture of the policy."""
    ads_factory(arguments.ads, "ADS")
    module, name, *argument = whole_name(arguments.ads).split(":", 2)
    made = f"lambda: factory({argument[0]!r})" if argument else "factory"
    return (
        f"import pytest\n{_import(module, name, 'factory', 'ADS')}\n\n"
        f"@pytest.fixture\ndef ads():  # a factory: one fresh policy per scenario\n    return {made}\n"
    )


def _test(arguments: argparse.Namespace) -> str:
    """Return the content of the file with the test."""
    given = [] if arguments.blame == "any" else [f'blame="{arguments.blame}"']
    of_world, imports = _world(arguments)
    given += of_world
    given += [] if arguments.traffic is None else [f'traffic="{arguments.traffic}"']
    given += [] if arguments.vehicles is None else [f"vehicles={json.dumps(_vehicles(arguments.vehicles))}"]
    name, holds = "never_at_fault_in_a_collision", "assert not run.collision, run.explain()"
    if arguments.blame != "ego":
        name = "never_in_a_collision"
    if arguments.check is not None:
        check_function(arguments.check)
        module, name = arguments.check.split(":")
        holds, imports = "return holds(run)", imports + _import(module, name, "holds", "--check")
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
        _import(module, name.partition(":")[0], "", "--world")  # it checks the names
        return [f"world={json.dumps(arguments.world)}"], ""
    of_config = "" if config is None else f", config={config!r}"
    of_planner = "" if world.planner_hz is None else f", planner_hz={world.planner_hz}"
    return [f"world=pafot.World({world.env_id!r}{of_config}{of_planner})"], f"import {module}\n" if name else ""


def _vehicles(text: str) -> list[str]:
    """Return the names of vehicles in the value of ``--vehicles``."""
    names = [name.strip() for name in text.split(",")]
    try:
        named_vehicles(names)
    except FieldError as error:
        raise RequestError(f"--vehicles: expected {error.expected}, received {error.received}") from None
    return names


def _import(module: str, name: str, alias: str, option: str) -> str:
    """Return the import of a function. Its alias hides no fixture, and is no test or hook for pytest."""
    if module in (Path(CONFTEST).stem, Path(TEST).stem):
        received = f"{module}:{name}, in a file of the search itself"
        raise RequestError(
            f"{option}: expected a module other than {CONFTEST} and {TEST}, received {received}; rename it"
        )
    for part in (*module.split("."), name):
        if not part.isidentifier() or keyword.iskeyword(part):
            received = f"{part!r} in {module}:{name}"
            raise RequestError(f"{option}: expected names that `import` takes, received {received}; rename it")
    return f"from {module} import {name} as {alias}\n"
