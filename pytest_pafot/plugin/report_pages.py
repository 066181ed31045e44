"""The report page: what items show is gathered on the controller, and written when the session ends.

Nothing that makes pages is imported before there is one to make.
"""

from __future__ import annotations

import os
import shlex
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from pytest_pafot.campaign.options import BY_NAME, is_page_file
from pytest_pafot.plugin import messages
from pytest_pafot.plugin.marks import SEARCH_MARK

if TYPE_CHECKING:
    from pytest_pafot.campaign.options import Settings
    from pytest_pafot.plugin.page_messages import Showing
    from pytest_pafot.report.page_data import CampaignView, FindingView, Report

ORDER = ("ego", "both", "npc", "none")
"""Of findings by responsibility: what the policy answers for comes first."""

Line = tuple[str, bool]
"""A line for the summary of the session, and whether it is a problem."""

LINES = pytest.StashKey[list[Line]]()


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

    def take(self, message: Mapping[str, Any], finding: FindingView | None) -> None:
        """Add what an item tells."""
        if finding is not None:
            self.findings[finding.node_id] = finding
        if "replayed" in message:
            self.replayed[message["replayed"]] += 1
        if "campaign" in message:
            from pytest_pafot.report.page_codec import decode  # noqa: PLC0415
            from pytest_pafot.report.page_data import CampaignView  # noqa: PLC0415

            campaign = decode(CampaignView, message["campaign"])
            self.campaigns[campaign.node_id] = campaign
            self.seeds[message["base_seed"]] = None

    def report(
        self,
        config: pytest.Config,
        completed: Callable[[FindingView], FindingView],
        errors: tuple[tuple[str, str], ...],
        *,
        is_interrupted: bool,
    ) -> Report:
        """The content, in an order that does not depend on who was first.

        Args:
            config: of the session.
            completed: adds what is known of a finding by now.
            errors: node ids of what failed by no finding, and what pytest shows of it.
            is_interrupted: whether the session was.
        """
        from pytest_pafot.report.page_data import Report  # noqa: PLC0415

        findings = _by_test(map(completed, self.findings.values()))
        return Report(
            title=f"{config.rootpath.name}: {_counts(findings, errors)}",
            facts=tuple(self._facts(is_interrupted=is_interrupted)),
            command=shlex.join(["pytest", *map(str, config.invocation_params.args)]),
            findings=findings,
            campaigns=tuple(self.campaigns[node_id] for node_id in sorted(self.campaigns)),
            errors=errors,
            is_interrupted=is_interrupted,
        )

    def _facts(self, *, is_interrupted: bool) -> Iterator[tuple[str, str]]:
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
        config.stash[LINES] = []

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_logreport(self, report: Any) -> None:
        """Take what items show; add it to the row of an ordinary report."""
        message = messages.received(report)
        if message is not None and message["kind"] == messages.PAGE:
            self._take(report.nodeid, message)
            return
        if report.failed and (SEARCH_MARK in report.keywords or report.nodeid in self._targets):
            self._failures[report.nodeid, report.when] = report.longreprtext
        if report.when == "call" and report.nodeid in self._rows:
            self._add_row(report, self._rows.pop(report.nodeid))

    def pytest_sessionfinish(self, exitstatus: int) -> None:
        """Write the pages, also when the session was interrupted."""
        lines = self._config.stash[LINES]
        is_interrupted = exitstatus == pytest.ExitCode.INTERRUPTED
        for path, page in self._pages.items():
            with messages.faults_told(self._tell_problem, f"--pafot-report={page.target}: not written"):
                errors = self._errors(path)
                report = page.report(self._config, self._completed, errors, is_interrupted=is_interrupted)
                lines += _written(page.target, path, report, has_pictures=not is_interrupted)
        asked = self._config.getoption(BY_NAME["report"].key)
        if asked and not self._pages and not self._config.getoption("collectonly", False):
            lines.append((f"--pafot-report={asked}: nothing was written, since no search and no replay ran", True))

    def _tell_problem(self, text: str) -> None:
        self._config.stash[LINES].append((text, True))

    def _errors(self, path: Path) -> tuple[tuple[str, str], ...]:
        """What failed in items of a page, or in items that never came to name one, and is shown by no finding."""
        return tuple(
            (node_id, told)
            for (node_id, when), told in sorted(self._failures.items())
            if self._targets.get(node_id, path) == path and not (when == "call" and node_id in self._shown)
        )

    def _take(self, node_id: str, message: Mapping[str, Any]) -> None:
        finding = _finding(message)
        if finding is not None and _has_rows(self._config):
            self._rows[finding.node_id] = finding
        if finding is not None:
            self._shown |= {finding.node_id, node_id}  # the search that found it fails for it, too
        if "campaign" in message and message["campaign"]["reason"] == "error":
            self._shown.discard(node_id)
        self._runs.update(message.get("runs", {}))
        self._labels.update(message.get("labels", {}))
        target = message["target"]
        if target is not None:
            path = Path(os.path.normpath(self._config.invocation_params.dir / target))
            self._targets[node_id] = path
            self._pages.setdefault(path, _Page(target=target)).take(message, finding)

    def _add_row(self, report: Any, finding: FindingView) -> None:
        from pytest_html import extras  # noqa: PLC0415

        from pytest_pafot.report.page import render_frame  # noqa: PLC0415

        report.extras = [*getattr(report, "extras", ()), extras.html(render_frame(self._completed(finding)))]

    def _completed(self, finding: FindingView) -> FindingView:
        """With what is known only at the end of its search."""
        return replace(
            finding,
            runs=self._runs.get(finding.node_id, finding.runs),
            label=self._labels.get(finding.node_id, finding.label),
        )


