"""The tables of highD (Krajewski et al., ITSC 2018): a straight motorway in both directions, seen from above."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import numpy as np

from pytest_pafot.extending import Lane
from pytest_pafot.extras.recordings.recording import RecordedVehicle, Recording
from pytest_pafot.extras.recordings.tables import (
    Between,
    Table,
    Tracks,
    beside,
    ends_of,
    headings,
    parts,
    states_of,
)

COLUMNS = ("frame", "id", "x", "y", "width", "height", "xVelocity", "yVelocity")
"""The columns of ``01_tracks.csv`` that are needed. x and y are a corner of the box, ``width`` is its length."""
LEFTWARDS = 1
"""The ``drivingDirection`` of the upper lanes, in which vehicles drive against x."""


def read(path: Path, between: Between) -> Recording:
    """Return a recording whose vehicles drive along x on the lower lanes, and against it on the upper ones.

    Headings are those of the velocities. ``01_tracksMeta.csv`` and ``01_recordingMeta.csv`` are read, too.
    """
    table, about, whole = Table(path), beside(path, "tracksMeta"), beside(path, "recordingMeta")
    (upper, lower), (rate, limit) = whole.only(["upperLaneMarkings", "lowerLaneMarkings"], ["frameRate", "speedLimit"])
    if rate <= 0:
        raise whole.error(2, "frameRate", "frames per second, above 0", f"{rate:g}", "take the data set's own file")
    known = {}
    for line, (name, kind), (way,) in about.rows(["id", "class"], ["drivingDirection"]):
        if way not in (1, 2):
            raise about.error(line, "drivingDirection", "1 or 2", f"{way:g}", "take the data set's own file")
        known[name] = kind.lower(), math.pi if way == LEFTWARDS else 0.0
    tracks = Tracks(table, between)
    for line, (name,), (frame, *box) in table.rows(["id"], [name for name in COLUMNS if name != "id"]):
        if name not in known:
            raise table.error(line, "id", f"a vehicle of {about.path.name}", name[:60], "take both from one recording")
        if min(box[2:4]) <= 0:
            raise table.error(line, "width, height", "sizes above 0", f"{box[2:4]}", "correct the row")
        tracks.add(line, name, (frame / rate, *box))
    vehicles: list[RecordedVehicle] = []
    for name, rows in tracks.by_vehicle(7):
        times, x, y, length, width, ahead, aside = rows.T
        kind, otherwise = known[name]
        speeds = np.hypot(ahead, aside)
        angles = headings(np.arctan2(aside, ahead), speeds, otherwise)
        states = states_of(x + length / 2, y + width / 2, angles, speeds)
        vehicles += parts(name, kind, (float(length[0]), float(width[0])), times, states, rate)
    first, last = ends_of(vehicles)
    lanes = []
    for column, text, heading in (("lowerLaneMarkings", lower, 0.0), ("upperLaneMarkings", upper, math.pi)):
        try:
            lines = [float(each) for each in text.split(";")]
        except ValueError:
            lines = []
        if len(lines) < 2 or not all(left < right < math.inf for left, right in pairwise(lines)):
            fix = "take the data set's own file"
            raise whole.error(2, column, "growing numbers between semicolons", f"{text!r:.60}", fix)
        lanes += [
            Lane(
                x=last if heading else first,
                y=(left + right) / 2,
                heading=heading,
                length=last - first,
                width=right - left,
                speed_limit=limit if limit > 0 else math.inf,
            )
            for left, right in pairwise(lines)
        ]
    return Recording(vehicles=tuple(vehicles), rate=rate, lanes=tuple(lanes), source=str(path))
