"""highway-env's road networks as arrays, and the Kinematics observation.

Equations and option names are the same as in highway-env.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pytest_pafot.world.kernel.driver import clamp, wrap_angle

# kinds of lanes; a straight lane is 0
SINE = 1
CIRCULAR = 2
LANE_VALUES = 9  # values per lane in `shapes`; see Network
# distance past the ends of a lane within which a vehicle still counts as in the lane [m]
LANE_ENDS = 5.0
# highway-env's names for the features of a vehicle, in the order in which Table stores them
FEATURES = (
    "presence", "x", "y", "vx", "vy", "heading", "cos_h", "sin_h", "cos_d", "sin_d", "long_off", "lat_off", "ang_off",
)  # fmt: skip


class Network:
    """The lanes of a road network, in the order of highway-env's ``lanes_dict()``.

    Args:
        kinds: the kind of each lane: 0 for straight, 1 for sine, 2 for circular.
        shapes: nine values per lane, padded with zeros. A straight lane has the x [m] and y [m] of its start, a
            direction vector and a heading [rad]. A sine lane also has an amplitude [m], a pulsation [rad/m] and a phase
            [rad]. A circular lane has the x [m] and y [m] of its centre, a radius [m], a start phase [rad] and a
            direction (1 or -1).
        lengths, widths, speed_limits: length [m], width [m] and speed limit [m/s] of each lane.
        sections: the number of each lane's road section.
        numbers: the number of each lane in its section, from the left.
        forbidden: 1 for each lane that vehicles may not enter, else 0.
    """

    def __init__(
        self,
        kinds: Sequence[int],
        shapes: Sequence[float],
        lengths: Sequence[float],
        widths: Sequence[float],
        speed_limits: Sequence[float],
        sections: Sequence[int],
        numbers: Sequence[int],
        forbidden: Sequence[int],
    ) -> None:
        self._given = kinds, shapes, lengths, widths, speed_limits, sections, numbers, forbidden
        self.count = len(kinds)
        self._kinds = array("i", kinds)
        self._shapes = array("d", shapes)
        self.lengths = array("d", lengths)
        self._widths = array("d", widths)
        self.speed_limits = array("d", speed_limits)
        self._sections = array("i", sections)
        self.numbers = array("i", numbers)
        self._forbidden = array("i", forbidden)
        self.along = self.across = self.x = self.y = 0.0

    def __reduce__(self) -> tuple[object, ...]:
        return Network, self._given

    def __deepcopy__(self, _: object) -> Network:
        return self

    def is_beside(self, lane: int, other: int) -> bool:
        return 0 <= other < self.count and self._sections[lane] == self._sections[other]

    def locate(self, lane: int, x: float, y: float) -> None:
        """Set ``along`` and ``across`` to a point's distances [m] along a lane and to the right of its centre line."""
        row = lane * LANE_VALUES
        kind = self._kinds[lane]
        dx = x - self._shapes[row]
        dy = y - self._shapes[row + 1]
        if kind == CIRCULAR:
            radius = self._shapes[row + 2]
            start = self._shapes[row + 3]
            turn = self._shapes[row + 4]
            phi = math.atan2(dy, dx)
            phi = start + wrap_angle(phi - start)
            self.along = turn * (phi - start) * radius
            self.across = turn * (radius - math.sqrt(dx * dx + dy * dy))
            return
        cos = self._shapes[row + 2]
        sin = self._shapes[row + 3]
        self.along = dx * cos + dy * sin
        self.across = dx * -sin + dy * cos
        if kind == SINE:
            self.across -= self._sideways(row)

    def position(self, lane: int, along: float, across: float) -> None:
        """Set ``x`` and ``y`` to the point at given distances [m] along a lane and to the right of its centre line."""
        row = lane * LANE_VALUES
        kind = self._kinds[lane]
        if kind == CIRCULAR:
            radius = self._shapes[row + 2]
            start = self._shapes[row + 3]
            turn = self._shapes[row + 4]
            phi = turn * along / radius + start
            self.x = self._shapes[row] + (radius - across * turn) * math.cos(phi)
            self.y = self._shapes[row + 1] + (radius - across * turn) * math.sin(phi)
            return
        cos = self._shapes[row + 2]
        sin = self._shapes[row + 3]
        if kind == SINE:
            self.along = along
            across += self._sideways(row)
        self.x = self._shapes[row] + along * cos + across * -sin
        self.y = self._shapes[row + 1] + along * sin + across * cos

    def _sideways(self, row: int) -> float:
        return self._shapes[row + 5] * math.sin(
            self._shapes[row + 6] * self.along + self._shapes[row + 7]
        )

    def heading_at(self, lane: int, along: float) -> float:
        """Return a lane's direction [rad] at a distance from its start."""
        row = lane * LANE_VALUES
        kind = self._kinds[lane]
        if kind == CIRCULAR:
            turn = self._shapes[row + 4]
            return (
                turn * along / self._shapes[row + 2] + self._shapes[row + 3] + math.pi / 2.0 * turn
            )
        heading = self._shapes[row + 4]
        if kind == SINE:
            amplitude = self._shapes[row + 5]
            pulsation = self._shapes[row + 6]
            heading += math.atan(
                amplitude * pulsation * math.cos(pulsation * along + self._shapes[row + 7])
            )
        return heading

    def closest(self, x: float, y: float, heading: float) -> int:
        """Return the lane with the smallest sum of distance [m] and angle [rad] to a vehicle, or the first of these."""
        best = math.inf
        nearest = 0
        for lane in range(self.count):
            self.locate(lane, x, y)
            along = self.along
            length = self.lengths[lane]
            distance = abs(self.across) + max(along - length, 0.0) + max(0.0 - along, 0.0)
            if distance < best:  # adding the angle can only increase the sum
                distance += abs(wrap_angle(heading - self.heading_at(lane, along)))
                if distance < best:
                    best = distance
                    nearest = lane
        return nearest

    def is_on(
        self,
        lane: int,
        x: float,
        y: float,
        margin: float,
    ) -> bool:
        """Locate a point, and return whether it is on a lane that is widened on each side by ``margin`` [m]."""
        self.locate(lane, x, y)
        inside = -LANE_ENDS <= self.along < self.lengths[lane] + LANE_ENDS
        return inside and abs(self.across) <= self._widths[lane] / 2.0 + margin

    def is_reachable(self, lane: int, x: float, y: float) -> bool:
        """Return whether a vehicle may change to a lane from a point."""
        if self._forbidden[lane] != 0:
            return False
        self.locate(lane, x, y)
        inside = 0.0 <= self.along < self.lengths[lane] + LANE_ENDS
        return inside and abs(self.across) <= 2.0 * self._widths[lane]

    def is_after_end(self, lane: int, x: float, y: float) -> bool:
        """Return whether a vehicle at a point must switch to the next lane."""
        self.locate(lane, x, y)
        return self.along > self.lengths[lane] - LANE_ENDS / 2.0


