"""The sender of a report page's content: a running item sends its findings, replays and searches as they happen.

This module is imported only if a page, or a row in the report of pytest-html, is requested.
"""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass, field, replace

import pytest

from pytest_pafot.campaign.events import Find, FindTold, Judged, Progress, SearchEvent, SearchStarted, SearchSummary
from pytest_pafot.campaign.options import Settings
from pytest_pafot.findings.finding import Finding
from pytest_pafot.findings.severity import Severity
from pytest_pafot.model.trace import Trace
from pytest_pafot.oracle.checks import Check, CheckFailed
from pytest_pafot.plugin import messages, node_ids
from pytest_pafot.plugin.messages import PAGE
from pytest_pafot.report.page_data import NEW
from pytest_pafot.report.views import CampaignCounts, finding_view
from pytest_pafot.searching.plain import plain
from pytest_pafot.support.ways_out import rerun


def label_of(find: Find) -> str:
    """Return the label of a new finding on a page."""
    return f"{NEW} ({find.remark})" if find.remark else NEW


@dataclass(slots=True, kw_only=True)
class PageMessages:
    """A sender of everything that the report page shows of one item, which is a search or a replay."""

    item: pytest.Item  # the running item
    settings: Settings  # the item's settings, which name the page
    counts: CampaignCounts = field(default_factory=CampaignCounts)  # of the events of the search's algorithm
    responsibilities: Counter[str] = field(default_factory=Counter)  # number of runs by responsibility for a collision
    speed_limit: float = 0.0  # the speed limit in the search's world [m/s]

    def __call__(self, event: SearchEvent) -> None:
        """Process an event of a search."""
        match event:
            case SearchStarted():
                self.speed_limit = event.speed_limit
            case Judged():
                self.responsibilities[event.run.responsibility or "none"] += 1
            case FindTold():
                self._find(event)
            case SearchSummary():
                if self.counts.started is not None:  # otherwise the item only replayed
                    self._searched(event)
            case Progress():
                pass
            case _:
                self.counts.see(event)

    def _find(self, told: FindTold) -> None:
        """Send a new finding, or replace it on the page when more is known about it."""
        find, finding = told.find, told.finding
        view = finding_view(
            None if told.run is None else told.run.trace,
            finding,
            node_id=find.node_id,
            headline=find.headline,
            check=told.exception.check if isinstance(told.exception, CheckFailed) else None,
        )
        command = rerun(["pytest", find.node_id], os.environ, saved=find.id)
        if not find.path:  # An unsaved finding can only be reproduced by its search.
            command = rerun(["pytest", self.item.nodeid], os.environ, *self.settings.repeated)
        view = replace(view, label=label_of(find), severity=find.severity, path=find.path, command=command)
        self._tell(view=plain(view))

    def _searched(self, summary: SearchSummary) -> None:
        """Send the finished search, and what is known about its findings only now."""
        campaign = self.counts.view(
            self.item.nodeid,
            speed_limit=self.speed_limit,
            responsibilities=self.responsibilities,
            cut_by=summary.reason if summary.reason in ("error", "interrupted") else "",
        )
        known = {node_ids.saved_node_id(self.item, id_): count for id_, count in summary.known.items()}
        self._tell(
            campaign=plain(campaign),
            runs={find.node_id: 1 + find.repeats for find in summary.finds} | known,
            labels={find.node_id: label_of(find) for find in summary.finds},
            base_seed=self.settings.seed,
        )

    def replayed(
        self,
        finding: Finding,
        trace: Trace | None,
        *,
        headline: str,
        label: str,
        detail: str,
        path: str,
        check: Check | None = None,
        severity: Severity | None = None,
    ) -> None:
        """Send the replay of a saved scenario. The page counts it, and shows a picture if it fails.

        Args:
            finding: the finding in the file.
            trace: the trace of the replay; None if its process died or hung.
            headline: how the replay failed; empty if it passes.
            label: the label of the replay, such as ``still failing``.
            detail: what differs from the file.
            path: the path of the file.
            check: the check that failed; None if no check failed.
            severity: how bad the failure is; None without a measure.
        """
        self._tell(replayed=label, drifted={self.item.nodeid: detail} if label == "drifted" else {})
        if headline:
            view = finding_view(trace, finding, node_id=self.item.nodeid, headline=headline, check=check)
            accepted = f", accepted: {finding.accepted}" if finding.accepted else ""
            again = rerun(["pytest", self.item.nodeid], os.environ, saved=finding.id)
            view = replace(view, label=f"{label}{accepted}", severity=severity, path=path, command=again)
            self._tell(view=plain(view))

    def _tell(self, **data: object) -> None:
        messages.send(self.item, PAGE, {"target": self.settings.report, **data})
