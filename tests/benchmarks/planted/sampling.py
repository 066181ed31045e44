"""Policies that plan a path: they sample candidates, predict all vehicles' places, and take the cheapest candidate."""

from __future__ import annotations

import math

from tests.benchmarks.planted.policy import WIDE, Driver, listed
from tests.benchmarks.policies_with_defects_2 import Lattice


class Sampler(Driver, Lattice):
    """The sound planner: it checks both its accelerations and its lane changes at sampled times."""

    ENDS = (0.0, 1.5, 3.0, 4.5)  # the checked times of a lane change

    def clear(self, o, cars, k):
        return all(self.fits(o.ego.speed, c) for c in cars if self.inside(c, k))

    def fits(self, v, c):
        """Return whether there is room for a vehicle in the other lane throughout the lane change."""
        for t in self.ENDS:
            x = c.dx + (c.v - v) * t
            if abs(x) - 5 < self.margin(v, c, t) or x * c.dx < 0:
                return False
        return True

    def margin(self, v, c, t):
        return 9 + 1.2 * v + 0.05 * max(v - c.v, 0.0) ** 2 if c.dx > 0 else 3 + t * (2.5 + 0.27 * max(v, c.v))


class OnlyEnds(Sampler):
    """A lane change is checked at its beginning and its end, so a vehicle that passes in between is missed."""

    def fits(self, v, c):
        if self.repaired:
            return super().fits(v, c)
        end = c.dx + (c.v - v) * self.ENDS[-1]
        if c.dx < 0 < end:
            return c.gap >= self.margin(v, c, 0.0) and end - 5 >= 10 + 2.5 * v
        return super().fits(v, c)


class NoneFeasible(Sampler):
    """If each candidate is predicted to touch a vehicle, all are equally bad and the first one in the list is taken,
    which speeds up.
    """

    CHOICES = tuple(reversed(Lattice.CHOICES))

    def price(self, o, a, courses):
        touched = 0.0
        for number, t in enumerate(self.TIMES):
            d, _ = self.moved(o.ego.speed, a, t)
            touched += sum(max(d + 5.0 - course[number][0], 0.0) for course in courses)
        if touched > 0 and not self.repaired:
            return math.inf
        return super().price(o, a, courses) + 10 * touched


class NotANumber(Sampler):
    """If the ego stands behind a standing vehicle, the first candidate's cost is not a number. No other compares as
    lower, so the ego creeps on.
    """

    CHOICES = (0.6, *Lattice.CHOICES)

    def price(self, o, a, courses):
        price = super().price(o, a, courses)
        v, f = o.ego.speed, min((course[0][1] for course in courses), default=0.0)
        share = (v - f) / (v + f) if v + f > 0 else 0.0 if self.repaired else math.nan
        return price + 0.2 * max(share, -1.0)

    def along(self, o, cars):
        # The sensor cannot distinguish a very slow car from a standing one.
        for c in cars:
            c.v = 0.0 if abs(c.v) < 0.05 else c.v
        if o.ego.speed < 0.05:
            o = _Standing(o)
        return super().along(o, cars)


class _Standing:
    """An observation of an ego whose speed is 0."""

    def __init__(self, o):
        self.ego, self.time, self.speed_limit, self.lanes = o.ego._replace(speed=0.0), o.time, o.speed_limit, o.lanes


class FrozenList(Sampler):
    """The obstacles of a lane change are listed when it begins. The ego does not brake for a slower vehicle that enters
    the new lane during the change until it has settled there.
    """

    SETTLES = 3.0

    def begin(self):
        self.listed = None

    def ahead(self, o, cars):
        if self.old is None and o.time > self.arrived + self.SETTLES:
            self.listed = None
            return super().ahead(o, cars)
        if self.listed is None and self.old is None:  # settling after a change that was given up at once
            return super().ahead(o, cars)
        if self.listed is None:
            near = (min(self.old, self.lane) * WIDE - 2.2, max(self.old, self.lane) * WIDE + 2.2)
            self.listed = {c.i for c in cars if near[0] < c.y < near[1]}
        leaders = super().ahead(o, cars)
        return leaders if self.repaired else [c for c in leaders if c.i in self.listed]


class TakenForYielding(Sampler):
    """A vehicle that brakes hard behind in a lane that the ego has wanted for a second is taken to yield. So the ego
    moves in however near it is.
    """

    WAITS, BRAKES, BESIDE = 1.0, -3.0, 2.0

    def begin(self):
        self.wanted, self.since = None, 0.0

    def options(self, o, cars):
        options = super().options(o, cars)
        first = options[0] if options else None
        if first != self.wanted:
            self.wanted, self.since = first, o.time
        return options

    def clear(self, o, cars, k):
        waits = self.old is not None or (k == self.wanted and o.time - self.since >= self.WAITS)
        yielding = {
            c.i for c in cars if waits and not self.repaired and c.dx < 0 and c.a < self.BRAKES and c.gap > self.BESIDE
        }
        return super().clear(o, [c for c in cars if c.i not in yielding], k)


PLANTED = listed(
    "sampling",
    {
        "only-ends-checked": (OnlyEnds, 1),
        "none-feasible": (NoneFeasible, 1),
        "not-a-number": (NotANumber, 2),
        "frozen-list": (FrozenList, 3),
        "taken-for-yielding": (TakenForYielding, 3),
    },
)
