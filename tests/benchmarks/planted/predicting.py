"""Policies that predict the paths of other vehicles, and brake for those that will be in the ego's lane."""

from __future__ import annotations

import math

from tests.benchmarks.planted.policy import WIDE, Driver, braking_needed, listed


class Predictor(Driver):
    """The sound planner: it stays in its lane and drives at a speed from which it can stop behind each vehicle that is
    in its lane, or will be within the horizon.
    """

    HORIZON, MARGIN = 1.6, 1.2  # of the prediction [s]; beside the ego's lane [m]
    ANSWER = 1.4

    def lanes(self, o, cars):
        """Return no lanes: it stays in its lane."""

    def along(self, o, cars):
        v = o.ego.speed
        leaders = self.leaders(o, cars)
        a = min([self.cruise(o)] + [self.behind(v, c) for c in leaders])
        return min(a, self.emergency(v, leaders))

    def leaders(self, o, cars):
        return [c for c in cars if c.dx > 0 and self.arrival(o, c) < self.HORIZON]

    def arrival(self, o, c):
        """Return the time until the other is in the ego's lane, by its sideways speed [s]; inf if it never will be."""
        lane = self.lane * WIDE
        off = abs(c.y - lane) - c.reach - self.MARGIN
        if off < 0 or abs(c.y + self.may(c) - lane) < c.reach + self.MARGIN:
            return 0.0
        towards = -c.w if c.y > lane else c.w
        return off / towards if towards > 0.1 else math.inf

    def emergency(self, v, leaders):
        needed = max([self.needed(v, c) for c in leaders], default=0.0)
        return -1.3 * needed if needed > 1.8 else 2.0

    def needed(self, v, c):
        return braking_needed(v, c)


class LowerRoot(Predictor):
    """The time to a collision is the lower root of a quadratic equation, and a negative time counts as no collision. So
    while the vehicle ahead brakes, which makes the lower root negative, the ego only brakes gently.
    """

    # time to a collision that matters [s]; braking for what does not collide [m/s^2]
    ENDS, GENTLE = 7.0, 3.0

    def behind(self, v, c):
        return max(super().behind(v, c), -self.GENTLE)

    def needed(self, v, c):
        needed = super().needed(v, c)
        t = self.collision(v - c.v, -c.a, c.gap)
        return needed if 0 <= t < self.ENDS else 0.0

    def collision(self, closing, gains, gap):
        """Return the time until a gap is closed if the ego does not brake [s]; inf if it will not be."""
        if abs(gains) < 0.5:
            return gap / closing if closing > 0 else math.inf
        square = closing * closing + 2 * gains * gap
        if square < 0:
            return math.inf
        roots = [(-closing + sign * math.sqrt(square)) / gains for sign in (-1, 1)]
        return min([t for t in roots if t >= 0 or not self.repaired], default=math.inf)


class OutlierGate(Predictor):
    """The tracker drops a position as an outlier if it is more than 0.5 m beside the last one. That limit is for ten
    positions a second, and there are five. So a fast lane change is not seen until the track is given up.
    """

    GATE, GIVEN_UP = 0.5, 1.2  # [m], [s]

    def begin(self):
        self.tracks = {}

    def look(self, o):
        cars = super().look(o)
        for c in cars:
            y, since = self.tracks.get(c.i, (c.y, o.time))
            if abs(c.y - y) > self.gate(c) and o.time - since < self.GIVEN_UP:
                c.y, c.w, c.turned = y, 0.0, 0.0
            else:
                self.tracks[c.i] = c.y, o.time
        return cars

    def gate(self, c):
        return math.inf if self.repaired else self.GATE


class FlickerHeld(Predictor):
    """A vehicle whose predicted lane changes, and changes back within 1.5 s, is taken for a flickering detection. For
    three seconds it is kept in its old lane, wherever it drives.
    """

    SHORT, HOLDS = 1.5, 3.0

    def begin(self):
        self.comes, self.held = {}, {}

    def leaders(self, o, cars):
        leaders = super().leaders(o, cars)
        coming = {c.i for c in leaders if abs(c.y - self.lane * WIDE) > WIDE / 2}
        inside = {c.i for c in leaders} - coming
        for c in cars:
            began = self.comes.get(c.i)
            if c.i in coming:
                self.comes.setdefault(c.i, o.time)
            elif began is not None:
                del self.comes[c.i]
                if c.i not in inside and o.time - began < self.SHORT:
                    self.held[c.i] = o.time + self.HOLDS
        return (
            leaders if self.repaired else [c for c in leaders if o.time >= self.held.get(c.i, 0.0)]
        )


PLANTED = listed(
    "predicting",
    {
        "lower-root": (LowerRoot, 1),
        "outlier-gate": (OutlierGate, 1),
        "flicker-held": (FlickerHeld, 2),
    },
)
