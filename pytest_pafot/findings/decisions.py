"""The decision of an ADS that could have avoided a failure: which one it is, and what it rests on."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np

from pytest_pafot.attribution.responsibility import DRIFTING, Fault, frame_of
from pytest_pafot.findings.finding import Expect
from pytest_pafot.model.trace import HEADING, LANE, OFFSET, SPEED, Trace, X, Y
from pytest_pafot.oracle.run import Run

PARTS = {
    "acceleration": (0.2, "{:z.1f} m/s^2"),
    "steering": (0.02, "{:z.2f} rad"),
    "speed": (0.2, "{:z.1f} m/s"),
    "lateral_acceleration": (0.2, "{:z.1f} m/s^2"),
    "lateral_jerk": (0.2, "{:z.1f} m/s^3"),
}
"""The parts of a planner's decision: the smallest difference that counts, and how each is shown."""
SHARE = 0.05
"""The smallest difference between two values of an action in an environment's own units."""
CENTRED = 0.25
"""The largest distance from the centre of a lane at which the ego drives along it [m]."""
ALONG = DRIFTING / 10
"""The sideways speed below which the ego drives along the road [m/s]."""
STEADY = 0.003
"""The sideways speed, or change of it from one decision to the next, that no steering causes [m/s]."""
DRIFT_SECONDS = 3.0
"""The least time of a drift to a line [s]: a change of lanes begins slowly, too, but is over the line earlier."""
NEEDLESS: tuple[Fault, ...] = ("braked-for-nothing", "stopped-for-nothing")
"""The faults of an ego that should not have braked."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Moment:
    """The last decision that could have avoided a failure: what the policy saw and answered, and what would change it.

    Attributes:
        time: time of the decision [s].
        npc: the vehicle that it is about, as an index in the scenario; None for none.
        seen: where the policy saw the vehicle; empty if that is unknown.
        was: where the vehicle was, if it is unknown whether the policy saw it; else empty.
        action: what it answered.
        hidden: what it answers with the vehicle hidden in this one decision: empty for the same, None if unknown.
        otherwise: the smallest change of the vehicle, of those tried, with which it answers otherwise, and that answer;
            empty if none of them changes the answer, None if none was tried.
        reference: what the reference answered, if the test has one and this is the first decision that differs.
        conditions: the conditions that the policy evaluated in this decision, each with its line in the source, its
            values and its outcome, by whom they are about: first this vehicle, then none or an unknown one, then
            others; an empty text if nothing is known of that. In a group, those that come out otherwise with that
            change are first, then the others, the last one first.
    """

    time: float
    npc: int | None
    seen: str = ""
    was: str = ""
    action: str = ""
    hidden: str | None = None
    otherwise: str | None = None
    reference: str = ""
    conditions: tuple[tuple[str, tuple[str, ...]], ...] = ()

    def __str__(self) -> str:
        whom, changed = f"NPC {self.npc}", [self.brief.removesuffix(".")]
        if self.hidden is not None and not self.reference:
            changed.insert(1, f"with {whom} hidden {self.hidden or 'the same'}")
        if self.otherwise == "" and not self.reference:
            changed.append(f"no change of {whom} that was tried changes it")
        return f"{'; '.join(changed)}."

    @property
    def brief(self) -> str:
        """The decision in a sentence, with the smallest change that changes it."""
        at = f"At {self.time:.1f} s"
        if self.reference:
            first = f"{at}, in the first decision that differs, the policy answered {self.action}"
            return f"{first}, the reference {self.reference}."
        saw = f"saw NPC {self.npc} {self.seen}, and " if self.seen else ""
        was = f"NPC {self.npc} was {self.was}, and " if self.was else ""
        otherwise = f"; with NPC {self.npc} {self.otherwise}" if self.otherwise else ""
        return f"{at} {was}the policy {saw}answered {self.action}{otherwise}."

    def condition_lines(self) -> list[str]:
        """Return the rows of the conditions, below whom they are about."""
        lines = []
        for whom, rows in self.conditions:
            lines += [*([f"{whom}:"] if whom else []), *(f"{'  ' if whom else ''}{row}" for row in rows)]
        return lines


def vehicle_of(run: Run, expect: Expect) -> int | None:
    """Return the NPC that a failure is about: the one that was hit, that a check names, or that was nearest then.

    None without such a vehicle, such as for a collision with a fixed object, or a failure that is no check.
    """
    if run.collision is not None and expect.check is None:
        return run.collision.npc
    if expect.npc is not None or expect.check is None:
        return expect.npc
    tick = min(round(expect.time * run.trace.physics_hz), run.trace.ticks)
    away = np.hypot(*(run.trace.states[tick, 1:, [X, Y]] - run.trace.ego[tick, [X, Y], None]))
    return None if np.isnan(away).all() or not away.size else int(np.nanargmin(away))


def deciding(run: Run, expect: Expect) -> int | None:
    """Return the number of the last decision that could have avoided a failure; None if none is known.

    For a collision, it is the last decision from which a careful driver who takes over avoids it; the ego may brake
    there, but too softly. If there is none, or the ego braked for nothing, it is the one at the time that the verdict
    names. For a change of lanes it is the one that began the motion, or turned it back. For a failed check it is the
    last one up to the check.
    """
    trace, attribution = run.trace, run.attribution
    ticks, hz = trace.decision_ticks, trace.physics_hz

    def at(time: float) -> int:
        return max(bisect_right([tick / hz for tick in ticks], time + 1e-6) - 1, 0)

    if not ticks:
        return None
    if run.collision is None or expect.check is not None:
        return None if expect.check is None else at(expect.time)
    if (number := moved_over(run)) is not None:
        return number
    if expect.takeover and attribution.fault not in NEEDLESS:
        return at(expect.time - expect.takeover)
    return at(attribution.time or 0.0) if attribution.fault else None


def moved_over(run: Run) -> int | None:
    """Return the number of the decision that began a change of lanes by which the ego is at fault; None without one."""
    trace, attribution = run.trace, run.attribution
    if attribution.fault != "entered-lane" or not trace.decision_ticks:
        return None
    last = max(bisect_right(trace.decision_ticks, attribution.tick or 0) - 1, 0)
    return _begun(trace, attribution.tick or 0, last)


def beginning(run: Run) -> str:
    """Return in a few words when the ego began the change of lanes, or drift, by which it is at fault, else nothing."""
    if (number := moved_over(run)) is None:
        return ""
    began = f"{run.trace.decision_ticks[number] / run.trace.physics_hz:.1f} s"
    is_drift = _drifted(run.trace, number, run.attribution.time or 0.0)
    return f"the ego drifted from {began} on" if is_drift else f"the ego began to change lanes at {began}"


def fact_on(run: Run) -> str:
    """Return in a few words what the ego did that decides, for a headline; empty if it is not at fault.

    For a change of lanes, or a drift over the line, it is the time of the decision that began it, by
    :func:`moved_over`; else whether and how it braked.
    """
    if run.collision is None or run.responsibility not in ("ego", "both") or not run.attribution.sentences:
        return ""
    if began := beginning(run):
        return f"{began}, over the line at {run.attribution.time or 0.0:.1f} s"
    told = run.attribution.sentences[0 if run.attribution.fault in NEEDLESS else -1]
    return f"{told[:1].lower()}{told[1:]}".removesuffix(".")


def _drifted(trace: Trace, number: int, crossed: float) -> bool:
    """Return whether the ego only drifted from a decision on to a line: for long, and no faster than a vehicle wanders.

    ``crossed`` is when the ego was over the line [s]. An ego that has answered another lane changes lanes.
    """
    begin, end = trace.decision_ticks[number], round(crossed * trace.physics_hz)
    lane = _lane_of(trace.actions[number], None) if number < len(trace.actions) else None
    if lane not in (None, trace.ego[begin, LANE]) or end - begin < DRIFT_SECONDS * trace.physics_hz:
        return False
    return bool(abs(frame_of(trace).drift[0, begin + 1 : end + 1].mean()) < DRIFTING)


def _begun(trace: Trace, tick: int, number: int) -> int:
    """Return the number of the decision that began the motion with which the ego crosses a line at a tick.

    ``number`` is that of the last decision up to the tick. After a motion to the other side, it is the decision that
    turned back.
    """
    ticks = trace.decision_ticks
    drifts = frame_of(trace).drift[0]
    side = 1.0 if drifts[tick] > 0 else -1.0
    lanes = [_lane_of(action, math.nan) for action in trace.actions[: number + 1]]
    is_across = [side * (lane - trace.ego[tick, LANE]) >= 1 for lane in lanes]
    if any(is_across):  # The ego is steered softly to an answered lane, so its motion shows the decision late.
        while not is_across[number]:
            number -= 1
        while number and is_across[number - 1]:
            number -= 1
        return number
    drift = (side * drifts[ticks]).tolist()
    off_centre = np.abs(trace.track_of(0)[ticks, OFFSET])
    while number and drift[number] >= ALONG:
        number -= 1
    # The ego turned back while it still moved to the other side, and turned off before it moved visibly.
    while number and drift[number - 1] < drift[number] - STEADY:
        if -ALONG < drift[number] < STEADY and off_centre[number] < CENTRED:
            break
        number -= 1
    return number


def seen_of(trace: Trace, npc: int, number: int) -> str:
    """Return where a vehicle was at a decision, relative to the ego."""
    ego, other = trace.states[trace.decision_ticks[number], [0, npc + 1]]
    turn = trace.road.direction_of_places(trace.decision_ticks[number])
    (dx, dy), cos, sin = other[[X, Y]] - ego[[X, Y]], np.cos(turn), np.sin(turn)
    boxes = [(each[HEADING] - turn, *trace.sizes[index]) for each, index in ((ego, 0), (other, npc + 1))]
    return placed(dx * cos + dy * sin, dy * cos - dx * sin, other[SPEED] - ego[SPEED], *boxes)


def placed(ahead: float, right: float, faster: float, *boxes: tuple[float, float, float]) -> str:
    """Return a place relative to the ego in words, with the gap between two boxes along the road as a verdict has it.

    ``ahead`` and ``right`` are between the centres [m], ``faster`` is in m/s; a box is a heading [rad], a length and a
    width [m].
    """
    gap = abs(ahead)
    for angle, length, width in boxes:
        gap -= (length * abs(np.cos(angle)) + width * abs(np.sin(angle))) / 2
    words = [f"{gap:.1f} m {'ahead' if ahead >= 0 else 'behind'}" if gap > 0 else "next to the ego"]
    words += [f"{abs(right):.1f} m to the {'right' if right > 0 else 'left'}"] if abs(right) >= 0.05 else []
    pace = f"{abs(faster):.1f} m/s {'faster' if faster > 0 else 'slower'}" if abs(faster) >= 0.05 else "as fast"
    return ", ".join([*words, pace])


def differ(action: Any, other: Any) -> bool:
    """Return whether two actions differ by more than a vehicle far away changes in the output of a network."""
    if other is None or type(action) is not type(other):
        return action is not other
    if is_planners(action):
        return bool(told_parts(action, other))
    here, there = _plain(action), _plain(other)
    if isinstance(here, float):
        return bool(abs(here - there) >= SHARE)
    if isinstance(here, list):
        return len(here) != len(there) or any(map(differ, here, there))
    if isinstance(here, dict):
        return here.keys() != there.keys() or any(differ(here[name], there[name]) for name in here)
    return repr(here) != repr(there)


def _plain(action: Any) -> Any:
    """Return an action, or a part of one, as a float, a list, a dict of its parts, or as it is."""
    if isinstance(action, (np.ndarray, np.generic)):
        return action.tolist()
    if isinstance(action, tuple):
        return list(action)
    is_bare = repr(action) == object.__repr__(action)  # which has the address of the object
    return vars(action) if hasattr(action, "__dict__") and (is_bare or is_dataclass(action)) else action


def text_of_any(action: Any) -> str:
    """Return an action of any kind in words, with three digits of each number."""
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
    """Return whether an action is a planner's: a pair in SI units, or a :class:`pytest_pafot.Drive`."""
    return is_si(action) or type(action).__module__ == "pytest_pafot.world.kernel.action"


