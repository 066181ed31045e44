"""Lanes and cells of roads that are not straight, in world coordinates, for the picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pytest_pafot.grid import Cell
from pytest_pafot.report.page_data import LaneView, Pose
from pytest_pafot.trace import ALONG, LANE, FloatArray, Lane, Trace, X, Y
from pytest_pafot.world.roads.route import wrapped
from pytest_pafot.world.roads.survey import SAME_DIRECTION

DENSE = 0.5
"""Distance of the points by which cells are found [m]."""
BEYOND = 150.0
"""How far beyond where the vehicles came the lanes of the ego's way are drawn [m]."""


def lane_views(trace: Trace) -> tuple[LaneView, ...]:
    """All lanes of a run, as lines with a width."""
    reach = float(trace.track_of(0)[:, ALONG].max()) + BEYOND
    views = []
    for lane in trace.lanes:
        points = _points(lane)
        length = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))))
        shown = points[: max(int(np.searchsorted(length, reach)) + 1, 2)]
        views.append(
            LaneView(points=tuple((round(float(x), 2), round(float(y), 2)) for x, y in shown), width=float(lane.width))
        )
    return tuple(views)


def grid_views(trace: Trace, ticks: Sequence[int], clearance: float) -> tuple[tuple[Pose | None, ...], ...]:
    """Where the eight cells are at each of some ticks: x [m], y [m], direction [rad]; None for one without a lane."""
    lanes = _Dense.of(trace.lanes)
    other = float(trace.sizes[min(1, len(trace.sizes) - 1), 0])
    rows = (float(trace.sizes[0, 0]) + other) / 2 + clearance
    return tuple(lanes.cells(trace.ego[tick], rows, trace.lanes) for tick in ticks)


@dataclass(frozen=True, slots=True)
class _Dense:
    """All lanes as many points, each with its direction and the number of its lane."""

    x: FloatArray
    y: FloatArray
    heading: FloatArray
    lane: npt.NDArray[np.intp]

    @classmethod
    def of(cls, lanes: Sequence[Lane]) -> _Dense:
        parts = [_dense(lane) for lane in lanes]
        x, y, heading = (np.concatenate([part[column] for part in parts]) for column in range(3))
        return cls(x, y, heading, np.repeat(np.arange(len(lanes)), [len(part[0]) for part in parts]))

    def cells(self, ego: FloatArray, rows: float, lanes: Sequence[Lane]) -> tuple[Pose | None, ...]:
        """The places of the cells around an ego."""
        number = int(ego[LANE])
        if number < 0:
            return (None,) * len(Cell)
        own = np.flatnonzero(self.lane == number)
        near = own[0] + int(np.hypot(self.x[own] - ego[X], self.y[own] - ego[Y]).argmin())
        return tuple(self._cell(cell, near, own, rows, lanes[number].width) for cell in Cell)

    def _cell(self, cell: Cell, near: int, own: npt.NDArray[np.intp], rows: float, width: float) -> Pose | None:
        base = near + round(cell.row * rows / DENSE)
        if not own[0] <= base <= own[-1]:
            return None
        x, y, heading = float(self.x[base]), float(self.y[base]), float(self.heading[base])
        if cell.column == 0:
            return _pose(x, y, heading)
        x, y = x - cell.column * width * np.sin(heading), y + cell.column * width * np.cos(heading)
        turned = np.abs(wrapped(self.heading - heading))
        distance = np.hypot(self.x - x, self.y - y)
        distance[(turned > SAME_DIRECTION) | (self.lane == self.lane[base])] = np.inf
        best = int(distance.argmin())
        if distance[best] > width / 2:
            return None
        return _pose(float(self.x[best]), float(self.y[best]), float(self.heading[best]))


def _pose(x: float, y: float, heading: float) -> Pose:
    return round(x, 2), round(y, 2), round(heading, 3)


def _points(lane: Lane) -> FloatArray:
    if lane.points:
        return np.array(lane.points)
    end = lane.x + lane.length * np.cos(lane.heading), lane.y + lane.length * np.sin(lane.heading)
    return np.array([(lane.x, lane.y), end])


def _dense(lane: Lane) -> tuple[FloatArray, FloatArray, FloatArray]:
    points = _points(lane)
    length = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))))
    places = np.arange(0.0, length[-1] + DENSE / 2, DENSE)
    x, y = (np.interp(places, length, points[:, column]) for column in (0, 1))
    return x, y, np.arctan2(np.gradient(y), np.gradient(x))
