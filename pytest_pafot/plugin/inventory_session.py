"""The plugin of a session that collects tests and runs none, for commands that need to know which tests there are.

It writes a JSON file with the saved scenarios whose test is gone.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import pytest

from pytest_pafot.corpus.layout import files_in, relative
from pytest_pafot.plugin.collection import NAMES_ONLY
from pytest_pafot.plugin.unrun import UNRUN

TO = "--inventory-to"
"""The option of this session that names the file."""

ENDS = (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED)
"""The exit codes of a session that collected all that there is."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Declare the option with which the command names the file."""
    parser.addoption(TO, help=argparse.SUPPRESS)


def pytest_configure(config: pytest.Config) -> None:
    """Leave saved scenarios unread: reading them takes longer than all else, and the command reads them itself."""
    config.stash[NAMES_ONLY] = True


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    """Write what was collected, also if some files could not be collected; nothing if the session was broken off."""
    if not (session.testsfailed or exitstatus in ENDS):
        return
    root = session.config.rootpath
    orphans = {
        relative(file, root): orphan.expected
        for folder, orphan in session.config.stash[UNRUN].orphans.items()
        for file in files_in(folder)
    }
    content = json.dumps({"root": str(root), "failed": session.testsfailed, "orphans": orphans})
    Path(session.config.getoption(TO)).write_text(content, encoding="ascii")
