"""The report page of a session: the data from all items are collected, sorted and written to files."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
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

PAGE = "index.html"


@dataclass(slots=True, kw_only=True)
class Draft:
    """The part of a session's report that is known so far; ``--pafot-report`` names the target.

    Findings, searches and details of drifted scenarios are stored by node id, the number of replays by label, and base
    seeds in the order in which they arrived.
    """

    target: str
    findings: dict[str, FindingView] = field(default_factory=dict)
    campaigns: dict[str, CampaignView] = field(default_factory=dict)
    replayed: Counter[str] = field(default_factory=Counter)
    drifted: dict[str, str] = field(default_factory=dict)
    seeds: dict[int, None] = field(default_factory=dict)

    def take(self, data: Mapping[str, Any], finding: FindingView | None, campaign: CampaignView | None) -> None:
        """Add the data, the finding or the search that an item reports."""
        if finding is not None:
            self.findings[finding.node_id] = finding
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

        ``findings`` are the findings of this draft, with what became known at the end of the session.
        """
        ranked = sorted(findings, key=_rank)
        tests = list(dict.fromkeys(finding.test for finding in ranked))
        ordered = tuple(sorted(ranked, key=lambda finding: tests.index(finding.test)))  # groups them by test
        return Report(
            title=f"{project}: {_counts(ordered, errors)}",
            facts=tuple(self._facts(is_interrupted=is_interrupted)),
            command=command,
            findings=ordered,
            campaigns=tuple(self.campaigns[node_id] for node_id in sorted(self.campaigns)),
            errors=errors,
            is_interrupted=is_interrupted,
        )

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
    problem = f"--pafot-report={target}: the page was written, but not all pictures{missing}" if missing else ""
    return f"report: {shown} ({_counts(report.findings, report.errors)}{more})", problem


def report_files(report: Report) -> Iterator[tuple[str, bytes]]:
    """Yield the files of a report in a folder, by name and content: the page, then an animation of each recorded run.

    Raises:
        AnimationError: if there is a run to draw and Pillow is missing; the page has been yielded by then.
    """
    yield PAGE, render_page(report).encode()
    for key, finding in zip(finding_keys(report.findings), report.findings, strict=True):
        if finding.times:
            yield re.sub(r"[^A-Za-z0-9._-]", "_", key) + ".png", animate(finding)


def _rank(finding: FindingView) -> tuple[Any, ...]:
    """Return the key that sorts findings: new before known, then by responsibility, severity and number of runs."""
    worst = worst_first(finding.responsibility, finding.severity)
    return not finding.label.startswith(NEW), *worst, -finding.runs, finding.node_id


def _counts(findings: Sequence[object], errors: Sequence[object]) -> str:
    """Return the number of errors, if there are any, and of findings, in words."""
    found = plural(len(findings), "finding")
    return f"{plural(len(errors), 'error')}, {found}" if errors else found
