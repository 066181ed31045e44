"""A careful driver where ways cross, which gives way, stops at the line, and continues when its way is free.

Kind (a), for a world such as ``pafot.World("intersection-v0", planner_hz=5)``. Its rules and their sources:

- Right of way is given and not taken (Shalev-Shwartz, Shammah, Shashua 2017, arXiv:1708.06374, section 3.5): with
  priority it looks, too, and brakes for a vehicle that can no longer stop.
- It brakes for a line with 3 m/s^2, as drivers do when a light turns yellow (Institute of Transportation Engineers'
  formula for its interval: 10 ft/s^2), and never stops in a zone, not even behind a queue beyond it.
- It passes before another vehicle if it will have left 1.5 s before that one arrives. A shorter post-encroachment
  time (Allen, Shin, Cooper 1978) is commonly called a conflict. From a standstill this needs gaps of 5 to 6 s, which
  drivers accept (Highway Capacity Manual, base critical headways at two-way stops: 4.1 to 7.1 s).
- It passes after another vehicle once that one has left the zone, so that a vehicle that stops there does not surprise
  it.
- A vehicle that stands before a zone for two seconds while the ego stands, too, lets the ego go first, until it moves
  again.

Along its way it follows by the Intelligent Driver Model (Treiber, Hennecke, Helbing 2000).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import pytest_pafot as pafot

if TYPE_CHECKING:
    from pytest_pafot import CrossingVehicle, Observation
    from pytest_pafot.world import VehicleState

SPEED = 9.0
"""The speed on a free road [m/s]."""
ACCELERATION = 2.0
BRAKING = 3.0
"""The braking for a line [m/s^2]."""
RESPONSE = 1.0
"""The time before another vehicle begins to brake for it [s]."""
HARDEST = 7.0
"""The braking in an emergency [m/s^2]."""
SPEEDING_UP = 0.2
"""The least acceleration that it expects of another vehicle [m/s^2]."""
LINE_GAP = 1.0
"""The distance before a zone at which it stops [m]."""
MARGIN = 1.5
"""The time between leaving a zone and another's arrival [s]."""
PATIENCE = 2.0
"""The time after which a standing vehicle lets it go first [s]."""
STANDING = 0.3
"""The speed below which a vehicle stands [m/s]."""
HEADWAY, STANDSTILL_GAP = 1.5, 3.0
"""The distance behind a leader [s, m]."""
EGO = -1
"""Its own number among the ids of the others."""


