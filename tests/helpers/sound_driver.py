"""A driver that changes lanes and does nothing wrong, so that no attribution rule may find it at fault.

It follows at the distance of the careful and competent driver, and overtakes only if the gaps are more than generous.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from pytest_pafot.world.kernel.observation import Observation, VehicleState
from pytest_pafot.world.reference_drivers import CarefulHuman

RESPONSE, BRAKING, LEADERS_BRAKING = 1.0, 6.0, 8.0
"""The parameters of the safe distance: the follower's delay [s] and braking, and the leader's braking [m/s^2]."""
GENEROUS, SUFFICIENT = 1.5, 1.2
"""The shares of the gap for giving way that are necessary to begin a lane change, and to continue it."""
SECONDS = {GENEROUS: 3.0, SUFFICIENT: 1.5}
"""The time for which it could close in on a vehicle ahead there before that is too near [s]."""
LASTS = {GENEROUS: 4.0, SUFFICIENT: 3.0}
"""The time until it will have been in the other lane's track for a second [s]; that is 2 m to the side."""


@dataclass(slots=True)
class SoundLaneChanger(CarefulHuman):
    """The careful driver, which also drives as fast as it may, overtakes to do so, and otherwise keeps to the right.

    It wants to change lanes if the new lane is 2 m/s faster, or if the lane to the right is not slower. It looks at the
    vehicles in that lane, and at those that could enter it from the lane beyond or from its own. No vehicle may move
    sideways into it. A vehicle ahead must be beyond the safe distance even three seconds later. A vehicle behind must
    be beyond the safe distance and 1.5 times the gap for giving way, both now and at the end of the lane change, if
    both continue to slow down and speed up as they do now. All that must have held for half a second, in which it stays
    in the middle of its lane. It goes back if the gaps no longer suffice, as long as its box can still stay in its
    lane. It follows without delay every vehicle that comes over or will be in its way once it is in the middle of its
    lane.

    Attributes:
        path: The line that it steers to, which moves sideways at 1 m/s at most [m].
        origin: The lane to go back to; None while no lane change can be given up.
        changed: The time when it last began or gave up a lane change [s].
        changes: The number of lane changes that it completed.
    """

    SIDEWAYS = 1.0
    """The sideways speed [m/s]."""
    GAIN = 2.0
    """The speed gain that is worth a lane change [m/s]."""
    SIGHT = 200.0
    """The distance that it sees ahead [m]."""
    SLOWEST = 8.0
    """The lowest speed for a lane change [m/s]; below it, a lane change would take long."""
    SETTLED = 0.375
    """The largest distance from its lane's centre at which it begins a lane change [m]."""
    PATIENCE, LOOK = 4.0, 0.5
    """The time between two lane changes, and before one [s]."""

    path: float = math.nan
    origin: int | None = None
    changed: float = 0.0
    changes: int = 0

    def __call__(self, observation: Observation) -> tuple[float, float]:
        """Return acceleration [m/s^2] and steering [rad]."""
        acceleration, _ = CarefulHuman.__call__(self, observation)
        self.wanted = observation.speed_limit
        ego, width = observation.ego, observation.lane_width
        self.acceleration = acceleration = min(acceleration, self._attentive(observation))
        if self.origin is None:
            self._consider(observation)
        elif self._is_committed(ego, width):
            self.origin, self.changes = None, self.changes + 1
        elif not self._has_room(observation, self.lane, SUFFICIENT):
            self.lane, self.origin, self.changed = self.origin, None, self.now
        self._move_path(self.lane * width)
        heading = math.asin(max(min(0.6 * (self.path - ego.y) / max(ego.speed, 3.0), 0.2), -0.2))
        return acceleration, 6.0 / max(ego.speed, 6.0) * (heading - ego.heading)

    def _attentive(self, observation: Observation) -> float:
        """Return the acceleration to follow, without delay, vehicles in its track or lane or coming over [m/s^2]."""
        ego, wish = observation.ego, math.inf
        for index, other in enumerate(observation.others):
            leader, comes_over = self.ahead(observation, index), _comes_over(ego, other)
            in_way = other.lane == self.lane or _is_in_way(ego, other, self.lane * observation.lane_width)
            if leader is not None and (comes_over or in_way):
                wish = min(wish, self.follow(ego.speed, leader))
            wish = min(wish, 0.0) if comes_over else wish
        return wish

    def _consider(self, observation: Observation) -> None:
        """Begin a lane change if it is worth it and has had room for long enough."""
        ego = observation.ego
        is_settled = abs(ego.y - self.lane * observation.lane_width) < self.SETTLED and self.brakes_from > self.now
        is_ready = is_settled and self.now >= self.changed + self.PATIENCE and ego.speed >= self.SLOWEST
        sides = [lane for lane in (self.lane - 1, self.lane + 1) if 0 <= lane < observation.lanes]
        for lane in sorted(sides, key=lambda lane: -self._progress(observation, lane)):
            gain = self._progress(observation, lane) - self._progress(observation, self.lane)
            is_better = gain >= self.GAIN or (lane > self.lane and gain >= 0)
            is_wanted = is_ready and is_better and self._has_room(observation, lane, GENEROUS)
            if self.held(f"room {lane}", is_wanted) >= self.LOOK:
                self.origin, self.lane, self.changed = self.lane, lane, self.now
                return

    def _progress(self, observation: Observation, lane: int) -> float:
        """Return the speed that a lane promises [m/s]."""
        ego = observation.ego
        ahead = (other for other in observation.others if other.lane == lane and 0 < other.x - ego.x < self.SIGHT)
        return min([self.wanted or 0.0, *(other.speed for other in ahead)])

    def _has_room(self, observation: Observation, lane: int, share: float) -> bool:
        """Return whether no vehicle is, or could soon be, too close in a lane."""
        ego, centre = observation.ego, lane * observation.lane_width
        leaving = self.lane if self.origin is None else self.origin
        return not any(
            _moves_sideways(other, centre)
            or not (self._is_far(ego, other, braking, share) or _leads(ego, other, leaving))
            for other, braking in zip(observation.others, self.brakings, strict=True)
            if abs(other.lane - lane) <= 1
        )

    def _is_far(self, ego: VehicleState, other: VehicleState, braking: float, share: float) -> bool:
        """Return whether a vehicle in the lane to enter is far enough ahead or behind."""
        gap = abs(other.x - ego.x) - (ego.length + other.length) / 2
        if other.x > ego.x:
            return gap > _safe(ego.speed, other.speed) + SECONDS[share] * max(ego.speed - other.speed, 0.0)
        seconds = LASTS[share]
        own = max(ego.speed + min(self.acceleration, 0.0) * seconds, 0.0)
        others = other.speed + max(-braking, 0.0) * seconds
        closed = (other.speed + others - ego.speed - own) / 2 * seconds
        return gap > _asked(other.speed, ego.speed, share) and gap - closed > _asked(others, own, share)

    def _is_committed(self, ego: VehicleState, width: float) -> bool:
        """Return whether its box will cross the line even if it turns back now."""
        assert self.origin is not None
        side = 1.0 if self.lane > self.origin else -1.0
        sideways = max(side * ego.speed * math.sin(ego.heading), 0.0)
        return side * (ego.y - self.origin * width) + 0.6 * sideways > (width - ego.width) / 2 - 0.1

    def _move_path(self, centre: float) -> None:
        if math.isnan(self.path):
            self.path = centre
        step = self.SIDEWAYS * self.step
        self.path += max(min(centre - self.path, step), -step)


