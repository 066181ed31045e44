"""The table of ``python -m pytest_pafot corpus list``: a row for each saved scenario, to decide what comes first.

No scenario is run. A row joins what the file says, what the marks of its test say, the commit that added the file, and
the labels of its replays in earlier sessions.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path
from typing import Any

from pytest_pafot.commands.history import Since, place_of
from pytest_pafot.commands.inventory import Inventory
from pytest_pafot.commands.results import Session
from pytest_pafot.corpus.saved import Saved
from pytest_pafot.findings.severity import Severity
from pytest_pafot.findings.shrink import size_of
from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.text import ascii_text, wrapped_to

COLUMNS = ("id", "test", "what", "severity", "who", "state", "since")

GAP = "  "
"""The space between two columns of text."""

BELOW = ("what", "test", "since", "who", "state", "severity")
"""The columns that move to a line of their own below a row that is too wide. Those at the end stay if they fit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """A saved scenario, with what is known of it.

    Attributes:
        saved: the file with its finding, or with the reason why it cannot be read.
        severity: how bad the failure is; None if nothing measures it, or if an older file does not store it.
        state: what has become of it, in words.
        since: the commit that added the file; None if that is not known.
    """

    saved: Saved
    severity: Severity | None
    state: str
    since: Since | None

    @property
    def cells(self) -> dict[str, str]:
        """The texts of the row, by column."""
        finding = self.saved.finding
        return {
            "id": self.saved.id,
            "test": "" if finding is None else finding.test.partition("::")[2],
            "what": self.saved.error if finding is None else finding.expect.brief,
            "severity": "" if self.severity is None else str(self.severity),
            "who": "" if finding is None else finding.expect.responsibility,
            "state": self.state,
            "since": "" if self.since is None else " ".join(self.since),
        }

    @property
    def rank(self) -> tuple[Any, ...]:
        """The key that sorts rows: the worst first, and files that cannot be read last."""
        finding, names = self.saved.finding, (self.saved.id, self.saved.path.as_posix())
        if finding is None:
            return True, *Severity.worst_first("none", None), *names
        return False, *Severity.worst_first(finding.expect.responsibility, self.severity), *names

    @property
    def data(self) -> dict[str, Any]:
        """The row as plain data, for programs."""
        return data_of(self.saved) | {
            "severity": None if self.severity is None else asdict(self.severity),
            "state": self.state,
            "since": None if self.since is None else dict(zip(("commit", "day"), self.since, strict=True)),
        }


def data_of(saved: Saved) -> dict[str, Any]:
    """Return a saved scenario as plain data: its path and its finding, or why the file cannot be read."""
    finding, file = saved.finding, saved.path.as_posix()
    if finding is None:
        return {"file": file, "id": saved.id, "error": saved.error}
    expect = finding.expect
    return {
        "file": file,
        "id": finding.id,
        "test": finding.test,
        "kind": finding.signature.slug,
        "event": expect.event,
        "failure": expect.failure,
        "assertion": expect.assertion,
        "outcome": str(expect.outcome),
        "time": expect.time,
        "responsibility": expect.responsibility,
        "preventable_by": list(expect.preventable_by),
        "size": size_of(finding.scenario, finding.longest_run),
        "algorithm": finding.found.algorithm,
        "seed": finding.found.seed,
        "flaky": finding.flaky,
        "xfail": finding.xfail,
        "xfail_until": None if finding.xfail_until is None else finding.xfail_until.isoformat(),
        "xfail_flaky": finding.xfail_flaky,
    }


def rows_of(
    files: Iterable[Saved],
    *,
    inventory: Inventory,
    added: Mapping[Path, Since],
    labels: Mapping[str, Sequence[tuple[str, str]]],
    today: date,
) -> list[Row]:
    """Return the rows of saved scenarios, the worst first.

    Args:
        files: the files as read.
        inventory: the saved scenarios whose test is gone.
        added: the commit that added each file, see :func:`~pytest_pafot.commands.history.added_in`.
        labels: the labels of replays, see :func:`labels_in`.
        today: the day with which the last days of accepted failures are compared.
    """
    orphans = {place_of(inventory.root / file) for file in inventory.orphans}
    rows = []
    for saved in files:
        place, finding = place_of(saved.path), saved.finding
        state = _state(saved, place in orphans, _label(place, labels.get(place.name, ())), today)
        rows.append(
            Row(
                saved=saved,
                severity=None if finding is None else Severity.in_file(finding.expect),
                state=state,
                since=added.get(place),
            )
        )
    return sorted(rows, key=lambda row: row.rank)


