"""Drivers that brake although nothing is ahead."""

from __future__ import annotations

from typing import Any

from .driver import Driver


class BrakesForGhosts(Driver):
    """A driver that brakes at 9 m/s^2 for 1.2 seconds every twelve seconds, regardless of the traffic.

    Why it happens: the radar mistakes the echo of a bridge for a vehicle, and the emergency brake does not check a
    second sensor.
    """

    SECONDS, LASTING = 12.0, 1.2
    BRAKING = 9.0

    def act(self, action: Any = None) -> None:
        """Act as planned, except while the driver sees a ghost."""
        super().act(action)
        if self.clock >= self.SECONDS and self.clock % self.SECONDS < self.LASTING:
            self.action["acceleration"] = -min(self.BRAKING, 5 * self.speed)


class StopsInItsLane(Driver):
    """A driver that brakes at 4.5 m/s^2 to a standstill in its lane every twenty seconds, and continues after twelve.

    Why it happens: a sensor's message is late, and the planner's safe state is to stop, wherever the vehicle is.
    """

    SECONDS, LASTING = 20.0, 12.0
    BRAKING = 4.5

    def act(self, action: Any = None) -> None:
        """Act as planned, except while the driver waits for the sensor."""
        super().act(action)
        if self.clock >= self.SECONDS and self.clock % self.SECONDS < self.LASTING:
            self.action["acceleration"] = min(
                self.action["acceleration"], -min(self.BRAKING, 2 * self.speed)
            )
