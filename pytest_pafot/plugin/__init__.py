"""The pytest plugin: options, marks, fixtures, items, and their reports on the terminal.

A session without a marked test imports only small modules. Everything that needs numpy, yaml or highway-env
is imported when a marked test is collected or run.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import ExitStack

import pytest

from pytest_pafot.campaign.options import BY_NAME
from pytest_pafot.plugin import fixtures, messages, session_records
from pytest_pafot.plugin.catalogue_item import Catalogued
from pytest_pafot.plugin.collection import Collection
from pytest_pafot.plugin.marks import ANY_MARK, CATALOGUE_MARK, SAVED_MARK, SEARCH_MARK
from pytest_pafot.plugin.merge_item import MERGE, Merging
from pytest_pafot.plugin.option_sources import add_options
from pytest_pafot.plugin.orphans import Guard
from pytest_pafot.plugin.report_pages import Pages
from pytest_pafot.plugin.run_tables import Tables
from pytest_pafot.plugin.session import (
    SHARED,
    SUMMARY_LINES,
    Controller,
    Header,
    Shared,
    SummaryLines,
    Worker,
    shared_by_controller,
)
from pytest_pafot.plugin.terminal_reporter import Reporter
from pytest_pafot.plugin.tracing import Tracing


def pytest_addoption(parser: pytest.Parser) -> None:
    """Declare the command-line options and ini keys."""
    add_options(parser)


def pytest_configure(config: pytest.Config) -> None:
    """Register the marks, and a separate plugin for each feature that the options turn on."""
    for line in (
        f"{ANY_MARK}(requirement, title, owner): every test that belongs to pytest-pafot, to select all of them, or to "
        "say which requirement a test checks",
        f"{SEARCH_MARK}(**arguments): search for scenarios that break the test; write @pafot.search(...)",
        f"{CATALOGUE_MARK}(*names, **values): drive named scenarios; write @pafot.catalogue(...)",
        f"{SAVED_MARK}(saved): the item replays a saved scenario; set by the plugin",
    ):
        config.addinivalue_line("markers", line)
    config.stash[SUMMARY_LINES] = SummaryLines()
    features = {"fixtures": fixtures, "collection": Collection(config), "messages": messages}
    features |= {"catalogue": Catalogued(), "tracing": Tracing()}
    if hasattr(config, "workerinput"):
        config.stash[SHARED] = shared_by_controller(config)
        features["worker"] = Worker()
    else:
        asked = config.getoption(BY_NAME["today"].key)
        config.stash[SHARED] = Shared(today=asked) if asked else Shared()
        features |= {"reporting": Reporter(config), "pages": Pages(config), "guard": Guard()}
        if session_records.is_asked_for(config, os.environ):
            features["records"] = session_records.Records(config)
        if config.getoption(BY_NAME["table"].key) and not config.getoption("collectonly", False):
            features["tables"] = Tables(config)
    if config.getoption(MERGE):
        features["merging"] = Merging(config)
    if config.getoption("dist", "no") != "no":
        features["controller"] = Controller()
    if config.get_verbosity() > 0:
        features["header"] = Header()
    _register(config, features)


def pytest_collection_finish(session: pytest.Session) -> None:
    """Register the plugins that run the marked items, if the session will run any."""
    is_marked = any(item.get_closest_marker(name) for item in session.items for name in (SEARCH_MARK, ANY_MARK))
    if not is_marked or session.config.getoption("collectonly"):
        return  # these plugins import the simulation, and an editor that only lists tests would wait for it
    from pytest_pafot.plugin.failure_reports import Failures  # noqa: PLC0415
    from pytest_pafot.plugin.item_checks import Checks, Execution  # noqa: PLC0415
    from pytest_pafot.support.interrupts import interrupted_by_signals  # noqa: PLC0415

    _register(session.config, {"checks": Checks(), "execution": Execution(), "failing": Failures()})
    stack = ExitStack()
    session.config.add_cleanup(stack.close)
    stack.enter_context(interrupted_by_signals())  # SIGTERM alone would leave processes and copies of revisions behind.


def _register(config: pytest.Config, features: Mapping[str, object]) -> None:
    for name, feature in features.items():
        if not config.pluginmanager.has_plugin(f"pafot-{name}"):
            config.pluginmanager.register(feature, f"pafot-{name}")
