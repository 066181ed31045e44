"""``python -m pytest_pafot search``: a search without test files.

In a temporary folder, the session runs the test file that ``--write-test`` would write. Findings are saved in a folder
that no project's tests use, until ``--write-test`` moves them.
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
from itertools import takewhile
from pathlib import Path
from typing import Any

from pytest_pafot.commands.policy_reference import (
    BAD_USE,
    add_world_arguments,
    ads_factory,
    check_function,
    chosen_world,
    config_of,
    whole_name,
)
from pytest_pafot.corpus.layout import CORPUS, FOUND, files_below, link_below, refusal, safe_name
from pytest_pafot.model.vehicle_type import STYLES
from pytest_pafot.searches.options import BY_NAME, OF_COMMAND, OPTIONS, RUNS
from pytest_pafot.searches.request import BLAMES
from pytest_pafot.support.errors import OF_REPLAY, OF_SEARCH, RequestError, flag
from pytest_pafot.support.files import way_out, write_if_free
from pytest_pafot.support.process import Ended, taken_receipt, undisturbed, unfinished
from pytest_pafot.support.references import PLANNER
from pytest_pafot.support.text import ascii_text

TEST = "test_safety.py"
PAGE = "pafot.html"
# The options of pytest that have a short name here.
OWN = ("runs", "seed", "report", "against")
# Exit codes of pytest. A session with a policy that hangs ends with the second. They are copied, because importing
# pytest would slow down `--help`.
TESTS_FAILED, STUCK, USAGE_ERROR = 1, 2, 4
# An interrupted session is killed if its summary takes longer [s].
LAST_SECONDS = 30
# `python -m pytest` as a process that leaves a receipt, since a policy may end it with the exit code 0. It ends
# together with its parent, whose id is the first argument. The second argument is the folder for the receipt.
PYTEST = """
import os, signal, sys
parent, folder = int(sys.argv.pop(1)), sys.argv[1]
if sys.platform == "linux":  # on other systems, the session continues if the command is killed
    import ctypes
    ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG
    if os.getppid() != parent:  # it was killed before that call
        sys.exit(128 + signal.SIGTERM)
try:
    import pytest
    code = int(pytest.main())
    sys.stdout.flush()
except KeyboardInterrupt:  # before the session started; the command reports it
    code = 2
