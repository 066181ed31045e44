"""The lines of the user's own files that an ADS runs in its decisions.

They are recorded with ``sys.monitoring``, or before Python 3.12 with ``sys.settrace``, which a debugger or a
measurement of coverage may hold already. Nothing depends on them but what is told of a finding.
"""

from __future__ import annotations

import functools
import linecache
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

from pytest_pafot.findings.lines import Line
from pytest_pafot.support.source_files import is_users

HELD = "a debugger or a measurement of coverage holds Python's tracer"
"""Why lines cannot be recorded."""

_NAME = "pytest-pafot"


class LineTrace:
    """A recorder of the lines of files below a folder that run in some decisions of an ADS.

    Args:
        root: the folder of the project. Installed packages in it are left out.
    """

    def __init__(self, root: Path) -> None:
        self._root = root.resolve()
        self._is_own: dict[CodeType, bool] = {}
        self._lines: set[Line] = set()
        self._decisions = range(0)
        self._number = 0

    def watched(self, factory: Callable[..., Any]) -> Callable[..., Any]:
        """Return a factory of the same ADSs, the lines of whose decisions are recorded."""

        def make(*arguments: Any, **named: Any) -> Any:
            self._number = 0
            return _Watched(factory(*arguments, **named), self)

        return functools.wraps(factory, updated=())(make)

    def lines_in(self, run: Callable[[], object], decisions: range) -> frozenset[Line]:
        """Return the lines that ran in decisions of a run, which is made by ``run`` with an ADS that is watched."""
        self._lines, self._decisions = set(), decisions
        run()
        return frozenset(self._lines)

    @contextmanager
    def decision(self) -> Iterator[None]:
        """Record the lines of one decision, if it is one of those that are asked for."""
        number, self._number = self._number, self._number + 1
        if number not in self._decisions:
            yield
        elif sys.version_info >= (3, 12):
            with self._monitored():
                yield
        else:
            sys.settrace(self._traced)
            try:
                yield
            finally:
                sys.settrace(None)

    def _add(self, code: CodeType, number: int) -> None:
        function = code.co_qualname.partition(".<locals>.<")[0]  # a comprehension or lambda belongs to its function
        self._lines.add(Line(code.co_filename, number, function))

    def _owns(self, code: CodeType) -> bool:
        known = self._is_own.get(code)
        if known is None:
            file = Path(code.co_filename).resolve()
            known = self._is_own[code] = file.is_relative_to(self._root) and is_users(file)
        return known

    def _traced(self, frame: FrameType, event: str, argument: object) -> Any:
        if not self._owns(frame.f_code):
            return None
        if event == "line":
            self._add(frame.f_code, frame.f_lineno)
        return self._traced

    if sys.version_info >= (3, 12):

        @contextmanager
        def _monitored(self) -> Iterator[None]:
            events, tool = sys.monitoring.events, _free_tool()

            def on_line(code: CodeType, number: int) -> Any:
                if self._owns(code):
                    self._add(code, number)
                return sys.monitoring.DISABLE  # it need not be told again in this decision

            assert tool is not None  # noqa: S101  (see why_not)
            sys.monitoring.use_tool_id(tool, _NAME)
            try:
                sys.monitoring.register_callback(tool, events.LINE, on_line)
                sys.monitoring.restart_events()
                sys.monitoring.set_events(tool, events.LINE)
                yield
            finally:
                sys.monitoring.set_events(tool, events.NO_EVENTS)
                sys.monitoring.register_callback(tool, events.LINE, None)
                sys.monitoring.free_tool_id(tool)


class _Watched:
    """An ADS, with all its attributes, the lines of whose decisions are recorded."""

    def __init__(self, ads: Any, trace: LineTrace) -> None:
        self._ads, self._trace = ads, trace

    def __getattr__(self, name: str) -> Any:
        return getattr(self._ads, name)

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        with self._trace.decision():
            return self._ads(*arguments, **named)


def why_not() -> str:
    """Return why no lines can be recorded now; empty if they can."""
    if sys.version_info >= (3, 12):
        return "" if _free_tool() is not None else HELD
    return "" if sys.gettrace() is None else HELD


def _free_tool() -> int | None:
    if sys.version_info >= (3, 12):
        return next((each for each in (3, 4) if sys.monitoring.get_tool(each) is None), None)
    return None


def text_of(line: Line) -> str:
    """Return a line of source text without indentation."""
    return linecache.getline(line.file, line.number).strip()
