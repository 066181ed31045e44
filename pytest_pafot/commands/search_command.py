"""``python -m pytest_pafot search``: a search without test files, in a pytest session with temporary test files.

The session runs the two files that ``--write-test`` writes, from a temporary folder. Findings are saved where the test
of ``--write-test`` finds them, so they are its regression tests.
"""

from __future__ import annotations

import argparse
import os
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from pytest_pafot.campaign.options import BY_NAME, REVISION
from pytest_pafot.campaign.request import BLAMES
from pytest_pafot.commands.policy_reference import (
    ABOUT_POLICIES,
    BAD_USE,
    PlanError,
    ads_factory,
    check_function,
    module_of,
)
from pytest_pafot.commands.revision import OF_COMMAND
from pytest_pafot.corpus.layout import CORPUS, files_below
from pytest_pafot.model.driving_style import STYLES
from pytest_pafot.support.interrupts import Ended, undisturbed

CONFTEST, TEST = "conftest.py", "test_safety.py"
PAGE = "pafot.html"
TESTS_FAILED, USAGE_ERROR = 1, 4
"""Exit codes of pytest. They are copied, because importing pytest would slow down the help of commands."""
LAST_SECONDS = 30
"""The time that an interrupted session has for its summary [s]. After that it is killed."""
NO_TESTS = "[pytest]\n"
"""An empty configuration of pytest, so that the project's settings do not apply to the session."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    of_whom = "the policy: module:factory, such as planner:Planner, or module:factory:argument"
    parser.add_argument("ads", metavar="ADS", help=of_whom)
    parser.add_argument("--world", metavar="ID", help="a highway-env environment (default: a highway, in SI units)")
    of_traffic = "how the other vehicles drive (default: hostile)"
    parser.add_argument("--traffic", choices=STYLES, help=of_traffic)
    of_runs = "the number of runs (default: 40, or 400 if the variable CI is set)"
    parser.add_argument("--runs", type=BY_NAME["runs"].read, metavar="N", help=of_runs)
    of_seed = "the seed of the search (default: a new one, which the output names, or 0 if the variable CI is set)"
    parser.add_argument("--seed", type=BY_NAME["seed"].read, metavar="N", help=of_seed)
    of_blame = "which collisions are failures: any; those for which the ego is responsible; or, of these, those that a "
    of_blame += "reference driver prevents (default: %(default)s)"
    parser.add_argument("--blame", choices=BLAMES, default="ego", help=of_blame)
    of_against = f"count only failures that a reference passes: {REVISION}REVISION for ADS in another revision of the "
    of_against += f"repository, such as {REVISION}main, or module:factory[:argument]"
    parser.add_argument("--against", metavar="REFERENCE", help=of_against)
    of_copy = f"with --against {REVISION}REVISION, files and folders that ADS needs and git ignores, such as weights"
    parser.add_argument("--copy", nargs="+", default=[], metavar="PATH", help=of_copy)
    of_check = "a function of a run, which asserts what must hold (default: that there is no collision)"
    parser.add_argument("--check", metavar="MODULE:FUNCTION", help=of_check)
    of_report = "the web page of the findings (default: %(default)s)"
    parser.add_argument("--report", type=BY_NAME["report"].read, metavar="FILE", default=PAGE, help=of_report)
    of_test = f"do not search, but write {CONFTEST} and {TEST} here, with which `pytest` searches and replays findings"
    parser.add_argument("--write-test", action="store_true", help=of_test)
    of_exit = "The exit code is 1 if the search has found something or failed, 2 for wrong arguments, else 0."
    parser.epilog = f"{ABOUT_POLICIES} {of_exit}"
    parser.usage = "%(prog)s ADS [option ...] [-- option of pytest ...]"


def run(arguments: argparse.Namespace, command: Sequence[str]) -> int:
    """Run the search, or with ``--write-test`` write the test that runs it. Return the exit code."""
    here = Path.cwd()
    sys.path.insert(0, str(here))  # Import the policy from the current folder, as `python -m pytest` does.
    try:
        files = {CONFTEST: _conftest(arguments), TEST: _test(arguments)}
        if arguments.write_test:
            return _written(here, files)
    except PlanError as error:
        sys.stderr.write(f"search: {error}\n")
        return BAD_USE
    given = {"--pafot-runs": arguments.runs, "--pafot-seed": arguments.seed, "--pafot-report": arguments.report}
    given |= {"--pafot-against": arguments.against, "--pafot-copy": shlex.join(arguments.copy) or None}
    options = [f"{name}={value}" for name, value in given.items() if value is not None]
    with tempfile.TemporaryDirectory(prefix="pafot-") as folder:
        for name, text in {**files, "pytest.ini": NO_TESTS}.items():
            (Path(folder) / name).write_text(text, encoding="utf-8")
        fixed = [f"--rootdir={folder}", f"--pafot-corpus={here / CORPUS}", "-pno:cacheprovider", "-rN"]
        session = [sys.executable, "-m", "pytest", folder, *fixed, *options, *arguments.pytest]
        code = _code_of(session, {**os.environ, OF_COMMAND: arguments.ads})
    if code == TESTS_FAILED and files_below(here / CORPUS):
        kept = f"and commit {CONFTEST}, {TEST} and {CORPUS}/; `pytest FILE` needs them, too"
        own = command[: command.index("--")] if "--" in command else command
        again = [*own, "--write-test"]
        sys.stdout.write(f"keep it as a test: {shlex.join(again)}, {kept}\n")
    return BAD_USE if code == USAGE_ERROR else code


def _code_of(session: Sequence[str], environ: Mapping[str, str]) -> int:
    """Run a pytest session and return its exit code. If this process is interrupted, the session ends before it.

    A session has LAST_SECONDS for its summary and page, and is killed then.
    """
    with subprocess.Popen(session, env=environ) as process:  # noqa: S603  (the user's own arguments)
        try:
            return process.wait()
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


def _written(here: Path, files: dict[str, str]) -> int:
    there = [name for name in files if (here / name).exists()]
    if there:
        raise PlanError(
            f"--write-test: expected a folder without {' and '.join(there)}, received {here}; run the command in "
            "another folder, or write the test by hand"
        )
    for name, text in files.items():
        (here / name).write_text(text, encoding="utf-8")
        sys.stdout.write(f"{name}\n")
    return 0


def _conftest(arguments: argparse.Namespace) -> str:
    """Return the content of the conftest.py with the fixture of the policy."""
    ads_factory(arguments.ads, "ADS")
    _, name, *argument = f"{arguments.ads}{'' if ':' in arguments.ads else ':make'}".split(":")
    made = f"lambda: {name}({argument[0]!r})" if argument else name
    return (
        f"import pytest\n{_import(module_of(arguments.ads), name)}\n\n"
        f"@pytest.fixture\ndef ads():  # a factory: one fresh policy per scenario\n    return {made}\n"
    )


def _test(arguments: argparse.Namespace) -> str:
    """Return the content of the file with the test."""
    given = [] if arguments.blame == "any" else [f'blame="{arguments.blame}"']
    given += [] if arguments.world is None else [f"world=pafot.World({arguments.world!r})"]
    given += [] if arguments.traffic is None else [f'traffic="{arguments.traffic}"']
    name, holds, imports = "never_at_fault_in_a_collision", "assert not run.collision, run.explain()", ""
    if arguments.blame != "ego":
        name = "never_in_a_collision"
    if arguments.check is not None:
        check_function(arguments.check)
        function = arguments.check.partition(":")[2]
        name, holds, imports = function, f"{function}(run)", _import(module_of(arguments.check), function)
    name = name if name.startswith("test") else f"test_{name}"
    return (
        f"import pytest_pafot as pafot\n{imports}\n\n@pafot.search({', '.join(given)})\ndef {name}(run):\n    {holds}\n"
    )


def _import(module: str, name: str) -> str:
    return f"from {module} import {name}\n"
