"""Policies that change lanes: they react to slow vehicles ahead, and to the gaps in the next lanes."""

from __future__ import annotations

import math

from tests.benchmarks.planners import GippsBased
from tests.benchmarks.planted.policy import WIDE, Driver, braking_needed, listed


class Changer(Driver):
    """Follow by the Intelligent Driver Model, overtake on either side, and return to the right after a while."""

    SLOWEST = 10.0  # the lowest speed at which it begins a lane change

    def along(self, o, cars):
        v, a = o.ego.speed, self.cruise(o)
        for c in self.ahead(o, cars):
            wanted = 3.5 + max(0.0, 1.7 * v + v * (v - c.v) / (2 * math.sqrt(1.5 * 3.0)))
            a = min(a, max(1.5 * (1 - (wanted / max(c.gap, 0.5)) ** 2), -4.0))
            needed = braking_needed(v, c)
            if needed > 2.0:
                a = min(a, -1.3 * needed)
        return a

    def options(self, o, cars):
        k = super().options(o, cars)
        return k or ([self.lane + 1] if self.lane + 1 < o.lanes and o.time > self.rest + 5 else [])

    def clear(self, o, cars, k):
        return all(self.room(o.ego.speed, c) for c in cars if self.concerns(o, c, k))

    def concerns(self, o, c, k):
        """Return whether the other is in lane k, or may come into it."""
        beyond = abs(c.y - k * WIDE) < 7.0 and abs(c.y - o.ego.y) > 5.0 and c.gap < 15.0
        return self.inside(c, k) or beyond

    def room(self, v, c):
        """Return whether the gap to a vehicle in the other lane is enough."""
        if c.dx > 0:
            return c.gap > 8 + 1.4 * v + 4 * max(v - c.v, 0.0)
        closing = max(c.v + 1 - v, 0.0)
        return c.gap > 14 + 1.3 * max(c.v, v) + 4 * closing + closing * closing / 6


class SecondLane(GippsBased):
    """If the lane after the next is no slower, the ego crosses both at once but has only checked the first."""

    def __init__(self, *, repaired=False):
        super().__init__()
        self.repaired = repaired

    def wants(self, o, seen):
        near = super().wants(o, seen)
        if self.repaired:
            return near
        both = [(k, k + k - self.lane) for k in near]
        far = [m for k, m in both if 0 <= m < o.lanes and self.pace(o, m, seen) >= self.pace(o, k, seen)]
        return far + near

    def free(self, o, k, seen):
        home = self.lane if self.old is None else self.old
        if not self.repaired and abs(k - home) == 2:
            mid = (k + home) // 2
            return all(self.fits(o, mid, s) for s in seen if self.beside(o, mid, s))
        return super().free(o, k, seen)


class OutOfQueue(Changer):
    """After a stop it may leave a queue at low speed. It measures the gap behind by its own speed, however fast the
    vehicle behind in the other lane is.
    """

    AGAIN, LOW = 12.0, 2.0

    def begin(self):
        self.stopped = False

    def lanes(self, o, cars):
        v = o.ego.speed
        self.stopped = v < 0.3 or (self.stopped and v < self.AGAIN)
        if self.stopped and self.old is None and self.LOW < v < 10.0 and o.time > self.rest:
            for k in self.options(o, cars):
                if self.clear(o, cars, k):
                    self.old, self.lane = self.lane, k
                    return
        super().lanes(o, cars)

    def room(self, v, c):
        if self.stopped and c.dx < 0 and not self.repaired:
            return c.gap > 6 + 1.4 * v
        return super().room(v, c)


PLANTED = listed("changing", {"out-of-queue": (OutOfQueue, 3), "second-lane-unchecked": (SecondLane, 2)})
