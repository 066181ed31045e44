"""What a running item tells the controller, as it happens and from any worker.

A message is a test report of a phase of its own. Such a report reaches the controller under pytest-xdist like any
other, at once; everybody else takes it for a passed phase that shows nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import pytest

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
