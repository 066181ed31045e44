"""The geometry of lanes for compiled code: parallel straight lanes, lanes along a curved path, and a single path."""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence

from pytest_pafot.world.kernel.bodies import Body

# distance from a lane line below which rounding matters, so that all lanes are compared [m]
ALMOST = 1e-6


class Lanes:
    """Parallel straight lanes of equal length [m] and width [m], numbered from the left."""

    def __init__(self, count: int, width: float, length: float) -> None:
        self.count = count
        self.width = width
        self.length = length
        self._inside = width / 2.0 - ALMOST
        self._last = float(count - 1)
        self._left = -width / 2.0
        self._right = (count - 1) * width + width / 2.0

    def locate(self, body: Body) -> int:
        """Set a body's nearest lane and return it, or return -1 if the body is off the road.

        If two lanes are equally near, the left one is used. highway-env's vehicles use :meth:`closest` instead.
        """
        across = body.y
        offset = across - body.lane * self.width
        if -self._inside < offset < self._inside and 0.0 <= body.x <= self.length:
            return body.lane  # still the previous lane
        lanes = across / self.width - 0.5
        if lanes <= 0.0:
            body.lane = 0
        elif lanes >= self._last:
            body.lane = self.count - 1
        else:
            lane = int(lanes)
            body.lane = lane + 1 if lane < lanes else lane
        return (
            body.lane
            if self._left <= across <= self._right and 0.0 <= body.x <= self.length
            else -1
        )

    def closest(self, along: float, across: float, heading: float) -> int:
        """Return the lane with the smallest sum of distance [m] and angle [rad], as highway-env does."""
        # A vehicle that is well inside a lane is nearest to that lane. Otherwise, all lanes are compared.
        near = int(across / self.width + 0.5) if across > 0.0 else 0
        if near < self.count and abs(across - near * self.width) < self._inside:
            return near  # the other terms are equal for all lanes
        beyond = max(along - self.length, 0.0) + max(-along, 0.0)
        angle = abs((heading + math.pi) % (2.0 * math.pi) - math.pi)
        best, lane = math.inf, 0
        for index in range(self.count):
            distance = abs(across - index * self.width) + beyond + angle
            if distance < best:
                best, lane = distance, index
        return lane


STEP = 0.5  # distance between neighbouring points of a line [m]
HALF_TURN = math.pi  # [rad]; unlike math.pi, it is a C number in compiled code
ON_LANE = 1e-6  # rounding tolerance at the edges of a lane [m]


