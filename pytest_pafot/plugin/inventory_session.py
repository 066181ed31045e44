"""The plugin of a session that collects tests and runs none, for commands that need to know which tests there are.

It writes a JSON file with the tests, their requirements, and the saved scenarios that they replay.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from pytest_pafot.corpus.layout import files_in, relative
from pytest_pafot.plugin.collection import NAMES_ONLY, saved_of
from pytest_pafot.plugin.marks import ANY_MARK
from pytest_pafot.plugin.node_ids import base_id
from pytest_pafot.plugin.tracing import read
from pytest_pafot.plugin.unrun import UNRUN
from pytest_pafot.support.traced import Traced

TO = "--inventory-to"
"""The option of this session that names the file."""

ALL: pytest.StashKey[list[pytest.Item]] = pytest.StashKey()

ENDS = (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED)
"""The exit codes of a session that collected all that there is."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Declare the option with which the command names the file."""
    parser.addoption(TO, help=argparse.SUPPRESS)


def pytest_configure(config: pytest.Config) -> None:
    """Leave saved scenarios unread: reading them takes longer than all else, and the command reads them itself."""
    config.stash[NAMES_ONLY] = True


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Note all items, also those that an option such as ``-m`` leaves out afterwards."""
    config.stash[ALL] = list(items)


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    """Write what was collected, also if some files could not be collected; nothing if the session was broken off."""
    if ALL not in session.config.stash or not (session.testsfailed or exitstatus in ENDS):
        return
    tests: dict[str, dict[str, Any]] = {}
    files: dict[str, str] = {}
    root = session.config.rootpath
    wrong: dict[str, str] = {}
    for item in session.config.stash[ALL]:
        test, saved = base_id(item), saved_of(item)
        if saved is not None:
            files[relative(saved.path, root)] = test
        if item.get_closest_marker(ANY_MARK) is None:
            continue
        try:
            tests[test] = asdict(read(item))
        except ValueError as error:
            tests[test], wrong[test] = asdict(Traced()), str(error)
    orphans = {
        relative(file, root): orphan.expected
        for folder, orphan in session.config.stash[UNRUN].orphans.items()
        for file in files_in(folder)
    }
    collected = {"tests": tests, "files": files, "orphans": orphans, "wrong": wrong}
    content = json.dumps({"root": str(root), "failed": session.testsfailed, **collected})
    Path(session.config.getoption(TO)).write_text(content, encoding="ascii")