class CarefulDriver:
    """A driver for junctions by the rules of the module docstring."""

    def __init__(self) -> None:
        self.time = 0.0
        self.speeds: dict[int, float] = {}
        self.gains: dict[int, float] = {}
        self.standing: dict[int, float] = {}
        self.let_go: set[int] = set()

    def __call__(self, seen: Observation) -> pafot.LaneCommand:
        """Return the ego's lane and an acceleration [m/s^2]."""
        ego = seen.ego
        self.watch(seen)
        wishes = [self.cruise(ego), self.stop_in(self.line(seen), ego.speed)]
        wishes += [self.follow(ego, gap, speed) for gap, speed in self.leaders(seen)]
        return pafot.LaneCommand(lane=ego.lane, acceleration=max(min(wishes), -HARDEST))

    def watch(self, seen: Observation) -> None:
        """Note which vehicles speed up and how much, which stand and since when, and which let the ego go first."""
        speeds = {EGO: seen.ego.speed, **{other.id: other.speed for other in seen.crossing}}
        known = speeds.keys() & self.speeds.keys()
        self.gains = {who: (speeds[who] - self.speeds[who]) / (seen.time - self.time) for who in known}
        self.speeds, self.time = speeds, seen.time
        self.standing = {who: self.standing.get(who, seen.time) for who, speed in speeds.items() if speed < STANDING}
        waited = {who for who, since in self.standing.items() if seen.time - since >= PATIENCE}
        self.let_go = self.let_go & waited if EGO not in self.standing else waited

    # Places to stop.

    def line(self, seen: Observation) -> float:
        """Return the distance to where it has to stop, outside all zones [m]; infinite if it need not stop."""
        stops = [other.ego_distance - LINE_GAP for other in self.relevant(seen) if self.waits_for(seen, other)]
        stop = min([*stops, *self.queues(seen)], default=math.inf)
        for other in sorted(seen.crossing, key=lambda each: -each.ego_distance):
            before = other.ego_distance - LINE_GAP
            if before < stop < other.ego_to_leave and self.can_stop(seen.ego, other):
                stop = before
        return stop

    def relevant(self, seen: Observation) -> list[CrossingVehicle]:
        """Return the vehicles that it can still meet in a zone."""
        return [other for other in seen.crossing if other.to_leave > 0 and other.ego_to_leave > 0]

    def queues(self, seen: Observation) -> list[float]:
        """Return the distances to the places behind slow leaders once they stand [m]."""
        slow = [(gap, speed) for gap, speed in self.leaders(seen) if speed < SPEED / 2]
        return [max(gap - STANDSTILL_GAP + speed**2 / (2 * BRAKING), 0.0) for gap, speed in slow]

    def can_stop(self, ego: VehicleState, other: CrossingVehicle) -> bool:
        """Return whether it can stop before a zone."""
        return ego.speed**2 <= 2 * HARDEST * other.ego_distance

    def waits_for(self, seen: Observation, other: CrossingVehicle) -> bool:
        """Return whether it stops before a zone for another vehicle."""
        ego = seen.ego
        if not self.can_stop(ego, other):
            return False  # it is in the zone or about to enter it: the quickest way out is ahead
        if other.is_inside:
            return True
        if other.id in self.let_go or (other.zone.priority == "ego" and self.gives_way(other)):
            return False
        leaves = seconds_for(other.ego_to_leave, ego.speed, SPEED, ACCELERATION)
        return self.arrival(seen, other) < leaves + MARGIN

    def arrival(self, seen: Observation, other: CrossingVehicle) -> float:
        """Return when another vehicle reaches its zone [s]."""
        gain = max(self.gains.get(other.id, 0.0), SPEEDING_UP)
        return seconds_for(other.distance, other.speed, seen.speed_limit, gain)

    def gives_way(self, other: CrossingVehicle) -> bool:
        """Return whether another vehicle can still stop before its zone without braking hard, after a response."""
        return other.speed**2 < 2 * BRAKING * (other.distance - other.speed * RESPONSE)

    # Accelerations.

    def cruise(self, ego: VehicleState) -> float:
        """Return the acceleration towards the speed on a free road [m/s^2]."""
        return min(max(SPEED - ego.speed, -1.0), ACCELERATION)

    def stop_in(self, distance: float, speed: float) -> float:
        """Return the acceleration for a stop at a distance [m/s^2]; infinite while it is too early to brake."""
        needed = speed**2 / (2 * max(distance, 0.2))
        return -max(needed, 1.0) if needed > 0.7 * BRAKING or distance < 1.0 else math.inf

    def leaders(self, seen: Observation) -> list[tuple[float, float]]:
        """Return the gaps to the vehicles ahead in its lane, or joining it there, and their speeds [m, m/s]."""
        ego = seen.ego
        ahead = [
            (other.x - ego.x - (other.length + ego.length) / 2, other.speed)
            for other in seen.others
            if other.x > ego.x and abs(other.y - ego.y) < (other.width + ego.width) / 2 + 0.5
        ]
        joining = [
            (other.ego_to_leave - other.to_leave - (other.length + ego.length) / 2, other.speed)
            for other in self.relevant(seen)
            if other.zone.kind == "merging" and other.is_inside and other.to_leave < other.ego_to_leave
        ]
        return ahead + joining

    def follow(self, ego: VehicleState, gap: float, speed: float) -> float:
        """Return the acceleration of the Intelligent Driver Model behind a leader [m/s^2]."""
        closing = ego.speed * (ego.speed - speed) / (2 * math.sqrt(ACCELERATION * BRAKING))
        wanted = STANDSTILL_GAP + max(HEADWAY * ego.speed + closing, 0.0)
        return ACCELERATION * (1 - (wanted / max(gap, 0.1)) ** 2)


def seconds_for(distance: float, speed: float, top: float, acceleration: float) -> float:
    """Return the time for a distance [m] of a vehicle that speeds up to a top speed, unless already faster [s]."""
    top = max(top, speed)
    gaining = (top**2 - speed**2) / (2 * acceleration)
    if distance <= gaining:
        return (math.sqrt(speed**2 + 2 * acceleration * max(distance, 0.0)) - speed) / acceleration
    return (top - speed) / acceleration + (distance - gaining) / top


def make() -> CarefulDriver:
    """Return a fresh driver."""
    return CarefulDriver()
