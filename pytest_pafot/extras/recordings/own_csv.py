"""The tables that ``python -m pytest_pafot export --to csv`` writes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pytest_pafot.extending import FloatArray
from pytest_pafot.extras.recordings.recording import EGO_NAMES, LANE_WIDTH, RecordedVehicle, Recording
from pytest_pafot.extras.recordings.tables import Between, Table, Tracks, ends_of, lanes_of, parts, states_of

COLUMNS = ("time", "vehicle", "x", "y", "heading", "speed", "length", "width")
"""The columns that are needed. The column ``lane`` is read, too, if there is one."""
KEEPS_LANE = 0.005
"""The largest heading of a vehicle that is not changing lanes [rad]."""
UNITS = {"km/h": 3.6, "feet per second": 3.281, "miles per hour": 2.237}
"""What speeds in other units are, as multiples of those in m/s."""
NEAR = 0.03
"""The largest difference between the measured multiple and that of a unit, as a share of it."""
LEAST_MOVES, SLOWEST, LEAST_TURN = 10, 1.0, 0.03
"""How many moves of a second a vehicle must have for its units to be checked, and in each of them the least distance
[m], and for headings the least angle to x [rad]: places are rounded, and the direction of a short move is noise."""
AGREES, DIFFERS = 0.1, 0.3
"""The largest median angle between moves and headings that fit them, and the smallest of ones that do not [rad]."""


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
    _check_units(table, driven, max(round(rate), 1))
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


def _check_units(table: Table, driven: Sequence[tuple[str, FloatArray]], second: int) -> None:
    """Refuse speeds and headings that fit the moves of vehicles only if they are in another unit.

    A move is what happens within a second, given in rows. Half of the vehicles that move must have the other unit: one
    alone may have been tracked badly.

    Raises:
        RecordingError: if they are in another unit.
    """
    multiples, angles = [], []
    for _, rows in driven:
        if len(rows) < second + LEAST_MOVES:
            continue
        seconds, x, y = (rows[second:] - rows[:-second])[:, :3].T
        distances, headings = np.hypot(x, y), rows[second // 2 :, 3][: len(x)]
        speeds = np.abs(rows[second:, 4] + rows[:-second, 4]) / 2
        moves = distances >= SLOWEST * seconds
        if moves.sum() >= LEAST_MOVES:
            multiples.append(float(np.median((speeds * seconds)[moves] / distances[moves])))
        moves &= np.abs(turned := np.arctan2(y, x)) >= LEAST_TURN
        if moves.sum() >= LEAST_MOVES:
            off = [np.exp(1j * (each - turned)[moves]) for each in (headings, np.radians(headings))]
            angles.append([float(np.median(np.abs(np.angle(each)))) for each in off])
    for unit, factor in UNITS.items():
        wrong = sum(abs(each / factor - 1) < NEAR for each in multiples)
        if wrong and 2 * wrong >= len(multiples):
            received = f"{factor:g} times the speeds at which the places change, as in {unit}"
            raise table.error(None, "speed", "m/s", received, f"divide the column by {factor:g}")
    wrong = sum(plain > DIFFERS and degrees < AGREES for plain, degrees in angles)
    if wrong and 2 * wrong >= len(angles):
        received = "57.3 times the directions in which the places change, as in degrees"
        raise table.error(None, "heading", "radians", received, "multiply the column by pi / 180")
