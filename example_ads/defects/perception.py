"""Defects in what a driver perceives: it overlooks or forgets others, or sees them late."""

from __future__ import annotations

from collections import deque
from copy import copy
from typing import Any

from .driver import Driver


class BlindBesideFrontWheel(Driver):
    """A driver that does not see a vehicle in the next lane that is level with its front wheel.

    Why it happens: the fields of view of the forward camera and of the side radar do not meet, and no vehicle drove
    there in the recorded data.
    """

    FIRST, LAST = -1.0, 6.0
    """The range of the other's centre ahead of the driver's [m], in which its box covers the driver's front wheel."""
    NEAREST, FARTHEST = 1.5, 5.5
    """The range of the distance between the two centres across the lane [m]."""

    def sees(self, other: Any) -> bool:
        """Return whether a vehicle is outside the two blind zones."""
        ahead, right = self.relative(other)
        return not (self.FIRST <= ahead <= self.LAST and self.NEAREST <= abs(right) <= self.FARTHEST)


class SeesOldSpeeds(Driver):
    """A driver that sees the others where they would be if they had kept their speeds of two seconds ago.

    Why it happens: perception takes two seconds, and constant-velocity prediction compensates for the delay. In flowing
    traffic this goes unnoticed.
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

    def acceleration(self, ego_vehicle: Any, front_vehicle: Any = None, rear_vehicle: Any = None) -> float:
        """Return the IDM's acceleration [m/s^2], its own or that expected of a follower, among the predicted others."""
        return float(super().acceleration(self._as_seen(ego_vehicle), self._as_seen(front_vehicle), rear_vehicle))

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
    """A driver that ignores a vehicle in the first two seconds after it has entered a different lane.

    Why it happens: many frames must confirm a leader in the same lane before the driver reacts to it, because the
    tracker used to brake for vehicles that only came near the line.
    """

    CONFIRMATION = 2.0

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._lanes: dict[Any, tuple[Any, float]] = {}

    def act(self, action: Any = None) -> None:
        """Note which vehicles have entered a different lane and when, then drive."""
        for other in self.road.everybody:
            lane, _ = self._lanes.get(other, (None, 0.0))
            if lane is None:
                self._lanes[other] = other.lane_index, -self.CONFIRMATION
            elif lane != other.lane_index:
                self._lanes[other] = other.lane_index, self.clock
        super().act(action)

    def sees(self, other: Any) -> bool:
        """Return whether a vehicle is confirmed."""
        _, entered = self._lanes[other]
        return bool(self.clock >= entered + self.CONFIRMATION)


class IgnoresStandingVehicles(Driver):
    """A driver that ignores vehicles slower than 3 m/s.

    Why it happens: a radar sees bridges and signs as objects at rest, so adaptive cruise controls drop slow returns. A
    leader that stops is dropped, too, and the driver speeds up into it.
    """

    SLOWEST = 3.0

    def sees(self, other: Any) -> bool:
        """Return whether a vehicle moves."""
        return bool(other.speed >= self.SLOWEST)


class ForgetsAfterLaneChange(Driver):
    """A driver that sees no other vehicle for three seconds after it has entered a different lane.

    Why it happens: tracks are stored relative to the driver's lane. When that changes, they are dropped, and several
    frames must confirm each before it counts again.
    """

    CONFIRMATION = 3.0

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._tracked_lane = self.lane_index
        self._blind_until = 0.0

    def act(self, action: Any = None) -> None:
        """Drop all tracks in a new lane, then drive."""
        if self.lane_index != self._tracked_lane:
            self._tracked_lane = self.lane_index
            self._blind_until = self.clock + self.CONFIRMATION
        super().act(action)

    def sees(self, other: Any) -> bool:
        """Return True for all vehicles, after their tracks are confirmed."""
        return self.clock >= self._blind_until
