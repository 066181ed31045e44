"""Whether a run with manoeuvres or crossing NPCs came up as it was asked for, measured in its trace.

A trigger by distance does not make a situation alone: an ego that has sped up meets the same gap at another closing
speed. So each step tells what was asked, and what it was when the step began, and when it was done. An NPC that crosses
has a slot relative to the ego, which counts when the NPC no longer adapts to the ego.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pytest_pafot.criticality.zones import passages, times_expected
from pytest_pafot.model.instructions import Instruction, Step
from pytest_pafot.model.trace import ACCELERATION, SPEED, FloatArray, Trace, X, Y

GAP, HEADWAY, SPEED_OFF, EGO_SPEED_OFF, SLOT = 1.0, 0.1, 1.0, 1.0, 0.3
"""The tolerances of a gap [m], a headway [s], an NPC's speed and the ego's speed [m/s], and a slot [s]."""
SHARE = 0.05
"""The tolerance of gaps and headways beside that, as a share of what is asked."""
LATERAL, LATERAL_SHARE, BRAKING_SHARE = 0.2, 0.1, 0.2
"""The tolerance of the highest lateral speed of a lane change [m/s] and its share, and that of the acceleration."""
NOT_DONE = {
    "step": "step {} did not come up",
    "end": "step {} was not done",
    "lane": "step {} was for a lane that the road does not have",
    "zone": "the NPC did not come to its zone",
}
"""The words on what did not come up."""
LEAST_CHANGE = 3.0
"""The change of speed [m/s] from which the acceleration is judged; a smaller one ends before it builds up."""
ADAPTING_UNTIL, WAITING = 3.0, 0.5
"""The time before its entry into the zone until which an NPC adapts to the ego's arrival [s], and the smallest share of
its speed to which it slows down for that; both are those of ``world/kernel/crossing.py``."""
LATELY, RISE = 0.2, 0.05
"""A time [s], and the rise of a lateral speed [m/s] or acceleration [m/s^2] within it below which it has built up."""


@dataclass(frozen=True, slots=True)
class Asked:
    """One thing that a manoeuvre asked for.

    Attributes:
        npc: index of the NPC.
        step: index of the step; 0 for an NPC that crosses.
        what: ``gap``, ``headway``, ``speed``, ``ego speed``, ``lateral speed``, ``acceleration``; ``step`` for a step
            that did not begin; ``end`` for one that began and was not done; ``lane`` for one to a lane that is none.
            ``slot`` for an NPC that crosses, and ``zone`` if it did not come to its zone.
        asked: what was asked [m, s, m/s or m/s^2]; NaN for what did not come up.
        was: what it was; NaN for what did not come up.
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
            return NOT_DONE[self.what].format(self.step)
        return f"{self.what} asked {self.asked:g} {self.unit}, was {self.was:.1f} {self.unit}"


def gap_at(trace: Trace, npc: int, tick: int) -> float:
    """Return the gap between the ego and an NPC along the road [m]; negative if the NPC is behind the ego."""
    return _between_bumpers(trace, npc, trace.road.distance(npc, tick))


def _between_bumpers(trace: Trace, npc: int, distance: float) -> float:
    room = abs(distance) - float(trace.sizes[0, 0] + trace.sizes[npc + 1, 0]) / 2
    return math.copysign(max(room, 0.0), distance)


@dataclass(frozen=True, slots=True, kw_only=True)
class Departure:
    """The moment at which an NPC stopped driving as recorded.

    It did so because its track ended, its step began, or the ego drove otherwise.

    Attributes:
        npc: index of the NPC.
        time: when it did [s].
        gap: the gap between the ego and the NPC along the road then [m]; negative if the NPC was behind.
        recorded_gap: the same in the recording; None if the recorded ego or the NPC was no longer there.
    """

    npc: int
    time: float
    gap: float
    recorded_gap: float | None = None

    @property
    def gaps(self) -> str:
        """The gaps in words: ``with a gap of 9 m instead of 14 m``."""
        was = "" if self.recorded_gap is None else f" instead of {abs(self.recorded_gap):.0f} m"
        return f"with a gap of {abs(self.gap):.0f} m{was}"

    @property
    def words(self) -> str:
        """The departure in words: ``leaves the recording after 1.2 s, with a gap of 9 m instead of 14 m``."""
        return f"leaves the recording after {self.time:.1f} s, {self.gaps}"


