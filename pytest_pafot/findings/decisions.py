"""The last decision with which an ADS could have avoided a failure."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np

from pytest_pafot.attribution.responsibility import DRIFTING, Fault, frame_of
from pytest_pafot.findings.finding import Expect
from pytest_pafot.model.trace import HEADING, LANE, OFFSET, SPEED, Trace, X, Y
from pytest_pafot.oracle.run import Run

# For each part of a planner's action: the smallest difference that counts, and the format for messages.
PARTS = {
    "acceleration": (0.2, "{:z.1f} m/s^2"),
    "steering": (0.02, "{:z.2f} rad"),
    "speed": (0.2, "{:z.1f} m/s"),
    "lateral_acceleration": (0.2, "{:z.1f} m/s^2"),
    "lateral_jerk": (0.2, "{:z.1f} m/s^3"),
}
# the smallest difference that counts between two numbers in an environment's own units
SHARE = 0.05
# the largest distance from the centre of a lane at which the ego counts as driving along it [m]
CENTRED = 0.25
# the sideways speed below which the ego counts as driving along the road [m/s]
ALONG = DRIFTING / 10
# Below this sideways speed, or change of sideways speed between two decisions, the ego counts as not steering [m/s].
STEADY = 0.003
# A drift takes at least this long to reach the line [s]. A lane change also starts slowly, but takes less time.
DRIFT_SECONDS = 3.0
# The faults of an ego that should not have braked.
NEEDLESS: tuple[Fault, ...] = ("braked-for-nothing", "stopped-for-nothing")


@dataclass(frozen=True, slots=True, kw_only=True)
class Moment:
    """The last decision that could have avoided a failure."""

    time: float  # time of the decision [s]
    npc: int | None  # index of the NPC that the decision is about, or None
    seen: str = ""  # where the policy saw the NPC; empty if that is unknown
    was: str = ""  # where the NPC was, if it is unknown whether the policy saw it; otherwise empty
    action: str = ""  # the action of the policy
    # The action if the NPC is hidden in this decision; empty if it is the same action, None if unknown.
    hidden: str | None = None
    # The smallest of the tried changes of the NPC that alter the action, and the altered action; empty if no change has
    # an effect, None if none was tried.
    otherwise: str | None = None
    # the action of the reference, if the test has one and this is the first decision that differs
    reference: str = ""
    # The conditions that the policy evaluated, each with its line, values and outcome, in groups: about this NPC, about
    # no vehicle or an unknown one, about other vehicles. A group starts with the conditions that have a different
    # outcome after the change in `otherwise`. The others follow, the latest first.
    conditions: tuple[tuple[str, tuple[str, ...]], ...] = ()

    def __str__(self) -> str:
        whom, changed = f"NPC {self.npc}", [self.brief.removesuffix(".")]
        if self.hidden is not None and not self.reference:
            changed.insert(1, f"with {whom} hidden, it chose {self.hidden or 'the same'}")
        if self.otherwise == "" and not self.reference:
            changed.append(f"none of the changes tried for {whom} had an effect")
        return f"{'; '.join(changed)}."

    @property
    def brief(self) -> str:
        """The decision in one sentence, with the smallest change of the NPC that alters it."""
        at = f"At {self.time:.1f} s,"
        if self.reference:
            first = f"{at} in the first decision that differs, the policy chose {self.action}"
            return f"{first}, and the reference chose {self.reference}."
        line = f"the policy chose {self.action}"
        if self.seen:
            line = f"the policy saw NPC {self.npc} ({self.seen}) and chose {self.action}"
        if self.was:
            line = f"NPC {self.npc} was {self.was}, and {line}"
        if self.otherwise:
            line += f"; with NPC {self.npc} {self.otherwise}"
        return f"{at} {line}."

    def condition_lines(self) -> list[str]:
        # The rows of the conditions, below the vehicle that they are about.
        lines: list[str] = []
        for whom, rows in self.conditions:
            indent = ""
            if whom:
                lines.append(f"{whom}:")
                indent = "  "
            lines += [f"{indent}{row}" for row in rows]
        return lines


def vehicle_of(run: Run, expect: Expect) -> int | None:
    """Return the index of the NPC involved in a failure, or None."""
    if run.collision is not None and expect.check is None:
        return run.collision.npc  # None for a fixed object
    if expect.npc is not None or expect.check is None:
        return expect.npc
    # The check names no NPC, so take the nearest one.
    tick = min(round(expect.time * run.trace.physics_hz), run.trace.ticks)
    aside = run.trace.states[tick, 1:, [X, Y]] - run.trace.ego[tick, [X, Y], None]
    away = np.hypot(*aside)
    if np.isnan(away).all():  # or there is no NPC
        return None
    return int(np.nanargmin(away))


def deciding(run: Run, expect: Expect) -> int | None:
    """Return the index of the last decision that could have avoided a failure, or None."""
    trace, attribution = run.trace, run.attribution
    if not trace.decision_ticks:
        return None
    if expect.check is not None:
        time = expect.time  # the last decision before a failed check
    elif run.collision is None:
        return None
    else:
        number = moved_over(run)
        if number is not None:
            return number
        # The last decision at which a careful driver who takes over avoids the collision. If there is none, or if the
        # ego braked for nothing, it is the decision at the time of the verdict.
        time = attribution.time or 0.0
        if expect.takeover and attribution.fault not in NEEDLESS:
            time = expect.time - expect.takeover
        elif not attribution.fault:
            return None
    times = [tick / trace.physics_hz for tick in trace.decision_ticks]
    return max(bisect_right(times, time + 1e-6) - 1, 0)


def moved_over(run: Run) -> int | None:
    """Return the index of the decision that started a lane change for which the ego is at fault, or None."""
    trace, tick = run.trace, run.attribution.tick or 0
    if run.attribution.fault != "entered-lane" or not trace.decision_ticks:
        return None
    last = max(bisect_right(trace.decision_ticks, tick) - 1, 0)
    return _begun(trace, tick, last)


def sentences_of(run: Run, expect: Expect) -> tuple[str, ...]:
    """Return the sentences that explain a run, including the start of a lane change for which the ego is at fault."""
    sentences, number = expect.sentences_on(run), moved_over(run)
    if not sentences or number is None:
        return sentences
    # A verdict does not know the decisions, so its sentence states only when the ego crossed the line.
    began = f"{run.trace.decision_ticks[number] / run.trace.physics_hz:.1f} s"
    did = f"began to change lanes at {began}"
    if _drifted(run.trace, number, run.attribution.time or 0.0):
        did = f"drifted from {began}"
    first, *others = sentences
    return (f"The ego {did} and {first.removeprefix('The ego ')}", *others)


def deed_of(run: Run, sentences: Sequence[str]) -> str:
    """Return the sentence about what the ego did wrong, or an empty string if the ego is not at fault."""
    # a fixed object has only the last sentence
    if run.responsibility not in ("ego", "both") or len(sentences) < 2:
        return ""
    if run.attribution.fault in (*NEEDLESS, "entered-lane"):
        return sentences[0]
    return sentences[-2]


def _drifted(trace: Trace, number: int, crossed: float) -> bool:
    # A drift takes a long time, and is as slow as wandering in the lane. An ego that has chosen another lane does not
    # drift.
    # `crossed` is the time at which the ego crosses the line [s].
    begin, end = trace.decision_ticks[number], round(crossed * trace.physics_hz)
    # The last decision of a run can have no action.
    if number < len(trace.actions):
        lane = _lane_of(trace.actions[number], None)
        if lane not in (None, trace.ego[begin, LANE]):
            return False
    if end - begin < DRIFT_SECONDS * trace.physics_hz:
        return False
    return bool(abs(frame_of(trace).drift[0, begin + 1 : end + 1].mean()) < DRIFTING)


def _begun(trace: Trace, tick: int, number: int) -> int:
    # `number` is the last decision up to the tick. If the ego moved to the other side before, its motion starts with
    # the decision to turn back.
    ticks = trace.decision_ticks
    drifts = frame_of(trace).drift[0]
    side = 1.0 if drifts[tick] > 0 else -1.0
    lanes = [_lane_of(action, math.nan) for action in trace.actions[: number + 1]]
    is_across = [side * (lane - trace.ego[tick, LANE]) >= 1 for lane in lanes]
    # The ego is steered gently to the lane of a LaneCommand, so its motion shows the decision late.
    if any(is_across):
        while not is_across[number]:
            number -= 1
        while number and is_across[number - 1]:
            number -= 1
        return number
    drift = (side * drifts[ticks]).tolist()
    off_centre = np.abs(trace.track_of(0)[ticks, OFFSET])
    while number and drift[number] >= ALONG:
        number -= 1
    # The ego turns back while it still moves to the other side, and steers before it visibly moves.
    while number and drift[number - 1] < drift[number] - STEADY:
        if -ALONG < drift[number] < STEADY and off_centre[number] < CENTRED:
            break
        number -= 1
    return number


def seen_of(trace: Trace, npc: int, number: int) -> str:
    """Describe the position of an NPC relative to the ego at a decision."""
    ego, other = trace.states[trace.decision_ticks[number], [0, npc + 1]]
    turn = trace.road.direction_of_places(trace.decision_ticks[number])
    dx, dy = other[[X, Y]] - ego[[X, Y]]
    cos, sin = np.cos(turn), np.sin(turn)
    box = (ego[HEADING] - turn, *trace.sizes[0])
    other_box = (other[HEADING] - turn, *trace.sizes[npc + 1])
    faster = other[SPEED] - ego[SPEED]
    return placed(dx * cos + dy * sin, dy * cos - dx * sin, faster, box, other_box)


def placed(ahead: float, right: float, faster: float, *boxes: tuple[float, float, float]) -> str:
    """Describe a vehicle's position and speed relative to the ego."""
    # `ahead` and `right` are between the centres [m], and `faster` is in m/s. Each of the two boxes is a heading [rad],
    # a length and a width [m]. As in a verdict, the gap is between the boxes.
    gap = abs(ahead)
    for angle, length, width in boxes:
        gap -= (length * abs(np.cos(angle)) + width * abs(np.sin(angle))) / 2
    place, side, pace = "next to the ego", "", "equally fast"
    if gap > 0:
        place = f"{gap:.1f} m ahead" if ahead >= 0 else f"{gap:.1f} m behind"
    # Smaller values would be printed as 0.0.
    if right >= 0.05:
        side = f", {right:.1f} m to the right"
    elif right <= -0.05:
        side = f", {-right:.1f} m to the left"
    if faster >= 0.05:
        pace = f"{faster:.1f} m/s faster"
    elif faster <= -0.05:
        pace = f"{-faster:.1f} m/s slower"
    return f"{place}{side}, {pace}"


