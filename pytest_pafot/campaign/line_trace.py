"""The lines of the user's own files that an ADS runs in its decisions.

They are recorded with ``sys.monitoring``, or before Python 3.12 with ``sys.settrace``, which a debugger or a
measurement of coverage may hold already. Nothing depends on them but what is told of a finding.
"""

from __future__ import annotations

import functools
import importlib.util
import linecache
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

from pytest_pafot.findings.lines import Line
from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.source_files import is_users

HELD = "a debugger or a measurement of coverage holds Python's tracer"
"""Why lines cannot be recorded."""

_NAME = "pytest-pafot"


def places_of(names: str | None) -> list[Path]:
    """Return the files and folders of installed packages or folders, which are named as words of a shell.

    Raises:
        RequestError: for a name that is neither.
    """
    try:
        words = shlex.split(names or "")
    except ValueError as error:
        raise RequestError(f"lines: expected names with spaces between them, received {names!r}: {error}") from None
    found = []
    for name in words:
        spec = importlib.util.find_spec(name) if name.isidentifier() and name != "__main__" else None
        origin = [] if spec is None or not spec.origin else [spec.origin]
        places = [] if spec is None else [*(spec.submodule_search_locations or ()), *origin]
        paths = [Path(place) for place in (places if spec is not None else [name])]
        paths = [path for path in paths if path.exists()]
        if not paths:
            raise RequestError(f"lines: expected installed packages and folders, received {name!r}; correct the name")
        found += [path.parent if path.name == "__init__.py" else path for path in paths]
    return list(dict.fromkeys(found))


class LineTrace:
    """A recorder of the lines of the user's files that run in some decisions of an ADS.

    These are files outside of the folders of installed packages: of the project, and of packages that are installed in
    editable form.

    Args:
        named: further files and folders, such as those of :func:`places_of`.
    """

    def __init__(self, named: Sequence[Path] = ()) -> None:
        self._named = [path.resolve() for path in named]
        self._is_own: dict[CodeType, bool] = {}
        self._lines: dict[Line, set[int]] = {}
        self._decisions = range(0)
        self._number = 0

    def watched(self, factory: Callable[..., Any]) -> Callable[..., Any]:
        """Return a factory of the same ADSs, the lines of whose decisions are recorded."""

        def make(*arguments: Any, **named: Any) -> Any:
            self._number = 0
            return _Watched(factory(*arguments, **named), self)

        return functools.wraps(factory, updated=())(make)

    def lines_in(self, run: Callable[[], object], decisions: range) -> dict[Line, int]:
        """Return the lines that ran in decisions of a run, each with the number of decisions in which it ran.

        The run is made by ``run`` with an ADS that is watched.
        """
        self._lines, self._decisions = {}, decisions
        run()
        return {line: len(numbers) for line, numbers in self._lines.items()}

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
        self._lines.setdefault(Line(code.co_filename, number, function), set()).add(self._number)

    def _owns(self, code: CodeType) -> bool:
        known = self._is_own.get(code)
        if known is None:
            file = Path(code.co_filename).resolve()
            is_named = any(file.is_relative_to(path) for path in self._named)
            known = self._is_own[code] = is_named or (is_users(file) and file.is_file())
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
