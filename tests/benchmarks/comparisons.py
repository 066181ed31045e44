"""Is a search with a reference red for changes that make a policy less safe, and only for these?

    python -m tests.benchmarks.comparisons [--runs 400] [--seed 21] [NAME ...]

Thirty changes each of four small planners that are meant to keep it as safe as before, and thirty that take something
from it: a side of its view, its range, its reaction, its brakes. Not each of the latter makes the planner collide more
often: the counts of random scenarios say so. Prints for each change how many findings there are without the comparison
and with it, the random scenarios that both policies drove and those in which only the new one or only the old one
failed, and the time without it and with it.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Mapping
from typing import Any

import pytest_pafot as pafot


def holds(run: pafot.Run) -> None:
    assert not run.collision


def keeping_its_lane(seen: Any) -> float:
    ego = seen.ego
    return -0.02 * (ego.y - seen.lane_centres[ego.lane]) - 0.2 * ego.heading


class Brake:
    """Cruises, and brakes hard when a vehicle in its path is nearer than its stopping distance."""

    cruise, gain, gap, side, decel, still = 25.0, 0.5, 1.0, 2.6, 8.0, 3.0

    def others(self, seen):
        return seen.others

    def path(self, e, o):
        return o.x > e.x and abs(o.y - e.y) < self.side

    def need(self, e, o):
        return self.still + self.gap * e.speed + max(0, e.speed**2 - o.speed**2) / 12

    def __call__(self, seen):
        e = seen.ego
        near = any(self.path(e, o) and o.x - e.x - o.length < self.need(e, o) for o in self.others(seen))
        wanted = self.gain * (self.cruise - e.speed)
        return min(wanted, -self.decel) if near else wanted, keeping_its_lane(seen)


class Idm:
    """The intelligent driver model behind whoever is in its lane or drifts into it."""

    v0, headway, s0, amax, comfort, cut = 24.0, 1.4, 3.0, 1.5, 3.0, 1.9

    def inside(self, e, o):
        drifted = o.y + 0.8 * o.speed * math.sin(o.heading)
        return min(abs(o.y - e.y), abs(drifted - e.y)) < self.cut

    def leaders(self, e, seen):
        return [o for o in seen.others if o.x > e.x and self.inside(e, o)]

    def speed_of(self, o):
        return o.speed

    def __call__(self, seen):
        e, free = seen.ego, 1 - (seen.ego.speed / self.v0) ** 4
        wanted = self.amax * free
        for o in self.leaders(e, seen):
            closing = e.speed * (e.speed - self.speed_of(o)) / (2 * math.sqrt(self.amax * self.comfort))
            gap = self.s0 + max(0.0, e.speed * self.headway + closing)
            wanted = min(wanted, self.amax * (free - (gap / max(o.x - e.x - o.length, 0.1)) ** 2))
        return max(wanted, -8.0), keeping_its_lane(seen)


class Changer:
    """Follows by a headway, and changes to a free lane beside it when it is blocked."""

    cruise, headway, ahead, behind, decel = 24.0, 1.6, 25.0, 20.0, 7.0
    target = None

    def free(self, seen, lane):
        e, is_lane = seen.ego, 0 <= lane < len(seen.lane_centres)
        behind = [self.behind + 2.0 * max(0.0, o.speed - e.speed) for o in seen.others]
        near = zip(seen.others, behind, strict=True)
        return is_lane and not any(o.lane == lane and -back < o.x - e.x < self.ahead for o, back in near)

    def crash(self, e, o):
        closing = max(0.0, e.speed - o.speed)
        return 2 + closing**2 / (2 * self.decel) + 0.4 * closing

    def __call__(self, seen):
        e = seen.ego
        self.target = e.lane if self.target is None else self.target
        mine = [o for o in seen.others if o.lane in (e.lane, self.target) or abs(o.y - e.y) < 2.3]
        gaps = [(o.x - e.x - o.length, o) for o in mine if o.x > e.x]
        wanted, want = min(0.6 * (self.cruise - e.speed), 2.0), 4 + self.headway * e.speed
        for gap, o in gaps:
            if gap < want:
                wanted = min(wanted, 0.4 * (gap - want) / max(self.headway, 0.5) + 1.2 * (o.speed - e.speed))
            wanted = -self.decel if gap < self.crash(e, o) else wanted
        if self.target == e.lane and any(gap < 35 and o.speed < e.speed + 0.5 for gap, o in gaps):
            self.target = next((lane for lane in (e.lane - 1, e.lane + 1) if self.free(seen, lane)), self.target)
        aside = 0.012 * (seen.lane_centres[self.target] - e.y) - 0.25 * e.heading
        return max(wanted, -self.decel), max(-0.08, min(0.08, aside))


class Wary:
    """Brakes by the time to contact, also for those in the next lane that drift towards it."""

    cruise, least, ttc, soft, hard, reach = 23.0, 5.0, 2.5, 2.5, 8.0, 1.0

    def others(self, seen):
        return seen.others

    def near(self, e, o):
        aside = o.y - e.y
        toward = -math.copysign(1.0, aside) * o.speed * math.sin(o.heading)
        return abs(aside) < 2.2 or (abs(aside) < 4.5 and toward > 0.3)

    def closing(self, e, o):
        return e.speed - o.speed

    def __call__(self, seen):
        e = seen.ego
        wanted = max(min(0.5 * (self.cruise - e.speed), 2.0), -2.0)
        for o in (each for each in self.others(seen) if each.x > e.x and self.near(e, each)):
            gap, closing = o.x - e.x - o.length, self.closing(e, o)
            wanted = min(wanted, -self.soft) if gap < self.least + self.reach * e.speed else wanted
            is_close = gap < self.least or (closing > 0 and gap / closing < self.ttc)
            wanted = -self.hard if is_close else wanted
        return wanted, keeping_its_lane(seen)


def changed(base: type, **given: Any) -> type:
    return type(f"Changed{base.__name__}", (base,), given)


def seeing(base: type, sees: Callable[[Any, Any], bool]) -> type:
    return changed(base, others=lambda self, seen: [o for o in seen.others if sees(seen.ego, o)])


def late(base: type, decisions: int) -> type:
    class Late(base):  # type: ignore[misc]
        def __init__(self):
            self.made = []

        def __call__(self, seen):
            self.made.append(super().__call__(seen))
            return self.made[max(0, len(self.made) - 1 - decisions)]

    return Late


def leading(inside: Callable[[Any, Any], bool]) -> type:
    return changed(
        Idm, leaders=lambda self, e, seen: [o for o in seen.others if o.x > e.x and inside(e, o) and self.inside(e, o)]
    )


class Frozen(Idm):
    """Decides every two seconds."""

    number, made = -1, (0.0, 0.0)

    def __call__(self, seen):
        self.number += 1
        self.made = super().__call__(seen) if self.number % 10 == 0 else self.made
        return self.made


class Blocked(Changer):
    """Looks at the lane on the other side before it changes."""

    def free(self, seen, lane):
        other = 2 * seen.ego.lane - lane
        is_there = 0 <= other < len(seen.lane_centres)
        return 0 <= lane < len(seen.lane_centres) and (not is_there or super().free(seen, other))


class Blind(Changer):
    """Looks at nobody while it changes lanes."""

    def __call__(self, seen):
        wanted, steering = super().__call__(seen)
        return wanted if self.target == seen.ego.lane else min(0.6 * (self.cruise - seen.ego.speed), 2.0), steering


def values(base: type, **given: tuple[float, ...]) -> dict[str, tuple[type, type]]:
    """Return changes of one number of a planner, by name."""
    each = [(name, value) for name, several in given.items() for value in several]
    return {f"{base.__name__} {name} {value:g}": (changed(base, **{name: value}), base) for name, value in each}


HARMLESS: Mapping[str, tuple[type, type]] = {
    **values(Brake, gap=(0.95, 0.98, 1.02, 1.05, 1.3), cruise=(24.0,), gain=(0.65,), still=(3.5,)),
    **values(Idm, headway=(1.47, 1.82), v0=(23.0,), amax=(1.3,), s0=(3.5,)),
    **values(Changer, headway=(1.52, 1.92), cruise=(25.0,), ahead=(28.0,), behind=(22.0,)),
    **values(Wary, ttc=(2.375, 2.625, 3.0), cruise=(22.0, 24.0), soft=(2.8,), reach=(1.1,), least=(5.5,), hard=(8.5,)),
    "Brake from the last": (changed(Brake, others=lambda self, seen: seen.others[::-1]), Brake),
    "Idm by distance": (
        changed(Idm, leaders=lambda self, e, seen: sorted(Idm.leaders(self, e, seen), key=lambda o: o.x)),
        Idm,
    ),
    "Wary from the last": (changed(Wary, others=lambda self, seen: seen.others[::-1]), Wary),
}
HARMFUL: Mapping[str, tuple[type, type]] = {
    **values(Brake, gap=(0.2,)),
    **values(Idm, headway=(0.4,)),
    **values(Changer, ahead=(3.0,), decel=(3.0,)),
    **values(Wary, ttc=(0.8,), hard=(3.0,)),
    "Brake blind right": (seeing(Brake, lambda e, o: o.y <= e.y + 1), Brake),
    "Brake sees 20 m": (seeing(Brake, lambda e, o: o.x < e.x + 20), Brake),
    "Brake sees nobody slow": (seeing(Brake, lambda e, o: o.speed > 8), Brake),
    "Brake sees nobody at speed": (seeing(Brake, lambda e, o: e.speed < 24), Brake),
    "Brake own lane only": (seeing(Brake, lambda e, o: o.lane == e.lane), Brake),
    "Brake first only": (changed(Brake, others=lambda self, seen: seen.others[:1]), Brake),
    "Brake sign": (
        changed(Brake, need=lambda self, e, o: 3 + e.speed + max(0, o.speed**2 - e.speed**2) / 12),
        Brake,
    ),
    "Brake late 1 s": (late(Brake, 5), Brake),
    "Idm takes others for faster": (changed(Idm, speed_of=lambda self, o: o.speed + 6), Idm),
    "Idm blind left": (leading(lambda e, o: o.y >= e.y - 1), Idm),
    "Idm half a lane": (changed(Idm, inside=lambda self, e, o: -1.9 < o.y - e.y < 0.5), Idm),
    "Idm late 0.8 s": (late(Idm, 4), Idm),
    "Idm frozen 2 s": (Frozen, Idm),
    "Changer other lane": (Blocked, Changer),
    "Changer no emergency": (changed(Changer, crash=lambda self, e, o: 0.0), Changer),
    "Changer blind in changes": (Blind, Changer),
    "Wary no drift": (changed(Wary, near=lambda self, e, o: abs(o.y - e.y) < 2.2), Wary),
    "Wary thin": (changed(Wary, near=lambda self, e, o: abs(o.y - e.y) < 0.8), Wary),
    "Wary blind left": (seeing(Wary, lambda e, o: o.y >= e.y - 1), Wary),
    "Wary blind right": (seeing(Wary, lambda e, o: o.y <= e.y + 1), Wary),
    "Wary sees 15 m": (seeing(Wary, lambda e, o: o.x < e.x + 15), Wary),
    "Wary sees nobody slow": (seeing(Wary, lambda e, o: o.speed > 10), Wary),
    "Wary sign": (changed(Wary, closing=lambda self, e, o: o.speed - e.speed), Wary),
    "Wary late 1 s": (late(Wary, 5), Wary),
}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--runs", type=int, default=400)
    parser.add_argument("--seed", type=int, default=21)
    given = parser.parse_args()
    for kind, changes in (("harmless", HARMLESS), ("harmful", HARMFUL)):
        red, reds, count = 0, 0, 0
        for name, (new, old) in changes.items():
            if given.names and name not in given.names:
                continue
            told, seconds = [], []
            for pairs in (0, 700):
                began = time.process_time()
                arguments = {"blame": "ego", "runs": given.runs, "seed": given.seed, "pairs": pairs}
                told.append(pafot.explore(new, against=old, holds=holds, **arguments).summary)
                seconds.append(f"{time.process_time() - began:.1f} s")
            before, now = (len(each.finds) for each in told)
            print(f"{name}: {before} findings, {now} count; {told[1].paired}; {seconds[0]}, {seconds[1]}", flush=True)
            red, reds, count = red + bool(now), reds + bool(before), count + 1
        print(f"{kind}: {red} of {count} red, {reds} without the comparison")


if __name__ == "__main__":
    main()
