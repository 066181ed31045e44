"""Parallel straight lanes in road coordinates: along the road, and across it from the centre of lane 0."""

from __future__ import annotations

import math

from pytest_pafot.world.kernel.bodies import Body

ALMOST = 1e-6
"""The distance to a lane line [m] below which rounding matters, so a vehicle's lane is found by comparing lanes."""


class Lanes:
    """Parallel lanes, numbered from the left, with one width and length [m]."""

    def __init__(self, count: int, width: float, length: float) -> None:
        self.count = count
        self.width = width
        self.length = length
        self._inside = width / 2.0 - ALMOST
        self._last = float(count - 1)
        self._left = -width / 2.0
        self._right = (count - 1) * width + width / 2.0

    def locate(self, body: Body) -> int:
        """Set a body's nearest lane (of two equally near, the left lane); return the lane, or -1 off the road.

        This is the lane of the record, the grid and the NPCs; highway-env's vehicles go by :meth:`closest`.
        """
        across = body.y
        offset = across - body.lane * self.width
        if -self._inside < offset < self._inside and 0.0 <= body.x <= self.length:
            return body.lane  # its previous lane
        lanes = across / self.width - 0.5
        if lanes <= 0.0:
            body.lane = 0
        elif lanes >= self._last:
            body.lane = self.count - 1
        else:
            lane = int(lanes)
            body.lane = lane + 1 if lane < lanes else lane
        return body.lane if self._left <= across <= self._right and 0.0 <= body.x <= self.length else -1

    def closest(self, along: float, across: float, heading: float) -> int:
        """Return the lane that highway-env finds: the first with the least sum of lateral distance and angle."""
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