class Bends:
    """The lanes along a curved line, with values at each point of the line.

    In lists with values for several lanes, all points of the first lane come first.
    """

    def __init__(
        self,
        line: tuple[Sequence[float], Sequence[float], Sequence[float]],
        flags: tuple[Sequence[int], Sequence[int]],
        shape: tuple[
            Sequence[float], Sequence[float], Sequence[float], Sequence[float], Sequence[float]
        ],
        widths: Sequence[float],
        lane_width: float,
    ) -> None:
        x, y, heading = line
        # 1 where a lane exists, else 0; index of the lane in Trace.lanes, or -1
        exists, part = flags
        # At each point of a lane: the distance to the right of the line [m], the direction [rad], the lean of a vehicle
        # in the lane [rad], the highest speed of NPCs [m/s], and the largest curvature during a lane change [1/m].
        across, direction, lean, speed, sharpest = shape
        self._x, self._y, self._heading = array("d", x), array("d", y), array("d", heading)
        self._exists, self._part = array("i", exists), array("i", part)
        self._across, self._direction = array("d", across), array("d", direction)
        self._lean, self._speed = array("d", lean), array("d", speed)
        self._sharpest = array("d", sharpest)
        self._widths = array("d", widths)  # widths of Trace.lanes [m]
        self._points = len(x)
        self._lanes = len(exists) // len(x)
        self._end = (len(x) - 1) * STEP
        self._lane_width = lane_width  # width of the ego's lane at the start [m]
        # results of `locate` [m, m, rad, m]
        self.along = self.across = self.angle = self.offset = 0.0
        self.lane = 0
        self._share = self._x0 = self._y0 = self._direction0 = 0.0

    def __reduce__(self) -> tuple[object, ...]:
        # pickled when worlds are sent to other processes
        line = list(self._x), list(self._y), list(self._heading)
        flags = list(self._exists), list(self._part)
        shape = (
            list(self._across),
            list(self._direction),
            list(self._lean),
            list(self._speed),
            list(self._sharpest),
        )
        return Bends, (line, flags, shape, list(self._widths), self._lane_width)

    def point(self, along: float) -> int:
        """Return the index of the point nearest to a position. If two are equally near, return the even one."""
        return min(max(even_rounded(along / STEP), 0), self._points - 1)

    def exists(self, lane: int, along: float) -> bool:
        if not (0 <= lane < self._lanes and 0.0 <= along <= self._end):
            return False
        return self._exists[lane * self._points + self.point(along)] != 0

    def continues(self, lane: int, since: float, until: float) -> bool:
        """Return whether a lane exists everywhere between two positions, or up to the end of the road."""
        if not 0 <= lane < self._lanes or since < 0.0:
            return False
        row = lane * self._points
        for index in range(row + self.point(since), row + self.point(until) + 1):  # noqa: SIM110  (no closures here)
            if self._exists[index] == 0:
                return False
        return True

    def _between(self, along: float) -> int:
        index = min(max(int(along / STEP), 0), self._points - 2)
        # The fraction of the step to the next point. It is negative or above 1 past the ends of the line, where the
        # line continues straight.
        self._share = along / STEP - index
        return index

    def _value(self, values: array[float], lane: int, along: float) -> float:
        """Interpolate a lane's values, which are constant before its start and after its end."""
        index = self._between(along) + lane * self._points
        share = min(max(self._share, 0.0), 1.0)
        return values[index] + share * (values[index + 1] - values[index])

    def across_at(self, lane: int, along: float) -> float:
        """Return the distance [m] of a lane's centre to the right of the line."""
        return self._value(self._across, lane, along)

    def pose(self, lane: int, along: float) -> tuple[float, float, float]:
        """Return the world x [m], y [m] and heading [rad] of a vehicle at the centre of a lane."""
        self._refer(along)
        across, sin, cos = (
            self.across_at(lane, along),
            math.sin(self._direction0),
            math.cos(self._direction0),
        )
        heading = self.direction_at(lane, along) + self.lean_at(lane, along)
        return self._x0 - sin * across, self._y0 + cos * across, heading

    def direction_at(self, lane: int, along: float) -> float:
        return self._value(self._direction, lane, along)

    def lean_at(self, lane: int, along: float) -> float:
        return self._value(self._lean, lane, along)

    def sharpest_at(self, lane: int, along: float) -> float:
        return self._sharpest[lane * self._points + self.point(along)]

    def heading_at(self, along: float) -> float:
        self._refer(along)
        return self._direction0

    def speed_at(self, lane: int, along: float) -> float:
        return self._value(self._speed, lane, along)

    def stretch(self, along: float, across: float) -> float:
        """Return the distance that a vehicle covers per metre of the line: above 1 on the outside of a bend."""
        index = self._between(along)
        bend = (self._heading[index + 1] - self._heading[index]) / STEP
        # without the limit, zero or negative past the centre of a bend
        return max(1.0 - bend * across, 0.2)

    def _refer(self, along: float) -> None:
        index = self._between(along)
        share = self._share
        turned = min(max(share, 0.0), 1.0) * (self._heading[index + 1] - self._heading[index])
        self._x0 = self._x[index] + share * (self._x[index + 1] - self._x[index])
        self._y0 = self._y[index] + share * (self._y[index + 1] - self._y[index])
        self._direction0 = self._heading[index] + turned

    def locate(self, x: float, y: float, heading: float, near: float) -> None:
        """Locate a vehicle on the road, and set ``along``, ``across``, ``angle``, ``lane`` and ``offset``.

        ``near`` is a position [m] close to the vehicle, which is needed because a road can cross itself.
        """
        along = near
        # each step projects onto the tangent at the last position, which converges even in bends
        for _ in range(4):
            self._refer(along)
            cos, sin = math.cos(self._direction0), math.sin(self._direction0)
            ahead = (x - self._x0) * cos + (y - self._y0) * sin
            across = (y - self._y0) * cos - (x - self._x0) * sin
            along = min(
                max(along + ahead / self.stretch(along, across), -self._end), 2.0 * self._end
            )
            if abs(ahead) < 1e-9:
                break
        self._refer(along)
        across = (y - self._y0) * math.cos(self._direction0) - (x - self._x0) * math.sin(
            self._direction0
        )
        point, nearest, best = self.point(along), 0, math.inf
        for lane in range(self._lanes):
            index = lane * self._points + point
            if self._exists[index] != 0 and abs(across - self._across[index]) < best:
                nearest, best = lane, abs(across - self._across[index])
        self.along, self.across, self.lane = along, across, nearest
        self.angle = (heading - self._direction0 + HALF_TURN) % (2.0 * HALF_TURN) - HALF_TURN
        self.offset = across - self._value(self._across, nearest, along)

    def in_lanes(self, lane: int, along: float, offset: float) -> float:
        """Return the nominal lateral position [m] of a vehicle with a given offset from a lane's centre."""
        # offsets are scaled so that the centre of the neighbouring lane is one nominal lane width away
        toward = lane + (1 if offset > 0.0 else -1)
        scale = 1.0
        if self.exists(toward, along):
            apart = abs(
                self._value(self._across, toward, along) - self._value(self._across, lane, along)
            )
            scale = self._lane_width / apart
        return lane * self._lane_width + offset * scale

    def part(self, lane: int, along: float, offset: float) -> int:
        """Return the index in Trace.lanes of a vehicle's lane, or -1 if the vehicle is on no lane of the path."""
        if not 0.0 <= along <= self._end:
            return -1
        part = self._part[lane * self._points + self.point(along)]
        return part if part >= 0 and abs(offset) <= self._widths[part] / 2.0 + ON_LANE else -1

    def nearest_lane(self, lateral: float) -> int:
        """Return the lane with its centre nearest to a nominal lateral position."""
        nearest = int(math.ceil(lateral / self._lane_width - 0.5))  # noqa: RUF046  (a float in C)
        return min(max(nearest, 0), self._lanes - 1)