except BrokenPipeError:  # such as `| head`; otherwise, Python fails to flush the rest when it exits
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    code = 1
from pytest_pafot.support.process import leave_receipt  # after pytest, which rewrites assertions of what it imports
leave_receipt(folder, code)
sys.exit(code)
"""
# An empty configuration, so that the project's settings do not apply.
NO_TESTS = "[pytest]\n"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    of_whom = "drive with this policy: module:factory, such as planner:Planner, or module:factory:argument"
    parser.add_argument("ads", metavar="ADS", help=of_whom)
    add_world_arguments(parser, "default: a highway, in SI units")
    of_traffic = "set the driving style of the other vehicles (default: hostile)"
    parser.add_argument("--traffic", choices=tuple(STYLES), help=of_traffic)
    of_runs = f"stop after N runs (default: {RUNS})"
    parser.add_argument(
        "--runs", flag("runs"), type=BY_NAME["runs"].read, metavar="N", help=of_runs
    )
    of_seed = "draw the scenarios with this seed (default: 0)"
    parser.add_argument(
        "--seed", flag("seed"), type=BY_NAME["seed"].read, metavar="N", help=of_seed
    )
    of_blame = "count these collisions as failures: all (any), or all except those for which only an NPC is at "
    of_blame += "fault (ego) (default: %(default)s)"
    parser.add_argument("--blame", choices=BLAMES, default="ego", help=of_blame)
    of_against = (
        "count only failures in scenarios that this second policy passes: module:factory[:argument]"
    )
    parser.add_argument("--against", flag("against"), metavar="REFERENCE", help=of_against)
    of_test = f"do not search, but write {TEST} and the saved findings to the current folder, for use with `pytest`"
    parser.add_argument("--write-test", action="store_true", help=of_test)
    parser.add_argument(flag("corpus"), dest="corpus", help=argparse.SUPPRESS)
    add_session_arguments(parser, PAGE, "the search found a failure or failed itself, 2")
    parser.usage = "%(prog)s ADS [option ...] [-- option of pytest ...]"


def add_session_arguments(parser: argparse.ArgumentParser, page: str | None, codes: str) -> None:
    """Declare the arguments that ``search`` and ``replay`` share. ``codes`` explains the exit codes."""
    of_check = "assert your requirements on each run with this function (default: no collision)"
    parser.add_argument("--check", metavar="MODULE:FUNCTION", help=of_check)
    of_report = f"write the findings to this HTML file (default: {page or 'none'})"
    parser.add_argument(
        "--report",
        flag("report"),
        type=BY_NAME["report"].read,
        metavar="FILE",
        default=page,
        help=of_report,
    )
    # Messages of the session name options of pytest. All options that affect a search are also accepted here.
    for option in OPTIONS:
        if option.name not in (*OWN, "corpus", "allow_orphans"):
            given: dict[str, Any] = {"action": "append", "type": f"{option.flag}={{}}".format}
            if option.kind == "switch":
                given = {"action": "append_const", "const": option.flag}
            parser.add_argument(
                option.flag, dest="options", default=[], help=argparse.SUPPRESS, **given
            )
    of_others = f"You can also use the pytest options of this package, such as {flag('isolate')}. "
    of_others += f"`pytest --help` lists them. The exit code is 1 if {codes} for wrong arguments, and 0 otherwise."
    parser.epilog = f"{parser.epilog} {of_others}"


def run(arguments: argparse.Namespace, command: Sequence[str]) -> int:
    """Run the search or, with ``--write-test``, write its test. Return the exit code."""
    name, test = written_test(arguments, "ADS")
    here = Path.cwd()
    folder = Path(Path(TEST).stem, safe_name(name))
    kept = here / CORPUS / folder
    found = here / FOUND / folder
    link = link_below(here, kept) or link_below(here, found)
    if arguments.corpus is None and link is not None:
        raise RequestError(f"{flag('corpus')}: {refusal(link)}")
    if arguments.write_test:
        return _write_test(test, {file: kept / file.name for file in files_below(found)})
    against = arguments.against
    if against is not None:
        ads_factory(against, "--against")
        against = whole_name(against)
    given: dict[str, object] = {option: getattr(arguments, option) for option in OWN}
    has_test = os.path.isfile(TEST) and Path(TEST).read_bytes() == test.encode()  # noqa: PTH113  (see is_folder)
    # Absolute, because the tests are in another folder.
    corpus = here / (arguments.corpus or (CORPUS if has_test else FOUND))
    given |= {"against": against, "corpus": corpus}
    options = [f"{flag(option)}={value}" for option, value in given.items() if value is not None]
    environ = {OF_COMMAND: arguments.ads, OF_SEARCH: shlex.join(command)}
    # otherwise, the command `replay` does not find the file by its id
    if corpus.is_relative_to(here):
        words = []
        for name in ("ads", "world", "config", "check"):
            value = getattr(arguments, name)
            if value:
                words += [f"--{name}", value]
        environ[OF_REPLAY] = shlex.join(words)
    code = code_of_session({TEST: test}, [*options, *arguments.options, *arguments.pytest], environ)
    if code == TESTS_FAILED and not has_test and files_below(corpus / Path(TEST).stem):
        own_words = takewhile(lambda word: word != "--", command)
        again = shlex.join([*own_words, "--write-test"])
        files = f"{TEST} and {arguments.corpus or CORPUS}/"
        sys.stdout.write(f"to keep this as a test, run {again}, and commit {files}\n")
    if code == USAGE_ERROR:
        return BAD_USE
    return code


def code_of_session(
    files: Mapping[str, str], options: Sequence[str], environ: Mapping[str, str]
) -> int:
    """Run pytest on some files in a temporary folder, and return its exit code.

    Raises:
        ChildProcessError: if the session did not finish.
    """
    with tempfile.TemporaryDirectory(prefix="pafot-") as folder:
        for name, text in {**files, "pytest.ini": NO_TESTS}.items():
            Path(folder, name).write_text(text, encoding="utf-8")
        fixed = [f"--rootdir={folder}", "-pno:cacheprovider", "-rN"]
        session = [sys.executable, "-c", PYTEST, str(os.getpid()), folder, *fixed, *options]
        return _code_of(session, {**os.environ, **environ}, folder)


def _code_of(session: Sequence[str], environ: Mapping[str, str], folder: str) -> int:
    # An interrupt of this process also ends the session, which has LAST_SECONDS for its summary and page.
    with subprocess.Popen(session, env=environ) as process:  # noqa: S603  (the user's own arguments)
        try:
            left = process.wait()
        except KeyboardInterrupt as interrupt:
            # the session received Ctrl-C as well, and a second one would end it
            if not isinstance(interrupt, Ended):
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
    if code is not None:
        return code
    if left != STUCK:
        raise ChildProcessError(unfinished(left))
    return left


def _write_test(text: str, found: Mapping[Path, Path]) -> int:
    here, elsewhere = Path.cwd(), "run the command in another folder"
    try:
        if not write_if_free(here / TEST, text.encode()):
            raise RequestError(
                f"--write-test: expected a folder without {TEST}, received {here}. Use another folder"
            )
        for file, kept in found.items():
            kept.parent.mkdir(parents=True, exist_ok=True)
            file.replace(kept)
    except OSError as error:
        raise RequestError(
            f"--write-test: expected a writable folder, received {here}: "
            f"{error.strerror or error}. {way_out(error, f'or {elsewhere}')}"
        ) from None
    names = [TEST, *(str(each.relative_to(here)) for each in found.values())]
    sys.stdout.write("".join(f"{ascii_text(name)}\n" for name in names))
    return 0


def written_test(arguments: argparse.Namespace, option: str, world: str = "") -> tuple[str, str]:
    """Return the name of the test and the content of its file.

    Args:
        arguments: the command's arguments.
        option: name of the argument for the policy, for errors.
        world: the mark's argument for the world, if ``--world`` is not given.
    """
    ads_factory(arguments.ads, option)
    _check_module(arguments.ads, option)
    given = [f"ads={json.dumps(whole_name(arguments.ads))}"]
    name = "never_in_a_collision"
    if arguments.blame != "any":
        given.append(f'blame="{arguments.blame}"')
        name = "never_at_fault_in_a_collision"
    of_world, imports = _world(arguments)
    given += filter(None, [of_world or world])
    if arguments.traffic is not None:
        given.append(f'traffic="{arguments.traffic}"')
    holds = "assert not run.collision, run.explain()"
    if arguments.check is not None:
        check_function(arguments.check)
        name = arguments.check.partition(":")[2]
        holds, imports = "return holds(run)", imports + _import(arguments.check, "--check")
    if not name.startswith("test"):
        name = f"test_{name}"
    function = f"@pafot.search({', '.join(given)})\ndef {name}(run):\n    {holds}\n"
    return name, f"import pytest_pafot as pafot\n{imports}\n\n{function}"


def _world(arguments: argparse.Namespace) -> tuple[str, str]:
    # The mark's argument for the world, and the import that it needs. Both may be empty.
    is_planner = arguments.ads.endswith(PLANNER)
    world = chosen_world(arguments.world, arguments.config, [arguments.ads], is_planner=is_planner)
    if world is None:
        return "", ""
    module, _, name = arguments.world.partition(":")
    if name and getattr(world, "env_id", "") != name:
        _check_module(arguments.world, "--world")
        return f"world={json.dumps(arguments.world)}", ""
    given = repr(world.env_id)
    config = config_of(arguments.config)
    if config is not None:
        given += f", config={config!r}"
    if world.planner_hz is not None:
        given += f", planner_hz={world.planner_hz}"
    return f"world=pafot.World({given})", f"import {module}\n" if name else ""


def _check_module(reference: str, option: str) -> None:
    # the file of the search would hide that module
    if reference.partition(":")[0] == Path(TEST).stem:
        raise RequestError(
            f"{option}: expected a module other than {TEST}, received {reference}. Rename the module"
        )


def _import(reference: str, option: str) -> str:
    # The alias must not hide a fixture, nor look like a test or a hook to pytest.
    _check_module(reference, option)
    module, name = reference.split(":")
    for part in (*module.split("."), name):
        if not part.isidentifier() or keyword.iskeyword(part):
            received = f"{part!r} in {reference}"
            raise RequestError(
                f"{option}: expected names that `import` accepts, received {received}. Rename it"
            )
    return f"from {module} import {name} as holds\n"
