"""CSV files as untrusted data, strictly: limits of size, finite numbers, and errors with file, line and column."""

from __future__ import annotations

import csv
import math
from array import array
from collections.abc import Iterator, Mapping, Sequence
from itertools import count, islice, pairwise
from pathlib import Path
from typing import TextIO

import numpy as np

from pytest_pafot.extending import HEADING, SPEED, FloatArray, Lane, X, Y
from pytest_pafot.extras.recordings.recording import LONGEST_GAP, STANDING, RecordedVehicle, RecordingError

MOST_BYTES = 2**31
"""The largest table [bytes]. The largest recordings of highD have 0.1 GB, the whole of NGSIM's I-80 0.8 GB."""
MOST_ROWS = 3_000_000
"""The largest number of rows that are kept. A row takes 48 bytes."""
MOST_VEHICLES = 20_000
"""The largest number of vehicles, each part of one that was lost in between counted. highD and NGSIM have 3,000."""
LONGEST_LINE = 100_000
"""The longest line [characters]; the longest header of the data sets has 300."""
MOST_FILLED = 100
"""The most rows that are filled in for each row of a vehicle: those of a second at 100 rows per second. A table with a
wrong rate, or times that hardly differ, could have more of them than there is memory."""
LARGEST = 1e9
"""The largest number that a cell may have; data sets have coordinates on a map in metres, and times in seconds."""
A_PART = "read a part of it, such as between=(0, 60) in seconds"
"""The way out for a table that is too large."""

Between = tuple[float, float] | None
"""The first and the last time of the rows to keep, on the clock of the data [s]; None for all."""


class Table:
    """A CSV file with a header, whose columns are known by name, in upper or lower case."""

    def __init__(self, path: Path) -> None:
        self.path = path
        size = path.stat().st_size
        if size > MOST_BYTES:
            raise self.error(None, "", f"at most {MOST_BYTES} bytes", f"{size}", "cut it into several files")
        self._names = [name.strip().lower() for name in next((row for _, row in self._rows()), [])]
        self.columns = {name: index for index, name in enumerate(self._names)}

    def _rows(self) -> Iterator[tuple[int, list[str]]]:
        """Yield the cells of each row that is not empty, from the header on, and the line in which it ends."""
        fix = "save it as plain CSV"

        def lines(file: TextIO) -> Iterator[str]:
            for number in count(1):
                line = file.readline(LONGEST_LINE)
                if len(line) == LONGEST_LINE:
                    raise self.error(number, "", f"lines below {LONGEST_LINE} characters", "a longer one", fix)
                if not line:
                    return
                yield line

        with self.path.open(encoding="utf-8-sig", errors="replace", newline="") as file:
            reader = csv.reader(lines(file), strict=True)
            try:
                for row in reader:
                    if row:
                        yield reader.line_num, row
            except csv.Error as error:
                raise self.error(reader.line_num, "", "cells between commas", str(error), fix) from None

    def rows(self, texts: Sequence[str], numbers: Sequence[str]) -> Iterator[tuple[int, list[str], list[float]]]:
        """Yield of each row its line, the texts in some columns, and the finite numbers in others.

        Raises:
            RecordingError: if a column is missing or there twice, a row has too few cells or too many, or a cell has no
                number.
        """
        for name in (*texts, *numbers):
            if name.lower() not in self.columns:
                fix = "take the file as the data set has it"
                raise self.error(1, name, "this column", f"{', '.join(self.columns)[:200]}", fix)
            if self._names.count(name.lower()) > 1:
                raise self.error(1, name, "one column of this name", "several", "rename those that are something else")
        words = [self.columns[name.lower()] for name in texts]
        places = [self.columns[name.lower()] for name in numbers]
        longest = max([*words, *places])
        for line, row in islice(self._rows(), 1, None):
            if len(row) <= longest:
                raise self.error(line, "", f"at least {longest + 1} cells", f"{len(row)}", "the file may be cut off")
            if any(cell.strip() for cell in row[len(self._names) :]):  # a comma too many shifts all cells behind it
                fix = "write numbers with decimal points, and names with commas in quotes"
                raise self.error(line, "", f"{len(self._names)} cells, as in the first line", f"{len(row)}", fix)
            values = []
            for name, place in zip(numbers, places, strict=True):
                number = _number(row[place])
                if number is None:
                    fix = "correct the cell or leave out the row"
                    raise self.error(line, name, "a finite number", f"{row[place]!r:.60}", fix)
                values.append(number)
            yield line, [row[place].strip() for place in words], values

    def only(self, texts: Sequence[str], numbers: Sequence[str]) -> tuple[list[str], list[float]]:
        """Return the first row of a file that describes a whole recording."""
        for _, words, values in self.rows(texts, numbers):
            return words, values
        raise self.error(2, "", "a row", "none", "the file may be cut off")

    def error(self, line: int | None, column: str, expected: str, received: str, fix: str) -> RecordingError:
        """Return an error about a cell, a row or the file."""
        return RecordingError(self.path, expected, received, fix, field=column, line=line)


def _number(text: str) -> float | None:
    try:
        number = float(text)
    except ValueError:
        return None
    return number if abs(number) <= LARGEST and "_" not in text else None  # NaN is not, either


def beside(path: Path, name: str) -> Table:
    """Return the table that belongs to ``..tracks.csv``, such as ``..tracksMeta.csv`` in the same folder.

    Raises:
        RecordingError: if there is none.
    """
    other = path.with_name(path.name.replace("tracks", name))
    if other == path or not other.is_file():
        fix = "keep the three files of a recording in one folder, with their names"
        raise RecordingError(path, f"the file {other.name if other != path else name} next to it", "none", fix)
    return Table(other)