def _comes_over(ego: VehicleState, other: VehicleState) -> bool:
    """Return whether a vehicle alongside or ahead moves sideways into the ego's track and would be close there."""
    sideways = other.speed * math.sin(other.heading) * (1 if other.y < ego.y else -1)
    gap = other.x - ego.x - (ego.length + other.length) / 2
    return sideways > 0.3 and -(ego.length + other.length) < gap < 2 * ego.speed


def _moves_sideways(other: VehicleState, centre: float) -> bool:
    """Return whether a vehicle enters the lane with this centre, or leaves it."""
    return abs(other.speed * math.sin(other.heading)) > 0.2 and abs(other.y - centre) > 0.5


def _leads(ego: VehicleState, other: VehicleState, lane: int) -> bool:
    """Return whether a vehicle is ahead in a lane; following it keeps the distance anyway."""
    return other.lane == lane and other.x > ego.x


def _is_in_way(ego: VehicleState, other: VehicleState, centre: float) -> bool:
    """Return whether a vehicle reaches into the ego's track, now or once the ego is in the middle of a lane."""
    left, right = sorted((ego.y, centre))
    reach = _half_width(ego) + _half_width(other)
    return left - reach < other.y < right + reach


def _asked(behind: float, ahead: float, share: float) -> float:
    """Return the gap to leave ahead of a vehicle, from the speeds of both [m]."""
    closing = max(behind - ahead, 0.0)
    giving_way = closing * 0.4 + closing**2 / (2 * 3.0) + ahead * 1.0
    return max(share * giving_way, _safe(behind, ahead))


def _half_width(vehicle: VehicleState) -> float:
    return (vehicle.width * math.cos(vehicle.heading) + vehicle.length * abs(math.sin(vehicle.heading))) / 2


def _safe(follower: float, leader: float) -> float:
    """Return the safe distance between a follower and a leader with these speeds [m]."""
    return follower * RESPONSE + follower**2 / (2 * BRAKING) - leader**2 / (2 * LEADERS_BRAKING)
