"""The report of a failing item: short frames, lines that fit the terminal, and one line for the summary.

A search may find dozens of failures, and pytest prints each three times: in its own section, in the short summary,
which is not shortened on CI, and in files for other tools. ``-v`` or ``--tb=long`` brings the full frames back.
"""

from __future__ import annotations

import json
import re
from collections.abc import Generator
from itertools import takewhile
from typing import Any

import pytest

from pytest_pafot.corpus.layout import relative
from pytest_pafot.oracle.checks import CheckFailed
from pytest_pafot.oracle.run import Run
from pytest_pafot.plugin.collection import saved_of
from pytest_pafot.plugin.marks import RATE_MARK, SEARCH_MARK
from pytest_pafot.plugin.messages import AS_SAVED
from pytest_pafot.plugin.session import SHARED
from pytest_pafot.support.text import MARKER, fitted_lines, visible, visible_lines

SUMMARY = pytest.StashKey[str]()  # the summary line of a failing item

SCENARIO = re.compile(r"E +scenario [0-9a-f]+, repair seed \d+(, position rule: \w+)?(, [a-z]+ traffic.*)?")
"""The last line of ``run.explain()``, which the saved file and the report page contain, too."""

REPEATED = (
    SCENARIO,
    re.compile(r"E +assert not <Collision [^<>]*>"),
    re.compile(r"E +\+  where .* = <Run [^<>]*>\.\w+"),
)
"""Lines that repeat what the explanation and the line of the assertion say."""

_COLOUR = re.compile("\x1b\\[[0-9;]*m")
"""A colour code. pytest colours the difference of two values with them; a malicious file may hide a text in them."""


class Failures:
    """The hook that shortens the reports of failing items."""

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item: pytest.Item, call: pytest.CallInfo[None]) -> Generator[None, Any, Any]:
        """Shorten the report of a search, a replay or a rate that fails."""
        if call.excinfo is None or not any(map(item.get_closest_marker, (SEARCH_MARK, RATE_MARK))):
            return (yield)
        option, is_brief = item.config.option, is_compact(item.config)
        style = getattr(option, "tbstyle", None)  # declared by pytest's terminal plugin, which may be off
        if is_brief and call.when == "call" and style == "auto":
            option.tbstyle = "short"
        try:
            report = yield
        finally:
            if style is not None:
                option.tbstyle = style
        saved = saved_of(item)
        if saved is not None:
            told = {"id": saved.id, "file": relative(saved.path, item.config.rootpath)}
            setattr(report, AS_SAVED, json.dumps(told))
        _make_visible(report)
        _fit(report.longrepr, item.config.stash[SHARED].width, is_brief=is_brief)
        summarise(report, item.stash.get(SUMMARY, ""))
        return report


def is_compact(config: pytest.Config) -> bool:
    """Return whether a report leaves out what the saved file and the report page contain, too."""
    return config.get_verbosity() <= 0


def explained(run: Run, exception: BaseException, config: pytest.Config) -> str:
    """Return the explanation of a run; if a check failed, as the line that follows the check's own explanation."""
    text = run.explain()
    if is_compact(config):  # drop the last line: it names the scenario, as the file does
        text = text.rpartition("\n")[0]
    return f"run        {text}" if isinstance(exception, CheckFailed) else text


def summarise(report: pytest.TestReport, text: str) -> None:
    """Set the summary line of a report to a text, or to the first line of its message if the text is empty."""
    crash = getattr(report.longrepr, "reprcrash", None)
    if crash is not None:
        first = _COLOUR.sub("", crash.message).removeprefix("Failed: ").partition("\n")[0]
        crash.message = visible(text or first)


def _make_visible(report: pytest.TestReport) -> None:
    """Make the texts safe to display that are not part of a traceback: an error, the reason of a skip or an xfail."""
    match report.longrepr:
        case str() as text:
            report.longrepr = visible_lines(text)
        case (path, line, why):
            report.longrepr = (path, line, visible_lines(why))
    if hasattr(report, "wasxfail"):
        report.wasxfail = visible_lines(report.wasxfail)


def _fit(longrepr: Any, width: int, *, is_brief: bool) -> None:
    """Fit the lines of a failure's message into the width, but not lines of code; make all of them safe to display."""
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
