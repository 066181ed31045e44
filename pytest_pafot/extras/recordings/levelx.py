"""The tables of inD, rounD and exiD (leveLXData): crossings, roundabouts and ramps, seen from above."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pytest_pafot.extras.recordings.recording import RecordedVehicle, Recording
from pytest_pafot.extras.recordings.tables import Between, Table, Tracks, beside, parts, states_of
from pytest_pafot.support.text import plural

COLUMNS = ("trackId", "frame", "xCenter", "yCenter", "heading", "width", "length", "xVelocity", "yVelocity")
"""The columns of ``00_tracks.csv`` that are needed. y grows to the left, and headings in degrees anticlockwise."""


def read(path: Path, between: Between) -> Recording:
    """Return a recording without lanes, which these tables do not have; x is as in the data.

    ``00_tracksMeta.csv`` and ``00_recordingMeta.csv`` are read, too. Pedestrians and cyclists have no size in the data
    and are left out.
    """
    table, about, whole = Table(path), beside(path, "tracksMeta"), beside(path, "recordingMeta")
    _, (rate,) = whole.only([], ["frameRate"])
    if rate <= 0:
        raise whole.error(2, "frameRate", "frames per second, above 0", f"{rate:g}", "take the data set's own file")
    known = {name: kind for _, (name, kind), _ in about.rows(["trackId", "class"], [])}
    tracks = Tracks(table, between)
    for line, (name,), (frame, *values) in table.rows(["trackId"], COLUMNS[1:]):
        if name not in known:
            fix = "take both from one recording"
            raise table.error(line, "trackId", f"a track of {about.path.name}", name[:60], fix)
        tracks.add(line, name, (frame / rate, *values))
    vehicles: list[RecordedVehicle] = []
    without = 0
    for name, rows in tracks.by_vehicle(8):
        times, x, left, degrees, width, length, ahead, aside = rows.T
        if min(length[0], width[0]) <= 0:
            without += 1
            continue
        states = states_of(x, -left, -np.radians(degrees), np.hypot(ahead, aside))
        vehicles += parts(name, known[name].lower(), (float(length[0]), float(width[0])), times, states, rate)
    if not vehicles:
        raise table.error(None, "", "vehicles with a size", "none", "give another time as between=")
    left_out = (f"{plural(without, 'pedestrian or cyclist')} without a size left out",) if without else ()
    notes = ("the data have no lanes", *left_out)
    return Recording(vehicles=tuple(vehicles), rate=rate, source=str(path), notes=notes)
