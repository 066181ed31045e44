"""Every number that the reason of a verdict says, computed once more from the trace.

A reason is a list of clauses. Each has a pattern with the numbers to be looked at, and a function that computes them in
their order; what no pattern knows is an error.
"""

from __future__ import annotations

import re

from tests.helpers.pencil_and_paper import Crash, gap, giving_way, is_behind, safe_along

NUMBER = r"(-?\d+\.\d)"


class Reading:
    """A collision as its reason is read: what its numbers are at the tick that the verdict names."""

    def __init__(self, trace, tick):
        self.crash = Crash(trace)
        self.crash.verdict()
        self.ego, self.npc, self.tick = self.crash.ego, self.crash.npc, tick
        self.mover, self.other = self.ego, self.npc

    def time(self, tick):
        return tick / self.crash.hz

    def apart(self):
        """Told as 0 of two that are side by side."""
        return max(0.0, gap(self.ego, self.npc, self.tick))

    def behind_and_ahead(self):
        pair = self.ego, self.npc
        return pair if is_behind(*pair, self.tick) else pair[::-1]

    def too_close(self):
        return [self.time(self.tick), self.apart(), safe_along(*self.behind_and_ahead(), self.tick)]

    def crossed(self, whose):
        """When and how fast sideways; what is told of the mover next is compared with the other."""
        self.mover, self.other = (self.ego, self.npc) if whose == "ego's moment" else (self.npc, self.ego)
        return [self.time(self.tick), self.towards(whose)]

    def towards(self, whose):
        """Sideways, to the other."""
        mover = self.ego if whose == "ego's moment" else self.npc
        return self.crash.sides[whose] * mover.sideways(self.crash.ticks[whose])

    def place(self, words):
        """How far ahead or behind, and how much faster or slower, as the words say."""
        faster = self.mover.speed[self.tick] - self.other.speed[self.tick]
        ahead = self.mover.along[self.tick] > self.other.along[self.tick]
        assert ("ahead" in words) == ahead
        if words.endswith("as fast"):
            assert f"{abs(faster):.1f}" == "0.0"
            return [self.apart()]
        return [self.apart(), faster if "faster" in words else -faster]

    def came_in(self):
        return [max(0.0, gap(self.ego, self.npc, self.crash.joined)), self.time(self.crash.joined)]

    def both_crossed(self):
        both = "ego's moment", "npc's moment"
        return [self.time(self.crash.ticks[whose]) for whose in both] + [self.towards(whose) for whose in both]

    def slowest(self):
        """Of the ego, in its lane change."""
        return self.crash.slowest_in_change(self.tick)

    def room(self):
        return giving_way(self.npc.speed[self.tick], self.slowest())

    def due(self, delay):
        return self.time(self.crash.ticks["answer"] + round(delay * self.crash.hz))

    def braking(self):
        """Of the ego, since its answer counts: from when on and with how much at most."""
        ticks = range(self.crash.ticks["answer"] + 1, self.crash.impact + 1)
        first = next(tick for tick in ticks if self.ego.deceleration(tick) >= 0.5)
        return [self.time(first - 1), max(self.ego.deceleration(tick) for tick in ticks)]

    def npcs_peak(self):
        return max(self.npc.deceleration_along(tick) for tick in range(self.tick + 1, self.crash.impact + 1))

    def speed_reached(self):
        return max(self.ego.speed[self.crash.ticks["answer"] : self.crash.impact + 1])

    def hard_braking(self, braker):
        first, last = self.crash.hard_braking(braker)
        return [self.time(first - 1), max(braker.deceleration(tick) for tick in range(first, last + 1))]

    def no_faster(self):
        """Until when, and from when on the one behind would brake."""
        return [self.time(self.crash.ticks["no faster"]), self.due(1.4)]

    def sped_up_towards(self, whose):
        """Since when, and to which speed."""
        first, mover = self.crash.sped_up, self.ego if whose == "the ego" else self.npc
        return [self.time(first), max(mover.speed[first : self.crash.impact + 1])]

    def stood(self):
        return [self.time(self.tick), self.time(self.crash.impact - self.crash.ticks["stood"])]


