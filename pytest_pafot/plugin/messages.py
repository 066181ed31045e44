"""What an item sends to the controller, also from the workers of pytest-xdist, and its properties in reports."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, MutableSequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import pytest

from pytest_pafot.corpus.layout import relative
from pytest_pafot.corpus.saved import Saved
from pytest_pafot.findings.sighting import Seen
from pytest_pafot.plugin.session import PHASE, report_on
from pytest_pafot.searching.plain import plain
from pytest_pafot.support.text import visible

if TYPE_CHECKING:
    from pytest_pafot.campaign.options import Settings
    from pytest_pafot.model.trace import Trace
    from pytest_pafot.oracle.checks import Check
    from pytest_pafot.oracle.run import Run
    from pytest_pafot.report.session import Event


def packed(value: object) -> str:
    """Return a value as ASCII text for a message: pytest-xdist cannot send texts with invalid characters."""
    return json.dumps(plain(value))


def send(item: pytest.Item, event: Event, **more: Any) -> None:
    """Send an event of a running item to the controller, with more data, which must be plain."""
    report = report_on(item, PHASE, pafot=(type(event).__name__, packed(event), more))
    item.ihook.pytest_runtest_logreport(report=report)


def send_seen(
    item: pytest.Item, settings: Settings, seen: Seen, *, check: Check | None = None, note: str = "", **more: Any
) -> None:
    """Send a finding, new or replayed, to the controller. What only a page needs is made only if one is requested.

    Args:
        item: the item that found or replayed it.
        settings: the item's settings, which say whether there is a page.
        seen: the finding, and what this session saw of it.
        check: the check that failed; None if no check failed.
        note: what the page adds to the headline.
        more: further data for the terminal.
    """
    sentences = seen.finding.expect.sentences_on(seen.run) if seen.headline and seen.run is not None else ()
    seen = replace(seen, observed=replace(seen.observed, sentences=sentences))
    if settings.report is not None and seen.headline:
        from pytest_pafot.report.views import finding_view  # noqa: PLC0415

        more["view"] = json.dumps(finding_view(seen, note=note, check=check), allow_nan=False)
    send(item, seen, **more)


# Properties of items, which appear in files for other tools, such as the file of ``--junitxml``.
#
# They are stored as pytest's own ``record_property`` stores them, so workers of pytest-xdist pass them on. The prefix
# ``pafot_`` distinguishes them from the user's properties.

PREFIX = "pafot_"

Properties = MutableSequence[tuple[str, Any]]


@dataclass(slots=True)
class OfOneRun:
    """The properties that a marked test records by pytest's ``record_property``, of one run and not of all runs.

    The test function is called for each run with the same fixtures, so each call would add its properties once more.
    """

    properties: Properties  # of the item
    _shown: list[tuple[str, Any]] = field(default_factory=list)  # those of one call, which are among the item's
    # by the trace, which a run keeps when more becomes known of it
    _recorded: WeakKeyDictionary[Trace, list[tuple[str, Any]]] = field(default_factory=WeakKeyDictionary)

    @contextmanager
    def call(self, run: Run) -> Iterator[None]:
        """Replace the properties of the call before by those that are recorded in this context, for a run."""
        self.show(None)
        count = len(self.properties)
        try:
            yield
        finally:
            self._shown = self._recorded[run.trace] = list(self.properties[count:])

    def show(self, run: Run | None, properties: Properties | None = None) -> None:
        """Replace the properties of the last call by those of the call for a run; by none if there was no such call.

        ``properties`` are those of a report that was made of the item; by default those of the item itself.
        """
        changed = self.properties if properties is None else properties
        shown = [] if run is None else self._recorded.get(run.trace, [])
        ours = set(map(id, self._shown))  # by identity, because a fixture may have recorded an equal one before
        changed[:] = [*(each for each in changed if id(each) not in ours), *shown]
        if properties is None:
            self._shown = shown


OF_ONE_RUN: pytest.StashKey[OfOneRun] = pytest.StashKey()
"""The properties that the marked test of an item records."""


def set_properties(properties: Properties, **values: object) -> None:
    """Set properties of an item or a report, replacing earlier values. Empty properties are left out."""
    names = {f"{PREFIX}{name}": visible(str(value)) for name, value in values.items() if value not in (None, "")}
    others = [each for each in properties if each[0] not in names]
    properties[:] = [*others, *names.items()]


def set_of_saved(item: pytest.Item, saved: Saved) -> None:
    """Add seed, id, signature and file of an item's saved scenario to the item's properties in pytest's reports."""
    finding, file = saved.finding, relative(saved.path, item.config.rootpath)
    seed, signature = (None, None) if finding is None else (finding.found.seed, finding.signature.text)
    set_properties(item.user_properties, seed=seed, id=saved.id, signature=signature, file=file)


def of_findings(sightings: Iterable[Seen]) -> dict[str, str]:
    """Return the properties that describe findings in pytest's reports; commas separate the values of the findings."""
    columns: dict[str, list[str]] = {"id": [], "signature": [], "file": [], "severity": []}
    for each in sightings:
        texts = (each.id, each.finding.signature.text, each.path, str(each.severity or "none"))
        for column, text in zip(columns.values(), texts, strict=True):
            column.append(text)
    return {name: ", ".join(filter(None, column)) for name, column in columns.items()}
