"""The report page: the controller gathers what items send, and writes the page when the session ends.

The modules that make pages are imported only when there is a page to make.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from pytest_pafot.campaign.options import BY_NAME
from pytest_pafot.plugin.marks import SEARCH_MARK
from pytest_pafot.plugin.messages import Message, received, unpacked
from pytest_pafot.plugin.record import Record
from pytest_pafot.plugin.session import SUMMARY_LINES, exit_code, not_written
from pytest_pafot.support.errors import flag, rerun

if TYPE_CHECKING:
    from pytest_pafot.report.page import Draft
    from pytest_pafot.report.page_data import RunView


class Pages:
    """Hooks that collect the content of report pages and write the pages, only on the controller."""

    def __init__(self, config: pytest.Config, record: Record) -> None:
        self._config = config
        self._record = record
        self._drafts: dict[Path, Draft] = {}
        self._targets: dict[str, Path] = {}
        self._failures: dict[tuple[str, str], str] = {}
        self._shown: set[str] = set()

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Store what items send for the page."""
        message = received(report)
        if message is not None:
            if "target" in message.data:  # of a finding or a search whose item asks for a page
                self._take(report.nodeid, message)
            return
        if report.failed and (SEARCH_MARK in report.keywords or report.nodeid in self._targets):
            self._failures[report.nodeid, report.when] = report.longreprtext

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Write the report pages, even if the session was interrupted."""
        lines, is_interrupted = self._config.stash[SUMMARY_LINES], exit_code(session) == pytest.ExitCode.INTERRUPTED
        for path, draft in self._drafts.items():
            with lines.faults(f"{flag('report', draft.target)}: not written"):
                self._write(path, draft, is_interrupted=is_interrupted)
        asked, is_listed = self._config.getoption(BY_NAME["report"].key), self._config.getoption("collectonly", False)
        if asked and not (self._drafts or is_listed):
            lines.problems.append(f"{flag('report', asked)}: nothing was written, since no search and no replay ran")

    def _take(self, node_id: str, message: Message) -> None:
        """Store what a finding or a search sends for the page."""
        from pytest_pafot.campaign.events import Ending  # noqa: PLC0415
        from pytest_pafot.report.page import Draft  # noqa: PLC0415
        from pytest_pafot.report.page_data import RunView  # noqa: PLC0415

        data = message.data
        finding = replace(unpacked(RunView, data["view"]), sighting=self._record.latest) if "view" in data else None
        if finding is not None:
            self._shown |= {finding.node_id, node_id}  # the search that found it fails because of it, too
        if message.kind == "search" and self._record.searches[node_id].reason is Ending.ERROR:
            self._shown.discard(node_id)
        path = Path(os.path.normpath(self._config.invocation_params.dir / data["target"]))
        self._targets[node_id] = path
        draft = self._drafts.setdefault(path, Draft(target=data["target"]))
        if finding is not None:
            draft.take(finding)

    def _write(self, path: Path, draft: Draft, *, is_interrupted: bool) -> None:
        from pytest_pafot.campaign.events import Ending  # noqa: PLC0415
        from pytest_pafot.report.page import write_report  # noqa: PLC0415

        errors = tuple(
            (node_id, text)
            for (node_id, when), text in sorted(self._failures.items())
            # Errors of this page's items, and of items that failed before they named a page; not failures that a
            # finding shows already.
            if self._targets.get(node_id, path) == path and not (when == "call" and node_id in self._shown)
        )
        report = draft.report(
            project=self._config.rootpath.name,
            command=rerun(["pytest", *map(str, self._config.invocation_params.args)], os.environ),
            findings=map(self._completed, draft.findings.values()),
            errors=errors,
            is_interrupted=is_interrupted,
            searches=[
                each
                for each in self._record.searches.values()
                if self._targets.get(each.node_id) == path and each.reason is not Ending.REPLAYS
            ],
            replays=[each for each in self._record.replays if self._targets.get(each.node_id) == path],
        )
        lines = self._config.stash[SUMMARY_LINES]
        problem = not_written(
            self._config,
            draft.target,
            path.parent,
            lambda: lines.reports.append(write_report(draft.target, path, report)),
        )
        if problem:
            lines.problems.append(f"{flag('report', draft.target)}: not written: {problem}")

    def _completed(self, finding: RunView) -> RunView:
        """Return a finding with its number of runs and its label, which are known only at the end of its search."""
        from pytest_pafot.campaign.events import by_test  # noqa: PLC0415
        from pytest_pafot.plugin.finding_message import label_of  # noqa: PLC0415

        new, replay = (each.get(finding.node_id) for each in (self._record.new, self._record.sightings))
        if new is not None:
            return replace(finding, runs=1 + new.repeats, label=label_of(new), sighting=new)
        search = None if replay is None else by_test(self._record.searches.values()).get(replay.test)
        return finding if search is None else replace(finding, runs=search.known.get(finding.id, finding.runs))
