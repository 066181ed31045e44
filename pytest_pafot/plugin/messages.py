"""The messages of an item to the controller, its properties in reports, and its failure report."""

from __future__ import annotations

import json
import re
from collections.abc import Generator, Iterable, Iterator, MutableSequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import date
from itertools import takewhile
from os import getpid
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import pytest

from pytest_pafot.algorithms.plain import plain
from pytest_pafot.attribution.sentences import ALSO
from pytest_pafot.corpus.layout import relative
from pytest_pafot.corpus.reader import Saved
from pytest_pafot.findings.decisions import sentences_of
from pytest_pafot.findings.sighting import Seen
from pytest_pafot.oracle.run import Check, Run
from pytest_pafot.plugin.collection import base_id, is_driven, saved_of
from pytest_pafot.plugin.session import AS_SAVED, PHASE, SHARED, report_on
from pytest_pafot.searches.harness import collision_in_short
from pytest_pafot.support.text import MARKER, fitted_lines, visible, visible_lines

if TYPE_CHECKING:
    from pytest_pafot.model.trace import Trace
    from pytest_pafot.report.terminal import Event
    from pytest_pafot.searches.options import Settings


def packed(value: object) -> str:
    """Encode a value as ASCII JSON, because pytest-xdist cannot send invalid characters."""
    return json.dumps(plain(value))


def send(item: pytest.Item, event: Event, **more: Any) -> None:
    """Send an event of a running item to the controller, with additional JSON-compatible data."""
    report = report_on(item, PHASE, pafot=(type(event).__name__, packed(event), more))
    item.ihook.pytest_runtest_logreport(report=report)


def send_seen(
    item: pytest.Item,
    settings: Settings,
    seen: Seen,
    *,
    check: Check | None = None,
    note: str = "",
    **more: Any,
) -> None:
    """Send a new or replayed finding to the controller.

    Args:
        item: the item that found or replayed the finding.
        settings: the settings of the item.
        seen: the finding, with this session's observations.
        check: the check that failed, or None.
        note: an addition to the headline on the page.
        more: more data for the terminal.
    """
    sentences: tuple[str, ...] = ()
    if seen.headline and seen.run is not None:
        sentences = sentences_of(seen.run, seen.finding.expect)
        # The sentences are about the collision, not about the check.
        if sentences and check is not None:
            sentences = (f"{ALSO} {collision_in_short(seen.run)}.",)
    seen = replace(seen, observed=replace(seen.observed, sentences=sentences))
    # The view of the page is large, so it is created only if a page was requested.
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
    """The properties that a test records with ``record_property`` in one run."""

    properties: Properties  # of the item
    # from the last call, also in `properties`
    _shown: list[tuple[str, Any]] = field(default_factory=list)
    # by trace, because a run may be replaced by one with the same trace and more facts
    _recorded: WeakKeyDictionary[Trace, list[tuple[str, Any]]] = field(
        default_factory=WeakKeyDictionary
    )

    @contextmanager
    def call(self, run: Run) -> Iterator[None]:
        """Replace the properties of the previous run with those that are recorded in this context."""
        self.show(None)
        count = len(self.properties)
        try:
            yield
        finally:
            self._shown = self._recorded[run.trace] = list(self.properties[count:])

    def show(self, run: Run | None, properties: Properties | None = None) -> None:
        """Replace the last call's properties with the properties of ``run``, or remove them if ``run`` is None.

        ``properties`` is the list to change, by default the item's.
        """
        changed = self.properties if properties is None else properties
        shown = [] if run is None else self._recorded.get(run.trace, [])
        # by identity, because a fixture may have recorded an equal one before
        ours = set(map(id, self._shown))
        changed[:] = [*(each for each in changed if id(each) not in ours), *shown]
        if properties is None:
            self._shown = shown


OF_ONE_RUN: pytest.StashKey[OfOneRun] = pytest.StashKey()


def set_properties(properties: Properties, **values: object) -> None:
    """Set properties of an item or a report. Replace earlier values, and skip empty ones."""
    names = {
        f"{PREFIX}{name}": visible(str(value))
        for name, value in values.items()
        if value not in (None, "")
    }
    others = [each for each in properties if each[0] not in names]
    properties[:] = [*others, *names.items()]


def set_saved_properties(item: pytest.Item, saved: Saved) -> None:
    """Add the seed, id, signature and file of a saved scenario to the item's properties."""
    finding, file = saved.finding, relative(saved.path, item.config.rootpath)
    seed, signature = (
        (None, None) if finding is None else (finding.found.seed, finding.signature.text)
    )
    set_properties(item.user_properties, seed=seed, id=saved.id, signature=signature, file=file)


def finding_properties(sightings: Iterable[Seen]) -> dict[str, str]:
    """Return the properties that describe findings, as lists separated by commas."""
    columns: dict[str, list[str]] = {"id": [], "signature": [], "file": [], "severity": []}
    for each in sightings:
        texts = (each.id, each.finding.signature.text, each.path, str(each.severity or "none"))
        for column, text in zip(columns.values(), texts, strict=True):
            column.append(text)
    return {name: ", ".join(filter(None, column)) for name, column in columns.items()}


# The failure report of an item, and its output.

REPLAYED = pytest.StashKey[bool]()
"""True if the item's saved scenario was replayed."""

NOT_ACCEPTED = pytest.StashKey[str]()
"""The difference between the failure in a replay and the accepted failure."""

OUTPUT_END = 10_000
"""The number of characters of captured output that a report keeps from each end."""

# A colour code, with which pytest marks differences. In other places, it could hide a message.
_COLOUR = re.compile("\x1b\\[[0-9;]*m")


