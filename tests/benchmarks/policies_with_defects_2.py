"""Planners with seeded defects that can be switched off one by one (``repaired=``): ten with one, eight with more.

These measure the rules that separate findings. Their author did not know the rules. There are five makes of planner,
each with its own law for the distance and its own check before lane changes. Units are metres, seconds and radians
throughout. Each defect is where it was made, behind ``self.bad``.
"""

from __future__ import annotations

import math
from functools import partial

WIDE = 4.0  # a lane


def clip(x, lo, hi):
    return lo if x < lo else hi if x > hi else x


class Car:
    """A planner's data about another vehicle: `dx` ahead of the ego, `v` along the road, `w` sideways."""

    __slots__ = ("a", "dx", "gap", "i", "reach", "turned", "v", "w", "y")

    def __init__(self, i, s, e, a):
        sin, cos = math.sin(s.heading), math.cos(s.heading)
        self.i, self.dx, self.y, self.v, self.w, self.a = i, s.x - e.x, s.y, s.speed * cos, s.speed * sin, a
        self.gap, self.turned = abs(self.dx) - (s.length + e.length) / 2, s.heading
        self.reach = (s.length * abs(sin) + s.width * cos) / 2


class Planner:
    """The shared parts of all makes: memory of speeds, the course of a lane change, the steering."""

    SHARE = 0.96  # of the speed limit
    PULL, DRIFT = 0.45, 1.3  # of the steering: towards the goal [1/s], at most [m/s]
    REST = 4.0  # time between two lane changes [s]

    def __init__(self, bugs=frozenset()):
        self.bugs = bugs
        self.lane = self.old = self.last = None
        self.rest, self.speeds, self.home, self.arrived = 3.0, {}, 0, -9.0
        self.begin()

    def begin(self):
        pass

    def bad(self, name):
        return name in self.bugs

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
        return min([self.SHARE * o.speed_limit] + [c.v for c in cars if 0 < c.dx < 90 and abs(c.y - k * WIDE) < 2.2])

    def options(self, o, cars):
        """Return the lanes that it would prefer, best first."""
        own = self.flow(o, cars, self.lane) + 2.0
        flows = [(self.flow(o, cars, k), k) for k in (self.lane - 1, self.lane + 1) if 0 <= k < o.lanes]
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

    def cruise(self, o):
        if self.bad("set-speed-lost") and o.time < self.arrived + 2.5:
            return -6.0  # towards the 0 m/s with which a new lane begins
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


class Barrier(Planner):
    """A control barrier function: the braking distances, and a time to answer, must fit into the gap."""

    TAU, BRAKE, GAMMA = 1.3, 5.0, 0.45

    def room(self, gap, rear, front):
        """Return what is left of a gap [m]."""
        brake = self.BRAKE * (3.28 if self.bad("braking-in-feet") else 1.0)
        return gap - 4.0 - self.TAU * rear - max(rear * rear - front * front, 0.0) / (2 * brake)

    def allowed(self, o, c):
        v, f = o.ego.speed, max(c.v, 0.0)
        h = self.GAMMA * self.room(c.gap, v, f) + f - v
        if v <= f - 1:
            return h / self.TAU
        gains = abs(c.a) if self.bad("leader-acceleration-sign") else min(c.a, 0.0)
        return (h + f * gains / self.BRAKE) / (self.TAU + v / self.BRAKE)

    def ahead(self, o, cars):
        if self.bad("nearest-before-filter"):
            cars = sorted(cars, key=lambda c: abs(c.dx))[:1]
        return super().ahead(o, cars)

    def along(self, o, cars):
        return min([self.cruise(o)] + [self.allowed(o, c) for c in self.ahead(o, cars)])

    def clear(self, o, cars, k):
        v = o.ego.speed
        for c in cars:
            if not self.inside(c, k):
                continue
            if c.dx > 0:
                if self.room(c.gap, v, c.v) < 4:
                    return False
            elif self.bad("closing-sign-behind"):
                if c.gap < 4 or c.gap - 4.0 + 3.0 * (c.v - v) < 0:
                    return False
            elif c.gap - 12 - 1.3 * max(c.v, v) - 4.0 * max(c.v + 1 - v, 0) < 0:
                return False
        return True


