"""``--pafot-table``: all runs of a session's searches in one file, written by the controller.

A CSV file grows with each generation, so a killed session leaves the runs so far. At the end, the rows are sorted by
test and run, so their order does not depend on the number of workers.
"""

from __future__ import annotations

import csv
import io
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from pytest_pafot.campaign.options import BY_NAME
from pytest_pafot.plugin import messages
from pytest_pafot.plugin.session import SUMMARY_LINES, refused_output
from pytest_pafot.support.ways_out import flag, install

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
        self._config = config
        self._name: str = config.getoption(TABLE.key)
        self._path = Path(os.path.normpath(config.invocation_params.dir / self._name))
        self._is_parquet = self._path.suffix.lower() == ".parquet"
        self._rows: list[list[Any]] = []  # only for a Parquet file, which cannot grow
        self._problem = refused_output(config, self._name, self._path.parent)

    @pytest.hookimpl(trylast=True)
    def pytest_sessionstart(self) -> None:
        """Replace the file of an earlier session."""
        from pytest_pafot.campaign.run_table import COLUMNS  # noqa: PLC0415

        if self._is_parquet:
            try:
                import pyarrow  # noqa: F401, PLC0415
            except ImportError:
                fix = f"{install('table')}, or name a file that ends in .csv"
                raise pytest.UsageError(f"{flag('table', self._name)}: expected pyarrow; {fix}") from None
        else:
            self._write("w", [list(COLUMNS)])

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Write or store the rows that a search sends."""
        message = messages.received(report)
        if message is None or message.kind != "runs":
            return
        if self._is_parquet:
            self._rows += message.data["rows"]
        else:
            self._write("a", message.data["rows"])

    @pytest.hookimpl(trylast=True)
    def pytest_sessionfinish(self) -> None:
        """Sort the rows of the file, even if the session was interrupted."""
        lines = self._config.stash[SUMMARY_LINES]
        if not self._problem:
            self._finish()
        if self._problem:
            lines.problems.append(f"{flag('table', self._name)}: not written: {self._problem}")
        else:
            lines.reports.append(f"table: {self._name}")

    def _finish(self) -> None:
        from pytest_pafot.campaign.run_table import COLUMNS  # noqa: PLC0415
        from pytest_pafot.support.files import write_whole  # noqa: PLC0415

        names = list(COLUMNS)
        test, run = names.index("test"), names.index("run")
        try:
            if self._is_parquet:
                import pyarrow  # noqa: PLC0415
                from pyarrow import parquet  # noqa: PLC0415

                rows = sorted(self._rows, key=lambda row: (row[test], row[run]))
                cells = [dict(zip(names, row, strict=True)) for row in rows]
                file = io.BytesIO()
                parquet.write_table(pyarrow.Table.from_pylist(cells), file)
                write_whole(self._path, file.getvalue())
                return
            header, *written = csv.reader(io.StringIO(self._path.read_text(encoding="utf-8")))
            written.sort(key=lambda row: (row[test], int(row[run])))
            write_whole(self._path, _text([header, *written]))
        except OSError as error:
            self._fail(error)

    def _write(self, mode: str, rows: list[list[Any]]) -> None:
        if self._problem:
            return
        try:
            with self._path.open(mode, encoding="utf-8", newline="") as file:
                file.write(_text(rows))
        except OSError as error:
            self._fail(error)

    def _fail(self, error: OSError) -> None:
        from pytest_pafot.support.files import way_out  # noqa: PLC0415

        self._problem = f"{error.strerror or error}; {way_out(error, 'or name another file')}"


def _text(rows: list[list[Any]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()
