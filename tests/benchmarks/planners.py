"""A planner that follows, overtakes and returns to the right.

Units are metres, seconds and radians throughout.
"""

from __future__ import annotations

import math


def clip(x, lo, hi):
    return lo if x < lo else hi if x > hi else x


class Seen:
    """A planner's data about another vehicle: `v` along the road, `w` sideways, `a` its acceleration."""

    __slots__ = ("a", "length", "reach", "turned", "v", "w", "width", "x", "y")

    def __init__(self, o, a):
        self.x, self.y = o.x, o.y
        self.v, self.w = o.speed * math.cos(o.heading), o.speed * math.sin(o.heading)
        self.a, self.length, self.width, self.turned = a, o.length, o.width, o.heading
        self.reach = (o.length * abs(math.sin(o.heading)) + o.width * abs(math.cos(o.heading))) / 2


class Preview:
    """Steer at a point ahead on the goal line."""

    def __init__(self, seconds=2.6):
        self.seconds = seconds

    def steer(self, o, goal):
        e = o.ego
        v = max(e.speed, 4.0)
        h = clip((goal - e.y) / (self.seconds * v), -1.4 / v, 1.4 / v)
        return clip(2.0 * (clip(h, -0.25, 0.25) - e.heading) * 5 / v, -0.2, 0.2)


class GippsBased:
    HEADWAY = 1.7
    SHARE = 0.93  # of the speed limit
    GAIN, LOSS = 2.0, 9.0  # speed that a change must promise; time between two changes [s]

    def __init__(self):
        self.lat, self.lane, self.old, self.changed, self.rest = Preview(), None, None, -3.0, 0.0
        self.tracks, self.t, self.low = {}, None, 99.0

    # perception
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

    # along
    def law(self, e, g, d, v):
        b, tau = 4.0, self.HEADWAY
        safe = -b * tau / 2 + math.sqrt(
            (b * tau / 2) ** 2 + max(v, 0) ** 2 + 2 * b * max(g - 3 - 0.5 * tau * e.speed, 0)
        )
        return (safe - e.speed) / 0.8

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
        a = clip(self.law(e, g, e.speed - s.v, s.v), -4.0, 3.0)
        if n > 1.5:
            a = min(a, -1.2 * n)
        return a

    def cruise(self, o):
        return clip(0.6 * (self.SHARE * o.speed_limit - o.ego.speed), -1.5, 1.8)

    def along(self, o, seen):
        return min([self.cruise(o)] + [self.follow(o, s) for s in seen if self.in_path(o, s)])

    # across
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
        return min(
            [self.SHARE * o.speed_limit]
            + [s.v for s in seen if 0 < s.x - o.ego.x < 90 and abs(s.y - k * o.lane_width) < 2.2]
        )

    def wants(self, o, seen):
        """Return the lanes that it would prefer, best first."""
        own = self.pace(o, self.lane, seen)
        c = [k for k in (self.lane + 1, self.lane - 1) if 0 <= k < o.lanes and self.pace(o, k, seen) > own + self.GAIN]
        if (
            not c
            and o.time - self.changed > self.LOSS
            and self.lane + 1 < o.lanes
            and self.pace(o, self.lane + 1, seen) >= own
        ):
            c = [self.lane + 1]
        return c

    def choose(self, o, seen):
        e = o.ego
        if self.old is not None:
            if abs(e.y - self.lane * o.lane_width) < 0.4:
                self.old, self.changed = None, o.time
            elif abs(e.y - self.old * o.lane_width) < 0.9 and not self.free(o, self.lane, seen):
                self.lane, self.old, self.rest = self.old, None, o.time + 2.0
            return
        if o.time < self.rest or o.time - self.changed < 4 or e.speed < 11 or abs(e.y - self.lane * o.lane_width) > 0.4:
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
        return float(a), float(self.lat.steer(o, self.lane * o.lane_width))
