"""Capture of the output of code in a different process: printed text, log records and warnings.

The process of the test repeats the captured output, because pytest captures only the output of that process.
"""

from __future__ import annotations

import io
import logging
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from logging.handlers import QueueHandler
from queue import SimpleQueue


@dataclass(slots=True, kw_only=True)
class CapturedOutput:
    """The captured output: printed text, log records and warnings, each in the order in which they occurred.

    A warning that passes the filters is stored as text, category, file and line, without the objects that it refers to.
    """

    out: str = ""
    err: str = ""
    records: list[logging.LogRecord] = field(default_factory=list)
    warned: list[tuple[str, type[Warning], str, int]] = field(default_factory=list)

    def repeat(self) -> None:
        """Print the texts, handle the log records and issue the warnings in this process."""
        for stream, text in ((sys.stdout, self.out), (sys.stderr, self.err)):
            if text:
                stream.write(text)
        for record in self.records:
            logging.getLogger().callHandlers(record)
        with warnings.catch_warnings():
            warnings.simplefilter("always")  # They passed the filters of the process in which they were raised.
            for each in self.warned:
                warnings.warn_explicit(*each)


@contextmanager
def capture_output() -> Iterator[CapturedOutput]:
    """Capture the output of the code in the ``with`` block; it is complete when the block ends."""
    captured, out, err = CapturedOutput(), _Stream(), _Stream()
    root, queue = logging.getLogger(), SimpleQueue[logging.LogRecord]()
    handlers, root.handlers = root.handlers, [QueueHandler(queue)]
    try:
        with redirect_stdout(out), redirect_stderr(err), warnings.catch_warnings(record=True) as warned:
            yield captured
    finally:
        root.handlers = handlers
    captured.out, captured.err = out.text, err.text
    captured.records = [queue.get() for _ in range(queue.qsize())]
    captured.warned = [(str(each.message), each.category, each.filename, each.lineno) for each in warned]


class _Stream(io.TextIOWrapper):
    """A text stream in memory that accepts bytes as well, like a standard stream."""

    def __init__(self) -> None:
        self._bytes = io.BytesIO()
        super().__init__(self._bytes, encoding="utf-8", errors="replace", newline="", write_through=True)

    def close(self) -> None:
        """Stay open, so that code that closes a standard stream does not lose its earlier output."""

    @property
    def text(self) -> str:
        return self._bytes.getvalue().decode("utf-8", "replace")
