"""The tables of NGSIM (US 101, I-80, Lankershim, Peachtree): feet, frames of 0.1 s, places of front bumpers."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pytest_pafot.extending import FloatArray
from pytest_pafot.extras.recordings.recording import LANE_WIDTH, RecordedVehicle, Recording
from pytest_pafot.extras.recordings.tables import (
    Between,
    Table,
    Tracks,
    ends_of,
    headings,
    lanes_of,
    parts,
    states_of,
)

COLUMNS = ("Vehicle_ID", "Frame_ID", "Local_X", "Local_Y", "v_Length", "v_Width", "v_Class", "v_Vel", "Lane_ID")
"""The columns that are needed. Local_X is across the road to the right, Local_Y along it."""
FOOT = 0.3048
RATE = 10.0
"""Frames per second."""
KINDS = {1: "motorcycle", 2: "car", 3: "truck"}
SMOOTHED = 5
"""The number of frames before and after a place between which its direction is taken; places jump by a foot."""


def read(path: Path, between: Between) -> Recording:
    """Return a recording with x along the road.

    Headings are computed from places half a second before and after. The data have numbers of lanes but not their
    places, which are estimated from what drove in them.
    """
    table = Table(path)
    place = ["Location"] if "location" in table.columns else []
    tracks, found = Tracks(table, between), ""
    for line, (name, *where), (frame, *values) in table.rows(["Vehicle_ID", *place], COLUMNS[1:]):
        if where and found not in ("", where[0]):
            raise table.error(line, "Location", f"one place, {found}", where[0][:60], "split the file by this column")
        found = where[0] if where else ""
        if min(values[2:4]) <= 0:
            raise table.error(line, "v_Length, v_Width", "sizes above 0", f"{values[2:4]}", "correct the row")
        tracks.add(line, name, (frame / RATE, *values))
    vehicles: list[RecordedVehicle] = []
    lanes: dict[int, list[FloatArray]] = {}
    for name, rows in tracks.by_vehicle(8):
        times, right, along, length, width, kind, speed, lane = rows.T
        x, y, speeds = along * FOOT, right * FOOT, speed * FOOT
        row = np.arange(len(x))
        before, after = np.maximum(row - SMOOTHED, 0), np.minimum(row + SMOOTHED, row[-1])
        moved = np.hypot(x[after] - x[before], y[after] - y[before])
        angles = np.arctan2(y[after] - y[before], x[after] - x[before])
        angles = headings(angles, np.minimum(speeds, moved / np.maximum(times[after] - times[before], 0.1)), 0.0)
        box = float(length[0]) * FOOT, float(width[0]) * FOOT
        states = states_of(x - np.cos(angles) * box[0] / 2, y - np.sin(angles) * box[0] / 2, angles, speeds)
        vehicles += parts(name, KINDS.get(int(kind[0]), ""), box, times, states, RATE)
        for number in np.unique(lane).tolist():
            lanes.setdefault(int(number), []).append(y[lane == number])
    there = lanes_of({number: np.concatenate(each) for number, each in lanes.items()}, LANE_WIDTH, ends_of(vehicles))
    notes = ("lanes are estimated from what drove in them",) if there else ("the data have no lanes",)
    return Recording(vehicles=tuple(vehicles), rate=RATE, lanes=there, source=str(path), notes=notes)
