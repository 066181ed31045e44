"""The data that pytest-xdist's controller and workers exchange when a worker starts and ends."""

from __future__ import annotations

import json
from queue import Queue
from typing import Any

import pytest

from pytest_pafot.corpus.layout import SEARCH_PART, around
from pytest_pafot.plugin.collection import SAVED_PART
from pytest_pafot.plugin.session import INVENTORY, SHARED, Inventory, end_in_order

KEY = "pafot"  # the key of this plugin's data in the input and the output of a worker


class _KeptEvents(Queue[Any]):
    """A queue that keeps an event until the next one is requested, so that an interrupt does not lose it."""

    is_begun = False  # whether the first event has been handed out

    def _qsize(self) -> int:
        return len(self.queue) - self.is_begun

    def _get(self) -> Any:
        if self.is_begun:
            self.queue.popleft()
        self.is_begun = True
        return self.queue[0]


class Controller:
    """Hooks for pytest-xdist's controller."""

    _last: pytest.TestReport | None = None  # the last report that all plugins have received

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionstart(self, session: pytest.Session) -> None:
        controller = session.config.pluginmanager.get_plugin("dsession")
        if controller is not None:
            # An interrupt between taking an event and handling it would lose the event.
            controller.queue = _KeptEvents()

    @pytest.hookimpl(trylast=True)
    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self._last = report

    @pytest.hookimpl(optionalhook=True)
    def pytest_configure_node(self, node: Any) -> None:
        node.workerinput[KEY] = dict(vars(node.config.stash[SHARED]))

    @pytest.hookimpl(optionalhook=True)
    def pytest_xdist_node_collection_finished(self, node: Any, ids: list[str]) -> None:
        """Store the saved scenarios that the first workers collected, so that later workers collect the same ones."""
        shared = node.config.stash[SHARED]
        if shared.frozen is None:
            # With --dist=loadgroup, pytest-xdist appends the name of the group.
            names = [node_id[: node_id.rfind("]") + 1] for node_id in ids]
            shared.frozen = frozenset(name for name in names if SAVED_PART in name)
            if shared.frozen or any(around(SEARCH_PART, name) for name in names):
                end_in_order(node.config)

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node: Any, error: object) -> None:
        output = getattr(node, "workeroutput", {}).get(KEY)
        if output is None:  # the worker died
            return
        for known, other in zip(node.config.stash[INVENTORY], json.loads(output), strict=True):
            known.update(other)

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Report the results that an interrupted controller has received but not yet handled."""
        # All workers have ended by now, so no more events come.
        controller = session.config.pluginmanager.get_plugin("dsession")
        if controller is None:
            return
        for event, data in tuple(controller.queue.queue):
            if event == "testreport" and data["rep"] is not self._last:
                session.config.hook.pytest_runtest_logreport(report=data["rep"])


class Worker:
    """Hooks for a pytest-xdist worker."""

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Send the collected items to the controller."""
        inventory: Inventory = session.config.stash[INVENTORY]
        # JSON in ASCII, because file names may contain invalid characters. pytest-xdist cannot send these: it would
        # replace the worker, and the new one would fail in the same way.
        output = json.dumps([sorted(each) for each in inventory])
        session.config.workeroutput[KEY] = output  # type: ignore[attr-defined]
