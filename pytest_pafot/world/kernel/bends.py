"""Roads that bend, by plain numbers: places along a line and across its lanes, and the vehicles there.

Positions are along the line, of which there is a point every half metre, and across it to the right. Lanes are numbered
from the left; none of them needs to exist everywhere.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence

STEP = 0.5
"""Distance of the points of a line [m]."""
HALF_TURN = math.pi
"""A number of C's where compiled, which ``math.pi`` is not [rad]."""
ON_LANE = 1e-6
"""How far beside a lane a vehicle still is on it, as rounding has it [m]."""


class Bends:
    """The lanes along a line.

    Args:
        x, y, heading: of the line's points [m, m, rad].
        exists, part: of each lane and each of its points, whether it is there and its number in a trace, in one row.
        across, direction, lean, speed: of each lane and each of its points [m, rad, rad, m/s], in one row.
        widths: of the lanes of a trace [m].
        lane_width: of the ego's lane at the start [m].

    Attributes:
        along, across, angle, lane, offset: where :meth:`locate` has found a vehicle [m, m, rad, , m].
    """

    def __init__(
        self,
        line: tuple[Sequence[float], Sequence[float], Sequence[float]],
        flags: tuple[Sequence[int], Sequence[int]],
        shape: tuple[Sequence[float], Sequence[float], Sequence[float], Sequence[float]],
        widths: Sequence[float],
        lane_width: float,
    ) -> None:
        x, y, heading = line
        exists, part = flags
        across, direction, lean, speed = shape
        self._x, self._y, self._heading = array("d", x), array("d", y), array("d", heading)
        self._exists, self._part = array("i", exists), array("i", part)
        self._across, self._direction = array("d", across), array("d", direction)
        self._lean, self._speed = array("d", lean), array("d", speed)
        self._widths = array("d", widths)
        self._points = len(x)
        self._lanes = len(exists) // len(x)
        self._end = (len(x) - 1) * STEP
        self._lane_width = lane_width
        self.along = self.across = self.angle = self.offset = 0.0
        self.lane = 0
        self._share = self._x0 = self._y0 = self._direction0 = 0.0

    def __reduce__(self) -> tuple[object, ...]:
        """Roads travel to other processes with their worlds."""
        line = list(self._x), list(self._y), list(self._heading)
        flags = list(self._exists), list(self._part)
        shape = list(self._across), list(self._direction), list(self._lean), list(self._speed)
        return Bends, (line, flags, shape, list(self._widths), self._lane_width)

    def point(self, along: float) -> int:
        """The point of the line that is nearest to a place; of two the even one, as Python rounds."""
        exact = along / STEP
        below = int(math.floor(exact))  # noqa: RUF046  (where compiled it is not)
        rest = exact - below
        if rest > 0.5 or (rest == 0.5 and below % 2 != 0):
            below += 1
        return min(max(below, 0), self._points - 1)

    def exists(self, lane: int, along: float) -> bool:
        """Whether there is such a lane at a place of the road."""
        if not (0 <= lane < self._lanes and 0.0 <= along <= self._end):
            return False
        return self._exists[lane * self._points + self.point(along)] != 0

    def continues(self, lane: int, since: float, until: float) -> bool:
        """Whether a lane exists from one place to another, or to the end of the road."""
        if not 0 <= lane < self._lanes or since < 0.0:
            return False
        row = lane * self._points
        for index in range(row + self.point(since), row + self.point(until) + 1):  # noqa: SIM110  (no closures here)
            if self._exists[index] == 0:
                return False
        return True

    def _between(self, along: float) -> int:
        """The point before a place; sets the share of the way to the next, which goes on straight beyond the ends."""
        index = min(max(int(along / STEP), 0), self._points - 2)
        self._share = along / STEP - index
        return index

    def _value(self, values: array[float], lane: int, along: float) -> float:
        """What a lane has at a place; as at the ends beyond them."""
        index = self._between(along) + lane * self._points
        share = min(max(self._share, 0.0), 1.0)
        return values[index] + share * (values[index + 1] - values[index])

    def across_at(self, lane: int, along: float) -> float:
        """How far to the right of the line the centre of a lane is [m]."""
        return self._value(self._across, lane, along)

    def lane_at(self, lane: int, along: float) -> tuple[float, float, float]:
        """Of a lane: across [m], direction [rad], lean [rad]."""
        return (
            self._value(self._across, lane, along),
            self._value(self._direction, lane, along),
            self._value(self._lean, lane, along),
        )

    def speed_at(self, lane: int, along: float) -> float:
        """The highest speed of an NPC in a lane [m/s]."""
        return self._value(self._speed, lane, along)

    def stretch(self, along: float, across: float) -> float:
        """Metres driven there per metre of the road: more outside of a bend, less inside."""
        index = self._between(along)
        bend = (self._heading[index + 1] - self._heading[index]) / STEP
        return max(1.0 - bend * across, 0.2)

    def _refer(self, along: float) -> None:
        """Set x, y and direction of the line at a place; straight on beyond its ends."""
        index = self._between(along)
        share = self._share
        turned = min(max(share, 0.0), 1.0) * (self._heading[index + 1] - self._heading[index])
        self._x0 = self._x[index] + share * (self._x[index + 1] - self._x[index])
        self._y0 = self._y[index] + share * (self._y[index + 1] - self._y[index])
        self._direction0 = self._heading[index] + turned

    def reference(self, along: float) -> tuple[float, float, float]:
        """World x [m], y [m] and heading [rad] of the line; straight on beyond its ends."""
        self._refer(along)
        return self._x0, self._y0, self._direction0

    def locate(self, x: float, y: float, heading: float, near: float) -> None:
        """Find a vehicle on the road, near a place along it, since roads may cross themselves."""
        along = near
        for _ in range(4):
            self._refer(along)
            cos, sin = math.cos(self._direction0), math.sin(self._direction0)
            ahead = (x - self._x0) * cos + (y - self._y0) * sin
            across = (y - self._y0) * cos - (x - self._x0) * sin
            along = min(max(along + ahead / self.stretch(along, across), -self._end), 2.0 * self._end)
            if abs(ahead) < 1e-9:
                break
        self._refer(along)
        across = (y - self._y0) * math.cos(self._direction0) - (x - self._x0) * math.sin(self._direction0)
        point, nearest, best = self.point(along), 0, math.inf
        for lane in range(self._lanes):
            index = lane * self._points + point
            if self._exists[index] != 0 and abs(across - self._across[index]) < best:
                nearest, best = lane, abs(across - self._across[index])
        self.along, self.across, self.lane = along, across, nearest
        self.angle = (heading - self._direction0 + HALF_TURN) % (2.0 * HALF_TURN) - HALF_TURN
        self.offset = across - self._value(self._across, nearest, along)

    def in_lanes(self, lane: int, along: float, offset: float) -> float:
        """Where across the road somebody is who is so far beside a lane's centre, in the measure of lanes [m]."""
        toward = lane + (1 if offset > 0.0 else -1)
        scale = 1.0
        if self.exists(toward, along):
            apart = abs(self._value(self._across, toward, along) - self._value(self._across, lane, along))
            scale = self._lane_width / apart
        return lane * self._lane_width + offset * scale

    def part(self, lane: int, along: float, offset: float) -> int:
        """Number in a trace of the lane of the way that somebody's centre is on, -1 beside them."""
        if not 0.0 <= along <= self._end:
            return -1
        part = self._part[lane * self._points + self.point(along)]
        return part if part >= 0 and abs(offset) <= self._widths[part] / 2.0 + ON_LANE else -1

    def nearest_lane(self, lateral: float) -> int:
        """The lane whose centre is nearest, in the measure of lanes."""
        nearest = int(math.ceil(lateral / self._lane_width - 0.5))  # noqa: RUF046  (where compiled it is not)
        return min(max(nearest, 0), self._lanes - 1)
