"""``python -m pytest_pafot replay``: replay one saved scenario with a policy, outside of a project.

The command runs a search session that only replays, with this file as its only saved scenario.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence

from pytest_pafot.commands.policy_reference import add_world_arguments, chosen_world
from pytest_pafot.commands.search_command import (
    TEST,
    add_session_arguments,
    code_of_session,
    written_test,
)
from pytest_pafot.corpus.layout import CORPUS
from pytest_pafot.model.trace import Outcome
from pytest_pafot.searches.saved_scenario import load
from pytest_pafot.support.errors import OF_SEARCH, RequestError, flag
from pytest_pafot.support.text import ascii_text

# The end of the session's conftest.py. It makes the file a saved scenario of the test, and ignores that its failure may
# be accepted.
CONFTEST = """
from dataclasses import replace
from pathlib import Path
from pytest_pafot.corpus.layout import CORPUS, folder_of_test
from pytest_pafot.corpus.reader import Saved, load
from pytest_pafot.plugin.collection import COLLECTED

def pytest_configure(config):
    folder, path = folder_of_test(config.rootpath / TEST, NAME, CORPUS, config.rootpath), Path(FILE)
    folder.mkdir(parents=True, exist_ok=True)
    saved = Saved(path, replace(load(path), xfail=None, xfail_until=None))
    config.stash.setdefault(COLLECTED, {})[folder] = {path.name: saved}
"""

# The ends of a run that are failures without the user's test.
ENDS = (Outcome.COLLISION, Outcome.ADS_ERROR, Outcome.HANG)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument(
        "file", metavar="FILE", help="run this saved scenario, given as a file or an id"
    )
    parser.add_argument(
        "--ads", metavar="ADS", help="drive with this policy: module:factory[:argument]"
    )
    add_world_arguments(
        parser, "required if the world of the file is code, such as wrappers or your own world"
    )
    add_session_arguments(parser, None, "the run fails, 4")
    parser.set_defaults(traffic=None)
    parser.usage = "%(prog)s FILE --ads ADS [option ...] [-- option of pytest ...]"


def run(arguments: argparse.Namespace, command: Sequence[str]) -> int:
    """Replay the file, and return the exit code of the session."""
    saved = load(arguments.file)
    expect, test = saved.expect, ascii_text(saved.finding.test)
    if arguments.ads is None:
        expected = "a policy, such as --ads module:Class"
        raise RequestError(
            f"--ads: expected {expected}, received none. The file itself contains no policy"
        )
    is_end = expect.is_crash or (expect.check is None and expect.outcome in ENDS)
    if arguments.check is None and (expect.signature.is_property or not is_end):
        expected = f"a function that takes a run and asserts the same as {test}, such as --check module:function"
        raise RequestError(
            f"--check: expected {expected}, received none. The failure was: {ascii_text(expect.brief)}"
        )
    # as in a test that found it
    arguments.blame = "any" if expect.responsibility == "npc" else "ego"
    name, text = written_test(arguments, "--ads", f"world=pafot.load({str(saved.path)!r}).world")
    saved.check_fits(chosen_world(arguments.world, arguments.config) or saved.world)
    version = saved.finding.found.versions.get("pytest-pafot", "of an unknown version")
    told = f"{saved.path}: {expect.brief}, found with pytest-pafot {version}. Replaying it with {arguments.ads}"
    sys.stdout.write(f"{ascii_text(told)}\n")
    sys.stdout.flush()
    options = ["-mpafot_saved", flag("runs", 0), flag("corpus", CORPUS), *arguments.options]
    if arguments.report is not None:
        options.append(flag("report", arguments.report))
    files = {
        TEST: text,
        "conftest.py": f"TEST, NAME, FILE = {(TEST, name, str(saved.path))!r}{CONFTEST}",
    }
    return code_of_session(files, [*options, *arguments.pytest], {OF_SEARCH: shlex.join(command)})
