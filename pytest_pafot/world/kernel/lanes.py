"""Vehicles as moving boxes, the lanes on which they drive, and the positions of all vehicles of a run.

Vehicles move according to highway-env's kinematic bicycle model. highway-env's own collision check is switched off,
because it also reports predicted contacts and pushes vehicles apart.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Sequence
from typing import Any

from pytest_pafot.model.crossings import NOT_ON_WAY
from pytest_pafot.model.trace import Outcome, Side
from pytest_pafot.world.limits import TOP_SPEED

# values per vehicle and tick in a record: x, y, heading, speed, acceleration, steering, lane
COLUMNS = 7
ROW_LENGTH = COLUMNS  # unlike COLUMNS, it is a C number in compiled code
# both forwards and backwards [m/s]; unlike TOP_SPEED, it is a C number in compiled code
MAX_SPEED = TOP_SPEED
# distance from a lane line below which rounding matters, so that all lanes are compared [m]
ALMOST = 1e-6
STEP = 0.5  # distance between neighbouring points of a line [m]
HALF_TURN = math.pi  # [rad]; unlike math.pi, it is a C number in compiled code
ON_LANE = 1e-6  # rounding tolerance at the edges of a lane [m]
NOWHERE = float("nan")
TRACK_COLUMNS = 5  # values per vehicle and tick in Trace.track


class Box:
    """A rectangle with a centre [m], a heading [rad], a length [m] and a width [m]."""

    def __init__(
        self,
        x: float,
        y: float,
        heading: float,
        length: float,
        width: float,
    ) -> None:
        self.x = x
        self.y = y
        self.heading = heading
        self.length = length
        self.width = width


class Body(Box):
    """A box with a speed [m/s] and controls, which apply until they are changed."""

    def __init__(self, length: float, width: float) -> None:
        self.x = self.y = self.heading = self.speed = self.acceleration = self.steering = 0.0
        self.length = length
        self.width = width
        # nearest lane, updated after all bodies have moved; not used for crossing vehicles
        self.lane = 0

    def place(
        self,
        x: float,
        y: float,
        heading: float,
        speed: float,
    ) -> None:
        """Set the position [m], the heading [rad] and the speed [m/s]."""
        self.x = x
        self.y = y
        self.heading = heading
        self.speed = speed

    def step(self, dt: float) -> None:
        """Move the body for ``dt`` seconds, with one explicit Euler step of highway-env's bicycle model."""
        speed = self.speed
        if speed > MAX_SPEED:
            self.acceleration = min(self.acceleration, MAX_SPEED - speed)
        elif speed < -MAX_SPEED:
            self.acceleration = max(self.acceleration, -MAX_SPEED - speed)
        course = self.heading
        if self.steering != 0.0:
            slip = math.atan(0.5 * math.tan(self.steering))
            course += slip
            self.heading += speed * math.sin(slip) / (self.length / 2.0) * dt
        if course == 0.0:
            self.x += speed * dt
        else:
            self.x += speed * math.cos(course) * dt
            self.y += speed * math.sin(course) * dt
        self.speed = speed + self.acceleration * dt


def overlap(a: Box, b: Box) -> bool:
    """Return whether two boxes overlap. A shared edge is not an overlap."""
    # Angles are upper bounds of their sines. With these bounds, most pairs are found to be apart without trigonometry.
    turn_a = abs(a.heading)
    turn_b = abs(b.heading)
    if 2.0 * abs(b.x - a.x) > a.length + b.length + a.width * turn_a + b.width * turn_b:
        return False
    if 2.0 * abs(b.y - a.y) > a.width + b.width + a.length * turn_a + b.length * turn_b:
        return False
    return depth(a, b) < 0.0


def depth(a: Box, b: Box) -> float:
    """Return the largest gap [m] between two boxes along any of their axes, negative if the boxes overlap."""
    along, across = separation(a, b)
    its_along, its_across = separation(b, a)
    return max(along, across, its_along, its_across)