def _has_rows(config: pytest.Config) -> bool:
    """Whether pytest-html writes a report."""
    return bool(config.getoption("htmlpath", None))


def _finding(message: Mapping[str, Any]) -> FindingView | None:
    if "view" not in message:
        return None
    from pytest_pafot.report.page_codec import decode  # noqa: PLC0415
    from pytest_pafot.report.page_data import FindingView  # noqa: PLC0415

    return decode(FindingView, message["view"])


def _by_test(findings: Iterable[FindingView]) -> tuple[FindingView, ...]:
    """Those of a test together; the test whose first finding comes first is the first."""
    ordered = sorted(findings, key=_place)
    tests = list(dict.fromkeys(finding.test for finding in ordered))
    return tuple(sorted(ordered, key=lambda finding: tests.index(finding.test)))


def _place(finding: FindingView) -> tuple[bool, int, int, str]:
    """New before known, by responsibility, the most frequent first."""
    who = ORDER.index(finding.responsibility) if finding.responsibility in ORDER else len(ORDER)
    return not finding.label.startswith(messages.NEW), who, -finding.runs, finding.node_id


def _written(target: str, path: Path, report: Report, *, has_pictures: bool) -> list[Line]:
    """Write a report to a file or a folder; what to tell of it. Pictures take seconds each, a page does not."""
    from pytest_pafot.files import write_whole  # noqa: PLC0415
    from pytest_pafot.report.animation import AnimationError  # noqa: PLC0415

    lines: list[Line] = []
    shown, pictures = target, 0
    try:
        for name, content in islice(_contents(target, path, report), None if has_pictures else 1):
            write_whole(name, content)
            pictures += name.suffix == ".png"
            shown = target if name == path else os.path.join(target, "index.html")  # noqa: PTH118
    except OSError as error:
        reason = error.strerror or str(error)
        return [(f"--pafot-report={target}: not written: {reason}: {error.filename or path}; name another place", True)]
    except AnimationError as error:
        lines.append((f"--pafot-report={target}: the page is there, pictures are not: {error}", True))
    if not has_pictures and not is_page_file(target):
        lines.append((f"--pafot-report={target}: the page is there, pictures are not, after an interrupt", True))
    more = f", {_plural(pictures, 'moving picture')}" if pictures else ""
    return [(f"report: {shown} ({_counts(report.findings, report.errors)}{more})", False), *lines]


def _contents(target: str, path: Path, report: Report) -> Iterable[tuple[Path, bytes]]:
    if is_page_file(target):
        from pytest_pafot.report.page import render_page  # noqa: PLC0415

        return [(path, render_page(report).encode())]
    from pytest_pafot.report.folder import report_files  # noqa: PLC0415

    return ((path / name, content) for name, content in report_files(report))


def _counts(findings: Sequence[object], errors: Sequence[object]) -> str:
    """Errors first; without any, findings alone."""
    return ", ".join([*([_plural(len(errors), "error")] if errors else []), _plural(len(findings), "finding")])


def _plural(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"
