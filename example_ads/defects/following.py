"""Drivers that keep too little distance to the vehicle ahead, or brake too late or too weakly."""

from __future__ import annotations

from typing import Any

from .driver import Driver


class FollowsTooClose(Driver):
    """A driver that keeps a gap of 2 m plus 0.1 s. The healthy driver keeps 5 m plus 1.5 s.

    Why it happens: the gap was tuned in gentle traffic so that no vehicle cuts in. It is too short behind a leader that
    brakes hard.
    """

    DISTANCE_WANTED = Driver.LENGTH + 2.0
    TIME_WANTED = 0.1


class BrakesLateAboveTwenty(Driver):
    """A driver that, above 20 m/s, reacts to a leader only when the gap is below 10 m.

    Why it happens: the distance at which it reacts is from a table for city traffic, which ends at 20 m/s. Above this
    speed, the code uses a constant.
    """

    CALIBRATED_SPEED = 20.0
    REACTION_GAP = 10.0

    def acceleration(
        self, ego_vehicle: Any, front_vehicle: Any = None, rear_vehicle: Any = None
    ) -> float:
        """Return the IDM's acceleration [m/s^2], ignoring a leader that the driver considers far away."""
        if ego_vehicle is self and front_vehicle and self.speed > self.CALIBRATED_SPEED:
            gap = self.lane_distance_to(front_vehicle) - self.LENGTH
            front_vehicle = front_vehicle if gap < self.REACTION_GAP else None
        return float(super().acceleration(ego_vehicle, front_vehicle, rear_vehicle))


class BrakesWeakly(Driver):
    """A driver that never brakes harder than 2 m/s^2. The healthy driver brakes at up to 6 m/s^2.

    Why it happens: the comfort limit is applied to the planner's output, so it also limits emergency braking.
    """

    HARDEST_BRAKING = 2.0

    def act(self, action: Any = None) -> None:
        """Act as planned, but brake no harder than the limit."""
        super().act(action)
        self.action["acceleration"] = max(self.action["acceleration"], -self.HARDEST_BRAKING)
