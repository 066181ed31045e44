"""Drivers that overlook or forget other vehicles, or see them late."""

from __future__ import annotations

from collections import deque
from copy import copy
from typing import Any

from .driver import Driver


class BlindBesideFrontWheel(Driver):
    """A driver that does not see vehicles in adjacent lanes that are level with its front wheels.

    Why it happens: there is a gap between the fields of view of the forward camera and the side radar, and in the
    recorded data, no vehicle drove there.
    """

    FIRST, LAST = -1.0, 6.0
    """The range of longitudinal distances [m] between the two centres in which the other is next to the front wheel."""
    NEAREST, FARTHEST = 1.5, 5.5
    """The range of lateral distances [m] between the two centres."""

    def sees(self, other: Any) -> bool:
        """Return whether a vehicle is outside the two blind zones."""
        ahead, right = self.relative(other)
        return not (
            self.FIRST <= ahead <= self.LAST and self.NEAREST <= abs(right) <= self.FARTHEST
        )


class SeesOldSpeeds(Driver):
    """A driver that sees other vehicles where they would be if they had kept their speeds of two seconds ago.

    Why it happens: perception takes two seconds, and a constant-velocity prediction compensates for the delay. This
    goes unnoticed in flowing traffic.
    """

    DELAY = 2.0

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._tracks: dict[Any, deque[tuple[float, Any, float]]] = {}

    def act(self, action: Any = None) -> None:
        """Look at all vehicles, then drive."""
        for other in self.road.vehicles:
            if other is not self:
                self._look_at(other)
        super().act(action)

    def acceleration(
        self, ego_vehicle: Any, front_vehicle: Any = None, rear_vehicle: Any = None
    ) -> float:
        """Return the IDM's acceleration [m/s^2] of the driver or another vehicle, using the predicted states."""
        return float(
            super().acceleration(
                self._as_seen(ego_vehicle), self._as_seen(front_vehicle), rear_vehicle
            )
        )

    def _look_at(self, other: Any) -> None:
        track = self._tracks.setdefault(other, deque())
        track.append((self.clock, other.position.copy(), other.speed))
        while len(track) > 1 and track[1][0] <= self.clock - self.DELAY:
            track.popleft()

    def _as_seen(self, vehicle: Any) -> Any:
        if vehicle not in self._tracks:
            return vehicle
        seen = copy(vehicle)
        then, position, seen.speed = self._tracks[vehicle][0]
        seen.position = position + seen.speed * vehicle.direction * (self.clock - then)
        return seen


class SeesCutInsLate(Driver):
    """A driver that ignores each vehicle for two seconds after the vehicle has entered another lane.

    Why it happens: many frames must confirm a new leader before the driver reacts to it, because the driver used to
    brake for vehicles that only came near the line.
    """

    CONFIRMATION = 2.0

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._lanes: dict[Any, tuple[Any, float]] = {}

    def act(self, action: Any = None) -> None:
        """Record when each vehicle entered its lane, then drive."""
        for other in self.road.everybody:
            lane, _ = self._lanes.get(other, (None, 0.0))
            if lane is None:
                self._lanes[other] = other.lane_index, -self.CONFIRMATION
            elif lane != other.lane_index:
                self._lanes[other] = other.lane_index, self.clock
        super().act(action)

    def sees(self, other: Any) -> bool:
        """Return whether a vehicle has been in its lane for long enough."""
        _, entered = self._lanes[other]
        return bool(self.clock >= entered + self.CONFIRMATION)


class IgnoresStandingVehicles(Driver):
    """A driver that ignores vehicles slower than 3 m/s.

    Why it happens: a radar sees bridges and signs as stationary objects, so adaptive cruise control discards slow
    objects. It also discards a leader that stops, and the driver accelerates into it.
    """

    SLOWEST = 3.0

    def sees(self, other: Any) -> bool:
        """Return whether a vehicle moves at 3 m/s or more."""
        return bool(other.speed >= self.SLOWEST)


class ForgetsAfterLaneChange(Driver):
    """A driver that sees no other vehicles for three seconds after changing lanes.

    Why it happens: tracks are stored relative to the driver's lane. After a lane change, they are deleted, and several
    frames must confirm each new track.
    """

    CONFIRMATION = 3.0

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._tracked_lane = self.lane_index
        self._blind_until = 0.0

    def act(self, action: Any = None) -> None:
        """Become blind for three seconds in a new lane, then drive."""
        if self.lane_index != self._tracked_lane:
            self._tracked_lane = self.lane_index
            self._blind_until = self.clock + self.CONFIRMATION
        super().act(action)

    def sees(self, other: Any) -> bool:
        """Return whether the driver sees other vehicles again."""
        return self.clock >= self._blind_until