class Lattice(Planner):
    """Sample accelerations, predict all vehicles' places, and take the cheapest."""

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
        if self.bad("penalty-saturates"):
            cost = min(cost, 12.0)
        return cost + 0.3 * abs(a) + 0.8 * abs(self.SHARE * o.speed_limit - max(v + 2 * a, 0.0))

    def along(self, o, cars):
        courses = [self.course(c) for c in self.ahead(o, cars) if c.gap < (17 if self.bad("range-too-short") else 130)]
        if not courses:
            return self.cruise(o)
        return min(self.cruise(o), min(self.CHOICES, key=lambda a: self.price(o, a, courses)))

    def options(self, o, cars):
        """Return the lane with the most room ahead."""
        rooms = {}
        for k in (self.lane, self.lane - 1, self.lane + 1):
            if 0 <= k < o.lanes:
                here = [c.gap + 2 * (c.v - o.ego.speed) for c in cars if c.dx > 0 and abs(c.y - k * WIDE) < 2.2]
                rooms[k] = min([*here, 100.0])
        return [k for k in sorted(rooms, key=rooms.get, reverse=True) if rooms[k] > rooms[self.lane] + 15]

    def clear(self, o, cars, k):
        v = o.ego.speed
        for c in cars:
            if not self.inside(c, k):
                continue
            s = c.v - v if self.bad("relative-twice") and c.dx < 0 else c.v
            for t in (0.0, 1.5, 3.0, 4.5):
                x = c.dx + (s - v) * t
                need = 9 + 1.2 * v + 0.05 * max(v - c.v, 0) ** 2 if c.dx > 0 else 3 + t * (2.5 + 0.27 * max(v, c.v))
                if abs(x) - 5 < need or x * c.dx < 0:
                    return False
        return True


class Machine(Planner):
    """States with hysteresis: free, follow, brake, stand. Overtakes on the left, and goes back."""

    PULL = 0.5

    def begin(self):
        self.state, self.entered, self.left = "free", 0.0, 0

    def need(self, v, c):
        """Return the deceleration that the other requires."""
        f, room = max(c.v, 0.0), max(c.gap - 3.0, 0.3)
        n = (v - f) ** 2 / (2 * room) if v > f else 0.0
        if c.a < -1 or c.gap < 0.9 * v:
            n = max(n, v * v / (2 * max(room + f * f / 14 - 0.4 * v, 0.5)) if v > f - 2 else 0.0)
        return n

    def ahead(self, o, cars):
        if self.old is not None:
            self.left = self.old
        if self.bad("leaders-of-old-lane") and (self.old is not None or o.time < self.arrived + 5):
            return [c for c in cars if c.dx > 0 and abs(c.y - self.left * WIDE) < 2.0]
        return super().ahead(o, cars)

    def turn(self, o, c, n):
        """Return the next state."""
        v, near = o.ego.speed, 6 + 2.4 * o.ego.speed + 3 * max(o.ego.speed - c.v, 0.0)
        if self.state == "stand":
            return "stand" if c.v < 0.8 and c.gap < 7 else "follow"
        if n > (1.0 if self.state == "brake" else 2.2):
            return "brake"
        if v < 0.4 and c.gap < 7:
            return "stand"
        if self.state == "free":
            return "follow" if c.gap < near else "free"
        return "free" if c.gap > 1.25 * near else "follow"

    def answer(self, o, c):
        v, n = o.ego.speed, self.need(o.ego.speed, c)
        self.enter(o, self.turn(o, c, n))
        if self.state == "brake":
            return -max(1.3 * n, 3.0)
        if self.state == "stand":
            return 1.0 if self.bad("stand-sign") else -1.0
        return self.cruise(o) if self.state == "free" else max(0.3 * (c.gap - 4 - 1.9 * v) + 1.1 * (c.v - v), -3.0)

    def enter(self, o, state):
        if self.bad("states-dwell") and o.time < self.entered + 3.0:
            return
        if state != self.state:
            self.state, self.entered = state, o.time

    def along(self, o, cars):
        near = self.ahead(o, cars)
        if not near:
            self.enter(o, "free")
            return self.cruise(o)
        first = max(near, key=lambda c: (self.need(o.ego.speed, c), -c.gap))
        return min(self.cruise(o), self.answer(o, first))

    def options(self, o, cars):
        slow = self.flow(o, cars, self.lane) < self.SHARE * o.speed_limit - 2
        if slow:
            return [k for k in (self.lane - 1,) if k >= 0 and self.flow(o, cars, k) > self.flow(o, cars, self.lane) + 2]
        if self.lane < self.home and self.flow(o, cars, self.lane + 1) > self.SHARE * o.speed_limit - 1:
            return [self.lane + 1]
        return []

    def clear(self, o, cars, k):
        v = o.ego.speed
        if self.bad("way-back-unchecked") and k == self.home:
            return True
        for c in cars:
            if self.inside(c, k):
                d = v - c.v if c.dx > 0 else c.v + 1 - v
                if c.gap < (8 + 1.4 * v if c.dx > 0 else 14 + 1.3 * c.v) + 4 * max(d, 0):
                    return False
        return True


