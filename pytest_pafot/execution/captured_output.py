"""What code says while it runs in another process: printed text, log records and warnings, said again in this one.

pytest gathers all three in memory of the process that runs the item, where nothing that another process says arrives.
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
    """What was said, each kind in the order in which it was said.

    Of warnings that the filters let pass it has text, category, file and line, without objects they hold on to.
    """

    out: str = ""
    err: str = ""
    records: list[logging.LogRecord] = field(default_factory=list)
    warned: list[tuple[str, type[Warning], str, int]] = field(default_factory=list)

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
                warnings.warn_explicit(*each)


@contextmanager
def capture_output() -> Iterator[CapturedOutput]:
    """Capture what is said inside; it is complete at the end."""
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
    """In memory, and like a standard stream also for bytes."""

    def __init__(self) -> None:
        self._bytes = io.BytesIO()
        super().__init__(self._bytes, encoding="utf-8", errors="replace", newline="", write_through=True)

    def close(self) -> None:
        """Stay open: whoever closes a standard stream does not take back what was said on it."""

    @property
    def text(self) -> str:
        return self._bytes.getvalue().decode("utf-8", "replace")
