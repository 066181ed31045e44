"""The report page: what items show is gathered on the controller, and written when the session ends.

Nothing that makes pages is imported before there is one to make.
"""

from __future__ import annotations

import os
import shlex
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from pytest_pafot.campaign.options import BY_NAME, is_page_file
from pytest_pafot.plugin import messages
from pytest_pafot.plugin.marks import SEARCH_MARK
from pytest_pafot.plugin.session import SUMMARY_LINES, SummaryLines

if TYPE_CHECKING:
    from pytest_pafot.campaign.options import Settings
    from pytest_pafot.plugin.page_messages import Showing
    from pytest_pafot.report.page_data import CampaignView, FindingView, Report

ORDER = ("ego", "both", "npc", "none")
"""Of findings by responsibility: what the policy answers for comes first."""


def showing_of(item: pytest.Item, settings: Settings) -> Showing | None:
    """How an item shows what happens; None where nobody asked for it."""
    if settings.report is None and not _has_rows(item.config):
        return None
    from pytest_pafot.plugin.page_messages import Showing  # noqa: PLC0415

    return Showing(item=item, settings=settings)


@dataclass(slots=True, kw_only=True)
class _Page:
    """One page in the making.

    Attributes:
        target: as the option gives it.
        findings: by node id.
        campaigns: by node id.
        replayed: number of replays by label.
        seeds: base seeds of the searches.
    """

    target: str
    findings: dict[str, FindingView] = field(default_factory=dict)
    campaigns: dict[str, CampaignView] = field(default_factory=dict)
    replayed: Counter[str] = field(default_factory=Counter)
    seeds: dict[int, None] = field(default_factory=dict)

    def take(self, data: Mapping[str, Any], finding: FindingView | None, campaign: CampaignView | None) -> None:
        """Add what an item tells."""
        if finding is not None:
            self.findings[finding.node_id] = finding
        if campaign is not None:
            self.campaigns[campaign.node_id] = campaign
            self.seeds[data["base_seed"]] = None
        if "replayed" in data:
            self.replayed[data["replayed"]] += 1

    def facts(self, *, is_interrupted: bool) -> Iterator[tuple[str, str]]:
        """What the page says of the session as a whole."""
        from pytest_pafot.versions import installed_versions  # noqa: PLC0415

        if is_interrupted:
            yield "session", "interrupted; what ran until then is here"
        if self.seeds:
            yield _plural(len(self.seeds), "base seed").partition(" ")[2], ", ".join(map(str, self.seeds))
        if self.replayed:
            labels = ", ".join(f"{count} {label}" for label, count in sorted(self.replayed.items()))
            yield "replayed", f"{_plural(self.replayed.total(), 'saved scenario')}: {labels}"
        yield from installed_versions().items()
        yield "written", datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")


