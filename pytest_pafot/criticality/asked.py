"""Whether a run with manoeuvres came up as it was asked for, measured in its trace.

A trigger by distance does not make a situation alone: an ego that has sped up meets the same gap at another closing
speed. So each step tells what was asked, and what it was when the step began, and when it was done.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pytest_pafot.model.scenario import Manoeuvre, Step
from pytest_pafot.model.trace import ACCELERATION, LANE, SPEED, Trace, X, Y

GAP, HEADWAY, SPEED_OFF, EGO_SPEED_OFF = 1.0, 0.1, 1.0, 1.0
"""The tolerances of a gap [m], a headway [s], an NPC's speed and the ego's speed [m/s]."""
SHARE = 0.05
"""The tolerance of gaps and headways beside that, as a share of what is asked."""
LATERAL, LATERAL_SHARE, BRAKING_SHARE = 0.2, 0.1, 0.2
"""The tolerance of the highest lateral speed of a lane change [m/s] and its share, and that of the acceleration."""
NOT_DONE = {"step": "did not come up", "end": "was not done", "lane": "was for a lane that the road does not have"}
"""The words on steps that did not become what was asked."""
LEAST_CHANGE = 3.0
"""The change of speed [m/s] from which the acceleration is judged; a smaller one ends before it builds up."""


@dataclass(frozen=True, slots=True)
class Asked:
    """One thing that a manoeuvre asked for.

    Attributes:
        npc: index of the NPC.
        step: index of the step.
        what: ``gap``, ``headway``, ``speed``, ``ego speed``, ``lateral speed``, ``acceleration``; ``step`` for a step
            that did not begin; ``end`` for one that began and was not done; ``lane`` for one to a lane that is none.
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
        """The words for it: ``gap asked 20 m, was 20.4 m``."""
        if self.what in NOT_DONE:
            return f"step {self.step} {NOT_DONE[self.what]}"
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

    A step that had no time before a collision is not judged by what it would have become; but if none had begun, the
    situation did not come up. A lane change and a change of speed are judged if they were done before another began.
    """
    found: list[Asked] = []
    by_distance = [
        (begin, npc, number)
        for npc, chain in enumerate(trace.scenario.npcs)
        if isinstance(chain[0], Manoeuvre)
        for number, (step, begin) in enumerate(zip(chain[0].steps, trace.steps_begun(npc), strict=False))
        if step.is_by_distance
    ]
    if by_distance:  # at the first, the ego drives its own speed, unless it has reacted to a step by time before
        begin, npc, number = min(by_distance)
        ego = float(trace.ego[begin, SPEED])
        found.append(Asked(npc, number, "ego speed", trace.scenario.ego_speed, ego, EGO_SPEED_OFF, "m/s"))
    for npc, chain in enumerate(trace.scenario.npcs):
        if isinstance(chain[0], Manoeuvre):
            found += _of_npc(trace, npc, chain[0])
    return tuple(found)


def _of_npc(trace: Trace, npc: int, manoeuvre: Manoeuvre) -> list[Asked]:
    begun = trace.steps_begun(npc)
    done = trace.arrivals[npc][0] if npc < len(trace.arrivals) and trace.arrivals[npc] else None
    found: list[Asked] = []
    speed = manoeuvre.speed
    for number, (step, begin) in enumerate(zip(manoeuvre.steps, begun, strict=False)):
        gap = gap_at(trace, npc, begin)
        if step.gap is not None:
            found.append(Asked(npc, number, "gap", step.gap, gap, GAP + SHARE * abs(step.gap), "m"))
        if step.headway is not None:
            rear = 0 if gap > 0 else npc + 1
            time = gap / max(float(trace.states[begin, rear, SPEED]), 0.1)
            found.append(Asked(npc, number, "headway", step.headway, time, HEADWAY + SHARE * abs(step.headway), "s"))
        was = float(trace.states[begin, npc + 1, SPEED])
        if number == 0 or not step.is_by_distance:  # else it may begin while the one before it goes on
            found.append(Asked(npc, number, "speed", speed, was, SPEED_OFF, "m/s"))
        speed = speed if step.speed is None else step.speed
        # It was done when a timed step after it began, or with the manoeuvre; those between go on beside it.
        later = list(zip(manoeuvre.steps, begun, strict=False))[number + 1 :]
        timed = next((place for place, (each, _) in enumerate(later) if not each.is_by_distance), len(later))
        has_waited = trace.collision is None and len(begun) < len(manoeuvre.steps)  # until the end of the run
        end = later[timed][1] if timed < len(later) else trace.ticks if has_waited else done
        if end is not None:
            found += _dynamics(trace, npc, number, [step, *(each for each, _ in later[:timed])], (begin, end))
    has_time = trace.collision is None or not begun  # a collision leaves later steps no time
    if manoeuvre.steps and done is None and has_time:
        what, number = ("step", len(begun)) if len(begun) < len(manoeuvre.steps) else ("end", len(begun) - 1)
        missed = _without_lane(trace, npc, manoeuvre.steps[: len(begun)])
        what, number = (what, number) if missed is None else ("lane", missed)
        found.append(Asked(npc, number, what, math.nan, math.nan, 0.0, ""))
    return found


def _without_lane(trace: Trace, npc: int, steps: Sequence[Step]) -> int | None:
    """Return the first step to a lane that a straight road does not have; None if there is none."""
    lane = int(trace.states[0, npc + 1, LANE])
    for number, step in enumerate(steps):
        lane += step.column
        if trace.track is None and not 0 <= lane < len(trace.lanes):
            return number
    return None


def _move_aside(step: Step, others: Sequence[Step]) -> bool:
    return any(each.lane != "keep" or each.offset != step.offset for each in others)


def _dynamics(trace: Trace, npc: int, number: int, steps: Sequence[Step], span: tuple[int, int]) -> list[Asked]:
    """Return the lateral speed and the acceleration of the first step, unless those beside it change the same."""
    begin, end = span
    step, *others = steps
    rows = trace.states[begin : end + 1, npc + 1]
    change = 0.0 if step.speed is None else step.speed - float(rows[0, SPEED])
    found = []
    if step.lane != "keep" and trace.track is None and not _move_aside(step, others):
        fastest = float(np.max(np.abs(np.diff(rows[:, Y])), initial=0.0)) * trace.physics_hz
        tolerance = LATERAL + LATERAL_SHARE * step.lateral_speed
        found.append(Asked(npc, number, "lateral speed", step.lateral_speed, fastest, tolerance, "m/s"))
    if abs(change) >= LEAST_CHANGE and all(each.speed is None for each in others):
        hardest = float(np.max(rows[1:, ACCELERATION] * np.sign(change), initial=0.0))
        tolerance = BRAKING_SHARE * step.acceleration
        found.append(Asked(npc, number, "acceleration", step.acceleration, hardest, tolerance, "m/s^2"))
    return found
