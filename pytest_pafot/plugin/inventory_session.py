"""The plugin of a session that collects tests and runs none, for commands that need to know which tests there are.

It writes a JSON file with the tests, their requirements, and the saved scenarios that they replay.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import pytest

from pytest_pafot.corpus.layout import files_in, relative
from pytest_pafot.plugin.collection import NAMES_ONLY, is_search, saved_of
from pytest_pafot.plugin.marks import ANY_MARK
from pytest_pafot.plugin.node_ids import base_id
from pytest_pafot.plugin.orphans import UNRUN
from pytest_pafot.plugin.tracing import traced

TO = "--inventory-to"
"""The option of this session that names the file."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Declare the option with which the command names the file."""
    parser.addoption(TO, help=argparse.SUPPRESS)


def pytest_configure(config: pytest.Config) -> None:
    """Leave saved scenarios unread: reading them takes longer than all else, and the command reads them itself."""
    config.stash[NAMES_ONLY] = True


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """Write what was collected, also if some files could not be collected."""
    tests: dict[str, dict[str, Any]] = {}
    files: dict[str, str] = {}
    root = session.config.rootpath
    for item in session.items:
        test, told = base_id(item), traced(item)
        known = tests.setdefault(
            test,
            {
                "requirements": told.requirements,
                "title": told.title,
                "owner": told.owner,
                "is_marked": item.get_closest_marker(ANY_MARK) is not None,
                "is_search": False,
            },
        )
        known["is_search"] = known["is_search"] or is_search(item)
        saved = saved_of(item)
        if saved is not None:
            files[relative(saved.path, root)] = test
    orphans = {
        relative(file, root): orphan.expected
        for folder, orphan in session.config.stash[UNRUN].orphans.items()
        for file in files_in(folder)
    }
    all_of_it = {"root": str(root), "tests": tests, "files": files, "orphans": orphans, "failed": session.testsfailed}
    Path(session.config.getoption(TO)).write_text(json.dumps(all_of_it), encoding="ascii")
