"""A second computation, from the trace, of every number in the sentences of a verdict.

Each sentence has a pattern with the numbers to check, and a function that computes them in the same order. A sentence
that matches no pattern is an error.
"""

from __future__ import annotations

import re

from tests.helpers.pencil_and_paper import (
    Crash,
    Crossing,
    gap,
    giving_way,
    is_behind,
    part_of,
    safe_along,
)
from tests.helpers.stories import entry_of, stories_of

NUMBER = r"(-?\d+\.\d\d?)"
WHO = r"(?:the ego|The ego|NPC #)"
PACE = (
    rf"(?:{WHO} drove {NUMBER} m/s (?:faster|slower)|Both drove equally fast"
    rf"|NPC # braked at up to {NUMBER} m/s\^2)"
)
PLACE = rf"(?:next to {WHO}|{NUMBER} m (?:ahead of|behind) {WHO}\. {PACE})"


class Reading:
    """A collision as its sentences describe it: the values of their numbers at the tick that the verdict names."""

    def __init__(self, trace, tick):
        crossing = Crossing(trace) if trace.zones and trace.zones[trace.collision.npc] else None
        if crossing is not None:
            crossing.verdict()
        self.crossing, self.since = crossing, 0
        if crossing is not None and crossing.decides == "lane":
            self.since, trace = crossing.since, part_of(trace, crossing.since, crossing.until)
        self.crash = Crash(trace)
        self.crash.verdict()
        self.ego, self.npc, self.tick = self.crash.ego, self.crash.npc, tick - self.since

    def time(self, tick):
        return (tick + self.since) / self.crash.hz

    def who(self, said):
        """Return the vehicle that a sentence names first, and the other."""
        pair = self.ego, self.npc
        return pair if re.search("ego|NPC", said, re.IGNORECASE)[0] == "ego" else pair[::-1]

    def apart(self, tick):
        """Return the distance between the vehicles, 0 if they are side by side [m]."""
        return max(0.0, gap(self.ego, self.npc, tick))

    def too_close(self, said):
        behind, ahead = self.who(said)
        assert is_behind(self.ego, self.npc, self.tick) == (behind is self.ego)
        time, apart, *pace = self.placed(said, self.tick)
        safe = safe_along(behind, ahead, self.tick)
        assert ("safe" in said) == (safe > 0)
        return [apart, time, *([safe] if safe > 0 else []), *pace]

    def crossed(self, said):
        """Return the numbers of a crossing of the line: when, into which lane, and where."""
        mover, _ = self.who(said)
        side = self.crash.sides["ego's moment" if mover is self.ego else "npc's moment"]
        lane = re.search(r"into lane (\d)", said)
        before = range(max(self.tick - round(0.5 * self.crash.hz), 0), self.tick)
        in_lane = [tick for tick in before if mover.lane[tick] == mover.lane[self.tick]]
        assert ("moved on" in said) == any(mover.is_over_its_line(tick, side) for tick in in_lane)
        assert lane is None or int(lane[1]) == mover.lane[self.tick] + side
        return self.placed(said, self.tick)

    def came_in(self, said):
        return self.placed(said, max(self.crash.joined, self.tick))

    def placed(self, said, tick):
        """Return how far ahead or behind the other was, and its speed difference, as the words describe them."""
        mover, other = self.who(said)
        faster, apart = other.speed[tick] - mover.speed[tick], self.apart(tick)
        if "next to" in said:
            assert apart == 0.0
            return [self.time(tick)]
        assert ("ahead" in said) == (mover.along[tick] > other.along[tick])
        ticks = range(max(tick - self.crash.hz, 0) + 1, self.crash.impact + 1)
        braked = max(map(self.npc.deceleration, ticks), default=0.0)
        is_told = self.npc.along[tick] > self.ego.along[tick] and apart > 0 and braked >= 3.0
        assert ("braked" in said) == is_told
        if is_told:
            return [self.time(tick), apart, braked]
        if "equally fast" in said:
            assert f"{abs(faster):.1f}" == "0.0"
            return [self.time(tick), apart]
        return [self.time(tick), apart, faster if "faster" in said else -faster]

    def both_crossed(self, said):
        return [self.time(self.crash.ticks[whose]) for whose in ("ego's moment", "npc's moment")]

    def room(self, said):
        """Return the gap that the ego owed when it crossed the line, or when it came in if the first was enough."""
        at, then = self.tick, max(self.crash.joined, self.tick)
        room = giving_way(self.npc.speed[at], self.crash.slowest_in_change(self.crash.ego, at))
        if "more than" in said or gap(self.ego, self.npc, at) < room:
            return [room]
        return [giving_way(self.npc.speed[then], self.ego.speed[then])]

    def entered(self, said):
        """Return the times at which the two entered the zone, and check the sentence's other words."""
        crossing, first = self.crossing, self.who(said)[0]
        one = crossing.ego if first is self.ego else crossing.npc
        other, zone = crossing.other(one), crossing.trace.zones[crossing.trace.collision.npc]
        assert one.enters == self.tick
        assert ("merge" in said) == (zone.kind == "merging")
        assert f"from {'the ' if zone.origin in ('left', 'right') else ''}{zone.origin}" in said
        assert ("Neither had priority" in said) == (zone.priority == "none")
        if zone.priority != "none":
            assert said.endswith("The ego had priority.") == (zone.priority == "ego")
        apart = (other.enters - one.enters) / self.crash.hz
        assert ("before" in said, "after" in said) == (apart > 0, apart < 0)
        return [self.time(one.enters), *([abs(apart)] if apart else [])]

    def since_when(self, vehicle):
        """Return the tick from which a vehicle owed the answer that the sentence describes."""
        crossing = self.crossing
        if crossing is None or crossing.decides != "priority":
            return self.crash.ticks.get("answer", self.tick)
        one = crossing.ego if vehicle is self.ego else crossing.npc
        if one in crossing.blind:
            return crossing.last_to_slow_down(one) if crossing.is_merge else crossing.last_to_stop_short(one)
        assert one in crossing.rude
        assert one is crossing.ego or not crossing.blind
        return crossing.chance_not_taken(one)

    def is_due(self, story):
        """Return whether braking was due after the danger had begun, and where ways meet before the vehicle entered."""
        vehicle = self.npc if story.vehicle else self.ego
        since, told = self.since_when(vehicle) + self.since, story.ticks(story.due[story.due.re.groups - 1])
        if self.crossing is None or self.crossing.decides != "priority" or story.vehicle:
            return since <= told[-1]
        return since <= told[-1] and told[0] < self.crossing.ego.enters

    def hard_braking(self, said):
        braker, _ = self.who(said)
        first, last = self.crash.hard_braking(braker)
        return [max(braker.deceleration(tick) for tick in range(first, last + 1)), self.time(first - 1)]

    def sped_up(self, said):
        """Return the speed that it sped up to, and since when."""
        return [self.crash.sped_up_to, self.time(self.crash.sped_up)]

    def braked_on(self, said):
        """Return how hard the ego braked at most when the reason was gone, and since when."""
        ticks = range(self.tick, self.crash.rests[self.tick] + 1)
        return [max(map(self.ego.deceleration, ticks)), self.time(self.tick)]

    def ignored(self, said):
        """Return the ego's mean braking from 1.2 s after the moment, if it braked, and when 6 m/s^2 is due."""
        crash, hz = self.crash, self.crash.hz
        first = self.tick + round(1.2 * hz)
        has_braked = any(self.ego.deceleration(tick) >= 0.5 for tick in range(first + 1, crash.impact + 1))
        assert has_braked == ("did not" not in said)
        lost = self.ego.speed[first] - self.ego.speed[crash.impact]
        mean = [max(lost * hz / (crash.impact - first), 0.0)] if has_braked else []
        return [*mean, self.time(self.tick + round(1.0 * hz))]

    def stood(self, said):
        return [self.time(self.tick), (self.crash.impact - self.crash.ticks["stood"]) / self.crash.hz]

    def ended(self, said):
        assert abs(self.ego.speed[self.crash.impact]) <= 0.1
        return [self.time(self.crash.impact)]


SENTENCES = {
    rf"{WHO} was only {NUMBER} m behind {WHO} at {NUMBER} s(?: \(safe: {NUMBER} m\))?\. {PACE}\.": Reading.too_close,
    rf"{WHO} (?:crossed (?:into lane \d|a lane line)|moved on (?:into lane \d|over a lane line)) "
    rf"at {NUMBER} s, {PLACE}\.": Reading.crossed,
    rf"The ego moved in at {NUMBER} s, {PLACE}\.": Reading.came_in,
    rf"The ego \(at {NUMBER} s\) and NPC # \(at {NUMBER} s\) moved towards each other and crossed their lane lines\.": (
        Reading.both_crossed
    ),
    rf"{WHO} kept its lane from {NUMBER} s on, {PLACE}\.": lambda reading, said: reading.placed(said, reading.tick),
    rf"{WHO} moved sideways at {NUMBER} s into {WHO}, which was next to it\.": lambda reading, said: [
        reading.time(reading.crash.joined)
    ],
    rf"The ego was standing when NPC # touched it at {NUMBER} s\.": Reading.ended,
    rf"The ego (?:did not brake|braked with a mean of {NUMBER} m/s\^2)\. "
    rf"By the rules, 6 m/s\^2 from {NUMBER} s on avoids it\.": Reading.ignored,
    rf"{WHO} braked at up to {NUMBER} m/s\^2 from {NUMBER} s on, with nothing in its way\.": Reading.hard_braking,
    rf"The ego kept braking at up to {NUMBER} m/s\^2 from {NUMBER} s on, with nothing in its way any more\.": (
        Reading.braked_on
    ),
    rf"The ego already braked and should have kept braking, but braked less from {NUMBER} s on\.": (
        lambda reading, said: [reading.time(reading.crash.ticks["brakes less"])]
    ),
    rf"The ego began to stop at {NUMBER} s with nothing in its way\. It stood for {NUMBER} s before the impact\.": (
        Reading.stood
    ),
    rf"{WHO} entered the (?:crossing|merge)(?: from [a-z ]+)? at {NUMBER} s, "
    rf"(?:{NUMBER} s (?:before|after)|together with) {WHO}(?: from [a-z ]+)?\. (?:{WHO}|Neither) had priority\.": (
        Reading.entered
    ),
    r"Neither could have foreseen the other in time, by the rules\.": lambda reading, said: [],
    rf"The ego touched NPC # at {NUMBER} s, outside the zone where their ways meet\.": lambda reading, said: [
        reading.time(reading.crash.impact)
    ],
    rf"The ego should have left NPC # a gap of {NUMBER} m\.": Reading.room,
    rf"The ego gave way: it left NPC # more than the required {NUMBER} m\.": Reading.room,
    rf"NPC # moved in behind the ego at {NUMBER} s\.": lambda reading, said: [
        reading.time(reading.crash.ticks["npc's moment"])
    ],
    rf"{WHO} had too little time to respond, by the rules\.": lambda reading, said: [],
    rf"{WHO} sped up to {NUMBER} m/s after {NUMBER} s\.": Reading.sped_up,
    rf"{WHO} should have kept braking but released the brakes at {NUMBER} s\.": lambda reading, said: [
        reading.time(reading.crash.ticks["brakes let go"])
    ],
}
"""The patterns and their functions; ``#`` is the NPC that was touched."""


def numbers(trace, attribution):
    """Return the numbers of the sentences as they are printed, and their true values and the claims that are wrong.

    Raises:
        ValueError: No pattern matches a sentence.
    """
    reading = Reading(trace, attribution.tick)
    said, true = [], []
    stories = stories_of(trace, attribution.sentences)
    for story in stories:
        true += story.wrong(entry_of(trace, attribution.sentences, story.vehicle))
        true += ["due by the rules"] if story.duty == "braked" and not reading.is_due(story) else []
    for sentence in attribution.sentences[: 1 if stories else None]:
        found, compute = known(sentence, trace.collision.npc)
        printed = [number for number in found.groups() if number is not None]
        values = compute(reading, sentence)
        assert len(printed) == len(values), sentence
        said += printed
        true += [as_printed(*pair) for pair in zip(values, printed, strict=True)]
    return said, true


def as_printed(value, printed):
    """Return a value with as many decimals as a printed number."""
    decimals = len(printed.partition(".")[2])
    return re.sub(r"^-(0\.0+)$", r"\1", f"{value:.{decimals}f}")


def known(sentence, npc):
    """Return the match and the function of the pattern that fits a sentence."""
    for pattern, compute in SENTENCES.items():
        found = re.fullmatch(pattern.replace("#", str(npc)), sentence)
        if found:
            return found, compute
    raise ValueError(f"no sentence that is known: {sentence!r}")
