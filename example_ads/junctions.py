"""A careful driver where ways cross: it gives way, stops at the line, and goes on when its way is free.

Kind (a), for a world such as ``pafot.World("intersection-v0", planner_hz=5)``. What it does, and where that is from:

- Right of way is given and not taken (Shalev-Shwartz, Shammah, Shashua 2017, arXiv:1708.06374, section 3.5): who has
  priority looks as well, and brakes for somebody who can no longer stop.
- It brakes for a line with 3 m/s^2, as drivers do when a light turns yellow (Institute of Transportation Engineers'
  formula for its interval: 10 ft/s^2), and stops in no zone, not even behind a queue beyond it.
- It goes ahead of another vehicle where it will have left 1.5 s before that one arrives. A shorter post-encroachment
  time (Allen, Shin, Cooper 1978) is commonly called a conflict. From a standstill that takes gaps of 5 to 6 s, as
  drivers accept (Highway Capacity Manual, base critical headways at two-way stops: 4.1 to 7.1 s).
- It goes behind another vehicle once that one has left the zone, so that nobody who stops there surprises it.
- Who has stood before a zone for two seconds while the ego stood, too, has let it go first, until it moves again.

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
"""[m/s]."""
ACCELERATION = 2.0
BRAKING = 3.0
"""For a line [m/s^2]."""
HARDEST = 7.0
"""In an emergency [m/s^2]."""
SPEEDING_UP = 0.2
"""What it expects of another at least, who may speed up by more already [m/s^2]."""
LINE_GAP = 1.0
"""Between where it stops and a zone [m]."""
MARGIN = 1.5
"""Between its leaving a zone and another's arrival [s]."""
PATIENCE = 2.0
"""After which who stands has let it go first [s]."""
STANDING = 0.3
"""Who is slower stands [m/s]."""
HEADWAY, STANDSTILL_GAP = 1.5, 3.0
"""Kept behind a leader [s, m]."""
EGO = -1
"""Its own number, beside those of the others."""


class CarefulDriver:
    """Drives through junctions as the head of the module says."""

    def __init__(self) -> None:
        self.time = 0.0
        self.speeds: dict[int, float] = {}
        self.gains: dict[int, float] = {}
        self.standing: dict[int, float] = {}
        self.let_go: set[int] = set()

    def __call__(self, seen: Observation) -> pafot.Drive:
        """The lane that it is in, and an acceleration [m/s^2]."""
        ego = seen.ego
        self.watch(seen)
        wishes = [self.cruise(ego), self.stop_in(self.line(seen), ego.speed)]
        wishes += [self.follow(ego, gap, speed) for gap, speed in self.leaders(seen)]
        return pafot.Drive(lane=ego.lane, acceleration=max(min(wishes), -HARDEST))

    def watch(self, seen: Observation) -> None:
        """Keep in mind who speeds up and by how much, who stands and since when, and who has let it go first."""
        speeds = {EGO: seen.ego.speed, **{other.id: other.speed for other in seen.crossing}}
        known = speeds.keys() & self.speeds.keys()
        self.gains = {who: (speeds[who] - self.speeds[who]) / (seen.time - self.time) for who in known}
        self.speeds, self.time = speeds, seen.time
        self.standing = {who: self.standing.get(who, seen.time) for who, speed in speeds.items() if speed < STANDING}
        waited = {who for who, since in self.standing.items() if seen.time - since >= PATIENCE}
        self.let_go = self.let_go & waited if EGO not in self.standing else waited

    # Where it has to stop.

    def line(self, seen: Observation) -> float:
        """How far it is to the place at which it has to stop, which is in no zone [m]; infinite where it need not."""
        stops = [other.ego_distance - LINE_GAP for other in self.relevant(seen) if self.waits_for(seen, other)]
        stop = min([*stops, *self.queues(seen)], default=math.inf)
        for other in sorted(seen.crossing, key=lambda each: -each.ego_distance):
            before = other.ego_distance - LINE_GAP
            if before < stop < other.ego_to_leave and self.can_stop(seen.ego, other):
                stop = before
        return stop

    def relevant(self, seen: Observation) -> list[CrossingVehicle]:
        """Those with whom it can still come together."""
        return [other for other in seen.crossing if other.to_leave > 0 and other.ego_to_leave > 0]

    def queues(self, seen: Observation) -> list[float]:
        """How far it is to the places behind leaders that are slow, where they will stand [m]."""
        slow = [(gap, speed) for gap, speed in self.leaders(seen) if speed < SPEED / 2]
        return [max(gap - STANDSTILL_GAP + speed**2 / (2 * BRAKING), 0.0) for gap, speed in slow]

    def can_stop(self, ego: VehicleState, other: CrossingVehicle) -> bool:
        """Whether it can stop before a zone."""
        return ego.speed**2 <= 2 * HARDEST * other.ego_distance

    def waits_for(self, seen: Observation, other: CrossingVehicle) -> bool:
        """Whether it stops before a zone for another vehicle."""
        ego = seen.ego
        if not self.can_stop(ego, other):
            return False  # it is in the zone, or as good as in it: the quickest way out is ahead
        if other.is_inside:
            return True
        if other.id in self.let_go or (other.zone.priority == "ego" and self.gives_way(other)):
            return False
        leaves = seconds_for(other.ego_to_leave, ego.speed, SPEED, ACCELERATION)
        return self.arrival(seen, other) < leaves + MARGIN

    def arrival(self, seen: Observation, other: CrossingVehicle) -> float:
        """When another vehicle comes to its zone [s]."""
        gain = max(self.gains.get(other.id, 0.0), SPEEDING_UP)
        return seconds_for(other.distance, other.speed, seen.speed_limit, gain)

    def gives_way(self, other: CrossingVehicle) -> bool:
        """Whether another vehicle can still stop before its zone without braking hard."""
        return other.speed**2 < 2 * BRAKING * other.distance

    # How it accelerates.

    def cruise(self, ego: VehicleState) -> float:
        """Towards the speed that it drives with where nobody is [m/s^2]."""
        return min(max(SPEED - ego.speed, -1.0), ACCELERATION)

    def stop_in(self, distance: float, speed: float) -> float:
        """For a stop in so many metres [m/s^2]; infinite while it is too early to brake."""
        needed = speed**2 / (2 * max(distance, 0.2))
        return -max(needed, 1.0) if needed > 0.7 * BRAKING or distance < 1.0 else math.inf

    def leaders(self, seen: Observation) -> list[tuple[float, float]]:
        """Gaps to those who are ahead in its lane, or join it there, and their speeds [m, m/s]."""
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
        """The Intelligent Driver Model behind a leader [m/s^2]."""
        closing = ego.speed * (ego.speed - speed) / (2 * math.sqrt(ACCELERATION * BRAKING))
        wanted = STANDSTILL_GAP + max(HEADWAY * ego.speed + closing, 0.0)
        return ACCELERATION * (1 - (wanted / max(gap, 0.1)) ** 2)


def seconds_for(distance: float, speed: float, top: float, acceleration: float) -> float:
    """How long a vehicle takes for a distance [m] that speeds up to a top speed, if it is not faster already [s]."""
    top = max(top, speed)
    gaining = (top**2 - speed**2) / (2 * acceleration)
    if distance <= gaining:
        return (math.sqrt(speed**2 + 2 * acceleration * max(distance, 0.0)) - speed) / acceleration
    return (top - speed) / acceleration + (distance - gaining) / top


def make() -> CarefulDriver:
    """A fresh driver."""
    return CarefulDriver()