CLAUSES = {
    f"from {NUMBER} s on (?:NPC # was {NUMBER} m behind the ego|the ego was {NUMBER} m behind NPC #), closer than the "
    f"{NUMBER} m that RSS demands": lambda reading, said: reading.too_close(),
    f"at {NUMBER} s NPC # crossed the lane line towards the ego \\({NUMBER} m/s sideways\\)": (
        lambda reading, said: reading.crossed("npc's moment")
    ),
    f"at {NUMBER} s the ego crossed the lane line towards NPC # \\({NUMBER} m/s sideways\\)": (
        lambda reading, said: reading.crossed("ego's moment")
    ),
    f", {NUMBER} m (?:ahead|behind), (?:{NUMBER} m/s (?:faster|slower)|as fast)": lambda reading, said: reading.place(
        said
    ),
    f", and came into its track only {NUMBER} m ahead at {NUMBER} s": lambda reading, said: reading.came_in(),
    f", (?:where giving way takes {NUMBER} m|more than the {NUMBER} m that giving way takes)": (
        lambda reading, said: [reading.room()]
    ),
    f"at {NUMBER} s the ego and at {NUMBER} s NPC # crossed a lane line towards each other "
    f"\\({NUMBER} and {NUMBER} m/s sideways\\)": lambda reading, said: reading.both_crossed(),
    f"the ego had kept its lane from {NUMBER} s on|from {NUMBER} s on (?:NPC #|the ego) kept the lane ahead": (
        lambda reading, said: [reading.time(reading.tick)]
    ),
    f"from {NUMBER} s the ego braked with up to {NUMBER} m/s\\^2 with nothing in its way": (
        lambda reading, said: reading.hard_braking(reading.ego)
    ),
    f"; from {NUMBER} s NPC # braked with up to {NUMBER} m/s\\^2 with nothing in its way": (
        lambda reading, said: reading.hard_braking(reading.npc)
    ),
    f"; but until {NUMBER} s (?:the ego|NPC #) was no faster, and braking with 3 to 6 m/s\\^2 from {NUMBER} s on "
    "would have avoided it": lambda reading, said: reading.no_faster(),
    f"; but (?:the ego|NPC #) let the brakes go at {NUMBER} s, where braking on with 6 m/s\\^2 would have avoided it": (
        lambda reading, said: [reading.time(reading.crash.ticks["brakes let go"])]
    ),
    f"from {NUMBER} s the ego braked to a standstill with nothing in its way and stood for {NUMBER} s": (
        lambda reading, said: reading.stood()
    ),
    f"; from {NUMBER} s on NPC # sped up to {NUMBER} m/s towards the ego": (
        lambda reading, said: reading.sped_up_towards("NPC")
    ),
    f"; from {NUMBER} s on the ego sped up to {NUMBER} m/s towards NPC #": (
        lambda reading, said: reading.sped_up_towards("the ego")
    ),
    f", as it slowed down to {NUMBER} m/s": lambda reading, said: [reading.slowest()],
    f"the ego was standing \\({NUMBER} m/s\\) at the impact": (
        lambda reading, said: [abs(reading.ego.speed[reading.crash.impact])]
    ),
    f"at {NUMBER} s (?:NPC # came sideways into the ego|the ego came sideways into NPC #)(?:'s way)?": (
        lambda reading, said: [reading.time(reading.crash.joined)]
    ),
    f"(?:; |; NPC #'s |, and NPC #'s )braking with 6 m/s\\^2 from {NUMBER} s on would have avoided it": (
        lambda reading, said: [reading.due(1.0)]
    ),
    f"; braking with 3 to 6 m/s\\^2 from {NUMBER} s on would have avoided it": lambda reading, said: [reading.due(1.4)],
    f"; the ego braked from {NUMBER} s on with up to {NUMBER} m/s\\^2": lambda reading, said: reading.braking(),
    f", and braked with up to {NUMBER} m/s\\^2": lambda reading, said: [reading.npcs_peak()],
    f"; the ego sped up to {NUMBER} m/s": lambda reading, said: [reading.speed_reached()],
    ", side by side|, and NPC # moved in behind it|, too late to avoid it"
    "|, and no response could avoid it|, and NPC # behind could not avoid it"
    "|, and NPC # could not avoid it any more when the ego kept the lane|; the ego did not brake": (
        lambda reading, said: []
    ),
}
"""Of these a reason is made; ``#`` is the NPC that was touched."""


def numbers(trace, attribution):
    """The numbers of a reason as it says them, and as they are.

    Raises:
        ValueError: for words that are in none of the clauses.
    """
    reading, rest = Reading(trace, attribution.tick), attribution.reason
    said, true = [], []
    while rest:
        found, compute = clause(rest, trace.collision.npc)
        said += [number for number in found.groups() if number is not None]
        true += [f"{number:.1f}".replace("-0.0", "0.0") for number in compute(reading, found[0])]
        rest = rest[found.end() :]
    return said, true


def clause(rest, npc):
    """The one that begins a text."""
    for pattern, compute in CLAUSES.items():
        found = re.match(pattern.replace("#", str(npc)), rest)
        if found:
            return found, compute
    raise ValueError(f"no clause of a reason that is known begins: {rest!r}")