class Grid(Planner):
    """Mark cells of the road as taken, and count the free ones."""

    CELL = 4

    def row(self, y):
        return int(y / WIDE) if self.bad("lane-truncated") else round(y / WIDE)

    def marks(self, o, cars):
        """Return the vehicle that takes each (lane, cell)."""
        taken, size = {}, self.CELL
        if self.bad("one-per-lane"):
            cars = {self.row(c.y): c for c in cars}.values()
        for c in cars:
            rows = {self.row(y) for y in (c.y, c.y + 1.2 * c.w, c.y + self.may(c))}
            for k in range(math.floor((c.dx - 5) / size), math.floor((c.dx + 5) / size) + 1):
                for row in rows:
                    taken[row, k] = c
        return taken

    def along(self, o, cars):
        e, a = o.ego, self.cruise(o)
        taken = self.marks(o, cars)
        for row in {self.row(e.y), self.lane}:
            for k in range(36):
                c = taken.get((row, k))
                if c is not None and c.dx > 0:
                    a = min(a, self.behind(e.speed, k * self.CELL, c))
                    break
        return a

    def behind(self, v, room, c):
        """Drive at a speed from which it could stop behind the other."""
        f, b, tau = max(c.v + 0.4 * min(c.a, 0.0), 0.0), 5.0, 1.5
        safe = math.sqrt((b * tau) ** 2 + 2 * b * max(room - 2.0, 0.0) + f * f) - b * tau
        return (safe - v) / 0.8

    def clear(self, o, cars, k):
        v = o.ego.speed
        fast = max([c.v for c in cars if c.dx < 0] + [v])
        rear = 14 + 1.3 * fast + 4 * max(fast + 1 - v, 0)
        slow = min([c.v for c in cars if c.dx > 0] + [v])
        front = 10 + 1.5 * v + 3 * (v - slow)
        cells = int(rear) // self.CELL
        if self.bad("cells-divided-twice"):
            cells = cells // self.CELL
        taken = self.marks(o, cars)
        return not any((k, j) in taken for j in range(-cells, int(front) // self.CELL + 1))


class Votes(Planner):
    """Let several behaviours request accelerations, and take the lowest."""

    RAMP = 12.0  # speed on an exit [m/s]

    def keep(self, o, cars):
        return self.cruise(o)

    def follow(self, o, cars):
        v, a = o.ego.speed, 2.0
        for c in self.ahead(o, cars):
            s = 3.5 + max(0.0, 1.7 * v + v * (v - c.v) / (2 * math.sqrt(1.5 * 3.0)))
            a = min(a, 1.5 * (1 - (s / max(self.space(c), 0.5)) ** 2))
        return max(a, -4.0)

    def space(self, c):
        return c.gap + 5.0 if self.bad("gap-of-centres") else c.gap

    def emergency(self, o, cars):
        v, a = o.ego.speed, 2.0
        for c in self.ahead(o, cars):
            f, gap = max(c.v, 0.0), max(self.space(c) - 2.0, 0.3)
            n = (v - f) ** 2 / (2 * gap) if v > f else 0.0
            if c.a < -1 or (gap < 0.8 * v and v > f - 2):
                n = max(n, v * v / (2 * max(gap + f * f / 14 - 0.4 * v, 0.5)))
            if n > 2:
                a = min(a, -1.3 * n)
        return a

    def limit(self, o, cars):
        if self.bad("ramp-limit") and o.ego.lane == o.lanes - 1 and o.ego.speed > self.RAMP:
            return -6.5
        return 2.0

    def along(self, o, cars):
        asked = [f(o, cars) for f in (self.keep, self.follow, self.emergency, self.limit)]
        a = clip(min(asked), -8.0, 2.0)
        if self.bad("comfort-last"):
            before = getattr(self, "sent", 0.0)
            self.sent = a = clip(a, before - 0.2, before + 0.2)
        return a

    def options(self, o, cars):
        k = super().options(o, cars)
        return k or ([self.lane + 1] if self.lane + 1 < o.lanes and o.time > self.rest + 5 else [])

    def clear(self, o, cars, k):
        v = o.ego.speed
        if self.bad("other-side-checked"):
            k = 2 * (self.lane if self.old is None else self.old) - k
        for c in cars:
            if not self.inside(c, k):
                continue
            front = c.v > v if self.bad("front-by-speed") else c.dx > 0
            soon = c.gap + (c.v - v if front else v - c.v - 1) * 4.0
            if c.gap < 5 or soon < (10 + 1.3 * v if front else 14 + 1.2 * max(c.v, v)):
                return False
        return True


POLICIES: dict[str, tuple[type, tuple[str, ...]]] = {
    "LeaderGains": (Barrier, ("leader-acceleration-sign",)),
    "NearestFirst": (Barrier, ("nearest-before-filter",)),
    "RelativeTwice": (Lattice, ("relative-twice",)),
    "PenaltySaturates": (Lattice, ("penalty-saturates",)),
    "WayBack": (Machine, ("way-back-unchecked",)),
    "StatesDwell": (Machine, ("states-dwell",)),
    "LaneTruncated": (Grid, ("lane-truncated",)),
    "DividedTwice": (Grid, ("cells-divided-twice",)),
    "ComfortLast": (Votes, ("comfort-last",)),
    "RampLimit": (Votes, ("ramp-limit",)),
    "TwoBehindLeader": (Votes, ("comfort-last", "gap-of-centres")),
    "TwoIntoLane": (Votes, ("other-side-checked", "front-by-speed")),
    "TwoStandAndBack": (Machine, ("stand-sign", "way-back-unchecked")),
    "TwoRooms": (Barrier, ("braking-in-feet", "closing-sign-behind")),
    "ThreeStates": (Machine, ("states-dwell", "leaders-of-old-lane", "set-speed-lost")),
    "ThreePredicted": (Lattice, ("relative-twice", "penalty-saturates", "range-too-short")),
    "ThreeCells": (Grid, ("cells-divided-twice", "one-per-lane", "set-speed-lost")),
    "ThreeVotes": (Votes, ("ramp-limit", "front-by-speed", "gap-of-centres")),
}


def make(name, repaired=()):
    kind, defects = POLICIES[name]
    return partial(kind, frozenset(defects) - frozenset(repaired))
