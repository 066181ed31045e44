"""A careful driver for junctions, which gives way, stops at the line, and continues when its path is clear.

It is a planner for a world such as ``pafot.World("intersection-v0", planner_hz=5)``. Its rules and their sources are:

- Right of way is given, not taken (Shalev-Shwartz, Shammah, Shashua 2017, arXiv:1708.06374, section 3.5). Even if the
  ego has priority, it brakes for a vehicle that can no longer stop.
- It brakes for a line at 3 m/s^2, as drivers do when a light turns yellow (10 ft/s^2 in the formula of the Institute of
  Transportation Engineers for the yellow interval). It never stops in a zone, even if there is a queue after it.
- It passes before another vehicle if it will have left the zone 1.5 s before that vehicle arrives. A shorter
  post-encroachment time (Allen, Shin, Cooper 1978) is commonly called a conflict. From a standstill, this requires gaps
  of 5 to 6 s, which drivers accept (Highway Capacity Manual, base critical headways at two-way stops: 4.1 to 7.1 s).
- Otherwise, it waits until the other vehicle has left the zone, in case that vehicle stops there.
- If another vehicle and the ego are both stationary before a zone for two seconds, the ego goes first, until the other
  vehicle moves again.

It follows other vehicles according to the Intelligent Driver Model (Treiber, Hennecke, Helbing 2000).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import pytest_pafot as pafot

if TYPE_CHECKING:
    from pytest_pafot import CrossingVehicle, Observation
    from pytest_pafot.world import VehicleState

SPEED = 9.0
"""The speed [m/s] on an empty road."""
ACCELERATION = 2.0
BRAKING = 3.0
"""The deceleration [m/s^2] before a line."""
RESPONSE = 1.0
"""The time [s] after which another vehicle starts to brake for the ego."""
HARDEST = 7.0
"""The deceleration [m/s^2] in an emergency."""
SPEEDING_UP = 0.2
"""The lowest acceleration [m/s^2] that the ego expects of another vehicle."""
LINE_GAP = 1.0
"""The distance [m] before a zone at which the ego stops."""
MARGIN = 1.5
"""The smallest time [s] between the ego's exit from a zone and another vehicle's arrival."""
PATIENCE = 2.0
"""The time [s] after which the ego assumes that a stationary vehicle lets it go first."""
STANDING = 0.3
"""The speed [m/s] below which a vehicle counts as stationary."""
HEADWAY, STANDSTILL_GAP = 1.5, 3.0
"""The gap to a leader, as a time [s] plus a distance [m]."""
EGO = -1
"""The ego's id, which differs from the ids of all other vehicles."""


