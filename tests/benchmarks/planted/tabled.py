"""Policies that follow a look-up table, and whose states decide when to use it."""

from __future__ import annotations

from bisect import bisect_right
from functools import cache
from types import SimpleNamespace

from tests.benchmarks.planted.policy import WIDE, Driver, braking_needed, clip, listed
from tests.benchmarks.policies_with_defects_2 import Machine, Planner

SPEEDS = (0.0, 0.5, 1.0, 2.0, 3.0, 4.5, 6.0, 9.0, 12.0, 15.0, 18.0, 21.0, 24.0, 27.0, 30.0)  # own speed
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


class Tabled(Driver, Machine):
    """The sound policy: it drives by the table, stands where it has stopped, overtakes and goes back."""

    def along(self, o, cars):
        near = self.ahead(o, cars)
        return self.by_state(o, near, min([self.cruise(o)] + [self.look_up(o.ego.speed, c) for c in near]))

    def by_state(self, o, near, a):
        """Hold the car where it has stopped close behind a vehicle."""
        v = o.ego.speed
        stands = v < 0.4 and any(c.gap < 7.0 and c.v < 0.8 for c in near)
        return -1.0 if stands else a

    def options(self, o, cars):
        return Planner.options(self, o, cars) or super().options(o, cars)

    def look_up(self, v, c):
        closing = v - c.v - 0.7 * min(c.a, 0.0)  # the closing speed soon
        i, j, k = bisect_right(SPEEDS, v) - 1, bisect_right(GAPS, c.gap) - 1, bisect_right(CLOSINGS, closing) - 1
        return self.value(max(i, 0), max(j, 0), max(k, 0))

    def value(self, i, j, k):
        return table()[i, j, k]


class UnfilledBlock(Tabled):
    """A block of the table, for 9 to 18 m/s, gaps of 4 to 14 m and closing speeds of 4.5 to 12 m/s, was never filled in
    and is 0.
    """

    def value(self, i, j, k):
        unfilled = 9 <= SPEEDS[i] < 18 and 4 <= GAPS[j] < 14 and 4.5 <= CLOSINGS[k] < 12
        return 0.0 if unfilled and not self.repaired else super().value(i, j, k)


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
        super().begin()
        self.until, self.behind = -1.0, set()

    def along(self, o, cars):
        v = o.ego.speed
        if v < 0.4:
            self.until, self.behind = o.time + self.SECONDS, {c.i for c in self.ahead(o, cars) if c.gap < 9.0}
        return super().along(o, cars)

    def ahead(self, o, cars):
        near = super().ahead(o, cars)
        if self.repaired or o.time >= self.until or not self.behind or o.ego.speed < 0.4:
            return near
        return [c for c in near if c.i in self.behind]


class OscillationGuard(Tabled):
    """Three changes between braking and speeding up within twelve seconds count as an oscillation of the controller.
    For five seconds it then brakes with 1 m/s^2 at most, even if the vehicle ahead brakes hard.
    """

    TURNS, WITHIN, SECONDS, LIMIT = 3, 12.0, 5.0, 1.0

    def begin(self):
        super().begin()
        self.turns, self.sign, self.until = [], 0, -1.0

    def by_state(self, o, near, a):
        a = super().by_state(o, near, a)
        sign = 1 if a > 0.5 else -1 if a < -1.5 else self.sign
        if sign != self.sign:
            self.turns, self.sign = [t for t in self.turns if t > o.time - self.WITHIN] + [o.time], sign
            if len(self.turns) >= self.TURNS:
                self.turns, self.until = [], o.time + self.SECONDS
        if o.time < self.until and (not self.repaired or a > -self.LIMIT):
            a = clip(a, -self.LIMIT, self.LIMIT)
        return a


class WayBack(Tabled):
    """While it goes back after a lane change that was given up, its leaders are those of the lane that it leaves, so it
    does not brake for vehicles in its own lane.
    """

    def begin(self):
        super().begin()
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
        "unfilled-block": (UnfilledBlock, 1),
        "past-last-column": (PastLastColumn, 1),
        "pulls-away": (PullsAway, 2),
        "oscillation-guard": (OscillationGuard, 2),
        "way-back-of-given-up-change": (WayBack, 3),
    },
)
