"""Shared parts of all policies with a planted defect: how to list one, and the basis of a planner in SI units.

Units are metres, seconds and radians throughout.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

WIDE = 4.0  # a lane


@dataclass(frozen=True)
class Planted:
    """A policy with one defect, and its twin without it.

    Attributes:
        kind: The kind of policy.
        conditions: The number of things that must coincide before the defect shows, 1 to 3.
        make, twin: Return the ADS factory of the policy, and of the repaired one.
    """

    kind: str
    conditions: int
    make: Callable[[], Any]
    twin: Callable[[], Any]


def listed(kind: str, policies: Mapping[str, tuple[Any, int]]) -> dict[str, Planted]:
    """Return the policies of planner classes by name; each class takes ``repaired`` and has a number of conditions."""
    return {
        name: Planted(
            kind, conditions, partial(partial, planner), partial(partial, planner, repaired=True)
        )
        for name, (planner, conditions) in policies.items()
    }


def clip(x, lo, hi):
    return lo if x < lo else hi if x > hi else x


class Car:
    """A planner's data about another vehicle: `dx` ahead of the ego, `v` along the road, `w` sideways."""

    __slots__ = ("a", "dx", "gap", "i", "reach", "turned", "v", "w", "y")

    def __init__(self, i, s, e, a):
        sin, cos = math.sin(s.heading), math.cos(s.heading)
        self.i, self.dx, self.y, self.v, self.w, self.a = (
            i,
            s.x - e.x,
            s.y,
            s.speed * cos,
            s.speed * sin,
            a,
        )
        self.gap, self.turned = abs(self.dx) - (s.length + e.length) / 2, s.heading
        self.reach = (s.length * abs(sin) + s.width * cos) / 2


class Driver:
    """A planner with one defect, unless it is ``repaired``: memory of speeds, lane changes, steering."""

    SHARE = 0.96  # of the speed limit
    ANSWER, BRAKE = 1.5, 4.5  # time to answer [s], braking that it plans with [m/s^2]
    PULL, DRIFT = 0.45, 1.3  # of the steering: towards the goal [1/s], at most [m/s]
    REST = 4.0  # time between two lane changes [s]

    def __init__(self, repaired=False):
        self.repaired = repaired
        self.lane = self.old = self.last = None
        self.rest, self.speeds, self.home, self.arrived = 3.0, {}, 0, -9.0
        self.begin()

    def begin(self):
        pass

    def look(self, o):
        e, dt = o.ego, o.time - self.last if self.last is not None else 0.0
        self.dt, self.last = dt, o.time
        cars = []
        for i, s in enumerate(o.others):
            cars.append(Car(i, s, e, (s.speed - self.speeds[i]) / dt if dt > 0 else 0.0))
            self.speeds[i] = s.speed
        return cars

    def may(self, c):
        """Return the sideways distance that a slow vehicle turned towards a different lane may soon move."""
        return clip(12 * c.turned, -1.5, 1.5) if abs(c.v) < 6 and abs(c.turned) > 0.03 else 0.0

    def off(self, o, c, seconds=1.2):
        """Return how far the other is, or soon will be, sideways from the ego's strip."""
        a, b = o.ego.y, self.lane * WIDE
        lo, hi = (a, b) if a < b else (b, a)
        return min(max(lo - y, y - hi, 0.0) for y in (c.y, c.y + seconds * c.w, c.y + self.may(c)))

    def ahead(self, o, cars):
        return [c for c in cars if c.dx > 0 and self.off(o, c) < c.reach + 1.4]

    def inside(self, c, k, seconds=2.0):
        """Return whether the other is in lane k, or is coming."""
        return min(abs(c.y - k * WIDE), abs(c.y + seconds * c.w - k * WIDE)) < 2.9

    def flow(self, o, cars, k):
        """Return the speed that lane k promises."""
        return min(
            [self.SHARE * o.speed_limit]
            + [c.v for c in cars if 0 < c.dx < 90 and abs(c.y - k * WIDE) < 2.2]
        )

    def options(self, o, cars):
        """Return the lanes that it would prefer, best first."""
        own = self.flow(o, cars, self.lane) + 2.0
        flows = [
            (self.flow(o, cars, k), k) for k in (self.lane - 1, self.lane + 1) if 0 <= k < o.lanes
        ]
        return [k for f, k in sorted(flows, reverse=True) if f > own]

    def lanes(self, o, cars):
        e = o.ego
        if self.old is None:
            if o.time < self.rest or e.speed < 10 or abs(e.y - self.lane * WIDE) > 0.4:
                return
            for k in self.options(o, cars):
                if self.clear(o, cars, k):
                    self.old, self.lane = self.lane, k
                    return
        elif abs(e.y - self.lane * WIDE) < 0.4:
            self.old, self.rest, self.arrived = None, o.time + self.REST, o.time
        elif abs(e.y - self.old * WIDE) < 0.9 and not self.clear(o, cars, self.lane):
            self.lane, self.old, self.rest = self.old, None, o.time + 3.0

    def clear(self, o, cars, k):
        return all(self.room(o.ego.speed, c) for c in cars if self.concerns(o, c, k))

    def concerns(self, o, c, k):
        """Return whether the other is in lane k, or may come into it from either side."""
        beyond = abs(c.y - k * WIDE) < 7.0 and abs(c.y - o.ego.y) > 5.0 and c.gap < 15.0
        return self.inside(c, k) or beyond

    def behind(self, v, c):
        """Approach the speed from which it could stop behind the other."""
        f, room, late = (
            max(c.v + 0.4 * min(c.a, 0.0), 0.0),
            max(c.gap - 3.0, 0.0),
            self.BRAKE * self.ANSWER,
        )
        safe = math.sqrt(late * late + 2 * self.BRAKE * room + f * f) - late
        return clip((safe - v) / 0.9, -4.0, 2.0)

    def cruise(self, o):
        return clip(0.6 * (self.SHARE * o.speed_limit - o.ego.speed), -1.5, 1.8)

    def steer(self, e):
        v = max(e.speed, 4.0)
        h = clip(self.PULL * (self.lane * WIDE - e.y), -self.DRIFT, self.DRIFT) / v
        return clip(2.0 * (clip(h, -0.25, 0.25) - e.heading) * 5 / v, -0.2, 0.2)

    def __call__(self, o):
        if self.lane is None:
            self.lane = self.home = o.ego.lane
        cars = self.look(o)
        self.lanes(o, cars)
        a = clip(self.along(o, cars), -8.0, 2.0)
        return float(max(a, -4.0 * max(o.ego.speed, 0.0))), float(self.steer(o.ego))


def braking_needed(v, c):
    """Return the deceleration that another vehicle in the way requires [m/s^2]; v is the own speed."""
    f, room = max(c.v, 0.0), max(c.gap - 2.0, 0.3)
    needed = (v - f) ** 2 / (2 * room) if v > f else 0.0
    # it brakes, or is so near that its hardest braking counts
    if c.a < -1.0 or (room < 0.9 * v and v > f - 2.0):
        needed = max(needed, v * v / (2 * max(room + f * f / 15 - 0.4 * v, 0.5)))
    return needed
