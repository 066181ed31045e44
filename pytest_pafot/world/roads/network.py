"""Roads of any shape, as the grid sees them: positions along the ego's way and across its lanes.

The way (:mod:`pytest_pafot.world.roads.route`) is the line to measure along. Beside it, at every half metre, are the
lanes of the same road section, found by projecting as highway-env's own ``side_lanes`` are used. A lane is known by its
number from the left, the ego's way having the same number from the beginning to the end; it need not exist everywhere.

Across the road positions are given in lanes: lane ``k`` has its centre at ``k`` lane widths, whatever the road does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from pytest_pafot.grid import Cell
from pytest_pafot.trace import Lane
from pytest_pafot.world.roads.route import STEP, LaneIndex, Line, wrapped


class Spot(NamedTuple):
    """A vehicle on the road.

    Attributes:
        along, across: of its centre, on the ego's way and to its right [m].
        angle: of its heading to the way [rad].
        lane: the nearest one that exists there.
        offset: to the centre of that lane, to the right [m].
    """

    along: float
    across: float
    angle: float
    lane: int
    offset: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """One lane along the whole way; lists have an entry per point of the line.

    Attributes:
        exists: whether there is such a lane here.
        across: of its centre from the line [m].
        direction: of its centre line [rad].
        lean: angle to it of a vehicle that follows it without error [rad]; a car in a bend points inwards less than
            it moves.
        speed: highest speed that bends, limits and the lane's end leave to an NPC [m/s].
        sharpest: largest curvature of the lane from here on, as far as a lane change takes [1/m].
        part: index of the lane in ``Trace.lanes``, -1 where there is none.
    """

    exists: list[bool]
    across: list[float]
    direction: list[float]
    lean: list[float]
    speed: list[float]
    sharpest: list[float]
    part: list[int]


@dataclass(frozen=True, kw_only=True, eq=False)
class NetworkRoad:
    """The lanes along the ego's way through a network.

    Attributes:
        lanes: all lanes, as a trace has them: first those of the way from the left, then the others of the network.
        columns: the lanes of the way, from the left.
        sections: of the way, as pairs of highway-env's nodes.
        others: highway-env's indices of the lanes that are in no section of the way, the last of ``lanes``.
        lane_width: of the ego's lane at the start [m].
        speed_limit: of the fastest lane of the way, or the ego's first speed where that is more [m/s].
        start, ego_lane, ego_speed: where along the road [m], in which lane and at which speed [m/s] the ego starts.
    """

    lanes: tuple[Lane, ...]
    columns: tuple[Column, ...]
    sections: frozenset[tuple[str, str]]
    others: tuple[LaneIndex, ...]
    line: Line
    lane_width: float
    speed_limit: float
    start: float
    ego_lane: int
    ego_speed: float

    def __deepcopy__(self, _: dict[int, object]) -> NetworkRoad:
        """Itself, as nothing in it changes: highway-env copies vehicles with all that hangs on them to predict them."""
        return self

    @cached_property
    def end(self) -> float:
        """Of the road [m]."""
        return (len(self.line.x) - 1) * STEP

    @property
    def lane_count(self) -> int:
        """How many lanes there are along the way, each of them somewhere."""
        return len(self.columns)

    @property
    def start_lanes(self) -> tuple[int, ...]:
        """The lanes that exist where the ego starts."""
        return tuple(lane for lane in range(len(self.columns)) if self.exists(lane, self.start))

    def exists(self, lane: int, along: float) -> bool:
        """Whether there is such a lane at a place of the road."""
        is_on_road = 0 <= lane < len(self.columns) and 0 <= along <= self.end
        return is_on_road and self.columns[lane].exists[self.point(along)]

    def continues(self, lane: int, since: float, until: float) -> bool:
        """Whether a lane exists from one place to another, or to the end of the road."""
        if not 0 <= lane < len(self.columns) or since < 0:
            return False
        first, last = self.point(since), self.point(until)
        return all(self.columns[lane].exists[first : last + 1])

    def cells(self, along: float, ego_lane: int, rows: float) -> frozenset[Cell]:
        """The cells whose centre is on a lane, for rows that are so far apart [m]."""
        return frozenset(cell for cell in Cell if self.exists(ego_lane + cell.column, along + cell.row * rows))

    def position(self, longitudinal: float, lane: int) -> tuple[float, float, float]:
        """World x [m], y [m] and heading [rad] of a vehicle on the centre of a lane."""
        x, y, heading = self.reference(longitudinal)
        across, direction, lean = self.lane_at(lane, longitudinal)
        return x - math.sin(heading) * across, y + math.cos(heading) * across, direction + lean

    def centre(self, lane: int) -> float:
        """How far across the road the centre of a lane is, in the measure of lanes [m]."""
        return lane * self.lane_width

    def nearest_lane(self, lateral: float) -> int:
        """The lane whose centre is nearest, in the measure of lanes."""
        return min(max(math.ceil(lateral / self.lane_width - 0.5), 0), len(self.columns) - 1)

    def lane_at(self, lane: int, along: float) -> tuple[float, float, float]:
        """Of a lane: across [m], direction [rad], lean [rad]."""
        index, share = self._inside(along)
        column = self.columns[lane]
        across, direction, lean = column.across, column.direction, column.lean
        return (
            across[index] + share * (across[index + 1] - across[index]),
            direction[index] + share * (direction[index + 1] - direction[index]),
            lean[index] + share * (lean[index + 1] - lean[index]),
        )

    def speed_at(self, lane: int, along: float) -> float:
        """The highest speed of an NPC in a lane [m/s]."""
        index, share = self._inside(along)
        speed = self.columns[lane].speed
        return speed[index] + share * (speed[index + 1] - speed[index])

    def stretch(self, along: float, across: float) -> float:
        """Metres driven there per metre of the road: more outside of a bend, less inside."""
        index, _ = self._between(along)
        bend = (self._points[index + 1][2] - self._points[index][2]) / STEP
        return max(1 - bend * across, 0.2)

    def spot(self, x: float, y: float, heading: float, near: float) -> Spot:
        """A vehicle on the road, looked for near a place along it, since roads may cross themselves."""
        along = near
        for _ in range(4):
            x0, y0, direction = self.reference(along)
            cos, sin = math.cos(direction), math.sin(direction)
            ahead, across = (x - x0) * cos + (y - y0) * sin, (y - y0) * cos - (x - x0) * sin
            along = min(max(along + ahead / self.stretch(along, across), -self.end), 2 * self.end)
            if abs(ahead) < 1e-9:
                break
        x0, y0, direction = self.reference(along)
        across = (y - y0) * math.cos(direction) - (x - x0) * math.sin(direction)
        index = self.point(along)
        lanes = [lane for lane, column in enumerate(self.columns) if column.exists[index]]
        lane = min(lanes, key=lambda each: abs(across - self.columns[each].across[index]))
        return Spot(along, across, wrapped(heading - direction), lane, across - self.lane_at(lane, along)[0])

    def in_lanes(self, spot: Spot) -> float:
        """Where across the road a vehicle is, in the measure of lanes [m]."""
        toward = spot.lane + (1 if spot.offset > 0 else -1)
        scale = 1.0
        if self.exists(toward, spot.along):
            apart = abs(self.lane_at(toward, spot.along)[0] - self.lane_at(spot.lane, spot.along)[0])
            scale = self.lane_width / apart
        return self.centre(spot.lane) + spot.offset * scale

    def part(self, spot: Spot) -> int:
        """Index in ``lanes`` of the lane of the way that a vehicle's centre is on, -1 beside them."""
        if not 0 <= spot.along <= self.end:
            return -1
        part = self.columns[spot.lane].part[self.point(spot.along)]
        return part if part >= 0 and abs(spot.offset) <= self.lanes[part].width / 2 + 1e-6 else -1

    def reference(self, along: float) -> tuple[float, float, float]:
        """World x, y and heading of the line; straight on beyond its ends."""
        index, share = self._between(along)
        (x0, y0, heading0), (x1, y1, heading1) = self._points[index], self._points[index + 1]
        turned = min(max(share, 0.0), 1.0) * (heading1 - heading0)
        return x0 + share * (x1 - x0), y0 + share * (y1 - y0), heading0 + turned

    def _between(self, along: float) -> tuple[int, float]:
        """The point before a place and the share of the way to the next; beyond the ends, as if it went straight on."""
        index = min(max(int(along / STEP), 0), len(self._points) - 2)
        return index, along / STEP - index

    def _inside(self, along: float) -> tuple[int, float]:
        """The point before a place and the share of the way to the next, 0 to 1: as at the ends beyond them."""
        index, share = self._between(along)
        return index, min(max(share, 0.0), 1.0)

    def point(self, along: float) -> int:
        """The point of the line that is nearest to a place."""
        return min(max(round(along / STEP), 0), len(self._points) - 1)

    @cached_property
    def _points(self) -> list[tuple[float, float, float]]:
        """World x [m], y [m] and heading [rad] of each point of the line, as floats, which are faster one by one."""
        line = self.line
        return list(zip(line.x.tolist(), line.y.tolist(), line.heading.tolist(), strict=True))
