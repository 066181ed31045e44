"""``--pafot-table``: all runs of a session's searches in one file, written by the controller.

A CSV file grows with each generation, so a killed session leaves the runs so far. At the end, the rows are sorted by
test and run, so their order does not depend on the number of workers. Until then a temporary file stores them, so that
the memory of the session does not grow with the number of runs. A Parquet file cannot grow, and a stream cannot be
sorted later, so both are written at the end.
"""

from __future__ import annotations

import csv
import io
import json
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator
from itertools import chain, islice
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, NamedTuple

import pytest

from pytest_pafot.campaign.options import BY_NAME
from pytest_pafot.plugin import messages
from pytest_pafot.plugin.session import SUMMARY_LINES, not_written
from pytest_pafot.plugin.tracing import traced
from pytest_pafot.support.errors import flag, install
from pytest_pafot.support.text import spreadsheet_cell

if TYPE_CHECKING:
    from pytest_pafot.campaign.events import SearchEvent
    from pytest_pafot.campaign.run_table import RunTable

TABLE = BY_NAME["table"]


def table_messages_of(item: pytest.Item) -> TableMessages | None:
    """Return the sender of a search's rows; None if no table is requested."""
    return TableMessages(item) if item.config.getoption(TABLE.key) else None


class TableMessages:
    """A sender of the rows of a search to the controller, one generation at a time."""

    def __init__(self, item: pytest.Item) -> None:
        from pytest_pafot.campaign.run_table import RunTable  # noqa: PLC0415

        self._item = item
        self._table: RunTable = RunTable(requirements=traced(item).ids or None)

    def __call__(self, event: SearchEvent) -> None:
        """Process an event of the search."""
        from pytest_pafot.campaign.events import SearchSummary  # noqa: PLC0415
        from pytest_pafot.searching.events import GenerationFinished  # noqa: PLC0415

        self._table.see(event)
        if isinstance(event, (GenerationFinished, SearchSummary)) and self._table.rows:
            messages.send(self._item, "runs", {"rows": [list(row.values()) for row in self._table.taken()]})