def departures(trace: Trace) -> tuple[Departure, ...]:
    """Return where the NPCs of a run left their recordings, in the order of time; empty if none did."""
    found, ego = [], trace.scenario.ego_track
    for npc, tick in enumerate(trace.handed_over):
        if tick is None:
            continue
        time, recorded_gap = tick / trace.physics_hz, None
        track: Any = trace.scenario.npcs[npc][0]
        if ego is not None and time <= min(ego.seconds, track.track.seconds):
            distance = float(track.track.at([time])[0, X] - ego.at([time])[0, X])
            recorded_gap = round(_between_bumpers(trace, npc, distance), 1)
        gap = round(gap_at(trace, npc, tick), 1)
        found.append(Departure(npc=npc, time=round(time, 3), gap=gap, recorded_gap=recorded_gap))
    return tuple(sorted(found, key=lambda each: each.time))


def asked(trace: Trace) -> tuple[Asked, ...]:
    """Return what the manoeuvres and crossing NPCs of a run asked for, by NPC and step; empty without them.

    A collision, an error of the ADS, or a departure from the road that ends the run leaves later steps no time, so they
    are not judged; but if none of any NPC had begun, the situation did not come up. A step that it breaks off is judged
    once its lateral speed or its acceleration has built up, so that the answer is mostly that of a run in which the ego
    survives. A lane change and a change of speed are judged if they were done before another began.
    """
    found: list[Asked] = []
    has_time = not (_is_broken_off(trace) and any(map(trace.steps_begun, range(len(trace.scenario.npcs)))))
    by_distance = [
        (begin, npc, number)
        for npc, chain in enumerate(trace.scenario.npcs)
        for number, (step, begin) in enumerate(zip(chain[0].steps, trace.steps_begun(npc), strict=False))
        if step.is_by_distance
    ]
    if by_distance:  # at the first, the ego drives its own speed, unless it has reacted to a step by time before
        begin, npc, number = min(by_distance)
        ego = float(trace.ego[begin, SPEED])
        found.append(Asked(npc, number, "ego speed", trace.scenario.ego_speed, ego, EGO_SPEED_OFF, "m/s"))
    for npc, chain in enumerate(trace.scenario.npcs):
        found += _of_npc(trace, npc, chain[0], has_time=has_time)
        if chain[0].slot_asked is not None:
            found += _of_crossing(trace, npc, chain[0].slot_asked)
    return tuple(found)


def _is_broken_off(trace: Trace) -> bool:
    """Return whether the ego ended the run with a collision or off the road, or its ADS did not decide."""
    return trace.collision is not None or trace.error is not None or trace.off_road_tick == trace.ticks


def _of_crossing(trace: Trace, npc: int, slot: float) -> Iterator[Asked]:
    """Yield the slot of an NPC, at the ego's speed when the NPC no longer adapted to the ego.

    An ego may answer in two ways that leave no slot to judge. It may wait for the NPC, which does not become slow
    enough to come after it. Or it may slow down in the zone, so that the NPC waits for it.
    """
    passage = passages(trace)[npc]
    if passage is None:
        return
    has_come = passage.npc_enters < math.inf
    if not has_come:
        if not _is_broken_off(trace):
            yield Asked(npc, 0, "zone", math.nan, math.nan, 0.0, "")
        return
    until = max(round((passage.npc_enters - ADAPTING_UNTIL) * trace.physics_hz), 0)
    if min(trace.ego[: until + 1, SPEED]) < WAITING * trace.ego[0, SPEED]:
        return
    (ego_enters, ego_leaves), (enters, leaves) = times_expected(trace, npc, until)
    was = enters - ego_leaves if slot > 0 else leaves - ego_enters
    if slot == 0:
        was = (enters + leaves - ego_enters - ego_leaves) / 2
    has_left = passage.ego_leaves < math.inf  # else, as after a collision, it would have left at its last speed
    left = passage.ego_leaves if has_left else times_expected(trace, npc, trace.ticks)[0][1]
    if was - slot <= SLOT or left <= ego_leaves + SLOT:
        yield Asked(npc, 0, "slot", slot, was, SLOT, "s")


