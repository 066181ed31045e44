"""What the items of a session report: one record in the controller, from which all that a session says is written."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from pytest_pafot.plugin import messages
from pytest_pafot.plugin.marks import SAVED_MARK, SEARCH_MARK
from pytest_pafot.plugin.messages import AS_SAVED, Message
from pytest_pafot.plugin.session import SUMMARY_LINES
from pytest_pafot.support.errors import rerun

if TYPE_CHECKING:
    from pytest_pafot.campaign.events import SearchSummary
    from pytest_pafot.findings.sighting import Sighting


class Record:
    """Hooks that collect the messages and the results of items, by the items' node ids.

    They are called before those of what writes, which see what a message has added.
    """

    def __init__(self, config: pytest.Config) -> None:
        self._lines = config.stash[SUMMARY_LINES]
        self.latest: Sighting | None = None  # the one of this message; None if it is about something else
        self.running: dict[str, SearchSummary] = {}  # searches that have begun and not ended
        self.searches: dict[str, SearchSummary] = {}  # in the order in which they ended
        self.unbegun: dict[str, SearchSummary] = {}  # searches whose item failed before they could begin
        self.sightings: dict[str, Sighting] = {}  # what is known now of each finding, new or replayed
        self.unread: dict[str, Mapping[str, str]] = {}  # the entries of saved scenarios that could not be read or run
        self.new: dict[str, Sighting] = {}  # the new findings of searches that have ended, which count their runs
        self.results: dict[str, list[str]] = {}  # of the phases
        self.reasons: dict[str, str] = {}  # the line of the short summary, or the first line of the text
        self.incomparable: dict[str, None] = {}  # items whose policy could not be compared with its reference
        self.warnings: list[str] = []
        self.notes: dict[str, None] = {}  # in the order in which they came

    @property
    def replays(self) -> list[Sighting]:
        """The replays, with what the searches of their tests say about them, in the order in which they ended."""
        from pytest_pafot.campaign.events import by_test, concluded  # noqa: PLC0415

        searches = by_test(self.searches.values())
        replays = (each for each in self.sightings.values() if each.observed is not None)
        return [concluded(each, searches) for each in replays]

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Take the messages of items, and the result of each of their phases."""
        message = messages.received(report)
        if message is None:
            self._take_phase(report)
            return
        self.latest = self._take(report.nodeid, message)

    def _take(self, node_id: str, message: Message) -> Sighting | None:
        from pytest_pafot.campaign.events import SearchSummary  # noqa: PLC0415
        from pytest_pafot.findings.sighting import Sighting  # noqa: PLC0415

        data = message.data
        match message.kind:
            case "start":
                self.running[node_id] = SearchSummary(node_id=node_id, **data)
            case "finding":
                sighting = messages.unpacked(Sighting, data["sighting"])
                earlier = self.sightings.pop(sighting.node_id, None)
                # A search whose new file this session replays as well may have left it unshrunk.
                left = "" if earlier is None or sighting.observed is None else earlier.unshrunk
                self.sightings[sighting.node_id] = replace(sighting, unshrunk=left) if left else sighting
                return sighting
            case "search":
                self.running.pop(node_id, None)
                self.searches.pop(node_id, None)
                self.searches[node_id] = summary = messages.unpacked(SearchSummary, data["summary"])
                self.new.update((each.node_id, each) for each in summary.finds)
            case "incomparable":
                self.incomparable[node_id] = None
            case "warning":
                self.warnings.append(data["text"])
            case "note":
                self.notes[data["text"]] = None
            case "done":
                self._lines.reports.append(data["text"])
            case "problem":
                self._lines.problems.append(data["text"])
        return None

    def _take_phase(self, report: pytest.TestReport) -> None:
        """Take the result of a phase. A saved scenario that failed without a message could not be read or run."""
        node_id = report.nodeid
        when: str = report.when
        if when == "???":  # pytest-xdist: the worker died, so the item has no result and says nothing of itself
            self.reasons.setdefault(node_id, str(report.longrepr))
            return
        if SEARCH_MARK not in report.keywords:
            return
        if when == "call" or not report.passed:  # A setup that passed is not yet a result.
            self.results.setdefault(node_id, []).append(_result(report))
        if not report.failed:
            return
        crash = getattr(report.longrepr, "reprcrash", None)
        text = report.longreprtext if crash is None else str(crash.message).removeprefix("Failed: ")
        self.reasons.setdefault(node_id, next((line.strip() for line in text.splitlines() if line.strip()), ""))
        if node_id in self.sightings:
            return
        if SAVED_MARK in report.keywords:
            saved = json.loads(getattr(report, AS_SAVED))
            again = rerun(["python", "-m", "pytest", saved["file"]], os.environ, saved=saved["id"])
            self.unread.setdefault(node_id, {**saved, "replay": again})
        elif node_id not in self.running and node_id not in self.searches:
            from pytest_pafot.campaign.events import SearchSummary  # noqa: PLC0415

            self.unbegun[node_id] = SearchSummary(node_id=node_id)


def _result(report: pytest.TestReport) -> str:
    """Return the result of a phase from its report: ``passed``, ``skipped``, ``xfailed``, ``failed`` or ``error``."""
    if report.failed:
        return "failed" if report.when == "call" else "error"
    if report.skipped:
        return "xfailed" if hasattr(report, "wasxfail") else "skipped"
    return "passed"
