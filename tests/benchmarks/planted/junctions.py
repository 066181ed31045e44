"""Drivers with one defect each at junctions, made from the careful driver of ``example_ads``.

Each defect is a planner's mistake: a forgotten direction, a track that is dropped, a plan that is not checked again.
None of them depends on how scenarios are sampled or searched.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import pytest_pafot as pafot
from example_ads.junctions import STANDING, CarefulDriver, seconds_for
from tests.benchmarks.planted.policy import listed


class Driver(CarefulDriver):
    """The careful driver with one defect, unless it is ``repaired``."""

    def __init__(self, repaired=False):
        super().__init__()
        self.repaired = repaired
        self.begin()

    def begin(self):
        """Set up a defect's memory."""

    def knows(self, seen, other):
        """Return whether it is aware of another vehicle; a repaired driver is aware of all."""
        return True

    def relevant(self, seen):
        found = super().relevant(seen)
        return found if self.repaired else [other for other in found if self.knows(seen, other)]


class LeftOnly(Driver):
    """Looks only to the left, as a driver from a country with the other priority does."""

    def knows(self, seen, other):
        return other.zone.origin != "right"


class HiddenBehindTheFirst(Driver):
    """Keeps one track for each road that leads here. A second vehicle on a road becomes known 2.5 s after the first has
    left its zone.
    """

    LATE = 2.5

    def begin(self):
        self.first = {}

    def watch(self, seen):
        super().watch(seen)
        for road in {road_of(other) for other in seen.crossing}:
            known = [other for other in seen.crossing if road_of(other) == road]
            present = {other.id for other in known if other.to_leave > 0}
            number, left = self.first.get(road, (None, None))
            if number in present or not present:
                continue
            if left is None and number is not None:
                self.first[road] = number, seen.time
            elif number is None or seen.time - left >= self.LATE:
                near = min((other for other in known if other.id in present), key=lambda other: other.distance)
                self.first[road] = near.id, None

    def knows(self, seen, other):
        return self.first.get(road_of(other), (None, None))[0] == other.id


class RollsOverTheLine(Driver):
    """Aims at the line with its front instead of stopping before it, and ends up just beyond. A vehicle beyond the line
    counts as inside the junction, so it leaves as quickly as possible.
    """

    BEYOND = 1.4

    def stop_in(self, distance, speed):
        return super().stop_in(distance if self.repaired else distance + self.BEYOND, speed)


class DecidesOnce(Driver):
    """Decides 45 m before a zone when it is free, by the other's speed at that moment, and does not check again."""

    FROM, MARGIN = 45.0, 0.7

    def begin(self):
        self.decided = {}

    def waits_for(self, seen, other):
        if self.repaired or other.ego_distance > self.FROM:
            return super().waits_for(seen, other)
        speed = max(other.speed, 0.1)
        enters, leaves = other.distance / speed - self.MARGIN, other.to_leave / speed + self.MARGIN
        own = seen.ego.speed or 1.0
        meets = enters < other.ego_to_leave / own and other.ego_distance / own < leaves
        return self.decided.setdefault(other.id, meets) and super().waits_for(seen, other)


class ShortGap(Driver):
    """Takes a gap if it reaches the zone before the other, as if it had no length and needed no time."""

    def arrival(self, seen, other):
        arrival = super().arrival(seen, other)
        if self.repaired:
            return arrival
        ego = seen.ego
        leaves = seconds_for(other.ego_to_leave, ego.speed, max(9.0, ego.speed), 2.0)
        enters = seconds_for(other.ego_distance, ego.speed, max(9.0, ego.speed), 2.0)
        return arrival + leaves - enters + 1.8


class BlindToOncoming(Driver):
    """Looks for oncoming traffic on its own road, but not after it has turned."""

    def knows(self, seen, other):
        return other.zone.origin != "ahead"


class TrustsPriority(Driver):
    """Does not look at vehicles that must give way to it."""

    def gives_way(self, other):
        return super().gives_way(other) if self.repaired else True

    def knows(self, seen, other):
        return other.zone.priority != "ego"


class EyesOnOne(Driver):
    """Watches one vehicle, the nearest when it began, until that vehicle has left its zone."""

    def begin(self):
        self.watched = None

    def watch(self, seen):
        super().watch(seen)
        present = {other.id: other.ahead**2 + other.right**2 for other in seen.crossing if other.to_leave > 0}
        if self.watched not in present:
            self.watched = min(present, key=present.get, default=None)

    def knows(self, seen, other):
        return other.id == self.watched


class ForgetsWhoStands(Driver):
    """Takes a vehicle that has stood for a second for one that is parked at the roadside."""

    PARKED = 1.0

    def knows(self, seen, other):
        since = self.standing.get(other.id)
        return since is None or seen.time - since < self.PARKED


class BrakingIsGivingWay(Driver):
    """Takes a braking vehicle for one that gives way, even if it only slows down for a bend or for others."""

    BRAKING = 0.5

    def knows(self, seen, other):
        return other.is_inside or self.gains.get(other.id, 0.0) > -self.BRAKING


class EntryAlone(Driver):
    """Checks that the entry of the ring is free, but not whether a vehicle comes along the ring."""

    def knows(self, seen, other):
        return other.is_inside


class SlowOnesLeave(Driver):
    """Takes a slow vehicle on the ring for one that is about to leave it."""

    SLOW = 5.5

    def knows(self, seen, other):
        return other.speed > self.SLOW or other.speed < STANDING


def road_of(other):
    """Return the road from which another vehicle comes."""
    return other.zone.way.partition(">")[0]


PLACES: Mapping[str, pafot.World] = MappingProxyType(
    {
        "turning left": pafot.World("intersection-v0", config={"destination": "o1"}, planner_hz=5),
        "going ahead": pafot.World("intersection-v0", config={"destination": "o2"}, planner_hz=5),
        "turning right": pafot.World("intersection-v0", config={"destination": "o3"}, planner_hz=5),
        "roundabout": pafot.World("roundabout-v0", planner_hz=5),
    }
)
"""The ego's destination: across a crossroads, or into a roundabout."""

POLICIES = {
    "yields-to-the-left-only": (LeftOnly, 1, "going ahead"),
    "hidden-behind-the-first": (HiddenBehindTheFirst, 2, "going ahead"),
    "rolls-over-the-line": (RollsOverTheLine, 1, "turning left"),
    "decides-once": (DecidesOnce, 2, "going ahead"),
    "short-gap": (ShortGap, 1, "going ahead"),
    "blind-to-oncoming": (BlindToOncoming, 1, "turning left"),
    "trusts-priority": (TrustsPriority, 2, "turning right"),
    "eyes-on-one": (EyesOnOne, 2, "turning left"),
    "forgets-who-stands": (ForgetsWhoStands, 2, "going ahead"),
    "braking-is-giving-way": (BrakingIsGivingWay, 2, "turning left"),
    "looks-at-the-entry-alone": (EntryAlone, 1, "roundabout"),
    "slow-ones-leave": (SlowOnesLeave, 2, "roundabout"),
}
PLANTED = listed("junction", {name: (policy, conditions) for name, (policy, conditions, _) in POLICIES.items()})
WHERE: Mapping[str, str] = MappingProxyType({name: place for name, (*_, place) in POLICIES.items()})
"""The place of each policy, by name."""
