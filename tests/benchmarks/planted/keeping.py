"""Policies that keep their lane and control only the distance."""

from __future__ import annotations

from tests.benchmarks.planted.policy import Driver, braking_needed, clip, listed


class Keeper(Driver):
    """Hold a time gap behind a vehicle in the way, and brake harder if that is not enough."""

    TIME, NEAREST = 1.7, 4.0

    def lanes(self, o, cars):
        """Return no lanes: it stays in its lane."""

    def along(self, o, cars):
        return min([self.cruise(o)] + [self.behind(o.ego.speed, c) for c in self.leaders(o, cars)])

    def leaders(self, o, cars):
        return self.ahead(o, cars)

    def behind(self, v, c):
        a = clip(0.25 * (c.gap - self.NEAREST - self.TIME * v) + 0.9 * (c.v - v), -4.0, 2.0)
        needed = braking_needed(v, c)
        return min(a, -1.25 * needed) if needed > 1.8 else a


class TrackAgeWraps(Keeper):
    """The age of a track, in radar cycles of 0.2 s, is stored in eight bits. A vehicle that has been ahead for 25 s
    becomes unconfirmed, and the ego does not brake for it.
    """

    CYCLE = 0.2

    def begin(self):
        self.since = {}

    def leaders(self, o, cars):
        leaders = super().leaders(o, cars)
        self.since = {c.i: self.since.get(c.i, o.time) if c.v > 1.0 else o.time for c in leaders}
        return [c for c in leaders if self.age(o.time - self.since[c.i]) >= 0]

    def age(self, seconds):
        cycles = int(seconds / self.CYCLE)
        return cycles if self.repaired else (cycles + 128) % 256 - 128


class HandOver(Keeper):
    """Below 8 m/s a different controller takes over, which builds its braking up from 0, not from the present value."""

    LOW, HIGH = 8.0, 9.5
    BUILD_UP = 2.5  # [m/s^3]

    def begin(self):
        self.low, self.sent = False, 0.0

    def along(self, o, cars):
        asked = super().along(o, cars)
        was, v = self.low, o.ego.speed
        self.low = v < (self.HIGH if self.low else self.LOW)
        if self.low and not self.repaired:
            before = self.sent if was else 0.0
            asked = max(asked, before - self.BUILD_UP * self.dt)
        self.sent = asked
        return asked


class Clutter(Keeper):
    """A vehicle that already stands when it enters the radar's range of 70 m is taken for a sign at the roadside."""

    RANGE = 70.0

    def begin(self):
        self.moving = set()

    def leaders(self, o, cars):
        near = {c.i for c in cars if abs(c.dx) < self.RANGE}
        self.moving = (self.moving & near) | {c.i for c in cars if c.i in near and c.v > 1.0}
        leaders = [c for c in super().leaders(o, cars) if c.i in near]
        return leaders if self.repaired else [c for c in leaders if c.i in self.moving]


class SpeedsByRank(Keeper):
    """The speeds of leaders are smoothed by rank, nearest first. A slow vehicle that becomes the nearest has its
    predecessor's speed for some seconds.
    """

    TAU = 1.0

    def begin(self):
        self.smooth = {}

    def leaders(self, o, cars):
        leaders = sorted(super().leaders(o, cars), key=lambda c: c.dx)
        smooth, self.smooth, share = self.smooth, {}, self.dt / (self.TAU + self.dt)
        for rank, c in enumerate(leaders):
            key = c.i if self.repaired else rank
            before = smooth.get(key, c.v)
            self.smooth[key] = c.v = before + (c.v - before) * share
        return leaders


class RearGuard(Keeper):
    """A guard against rear-end collisions limits braking to 1.5 m/s^2 for two seconds after a vehicle behind has closed
    in, however hard the vehicle ahead brakes.
    """

    NEAR, CLOSING, GENTLE, HOLD = 9.0, 0.5, -1.5, 2.0

    def begin(self):
        self.until = -1.0

    def along(self, o, cars):
        a, e = super().along(o, cars), o.ego
        if any(c.dx < 0 and c.gap < self.NEAR and abs(c.y - e.y) < 1.5 and c.v > e.speed + self.CLOSING for c in cars):
            self.until = o.time + self.HOLD
        if o.time < self.until and (not self.repaired or a > -2.5):  # in an emergency, the vehicle ahead takes priority
            a = max(a, self.GENTLE)
        return a


PLANTED = listed(
    "keeping",
    {
        "track-age-wraps": (TrackAgeWraps, 1),
        "hand-over-from-nothing": (HandOver, 1),
        "standing-is-clutter": (Clutter, 2),
        "speeds-by-rank": (SpeedsByRank, 2),
        "rear-guard-releases": (RearGuard, 3),
    },
)
