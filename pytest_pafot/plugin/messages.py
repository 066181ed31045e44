"""What an item says: the events that it sends to the controller, its properties in reports, and its failure report.

Items of pytest-xdist's workers send events, too. A failure report has short frames, and lines that fit the terminal: a
search may find dozens of failures, and pytest prints each several times, in its own section and in files for other
tools. With ``-v`` or ``--tb=long`` the frames are in full.
"""

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

from pytest_pafot.campaign.harness import collision_in_short
from pytest_pafot.corpus.layout import relative
from pytest_pafot.corpus.reader import Saved
from pytest_pafot.findings.decisions import beginning
from pytest_pafot.findings.sighting import Seen
from pytest_pafot.oracle.run import Check, Run
from pytest_pafot.plugin.collection import base_id, is_driven, saved_of
from pytest_pafot.plugin.session import AS_SAVED, PHASE, SHARED, report_on
from pytest_pafot.searching.plain import plain
from pytest_pafot.support.text import MARKER, capitalised, fitted_lines, visible, visible_lines

if TYPE_CHECKING:
    from pytest_pafot.campaign.options import Settings
    from pytest_pafot.model.trace import Trace
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
    sentences: tuple[str, ...] = ()
    if seen.headline and seen.run is not None:
        sentences = seen.finding.expect.sentences_on(seen.run)
        if sentences and check is not None:  # What both did is about the collision, and not about the check.
            sentences = (f"This run has a collision, too. {collision_in_short(seen.run)}.",)
        elif sentences and (began := beginning(seen.run)):  # the decision to move, which no verdict knows
            sentences = (f"{capitalised(began)}, and {sentences[0].removeprefix('The ego ')}", *sentences[1:])
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


# The failure report of an item, and its output.

REPLAYED = pytest.StashKey[bool]()
"""Set once the scenario of an item was replayed, however the replay ended."""

NOT_ACCEPTED = pytest.StashKey[str]()
"""How the failure of a replay goes beyond the one that its file accepts."""

OUTPUT_END = 10_000
"""The length of the beginning and of the end of captured output that a report contains [characters]."""

_COLOUR = re.compile("\x1b\\[[0-9;]*m")
"""A colour code of the terminal. It is removed, because a malicious file may hide a text with such codes.

pytest itself uses them to colour the difference of two values.
"""


class KeptOutput:
    """The captured output of an item that runs, of which the beginning and the end are kept.

    pytest keeps all output of every item to the end of the session, so it is read here first. A policy that prints at
    each decision prints gigabytes.
    """

    def __init__(self, item: pytest.Item) -> None:
        self._item = item
        self._capture = item.config.pluginmanager.get_plugin("capturemanager")  # None if another plugin replaces it
        self._process = getpid()
        self._texts = {"stdout": ("", "", 0), "stderr": ("", "", 0)}  # beginning, end, characters between them

    def read(self) -> None:
        """Take the output since the last call out of pytest's capture."""
        if self._capture is None or getpid() != self._process:
            return  # A process that was forked from this one writes to the same file, which this one reads.
        for key, text in zip(self._texts, self._capture.read_global_capture(), strict=True):
            begin, end, left_out = self._texts[key]
            begin, end = begin + text[: OUTPUT_END - len(begin)], end + text[OUTPUT_END - len(begin) :]
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
"""The output of a marked item that runs."""


class Failures:
    """The hooks that shorten the reports of failing items, and the output of all."""

    @pytest.hookimpl(wrapper=True)
    def pytest_pyfunc_call(self, pyfuncitem: pytest.Function) -> Generator[None, object, object]:
        """Keep only the beginning and the end of what a marked item prints."""
        if not is_driven(pyfuncitem):
            return (yield)
        output = pyfuncitem.stash[OUTPUT] = KeptOutput(pyfuncitem)
        try:
            return (yield)
        finally:
            output.give_back()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item: pytest.Item, call: pytest.CallInfo[None]) -> Generator[None, Any, Any]:
        """Shorten the report of a search or a replay that fails."""
        marked = is_driven(item)
        if call.excinfo is None or not marked:
            report = yield
            if marked:
                _shorten_output(report)
            return report
        option, is_brief = item.config.option, item.config.get_verbosity() <= 0  # the saved file has the rest
        style = getattr(option, "tbstyle", None)  # declared by pytest's terminal plugin, which may be off
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
            entry = {"id": saved.id, "file": relative(saved.path, item.config.rootpath), "test": base_id(item)}
            setattr(report, AS_SAVED, json.dumps(entry))
        _make_visible(report)
        _fit(report.longrepr, item.config.stash[SHARED].width)
        return report


def _shorten_output(report: pytest.TestReport) -> None:
    """Keep the beginning and the end of long output, also that of fixtures."""
    for number, (title, text) in enumerate(report.sections):
        left_out = len(text) - 2 * OUTPUT_END
        if left_out > OUTPUT_END:
            report.sections[number] = (title, _shortened(text[:OUTPUT_END], text[-OUTPUT_END:], left_out))


def _shortened(begin: str, end: str, left_out: int) -> str:
    line = f"[{left_out} characters of output are left out; pytest -s shows all, in a session without workers]"
    return f"{begin}\n{line}\n{end}"


def _count_unless_accepted(item: pytest.Item, saved: Saved, report: pytest.TestReport) -> None:
    """Let an item count as failed although its file is accepted, if its failure is not the accepted one.

    Either the replay shows another failure, or there was no replay: an error in a fixture, in the factory or elsewhere
    in the set-up.
    """
    is_accepted = saved.is_accepted(date.fromisoformat(item.config.stash[SHARED].today))
    is_other = REPLAYED not in item.stash or NOT_ACCEPTED in item.stash
    if is_accepted and is_other and hasattr(report, "wasxfail"):
        report.outcome = "failed"
        del report.wasxfail


def _make_visible(report: pytest.TestReport) -> None:
    """Make unprintable characters of a report visible, outside its traceback: in an error, a skip or an xfail."""
    match report.longrepr:
        case str() as text:
            report.longrepr = visible_lines(text)
        case (path, line, why):
            report.longrepr = (path, line, visible_lines(why))
    if hasattr(report, "wasxfail"):
        report.wasxfail = visible_lines(report.wasxfail)
    crash = getattr(report.longrepr, "reprcrash", None)
    if crash is not None:  # pytest's short summary has its first line
        crash.message = visible_lines(_COLOUR.sub("", crash.message))


def _fit(longrepr: Any, width: int) -> None:
    """Wrap the lines of a failure message to a width, except lines of code, and make unprintable characters visible."""
    tracebacks = [each[0] for each in getattr(longrepr, "chain", ())] or [getattr(longrepr, "reprtraceback", None)]
    for entry in (entry for each in tracebacks if each is not None for entry in each.reprentries):
        lines = [_COLOUR.sub("", line) for line in entry.lines]
        code = [] if entry.style == "value" else list(takewhile(lambda line: not line.startswith(MARKER), lines))
        entry.lines = [*map(visible_lines, code), *fitted_lines(lines[len(code) :], width)]
        for values in filter(None, [getattr(entry, "reprlocals", None)]):
            values.lines = list(map(visible_lines, values.lines))
        for arguments in filter(None, [getattr(entry, "reprfuncargs", None)]):
            arguments.args = [(name, visible(str(value))) for name, value in arguments.args]
