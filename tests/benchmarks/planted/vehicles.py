"""Vehicle classes of highway-env that drive themselves; each class is its own factory.

They follow by the Intelligent Driver Model with an emergency brake. They change lanes if that gains acceleration, as in
MOBIL, and if the gaps are long enough. They decide five times a second, as planners do.
"""

from __future__ import annotations

import math
from functools import partial

from highway_env.vehicle.controller import ControlledVehicle

from pytest_pafot.world import VehicleState
from tests.benchmarks.planted.policy import WIDE, Car, Planted, braking_needed, clip

TICKS = 3  # ticks of 1/15 s from one decision to the next
PERIOD = TICKS / 15.0


def state_of(vehicle):
    """Return the state of a vehicle as planners see it; the lane does not matter here."""
    x, y = map(float, vehicle.position)
    return VehicleState(x, y, vehicle.heading, vehicle.speed, 0, vehicle.LENGTH, vehicle.WIDTH)


class Pilot(ControlledVehicle):
    """The sound policy."""

    repaired = False
    SHARE = 0.97  # of the speed limit
    # the acceleration gain that is worth a lane change; the time between two of them [s]
    GAIN, REST = 0.4, 4.0

    def __init__(self, road, position, heading=0.0, speed=0.0, **options):
        super().__init__(road, position, heading, speed, **options)
        self.wanted = self.origin = self.lane_index[2]
        self.lanes = len(road.network.graph[self.lane_index[0]][self.lane_index[1]])
        self.clock, self.rest, self.ticks, self.asked, self.speeds = 0.0, 3.0, 0, 0.0, {}
        self.begin()

    def begin(self):
        """Set up a defect's memory."""

    def act(self, action=None):
        """Decide at every third tick and hold the decision; steer at every tick."""
        if self.ticks % TICKS == 0:
            others = self.look()
            self.change(others)
            self.asked = clip(self.along(others), -8.0, 2.0)
            self.clock += PERIOD
        self.ticks += 1
        self.target_lane_index = (*self.lane_index[:2], self.wanted)
        self.action = {
            "acceleration": max(self.asked, -4.0 * max(self.speed, 0.0)),
            "steering": self.steering(),
        }

    def steering(self):
        v = max(self.speed, 4.0)
        heading = clip(0.45 * (self.wanted * WIDE - self.position[1]), -1.3, 1.3) / v
        return float(clip(2.0 * (clip(heading, -0.25, 0.25) - self.heading) * 5 / v, -0.2, 0.2))

    def look(self):
        ego, before = state_of(self), self.speeds
        vehicles = [other for other in self.road.vehicles if other is not self]
        self.speeds = {key: other.speed for key, other in enumerate(vehicles)}
        return [
            Car(key, state_of(other), ego, (other.speed - before.get(key, other.speed)) / PERIOD)
            for key, other in enumerate(vehicles)
        ]

    def in_way(self, c):
        """Return whether the other is ahead in this vehicle's strip, or soon will be."""
        a, b = float(self.position[1]), self.wanted * WIDE
        lo, hi = (a, b) if a < b else (b, a)
        may = clip(12 * c.turned, -1.5, 1.5) if abs(c.v) < 6 and abs(c.turned) > 0.03 else 0.0
        off = min(max(lo - y, y - hi, 0.0) for y in (c.y, c.y + 1.2 * c.w, c.y + may))
        return c.dx > 0 and off < c.reach + 1.4

    def leaders(self, others):
        return [c for c in others if self.in_way(c)]

    def along(self, others):
        leaders = self.leaders(others)
        a = min([self.free()] + [self.behind(c) for c in leaders])
        return min(a, self.emergency(leaders))

    def free(self):
        return clip(0.6 * (self.SHARE * self.lane.speed_limit - self.speed), -1.5, 1.8)

    def behind(self, c):
        return max(1.5 * (1 - (self.desired(c) / max(c.gap, 0.5)) ** 2), -6.0)

    def desired(self, c):
        v = self.speed
        return 4.0 + max(0.0, 1.7 * v + v * (v - c.v) / (2 * math.sqrt(1.5 * 3.0)))

    def emergency(self, leaders):
        needed = max([braking_needed(self.speed, c) for c in leaders], default=0.0)
        return -1.3 * needed if needed > 2.0 else 2.0

    def change(self, others):
        aside = abs(float(self.position[1]) - self.wanted * WIDE)
        if self.wanted != self.origin:
            if aside < 0.4:
                self.origin, self.rest = self.wanted, self.clock + self.REST
            elif abs(float(self.position[1]) - self.origin * WIDE) < 0.9 and not self.clear(
                others, self.wanted
            ):
                self.wanted, self.rest = self.origin, self.clock + 3.0
        elif self.clock > self.rest and aside < 0.4 and self.speed > 8.0:
            own = self.promise(others, self.wanted) + self.GAIN
            for k in (self.wanted - 1, self.wanted + 1):
                if 0 <= k < self.lanes and self.promise(others, k) > own and self.clear(others, k):
                    self.wanted = k
                    return

    def promise(self, others, k):
        """Return the acceleration that lane k allows [m/s^2]."""
        ahead = [c for c in others if 0 < c.dx < 90.0 and abs(c.y - k * WIDE) < 2.2]
        return min([self.free()] + [self.behind(c) for c in ahead])

    def clear(self, others, k):
        return all(self.room(c) for c in others if self.concerns(c, k))

    def concerns(self, c, k):
        coming = min(abs(c.y - k * WIDE), abs(c.y + 2.0 * c.w - k * WIDE)) < 2.9
        beyond = (
            abs(c.y - k * WIDE) < 7.0 and abs(c.y - float(self.position[1])) > 5.0 and c.gap < 15.0
        )
        return coming or beyond

    def room(self, c):
        v = self.speed
        if c.dx > 0:
            return c.gap > 9 + 1.4 * v + 4 * max(v - c.v, 0.0)
        closing = max(c.v + 1 - v, 0.0)
        return c.gap > 15 + 1.3 * max(c.v, v) + 4 * closing + closing * closing / 6


