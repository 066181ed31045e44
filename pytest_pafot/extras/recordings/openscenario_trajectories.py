"""Trajectories of OpenSCENARIO as tracks: polylines of places with times."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np

from pytest_pafot.extending import FloatArray
from pytest_pafot.extras.recordings.recording import RecordedVehicle
from pytest_pafot.extras.recordings.tables import MOST_ROWS, headings, parts, states_of
from pytest_pafot.extras.recordings.xml_data import Element


def followed(
    driven: Mapping[str, FloatArray], boxes: Iterable[tuple[str, str, float, float, float]], board: Element
) -> tuple[tuple[RecordedVehicle, ...], float]:
    """Return vehicles that follow trajectories, and their rows per second.

    Speeds are those between places, and so are the headings of vertices that have none. If the times are not even, the
    rows are on straight lines between the vertices, at least ten per second.

    Args:
        driven: time [s], x, y [m], with y to the left, and heading [rad] or NaN of each vertex, by vehicle.
        boxes: name, class, length, width and the distance of the centre ahead of its place [m] of each vehicle.
        board: the place of errors.

    Raises:
        RecordingError: if there are no vertices, or too many rows between them.
    """
    steps = np.concatenate([np.diff(rows[:, 0]) for rows in driven.values()])
    if not len(steps):
        raise board.error("vertices at that time", "none", "give another time as between=")
    rate = round(1 / float(np.median(steps)), 6)
    if not rate or np.abs(steps * rate - np.round(steps * rate)).max() > 1e-3:
        rate = max(rate, 10.0)
    if steps.sum() * rate > MOST_ROWS:
        received, fix = f"{rate:g} a second for {steps.sum():g} s", "read a part of it, such as between=(0, 60)"
        raise board.error(f"at most {MOST_ROWS} rows", received, fix)
    vehicles: list[RecordedVehicle] = []
    for name, kind, length, width, centre in boxes:
        rows = driven[name]
        if len(rows) < 2:
            continue
        times, x, y, heading = rows.T
        ahead, left = np.gradient(x, times), np.gradient(y, times)
        speeds = np.hypot(ahead, left)
        angles = np.where(np.isnan(heading), headings(np.arctan2(left, ahead), speeds, 0.0), heading)
        states = states_of(x + np.cos(angles) * centre, -(y + np.sin(angles) * centre), -angles, speeds)
        seen = RecordedVehicle(name=name, kind=kind, length=length, width=width, times=times, states=states)
        if np.abs(np.diff(times) * rate - 1).max() > 1e-3:
            times = times[0] + np.arange(math.floor((times[-1] - times[0]) * rate + 1e-6) + 1) / rate
            times = np.minimum(times, seen.times[-1])
        vehicles += parts(name, kind, (length, width), times, seen.at(times), rate)
    return tuple(vehicles), rate


def vertices(deed: Element, start: float) -> FloatArray:
    """Return time, x, y, heading of the vertices of a trajectory; shape [vertices, 4], NaN for no heading."""
    follow = next(deed.all("FollowTrajectoryAction"), deed)
    trajectory = follow.find("TrajectoryRef/Trajectory") or follow.find("Trajectory")
    if trajectory is None:
        raise follow.error("its Trajectory in it", "one of a catalogue", "write it into the file")
    shape = trajectory.get("Shape")
    for child in shape.children:
        if child.tag != "Polyline":
            raise child.error("a Polyline", child.tag, "convert it to places with times")
    timing = follow.find("TimeReference/Timing")
    if timing is None:
        raise follow.error("a TimeReference with Timing", "a trajectory without times", "give it times")
    offset, scale = timing.number("offset", 0.0), timing.number("scale", 1.0)
    offset += start if timing.values.get("domainAbsoluteRelative") == "relative" else 0.0
    rows = []
    for vertex in shape.all("Polyline/Vertex"):
        place = vertex.get("Position").only()
        if place.tag != "WorldPosition":
            raise place.error("WorldPosition in a trajectory", place.tag, "convert it to x, y and h")
        time = vertex.number("time") * scale + offset
        heading = place.number("h") if "h" in place.values else math.nan
        rows.append([time, place.number("x"), place.number("y"), heading])
        if len(rows) > 1 and time <= rows[-2][0]:
            raise vertex.error("times that grow", f"{time:g} s", "correct the time", "time")
    if not rows:
        raise shape.error("vertices", "none", "the file may be cut off")
    return np.array(rows)
