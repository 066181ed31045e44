"""Messages from a running item to the controller, also from the workers of pytest-xdist.

A message is a test report of a phase that only this plugin knows. pytest-xdist passes the message to the controller at
once, like every report. Other plugins take it for the report of a passed phase without output.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, MutableSequence
from typing import TYPE_CHECKING, Any, NamedTuple

import pytest

from pytest_pafot.corpus.layout import relative
from pytest_pafot.corpus.saved import Saved
from pytest_pafot.support.text import visible

if TYPE_CHECKING:
    from pytest_pafot.findings.finding import Finding
    from pytest_pafot.findings.severity import Severity


PHASE = "pafot"  # the phase of a report that is a message
PAGE = "page"  # the kind of messages for a report page


class Message(NamedTuple):
    """A message from a running item to the controller."""

    kind: str  # the kind of the data, such as ``progress``
    data: dict[str, Any]  # plain values, which pytest-xdist can send


def send(item: pytest.Item, kind: str, data: Mapping[str, Any]) -> None:
    """Send a message from a running item to the controller. The data must be plain values, which can be serialised."""
    report = pytest.TestReport(
        nodeid=item.nodeid,
        location=item.location,
        keywords={},
        outcome="passed",
        longrepr=None,
        when=PHASE,  # type: ignore[arg-type]
        pafot=(kind, dict(data)),
    )
    item.ihook.pytest_runtest_logreport(report=report)


def received(report: pytest.TestReport | pytest.CollectReport) -> Message | None:
    """Return the message in a report, or None for an ordinary report."""
    return Message(*report.pafot) if getattr(report, "when", None) == PHASE else None


@pytest.hookimpl(tryfirst=True)
def pytest_report_teststatus(report: pytest.TestReport | pytest.CollectReport) -> tuple[str, str, str] | None:
    """Return empty texts for messages, so that pytest does not count them as results."""
    return ("", "", "") if getattr(report, "when", None) == PHASE else None


# Properties of items, which appear in files for other tools, such as the file of ``--junitxml``.
#
# They are stored as pytest's own ``record_property`` stores them, so workers of pytest-xdist pass them on. The prefix
# ``pafot_`` distinguishes them from the user's properties.

PREFIX = "pafot_"

AS_SAVED = "pafot_saved"
"""The attribute of a report that holds the id and the file of a failing saved scenario, for programs.

Its value is JSON in ASCII, because file names may contain bytes that are not valid characters, and pytest-xdist cannot
send such a text.
"""


def set_properties(properties: MutableSequence[tuple[str, Any]], **values: object) -> None:
    """Set properties of an item or a report, replacing earlier values. Empty properties are left out."""
    names = {f"{PREFIX}{name}": visible(str(value)) for name, value in values.items() if value not in (None, "")}
    others = [each for each in properties if each[0] not in names]
    properties[:] = [*others, *names.items()]


def set_of_saved(item: pytest.Item, saved: Saved) -> None:
    """Add seed, id, signature and file of an item's saved scenario to the item's properties in pytest's reports."""
    finding, file = saved.finding, relative(saved.path, item.config.rootpath)
    seed, signature = (None, None) if finding is None else (finding.found.seed, finding.signature.text)
    set_properties(item.user_properties, seed=seed, id=saved.id, signature=signature, file=file)


def severity_text(severity: Severity | None) -> str:
    """Return the severity of a failure as text for pytest's reports."""
    return "none" if severity is None else str(severity)


def of_findings(findings: Iterable[tuple[Finding, str, Severity | None]]) -> dict[str, str]:
    """Return the properties that describe findings in pytest's reports; commas separate the values of the findings."""
    columns: dict[str, list[str]] = {"id": [], "signature": [], "file": [], "severity": []}
    for finding, file, severity in findings:
        texts = (finding.id, finding.signature.text, file, severity_text(severity))
        for column, text in zip(columns.values(), texts, strict=True):
            column.append(text)
    return {name: ", ".join(filter(None, column)) for name, column in columns.items()}