class KeptOutput:
    """The start and the end of an item's captured output."""

    def __init__(self, item: pytest.Item) -> None:
        self._item = item
        # None if another plugin replaces it
        self._capture = item.config.pluginmanager.get_plugin("capturemanager")
        self._process = getpid()
        # pytest keeps the output of each item until the session ends, and a policy that prints at each decision prints
        # gigabytes. So only the start and the end are kept.
        # start, end, characters between them
        self._texts = {"stdout": ("", "", 0), "stderr": ("", "", 0)}

    def read(self) -> None:
        if self._capture is None or getpid() != self._process:
            # This process was forked. The original process reads the file, to which both write.
            return
        for key, text in zip(self._texts, self._capture.read_global_capture(), strict=True):
            begin, end, left_out = self._texts[key]
            begin, end = (
                begin + text[: OUTPUT_END - len(begin)],
                end + text[OUTPUT_END - len(begin) :],
            )
            too_long = max(0, len(end) - 2 * OUTPUT_END)
            self._texts[key] = begin, end[too_long:], left_out + too_long

    def give_back(self) -> None:
        """Add the output to the item's report, as pytest does."""
        self.read()
        for key, (begin, end, left_out) in self._texts.items():
            text = f"{begin}{end}"
            if left_out:
                text = _shortened(begin, end[-OUTPUT_END:], left_out + len(end) - OUTPUT_END)
            self._item.add_report_section("call", key, text)


OUTPUT = pytest.StashKey[KeptOutput]()


class Failures:
    """Hooks that shorten the reports of failing items and the captured output of all items."""

    @pytest.hookimpl(wrapper=True)
    def pytest_pyfunc_call(self, pyfuncitem: pytest.Function) -> Generator[None, object, object]:
        if not is_driven(pyfuncitem):
            return (yield)
        output = pyfuncitem.stash[OUTPUT] = KeptOutput(pyfuncitem)
        try:
            return (yield)
        finally:
            output.give_back()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item, call: pytest.CallInfo[None]
    ) -> Generator[None, Any, Any]:
        marked = is_driven(item)
        if call.excinfo is None or not marked:
            report = yield
            if marked:
                _shorten_output(report)
            return report
        # A search may find dozens of failures, and pytest prints each several times. With -v, frames are complete.
        # the saved file has the rest
        option, is_brief = item.config.option, item.config.get_verbosity() <= 0
        # declared by pytest's terminal plugin, which may be off
        style = getattr(option, "tbstyle", None)
        if is_brief and call.when == "call" and style == "auto":
            option.tbstyle = "short"
        try:
            report = yield
        finally:
            if style is not None:
                option.tbstyle = style
        _shorten_output(report)
        saved = saved_of(item)
        if saved is not None and not call.excinfo.errisinstance(pytest.xfail.Exception):
            _count_unless_accepted(item, saved, report)
        if saved is not None:
            entry = {
                "id": saved.id,
                "file": relative(saved.path, item.config.rootpath),
                "test": base_id(item),
            }
            setattr(report, AS_SAVED, json.dumps(entry))
        _make_visible(report)
        _fit(report.longrepr, item.config.stash[SHARED].width)
        return report


def _shorten_output(report: pytest.TestReport) -> None:
    for number, (title, text) in enumerate(report.sections):
        left_out = len(text) - 2 * OUTPUT_END
        if left_out > OUTPUT_END:
            report.sections[number] = (
                title,
                _shortened(text[:OUTPUT_END], text[-OUTPUT_END:], left_out),
            )


def _shortened(begin: str, end: str, left_out: int) -> str:
    line = f"[{left_out} characters of output are omitted. Run pytest -s without workers to see the complete output]"
    return f"{begin}\n{line}\n{end}"


def _count_unless_accepted(item: pytest.Item, saved: Saved, report: pytest.TestReport) -> None:
    """Count an item as failed if its failure differs from the accepted one."""
    is_accepted = saved.is_accepted(date.fromisoformat(item.config.stash[SHARED].today))
    # The mark xfail would also accept an error in a fixture or in the factory.
    is_other = REPLAYED not in item.stash or NOT_ACCEPTED in item.stash
    if is_accepted and is_other and hasattr(report, "wasxfail"):
        report.outcome = "failed"
        del report.wasxfail


def _make_visible(report: pytest.TestReport) -> None:
    match report.longrepr:
        case str() as text:
            report.longrepr = visible_lines(text)
        case (path, line, why):
            report.longrepr = (path, line, visible_lines(why))
    if hasattr(report, "wasxfail"):
        report.wasxfail = visible_lines(report.wasxfail)
    crash = getattr(report.longrepr, "reprcrash", None)
    if crash is not None:  # pytest's short summary shows its first line
        crash.message = visible_lines(_COLOUR.sub("", crash.message))


def _fit(longrepr: Any, width: int) -> None:
    """Wrap the lines of a failure message, except for code, and escape unprintable characters."""
    tracebacks = [each[0] for each in getattr(longrepr, "chain", ())] or [
        getattr(longrepr, "reprtraceback", None)
    ]
    for entry in (entry for each in tracebacks if each is not None for entry in each.reprentries):
        lines = [_COLOUR.sub("", line) for line in entry.lines]
        code = (
            []
            if entry.style == "value"
            else list(takewhile(lambda line: not line.startswith(MARKER), lines))
        )
        entry.lines = [*map(visible_lines, code), *fitted_lines(lines[len(code) :], width)]
        for values in filter(None, [getattr(entry, "reprlocals", None)]):
            values.lines = list(map(visible_lines, values.lines))
        for arguments in filter(None, [getattr(entry, "reprfuncargs", None)]):
            arguments.args = [(name, visible(str(value))) for name, value in arguments.args]