def _lane_of(action: Any, otherwise: float | None) -> Any:
    return action.lane if is_planners(action) and not is_si(action) else otherwise


def is_si(action: Any) -> bool:
    """Return whether an action is a pair of acceleration [m/s^2] and steering angle [rad], as planners return it."""
    return type(action) is tuple and len(action) == 2 and all(isinstance(each, float) for each in action)


def parts_of(action: Any) -> dict[str, Any]:
    """Return the named parts of a planner's decision, which is a pair or a :class:`pytest_pafot.Drive`."""
    if is_si(action):
        return dict(zip(("acceleration", "steering"), action, strict=True))
    return {field.name: getattr(action, field.name) for field in fields(action)}


def told_parts(action: Any, other: Any) -> list[str]:
    """Return the names of the parts in which a planner's decision differs from another one, else from its defaults."""
    parts = parts_of(action)
    if type(action) is not type(other) or is_si(action) is not is_si(other):
        defaults = {} if is_si(action) else {field.name: field.default for field in fields(action)}
        return [name for name, value in parts.items() if name not in defaults or value != defaults[name]]
    names = []
    for name, there in parts_of(other).items():
        here, (least, _) = parts[name], PARTS.get(name, (0.0, ""))
        is_number = isinstance(here, float) and isinstance(there, float)
        if abs(here - there) >= least if is_number else here != there:
            names.append(name)
    return names
