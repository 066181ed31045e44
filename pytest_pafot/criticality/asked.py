"""Whether a run with manoeuvres came up as it was asked for, measured in its trace.

A trigger by distance does not make a situation alone: an ego that has sped up meets the same gap at another closing
speed. So each step tells what was asked, and what it was when the step began, and when it was done.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pytest_pafot.model.scenario import Manoeuvre, Step
from pytest_pafot.model.trace import ACCELERATION, SPEED, Trace, X, Y

GAP, HEADWAY, SPEED_OFF, EGO_SPEED_OFF = 1.0, 0.1, 1.0, 1.0
"""The tolerances of a gap [m], a headway [s], an NPC's speed and the ego's speed [m/s]."""
SHARE = 0.05
"""The tolerance of gaps and headways beside that, as a share of what is asked."""
LATERAL, LATERAL_SHARE, BRAKING_SHARE = 0.2, 0.1, 0.2
"""The tolerance of the highest lateral speed of a lane change [m/s] and its share, and that of the acceleration."""
LEAST_CHANGE = 3.0
"""The change of speed [m/s] from which the acceleration is judged; a smaller one ends before it builds up."""


@dataclass(frozen=True, slots=True)
class Asked:
    """One thing that a manoeuvre asked for.

    Attributes:
        npc: index of the NPC.
        step: index of the step.
        what: ``gap``, ``headway``, ``speed``, ``ego speed``, ``lateral speed``, ``acceleration``, or ``step`` for a
            step that did not begin or was not done.
        asked: what was asked [m, s, m/s or m/s^2]; NaN for a step.
        was: what it was; NaN for a step.
        tolerance: the largest difference that counts as asked.
        unit: the unit of the numbers.
        words: in words: ``gap asked 20 m, was 20.4 m``.
    """

    npc: int
    step: int
    what: str
    asked: float
    was: float
    tolerance: float
    unit: str

    @property
    def is_met(self) -> bool:
        """True if it was as asked."""
        return abs(self.was - self.asked) <= self.tolerance

    @property
    def words(self) -> str:
        """What was asked and what was, in words."""
        if self.what == "step":
            return f"step {self.step} did not come up"
        return f"{self.what} asked {self.asked:g} {self.unit}, was {self.was:.1f} {self.unit}"


def gap_at(trace: Trace, npc: int, tick: int) -> float:
    """Return the gap between the ego and an NPC along the road [m]; negative if the NPC is behind the ego."""
    if trace.track is None:
        distance = float(trace.states[tick, npc + 1, X] - trace.states[tick, 0, X])
    else:
        distance = float((trace.track[tick, npc + 1, 0] - trace.track[tick, 0, 0]) * trace.track[tick, 0, 4])
    room = abs(distance) - float(trace.sizes[0, 0] + trace.sizes[npc + 1, 0]) / 2
    return math.copysign(max(room, 0.0), distance)


def asked(trace: Trace) -> tuple[Asked, ...]:
    """Return what the manoeuvres of a run asked for, by NPC and step; empty without manoeuvres.

    A step that had no time before a collision is not judged by what it would have become.
    """
    found: list[Asked] = []
    by_distance = [
        (begin, npc, number)
        for npc, chain in enumerate(trace.scenario.npcs[: len(trace.begun)])
        if isinstance(chain[0], Manoeuvre)
        for number, (step, begin) in enumerate(zip(chain[0].steps, trace.begun[npc], strict=False))
        if step.is_by_distance
    ]
    if by_distance:  # the ego has not reacted to anything before the first of them
        begin, npc, number = min(by_distance)
        ego = float(trace.ego[begin, SPEED])
        found.append(Asked(npc, number, "ego speed", trace.scenario.ego_speed, ego, EGO_SPEED_OFF, "m/s"))
    for npc, chain in enumerate(trace.scenario.npcs):
        if isinstance(chain[0], Manoeuvre):
            found += _of_npc(trace, npc, chain[0])
    return tuple(found)


def is_as_asked(trace: Trace) -> bool:
    """Return whether everything that the manoeuvres of a run asked for came up."""
    return all(each.is_met for each in asked(trace))


def _of_npc(trace: Trace, npc: int, manoeuvre: Manoeuvre) -> list[Asked]:
    begun = trace.begun[npc] if npc < len(trace.begun) else ()
    ends = (*begun[1:], trace.ticks)
    done = trace.arrivals[npc][0] if npc < len(trace.arrivals) and trace.arrivals[npc] else None
    found: list[Asked] = []
    speed = manoeuvre.speed
    for number, (step, begin, end) in enumerate(zip(manoeuvre.steps, begun, ends, strict=False)):
        before = speed
        gap = gap_at(trace, npc, begin)
        if step.gap is not None:
            found.append(Asked(npc, number, "gap", step.gap, gap, GAP + SHARE * abs(step.gap), "m"))
        if step.headway is not None:
            rear = 0 if gap > 0 else npc + 1
            time = gap / max(float(trace.states[begin, rear, SPEED]), 0.1)
            found.append(Asked(npc, number, "headway", step.headway, time, HEADWAY + SHARE * abs(step.headway), "s"))
        was = float(trace.states[begin, npc + 1, SPEED])
        if number == 0 or not step.is_by_distance:  # else it may begin while the one before it goes on
            found.append(Asked(npc, number, "speed", before, was, SPEED_OFF, "m/s"))
        speed = before if step.speed is None else step.speed
        is_last = number == len(manoeuvre.steps) - 1
        if done is not None or not is_last:  # it was done, or another one began
            found += _dynamics(trace, npc, number, step, (begin, done if is_last and done else end), speed - before)
    has_time = trace.collision is None or not begun  # a collision leaves later steps no time
    if manoeuvre.steps and done is None and has_time:
        found.append(Asked(npc, min(len(begun), len(manoeuvre.steps) - 1), "step", math.nan, math.nan, 0.0, ""))
    return found


def _dynamics(trace: Trace, npc: int, number: int, step: Step, span: tuple[int, int], change: float) -> list[Asked]:
    """Return the lateral speed of a lane change, and the acceleration of a change of speed."""
    begin, end = span
    rows = trace.states[begin : end + 1, npc + 1]
    found = []
    if step.lane != "keep" and trace.track is None:
        fastest = float(np.max(np.abs(np.diff(rows[:, Y])), initial=0.0)) * trace.physics_hz
        tolerance = LATERAL + LATERAL_SHARE * step.lateral_speed
        found.append(Asked(npc, number, "lateral speed", step.lateral_speed, fastest, tolerance, "m/s"))
    if abs(change) >= LEAST_CHANGE:
        hardest = float(np.max(rows[1:, ACCELERATION] * np.sign(change), initial=0.0))
        tolerance = BRAKING_SHARE * step.acceleration
        found.append(Asked(npc, number, "acceleration", step.acceleration, hardest, tolerance, "m/s^2"))
    return found
