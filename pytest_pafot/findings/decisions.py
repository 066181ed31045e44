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
        saw = f"saw NPC {self.npc} ({self.seen}) and " if self.seen else ""
        was = f"NPC {self.npc} was {self.was}, and " if self.was else ""
        otherwise = f"; with NPC {self.npc} {self.otherwise}" if self.otherwise else ""
        return f"{at} {was}the policy {saw}chose {self.action}{otherwise}."

    def condition_lines(self) -> list[str]:
        # The rows of the conditions, below the vehicle that they are about.
        lines = []
        for whom, rows in self.conditions:
            lines += [
                *([f"{whom}:"] if whom else []),
                *(f"{'  ' if whom else ''}{row}" for row in rows),
            ]
        return lines


def vehicle_of(run: Run, expect: Expect) -> int | None:
    """Return the index of the NPC involved in a failure, or None."""
    if run.collision is not None and expect.check is None:
        return run.collision.npc  # None for a fixed object
    if expect.npc is not None or expect.check is None:
        return expect.npc
    # The check names no NPC, so take the nearest one.
    tick = min(round(expect.time * run.trace.physics_hz), run.trace.ticks)
    away = np.hypot(*(run.trace.states[tick, 1:, [X, Y]] - run.trace.ego[tick, [X, Y], None]))
    return None if np.isnan(away).all() or not away.size else int(np.nanargmin(away))


def deciding(run: Run, expect: Expect) -> int | None:
    """Return the index of the last decision that could have avoided a failure, or None."""
    trace, attribution = run.trace, run.attribution
    ticks, hz = trace.decision_ticks, trace.physics_hz

    def at(time: float) -> int:
        return max(bisect_right([tick / hz for tick in ticks], time + 1e-6) - 1, 0)

    if not ticks:
        return None
    if run.collision is None or expect.check is not None:  # the last decision before a failed check
        return None if expect.check is None else at(expect.time)
    if (number := moved_over(run)) is not None:
        return number
    # The last decision at which a careful driver who takes over avoids the collision. If there is none, or if the ego
    # braked for nothing, it is the decision at the time of the verdict.
    if expect.takeover and attribution.fault not in NEEDLESS:
        return at(expect.time - expect.takeover)
    return at(attribution.time or 0.0) if attribution.fault else None


def moved_over(run: Run) -> int | None:
    """Return the index of the decision that started a lane change for which the ego is at fault, or None."""
    trace, attribution = run.trace, run.attribution
    if attribution.fault != "entered-lane" or not trace.decision_ticks:
        return None
    last = max(bisect_right(trace.decision_ticks, attribution.tick or 0) - 1, 0)
    return _begun(trace, attribution.tick or 0, last)


def sentences_of(run: Run, expect: Expect) -> tuple[str, ...]:
    """Return the sentences that explain a run, including the start of a lane change for which the ego is at fault."""
    sentences, number = expect.sentences_on(run), moved_over(run)
    if not sentences or number is None:
        return sentences
    # A verdict does not know the decisions, so its sentence states only when the ego crossed the line.
    began = f"{run.trace.decision_ticks[number] / run.trace.physics_hz:.1f} s"
    is_drift = _drifted(run.trace, number, run.attribution.time or 0.0)
    did = f"drifted from {began}" if is_drift else f"began to change lanes at {began}"
    return (f"The ego {did} and {sentences[0].removeprefix('The ego ')}", *sentences[1:])


def deed_of(run: Run, sentences: Sequence[str]) -> str:
    """Return the sentence about what the ego did wrong, or an empty string if the ego is not at fault."""
    # a fixed object has only the last sentence
    if run.responsibility not in ("ego", "both") or len(sentences) < 2:
        return ""
    return sentences[0 if run.attribution.fault in (*NEEDLESS, "entered-lane") else -2]


def _drifted(trace: Trace, number: int, crossed: float) -> bool:
    # A drift takes a long time, and is as slow as wandering in the lane. An ego that has chosen another lane does not
    # drift.
    # `crossed` is the time at which the ego crosses the line [s].
    begin, end = trace.decision_ticks[number], round(crossed * trace.physics_hz)
    lane = _lane_of(trace.actions[number], None) if number < len(trace.actions) else None
    if lane not in (None, trace.ego[begin, LANE]) or end - begin < DRIFT_SECONDS * trace.physics_hz:
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
    (dx, dy), cos, sin = other[[X, Y]] - ego[[X, Y]], np.cos(turn), np.sin(turn)
    boxes = [
        (each[HEADING] - turn, *trace.sizes[index]) for each, index in ((ego, 0), (other, npc + 1))
    ]
    return placed(dx * cos + dy * sin, dy * cos - dx * sin, other[SPEED] - ego[SPEED], *boxes)


def placed(ahead: float, right: float, faster: float, *boxes: tuple[float, float, float]) -> str:
    """Describe a vehicle's position and speed relative to the ego."""
    # `ahead` and `right` are between the centres [m], and `faster` is in m/s. Each of the two boxes is a heading [rad],
    # a length and a width [m]. As in a verdict, the gap is between the boxes.
    gap = abs(ahead)
    for angle, length, width in boxes:
        gap -= (length * abs(np.cos(angle)) + width * abs(np.sin(angle))) / 2
    words = [f"{gap:.1f} m {'ahead' if ahead >= 0 else 'behind'}" if gap > 0 else "next to the ego"]
    words += (
        [f"{abs(right):.1f} m to the {'right' if right > 0 else 'left'}"]
        if abs(right) >= 0.05
        else []
    )
    pace = (
        f"{abs(faster):.1f} m/s {'faster' if faster > 0 else 'slower'}"
        if abs(faster) >= 0.05
        else "equally fast"
    )
    return ", ".join([*words, pace])


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
    return (
        vars(action)
        if hasattr(action, "__dict__") and (is_bare or is_dataclass(action))
        else action
    )


def text_of_any(action: Any) -> str:
    """Format an action, with three significant digits for each number."""
    plain = _plain(action)
    if isinstance(plain, float):
        return f"{plain:.3g}"
    if isinstance(plain, list):
        ends = "()" if isinstance(action, tuple) else "[]"
        return f"{ends[0]}{', '.join(map(text_of_any, plain))}{ends[1]}"
    if isinstance(plain, dict):
        if plain is action:
            return f"{{{', '.join(f'{part!r}: {text_of_any(value)}' for part, value in plain.items())}}}"
        return f"{type(action).__name__}({', '.join(f'{part}={text_of_any(value)}' for part, value in plain.items())})"
    return repr(plain)


def is_planners(action: Any) -> bool:
    """Return whether an action is a pair in SI units or a ``LaneCommand``."""
    return is_si(action) or type(action).__module__ == "pytest_pafot.world.kernel.action"


def _lane_of(action: Any, otherwise: float | None) -> Any:
    return action.lane if is_planners(action) and not is_si(action) else otherwise


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
        defaults = {} if is_si(action) else {field.name: field.default for field in fields(action)}
        return [
            name for name, value in parts.items() if name not in defaults or value != defaults[name]
        ]
    names = []
    for name, there in parts_of(other).items():
        here, (least, _) = parts[name], PARTS.get(name, (0.0, ""))
        is_number = isinstance(here, float) and isinstance(there, float)
        if abs(here - there) >= least if is_number else here != there:
            names.append(name)
    return names
