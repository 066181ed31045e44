"""``--pafot-table``: all runs of a session's searches in one file, written by the controller.

A CSV file grows with each generation, so a killed session leaves the runs so far. At the end, the rows are sorted by
test and run, so their order does not depend on the number of workers. A Parquet file cannot grow, and a stream cannot
be sorted later, so both are written at the end.
"""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from pytest_pafot.campaign.options import BY_NAME
from pytest_pafot.plugin import messages
from pytest_pafot.plugin.session import SUMMARY_LINES, not_written

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
        self._table: RunTable = RunTable()

    def __call__(self, event: SearchEvent) -> None:
        """Process an event of the search."""
        from pytest_pafot.campaign.events import SearchSummary  # noqa: PLC0415
        from pytest_pafot.searching.events import GenerationFinished  # noqa: PLC0415

        self._table.see(event)
        if isinstance(event, (GenerationFinished, SearchSummary)) and self._table.rows:
            messages.send(self._item, "runs", {"rows": [list(row.values()) for row in self._table.taken()]})


class Tables:
    """Hooks that write the table of runs, only on the controller."""

    def __init__(self, config: pytest.Config) -> None:
        from pytest_pafot.support.files import is_stream  # noqa: PLC0415

        self._config = config
        self._name: str = config.getoption(TABLE.key)
        self._path = Path(os.path.normpath(config.invocation_params.dir / self._name))
        self._is_parquet = self._path.suffix.lower() == ".parquet"
        self._grows = not (self._is_parquet or is_stream(self._path))
        self._rows: list[list[Any]] = []  # only of a table that does not grow
        self._is_begun = False
        self._problem = ""

    @pytest.hookimpl(trylast=True)
    def pytest_sessionstart(self) -> None:
        """Refuse a Parquet file without the package that writes it."""
        if self._is_parquet:
            try:
                import pyarrow  # noqa: F401, PLC0415
            except ImportError:
                fix = "pip install 'pytest-pafot[table]', or name a file that ends in .csv"
                raise pytest.UsageError(f"{TABLE.flag}={self._name}: expected pyarrow; {fix}") from None

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Begin the table with the first search, and write or store the rows that searches send."""
        message = messages.received(report)
        if message is None or message.kind not in ("start", "runs"):
            return
        self._begin()
        if message.kind == "runs" and self._grows:
            from pytest_pafot.support.files import append  # noqa: PLC0415

            self._write("not all runs were written", lambda: append(self._path, _text(message.data["rows"])))
        elif message.kind == "runs":
            self._rows += message.data["rows"]

    @pytest.hookimpl(trylast=True)
    def pytest_sessionfinish(self, exitstatus: int) -> None:
        """Sort the rows of the file, even if the session was interrupted."""
        lines = self._config.stash[SUMMARY_LINES]
        if not self._is_begun and exitstatus not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):
            lines.problems.append(f"{TABLE.flag}={self._name}: nothing was written, since no search ran")
            return
        with lines.faults(f"{TABLE.flag}={self._name}"):
            self._begin()
            self._write("its rows were not sorted" if self._grows else "not written", self._finish)
            if self._problem:
                lines.problems.append(f"{TABLE.flag}={self._name}: {self._problem}")
            else:
                lines.reports.append(f"table: {self._name}")

    def _begin(self) -> None:
        """Replace the file of an earlier session, before the first search of this one."""
        if self._grows and not self._is_begun:
            from pytest_pafot.campaign.run_table import COLUMNS  # noqa: PLC0415
            from pytest_pafot.support.files import write_whole  # noqa: PLC0415

            self._write("not written", lambda: write_whole(self._path, _text([list(COLUMNS)])))
        self._is_begun = True

    def _finish(self) -> None:
        from pytest_pafot.campaign.run_table import COLUMNS  # noqa: PLC0415
        from pytest_pafot.support.files import open_regular, write_whole  # noqa: PLC0415

        names, rows = list(COLUMNS), self._rows
        if self._grows:
            with open_regular(self._path) as file:
                rows = [*csv.reader(io.StringIO(file.read().decode()))][1:]
        test, run = names.index("test"), names.index("run")
        ordered = sorted(rows, key=lambda row: (row[test], int(row[run])))
        if not self._is_parquet:
            if ordered != rows or not self._grows:
                write_whole(self._path, _text([names, *ordered]))
            return
        import pyarrow  # noqa: PLC0415
        from pyarrow import parquet  # noqa: PLC0415

        table = io.BytesIO()
        parquet.write_table(pyarrow.Table.from_pylist([dict(zip(names, row, strict=True)) for row in ordered]), table)
        write_whole(self._path, table.getvalue())

    def _write(self, what: str, write: Callable[[], None]) -> None:
        """Write by a function, unless that has failed before; ``what`` says what is wrong with the file if it fails."""
        if not self._problem:
            why = not_written(self._config, self._name, self._path.parent, write)
            self._problem = f"{what}: {why}" if why else ""


def _text(rows: list[list[Any]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()