class Tables:
    """The writer of the table of runs, only on the controller."""

    def __init__(self, config: pytest.Config) -> None:
        from pytest_pafot.support.files import is_stream  # noqa: PLC0415

        self._config = config
        self._name: str = config.getoption(TABLE.key)
        self._path = Path(os.path.normpath(config.invocation_params.dir / self._name))
        self._is_parquet = self._path.suffix.lower() == ".parquet"
        self._grows = not (self._is_parquet or is_stream(self._path))
        self._rows = StoredRows()
        self._is_begun = False
        self._problem = ""

    @pytest.hookimpl(trylast=True)
    def pytest_sessionstart(self) -> None:
        """Refuse a Parquet file without the package that writes it."""
        if self._is_parquet:
            try:
                import pyarrow  # noqa: F401, PLC0415
            except ImportError:
                fix = f"{install('table')}, or name a file that ends in .csv"
                raise pytest.UsageError(f"{flag('table', self._name)}: expected pyarrow; {fix}") from None

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Begin the table with the first search, and write or store the rows that searches send."""
        message = messages.received(report)
        if message is None or message.kind not in ("start", "runs"):
            return
        self._begin()
        if message.kind == "runs":
            rows = message.data["rows"]
            self._write("not all runs were written", lambda: self._rows.add(rows))
            if self._grows:
                from pytest_pafot.support.files import append  # noqa: PLC0415

                self._write("not all runs were written", lambda: append(self._path, _text(rows)))

    @pytest.hookimpl(trylast=True)
    def pytest_sessionfinish(self, exitstatus: int) -> None:
        """Sort the rows of the file, even if the session was interrupted."""
        lines = self._config.stash[SUMMARY_LINES]
        if not self._is_begun and exitstatus not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):
            lines.problems.append(f"{flag('table', self._name)}: nothing was written, since no search ran")
            return
        with lines.faults(flag("table", self._name)):
            self._begin()
            self._write("its rows were not sorted" if self._grows else "not written", self._finish)
            if self._problem:
                lines.problems.append(f"{flag('table', self._name)}: {self._problem}")
            else:
                lines.reports.append(f"table: {self._name}")
        self._rows.close()

    def _begin(self) -> None:
        """Replace the file of an earlier session, before the first search of this one."""
        if self._grows and not self._is_begun:
            from pytest_pafot.campaign.run_table import COLUMNS  # noqa: PLC0415
            from pytest_pafot.support.files import write_whole  # noqa: PLC0415

            self._write("not written", lambda: write_whole(self._path, _text([list(COLUMNS)])))
        self._is_begun = True

    def _finish(self) -> None:
        from pytest_pafot.campaign.run_table import COLUMNS  # noqa: PLC0415
        from pytest_pafot.support.files import write_whole  # noqa: PLC0415

        if self._is_parquet:
            write_whole(self._path, _parquet(list(COLUMNS), self._rows))
        elif not (self._grows and self._rows.are_ordered):
            write_whole(self._path, _text(chain([list(COLUMNS)], self._rows)))

    def _write(self, what: str, write: Callable[[], None]) -> None:
        """Write by a function, unless that has failed before; ``what`` says what is wrong with the file if it fails."""
        if not self._problem:
            why = not_written(self._config, self._name, self._path.parent, write)
            self._problem = f"{what}: {why}" if why else ""


class _Part(NamedTuple):
    """The rows of one message: those of one search, in the order of its runs, from a position of the temporary file."""

    test: str
    run: int
    position: int


class StoredRows:
    """Rows in a temporary file without a name, which disappears with the process, however it ends."""

    def __init__(self) -> None:
        self._file: IO[bytes] | None = None
        self._parts: list[_Part] = []

    def add(self, rows: list[list[Any]]) -> None:
        """Store the rows of a message.

        Raises:
            OSError: if the file cannot be written.
        """
        from pytest_pafot.campaign.run_table import COLUMNS  # noqa: PLC0415

        if self._file is None:
            self._file = tempfile.TemporaryFile()  # noqa: SIM115  (open until the session ends)
        first = dict(zip(COLUMNS, rows[0], strict=True))
        self._parts.append(_Part(first["test"], first["run"], self._file.seek(0, os.SEEK_END)))
        self._file.write(json.dumps(rows).encode() + b"\n")
        self._file.flush()

    @property
    def are_ordered(self) -> bool:
        """True if the rows were added in the order of the table, as those of a session without workers usually are."""
        return sorted(self._parts) == self._parts

    def close(self) -> None:
        """Remove the file."""
        if self._file is not None:
            self._file.close()

    def __iter__(self) -> Iterator[list[Any]]:
        """Yield the rows by test and run."""
        for part in sorted(self._parts):
            assert self._file is not None  # noqa: S101  (there are parts)
            self._file.seek(part.position)
            yield from json.loads(self._file.readline())


AT_ONCE = 10_000
"""The number of rows of a Parquet file that are in memory at once."""


def _parquet(names: list[str], rows: StoredRows) -> bytes:
    """Return the content of a Parquet file. The types of its columns follow from all rows."""
    import pyarrow  # noqa: PLC0415
    from pyarrow import parquet  # noqa: PLC0415

    def pieces() -> Iterator[Any]:
        left = iter(rows)
        while some := [dict(zip(names, row, strict=True)) for row in islice(left, AT_ONCE)]:
            yield pyarrow.Table.from_pylist(some)

    empty = pyarrow.Table.from_pylist([])
    schemas = [piece.schema for piece in pieces()] or [empty.schema]
    schema = pyarrow.unify_schemas(schemas, promote_options="permissive")
    file = io.BytesIO()
    with parquet.ParquetWriter(file, schema) as writer:
        for piece in pieces():
            writer.write_table(piece.cast(schema))
    return file.getvalue()


def _text(rows: Iterable[list[Any]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(map(spreadsheet_cell, row) for row in rows)
    return text.getvalue()
