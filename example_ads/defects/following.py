"""Defects in how a driver follows: it keeps too little distance, or uses too little of its brakes."""

from __future__ import annotations

from typing import Any

from .driver import Driver


class FollowsTooClose(Driver):
    """Keeps a gap of 2 m and 0.1 s, where 5 m and 1.5 s are healthy.

    Why it happens: the gap was tuned among drivers who brake gently, so that nobody cuts in; it leaves no room behind a
    leader who brakes hard.
    """

    DISTANCE_WANTED = Driver.LENGTH + 2.0
    TIME_WANTED = 0.1


class BrakesLateAboveTwenty(Driver):
    """Above 20 m/s it reacts to a leader only when the gap is below 10 m; at lower speeds it is healthy.

    Why it happens: the distance at which to react comes from a table that was calibrated for city traffic and ends at
    20 m/s. Beyond its end the constant of the code is used.
    """

    CALIBRATED_SPEED = 20.0
    REACTION_GAP = 10.0

    def acceleration(self, ego_vehicle: Any, front_vehicle: Any = None, rear_vehicle: Any = None) -> float:
        """IDM [m/s^2], with the leader left out while it is thought to be far."""
        if ego_vehicle is self and front_vehicle and self.speed > self.CALIBRATED_SPEED:
            gap = self.lane_distance_to(front_vehicle) - self.LENGTH
            front_vehicle = front_vehicle if gap < self.REACTION_GAP else None
        return float(super().acceleration(ego_vehicle, front_vehicle, rear_vehicle))


class BrakesWeakly(Driver):
    """Never brakes harder than 2 m/s^2, where 6 m/s^2 are healthy.

    Why it happens: the limit for passengers' comfort was put behind the planner, where it also cuts emergency braking.
    """

    HARDEST_BRAKING = 2.0

    def act(self, action: Any = None) -> None:
        """As planned, but for the limit."""
        super().act(action)
        self.action["acceleration"] = max(self.action["acceleration"], -self.HARDEST_BRAKING)
