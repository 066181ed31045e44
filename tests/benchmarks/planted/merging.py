"""Careful drivers that overtake on the left and go back to the right."""

from __future__ import annotations

from tests.benchmarks.planted.policy import WIDE, Driver, braking_needed, listed


class Overtaker(Driver):
    """The sound driver: it overtakes slow vehicles on the left, and goes back as soon as the lane to the right serves
    as well.
    """

    WORTH = 3.0  # the difference to the wanted speed at which it overtakes [m/s]
    BACK = 4.0  # the time after a lane change until it goes back [s]

    def along(self, o, cars):
        v, leaders = o.ego.speed, self.ahead(o, cars)
        return min(
            [self.cruise(o)] + [min(self.behind(v, c), self.emergency(v, c)) for c in leaders]
        )

    def emergency(self, v, c):
        needed = braking_needed(v, c)
        return -1.3 * needed if needed > 1.8 else 2.0

    def options(self, o, cars):
        wanted, own = self.SHARE * o.speed_limit, self.flow(o, cars, self.lane)
        if (
            own < wanted - self.WORTH
            and self.lane > 0
            and self.flow(o, cars, self.lane - 1) > own + 2.0
        ):
            return [self.lane - 1]
        right = self.lane + 1
        goes_back = right < o.lanes and o.time > self.arrived + self.BACK
        return [right] if goes_back and self.flow(o, cars, right) > min(own, wanted) - 1.0 else []

    def room(self, v, c):
        """Return whether the gap to a vehicle in the other lane is enough."""
        if c.dx > 0:
            return c.gap > 9 + 1.4 * v + 4 * max(v - c.v, 0.0)
        closing = max(c.v + 1 - v, 0.0)
        return c.gap > 15 + 1.3 * max(c.v, v) + 4 * closing + closing * closing / 6


class StillPassed(Overtaker):
    """When an overtaking lane change begins, the vehicle that is overtaken is marked as passed. If the change is given
    up, the mark stays, and the ego does not brake for that vehicle in its own lane.
    """

    def begin(self):
        self.passed = None

    def lanes(self, o, cars):
        lane, old = self.lane, self.old
        super().lanes(o, cars)
        if old is None and self.old is not None:
            ahead = [c for c in cars if c.dx > 0 and abs(c.y - lane * WIDE) < 2.0]
            self.passed = min(ahead, key=lambda c: c.dx).i if ahead and self.lane < lane else None
        elif old is not None and self.old is None and (self.lane == lane or self.repaired):
            self.passed = None

    def ahead(self, o, cars):
        leaders = super().ahead(o, cars)
        if self.old is not None:
            return leaders
        return [c for c in leaders if c.i != self.passed]


class RememberedSpeed(Overtaker):
    """The speed of a vehicle that is overtaken is measured when the lane change begins. The same value is used for the
    way back, even if the vehicle has sped up meanwhile.
    """

    NEAREST, TIME = 8.0, 0.6  # that it keeps to a vehicle behind, [m] and [s]

    def begin(self):
        self.measured = {}

    def lanes(self, o, cars):
        old = self.old
        super().lanes(o, cars)
        if old is None and self.old is not None and self.lane < self.old:
            self.measured = {
                c.i: c.v for c in cars if abs(c.y - self.old * WIDE) < 2.0 and c.dx > 0
            }

    def room(self, v, c):
        if c.dx > 0:
            return super().room(v, c)
        f = c.v if self.repaired else self.measured.get(c.i, c.v)
        closing = max(f + 1 - v, 0.0)
        return c.gap > self.NEAREST + self.TIME * f + 4 * closing + closing * closing / 4


PLANTED = listed(
    "merging", {"still-passed": (StillPassed, 2), "remembered-speed": (RememberedSpeed, 3)}
)
