"""The road of a run for its picture: lanes, and in world coordinates where it is not straight the cells of the ego."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pytest_pafot.grid import Cell
from pytest_pafot.report.page_data import LaneView, Pose, RoadView
from pytest_pafot.trace import ALONG, LANE, FloatArray, Lane, Trace, X, Y
from pytest_pafot.world.roads.route import wrapped
from pytest_pafot.world.roads.survey import SAME_DIRECTION

DENSE = 0.5
"""Distance of the points by which cells are found [m]."""
BEYOND = 150.0
"""How far beyond where the vehicles came the lanes of the ego's way are drawn [m]."""


def road_view(trace: Trace, clearance: float) -> RoadView:
    """The road of a run: how its lanes lie across it, or if it bends each lane as a line in the world.

    The clearance is the gap between the ego and the cells ahead and behind [m].
    """
    road = RoadView(
        lanes=(),
        lane_width=float(trace.lanes[0].width),
        speed_limit=round(float(trace.speed_limit), 2),
        clearance=clearance,
    )
    if trace.track is None:
        starts = np.array([(lane.x, lane.y) for lane in trace.lanes])
        across = along_and_across(trace, starts[:, 0], starts[:, 1])[1]
        return replace(road, lanes=tuple(round(float(value), 2) for value in across))
    reach = float(trace.track[:, 0, ALONG].max()) + BEYOND
    shapes = []
    for lane in trace.lanes:
        points, length = _measured(lane)
        shown = points[: max(int(np.searchsorted(length, reach)) + 1, 2)]
        line = tuple((round(float(x), 2), round(float(y), 2)) for x, y in shown)
        shapes.append(LaneView(points=line, width=float(lane.width)))
    return replace(road, shapes=tuple(shapes))


def along_and_across(trace: Trace, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """World coordinates in the frame of the first lane: along it, and across it to the right [m]."""
    lane = trace.lanes[0]
    dx, dy = x - lane.x, y - lane.y
    cos, sin = np.cos(lane.heading), np.sin(lane.heading)
    return dx * cos + dy * sin, dy * cos - dx * sin


def _measured(lane: Lane) -> tuple[FloatArray, FloatArray]:
    """Points of a lane's centre line, and the length of the line up to each [m]."""
    end = lane.x + lane.length * np.cos(lane.heading), lane.y + lane.length * np.sin(lane.heading)
    points = np.array(lane.points or [(lane.x, lane.y), end])
    return points, np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))))


def grid_poses(trace: Trace, ticks: Sequence[int], clearance: float) -> tuple[tuple[Pose | None, ...], ...]:
    """Where the eight cells are at each of some ticks: x [m], y [m], direction [rad]; None for one without a lane."""
    other = float(trace.sizes[min(1, len(trace.sizes) - 1), 0])
    row = (float(trace.sizes[0, 0]) + other) / 2 + clearance
    dense = _dense_points(trace.lanes)
    return tuple(_cells_around(trace.ego[tick], row, trace.lanes, dense) for tick in ticks)


def _dense_points(lanes: Sequence[Lane]) -> FloatArray:
    """All lanes as many points: x [m], y [m], direction [rad] and number of the lane, shape [4, points]."""
    parts = []
    for number, lane in enumerate(lanes):
        points, length = _measured(lane)
        steps = np.arange(0.0, length[-1] + DENSE / 2, DENSE)
        x, y = (np.interp(steps, length, points[:, column]) for column in (0, 1))
        parts.append((x, y, np.arctan2(np.gradient(y), np.gradient(x)), np.full(len(x), number)))
    return np.concatenate(parts, axis=1)


def _cells_around(ego: FloatArray, row: float, lanes: Sequence[Lane], dense: FloatArray) -> tuple[Pose | None, ...]:
    """The poses of the cells; a row ahead or behind is so many metres along the ego's lane."""
    own = np.flatnonzero(dense[3] == ego[LANE])
    if not len(own):
        return (None,) * len(Cell)
    near = own[0] + int(np.hypot(dense[0, own] - ego[X], dense[1, own] - ego[Y]).argmin())
    bases = [near + round(cell.row * row / DENSE) for cell in Cell]
    width = lanes[int(ego[LANE])].width
    return tuple(
        _beside(base, cell.column, width, dense) if own[0] <= base <= own[-1] else None
        for cell, base in zip(Cell, bases, strict=True)
    )


def _beside(base: int, column: int, width: float, dense: FloatArray) -> Pose | None:
    """The point of a neighbouring lane that is nearest to a lane's width beside a point of the ego's lane."""
    xs, ys, headings, numbers = dense
    best = base
    if column:
        sideways = column * width
        x, y = xs[base] - sideways * np.sin(headings[base]), ys[base] + sideways * np.cos(headings[base])
        distance = np.hypot(xs - x, ys - y)
        turned = np.abs(wrapped(headings - headings[base]))
        distance[(turned > SAME_DIRECTION) | (numbers == numbers[base])] = np.inf
        best = int(distance.argmin())
        if distance[best] > width / 2:
            return None
    return round(float(xs[best]), 2), round(float(ys[best]), 2), round(float(headings[best]), 3)
