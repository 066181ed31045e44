"""An oracle for the sentences on what a vehicle should have done and did: each claim against the trace alone.

It reads the printed text, not the facts behind it, and knows nothing of the rules. A time that is printed with one
decimal may mean any tick that rounds to it.
"""

from __future__ import annotations

import math
import re
from itertools import pairwise

import numpy as np

from pytest_pafot.model.trace import HEADING, LANE, SPEED, X, Y
from tests.helpers.polygons import corners, polygons_meet

WHO = r"(?P<who>[Tt]he ego|NPC \d+)"
TIME, FIGURE = r"(\d+\.\d) s", r"(\d+\.\d) m/s"
DUTIES = {
    "braked": rf"{WHO} should have braked (?P<how>hard|harder) by {TIME}(?P<never> but did not)?\.",
    "waited": rf"{WHO} should have waited but set off at {TIME}\.",
}
BEGAN = rf"(?:It|{WHO}) (?:drove {FIGURE} at|kept {FIGURE} from|stood at) {TIME}"
DEEDS = {
    "braked": rf"braked at up to {FIGURE}\^2, to {FIGURE}",
    "slowed": rf"slowed to {FIGURE}",
    "kept": rf"kept {FIGURE}",
    "sped up": rf"sped up to {FIGURE}",
    "stood": "stood",
}
NEAR, MOST, KEPT = 0.3, 7, 0.55
"""The largest error of the speed that is told [m/s], the largest number of phases, with which it may be larger, and the
largest change of a speed that was kept [m/s]."""


