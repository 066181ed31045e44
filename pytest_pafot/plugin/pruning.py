"""``python -m pytest_pafot corpus prune``: the plugin of its session, which collects the tests and runs none.

It lists the files of saved scenarios whose test is gone, or removes them.
"""

from __future__ import annotations

import argparse
from contextlib import suppress
from pathlib import Path

import pytest

from pytest_pafot.corpus.layout import files_in, relative
from pytest_pafot.plugin.session import SUMMARY_LINES
from pytest_pafot.plugin.unrun import UNRUN
from pytest_pafot.support.files import way_out
from pytest_pafot.support.text import visible


def pytest_addoption(parser: pytest.Parser) -> None:
    """Declare the option by which the command asks for removal."""
    parser.addoption("--remove-orphans", action="store_true", help=argparse.SUPPRESS)


@pytest.hookimpl(tryfirst=True)  # before the summary of the session is written
def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    """List or remove the files of orphans, and folders that are empty then; nothing if the collection failed."""
    if exitstatus not in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED):
        return
    session.exitstatus = pytest.ExitCode.OK
    lines, is_removed = session.config.stash[SUMMARY_LINES], session.config.getoption("remove_orphans")
    for folder, orphan in session.config.stash[UNRUN].orphans.items():
        for file in files_in(folder):
            name = visible(relative(file, session.config.rootpath))  # else a line break in it would begin a new line
            if str(file) not in orphan.removable:
                lines.reports.append(f"left as it is: {name}")
            elif not is_removed:
                lines.reports.append(f"would remove: {name}")
            else:
                try:
                    file.unlink(missing_ok=True)  # Another session may have removed it already.
                    lines.reports.append(f"removed: {name}")
                except OSError as error:
                    fix = way_out(error, "then prune again")
                    lines.problems.append(f"{name}: not removed: {error.strerror or error}; {fix}")
                    session.exitstatus = pytest.ExitCode.TESTS_FAILED
        if is_removed:
            with suppress(OSError):  # A folder with other content stays.
                Path(folder).rmdir()
                Path(folder).parent.rmdir()
    if not session.config.stash[UNRUN].orphans:
        lines.reports.append("nothing to remove")
