"""Defects in how a driver follows: it keeps too little distance, or uses too little of its brakes."""

from __future__ import annotations

from typing import Any

from .driver import Driver


class FollowsTooClose(Driver):
    """A driver that keeps a gap of 2 m and 0.1 s, where 5 m and 1.5 s are healthy.

    Why it happens: the gap was tuned so that no vehicle cuts in, among drivers who brake gently. It leaves no room
    behind a leader that brakes hard.
    """

    DISTANCE_WANTED = Driver.LENGTH + 2.0
    TIME_WANTED = 0.1


class BrakesLateAboveTwenty(Driver):
    """A driver that, above 20 m/s, reacts to a leader only when the gap is below 10 m; at lower speeds it is healthy.

    Why it happens: the distance at which it reacts is from a table for city traffic that ends at 20 m/s. Beyond the
    table, the code uses a constant.
    """

    CALIBRATED_SPEED = 20.0
    REACTION_GAP = 10.0

    def acceleration(self, ego_vehicle: Any, front_vehicle: Any = None, rear_vehicle: Any = None) -> float:
        """Return the IDM's acceleration [m/s^2], without a leader that is thought to be far."""
        if ego_vehicle is self and front_vehicle and self.speed > self.CALIBRATED_SPEED:
            gap = self.lane_distance_to(front_vehicle) - self.LENGTH
            front_vehicle = front_vehicle if gap < self.REACTION_GAP else None
        return float(super().acceleration(ego_vehicle, front_vehicle, rear_vehicle))


class BrakesWeakly(Driver):
    """A driver that never brakes harder than 2 m/s^2, where 6 m/s^2 are healthy.

    Why it happens: the limit for passengers' comfort was placed after the planner, where it also limits emergency
    braking.
    """

    HARDEST_BRAKING = 2.0

    def act(self, action: Any = None) -> None:
        """Act as planned, within the limit."""
        super().act(action)
        self.action["acceleration"] = max(self.action["acceleration"], -self.HARDEST_BRAKING)