def differ(action: Any, other: Any) -> bool:
    """Return whether two actions differ noticeably."""
    if other is None or type(action) is not type(other):
        return action is not other
    if is_planners(action):
        return bool(differing_parts(action, other))
    here, there = _plain(action), _plain(other)
    if isinstance(here, float):  # even a vehicle far away changes the output of a network a little
        return bool(abs(here - there) >= SHARE)
    if isinstance(here, list):
        return len(here) != len(there) or any(map(differ, here, there))
    if isinstance(here, dict):
        return here.keys() != there.keys() or any(differ(here[name], there[name]) for name in here)
    return repr(here) != repr(there)


def _plain(action: Any) -> Any:
    if isinstance(action, (np.ndarray, np.generic)):
        return action.tolist()
    if isinstance(action, tuple):
        return list(action)
    is_bare = repr(action) == object.__repr__(action)  # contains the address of the object
    if hasattr(action, "__dict__") and (is_bare or is_dataclass(action)):
        return vars(action)
    return action


def text_of_any(action: Any) -> str:
    """Format an action, with three significant digits for each number."""
    plain = _plain(action)
    if isinstance(plain, float):
        return f"{plain:.3g}"
    if isinstance(plain, list):
        parts = ", ".join(map(text_of_any, plain))
        return f"({parts})" if isinstance(action, tuple) else f"[{parts}]"
    if isinstance(plain, dict):
        values = {part: text_of_any(value) for part, value in plain.items()}
        if plain is action:
            parts = ", ".join(f"{part!r}: {value}" for part, value in values.items())
            return f"{{{parts}}}"
        parts = ", ".join(f"{part}={value}" for part, value in values.items())
        return f"{type(action).__name__}({parts})"
    return repr(plain)


