"""The tables that ``python -m pytest_pafot export --to csv`` writes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pytest_pafot.extending import FloatArray
from pytest_pafot.extras.recordings.recording import EGO_NAMES, LANE_WIDTH, RecordedVehicle, Recording
from pytest_pafot.extras.recordings.tables import Between, Table, Tracks, ends_of, lanes_of, parts, states_of

COLUMNS = ("time", "vehicle", "x", "y", "heading", "speed", "length", "width")
"""The columns that are needed. The column ``lane`` is read, too, if there is one."""
KEEPS_LANE = 0.005
"""The largest heading of a vehicle that is not changing lanes [rad]."""


def read(path: Path, between: Between) -> Recording:
    """Return the runs of a table: y and headings grow to the left there.

    The table has no lanes, but their numbers: on a straight road they are estimated from what drove in them.
    """
    table = Table(path)
    numbers = [name for name in COLUMNS if name != "vehicle"] + (["lane"] if "lane" in table.columns else [])
    tracks = Tracks(table, between)
    for line, (name,), values in table.rows(["vehicle"], numbers):
        if min(values[5:7]) <= 0:
            raise table.error(line, "length, width", "sizes above 0", f"{values[5:7]}", "correct the row")
        tracks.add(line, name, values)
    driven = [*tracks.by_vehicle(len(numbers))]
    steps = np.concatenate([np.diff(rows[:, 0]) for _, rows in driven])
    rate = round(1 / float(np.median(steps)), 6) if len(steps) else 1.0
    vehicles: list[RecordedVehicle] = []
    lanes: dict[int, list[FloatArray]] = {}
    for name, rows in driven:
        times, x, left, angle, speed, length, width, *_ = rows.T
        states = states_of(x, -left, -angle, speed)
        vehicles += parts(name, "", (float(length[0]), float(width[0])), times, states, rate)
        if len(numbers) > len(COLUMNS) - 1:
            keeps = np.abs(angle) < KEEPS_LANE
            for number in np.unique(rows[rows[:, -1] >= 0, -1]).tolist():
                lanes.setdefault(int(number), []).append(-left[(rows[:, -1] == number) & keeps])
    ego = next((vehicle.name for vehicle in vehicles if vehicle.name.lower() in EGO_NAMES), None)
    there = lanes_of({number: np.concatenate(each) for number, each in lanes.items()}, LANE_WIDTH, ends_of(vehicles))
    notes = ("lanes are estimated from what drove in them",) if there else ("the data have no lanes",)
    return Recording(vehicles=tuple(vehicles), rate=rate, lanes=there, ego=ego, source=str(path), notes=notes)
