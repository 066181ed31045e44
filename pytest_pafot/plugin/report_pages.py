"""The report page: the controller gathers what items send, and writes the page when the session ends.

The modules that make pages are imported only when there is a page to make.
"""

from __future__ import annotations

import os
import zlib
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from pytest_pafot.campaign.options import BY_NAME
from pytest_pafot.plugin.marks import SEARCH_MARK
from pytest_pafot.plugin.messages import Message, received, unpacked
from pytest_pafot.plugin.option_sources import value_if_right
from pytest_pafot.plugin.record import Record
from pytest_pafot.plugin.session import SUMMARY_LINES, exit_code, not_written
from pytest_pafot.support.errors import flag, rerun

if TYPE_CHECKING:
    from pytest_pafot.findings.sighting import Sighting
    from pytest_pafot.report.page import RunView


class Pages:
    """Hooks that collect the content of the report page and write the page, only on the controller."""

    def __init__(self, config: pytest.Config, record: Record) -> None:
        self._config = config
        self._record = record
        self._target: str | None = value_if_right(config, "report")  # the page, as the user has named it
        self._has_content = False
        self._views: dict[str, bytes] = {}  # of findings by node id; compressed, as each takes half a megabyte
        self._failures: dict[tuple[str, str], str] = {}
        self._shown: set[str] = set()

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Store what items send for the page."""
        message = received(report)
        if message is not None:
            if message.kind in ("finding", "search"):
                self._take(report.nodeid, message)
        elif report.failed and SEARCH_MARK in report.keywords:
            self._failures[report.nodeid, report.when] = report.longreprtext

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Write the report page, even if the session was interrupted."""
        lines, target = self._config.stash[SUMMARY_LINES], self._target
        asked, is_listed = self._config.getoption(BY_NAME["report"].key), self._config.getoption("collectonly", False)
        if target is not None and self._has_content:
            with lines.faults(f"{flag('report', target)}: not written"):
                self._write(target, is_interrupted=exit_code(session) == pytest.ExitCode.INTERRUPTED)
        elif asked and not is_listed:
            lines.problems.append(f"{flag('report', asked)}: nothing was written, since no search and no replay ran")

    def _take(self, node_id: str, message: Message) -> None:
        """Store what a finding or a search sends for the page."""
        from pytest_pafot.campaign.events import Ending  # noqa: PLC0415

        self._has_content, found = True, self._record.latest
        if found is not None and "view" in message.data:
            self._views[found.node_id] = zlib.compress(message.data["view"].encode(), level=1)
            self._shown |= {found.node_id, node_id}  # the search that found it fails because of it, too
        if message.kind == "search" and self._record.searches[node_id].reason is Ending.ERROR:
            self._shown.discard(node_id)

    def _write(self, target: str, *, is_interrupted: bool) -> None:
        from pytest_pafot.campaign.events import Ending  # noqa: PLC0415
        from pytest_pafot.report import page  # noqa: PLC0415

        record, path = self._record, Path(os.path.normpath(self._config.invocation_params.dir / target))
        errors = tuple(
            (node_id, text)
            for (node_id, when), text in sorted(self._failures.items())
            if not (when == "call" and node_id in self._shown)  # a failure that a finding shows already
        )
        found = sorted((record.new.get(node_id) or record.sightings[node_id] for node_id in self._views), key=page.rank)
        searches = [each for _, each in sorted(record.searches.items()) if each.reason is not Ending.REPLAYS]
        report = page.Report(
            title=f"{self._config.rootpath.name}: {page.numbers(len(found), len(errors))}",
            facts=tuple(page.session_facts(searches, record.replays)),
            command=rerun(["pytest", *map(str, self._config.invocation_params.args)], os.environ),
            findings=page.by_test(list(map(self._view, found[: page.WHOLE]))),
            further=tuple(found[page.WHOLE :]),
            searches=tuple(searches),
            errors=errors,
            is_interrupted=is_interrupted,
        )
        lines = self._config.stash[SUMMARY_LINES]
        problem = not_written(
            self._config, target, path.parent, lambda: lines.reports.append(page.write_report(target, path, report))
        )
        if problem:
            lines.problems.append(f"{flag('report', target)}: not written: {problem}")

    def _view(self, sighting: Sighting) -> RunView:
        """Return the view of a finding with its number of runs and its label, which are known only at the end."""
        from pytest_pafot.campaign.events import by_test  # noqa: PLC0415
        from pytest_pafot.plugin.finding_message import label_of  # noqa: PLC0415
        from pytest_pafot.report.page import RunView  # noqa: PLC0415

        view = unpacked(RunView, zlib.decompress(self._views[sighting.node_id]).decode())
        if sighting.node_id in self._record.new:
            return replace(view, runs=1 + sighting.repeats, label=label_of(sighting), sighting=sighting)
        search = by_test(self._record.searches.values()).get(sighting.test)
        return replace(view, runs=1 if search is None else search.known.get(sighting.id, 1), sighting=sighting)
