"""What a running item tells the controller, as it happens and from any worker.

A message is a test report of a phase of its own. Such a report reaches the controller under pytest-xdist like any
other, at once; everybody else takes it for a passed phase that shows nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import pytest

PHASE = "pafot"
"""Of a report that is a message."""

PAGE = "page"
"""Kind of the messages for a report page."""

NEW = "new"
"""Label of a finding that was not known before."""


def send(item: pytest.Item, kind: str, data: Mapping[str, Any]) -> None:
    """Tell the controller; the data must be plain."""
    report = pytest.TestReport(
        nodeid=item.nodeid,
        location=item.location,
        keywords={},
        outcome="passed",
        longrepr=None,
        when=PHASE,  # type: ignore[arg-type]
        pafot={"kind": kind, **data},
    )
    item.ihook.pytest_runtest_logreport(report=report)


def received(report: Any) -> dict[str, Any] | None:
    """The message in a report, or None for an ordinary report."""
    if getattr(report, "when", None) != PHASE:
        return None
    message: dict[str, Any] = report.pafot
    return message


@contextmanager
def faults_told(tell: Callable[[str], None], work: str) -> Iterator[None]:
    """Tell of a fault in work at the end of a session, where pytest would lose the texts of all failures by it.

    An interrupt ends the work and not the session, which ends by itself.

    Args:
        tell: takes one line for the summary.
        work: that is done inside, in a few words.
    """
    try:
        yield
    except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001  (whatever it is, the summary says so)
        tell(f"{work}: {type(error).__name__}: {error}")


class Unseen:
    """Keeps messages out of the results, in the controller and in workers."""

    @pytest.hookimpl(tryfirst=True)
    def pytest_report_teststatus(self, report: Any) -> tuple[str, str, str] | None:
        """Messages are no category of results."""
        return ("", "", "") if getattr(report, "when", None) == PHASE else None
