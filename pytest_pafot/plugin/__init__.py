"""The pytest plugin: options, marks, fixtures, items, and their reports on the terminal.

A session without a marked test imports only small modules. What reports on marked tests is imported when the first one
is collected, and everything that needs numpy, yaml or highway-env when it is collected or run.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from datetime import date

import pytest

from pytest_pafot.campaign.options import BY_NAME, OF_COMMAND, OPTIONS, is_ci
from pytest_pafot.plugin import fixtures
from pytest_pafot.plugin.collection import Collection
from pytest_pafot.plugin.marks import ANY_MARK, SAVED_MARK, SEARCH_MARK, is_driven
from pytest_pafot.plugin.option_sources import add_options, resolve
from pytest_pafot.plugin.session import (
    SHARED,
    SUMMARY_LINES,
    Controller,
    Header,
    Shared,
    SummaryLines,
    Worker,
    end_in_order,
    is_worker,
    shared_by_controller,
    stale_day,
)
from pytest_pafot.plugin.unrun import DRIVEN, UNRUN
from pytest_pafot.support.errors import RequestError, flag


def pytest_addoption(parser: pytest.Parser) -> None:
    """Declare the command-line options and ini keys."""
    add_options(parser)


def pytest_configure(config: pytest.Config) -> None:
    """Register the marks, and a separate plugin for each feature that the options turn on."""
    for line in (
        f"{ANY_MARK}: select every test that belongs to pytest-pafot with -m {ANY_MARK}",
        f"{SEARCH_MARK}(**arguments): search for scenarios that break the test; write @pafot.search(...)",
        f"{SAVED_MARK}(saved): replay a saved scenario; set by the plugin",
    ):
        config.addinivalue_line("markers", line)
    config.stash[SUMMARY_LINES] = SummaryLines()
    config.stash[DRIVEN] = set()
    features = {"fixtures": fixtures, "collection": Collection(config)}
    if is_worker(config):
        config.stash[SHARED] = shared_by_controller(config)
        features["worker"] = Worker()
    else:
        shared = config.stash[SHARED] = Shared()
        if asked := config.getoption(BY_NAME["today"].key):
            if is_ci(os.environ):  # where a day may stay in a script for years
                config.stash[SUMMARY_LINES].warnings.extend(stale_day(asked, date.fromisoformat(shared.today)))
            shared.today = asked
        if OF_COMMAND in os.environ:
            _check_that_it_searches(config)
    is_parallel = config.getoption("dist", "no") != "no"
    if config.get_verbosity() > 0:
        features["header"] = Header()
    _register(config, features)
    # A controller of pytest-xdist collects no items, so it cannot wait for a marked one.
    if is_parallel or any(config.getoption(option.key) is not None for option in OPTIONS):
        _report(config)
    if is_parallel:  # last, so that what it takes from workers that have ended comes before the reports
        _register(config, {"controller": Controller()})


def _check_that_it_searches(config: pytest.Config) -> None:
    """Refuse the session of the command ``search`` if its options let it search nothing, which would pass."""
    try:
        settings = resolve(config, {})
    except RequestError:  # its test reports it
        return
    if not settings.is_search:
        given = flag("generations", 0)
        raise pytest.UsageError(f"search: expected a search, received {given}, which asks for none; leave it out")


@pytest.hookimpl(trylast=True)  # after hooks that add marks
def pytest_collection_finish(session: pytest.Session) -> None:
    """Register the plugins that run the marked items and report on them, if there are any."""
    config = session.config
    marked = [item for item in session.items if item.get_closest_marker(ANY_MARK) is not None]
    driven = config.stash[DRIVEN]
    driven.update(item.nodeid for item in session.items if is_driven(item))
    is_marked = bool(marked or driven)
    unrun = config.stash[UNRUN]
    if is_marked or any(unrun):
        _report(config)
    if not is_marked or config.getoption("collectonly"):
        return  # these plugins import the simulation, and an editor that only lists tests would wait for it
    from pytest_pafot.plugin.failure_reports import Failures  # noqa: PLC0415
    from pytest_pafot.plugin.item_checks import Checks, Execution  # noqa: PLC0415

    _register(config, {"checks": Checks(), "execution": Execution(), "failing": Failures()})
    end_in_order(config)


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """Register the reports in a session without marked items that has something to say in its summary."""
    lines = session.config.stash[SUMMARY_LINES]
    if lines.problems or lines.reports:
        _report(session.config)


def _report(config: pytest.Config) -> None:
    """Register the plugins that report on marked items, unless they are registered. A worker only sends messages."""
    if config.pluginmanager.has_plugin("pafot-messages"):
        return
    from pytest_pafot.plugin import messages  # noqa: PLC0415

    features: dict[str, object] = {"messages": messages}
    if not is_worker(config):
        from pytest_pafot.plugin import session_records  # noqa: PLC0415
        from pytest_pafot.plugin.orphans import Guard  # noqa: PLC0415
        from pytest_pafot.plugin.record import Record  # noqa: PLC0415
        from pytest_pafot.plugin.report_pages import Pages  # noqa: PLC0415
        from pytest_pafot.plugin.terminal_reporter import Reporter  # noqa: PLC0415

        record = Record(config)
        features |= {"reporting": Reporter(config, record), "pages": Pages(config, record), "guard": Guard()}
        if session_records.is_asked_for(config, os.environ):
            features["records"] = session_records.Records(config, record)
        features["record"] = record  # last, so that its hooks are called first
    _register(config, features)


def _register(config: pytest.Config, features: Mapping[str, object]) -> None:
    for name, feature in features.items():
        if not config.pluginmanager.has_plugin(f"pafot-{name}"):
            config.pluginmanager.register(feature, f"pafot-{name}")
