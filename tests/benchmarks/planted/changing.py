"""Policies that change lanes: they react to slow vehicles ahead, and to the gaps in the next lanes."""

from __future__ import annotations

import math

from tests.benchmarks.planted.policy import Driver, braking_needed, clip, listed


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

    def room(self, v, c):
        """Return whether the gap to a vehicle in the other lane is enough."""
        if c.dx > 0:
            return c.gap > 8 + 1.4 * v + 4 * max(v - c.v, 0.0)
        closing = max(c.v + 1 - v, 0.0)
        return c.gap > 14 + 1.3 * max(c.v, v) + 4 * closing + closing * closing / 6


class Seen:
    """A planner's data about another vehicle: `v` along the road, `w` sideways, `a` its acceleration."""

    __slots__ = ("a", "length", "reach", "turned", "v", "w", "width", "x", "y")

    def __init__(self, o, a):
        self.x, self.y = o.x, o.y
        self.v, self.w = o.speed * math.cos(o.heading), o.speed * math.sin(o.heading)
        self.a, self.length, self.width, self.turned = a, o.length, o.width, o.heading
        self.reach = (o.length * abs(math.sin(o.heading)) + o.width * abs(math.cos(o.heading))) / 2


class GippsBased:
    """A planner that follows, overtakes and returns to the right."""

    HEADWAY = 1.7
    SHARE = 0.93  # of the speed limit
    GAIN, LOSS = 2.0, 9.0  # speed that a change must promise; time between two changes [s]

    def __init__(self):
        self.lane, self.old, self.changed, self.rest = None, None, -3.0, 0.0
        self.tracks, self.t, self.low = {}, None, 99.0

    def perceive(self, o):
        seen, dt = [], o.time - self.t if self.t is not None else 0.0
        for i, other in enumerate(o.others):
            before = self.tracks.get(i)
            a = (other.speed - before) / dt if before is not None and dt > 0 else 0.0
            self.tracks[i] = other.speed
            seen.append(Seen(other, a))
        self.t = o.time
        return seen

    def gap(self, o, s):
        return abs(s.x - o.ego.x) - (s.length + o.ego.length) / 2

    def off(self, o, s):
        """Return how far the other is, or soon will be, from the strip that the ego drives in."""
        a, b = o.ego.y, self.lane * o.lane_width
        lo, hi = min(a, b), max(a, b)
        return min(max(lo - y, y - hi, 0.0) for y in (s.y, s.y + 1.2 * s.w, s.y + self.may(s)))

    def may(self, s):
        """Return the sideways distance that a slow vehicle turned towards a different lane may soon move."""
        return clip(12 * s.turned, -1.5, 1.5) if abs(s.v) < 6 and abs(s.turned) > 0.03 else 0.0

    def in_path(self, o, s):
        return s.x > o.ego.x and self.off(o, s) < s.reach + o.ego.width / 2 + 0.35

    def law(self, e, g, v):
        b, tau = 4.0, self.HEADWAY
        room = 2 * b * max(g - 3 - 0.5 * tau * e.speed, 0)
        return (
            -b * tau / 2 + math.sqrt((b * tau / 2) ** 2 + max(v, 0) ** 2 + room) - e.speed
        ) / 0.8

    def need(self, o, s):
        """Return the deceleration needed now if the other continues as before."""
        e, g = o.ego, max(self.gap(o, s) - 2.0, 0.2)
        d = e.speed - s.v
        need = d * d / (2 * g) if d > 0 else 0.0
        if s.a < -1.0:
            stop = s.v * s.v / (2 * max(-s.a, 3.0))
            need = max(need, e.speed**2 / (2 * max(g + stop - 0.25 * e.speed, 0.5)))
        if g < 0.9 * e.speed:  # too near: be ready for the hardest braking
            hard = e.speed**2 / (2 * max(g + s.v * s.v / 16 - 0.4 * e.speed, 0.5))
            need = max(need, min(hard, 5.0) if d > -2 else 0.0)
        return need

    def follow(self, o, s):
        e, g, n = o.ego, self.gap(o, s), self.need(o, s)
        a = clip(self.law(e, g, s.v), -4.0, 3.0)
        if n > 1.5:
            a = min(a, -1.2 * n)
        return a

    def cruise(self, o):
        return clip(0.6 * (self.SHARE * o.speed_limit - o.ego.speed), -1.5, 1.8)

    def along(self, o, seen):
        return min([self.cruise(o)] + [self.follow(o, s) for s in seen if self.in_path(o, s)])

    def beside(self, o, k, s):
        """Return whether the other is in lane k, or will be."""
        return min(abs(y - k * o.lane_width) for y in (s.y, s.y + 1.5 * s.w)) < 2.9

    def front_ok(self, o, s):
        e, g = o.ego, self.gap(o, s)
        d = max(e.speed - s.v, 0)
        return g > 8 + 1.3 * e.speed + d + d * d / 6

    def rear_ok(self, o, s):
        e, g = o.ego, self.gap(o, s)
        d = max(s.v - min(self.low, e.speed) + 2.0, 0)
        return g > 16 + 1.3 * max(s.v, e.speed) + 2.5 * d + d * d / 5

    def fits(self, o, k, s):
        return self.front_ok(o, s) if s.x > o.ego.x else self.rear_ok(o, s)

    def free(self, o, k, seen):
        self.low = min(o.ego.speed, self.pace(o, k, seen))  # its speed in the new lane, soon
        for s in seen:
            if self.beside(o, k, s):
                if not self.fits(o, k, s):
                    return False
            elif abs(s.y - k * o.lane_width) < 7 and abs(s.y - o.ego.y) > 5 and self.gap(o, s) < 15:
                return False  # it might enter the lane from the other side
        return True

    def pace(self, o, k, seen):
        near = [s.v for s in seen if 0 < s.x - o.ego.x < 90 and abs(s.y - k * o.lane_width) < 2.2]
        return min([self.SHARE * o.speed_limit, *near])

    def wants(self, o, seen):
        """Return the lanes that it would prefer, best first."""
        own = self.pace(o, self.lane, seen)
        c = [
            k
            for k in (self.lane + 1, self.lane - 1)
            if 0 <= k < o.lanes and self.pace(o, k, seen) > own + self.GAIN
        ]
        right = self.lane + 1
        goes_back = not c and o.time - self.changed > self.LOSS and right < o.lanes
        return [right] if goes_back and self.pace(o, right, seen) >= own else c

    def choose(self, o, seen):
        e = o.ego
        if self.old is not None:
            if abs(e.y - self.lane * o.lane_width) < 0.4:
                self.old, self.changed = None, o.time
            elif abs(e.y - self.old * o.lane_width) < 0.9 and not self.free(o, self.lane, seen):
                self.lane, self.old, self.rest = self.old, None, o.time + 2.0
            return
        if (
            o.time < self.rest
            or o.time - self.changed < 4
            or e.speed < 11
            or abs(e.y - self.lane * o.lane_width) > 0.4
        ):
            return
        for k in self.wants(o, seen):
            if self.free(o, k, seen):
                self.old, self.lane = self.lane, k
                return

    def __call__(self, o):
        if self.lane is None:
            self.lane = o.ego.lane
        seen = self.perceive(o)
        self.choose(o, seen)
        a = max(clip(self.along(o, seen), -8.0, 2.5), -4.0 * max(o.ego.speed, 0.0))
        return float(a), float(self.steer(o.ego, self.lane * o.lane_width))

    def steer(self, e, goal):
        """Return the steering towards a point ahead on the goal line."""
        v = max(e.speed, 4.0)
        h = clip((goal - e.y) / (2.6 * v), -1.4 / v, 1.4 / v)
        return clip(2.0 * (clip(h, -0.25, 0.25) - e.heading) * 5 / v, -0.2, 0.2)


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
        far = [
            m
            for k, m in both
            if 0 <= m < o.lanes and self.pace(o, m, seen) >= self.pace(o, k, seen)
        ]
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


PLANTED = listed(
    "changing", {"out-of-queue": (OutOfQueue, 3), "second-lane-unchecked": (SecondLane, 2)}
)