class Table:
    """The Kinematics observation, with the features of the ego and of the nearest vehicles along the ego's lane."""

    def __init__(
        self,
        network: Network,
        lanes: dict[Any, int],
        options: Any,
        ranges: Mapping[str, Sequence[float]],
    ) -> None:
        features = options.features
        self._network = network
        self._lanes = lanes
        # features of the vehicle that was read last
        self._values = array("d", [0.0] * len(FEATURES))
        self._has_destination = "cos_d" in features or "sin_d" in features
        self._has_place = "long_off" in features or "lat_off" in features or "ang_off" in features
        self._is_scaled = array("i", [feature in ranges for feature in FEATURES])
        bounds = [ranges.get(feature, (0, 0)) for feature in FEATURES]
        self._low = array("d", [float(each[0]) for each in bounds])
        self._high = array("d", [float(each[1]) for each in bounds])
        self._is_clipped: bool = options.clip
        self._columns = array("i", [FEATURES.index(feature) for feature in features])
        self._count: int = options.vehicles_count
        self._is_relative = not options.absolute
        self._sees_behind: bool = options.see_behind
        self._sees_intentions: bool = options.observe_intentions

    def observe(
        self,
        ego: Any,
        vehicles: list[Any],
        objects: list[Any],
        reach: float,
        exit_lane: int,
    ) -> Any:
        """Return the observation as a float32 array of shape [vehicles, features].

        The ego observes vehicles up to ``reach`` [m] away. Unless ``exit_lane`` is -1, the ego's x is measured along
        ``exit_lane``.
        """
        values = self._values
        network = self._network
        count = len(vehicles)
        near = self._nearest(ego, vehicles, objects, reach)
        made = np.zeros((max(self._count, len(near) + 1), len(self._columns)), dtype=np.float32)
        table = made  # a typed memoryview in compiled code, to which writing is fast
        self._read(ego, False)
        x = values[1]
        y = values[2]
        vx = values[3]
        vy = values[4]
        if exit_lane >= 0:
            network.locate(exit_lane, x, y)
            values[1] = network.along
        for row in range(len(near) + 1):
            if row > 0:
                _, index, other = near[row - 1]
                self._read(other, index >= count)
                if not self._sees_intentions:
                    values[8] = values[9] = 0.0
                if self._is_relative:
                    values[1] -= x
                    values[2] -= y
                    values[3] -= vx
                    values[4] -= vy
            for column in range(len(self._columns)):
                table[row, column] = self._scaled(self._columns[column])
        return made

    def _nearest(
        self,
        ego: Any,
        vehicles: list[Any],
        objects: list[Any],
        reach: float,
    ) -> list[tuple[float, int, Any]]:
        network = self._network
        lane = self._lanes[ego.lane]
        found = []
        x, y = ego.position.tolist()
        network.locate(lane, x, y)
        here = network.along
        behind = -2.0 * ego.LENGTH
        count = len(vehicles)
        for index in range(count + len(objects)):
            other = vehicles[index] if index < count else objects[index - count]
            if other is ego:
                continue
            its_x, its_y = other.position.tolist()
            dx = its_x - x
            dy = its_y - y
            if math.sqrt(dx * dx + dy * dy) < reach:
                network.locate(lane, its_x, its_y)
                ahead = network.along - here
                if behind < ahead or (self._sees_behind and index < count):
                    found.append((abs(ahead), index, other))
        found.sort()
        # in highway-env, 0 other vehicles means no limit
        if self._count > 1:
            return found[: self._count - 1]
        return found

    def _read(self, vehicle: Any, is_object: bool) -> None:
        values = self._values
        heading = vehicle.heading
        x, y = vehicle.position.tolist()
        cos = math.cos(heading)
        sin = math.sin(heading)
        values[0] = 1.0
        values[1] = x
        values[2] = y
        values[6] = cos
        values[7] = sin
        values[8] = values[9] = 0.0
        if is_object:
            values[3] = values[4] = 0.0
            values[5] = values[10] = values[11] = values[12] = np.nan
            return
        speed = vehicle.speed
        values[3] = speed * cos
        values[4] = speed * sin
        values[5] = heading
        if self._has_destination:
            self._head_for_destination(vehicle, x, y)
        if self._has_place:
            lane = self._lanes[vehicle.lane]
            self._network.locate(lane, x, y)
            values[10] = self._network.along
            values[11] = self._network.across
            values[12] = wrap_angle(heading - self._network.heading_at(lane, values[10]))

    def _head_for_destination(self, vehicle: Any, x: float, y: float) -> None:
        route = getattr(vehicle, "route", None)
        if not route:
            return
        start, end, number = route[-1]
        if number is None:
            number = 0
        lane = self._lanes[vehicle.road.network.get_lane((start, end, number))]
        self._network.position(lane, self._network.lengths[lane], 0.0)
        dx = self._network.x - x
        dy = self._network.y - y
        away = math.sqrt(dx * dx + dy * dy)
        if away > 0.0:
            self._values[8] = dx / away
            self._values[9] = dy / away

    def _scaled(self, feature: int) -> float:
        value = self._values[feature]
        if not self._is_scaled[feature]:
            return value
        low = self._low[feature]
        value = -1.0 + (value - low) * 2.0 / (self._high[feature] - low)
        if self._is_clipped:
            return clamp(value, 1.0)
        return value
