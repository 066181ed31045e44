"""The report page of a session: the data from all items are collected, sorted and written to files."""

from __future__ import annotations

import os
import pickle
import re
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import Any

from pytest_pafot.campaign.options import is_page_file
from pytest_pafot.findings.severity import worst_first
from pytest_pafot.report.animation import AnimationError, animate
from pytest_pafot.report.markup import finding_keys
from pytest_pafot.report.page import render_page
from pytest_pafot.report.page_data import NEW, CampaignView, Errors, FindingView, Report
from pytest_pafot.support.files import write_whole
from pytest_pafot.support.text import plural
from pytest_pafot.support.versions import installed_versions
from pytest_pafot.support.ways_out import flag

PAGE = "index.html"

WHOLE = 100
"""The largest number of findings that a page shows whole, the worst ones: each takes about 80 kB of the page."""


@dataclass(slots=True, kw_only=True)
class Draft:
    """The part of a session's report that is known so far; ``--pafot-report`` names the target.

    Findings, searches and details of drifted scenarios are stored by node id, the number of replays by label, and base
    seeds in the order in which they arrived. What only whole findings show of a finding is compressed, because it takes
    half a megabyte, and a session may have thousands.
    """

    target: str
    findings: dict[str, FindingView] = field(default_factory=dict)
    _whole: dict[str, bytes] = field(default_factory=dict)
    campaigns: dict[str, CampaignView] = field(default_factory=dict)
    replayed: Counter[str] = field(default_factory=Counter)
    drifted: dict[str, str] = field(default_factory=dict)
    seeds: dict[int, None] = field(default_factory=dict)

    def take(self, data: Mapping[str, Any], finding: FindingView | None, campaign: CampaignView | None) -> None:
        """Add the data, the finding or the search that an item reports."""
        if finding is not None:
            self.findings[finding.node_id] = _as_row(finding)
            self._whole[finding.node_id] = zlib.compress(pickle.dumps(finding), level=1)
        if campaign is not None:
            self.campaigns[campaign.node_id] = campaign
            self.seeds[data["base_seed"]] = None
        if "replayed" in data:
            self.replayed[data["replayed"]] += 1
        self.drifted.update(data.get("drifted", {}))

    def report(
        self, *, project: str, command: str, findings: Iterable[FindingView], errors: Errors, is_interrupted: bool
    ) -> Report:
        """Return the finished report, in an order that does not depend on which item ran first.

        ``findings`` are the findings of this draft, with what became known at the end of the session. Only the worst
        are whole findings of the report.
        """
        ranked = sorted(findings, key=_rank)
        whole = [self._completed(finding) for finding in ranked[:WHOLE]]
        tests = list(dict.fromkeys(finding.test for finding in whole))
        return Report(
            title=f"{project}: {_counts(ranked, errors)}",
            facts=tuple(self._facts(is_interrupted=is_interrupted)),
            command=command,
            findings=tuple(sorted(whole, key=lambda finding: tests.index(finding.test))),  # groups them by test
            further=tuple(map(_as_row, ranked[WHOLE:])),
            campaigns=tuple(self.campaigns[node_id] for node_id in sorted(self.campaigns)),
            errors=errors,
            is_interrupted=is_interrupted,
        )

    def _completed(self, finding: FindingView) -> FindingView:
        """Return a finding with everything that was compressed of it."""
        packed = self._whole.get(finding.node_id)
        if packed is None:
            return finding
        whole: FindingView = pickle.loads(zlib.decompress(packed))  # noqa: S301  (of this process)
        return replace(whole, runs=finding.runs, label=finding.label)

    def _facts(self, *, is_interrupted: bool) -> Iterator[tuple[str, str]]:
        if is_interrupted:
            yield "session", "interrupted; this report has what ran before that"
        if self.seeds:
            yield "base seed" if len(self.seeds) == 1 else "base seeds", ", ".join(map(str, self.seeds))
        if self.replayed:
            labels = ", ".join(f"{count} {label}" for label, count in sorted(self.replayed.items()))
            yield "replayed", f"{plural(self.replayed.total(), 'saved scenario')}: {labels}"
        for node_id, detail in sorted(self.drifted.items()):
            yield "drifted", f"{node_id}: {detail}"
        yield from installed_versions().items()
        yield "written", datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")


def write_report(target: str, path: Path, report: Report) -> tuple[str, str]:
    """Write a report to a path; return a line on what was written, and a line on problems.

    The path is the absolute path of ``target``, the user's text. The second line is empty if there is no problem. After
    an interrupt there are no pictures, because each picture takes seconds and a page does not.

    Raises:
        OSError: if a file cannot be written.
    """
    is_file = is_page_file(target)
    files = iter([("", render_page(report).encode())]) if is_file else report_files(report)
    missing = ", after an interrupt" if report.is_interrupted and not is_file else ""
    pictures = 0
    try:
        for name, content in islice(files, 1 if report.is_interrupted else None):
            write_whole(path / name, content)
            pictures += name.endswith(".png")
    except AnimationError as error:
        missing = f": {error}"
    shown = target if is_file else os.path.join(target, PAGE)  # noqa: PTH118
    more = f", {plural(pictures, 'moving picture')}" if pictures else ""
    problem = f"{flag('report', target)}: the page was written, but not all pictures{missing}" if missing else ""
    found = (*report.findings, *report.further)
    return f"report: {shown} ({_counts(found, report.errors)}{more})", problem


def report_files(report: Report) -> Iterator[tuple[str, bytes]]:
    """Yield the files of a report in a folder: the page, then an animation of each run that the page shows.

    Raises:
        AnimationError: if there is a run to draw and Pillow is missing; the page has been yielded by then.
    """
    yield PAGE, render_page(report).encode()
    for key, finding in zip(finding_keys(report.findings), report.findings, strict=True):
        if finding.times:
            yield re.sub(r"[^A-Za-z0-9._-]", "_", key) + ".png", animate(finding)


def _as_row(finding: FindingView) -> FindingView:
    """Return a finding without what only a whole finding shows: its run, and the text of its file."""
    check = None if finding.check is None else replace(finding.check, values=(), broken=())
    road = replace(finding.road, lanes=(), shapes=())
    nothing: dict[str, Any] = dict.fromkeys(("vehicles", "times", "instructions", "grid"), ())
    return replace(finding, explanation="", yaml="", drive=None, shrink=None, check=check, road=road, **nothing)


def _rank(finding: FindingView) -> tuple[Any, ...]:
    """Return the key that sorts findings: new before known, then by responsibility, severity and number of runs."""
    worst = worst_first(finding.responsibility, finding.severity)
    return not finding.label.startswith(NEW), *worst, -finding.runs, finding.node_id


def _counts(findings: Sequence[object], errors: Sequence[object]) -> str:
    """Return the number of errors, if there are any, and of findings, in words."""
    found = plural(len(findings), "finding")
    return f"{plural(len(errors), 'error')}, {found}" if errors else found