class Story:
    """The claims of the sentences about one vehicle, and the vehicle's motion."""

    def __init__(self, trace, told):
        self.trace, self.hz = trace, trace.physics_hz
        self.moves = re.findall(rf"Its centre came into lane (\d+) at {TIME}\.", told)
        self.text = re.sub(r" Its centre came into lane .*", "", told)
        who = re.match(WHO, told)["who"]
        self.vehicle = 0 if who.lower() == "the ego" else int(who[4:]) + 1
        self.other = 0 if self.vehicle else trace.collision.npc + 1
        self.speed, self.end = trace.states[:, self.vehicle, SPEED], trace.ticks
        self.slowed = -np.diff(self.speed) * self.hz
        self.duty, self.due = None, None
        for name, pattern in DUTIES.items():
            found = re.match(pattern, told)
            if found:
                self.duty, self.due = name, found
        self.phases = self.read()

    def read(self):
        """Return the phases as name, time of the beginning, speed then and at the end, and hardest braking.

        Raises:
            ValueError: A part of the text is neither a duty nor a phase.
        """
        text = self.text[self.due.end() :] if self.due else self.text
        began = re.match(rf"\s*{BEGAN}", text)
        if not text:
            return []  # it kept its speed
        if began is None:
            raise ValueError(f"no beginning: {text!r}")
        *_, drove, kept, time = began.groups()
        speed = float(drove or kept or 0.0)
        first, *others = re.split(r"[;.]? from (?=\d+\.\d s it)", text[began.end() :].replace(" From", " from"))
        if not first.startswith(" and "):
            first = "stood" if "stood" in began[0] else f"kept {speed:.1f} m/s"
        first = first.removeprefix(" and ")
        found = []
        for part in [f"{time} s it {first}", *others]:
            time, deed = re.fullmatch(rf"{TIME} it (.*?)\.?", part).groups()
            name, match = next(
                (name, re.fullmatch(each, deed)) for name, each in DEEDS.items() if re.fullmatch(each, deed)
            )
            after = 0.0 if name == "stood" else float(match[match.re.groups])
            found.append((name, time, speed, after, float(match[1]) if name == "braked" else None))
            speed = after
        return found

    def ticks(self, printed):
        """Return the ticks that a printed time may mean."""
        near = round(float(printed) * self.hz)
        return [
            at for at in range(max(near - 2, 0), self.end + 1) if f"{at / self.hz:.1f}" == printed and at < near + 3
        ]

    def wrong(self, entry=None):
        """Return the claims that the trace contradicts, by name; ``entry`` is the tick of the deed at a zone."""
        return sorted({name for name, holds in self.claims(entry) if not holds})

    def claims(self, entry):
        begins = [self.ticks(time) for _, time, *_ in self.phases]
        yield "order", all(before[0] <= after[-1] for before, after in pairwise(begins))
        deed = self.end if entry is None else entry
        if self.duty == "braked":
            due = self.ticks(self.due[self.due.re.groups - 1])
            # an NPC may have to stop short of an ego in the zone that it has entered as well
            yield "due before the deed", due[0] < deed or self.vehicle > 0
            if entry is None:
                yield "due in time", any(self.is_free(at) for at in range(max(due[0] - 2, 0), due[-1] + 1))
                later = [self.is_free(at) for at in range(due[-1] + 1, due[-1] + round(0.6 * self.hz) + 1) if at < deed]
                yield "due as late as it helps", not later or not all(later)
            elif self.trace.zones[self.trace.collision.npc].kind == "crossing":
                yield "due in time", any(self.stops_short(at, self.end) for at in due) or self.is_free(due[0])
            is_braking = {bool(self.slowed[at] >= 0.5) for at in due if at < self.end}
            yield "braking when it was due", (self.due["how"] == "harder") in is_braking
            if self.due["never"]:
                yield "did not brake", self.lost(begins[0][-1] if begins else due[0]) < 0.25
        elif self.duty == "waited":
            yield "set off", any(self.speed[at] <= 0.3 for at in self.ticks(self.due[2]))
        for lane, time in self.moves:
            lanes = self.trace.states[:, self.vehicle, LANE]
            yield "lane", any(lanes[at] == int(lane) != lanes[at - 1] for at in self.ticks(time))
        if not self.phases:
            return
        yield from self.of_phases([each[len(each) // 2] for each in begins])

    def of_phases(self, begins):
        """Check that the speeds and times that are told, joined by straight lines, are the speed of the vehicle."""
        at, speeds = [*begins, self.end], [self.phases[0][2], *(after for *_, after, _ in self.phases)]
        if len(self.phases) < MOST:
            ticks = np.arange(at[0], self.end + 1)
            # a time that is rounded moves a line sideways by at most a tick
            slopes = [abs(b - a) / max(j - i, 1) for (a, b), (i, j) in zip(pairwise(speeds), pairwise(at), strict=True)]
            steepest = max([0.0, *slopes])
            far = np.abs(np.interp(ticks, at, speeds) - self.speed[ticks]).max()
            is_constant = "kept" in [name for name, *_ in self.phases]
            yield "speed", far <= NEAR + 0.06 + min(steepest, 1.0) + KEPT * is_constant
        for (name, _, before, after, braking), begin, over in zip(self.phases, at[:-1], at[1:], strict=True):
            near = range(max(begin - 1, 0), begin + 2), range(over - 3, min(over + 4, self.end + 1))
            told = [abs(float(self.speed[tick]) - after) for tick in near[1]]
            yield "speed at the end", min(told) <= (KEPT if name in ("kept", "stood") else 0.05)
            if name == "braked":
                edge = math.ceil(0.15 * self.hz) + 1
                widest = self.slowed[near[0][0] : near[1][-1]].max(initial=0.0)
                inner = self.slowed[begin + edge : over - edge].max(initial=0.0)
                yield "braked up to", inner - 0.06 <= braking <= widest + 0.06
            yield (
                name,
                {
                    "braked": after < before + 0.05,
                    "slowed": after < before + 0.05,
                    "kept": abs(after - before) <= KEPT,
                    "sped up": after > before - 0.05,
                    "stood": min(self.speed[begin : over + 1], default=0.0) <= 0.31,
                }[name],
            )

    def lost(self, tick):
        """Return the largest loss of speed by braking without a pause after a tick [m/s]."""
        braking = np.where(self.slowed[tick:] >= 0.5, self.slowed[tick:] / self.hz, np.nan)
        parts = np.split(braking, np.flatnonzero(np.isnan(braking)))
        return max((float(np.nansum(part)) for part in parts), default=0.0)

    def stops_short(self, tick, entry):
        """Return whether braking at 6 m/s^2 from a tick on ends before the place at which it entered the zone."""
        driven = np.hypot(*np.diff(self.trace.states[tick : entry + 1, self.vehicle][:, [X, Y]], axis=0).T).sum()
        return self.speed[tick] ** 2 / 12.0 + self.speed[tick] / (2 * self.hz) < driven

    def is_free(self, tick, rate=6.0):
        """Return whether it touches the other nowhere if it brakes at a rate [m/s^2] on its path from a tick on.

        Until the impact the other moves as recorded, then straight on with its last braking.
        """
        own, other = self.trace.states[:, self.vehicle], self.trace.states[:, self.other]
        driven = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(own[:, [X, Y]], axis=0).T))))
        turned = np.unwrap(own[:, HEADING])
        place, speed, at = float(driven[tick]), float(own[tick, SPEED]), tick
        slowing = max(float(other[-2, SPEED] - other[-1, SPEED]) * self.hz, 0.0)
        while speed > 0.0 or at < self.end:
            at += 1
            place, speed = place + speed / self.hz, max(speed - rate / self.hz, 0.0)
            mine = [float(np.interp(place, driven, own[:, column])) for column in (X, Y)]
            heading = float(np.interp(place, driven, turned))
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
            if polygons_meet(*rows):
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
    return [Story(trace, each) for each in told if is_story(each)]


def is_story(told):
    return any(re.match(each, told) for each in DUTIES.values()) or bool(re.match(BEGAN, told))


def entry_of(trace, sentences, vehicle):
    """Return the tick at which a vehicle entered the zone, if the first sentence says so; else None."""
    entered = re.match(rf"{WHO} entered the .*? at {TIME}, (?:(\d+\.\d) s (before|after)|together)", sentences[0])
    if entered is None:
        return None
    first = 0 if entered["who"].lower() == "the ego" else int(entered["who"][4:]) + 1
    time = float(entered[2])
    if first != vehicle and entered[3]:
        time += float(entered[3]) * (1 if entered[4] == "before" else -1)
    return round(time * trace.physics_hz)