def _label(place: Path, labels: Sequence[tuple[str, str]]) -> str:
    """Return the last label of a file; results name files relative to the rootdir of their session."""
    return next((label for file, label in reversed(labels) if f"/{place.as_posix()}".endswith(f"/{file}")), "")


def _state(saved: Saved, is_orphan: bool, label: str, today: date) -> str:
    finding = saved.finding
    if finding is None:
        return "broken"
    parts = [label, "orphaned" if is_orphan else ""]
    if finding.is_accepted(today):
        parts.append("accepted" if finding.xfail_until is None else f"accepted until {finding.xfail_until}")
    elif finding.xfail is not None:
        parts.append(f"expired {finding.xfail_until}")
    parts.append("flaky" if finding.flaky is not None or finding.xfail_flaky else "")
    return ", ".join(dict.fromkeys(filter(None, parts))) or "open"


def labels_in(results: Iterable[Path]) -> dict[str, list[tuple[str, str]]]:
    """Return the labels of replays in the results of sessions (``--pafot-json``), by the names of the files.

    Each label comes with the path of its file in that session, and the last session is last.

    Raises:
        RequestError: if a file cannot be read, or has no results.
    """
    found: dict[str, list[tuple[str, str]]] = {}
    for session in Session.grouped(map(Session.read, results)):
        for entry in session.findings:
            file = entry.get("file")
            label = entry.get("status", "")
            if entry.get("result") in ("failed", "error") and entry.get("headline") and "failing" not in label:
                # such as a crash that is harder than the one in the file, which has drifted
                label = f"failing, {label}"
            if file:
                found.setdefault(file.rpartition("/")[2], []).append((file, label))
    return found


# Filtering.


def checked_column(name: str) -> str:
    """Return the name of a column.

    Raises:
        RequestError: if there is no such column.
    """
    if name not in COLUMNS:
        near = difflib.get_close_matches(name, COLUMNS, n=1)
        fix = f"; did you mean {near[0]}?" if near else ""
        raise RequestError(f"expected one of {', '.join(COLUMNS)}, received {name!a:.50}{fix}")
    return name


def condition(text: str) -> tuple[str, str]:
    """Return the column and the text of a condition such as ``who=ego``."""
    column, separator, wanted = text.partition("=")
    if not separator:
        raise RequestError(f"expected COLUMN=TEXT, such as who=ego, received {text!a:.50}")
    return checked_column(column), wanted


def holds(row: Row, conditions: Iterable[tuple[str, str]]) -> bool:
    """Return whether a row fulfils all conditions: its cell contains the text, or is empty for an empty text."""
    cells = row.cells
    return all(
        wanted.casefold() in cells[column].casefold() if wanted else not cells[column] for column, wanted in conditions
    )


# Writing.


def text_of_table(rows: Sequence[Row], width: int) -> str:
    """Return rows as a text, wrapped to a width. A column that is empty in all rows is left out."""
    cells = [[row.cells[column] for column in COLUMNS] for row in rows]
    return "".join(f"{line}\n" for line in _lines(cells, width)) if rows else "no saved scenarios\n"


def _lines(rows: Sequence[Sequence[str]], width: int) -> Iterator[str]:
    """Yield the lines of a table: one for each row, and if that is too wide, the rest of the row below it."""
    texts = {name: list(map(ascii_text, cells)) for name, *cells in zip(COLUMNS, *rows, strict=True)}
    widths = {name: max(map(len, (name, *cells))) for name, cells in texts.items() if any(cells)}
    below: list[str] = []
    left = width - widths["id"]
    for name in (each for each in reversed(BELOW) if each in widths):
        if widths[name] + len(GAP) <= left:
            left -= widths[name] + len(GAP)
        else:
            below.insert(0, name)
            del widths[name]
    for number in range(-1, len(rows)):
        cells = {name: name if number < 0 else texts[name][number] for name in COLUMNS}
        yield GAP.join(f"{cells[name]:{room}}" for name, room in widths.items()).rstrip()
        rest = [cells[name] if name in ("what", "test") else f"{name} {cells[name]}" for name in below if cells[name]]
        if rest and number >= 0:
            yield from wrapped_to(f"    {'; '.join(rest)}", width, phrases=True)
