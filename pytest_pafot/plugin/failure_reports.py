"""The failure report of an item: short frames, and lines that fit the terminal.

A search may find dozens of failures, and pytest prints each several times: in its own section, and in files for other
tools. With ``-v`` or ``--tb=long`` the frames are in full.
"""

from __future__ import annotations

import json
import re
from collections.abc import Generator
from datetime import date
from itertools import takewhile
from os import getpid
from typing import Any

import pytest

from pytest_pafot.corpus.layout import relative
from pytest_pafot.corpus.saved import Saved
from pytest_pafot.oracle.checks import CheckFailed
from pytest_pafot.oracle.run import Run
from pytest_pafot.plugin.collection import saved_of
from pytest_pafot.plugin.marks import base_id, is_driven
from pytest_pafot.plugin.session import AS_SAVED, SHARED
from pytest_pafot.support.text import MARKER, fitted_lines, visible, visible_lines

REPLAYED = pytest.StashKey[bool]()
"""Set once the scenario of an item was replayed, however the replay ended."""

NOT_ACCEPTED = pytest.StashKey[str]()
"""How the failure of a replay goes beyond the one that its file accepts."""

SCENARIO = re.compile(r"E +scenario [0-9a-f]+, repair seed \d+(, position rule: \w+)?(, [a-z]+ traffic.*)?")
"""The last line of ``run.explain()``. It is left out, since the saved file and the report page contain it, too."""

REPEATED = (
    SCENARIO,
    re.compile(r"E +assert not <Collision [^<>]*>"),
    re.compile(r"E +\+  where .* = <Run [^<>]*>\.\w+"),
)
"""Lines of a report that are left out, because the explanation or the line of the assertion says the same."""

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
        _fit(report.longrepr, item.config.stash[SHARED].width, is_brief=is_brief)
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


def explained(run: Run, exception: BaseException) -> str:
    """Return the explanation of a run, for the message of a failure.

    If a check failed, the text is a line with a title, because it follows the check's own explanation.
    """
    text = run.explain().rpartition("\n")[0]  # the last line names the scenario, as the file does
    return f"run        {text}" if isinstance(exception, CheckFailed) else text


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


def _fit(longrepr: Any, width: int, *, is_brief: bool) -> None:
    """Wrap the lines of a failure message to a width, except lines of code, and make unprintable characters visible."""
    tracebacks = [each[0] for each in getattr(longrepr, "chain", ())] or [getattr(longrepr, "reprtraceback", None)]
    for entry in (entry for each in tracebacks if each is not None for entry in each.reprentries):
        lines = [_COLOUR.sub("", line) for line in entry.lines]
        if is_brief and any(map(SCENARIO.fullmatch, lines)):
            lines = [line for line in lines if not any(each.fullmatch(line) for each in REPEATED)]
        code = [] if entry.style == "value" else list(takewhile(lambda line: not line.startswith(MARKER), lines))
        entry.lines = [*map(visible_lines, code), *fitted_lines(lines[len(code) :], width)]
        for values in filter(None, [getattr(entry, "reprlocals", None)]):
            values.lines = list(map(visible_lines, values.lines))
        for arguments in filter(None, [getattr(entry, "reprfuncargs", None)]):
            arguments.args = [(name, visible(str(value))) for name, value in arguments.args]
