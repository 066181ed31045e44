"""The pytest plugin: options, marks, collection, the search loop and its reports.

Sessions without a marked test pay for the light modules imported here and nothing else: everything that needs
numpy, yaml or highway-env is imported when a marked test is collected or run.
"""

from __future__ import annotations

import pytest

from pytest_pafot.plugin import fixtures, header, session
from pytest_pafot.plugin.collection import Collection, accept_files
from pytest_pafot.plugin.marks import ANY_MARK, SAVED_MARK, SEARCH_MARK
from pytest_pafot.plugin.messages import Unseen
from pytest_pafot.plugin.options import add_options
from pytest_pafot.plugin.report_pages import Pages
from pytest_pafot.plugin.terminal_reporter import Reporter, WorkerReporter


def pytest_addoption(parser: pytest.Parser) -> None:
    """Declare the options."""
    add_options(parser)


def pytest_configure(config: pytest.Config) -> None:
    """Register the marks and one plugin object per feature."""
    for line in (
        f"{ANY_MARK}: every test that belongs to pytest-pafot, to select or deselect all of them",
        f"{SEARCH_MARK}(**arguments): search for scenarios that break the test; write @pafot.search(...)",
        f"{SAVED_MARK}(saved): the item replays a saved scenario; set by the plugin",
    ):
        config.addinivalue_line("markers", line)
    session.start(config)
    is_worker = session.is_worker(config)
    accept_files(config)
    features = {
        "fixtures": fixtures,
        "header": header,
        "collection": Collection(config),
        "messages": Unseen(),
        "reporting": WorkerReporter(config) if is_worker else Reporter(config),
    }
    if not is_worker:
        features["sharing"] = session.Sharing(config)
        features["pages"] = Pages(config)
    for name, feature in features.items():
        config.pluginmanager.register(feature, f"pafot-{name}")


def pytest_collection_finish(session: pytest.Session) -> None:
    """Register what runs the items, where there are any."""
    if not any(item.get_closest_marker(name) for item in session.items for name in (SEARCH_MARK, ANY_MARK)):
        return
    from pytest_pafot.plugin.execution import Execution  # noqa: PLC0415
    from pytest_pafot.plugin.failure_reports import Failures  # noqa: PLC0415
    from pytest_pafot.plugin.item_checks import Checks  # noqa: PLC0415

    for name, feature in (("checks", Checks()), ("execution", Execution()), ("failing", Failures())):
        if not session.config.pluginmanager.has_plugin(f"pafot-{name}"):
            session.config.pluginmanager.register(feature, f"pafot-{name}")