class ShortLookAhead(Pilot):
    """It looks 40 m ahead, which is enough behind moving vehicles, but not at full speed before a standing one."""

    AHEAD = 40.0

    def leaders(self, others):
        return [c for c in super().leaders(others) if self.repaired or c.gap < self.AHEAD]


class ClockWraps(Pilot):
    """The clock of the emergency brake counts milliseconds in 16 bits. Once it has braked in the first 32.8 s, it is
    never armed again after them.
    """

    def begin(self):
        self.rearmed = -math.inf

    def emergency(self, leaders):
        a, now = super().emergency(leaders), self.clock
        if not self.repaired:
            now = ((round(now * 1000) + 32768) % 65536 - 32768) / 1000
        if a >= 2.0:
            return a
        if now < self.rearmed:
            return 2.0
        self.rearmed = now  # it must be tested again before this moment counts
        return a


class TakenForShoulder(Pilot):
    """After a stop in the rightmost lane, which it takes for the hard shoulder, it pulls out to the left as soon as it
    moves. It only looks behind, not next to itself.
    """

    MOVES = 3.0

    def begin(self):
        self.stopped = False

    def change(self, others):
        rightmost = self.wanted == self.origin == self.lanes - 1
        self.stopped = rightmost and (self.stopped or self.speed < 0.3)
        if self.stopped and self.speed > self.MOVES:
            if self.clear(others, self.wanted - 1):
                self.wanted -= 1
            return
        super().change(others)

    def concerns(self, c, k):
        if self.stopped and not self.repaired and abs(c.dx) < 8.0:
            return False
        return super().concerns(c, k)


def given(policy, *, repaired=False):
    """Return a class, which is its own factory, or the same without its defect."""
    return type(f"{policy.__name__}Repaired", (policy,), {"repaired": True}) if repaired else policy


PLANTED = {
    name: Planted(
        "vehicle", conditions, partial(given, policy), partial(given, policy, repaired=True)
    )
    for name, policy, conditions in (
        ("short-look-ahead", ShortLookAhead, 1),
        ("clock-wraps", ClockWraps, 2),
        ("taken-for-shoulder", TakenForShoulder, 3),
    )
}
