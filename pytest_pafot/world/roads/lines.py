"""Roads from the centre lines of their lanes, as simulators state them.

Straight parallel lanes are a straight road. From any others follows a network of highway-env's own kinds of lanes, of
which the road is then made as that of an environment is: at every few metres a section, in which each lane is a
straight line or an arc between two points of its line.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from pytest_pafot.model.trace import FloatArray
from pytest_pafot.support.errors import WorldError

SECTION = 5.0
"""The length of a section [m]."""
ALMOST = 1e-4
"""How far a point of a straight lane may be from its place [m]."""
MOST_OVERLAP = 0.1
"""The largest share of their width by which neighbouring lanes may overlap."""
STRAIGHT = 1e-7
"""The angle between the ends of a section up to which a lane is a straight line there [rad]."""


def straight_along(lines: Sequence[FloatArray], width: float) -> tuple[tuple[float, float, float], float] | None:
    """Return where a straight road of equal lanes begins, and its length [m]; None if the lanes are no such road.

    Args:
        lines: the points of each centre line from the left, in the direction of driving [m]; shape [points, 2].
        width: the width of the lanes [m].

    Returns:
        World x [m], y [m] and heading [rad] of the beginning of the leftmost lane, and the length of the road.
    """
    first = lines[0]
    heading = math.atan2(*(first[-1] - first[0])[::-1])
    cos, sin = math.cos(heading), math.sin(heading)
    begin, end = 0.0, math.inf
    for number, line in enumerate(lines):
        moved = line - first[0]
        along, across = moved @ np.array([cos, sin]), moved @ np.array([-sin, cos])
        if np.abs(across - number * width).max() > ALMOST or (np.diff(along) <= 0.0).any():
            return None
        begin, end = max(begin, float(along[0])), min(end, float(along[-1]))
        if abs(along[0]) > width or abs(along[-1] - np.hypot(*(first[-1] - first[0]))) > width:
            return None  # a lane that begins or ends elsewhere
    x, y = first[0] + begin * np.array([cos, sin])
    return (float(x), float(y), heading), end - begin


def network_of(lines: Sequence[FloatArray], width: float, speed_limit: float, name: str = "") -> Any:
    """Make a network of highway-env with a lane along each centre line.

    Args:
        lines: as for :func:`straight_along`; a lane may be shorter than the longest, next to which it lies.
        width: the width of the lanes [m].
        speed_limit: the speed limit [m/s].
        name: whose lanes they are, for errors.

    Raises:
        WorldError: if the lanes are not from the left, or overlap.
    """
    from pytest_pafot.world.stock import CircularLane, RoadNetwork, StraightLane  # noqa: PLC0415  (highway-env)

    curves = [_curve(line) for line in lines]
    longest = max(curves, key=len)
    stations = longest[:: max(1, round(SECTION))]
    if len(stations) > 1 and math.dist(stations[-1], longest[-1]) > SECTION / 2:
        stations = np.vstack([stations, longest[-1:]])
    tangent = np.gradient(stations, axis=0, edge_order=2 if len(stations) > 2 else 1)
    tangent /= np.hypot(*tangent.T)[:, None]
    reach = 2.0 * width * len(lines)  # further away, it is another turn of a spiral, or the other side of a loop
    ways = [_at_stations(curve, stations, tangent, reach) for curve in curves]
    _check_order(ways, tangent, width, name)
    turns = [np.unwrap(np.arctan2(*_slopes(way).T[::-1])) for way in ways]
    network = RoadNetwork()
    common = {"width": width, "speed_limit": speed_limit}
    for number, (here, there) in enumerate(pairwise(range(len(stations)))):
        for way, turn in zip(ways, turns, strict=True):
            start, end, angle = way[here], way[there], float(turn[there] - turn[here])
            if not np.isfinite([*start, *end]).all():
                continue
            if not abs(angle) > STRAIGHT:
                network.add_lane(str(number), str(number + 1), StraightLane(start, end, **common))
                continue
            chord, (dx, dy) = math.dist(start, end), end - start
            radius = chord / (2.0 * math.sin(abs(angle) / 2.0))
            side = math.copysign(1.0, angle)  # 1 to the right, where y grows
            toward = math.atan2(dy, dx) + side * math.pi / 2
            away = radius * math.cos(angle / 2.0)
            centre = (start + end) / 2 + away * np.array([math.cos(toward), math.sin(toward)])
            begin = math.atan2(*(start - centre)[::-1])
            lane = CircularLane(centre, radius, begin, begin + angle, clockwise=angle > 0, **common)
            network.add_lane(str(number), str(number + 1), lane)
    return network


def _check_order(ways: Sequence[FloatArray], tangent: FloatArray, width: float, name: str) -> None:
    """Refuse lanes that are not from the left, or of which two overlap along most of their way."""
    for number, (left, right) in enumerate(pairwise(ways), start=1):
        across = ((right - left) * np.stack([-tangent[:, 1], tangent[:, 0]], axis=-1)).sum(axis=1)
        if np.isnan(across).all():
            continue
        apart, least, most = float(np.nanmedian(across)), float(np.nanmin(across)), float(np.nanmax(across))
        if apart < (1.0 - MOST_OVERLAP) * width and most - least > width / 2:
            expected = f"a lane next to lanes[{number - 1}], {width:g} m to the right of it all the way"
            received = f"one from {least:.1f} to {most:.1f} m to the right of it"
            fix = "is each line moved across the road, rather than along an axis?"
            raise WorldError(field=f"{name}.lanes[{number}]", expected=expected, received=received, fix=fix)
        if apart < 0.0:
            expected = "lanes from the left, as a driver sees them"
            received = f"one {-apart:.1f} m to the left of the lane before it"
            fix = "is y_is_left wrong, or do the points lead against the way of driving? Otherwise write lanes[::-1]"
            raise WorldError(field=f"{name}.lanes[{number}]", expected=expected, received=received, fix=fix)
        if apart < (1.0 - MOST_OVERLAP) * width:
            expected = (
                f"at most {apart:.2f} m, the distance between the centre lines of lanes {number - 1} and {number}"
            )
            fix = "are lane_width and the points of lanes in the same unit, which metres states?"
            raise WorldError(field=f"{name}.lane_width", expected=expected, received=f"{width:.2f} m", fix=fix)


def _slopes(way: FloatArray) -> FloatArray:
    """Return the direction of a lane at each of its points; NaN where it has none."""
    slopes = np.full_like(way, np.nan)
    known = np.flatnonzero(np.isfinite(way[:, 0]))
    if len(known) > 1:  # at its ends, those of a parabola, so that a bend begins as it goes on
        slopes[known] = np.gradient(way[known], axis=0, edge_order=2 if len(known) > 2 else 1)
    slopes[np.isnan(slopes)] = 0.0
    return slopes


def _curve(line: FloatArray) -> FloatArray:
    """Return a point about every metre of a smooth curve through the points of a line (Catmull and Rom 1974)."""
    steps = np.hypot(*np.diff(line, axis=0).T)
    places = np.concatenate(([0.0], np.cumsum(steps)))
    slopes = np.gradient(line, places, axis=0, edge_order=2 if len(line) > 2 else 1)
    wanted = np.linspace(0.0, places[-1], max(2, round(float(places[-1])) + 1))
    part = np.clip(np.searchsorted(places, wanted, side="right") - 1, 0, len(steps) - 1)
    share = ((wanted - places[part]) / steps[part])[:, None]
    length = steps[part][:, None]
    square, cube = share**2, share**3
    curve: FloatArray = (
        (2 * cube - 3 * square + 1) * line[part]
        + (cube - 2 * square + share) * length * slopes[part]
        + (3 * square - 2 * cube) * line[part + 1]
        + (cube - square) * length * slopes[part + 1]
    )
    return curve


def _at_stations(curve: FloatArray, stations: FloatArray, tangent: FloatArray, reach: float) -> FloatArray:
    """Return where a curve is next to each station of the longest one, up to a distance [m]; NaN where it is not."""
    found = np.full_like(stations, np.nan)
    for number, (station, direction) in enumerate(zip(stations, tangent, strict=True)):
        ahead = (curve - station) @ direction
        crossing = np.flatnonzero((ahead[:-1] <= 1e-6) & (ahead[1:] >= -1e-6))
        if not crossing.size:
            continue
        near = min(crossing.tolist(), key=lambda each: float(np.hypot(*(curve[each] - station))))
        if np.hypot(*(curve[near] - station)) > reach:
            continue
        share = -ahead[near] / (ahead[near + 1] - ahead[near])
        found[number] = curve[near] + min(max(share, 0.0), 1.0) * (curve[near + 1] - curve[near])
    return found