def separation(a: Box, b: Box) -> tuple[float, float]:
    """Return the gaps [m] between two boxes along the length and the width of the first. Overlaps are negative."""
    cos_a = math.cos(a.heading)
    sin_a = math.sin(a.heading)
    turn = b.heading - a.heading
    cos_t = abs(math.cos(turn))
    sin_t = abs(math.sin(turn))
    dx = b.x - a.x
    dy = b.y - a.y
    along = abs(dx * cos_a + dy * sin_a)
    across = abs(dy * cos_a - dx * sin_a)
    return (
        along - (a.length + b.length * cos_t + b.width * sin_t) / 2.0,
        across - (a.width + b.length * sin_t + b.width * cos_t) / 2.0,
    )


def side_hit(ego_before: Box, other_before: Box) -> Side:
    """Return the side of the ego that was hit, given both boxes at the last tick before the contact."""
    # The contact occurred along the axis of the ego along which the gap was larger before.
    along, across = separation(ego_before, other_before)
    dx = other_before.x - ego_before.x
    dy = other_before.y - ego_before.y
    cos_h = math.cos(ego_before.heading)
    sin_h = math.sin(ego_before.heading)
    if along >= across:
        if dx * cos_h + dy * sin_h > 0.0:
            return "front"
        return "rear"
    if dy * cos_h - dx * sin_h > 0.0:
        return "right"
    return "left"


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
            body.lane = lane
            if lane < lanes:
                body.lane = lane + 1
        if self._left <= across <= self._right and 0.0 <= body.x <= self.length:
            return body.lane
        return -1

    def closest(self, along: float, across: float, heading: float) -> int:
        """Return the lane with the smallest sum of distance [m] and angle [rad], as highway-env does."""
        # A vehicle that is well inside a lane is nearest to that lane. Otherwise, all lanes are compared.
        near = 0
        if across > 0.0:
            near = int(across / self.width + 0.5)
        if near < self.count and abs(across - near * self.width) < self._inside:
            return near  # the other terms are equal for all lanes
        beyond = max(along - self.length, 0.0) + max(-along, 0.0)
        angle = abs((heading + math.pi) % (2.0 * math.pi) - math.pi)
        best = math.inf
        lane = 0
        for index in range(self.count):
            distance = abs(across - index * self.width) + beyond + angle
            if distance < best:
                best = distance
                lane = index
        return lane


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
        self._given = line, flags, shape, widths, lane_width
        # 1 where a lane exists, else 0; index of the lane in Trace.lanes, or -1
        exists, part = flags
        # At each point of a lane: the distance to the right of the line [m], the direction [rad], the lean of a vehicle
        # in the lane [rad], the highest speed of NPCs [m/s], and the largest curvature during a lane change [1/m].
        across, direction, lean, speed, sharpest = shape
        self._x = array("d", x)
        self._y = array("d", y)
        self._heading = array("d", heading)
        self._exists = array("i", exists)
        self._part = array("i", part)
        self._across = array("d", across)
        self._direction = array("d", direction)
        self._lean = array("d", lean)
        self._speed = array("d", speed)
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
        return Bends, self._given

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
        across = self.across_at(lane, along)
        sin = math.sin(self._direction0)
        cos = math.cos(self._direction0)
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

    def locate(
        self,
        x: float,
        y: float,
        heading: float,
        near: float,
    ) -> None:
        """Locate a vehicle on the road, and set ``along``, ``across``, ``angle``, ``lane`` and ``offset``.

        ``near`` is a position [m] close to the vehicle, which is needed because a road can cross itself.
        """
        along = near
        # each step projects onto the tangent at the last position, which converges even in bends
        for _ in range(4):
            self._refer(along)
            cos = math.cos(self._direction0)
            sin = math.sin(self._direction0)
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
        point = self.point(along)
        nearest = 0
        best = math.inf
        for lane in range(self._lanes):
            index = lane * self._points + point
            if self._exists[index] != 0 and abs(across - self._across[index]) < best:
                nearest = lane
                best = abs(across - self._across[index])
        self.along = along
        self.across = across
        self.lane = nearest
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
        if part >= 0 and abs(offset) <= self._widths[part] / 2.0 + ON_LANE:
            return part
        return -1

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
        self._given = x, y, heading, lean, speed, sharpest, parts, along_ego, enters
        self._last = len(x) - 1
        # The lane of each point as an index in Trace.lanes, the position of each point along the ego's path [m] or NaN,
        # and the position at which the path enters its zone [m].
        self.parts = array("i", parts)
        self.along_ego = array("d", along_ego)
        self.enters = enters
        self.x = array("d", x)
        self.y = array("d", y)
        self.heading = array("d", heading)
        # At each point: the angle between the path and a vehicle that follows it [rad], the highest speed of an NPC
        # [m/s], and the largest curvature during a lane change that starts there [1/m].
        self.lean = array("d", lean)
        self.speed = array("d", speed)
        self.sharpest = array("d", sharpest)
        self.along = self.across = self.direction = 0.0

    def __deepcopy__(self, _: object) -> Track:
        # highway-env deep-copies vehicles to predict them, and a copy of the path would be slow
        return self

    def __reduce__(self) -> tuple[object, ...]:
        return Track, self._given

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
            cos = math.cos(direction)
            sin = math.sin(direction)
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
    if rest > 0.5 or (rest == 0.5 and below % 2 != 0):
        return below + 1
    return below