class Tracks:
    """The rows of a table by vehicle, in the order in which the vehicles come."""

    def __init__(self, table: Table, between: Between) -> None:
        self._table = table
        self._first, self._last = between or (-math.inf, math.inf)
        self._rows: dict[str, array[float]] = {}
        self._count = 0

    def add(self, line: int, name: str, row: Sequence[float]) -> None:
        """Keep a row: its time, and numbers of which all rows have as many."""
        if self._first <= row[0] <= self._last:
            self._count += 1
            self._rows.setdefault(name, array("d")).extend(row)
            if self._count > MOST_ROWS:
                raise self._table.error(line, "", f"at most {MOST_ROWS} rows", "more", A_PART)
            if len(self._rows) > MOST_VEHICLES:
                raise self._table.error(line, "", f"at most {MOST_VEHICLES} vehicles", "more", A_PART)

    def by_vehicle(self, columns: int) -> Iterator[tuple[str, FloatArray]]:
        """Yield the name of each vehicle, and its rows in the order of their times; shape [rows, columns].

        Raises:
            RecordingError: if there are no rows, a vehicle has two at the same time, or too many are lost in between.
        """
        if not self._rows:
            is_cut = self._first > -math.inf
            fix = "give another time as between=" if is_cut else "the file may be cut off"
            raise self._table.error(None, "", "rows" + " at that time" * is_cut, "none", fix)
        count = 0
        for name, numbers in self._rows.items():
            rows = np.array(numbers).reshape(-1, columns)
            rows = rows[np.argsort(rows[:, 0], kind="stable")]
            twice = np.flatnonzero(np.diff(rows[:, 0]) <= 0)
            if len(twice):
                received = f"two of vehicle {name}"
                fix = "remove one, or split a file with data of several places or days"
                raise self._table.error(None, "", f"one row of a vehicle at {rows[twice[0], 0]:g} s", received, fix)
            count += 1 + int(np.count_nonzero(np.diff(rows[:, 0]) > LONGEST_GAP))
            if count > MOST_VEHICLES:
                received = "more, since each gap of more than a second makes another one"
                raise self._table.error(None, "", f"at most {MOST_VEHICLES} vehicles", received, A_PART)
            yield name, rows


def parts(
    name: str, kind: str, size: tuple[float, float], times: FloatArray, states: FloatArray, rate: float
) -> Iterator[RecordedVehicle]:
    """Yield a vehicle, or several if it was not seen for more than a second in between; shorter gaps are filled."""
    steps = np.round(np.diff(times) * rate)
    cuts = [0, *(np.flatnonzero(steps > LONGEST_GAP * rate) + 1).tolist(), len(times)]
    for part, (first, end) in enumerate(pairwise(cuts), 1):
        label = name if part == 1 else f"{name}/{part}"
        seen = RecordedVehicle(
            name=label, kind=kind, length=size[0], width=size[1], times=times[first:end], states=states[first:end]
        )
        missing = steps[first : end - 1].sum() - (end - 1 - first)
        if 0 < missing <= MOST_FILLED * len(seen.times):
            counts = np.arange(steps[first : end - 1].sum() + 1)
            at = np.interp(counts, np.cumsum([0, *steps[first : end - 1]]), seen.times)
            seen = RecordedVehicle(name=label, kind=kind, length=size[0], width=size[1], times=at, states=seen.at(at))
        yield seen


def headings(angles: FloatArray, speeds: FloatArray, otherwise: float) -> FloatArray:
    """Return directions that were computed from movements, without those of a vehicle that hardly moves.

    A vehicle that stands has the direction in which it last moved, or will move first, or else ``otherwise``.
    """
    moves = np.flatnonzero(speeds >= STANDING)
    if not len(moves):
        return np.full(len(angles), otherwise)
    last = np.maximum(np.searchsorted(moves, np.arange(len(angles)), side="right") - 1, 0)
    kept: FloatArray = angles[moves[last]]
    return kept


def lanes_of(seen: Mapping[int, FloatArray], width: float, ends: tuple[float, float]) -> tuple[Lane, ...]:
    """Return straight lanes in the middle of what drove in them, by number: y [m] of all rows in each lane.

    None if what drove in a lane is spread over more than the lane, as in a bend.
    """
    middles = [(float(np.median(places)), places) for places in seen.values() if len(places)]
    middles.sort(key=lambda each: each[0])
    gaps = np.diff([middle for middle, _ in middles])
    wide = float(np.median(gaps)) if len(gaps) else width
    if any(float(np.quantile(abs(places - middle), 0.9)) > wide for middle, places in middles) or wide < width / 2:
        return ()
    return tuple(
        Lane(x=ends[0], y=middle, heading=0.0, length=ends[1] - ends[0], width=wide, speed_limit=math.inf)
        for middle, _ in middles
    )


def ends_of(vehicles: Sequence[RecordedVehicle]) -> tuple[float, float]:
    """Return the smallest and the largest x of all vehicles [m]."""
    places = np.concatenate([vehicle.states[:, X] for vehicle in vehicles])
    return float(places.min()), float(places.max())


def states_of(x: FloatArray, y: FloatArray, heading: FloatArray, speed: FloatArray) -> FloatArray:
    """Return states with the columns of a recording; shape [rows, 4]."""
    states = np.empty((len(x), 4))
    states[:, X], states[:, Y], states[:, HEADING], states[:, SPEED] = x, y, heading, speed
    return states
