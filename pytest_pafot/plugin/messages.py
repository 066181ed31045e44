"""What a running item tells the controller, as it happens and from any worker.

A message is a test report of a phase of its own. Such a report reaches the controller under pytest-xdist like any
other, at once; everybody else takes it for a passed phase that shows nothing.
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


PHASE = "pafot"  # of a report that is a message
PAGE = "page"  # kind of the messages for a report page


class Message(NamedTuple):
    """What an item tells."""

    kind: str  # of the data, such as ``progress``
    data: dict[str, Any]  # plain


def send(item: pytest.Item, kind: str, data: Mapping[str, Any]) -> None:
    """Tell the controller; the data must be plain."""
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
    """The message in a report, or None for an ordinary report."""
    return Message(*report.pafot) if getattr(report, "when", None) == PHASE else None


@pytest.hookimpl(tryfirst=True)
def pytest_report_teststatus(report: pytest.TestReport | pytest.CollectReport) -> tuple[str, str, str] | None:
    """Keep messages out of the results, in the controller and in workers: they are no category of them."""
    return ("", "", "") if getattr(report, "when", None) == PHASE else None


# Properties of items, which files for other tools have, such as those of ``--junitxml``.
#
# They are those of pytest's own ``record_property``, each with the prefix ``pafot_``, so that workers of pytest-xdist
# hand them over and none is taken for one of the user's.

PREFIX = "pafot_"

AS_SAVED = "pafot_saved"
"""Attribute of the report of a saved scenario that fails: its id and file as they are, for programs.

It is JSON in ASCII: pytest-xdist sends no text with bytes in it that are no characters, as names of files may have.
"""


def set_properties(properties: MutableSequence[tuple[str, Any]], **values: object) -> None:
    """Set properties of an item or of a report, each once and safe to show; those that are empty are left out."""
    names = {f"{PREFIX}{name}": visible(str(value)) for name, value in values.items() if value not in (None, "")}
    others = [each for each in properties if each[0] not in names]
    properties[:] = [*others, *names.items()]


def set_of_saved(item: pytest.Item, saved: Saved) -> None:
    """Set those of the item of a saved scenario, before anything can go wrong with it."""
    finding, file = saved.finding, relative(saved.path, item.config.rootpath)
    seed, signature = (None, None) if finding is None else (finding.found.seed, finding.signature.text)
    set_properties(item.user_properties, seed=seed, id=saved.id, signature=signature, file=file)


def severity_text(severity: Severity | None) -> str:
    """Return how bad a failure is, as a property."""
    return "none" if severity is None else str(severity)


def of_findings(findings: Iterable[tuple[Finding, str, Severity | None]]) -> dict[str, str]:
    """Those that tell findings, with their files: for several, what stands in each is separated by commas."""
    columns: dict[str, list[str]] = {"id": [], "signature": [], "file": [], "severity": []}
    for finding, file, severity in findings:
        texts = (finding.id, finding.signature.text, file, severity_text(severity))
        for column, text in zip(columns.values(), texts, strict=True):
            column.append(text)
    return {name: ", ".join(filter(None, column)) for name, column in columns.items()}
