"""What code says while it runs in another process: printed text, log records and warnings, said again in this one.

pytest gathers all three in memory of the process that runs the item, where nothing that another process says arrives.
"""

from __future__ import annotations

import contextlib
import io
import logging
import sys
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from logging.handlers import QueueHandler
from queue import SimpleQueue
from typing import Any


@dataclass(frozen=True, slots=True, kw_only=True)
class Warned:
    """A warning without the objects that it may hold on to."""

    text: str
    category: type[Warning]
    file: str
    line: int


@dataclass(slots=True, kw_only=True)
class Echo:
    """What was said, in the order in which it was said, each kind for itself.

    Attributes:
        out, err: text for the standard streams.
        records: for the handlers of the root logger.
        warned: warnings that the filters let pass.
    """

    out: str = ""
    err: str = ""
    records: list[logging.LogRecord] = field(default_factory=list)
    warned: list[Warned] = field(default_factory=list)

    def repeat(self) -> None:
        """Say it in this process."""
        for stream, text in ((sys.stdout, self.out), (sys.stderr, self.err)):
            if text:
                stream.write(text)
        for record in self.records:
            logging.getLogger().callHandlers(record)
        with warnings.catch_warnings():
            warnings.simplefilter("always")  # The filters have had their say where the warning arose.
            for each in self.warned:
                warnings.warn_explicit(each.text, each.category, each.file, each.line)


@contextlib.contextmanager
def listening() -> Iterator[Echo]:
    """Gather what is said inside; it is complete at the end."""
    echo = Echo()
    out, err = _Stream(), _Stream()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), _records(echo), _warnings(echo):
        yield echo
    echo.out, echo.err = out.text, err.text


class _Stream(io.TextIOWrapper):
    """In memory, and like a standard stream also for bytes."""

    def __init__(self) -> None:
        self._bytes = io.BytesIO()
        super().__init__(self._bytes, encoding="utf-8", errors="replace", newline="", write_through=True)

    def close(self) -> None:
        """Stay open: whoever closes a standard stream does not take back what was said on it."""

    @property
    def text(self) -> str:
        return self._bytes.getvalue().decode("utf-8", "replace")


@contextlib.contextmanager
def _records(echo: Echo) -> Iterator[None]:
    root, queue = logging.getLogger(), SimpleQueue[logging.LogRecord]()
    before, root.handlers = root.handlers, [QueueHandler(queue)]
    try:
        yield
    finally:
        root.handlers = before
        while not queue.empty():
            echo.records.append(queue.get())


@contextlib.contextmanager
def _warnings(echo: Echo) -> Iterator[None]:
    def note(
        message: Warning | str, category: type[Warning], filename: str, lineno: int, file: Any = None, line: Any = None
    ) -> None:
        echo.warned.append(Warned(text=str(message), category=category, file=filename, line=lineno))

    with warnings.catch_warnings():
        warnings.showwarning = note
        yield