def is_planners(action: Any) -> bool:
    """Return whether an action is a pair in SI units or a ``LaneCommand``."""
    return is_si(action) or type(action).__module__ == "pytest_pafot.world.kernel.action"


def _lane_of(action: Any, otherwise: float | None) -> Any:
    if is_planners(action) and not is_si(action):
        return action.lane
    return otherwise


def is_si(action: Any) -> bool:
    """Return whether an action is a tuple (acceleration, steering) in SI units."""
    return (
        type(action) is tuple
        and len(action) == 2
        and all(isinstance(each, float) for each in action)
    )


def parts_of(action: Any) -> dict[str, Any]:
    """Return the parts of a planner's action as a dict."""
    if is_si(action):
        return dict(zip(("acceleration", "steering"), action, strict=True))
    return {field.name: getattr(action, field.name) for field in fields(action)}


def differing_parts(action: Any, other: Any) -> list[str]:
    """Return the names of the parts in which two actions differ."""
    parts = parts_of(action)
    if type(action) is not type(other) or is_si(action) is not is_si(other):
        # A part that a LaneCommand leaves at its default does not count.
        if not is_si(action):
            for field in fields(action):
                if parts[field.name] == field.default:
                    del parts[field.name]
        return list(parts)
    names = []
    for name, there in parts_of(other).items():
        here = parts[name]
        is_other = here != there
        if isinstance(here, float) and isinstance(there, float):
            least, _ = PARTS.get(name, (0.0, ""))
            is_other = abs(here - there) >= least
        if is_other:
            names.append(name)
    return names
