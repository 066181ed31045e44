"""The lanes of a road network of highway-env in plain numbers, with its equations, operation by operation."""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence

SINE, CIRCULAR = 1, 2
"""The kinds of lanes beside straight ones, which are 0."""
LANE_VALUES = 9
"""The number of values that give the shape of a lane; see :class:`Network`."""
LANE_ENDS = 5.0
"""The distance beyond a lane's ends up to which a vehicle is still in the lane [m]."""


class Network:
    """The lanes of a road network, in the order of highway-env's ``lanes_dict()``.

    Args:
        kinds: the kind of each lane: 0 for a straight one, 1 for a sine, 2 for a circle.
        shapes: nine values for each lane. Of a straight lane: x and y of its start [m], the direction as a vector, its
            heading [rad], and zeros; of a sine lane also its amplitude [m], pulsation [rad/m] and phase [rad]; of a
            circular lane: x and y of its centre [m], its radius [m], its start phase [rad], its direction (1 or -1),
            and zeros.
        lengths, widths, speed_limits: of each lane [m, m, m/s].
        sections: the number of each lane's road section.
        numbers: the number of each lane in its section, from the left.
        forbidden: 1 for each lane that may not be entered.

    Attributes:
        count: the number of lanes.
        along, across: the result of :meth:`locate` [m].
        x, y: the result of :meth:`position` [m].
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
        self.count = len(kinds)
        self._kinds, self._shapes = array("i", kinds), array("d", shapes)
        self._lengths, self._widths = array("d", lengths), array("d", widths)
        self._speed_limits = array("d", speed_limits)
        self._sections, self._numbers = array("i", sections), array("i", numbers)
        self._forbidden = array("i", forbidden)
        self.along = self.across = self.x = self.y = 0.0

    def __reduce__(self) -> tuple[object, ...]:
        """Return the parts for pickling, because worlds are sent to other processes."""
        sizes = list(self._lengths), list(self._widths), list(self._speed_limits)
        places = list(self._sections), list(self._numbers), list(self._forbidden)
        return Network, (list(self._kinds), list(self._shapes), *sizes, *places)

    def __deepcopy__(self, _: object) -> Network:
        """Return itself, because highway-env deep-copies vehicles with their road to predict them, which is slow."""
        return self

    def length(self, lane: int) -> float:
        """Return a lane's length [m]."""
        return self._lengths[lane]

    def width(self, lane: int) -> float:
        """Return a lane's width [m]."""
        return self._widths[lane]

    def speed_limit(self, lane: int) -> float:
        """Return a lane's speed limit [m/s]."""
        return self._speed_limits[lane]

    def number(self, lane: int) -> int:
        """Return the number of a lane in its section, from the left."""
        return self._numbers[lane]

    def is_beside(self, lane: int, other: int) -> bool:
        """Return whether a number is that of a lane in the same road section."""
        return 0 <= other < self.count and self._sections[lane] == self._sections[other]

    def locate(self, lane: int, x: float, y: float) -> None:
        """Set the place of a point along a lane and to the right of its centre line."""
        row, kind = lane * LANE_VALUES, self._kinds[lane]
        dx, dy = x - self._shapes[row], y - self._shapes[row + 1]
        if kind == CIRCULAR:
            radius, start, turn = self._shapes[row + 2], self._shapes[row + 3], self._shapes[row + 4]
            phi = math.atan2(dy, dx)
            phi = start + wrapped(phi - start)
            self.along = turn * (phi - start) * radius
            self.across = turn * (radius - math.sqrt(dx * dx + dy * dy))
            return
        cos, sin = self._shapes[row + 2], self._shapes[row + 3]
        self.along = dx * cos + dy * sin
        self.across = dx * -sin + dy * cos
        if kind == SINE:
            self.across -= self._sideways(row)

    def position(self, lane: int, along: float, across: float) -> None:
        """Set the point at a place along a lane and to the right of its centre line [m]."""
        row, kind = lane * LANE_VALUES, self._kinds[lane]
        if kind == CIRCULAR:
            radius, start, turn = self._shapes[row + 2], self._shapes[row + 3], self._shapes[row + 4]
            phi = turn * along / radius + start
            self.x = self._shapes[row] + (radius - across * turn) * math.cos(phi)
            self.y = self._shapes[row + 1] + (radius - across * turn) * math.sin(phi)
            return
        cos, sin = self._shapes[row + 2], self._shapes[row + 3]
        if kind == SINE:
            self.along = along
            across += self._sideways(row)
        self.x = self._shapes[row] + along * cos + across * -sin
        self.y = self._shapes[row + 1] + along * sin + across * cos

    def _sideways(self, row: int) -> float:
        """Return how far a sine lane is to the right of its axis at ``along`` [m]."""
        return self._shapes[row + 5] * math.sin(self._shapes[row + 6] * self.along + self._shapes[row + 7])

    def heading_at(self, lane: int, along: float) -> float:
        """Return a lane's direction at a place along it [rad]."""
        row, kind = lane * LANE_VALUES, self._kinds[lane]
        if kind == CIRCULAR:
            turn = self._shapes[row + 4]
            return turn * along / self._shapes[row + 2] + self._shapes[row + 3] + math.pi / 2.0 * turn
        heading = self._shapes[row + 4]
        if kind == SINE:
            amplitude, pulsation = self._shapes[row + 5], self._shapes[row + 6]
            heading += math.atan(amplitude * pulsation * math.cos(pulsation * along + self._shapes[row + 7]))
        return heading

    def closest(self, x: float, y: float, heading: float) -> int:
        """Return the first lane with the least sum of distances along and across it [m] and angle to it [rad]."""
        best, nearest = math.inf, 0
        for lane in range(self.count):
            self.locate(lane, x, y)
            along, length = self.along, self._lengths[lane]
            distance = abs(self.across) + max(along - length, 0.0) + max(0.0 - along, 0.0)
            if distance < best:  # the angle can only add to it
                distance += abs(wrapped(heading - self.heading_at(lane, along)))
                if distance < best:
                    best, nearest = distance, lane
        return nearest

    def is_on(self, lane: int, x: float, y: float, margin: float) -> bool:
        """Return whether a point is on a lane that is wider by a margin to each side [m], and set its place."""
        self.locate(lane, x, y)
        inside = -LANE_ENDS <= self.along < self._lengths[lane] + LANE_ENDS
        return inside and abs(self.across) <= self._widths[lane] / 2.0 + margin

    def is_reachable(self, lane: int, x: float, y: float) -> bool:
        """Return whether a vehicle may change to a lane from a point."""
        if self._forbidden[lane] != 0:
            return False
        self.locate(lane, x, y)
        inside = 0.0 <= self.along < self._lengths[lane] + LANE_ENDS
        return inside and abs(self.across) <= 2.0 * self._widths[lane]

    def is_after_end(self, lane: int, x: float, y: float) -> bool:
        """Return whether a vehicle at a point must take the next lane."""
        self.locate(lane, x, y)
        return self.along > self._lengths[lane] - LANE_ENDS / 2.0


def wrapped(angle: float) -> float:
    """Return an angle wrapped to [-pi, pi) [rad]."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi
