"""An oracle for the sentences on what a vehicle should have done and did: each claim against the trace alone.

It reads the printed text, not the facts behind it, and knows nothing of the rules. A time that is printed with one
decimal may mean any tick that rounds to it.
"""

from __future__ import annotations

import itertools
import math
import re

import numpy as np

from pytest_pafot.model.trace import HEADING, SPEED, X, Y
from tests.helpers.polygons import corners, polygon_distance

WHO = r"(?P<who>[Tt]he ego|NPC \d+)"
TIME, FIGURE = r"(?P<time>\d+\.\d) s", r"(?P<figure>\d+\.\d) m/s"
HOW = (
    rf"(?:with up to {FIGURE}\^2,? )?(?P<only>only )?from {TIME} on"
    r"(?:, with up to (?P<top>\d+\.\d) m/s\^2 at (?P<peak>\d+\.\d) s)?"
)
SHOULD = r"(?:[Tt]he ego|NPC \d+|It) should"
DUTIES = {
    "braked": rf"{SHOULD} have braked (?P<again>again )?from {TIME}",
    "braked harder": rf"{SHOULD} have braked harder from {TIME}",
    "kept braking": rf"{SHOULD} have kept braking (?:hard|with {FIGURE}\^2) from {TIME} on",
    "kept its braking": rf"{SHOULD} have kept braking but .*?{TIME}",
    "waited": rf"{SHOULD} have waited but set off at {TIME}",
    "not sped up": rf"{SHOULD} not have sped up from {TIME} on, to {FIGURE}",
    "not sped up further": rf"{SHOULD} not have sped up further after {TIME}, to {FIGURE}",
}
DEEDS = {
    "braked": rf"braked (?P<again>again )?{HOW}",
    "increasingly": rf"braked more and more,? {HOW}",
    "repeatedly": rf"braked again and again,? {HOW}",
    "harder": rf"braked harder,? {HOW}",
    "eased": rf"eased off from {TIME} on, to {FIGURE}\^2",
    "released": rf"released the brakes at {TIME}",
    "stood": rf"stood from {TIME} on",
    "sped up": rf"(?<!not have )sped up from {TIME} on, to {FIGURE}",
    "rose repeatedly": rf"sped up again and again from {TIME} on, to {FIGURE}",
    "set off": rf"set off at {TIME} and sped up to {FIGURE}",
    "nothing": rf"did not brake from {TIME} on",
}
BRAKED = ("braked", "increasingly", "repeatedly", "harder", "eased")
ROSE = ("sped up", "rose repeatedly", "set off")
EASED = ("eased", "released", "stood", *ROSE)
PAUSE, SMALL, CLEAR = 0.4, 0.31, 1.0
"""The pause between two brakings [s], and the changes of speed that need not be told and that must be told [m/s]."""
COASTED = 1.0
"""The time without braking from which on the end of a braking must be told [s]."""


class Story:
    """The claims of the sentences about one vehicle, and the vehicle's motion."""

    def __init__(self, trace, told, first=""):
        self.trace, self.text, self.hz = trace, told, trace.physics_hz
        who = re.match(WHO, told)["who"]
        self.vehicle = 0 if who.lower() == "the ego" else int(who[4:]) + 1
        self.other = 0 if self.vehicle else trace.collision.npc + 1
        self.speed, self.end = trace.states[:, self.vehicle, SPEED], trace.ticks
        self.slowed = -np.diff(self.speed) * self.hz
        self.duty, self.due = None, None
        for name, pattern in DUTIES.items():
            found = re.search(pattern, told)
            if found:
                self.duty, self.due = name, found
        self.danger = None
        if re.search(r"(?:crossed|moved|kept its lane|was only) .*?\d+\.\d s", first):
            self.danger = round(float(re.search(TIME, first)["time"]) * self.hz)
        found = [(each.start(), name, each) for name, pattern in DEEDS.items() for each in re.finditer(pattern, told)]
        self.deeds = [(name, each) for _, name, each in sorted(found, key=lambda each: each[0])]
        self.later = sum(each.start() < self.due.start() for _, each in self.deeds) if self.due else 0

    def ticks(self, printed):
        """Return the ticks that a printed time may mean."""
        near = round(float(printed) * self.hz)
        return [
            at for at in range(max(near - 2, 0), self.end + 1) if f"{at / self.hz:.1f}" == printed and at < near + 3
        ]

    def begins(self, index):
        """Return the ticks at which a deed may begin."""
        return self.ticks(self.deeds[index][1]["time"])

    def parts(self, index):
        """Return the pairs of ticks between which a deed may have been."""
        after = self.begins(index + 1) if index + 1 < len(self.deeds) else [self.end]
        return itertools.product(self.begins(index), after)

    def brakings(self, first, last):
        """Return the brakings between two ticks as first tick, last tick and loss of speed."""
        found = []
        for at in range(max(first, 0), last):
            if self.slowed[at] >= 0.5:
                if found and at - found[-1][1] < PAUSE * self.hz and self.speed[at] < self.speed[found[-1][1]] + CLEAR:
                    found[-1][1] = at + 1
                else:
                    found.append([at, at + 1])
        return [(a, b, float(self.speed[a] - self.speed[b])) for a, b in found]

    def wrong(self, entry=None):
        """Return the claims that the trace contradicts, by name; ``entry`` is the tick of the deed at a zone."""
        wrong = {name for name, holds in self.claims(entry) if not holds}
        return sorted(wrong)

    def claims(self, entry):
        if "but did not" in self.text and self.duty == "braked":
            due = self.ticks(self.due["time"])[-1]
            yield "did not", all(lost < CLEAR for *_, lost in self.brakings(due, self.end))
        names = [name for name, _ in self.deeds]
        yield (
            "harder than before",
            not any(
                name in ("harder", "eased") and (not at or names[at - 1] not in (*BRAKED, "rose repeatedly"))
                for at, name in enumerate(names)
            ),
        )
        times = [float(found["time"]) for _, found in self.deeds]
        yield "order", times == sorted(times)
        if self.duty in ("braked", "braked harder", "kept braking"):
            due = self.ticks(self.due["time"])
            yield "due before the deed", entry is None or due[0] <= entry
            yield "due in time", any(self.is_free(at) for at in range(max(due[0] - 2, 0), due[-1] + 1))
            if self.duty == "braked harder":
                yield "could brake harder", any(self.slowed[at] < 6.0 for at in due)
                yield "harder is needed", not all(self.suffices(at, entry) for at in due)
            is_braking = any(self.slowed[at] >= 0.5 for at in due if at < self.end)
            yield "braking when it was due", is_braking == (self.duty != "braked") or len(self.deeds) > 1
            if self.duty == "kept braking":
                kept = range(max(due[0] - round(PAUSE * self.hz), 0), due[-1] + 1)
                rate = self.due["figure"]
                kept = [at for at in kept if (f"{self.slowed[at]:.1f}" == rate if rate else self.slowed[at] >= 5.94)]
                yield "braking so hard when due", bool(kept)
                yield "it was enough", any(self.may_suffice(at, entry) for at in kept)
        elif self.duty == "kept its braking":
            ended = self.ticks(self.due["time"])
            kept = range(max(ended[0] - 2 * self.hz, 0), ended[-1] + 1)
            yield "it was enough", any(self.may_suffice(at, entry) for at in kept if self.slowed[at] >= 0.5)
        elif self.duty:
            ticks = self.ticks(self.due["time"])
            yield "set off", self.duty != "waited" or any(self.speed[at] <= 0.3 for at in ticks)
            yield "rises", any(self.speed[at:].max() > self.speed[at] + 0.2 for at in ticks)
            if "figure" in self.due.groupdict():
                after = self.begins(self.later) if self.deeds[self.later :] else [self.end]
                tops = {f"{self.speed[a : b + 1].max():.1f}" for a in ticks for b in after if a <= b}
                yield "to", self.due["figure"] in tops
        for index, (name, found) in enumerate(self.deeds):
            yield from self.of_deed(index, name, found)
        if self.duty is None or self.due.groupdict().get("time"):
            yield from self.unsaid()
            yield from self.eased()
            yield from self.instead()
            yield from self.released()

    def of_deed(self, index, name, found):
        parts = [(a, b) for a, b in self.parts(index) if a <= b]
        yield "order", bool(parts)
        before = round(PAUSE * self.hz)
        if name in BRAKED:
            yield from self.of_braking(name, found, parts)
        if name == "braked":
            half = float(found["figure"] or 0.0) / 2
            starts = {a for a, _ in parts}
            quiet = [a for a in starts if all(lost < SMALL for *_, lost in self.brakings(a - before + 1, a))]
            yield "braked from", any((self.slowed[a : a + 2] >= 0.5).any() for a in quiet)
            yield (
                "hard from",
                half < 1.5 or any((self.slowed[a : a + self.hz // 2 + 1] >= half - 0.1).any() for a in starts),
            )
            if found["only"] and self.duty == "braked":
                due = self.ticks(self.due["time"])[-1]
                yield "only from", all(lost < SMALL for *_, lost in self.brakings(due, max(min(starts) - before, due)))
        if name == "nothing":
            yield "did not brake", all(lost < SMALL for *_, lost in self.brakings(parts[0][0], self.end))
        if name == "released":
            yield "released", all(lost < SMALL for *_, lost in self.brakings(parts[-1][0] + 1, parts[0][1] - before))
        if name == "stood":
            yield "stood", any((self.speed[a:] <= 0.2).all() for a, _ in parts)
        if name in ROSE:
            yield "to", found["figure"] in {f"{self.speed[a : b + 1].max():.1f}" for a, b in parts}
        if name in ("sped up", "set off"):
            yield (
                "sped up from",
                any(
                    self.speed[a] - self.speed[max(a - before, 0) : a + 1].min() <= 0.21
                    and self.speed[a : b + 1].max() > self.speed[a] + 0.15
                    and self.speed[a : a + self.hz + 1].max() > self.speed[a] + 0.05
                    for a, b in parts
                ),
            )
            yield "beginning of the rise", any(self.is_beginning(a) for a, _ in parts)
        if name == "set off":
            yield "set off", any(self.speed[a] <= 0.3 for a, _ in parts)

    def of_braking(self, name, found, parts):
        before = round(PAUSE * self.hz)
        figures = set()
        for a, b in parts:
            part = self.slowed[min(a, self.end - 1) : b if name != "eased" or b > a + before else a + before]
            kept = part[part >= 0.5]
            if name == "eased":
                figures |= {f"{max(each.min(initial=99.0), 0.0):.1f}" for each in (part, kept)}
            else:
                figures.add(f"{part.max(initial=0.0):.1f}")
        yield "braked up to", (found["figure"] or found["top"]) in figures
        if name != "eased":
            yield "place of the peak", any(self.has_peak(found, a, b) for a, b in parts if a < min(b, self.end))

    def has_peak(self, found, begin, over):
        """Return whether a phase is hardest near the printed tick, or if none is printed, early or nearly so."""
        hardest = self.slowed[begin:over].max()
        if found["peak"]:
            near = {tick for at in self.ticks(found["peak"]) for tick in (at - 1, at, at + 1) if 0 <= tick < self.end}
            return any(self.slowed[tick] >= hardest - 0.11 for tick in near)
        early = self.slowed[begin : begin + self.hz // 2 + 2]
        return early.max() >= hardest - 0.1 or early[: self.hz // 2 + 1].mean() >= 0.65 * hardest

    def is_beginning(self, tick):
        """Return whether a rise that is told from a tick on neither began earlier nor ended before the danger."""
        braked = np.flatnonzero(self.slowed[:tick] >= 0.5)
        first = max(tick - self.hz, 0, *(braked[-1:] + 1))
        gained = self.speed[tick] - self.speed[first : tick + 1].min()
        brakes = np.flatnonzero(self.slowed[tick + 1 :] >= 0.5)
        rising = self.speed[tick : min([max(self.since(), tick), *(tick + 1 + brakes[:1])]) + 1]
        return gained <= 0.6 and (np.maximum.accumulate(rising) - rising).max() <= 0.5

    def eased(self):
        """Check that the last lull of a clear braking before the impact is told, and the braking that followed it."""
        for begin, over, lost in self.brakings(0, self.end)[-1:]:
            part = self.slowed[begin:over]
            weak = part < 0.45 * np.maximum.accumulate(part)
            edges = np.flatnonzero(np.diff([0, *weak, 0]))
            lulls = [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a > 0.6 * self.hz]
            if lost < CLEAR or not lulls or begin + lulls[-1][1] <= self.since():
                continue
            low, high = lulls[-1]
            peak = int(part[:low].argmax())
            near = set(range(begin + peak, begin + high + round(PAUSE * self.hz) + 1))
            is_told = any(near & {*self.begins(at)} for at, (name, _) in enumerate(self.deeds) if name in EASED)
            is_told |= any("repeatedly" in name for name, _ in self.deeds)
            kept = [at for at in self.ticks(self.due["time"]) if at in near] if self.duty == "kept its braking" else []
            yield "easing is told", is_told or bool(kept)
            rest = part[low:]
            trough = int(rest.argmin())
            strong = rest[trough:] >= max(2.5 * rest[trough], rest[trough] + 0.6)
            if strong.sum() > 0.4 * self.hz:
                later = [name for at, (name, _) in enumerate(self.deeds) if max(self.begins(at)) > begin + low]
                later += [name for name, _ in self.deeds if name == "repeatedly"]
                yield "braking after the lull is told", bool({*later} & {*BRAKED[:-1]})

    def instead(self):
        """Check that what it did instead of braking went on when braking was due."""
        if "Instead it sped" in self.text or "Instead it set" in self.text:
            due = self.ticks(self.due["time"])
            later = [each for index in range(len(self.deeds)) for each in self.begins(index) if each > due[-1]]
            over = max(min([self.end, *later]), due[-1] + 1)
            yield "instead", any(self.speed[at : over + 1].max() > self.speed[max(at - 1, 0)] for at in due)

    def unsaid(self):
        """Check that each clear braking or gain in speed from the time on that is due is in a phase that is told."""
        first = self.since()
        told = {"braked": [], "rose": []}
        if self.duty in ("waited", "not sped up", "not sped up further"):
            told["rose"].append((first, self.begins(self.later)[-1] if self.deeds[self.later :] else self.end))
        for index, (name, _) in enumerate(self.deeds):
            for kind, names in (("braked", (*BRAKED, "rose repeatedly")), ("rose", (*ROSE, "repeatedly"))):
                told[kind] += list(self.parts(index)) if name in names else []
        for a, b, lost in self.brakings(first, self.end):
            if lost >= CLEAR:
                yield "braking is told", any(a < d + 1 and c - 1 < b for c, d in told["braked"])
        speed = self.speed[first:]
        gain = speed - np.minimum.accumulate(speed)
        top = int(gain.argmax())
        if gain[top] >= CLEAR:
            yield "speeding up is told", any(first + top >= c for c, _ in told["rose"])

    def since(self):
        """Return the tick of the danger in the first sentence, or of the first duty or deed if that is earlier."""
        first = self.ticks(self.due["time"])[0] if self.duty else self.begins(0)[0]
        return first if self.danger is None else min(first, self.danger)

    def released(self):
        """Check that the end of each clear braking is told if the vehicle then did not brake for a second."""
        brakings = [each for each in self.brakings(0, self.end) if each[2] >= SMALL]
        for (_, over, lost), (later, *_) in itertools.pairwise([*brakings, (self.end, self.end, 0.0)]):
            if over <= self.since() or lost < CLEAR or later - over < COASTED * self.hz:
                continue
            if (self.slowed[over : over + round(PAUSE * self.hz)] > 0.15).all() and "eased" in dict(self.deeds):
                continue  # it let go little by little
            near = {*range(over - 3, over + round(COASTED * self.hz) + 3)}
            ends = {name for index, (name, _) in enumerate(self.deeds) if near & {*self.begins(index)}}
            if self.duty in ("waited", "not sped up") and near & {*self.ticks(self.due["time"])}:
                ends.add("sped up")
            for index, (name, _) in enumerate(self.deeds):
                if "repeatedly" in name and any(a < later and over < b for a, b in self.parts(index)):
                    ends.add("released")
            left = [at for index, (name, _) in enumerate(self.deeds) if name == "set off" for at in self.begins(index)]
            stands = bool((self.speed[over : min([later, *(at for at in left if at > over)])] <= 0.2).all())
            yield "release is told", stands or bool(ends & {"released", "stood", *ROSE})

    def suffices(self, tick, entry, share=0.9):
        """Return whether a share of the braking at a tick, kept up to a standstill, avoids the collision.

        At a zone, it does if it ends before the place at which the vehicle was when it entered the zone.
        """
        rate = share * self.slowed[tick]
        if rate < 0.5:
            return False
        if entry is None:
            return self.is_free(tick, rate, brakes_on=True)
        driven = np.hypot(*np.diff(self.trace.states[tick : entry + 1, self.vehicle][:, [X, Y]], axis=0).T).sum()
        return self.speed[tick] ** 2 / (2 * rate) + self.speed[tick] / (2 * self.hz) < driven

    def may_suffice(self, tick, entry):
        """Return whether a little more than the braking at a tick, kept up, avoids the collision in some way."""
        return self.suffices(tick, entry, 1.1) or self.is_free(tick, 1.1 * self.slowed[tick])

    def is_free(self, tick, rate=6.0, *, brakes_on=False):
        """Return whether it touches the other nowhere if it brakes at a rate [m/s^2] on its path from a tick on.

        Until the impact the other moves as recorded, then straight on with its last speed, or its last braking.
        """
        own, other = self.trace.states[:, self.vehicle], self.trace.states[:, self.other]
        driven = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(own[:, [X, Y]], axis=0).T))))
        place, speed, at = float(driven[tick]), float(own[tick, SPEED]), tick
        slowing = max(float(other[-2, SPEED] - other[-1, SPEED]) * self.hz, 0.0) if brakes_on else 0.0
        while speed > 0.0 or at < self.end:
            at += 1
            place, speed = place + speed / self.hz, max(speed - rate / self.hz, 0.0)
            mine = [float(np.interp(place, driven, own[:, column])) for column in (X, Y)]
            heading = float(np.interp(place, driven, np.unwrap(own[:, HEADING])))
            beyond = max(place - float(driven[-1]), 0.0)
            mine = [mine[0] + beyond * math.cos(heading), mine[1] + beyond * math.sin(heading), heading]
            late = max(at - self.end, 0) / self.hz
            theirs = other[min(at, self.end)]
            late = min(late, theirs[SPEED] / slowing) if slowing > 0.0 else late
            further = late * theirs[SPEED] - slowing * late**2 / 2
            x = theirs[X] + further * math.cos(theirs[HEADING])
            y = theirs[Y] + further * math.sin(theirs[HEADING])
            if math.hypot(x - mine[0], y - mine[1]) > 12.0:
                continue
            boxes = (mine, self.trace.sizes[self.vehicle]), ((x, y, theirs[HEADING]), self.trace.sizes[self.other])
            rows = [corners({X: pose[0], Y: pose[1], HEADING: pose[2]}, *map(float, size)) for pose, size in boxes]
            if polygon_distance(*rows) == 0.0:
                return False
        return True


def stories_of(trace, sentences):
    """Return the stories in the sentences of a verdict, each about one vehicle; none if they tell none."""
    told = []
    for line in sentences[1:]:
        if told and not re.match(WHO, line):
            told[-1] += f" {line}"
        else:
            told.append(line)
    return [Story(trace, each, sentences[0]) for each in told if is_story(each)]


def is_story(told):
    is_one = re.search("should (have braked|have kept braking hard|have waited|not have sped)", told) or any(
        re.match(rf"{WHO} {pattern}", told) for name, pattern in DEEDS.items() if name != "set off"
    )
    return bool(is_one) and "towards" not in told


def entry_of(trace, sentences, vehicle):
    """Return the tick at which a vehicle entered the zone, if the first sentence says so; else None."""
    entered = re.match(rf"{WHO} entered the .*? at {TIME}, (?:(\d+\.\d) s (before|after)|together)", sentences[0])
    if entered is None:
        return None
    first = 0 if entered["who"].lower() == "the ego" else int(entered["who"][4:]) + 1
    time = float(entered["time"])
    if first != vehicle and entered[3]:
        time += float(entered[3]) * (1 if entered[4] == "before" else -1)
    return round(time * trace.physics_hz)