def _of_npc(trace: Trace, npc: int, manoeuvre: Instruction, *, has_time: bool) -> list[Asked]:
    """Return what the steps of an instruction asked for."""
    begun = trace.steps_begun(npc)
    done = trace.arrivals[npc][0] if npc < len(trace.arrivals) and trace.arrivals[npc] else None
    is_broken_off = _is_broken_off(trace)
    found: list[Asked] = []
    speed = manoeuvre.speed if manoeuvre.holds_speed else None
    for number, (step, begin) in enumerate(zip(manoeuvre.steps, begun, strict=False)):
        gap = gap_at(trace, npc, begin)
        if step.gap is not None:
            found.append(Asked(npc, number, "gap", step.gap, gap, GAP + SHARE * abs(step.gap), "m"))
        if step.headway is not None:
            rear = 0 if gap > 0 else npc + 1
            time = gap / max(float(trace.states[begin, rear, SPEED]), 0.1)
            found.append(Asked(npc, number, "headway", step.headway, time, HEADWAY + SHARE * abs(step.headway), "s"))
        was = float(trace.states[begin, npc + 1, SPEED])
        if speed is not None and (
            number == 0 or not step.is_by_distance
        ):  # else it may begin while the one before it goes on
            found.append(Asked(npc, number, "speed", speed, was, SPEED_OFF, "m/s"))
        speed = speed if step.speed is None else step.speed
        # It was done when a timed step after it began, or with the manoeuvre; those between go on beside it.
        later = list(zip(manoeuvre.steps, begun, strict=False))[number + 1 :]
        timed = next((place for place, (each, _) in enumerate(later) if not each.is_by_distance), len(later))
        has_waited = not is_broken_off and len(begun) < len(manoeuvre.steps)  # until the end of the run
        end = later[timed][1] if timed < len(later) else trace.ticks if has_waited else done
        if end is not None or is_broken_off:
            span = begin, trace.ticks if end is None else end
            acts = _dynamics(trace, npc, number, [step, *(each for each, _ in later[:timed])], span)
            found += [act for act, has_built_up in acts if end is not None or act.is_met or has_built_up]
    if manoeuvre.steps and done is None and has_time:
        what, number = ("step", len(begun)) if len(begun) < len(manoeuvre.steps) else ("end", len(begun) - 1)
        missed = _without_lane(trace, npc, manoeuvre.steps[: len(begun)])
        what, number = (what, number) if missed is None else ("lane", missed)
        found.append(Asked(npc, number, what, math.nan, math.nan, 0.0, ""))
    return found


def _without_lane(trace: Trace, npc: int, steps: Sequence[Step]) -> int | None:
    """Return the first step to a lane that a straight road does not have; None if there is none."""
    first = lane = int(trace.road.numbers(npc + 1)[0])
    for number, step in enumerate(steps):
        lane += step.column
        if first >= 0 and not 0 <= lane < len(trace.lanes):
            return number
    return None


def _dynamics(
    trace: Trace, npc: int, number: int, steps: Sequence[Step], span: tuple[int, int]
) -> Iterator[tuple[Asked, bool]]:
    """Yield the lateral speed and the acceleration of the first step, and whether each has built up.

    It has if it has risen and no longer does; a lateral speed also rises with the speed of the vehicle. What the other
    steps, which begin while it goes on, change as well is left out.
    """
    begin, end = span
    step, *others = steps
    lately = round(LATELY * trace.physics_hz)

    def rises(values: FloatArray) -> bool:
        return len(values) <= lately or bool(values[-1] - values[-1 - lately] >= RISE)

    rows = trace.states[begin : end + 1, npc + 1]
    change = 0.0 if step.speed is None else step.speed - float(rows[0, SPEED])
    move_aside = any(each.lane != "keep" or each.offset != step.offset for each in others)
    if step.lane != "keep" and trace.road.is_straight and not move_aside:
        values = np.abs(np.diff(rows[:, Y])) * trace.physics_hz
        fastest, tolerance = float(np.max(values, initial=0.0)), LATERAL + LATERAL_SHARE * step.lateral_speed
        yield (
            Asked(npc, number, "lateral speed", step.lateral_speed, fastest, tolerance, "m/s"),
            (fastest > RISE and not rises(values) and not rises(rows[:, SPEED])),
        )
    if abs(change) >= LEAST_CHANGE and all(each.speed is None for each in others):
        values = rows[1:, ACCELERATION] * np.sign(change)
        hardest, tolerance = float(np.max(values, initial=0.0)), BRAKING_SHARE * step.acceleration
        yield (
            Asked(npc, number, "acceleration", step.acceleration, hardest, tolerance, "m/s^2"),
            (hardest > RISE and not rises(values)),
        )
