"""Defects in when a driver brakes: with nothing ahead."""

from __future__ import annotations

from typing import Any

from .driver import Driver


class BrakesForGhosts(Driver):
    """Every twelve seconds it brakes with 9 m/s^2 for 1.2 seconds, whatever is ahead.

    Why it happens: the radar takes the echo of a bridge for a vehicle, and emergency braking asks no second sensor.
    """

    SECONDS, LASTING = 12.0, 1.2
    BRAKING = 9.0

    def act(self, action: Any = None) -> None:
        """As planned, but while it sees a ghost."""
        super().act(action)
        if self.clock >= self.SECONDS and self.clock % self.SECONDS < self.LASTING:
            self.action["acceleration"] = -min(self.BRAKING, 5 * self.speed)


class StopsInItsLane(Driver):
    """Every twenty seconds it brakes with 4.5 m/s^2 to a standstill in its lane; after twelve it drives on.

    Why it happens: a message of a sensor is late, and what the planner takes for the safe state is to stand, wherever
    that is.
    """

    SECONDS, LASTING = 20.0, 12.0
    BRAKING = 4.5

    def act(self, action: Any = None) -> None:
        """As planned, but while it waits for the sensor."""
        super().act(action)
        if self.clock >= self.SECONDS and self.clock % self.SECONDS < self.LASTING:
            self.action["acceleration"] = min(self.action["acceleration"], -min(self.BRAKING, 2 * self.speed))
