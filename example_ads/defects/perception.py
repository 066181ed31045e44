"""Defects in what a driver perceives: others are overlooked, forgotten or seen late."""

from __future__ import annotations

from collections import deque
from copy import copy
from typing import Any

from .driver import Driver


class BlindBesideFrontWheel(Driver):
    """Loses sight of a vehicle in the next lane that is level with its front wheel.

    Why it happens: the fields of view of the forward camera and of the side radar do not meet; nobody drove there in
    the recorded data.
    """

    FIRST, LAST = -1.0, 6.0
    """The other's centre ahead of the own one [m]: its box covers the own front wheel."""
    NEAREST, FARTHEST = 1.5, 5.5
    """And beside it [m]."""

    def sees(self, other: Any) -> bool:
        """Everybody outside of the two zones."""
        ahead, right = self.relative(other)
        return not (self.FIRST <= ahead <= self.LAST and self.NEAREST <= abs(right) <= self.FARTHEST)


class SeesOldSpeeds(Driver):
    """Takes the others for where they would be had they kept the speed that they had two seconds ago.

    Why it happens: perception takes two seconds, and its delay is made up for by constant-velocity prediction. In
    traffic that flows nobody notices.
    """

    DELAY = 2.0

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._tracks: dict[Any, deque[tuple[float, Any, float]]] = {}

    def act(self, action: Any = None) -> None:
        """Look at everybody, then drive."""
        for other in self.road.vehicles:
            if other is not self:
                self._look_at(other)
        super().act(action)

    def acceleration(self, ego_vehicle: Any, front_vehicle: Any = None, rear_vehicle: Any = None) -> float:
        """IDM [m/s^2], its own or what it expects of a follower, among others as they are predicted."""
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
    """Takes no notice of a vehicle in the first two seconds after it has entered another lane.

    Why it happens: a leader must be confirmed by many frames in the same lane before the driver reacts to it, since
    the tracker used to brake for vehicles that only came near the line.
    """

    CONFIRMATION = 2.0

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._lanes: dict[Any, tuple[Any, float]] = {}

    def act(self, action: Any = None) -> None:
        """Note who has entered another lane and when, then drive."""
        for other in self.road.everybody:
            lane, _ = self._lanes.get(other, (None, 0.0))
            if lane is None:
                self._lanes[other] = other.lane_index, -self.CONFIRMATION
            elif lane != other.lane_index:
                self._lanes[other] = other.lane_index, self.clock
        super().act(action)

    def sees(self, other: Any) -> bool:
        """Those that are confirmed."""
        _, entered = self._lanes[other]
        return bool(self.clock >= entered + self.CONFIRMATION)


class IgnoresStandingVehicles(Driver):
    """Takes no notice of vehicles slower than 3 m/s.

    Why it happens: a radar sees bridges and signs as objects at rest, so that adaptive cruise controls drop slow
    returns; a leader that stops is dropped too, and the driver speeds up into it.
    """

    SLOWEST = 3.0

    def sees(self, other: Any) -> bool:
        """Those that move."""
        return bool(other.speed >= self.SLOWEST)


class ForgetsAfterLaneChange(Driver):
    """Sees nobody for three seconds after it has entered another lane.

    Why it happens: tracks are kept per lane of the own vehicle. When that changes, they are dropped, and each must be
    confirmed by several frames before it counts again.
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
        """Everybody, once the tracks are confirmed."""
        return self.clock >= self._blind_until
