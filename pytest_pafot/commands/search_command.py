"""``python -m pytest_pafot search``: a search without files of one's own, in a pytest session that has them for itself.

The session runs the same two files that ``--write-test`` leaves, from a folder of its own; findings are saved where
those two would find them, so that they become its regression tests.
"""

from __future__ import annotations

import argparse
import keyword
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from pytest_pafot.campaign.request import BLAMES
from pytest_pafot.commands.policy_reference import BAD_USE, PlanError, ads_factory, module_of
from pytest_pafot.corpus.layout import CORPUS

CONFTEST, TEST = "conftest.py", "test_safety.py"
PAGE = "pafot.html"
TESTS_FAILED, USAGE_ERROR = 1, 4
"""Exit codes of pytest, which the help of commands does not wait for."""
NO_TESTS = "[pytest]\n"
"""Keeps the settings of a project out of a session that has none of its tests."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    of_whom = "the policy: module:factory or module:factory:argument, where a class is a factory, too"
    parser.add_argument("ads", metavar="ADS", help=of_whom)
    parser.add_argument("--world", metavar="ID", help="a highway-env environment (default: a highway, in SI units)")
    parser.add_argument("--runs", type=int, metavar="N", help="after which the search ends (default: 40)")
    parser.add_argument("--seed", type=int, metavar="N", help="(default: a fresh one, which is told)")
    of_blame = "which collisions count, by who answers for them (default: %(default)s)"
    parser.add_argument("--blame", choices=BLAMES, default="ego", help=of_blame)
    of_check = "a function of a run that asserts what must hold, in place of that there is no collision"
    parser.add_argument("--check", metavar="MODULE:FUNCTION", help=of_check)
    parser.add_argument("--report", metavar="FILE", default=PAGE, help="the page (default: %(default)s)")
    of_test = f"write {CONFTEST} and {TEST} here, and do not search: `pytest` then does"
    parser.add_argument("--write-test", action="store_true", help=of_test)
    parser.usage = "%(prog)s ADS [option ...] [-- option of pytest ...]"


def run(arguments: argparse.Namespace, command: Sequence[str]) -> int:
    """Search, or write the test that does; the exit code, which is that of pytest."""
    here = Path.cwd()
    sys.path.insert(0, str(here))  # The policy is where the command is run, as with `python -m pytest`.
    try:
        files = {CONFTEST: _conftest(arguments), TEST: _test(arguments)}
        if arguments.write_test:
            return _written(here, files)
    except PlanError as error:
        sys.stderr.write(f"search: {str(error).replace('--ads', 'ADS')}\n")
        return BAD_USE
    given = {"--pafot-runs": arguments.runs, "--pafot-seed": arguments.seed, "--pafot-report": arguments.report}
    options = [f"{name}={value}" for name, value in given.items() if value is not None]
    with tempfile.TemporaryDirectory(prefix="pafot-") as folder:
        for name, text in {**files, "pytest.ini": NO_TESTS}.items():
            (Path(folder) / name).write_text(text, encoding="utf-8")
        fixed = [f"--rootdir={folder}", f"--pafot-corpus={here / CORPUS}", "-pno:cacheprovider", "-rN"]
        session = [sys.executable, "-m", "pytest", folder, *fixed, *options, *arguments.pytest]
        code = subprocess.run(session, check=False).returncode  # noqa: S603  (the user's own arguments)
    if code == TESTS_FAILED:
        kept = f"and commit {CONFTEST}, {TEST} and {CORPUS}/"
        own = command[: command.index("--")] if "--" in command else command
        again = [*own, "--write-test"]
        sys.stdout.write(f"keep it as a test: {shlex.join(again)}, {kept}\n")
    return BAD_USE if code == USAGE_ERROR else code


def _written(here: Path, files: dict[str, str]) -> int:
    there = [name for name in files if (here / name).exists()]
    if there:
        raise PlanError(
            f"--write-test: expected a folder without {' and '.join(there)}, received {here}; give the command in "
            "another one, or write the test by hand"
        )
    for name, text in files.items():
        (here / name).write_text(text, encoding="utf-8")
        sys.stdout.write(f"{name}\n")
    return 0


def _conftest(arguments: argparse.Namespace) -> str:
    """Return the file that says what to test."""
    ads_factory(arguments.ads)
    _, name, *argument = f"{arguments.ads}{'' if ':' in arguments.ads else ':make'}".split(":")
    made = f"lambda: {name}({argument[0]!r})" if argument else name
    return (
        f"import pytest\n{_import(module_of(arguments.ads), name)}\n\n"
        f"@pytest.fixture\ndef ads():  # a factory: one fresh policy per scenario\n    return {made}\n"
    )


def _test(arguments: argparse.Namespace) -> str:
    """Return the file that says what must hold."""
    given = [] if arguments.blame == "any" else [f'blame="{arguments.blame}"']
    given += [] if arguments.world is None else [f"world=pafot.World({arguments.world!r})"]
    name, holds, imports = "never_at_fault_in_a_collision", "assert not run.collision, run.explain()", ""
    if arguments.blame != "ego":
        name = "never_in_a_collision"
    if arguments.check is not None:
        try:
            ads_factory(arguments.check)
        except PlanError as error:
            raise PlanError(str(error).replace("--ads", "--check")) from None
        _, _, function = arguments.check.partition(":")
        if not function.isidentifier() or keyword.iskeyword(function):
            expected = "expected module:function of a function of a run"
            raise PlanError(f"--check: {expected}, received {arguments.check!r}")
        name, holds, imports = function, f"{function}(run)", _import(module_of(arguments.check), function)
    name = name if name.startswith("test") else f"test_{name}"
    return (
        f"import pytest_pafot as pafot\n{imports}\n\n@pafot.search({', '.join(given)})\ndef {name}(run):\n    {holds}\n"
    )


def _import(module: str, name: str) -> str:
    return f"from {module} import {name}\n"
