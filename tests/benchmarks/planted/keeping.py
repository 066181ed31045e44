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


PLANTED = listed(
    "keeping", {"hand-over-from-nothing": (HandOver, 1), "standing-is-clutter": (Clutter, 2)}
)
