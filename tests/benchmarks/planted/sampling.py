"""Policies that plan a path: they sample candidates, predict all vehicles' places, and take the cheapest candidate."""

from __future__ import annotations

import math

from tests.benchmarks.planted.policy import WIDE, Driver, listed


class Sampler(Driver):
    """The sound planner: it checks both its accelerations and its lane changes at sampled times."""

    ENDS = (0.0, 1.5, 3.0, 4.5)  # the checked times of a lane change
    TIMES = (1.0, 2.0, 3.0, 4.0)
    CHOICES = (-8.0, -6.0, -4.5, -3.0, -2.0, -1.0, 0.0, 1.0, 1.8)
    PULL, DRIFT = 0.4, 1.2

    @staticmethod
    def moved(v, a, t):
        """Return the distance, and the speed after it."""
        if v + a * t < 0:
            return v * v / (-2 * a), 0.0
        return v * t + a * t * t / 2, v + a * t

    def course(self, c):
        a = c.a if c.a < -1 else 0.0
        return [(c.dx + d, f) for d, f in (self.moved(max(c.v, 0.0), a, t) for t in self.TIMES)]

    def price(self, o, a, courses):
        v, cost = o.ego.speed, 0.0
        for t, *there in zip(self.TIMES, *courses, strict=True):
            d, u = self.moved(v, a, t)
            for x, f in there:
                lack = 5 + 2.5 + 0.8 * u + max(u * u - f * f, 0.0) / 13 - (x - d)
                if lack > 0:
                    cost += lack
        return cost + 0.3 * abs(a) + 0.8 * abs(self.SHARE * o.speed_limit - max(v + 2 * a, 0.0))

    def along(self, o, cars):
        courses = [self.course(c) for c in self.ahead(o, cars) if c.gap < 130]
        if not courses:
            return self.cruise(o)
        return min(self.cruise(o), min(self.CHOICES, key=lambda a: self.price(o, a, courses)))

    def options(self, o, cars):
        """Return the lane with the most room ahead."""
        rooms = {}
        for k in (self.lane, self.lane - 1, self.lane + 1):
            if 0 <= k < o.lanes:
                here = [
                    c.gap + 2 * (c.v - o.ego.speed)
                    for c in cars
                    if c.dx > 0 and abs(c.y - k * WIDE) < 2.2
                ]
                rooms[k] = min([*here, 100.0])
        return [
            k
            for k in sorted(rooms, key=rooms.get, reverse=True)
            if rooms[k] > rooms[self.lane] + 15
        ]

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
        return (
            9 + 1.2 * v + 0.05 * max(v - c.v, 0.0) ** 2
            if c.dx > 0
            else 3 + t * (2.5 + 0.27 * max(v, c.v))
        )


class NoneFeasible(Sampler):
    """If each candidate is predicted to touch a vehicle, all are equally bad and the first one in the list is taken,
    which speeds up.
    """

    CHOICES = tuple(reversed(Sampler.CHOICES))

    def price(self, o, a, courses):
        touched = 0.0
        for number, t in enumerate(self.TIMES):
            d, _ = self.moved(o.ego.speed, a, t)
            touched += sum(max(d + 5.0 - course[number][0], 0.0) for course in courses)
        if touched > 0 and not self.repaired:
            return math.inf
        return super().price(o, a, courses) + 10 * touched


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
        # settling after a change that was given up at once
        if self.listed is None and self.old is None:
            return super().ahead(o, cars)
        if self.listed is None:
            near = (min(self.old, self.lane) * WIDE - 2.2, max(self.old, self.lane) * WIDE + 2.2)
            self.listed = {c.i for c in cars if near[0] < c.y < near[1]}
        leaders = super().ahead(o, cars)
        return leaders if self.repaired else [c for c in leaders if c.i in self.listed]


PLANTED = listed("sampling", {"none-feasible": (NoneFeasible, 1), "frozen-list": (FrozenList, 3)})