class Pages:
    """Gathers what is shown, on the controller alone."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config
        self._pages: dict[Path, _Page] = {}
        self._rows: dict[str, FindingView] = {}
        self._runs: dict[str, int] = {}
        self._labels: dict[str, str] = {}
        self._targets: dict[str, Path] = {}
        self._failures: dict[tuple[str, str], str] = {}
        self._shown: set[str] = set()

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_logreport(self, report: Any) -> None:
        """Take what items show; add it to the row of an ordinary report."""
        message = messages.received(report)
        if message is not None:
            if message.kind == messages.PAGE:
                self._take(report.nodeid, message.data)
            return
        if report.failed and (SEARCH_MARK in report.keywords or report.nodeid in self._targets):
            self._failures[report.nodeid, report.when] = report.longreprtext
        if report.when == "call" and report.nodeid in self._rows:
            self._add_row(report, self._rows.pop(report.nodeid))

    def pytest_sessionfinish(self, exitstatus: int) -> None:
        """Write the pages, also when the session was interrupted."""
        lines = self._config.stash[SUMMARY_LINES]
        for path, page in self._pages.items():
            with lines.faults(f"--pafot-report={page.target}: not written"):
                report = self._report(path, page, is_interrupted=exitstatus == pytest.ExitCode.INTERRUPTED)
                _write(page.target, path, report, lines)
        asked = self._config.getoption(BY_NAME["report"].key)
        if asked and not self._pages and not self._config.getoption("collectonly", False):
            lines.problems.append(f"--pafot-report={asked}: nothing was written, since no search and no replay ran")

    def _take(self, node_id: str, data: Mapping[str, Any]) -> None:
        from pytest_pafot.report.page_codec import decode  # noqa: PLC0415
        from pytest_pafot.report.page_data import CampaignView, FindingView  # noqa: PLC0415

        finding = decode(FindingView, data["view"]) if "view" in data else None
        campaign = decode(CampaignView, data["campaign"]) if "campaign" in data else None
        if finding is not None:
            self._shown |= {finding.node_id, node_id}  # the search that found it fails for it, too
            if _has_rows(self._config):
                self._rows[finding.node_id] = finding
        if campaign is not None and campaign.reason == "error":
            self._shown.discard(node_id)
        self._runs.update(data.get("runs", {}))
        self._labels.update(data.get("labels", {}))
        target = data["target"]
        if target is not None:
            path = Path(os.path.normpath(self._config.invocation_params.dir / target))
            self._targets[node_id] = path
            self._pages.setdefault(path, _Page(target=target)).take(data, finding, campaign)

    def _report(self, path: Path, page: _Page, *, is_interrupted: bool) -> Report:
        """The content of a page, in an order that does not depend on who was first."""
        from pytest_pafot.report.page_data import Report  # noqa: PLC0415

        findings = _by_test(map(self._completed, page.findings.values()))
        errors = tuple(
            (node_id, told)
            for (node_id, when), told in sorted(self._failures.items())
            # Of items of this page, or that never came to name one, and shown by no finding.
            if self._targets.get(node_id, path) == path and not (when == "call" and node_id in self._shown)
        )
        return Report(
            title=f"{self._config.rootpath.name}: {_counts(findings, errors)}",
            facts=tuple(page.facts(is_interrupted=is_interrupted)),
            command=shlex.join(["pytest", *map(str, self._config.invocation_params.args)]),
            findings=findings,
            campaigns=tuple(page.campaigns[node_id] for node_id in sorted(page.campaigns)),
            errors=errors,
            is_interrupted=is_interrupted,
        )

    def _add_row(self, report: Any, finding: FindingView) -> None:
        from pytest_html import extras  # noqa: PLC0415

        from pytest_pafot.report.page import render_frame  # noqa: PLC0415

        report.extras = [*getattr(report, "extras", ()), extras.html(render_frame(self._completed(finding)))]

    def _completed(self, finding: FindingView) -> FindingView:
        """With what is known only at the end of its search."""
        node_id = finding.node_id
        runs, label = self._runs.get(node_id, finding.runs), self._labels.get(node_id, finding.label)
        return replace(finding, runs=runs, label=label)


def _has_rows(config: pytest.Config) -> bool:
    """Whether pytest-html writes a report."""
    return bool(config.getoption("htmlpath", None))


def _by_test(findings: Iterable[FindingView]) -> tuple[FindingView, ...]:
    """Those of a test together; the test whose first finding comes first is the first."""
    ordered = sorted(findings, key=_rank)
    tests = list(dict.fromkeys(finding.test for finding in ordered))
    return tuple(sorted(ordered, key=lambda finding: tests.index(finding.test)))


def _rank(finding: FindingView) -> tuple[bool, int, int, str]:
    """New before known, by responsibility, the most frequent first."""
    who = ORDER.index(finding.responsibility) if finding.responsibility in ORDER else len(ORDER)
    return not finding.label.startswith(messages.NEW), who, -finding.runs, finding.node_id


def _write(target: str, path: Path, report: Report, lines: SummaryLines) -> None:
    """Write a report to a file or a folder, and tell of it.

    After an interrupt there are no pictures: they take seconds each, a page does not.
    """
    from pytest_pafot.files import write_whole  # noqa: PLC0415
    from pytest_pafot.report.animation import AnimationError  # noqa: PLC0415
    from pytest_pafot.report.folder import PAGE, report_files  # noqa: PLC0415
    from pytest_pafot.report.page import render_page  # noqa: PLC0415

    is_file = is_page_file(target)
    files = iter([("", render_page(report).encode())]) if is_file else report_files(report)
    missing = ", after an interrupt" if report.is_interrupted and not is_file else ""
    pictures = 0
    try:
        for name, content in islice(files, 1 if report.is_interrupted else None):
            write_whole(path / name, content)
            pictures += name.endswith(".png")
    except OSError as error:
        reason = f"{error.strerror or error}: {error.filename or path}"
        lines.problems.append(f"--pafot-report={target}: not written: {reason}; name another place")
        return
    except AnimationError as error:
        missing = f": {error}"
    shown = target if is_file else os.path.join(target, PAGE)  # noqa: PTH118
    more = f", {_plural(pictures, 'moving picture')}" if pictures else ""
    lines.reports.append(f"report: {shown} ({_counts(report.findings, report.errors)}{more})")
    if missing:
        lines.problems.append(f"--pafot-report={target}: the page is there, pictures are not{missing}")


def _counts(findings: Sequence[object], errors: Sequence[object]) -> str:
    """Errors first; without any, findings alone."""
    return ", ".join([*([_plural(len(errors), "error")] if errors else []), _plural(len(findings), "finding")])


def _plural(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"