class CarefulDriver:
    """A driver for junctions that follows the rules in the module docstring."""

    def __init__(self) -> None:
        self.time = 0.0
        self.speeds: dict[int, float] = {}
        self.gains: dict[int, float] = {}
        self.standing: dict[int, float] = {}
        self.let_go: set[int] = set()

    def __call__(self, seen: Observation) -> pafot.LaneCommand:
        """Return a command with the ego's lane and an acceleration."""
        ego = seen.ego
        self.watch(seen)
        wishes = [self.cruise(ego), self.stop_in(self.line(seen), ego.speed)]
        wishes += [self.follow(ego, gap, speed) for gap, speed in self.leaders(seen)]
        return pafot.LaneCommand(lane=ego.lane, acceleration=max(min(wishes), -HARDEST))

    def watch(self, seen: Observation) -> None:
        """Record each vehicle's acceleration, since when it is stationary, and whether it lets the ego go first."""
        speeds = {EGO: seen.ego.speed, **{other.id: other.speed for other in seen.crossing}}
        known = speeds.keys() & self.speeds.keys()
        self.gains = {
            who: (speeds[who] - self.speeds[who]) / (seen.time - self.time) for who in known
        }
        self.speeds, self.time = speeds, seen.time
        self.standing = {
            who: self.standing.get(who, seen.time)
            for who, speed in speeds.items()
            if speed < STANDING
        }
        waited = {who for who, since in self.standing.items() if seen.time - since >= PATIENCE}
        self.let_go = self.let_go & waited if EGO not in self.standing else waited

    # Positions at which to stop.

    def line(self, seen: Observation) -> float:
        """Return the distance [m] to where the ego must stop, outside all zones; inf if it need not stop."""
        stops = [
            other.ego_distance - LINE_GAP
            for other in self.relevant(seen)
            if self.waits_for(seen, other)
        ]
        stop = min([*stops, *self.queues(seen)], default=math.inf)
        for other in sorted(seen.crossing, key=lambda each: -each.ego_distance):
            before = other.ego_distance - LINE_GAP
            if before < stop < other.ego_to_leave and self.can_stop(seen.ego, other):
                stop = before
        return stop

    def relevant(self, seen: Observation) -> list[CrossingVehicle]:
        """Return the vehicles that the ego can still meet in a zone."""
        return [other for other in seen.crossing if other.to_leave > 0 and other.ego_to_leave > 0]

    def queues(self, seen: Observation) -> list[float]:
        """Return the distances [m] to the positions behind slow leaders at which the ego would stop."""
        slow = [(gap, speed) for gap, speed in self.leaders(seen) if speed < SPEED / 2]
        return [max(gap - STANDSTILL_GAP + speed**2 / (2 * BRAKING), 0.0) for gap, speed in slow]

    def can_stop(self, ego: VehicleState, other: CrossingVehicle) -> bool:
        """Return whether the ego can stop before its zone with another vehicle."""
        return ego.speed**2 <= 2 * HARDEST * other.ego_distance

    def waits_for(self, seen: Observation, other: CrossingVehicle) -> bool:
        """Return whether the ego must stop before a zone for another vehicle."""
        ego = seen.ego
        if not self.can_stop(ego, other):
            # the ego is in the zone or about to enter it, and leaves it sooner if it continues
            return False
        if other.is_inside:
            return True
        if other.id in self.let_go or (other.zone.priority == "ego" and self.gives_way(other)):
            return False
        leaves = seconds_for(other.ego_to_leave, ego.speed, SPEED, ACCELERATION)
        return self.arrival(seen, other) < leaves + MARGIN

    def arrival(self, seen: Observation, other: CrossingVehicle) -> float:
        """Return the time [s] until another vehicle reaches the zone."""
        gain = max(self.gains.get(other.id, 0.0), SPEEDING_UP)
        return seconds_for(other.distance, other.speed, seen.speed_limit, gain)

    def gives_way(self, other: CrossingVehicle) -> bool:
        """Return whether another vehicle can respond and stop before the zone without braking hard."""
        return other.speed**2 < 2 * BRAKING * (other.distance - other.speed * RESPONSE)

    # Accelerations.

    def cruise(self, ego: VehicleState) -> float:
        """Return the acceleration [m/s^2] towards the speed on an empty road."""
        return min(max(SPEED - ego.speed, -1.0), ACCELERATION)

    def stop_in(self, distance: float, speed: float) -> float:
        """Return the acceleration [m/s^2] for a stop after a distance; inf while it is too early to brake."""
        needed = speed**2 / (2 * max(distance, 0.2))
        return -max(needed, 1.0) if needed > 0.7 * BRAKING or distance < 1.0 else math.inf

    def leaders(self, seen: Observation) -> list[tuple[float, float]]:
        """Return the gap [m] and the speed [m/s] of each vehicle that is ahead in the ego's lane or joins it there."""
        ego = seen.ego
        ahead = [
            (other.x - ego.x - (other.length + ego.length) / 2, other.speed)
            for other in seen.others
            if other.x > ego.x and abs(other.y - ego.y) < (other.width + ego.width) / 2 + 0.5
        ]
        joining = [
            (other.ego_to_leave - other.to_leave - (other.length + ego.length) / 2, other.speed)
            for other in self.relevant(seen)
            if other.zone.kind == "merging"
            and other.is_inside
            and other.to_leave < other.ego_to_leave
        ]
        return ahead + joining

    def follow(self, ego: VehicleState, gap: float, speed: float) -> float:
        """Return the Intelligent Driver Model's acceleration [m/s^2] behind a leader."""
        closing = ego.speed * (ego.speed - speed) / (2 * math.sqrt(ACCELERATION * BRAKING))
        wanted = STANDSTILL_GAP + max(HEADWAY * ego.speed + closing, 0.0)
        return ACCELERATION * (1 - (wanted / max(gap, 0.1)) ** 2)


def seconds_for(distance: float, speed: float, top: float, acceleration: float) -> float:
    """Return the time [s] that a vehicle takes for a distance [m] if it accelerates to its top speed."""
    top = max(top, speed)
    gaining = (top**2 - speed**2) / (2 * acceleration)
    if distance <= gaining:
        return (math.sqrt(speed**2 + 2 * acceleration * max(distance, 0.0)) - speed) / acceleration
    return (top - speed) / acceleration + (distance - gaining) / top


def make() -> CarefulDriver:
    """Return a new driver."""
    return CarefulDriver()
