"""``python -m pytest_pafot corpus nearby``: the plugin of its session, which replays saved scenarios.

It lists neighbours that fail although the saved scenario passes, or puts them into the files.
"""

from __future__ import annotations

import argparse

import pytest

from pytest_pafot.corpus.layout import relative
from pytest_pafot.corpus.writer import CorpusWriteError, rewrite
from pytest_pafot.plugin import messages
from pytest_pafot.plugin.collection import saved_of
from pytest_pafot.plugin.replay_item import NEARBY_SHOWN
from pytest_pafot.plugin.session import SUMMARY_LINES
from pytest_pafot.plugin.shrinking import pytest_collection_modifyitems  # noqa: F401  (a hook of this plugin, too)
from pytest_pafot.support.text import visible


def pytest_addoption(parser: pytest.Parser) -> None:
    """Declare the option by which the command asks to write."""
    parser.addoption("--put-neighbours", action="store_true", help=argparse.SUPPRESS)


def pytest_runtest_teardown(item: pytest.Item) -> None:
    """List the neighbour that fails in a replay, or write it into the file of the replay."""
    saved, shown = saved_of(item), item.stash.get(NEARBY_SHOWN, None)
    if saved is None or shown is None:
        return
    name, kind, done = visible(relative(saved.path, item.config.rootpath)), "done", "would replace"
    if item.config.getoption("put_neighbours"):
        try:
            rewrite(saved.path, shown)
            done = "replaced"
        except CorpusWriteError as error:
            kind, done = "problem", f"not replaced: {visible(str(error))}"
    messages.send(item, kind, {"text": f"{done}: {name}"})


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    """Let a session in which saved scenarios fail end in order, because the command is not about their result."""
    lines = session.config.stash[SUMMARY_LINES]
    if exitstatus == pytest.ExitCode.TESTS_FAILED and not lines.problems:
        session.exitstatus = pytest.ExitCode.OK