class Places:
    """The positions of all vehicles of a run.

    On a curved road, vehicles are tracked from tick to tick, because the road can cross itself or be a circle.
    """

    def __init__(
        self,
        vehicles: list[Any],
        bodies: list[Any],
        lanes: Lanes | None = None,
        x: float = 0.0,
        y: float = 0.0,
        *,
        bends: Bends | None = None,
        starts: Sequence[float] = (),
        ways: Sequence[Track | None] = (),
        end: float = 0.0,
        beside: Callable[[float, float, int, float], tuple[int, Outcome | None]] | None = None,
        ticks: int = 0,
    ) -> None:
        self.vehicles: list[Body] = vehicles
        self.obstacles: list[Box] = []
        self.bodies: list[Body] = bodies
        # outcome if the ego has left the road or a vehicle has reached its end; always None on a straight road
        self.left: Outcome | None = None
        self._lanes: Any = lanes
        self._x = x
        self._y = y
        # None if `see` must place bodies after each tick
        self.lanes = None
        if vehicles[0] is bodies[0]:
            self.lanes = lanes
        self._bends: Any = bends
        self._ways = list(ways)  # path of each crossing NPC, None for the other vehicles
        self._end = end  # position along the ego's path at which the run ends [m]
        # If the ego is on no lane of its path, this function is called with x, y, the nearest lane and the position
        # along the path. It returns the index of the ego's lane in Trace.lanes, and the outcome if the run ends.
        self._beside: Any = beside
        self._along = array("d", starts)  # position of each vehicle along its path [m]
        # sum of the vehicles recorded at all earlier ticks, from which indices in `track` follow
        self._row = 0
        npcs = len(vehicles) - 1
        rows = 0
        if bends is not None:
            rows = ticks + 1
        crosses = len(ways) > ways.count(None)
        # values of Trace.track and Trace.on_way; empty if the trace does not need them
        self.track = array("d", [NOWHERE]) * (TRACK_COLUMNS * (npcs + 1) * rows)
        self.on_way = array("d", [NOWHERE]) * (npcs * rows if crosses else 0)

    def control(self) -> None:
        """Copy the NPCs' controls, which the director has set, from the bodies to the vehicles."""
        for number in range(1, len(self.vehicles)):
            vehicle = self.vehicles[number]
            body = self.bodies[number]
            vehicle.acceleration = body.acceleration
            vehicle.steering = body.steering

    def see(self, record: Any, row: int) -> None:
        """Locate all vehicles, place their bodies on the road, and write their lanes into the record."""
        bends = self._bends
        has_ended = False
        count = len(self.vehicles)
        first = row
        for number in range(count):
            vehicle = self.vehicles[number]
            body = self.bodies[number]
            if bends is None:
                body.place(vehicle.x - self._x, vehicle.y - self._y, vehicle.heading, vehicle.speed)
                record[row + 6] = self._lanes.locate(body)
            # the body of a crossing NPC is placed along and across the NPC's own path
            elif (way := self._ways[number]) is not None:
                record[row + 6] = self._on_own_way(vehicle, body, way, number)
            else:
                # all other bodies are placed along the ego's path, at a nominal lateral position
                bends.locate(vehicle.x, vehicle.y, vehicle.heading, self._along[number])
                along = bends.along
                self._along[number] = along
                body.place(
                    along,
                    bends.in_lanes(bends.lane, along, bends.offset),
                    bends.angle,
                    vehicle.speed,
                )
                body.lane = bends.nearest_lane(body.y)
                record[row + 6] = bends.part(bends.lane, along, bends.offset)
                self._note(number)
                has_ended = has_ended or along + body.length / 2.0 >= self._end
            row += ROW_LENGTH
        self._row += count
        if has_ended:
            self.left = Outcome.END_OF_ROAD
        # the ego is in a lane of another road, or off the road
        elif bends is not None and record[first + 6] < 0:
            ego = self.vehicles[0]
            bends.locate(ego.x, ego.y, ego.heading, self._along[0])
            record[first + 6], self.left = self._beside(ego.x, ego.y, bends.lane, bends.along)

    def _on_own_way(
        self,
        vehicle: Body,
        body: Body,
        way: Track,
        number: int,
    ) -> int:
        way.locate(vehicle.x, vehicle.y, self._along[number])
        along = self._along[number] = way.along
        turned = vehicle.heading - way.direction
        turned = (turned + HALF_TURN) % (2.0 * HALF_TURN) - HALF_TURN
        body.place(along, way.across, turned, vehicle.speed)
        self.on_way[self._row // len(self.vehicles) * (len(self.vehicles) - 1) + number - 1] = along
        if self.is_on_way(way, vehicle.x, vehicle.y, vehicle.heading, along):
            self._note(number)
        if 0.0 <= along <= (len(way.parts) - 1) * STEP:
            return way.parts[way.point(along)]
        return -1

    def along(self, number: int) -> float:
        return self._along[number]

    def way(self, number: int) -> Track | None:
        return self._ways[number]

    def is_on_way(
        self,
        way: Track | None,
        x: float,
        y: float,
        heading: float,
        along: float,
    ) -> bool:
        """Locate a vehicle along the ego's path, and return whether it is on that path."""
        bends: Bends = self._bends
        if way is None:
            bends.locate(x, y, heading, along)
            return True
        if along < way.enters:  # before its zone, a crossing NPC is never on the ego's path
            return False
        near = way.along_ego[min(even_rounded(along / STEP), len(way.along_ego) - 1)]
        if math.isnan(near):
            return False
        bends.locate(x, y, heading, near)
        is_on = bends.part(bends.lane, bends.along, bends.offset) >= 0
        return is_on and -NOT_ON_WAY < bends.angle < NOT_ON_WAY

    def _note(self, number: int) -> None:
        bends = self._bends
        track = self.track
        row = TRACK_COLUMNS * (self._row + number)
        track[row] = bends.along
        track[row + 1] = bends.across
        track[row + 2] = bends.angle
        track[row + 3] = bends.offset
        track[row + 4] = bends.stretch(bends.along, bends.across)