class Track:
    """The path of a crossing NPC, with the highest speed and other values at each point."""

    def __init__(
        self,
        x: Sequence[float],
        y: Sequence[float],
        heading: Sequence[float],
        lean: Sequence[float],
        speed: Sequence[float],
        sharpest: Sequence[float],
        parts: Sequence[int],
        along_ego: Sequence[float],
        enters: float,
    ) -> None:
        self._last = len(x) - 1
        # The lane of each point as an index in Trace.lanes, the position of each point along the ego's path [m] or NaN,
        # and the position at which the path enters its zone [m].
        self.parts, self.along_ego, self.enters = array("i", parts), array("d", along_ego), enters
        self.x, self.y, self.heading = array("d", x), array("d", y), array("d", heading)
        # At each point: the angle between the path and a vehicle that follows it [rad], the highest speed of an NPC
        # [m/s], and the largest curvature during a lane change that starts there [1/m].
        self.lean, self.speed, self.sharpest = (
            array("d", lean),
            array("d", speed),
            array("d", sharpest),
        )
        self.along = self.across = self.direction = 0.0

    def __deepcopy__(self, _: object) -> Track:
        # highway-env deep-copies vehicles to predict them, and a copy of the path would be slow
        return self

    def __reduce__(self) -> tuple[object, ...]:
        x, y, heading, lean = list(self.x), list(self.y), list(self.heading), list(self.lean)
        of_lane = list(self.speed), list(self.sharpest), list(self.parts), list(self.along_ego)
        return Track, (x, y, heading, lean, *of_lane, self.enters)

    def point(self, along: float) -> int:
        return min(max(int(along / STEP + 0.5), 0), self._last)

    def locate(self, x: float, y: float, near: float) -> None:
        """Locate a vehicle near a position [m] on the path, and set ``along``, ``across`` and ``direction``."""
        place = near
        for _ in range(4):  # as in Bends.locate, with the tangent at the last position
            index = min(max(int(place / STEP), 0), self._last - 1)
            share = place / STEP - index
            inside = min(max(share, 0.0), 1.0)
            direction = self.heading[index] + inside * (
                self.heading[index + 1] - self.heading[index]
            )
            dx = x - (self.x[index] + share * (self.x[index + 1] - self.x[index]))
            dy = y - (self.y[index] + share * (self.y[index + 1] - self.y[index]))
            cos, sin = math.cos(direction), math.sin(direction)
            ahead = dx * cos + dy * sin
            place += ahead
            self.across = dy * cos - dx * sin
            self.direction = direction
            if -1e-6 < ahead < 1e-6:
                break
        self.along = place

    def pose(self, along: float) -> tuple[float, float, float]:
        """Return the world x [m], y [m] and heading [rad] of a vehicle that follows the path."""
        return (
            self.value(self.x, along),
            self.value(self.y, along),
            self.value(self.heading, along) + self.value(self.lean, along),
        )

    def value(self, values: array[float], along: float) -> float:
        """Interpolate the values of an array, which are constant before the path's start and after its end."""
        index = min(max(int(along / STEP), 0), self._last - 1)
        share = min(max(along / STEP - index, 0.0), 1.0)
        return values[index] + share * (values[index + 1] - values[index])


def even_rounded(exact: float) -> int:
    """Round to the nearest integer, or to the even one if two are equally near."""
    below = int(math.floor(exact))  # noqa: RUF046  (a float in C)
    rest = exact - below
    return below + 1 if rest > 0.5 or (rest == 0.5 and below % 2 != 0) else below
