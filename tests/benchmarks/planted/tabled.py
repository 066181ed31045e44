"""Policies that follow a look-up table, and whose states decide when to use it."""

from __future__ import annotations

from bisect import bisect_right
from functools import cache
from types import SimpleNamespace

from tests.benchmarks.planted.policy import WIDE, Driver, braking_needed, clip, listed

# own speed
SPEEDS = (0.0, 0.5, 1.0, 2.0, 3.0, 4.5, 6.0, 9.0, 12.0, 15.0, 18.0, 21.0, 24.0, 27.0, 30.0)
GAPS = (*range(0, 40, 2), *range(40, 101, 5))
CLOSINGS = (-8.0, -4.5, -3.0, -1.5, -0.5, 0.0, 0.5, *(1.5 * step for step in range(1, 15)))
FAR = 2.0  # acceleration if no vehicle is near


@cache
def table():
    """Return the acceleration for each own speed, gap and closing speed, at the worst corner of the table's box."""
    return {
        (i, j, k): entry((*SPEEDS, 33.0)[i + 1], float(gap), (*CLOSINGS, 22.5)[k + 1])
        for i in range(len(SPEEDS))
        for j, gap in enumerate(GAPS)
        for k in range(len(CLOSINGS))
    }


def entry(v, gap, closing):
    other = SimpleNamespace(v=max(v - closing, 0.0), gap=gap, a=0.0)
    a = clip(0.25 * (gap - 2.0 - 1.6 * v) - 0.9 * closing, -4.0, FAR)
    needed = braking_needed(v, other)
    return min(a, -1.25 * needed) if needed > 1.8 else a


class Tabled(Driver):
    """The sound policy: it drives by the table, stands where it has stopped, overtakes and goes back."""

    PULL = 0.5

    def along(self, o, cars):
        near = self.ahead(o, cars)
        return self.by_state(
            o, near, min([self.cruise(o)] + [self.look_up(o.ego.speed, c) for c in near])
        )

    def by_state(self, o, near, a):
        """Hold the car where it has stopped close behind a vehicle."""
        v = o.ego.speed
        stands = v < 0.4 and any(c.gap < 7.0 and c.v < 0.8 for c in near)
        return -1.0 if stands else a

    def options(self, o, cars):
        if found := super().options(o, cars):
            return found
        slow = self.flow(o, cars, self.lane) < self.SHARE * o.speed_limit - 2
        if slow:
            return [
                k
                for k in (self.lane - 1,)
                if k >= 0 and self.flow(o, cars, k) > self.flow(o, cars, self.lane) + 2
            ]
        if (
            self.lane < self.home
            and self.flow(o, cars, self.lane + 1) > self.SHARE * o.speed_limit - 1
        ):
            return [self.lane + 1]
        return []

    def concerns(self, o, c, k):
        return self.inside(c, k)

    def room(self, v, c):
        d = v - c.v if c.dx > 0 else c.v + 1 - v
        return c.gap >= (8 + 1.4 * v if c.dx > 0 else 14 + 1.3 * c.v) + 4 * max(d, 0)

    def look_up(self, v, c):
        closing = v - c.v - 0.7 * min(c.a, 0.0)  # the closing speed soon
        i, j, k = (
            bisect_right(SPEEDS, v) - 1,
            bisect_right(GAPS, c.gap) - 1,
            bisect_right(CLOSINGS, closing) - 1,
        )
        return self.value(max(i, 0), max(j, 0), max(k, 0))

    def value(self, i, j, k):
        return table()[i, j, k]


class PastLastColumn(Tabled):
    """Closing speeds above 13.5 m/s are past the last column of the table, which counts as no vehicle."""

    LAST = 13.5

    def look_up(self, v, c):
        return FAR if v - c.v > self.LAST and not self.repaired else super().look_up(v, c)


class PullsAway(Tabled):
    """For six seconds after it has stood, it watches only the vehicle that it stood behind, and does not see another
    that cuts in.
    """

    SECONDS = 6.0

    def begin(self):
        self.until, self.behind = -1.0, set()

    def along(self, o, cars):
        v = o.ego.speed
        if v < 0.4:
            self.until, self.behind = (
                o.time + self.SECONDS,
                {c.i for c in self.ahead(o, cars) if c.gap < 9.0},
            )
        return super().along(o, cars)

    def ahead(self, o, cars):
        near = super().ahead(o, cars)
        if self.repaired or o.time >= self.until or not self.behind or o.ego.speed < 0.4:
            return near
        return [c for c in near if c.i in self.behind]


class WayBack(Tabled):
    """While it goes back after a lane change that was given up, its leaders are those of the lane that it leaves, so it
    does not brake for vehicles in its own lane.
    """

    def begin(self):
        self.given_up = None

    def lanes(self, o, cars):
        lane, old = self.lane, self.old
        super().lanes(o, cars)
        if old is not None and self.old is None and self.lane == old:
            self.given_up = lane
        elif self.old is not None or abs(o.ego.y - self.lane * WIDE) < 0.15:
            self.given_up = None

    def ahead(self, o, cars):
        if self.given_up is None or self.repaired:
            return super().ahead(o, cars)
        return [c for c in cars if c.dx > 0 and abs(c.y - self.given_up * WIDE) < 2.0]


PLANTED = listed(
    "tabled",
    {
        "past-last-column": (PastLastColumn, 1),
        "pulls-away": (PullsAway, 2),
        "way-back-of-given-up-change": (WayBack, 3),
    },
)
