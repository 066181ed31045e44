"""The item's side of a report page: what is to be seen of a find, of a replay and of a search, told as it happens.

Imported only where a page is asked for, or a row in the report of pytest-html.
"""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import pytest

from pytest_pafot.campaign.recorder import what_happened
from pytest_pafot.campaign.simplification import speed_sentences
from pytest_pafot.corpus.yaml_text import text_of
from pytest_pafot.plugin import messages
from pytest_pafot.plugin.messages import PAGE
from pytest_pafot.report.campaign_view import campaign_view
from pytest_pafot.report.finding_view import finding_view, shrink_view
from pytest_pafot.report.page_codec import encode
from pytest_pafot.report.page_data import NEW
from pytest_pafot.searching.events import Event

if TYPE_CHECKING:
    from pytest_pafot.campaign.options import Settings
    from pytest_pafot.campaign.summary import Find
    from pytest_pafot.campaign.verdict import Verdict
    from pytest_pafot.findings.finding import Finding
    from pytest_pafot.report.page_data import FindingView, ShrinkView
    from pytest_pafot.run import Run
    from pytest_pafot.trace import Trace


def shrink_of(finding: Finding) -> ShrinkView | None:
    """What shrinking came to; None for a finding that was not shrunk."""
    if finding.shrunk is None:
        return None
    first = finding.original or finding.scenario
    return shrink_view(first, finding.scenario, rollouts=finding.shrunk.rollouts, notes=speed_sentences(finding))


def label_of(find: Find) -> str:
    """What a page calls a find."""
    return f"{NEW} ({find.remark})" if find.remark else NEW


@dataclass(slots=True, kw_only=True)
class Showing:
    """What one item shows.

    Attributes:
        item: that runs.
        settings: of it; they name the page.
        events: of the search so far.
        responsibilities: of its runs.
    """

    item: pytest.Item
    settings: Settings
    events: list[Event] = field(default_factory=list)
    responsibilities: Counter[str] = field(default_factory=Counter)

    def judging(self, judge: Callable[[Run], Verdict]) -> Callable[[Run], Verdict]:
        """A judge who also notes what the page says of all runs together."""

        def judged(run: Run) -> Verdict:
            __tracebackhide__ = True
            verdict = judge(run)
            self.responsibilities[run.responsibility or "none"] += 1
            return verdict

        return judged

    def noted(self, events: Iterable[Event]) -> Iterator[Event]:
        """The same events, which are kept for the end of the search."""
        for event in events:
            self.events.append(event)
            yield event

    def find(
        self,
        find: Find,
        finding: Finding,
        trace: Trace | None,
        *,
        tried: Sequence[str] = (),
    ) -> None:
        """Show a find. Telling it again, when more is known of it, replaces what was told.

        Args:
            find: as the terminal tells it.
            finding: as it is kept.
            trace: of a run of the scenario in ``finding``; None where nobody saw how it ended.
            tried: reference drivers that were tried.
        """
        view = finding_view(
            trace,
            finding,
            node_id=find.node_id,
            yaml=text_of(finding),
            headline=find.headline,
            preventable_tried=tried,
            shrink=shrink_of(finding),
        )
        command = view.command if find.path else self._search_command()
        self._show(replace(view, label=label_of(find), path=find.path, command=command))

    def replayed(self, finding: Finding, run: Run, verdict: Verdict, *, label: str, path: str) -> None:
        """Count a replay of a saved scenario, and show it where it fails."""
        if verdict.failed:
            self._show_replay(finding, run.trace, what_happened(run, verdict), label, path)
        else:
            self._tell(replayed=label)

    def lost(self, finding: Finding, headline: str, *, label: str, path: str) -> None:
        """The same for one whose process did not come back."""
        self._show_replay(finding, None, headline, label, path)

    def _show_replay(self, finding: Finding, trace: Trace | None, headline: str, label: str, path: str) -> None:
        self._tell(replayed=label)
        view = finding_view(
            trace,
            finding,
            node_id=self.item.nodeid,
            yaml=text_of(finding),
            headline=headline,
            shrink=shrink_of(finding),
        )
        accepted = "" if finding.xfail is None else f", accepted: {finding.xfail}"
        self._show(replace(view, label=f"{label}{accepted}", path=path))

    def searched(self, finds: Iterable[Find], known: Mapping[str, int], speed_limit: float, cut_by: str) -> None:
        """Show the search, and what is known at its end of the finds.

        Args:
            finds: of the search.
            known: failing runs of the search by the node id of the saved scenario that covers them.
            speed_limit: of its world [m/s].
            cut_by: ``error`` or ``interrupted`` where that ended it; else empty.
        """
        finds = tuple(finds)
        campaign = campaign_view(
            self.item.nodeid,
            self.events,
            speed_limit=speed_limit,
            responsibilities=self.responsibilities,
            cut_by=cut_by,
        )
        self._tell(
            campaign=encode(campaign),
            runs={find.node_id: 1 + find.repeats for find in finds} | dict(known),
            labels={find.node_id: label_of(find) for find in finds},
            base_seed=self.settings.seed,
        )

    def _search_command(self) -> str:
        """By which a find that lies in no file is found again."""
        settings = self.settings
        node_id = shlex.quote(self.item.nodeid)
        return f"pytest {node_id} --pafot-generations={settings.generations} --pafot-seed={settings.seed}"

    def _show(self, view: FindingView) -> None:
        self._tell(view=encode(view))

    def _tell(self, **data: object) -> None:
        messages.send(self.item, PAGE, {"target": self.settings.report, **data})
