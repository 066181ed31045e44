"""The moment of a finding: what a policy that was asked again says of the decision that could have avoided it."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping
from dataclasses import is_dataclass
from typing import Any

import numpy as np

from pytest_pafot.findings.decisions import (
    HARDER,
    PARTS,
    Moment,
    braking_of,
    differ,
    is_si,
    parts_of,
    placed,
    seen_of,
    told_parts,
)
from pytest_pafot.model.sight import Sight
from pytest_pafot.model.trace import Trace
from pytest_pafot.world.driving.shadow import Aside, changed
from pytest_pafot.world.kernel.action import possible_acceleration, possible_steering
from pytest_pafot.world.kernel.observation import Observation

LITTLE = {"acceleration": HARDER, "steering": 0.05}
"""The least differences of an acceleration [m/s^2] and a steering angle [rad] with which a decision is another one."""
POSSIBLE = {"acceleration": possible_acceleration, "steering": possible_steering}
"""The parts of a planner's decision with limits, and the functions that limit them to what an ego can do."""


def moment_of(
    trace: Trace,
    npc: int,
    number: int,
    whole: Aside,
    without_it: Aside,
    ask: Callable[[Any], Aside | None],
    sight: Sight | None = None,
) -> Moment:
    """Return what a policy saw, answered and would have answered at a decision.

    ``ask`` returns the decisions of a fresh policy that sees something else at this one; None if it cannot be asked.
    ``sight`` is the policy's sight; None for perfect sight.
    """
    seen, action = whole.at, whole.of(number)
    is_planner = isinstance(seen, Observation)
    where = ""
    if is_planner and npc in seen.ids:
        ego, other = seen.ego, seen.others[seen.ids.index(npc)]
        boxes = ((each.heading, each.length, each.width) for each in (ego, other))
        where = placed(other.x - ego.x, other.y - ego.y, other.speed - ego.speed, *boxes)
    elif is_planner or pickle.dumps(seen) == pickle.dumps(without_it.at):
        where = "nowhere"
    elif sight is None or sight.is_exact:  # otherwise only the environment knows where it seemed to be
        where = seen_of(trace, npc, number)
    hidden = otherwise = None
    tries = [] if is_planner else [("", without_it.at)]
    if is_planner and npc in seen.ids:
        tries = [(words, changed(seen, npc, by)) for words, by in _changes(seen, npc)]
    for words, instead in tries:
        aside = ask(instead)
        # Only a policy that decides as the run's until there says what the run's would answer: one that keeps state
        # in a module or a class still has that of other runs.
        if aside is None or any(differ(each, aside.of(before)) for before, each in enumerate(trace.actions[:number])):
            hidden = otherwise = None
            break
        answer = aside.of(number)
        if not words:
            hidden = text_of(answer, action) if differ(action, answer) else ""
            otherwise = "" if is_planner else None
        elif _is_other(action, answer):
            otherwise = f"{words} {text_of(answer, action)}"
            break
    time = round(trace.decision_ticks[number] / trace.physics_hz, 3)
    return Moment(time=time, npc=npc, seen=where, action=text_of(action), hidden=hidden, otherwise=otherwise)


def braked_for(
    number: int, whole: Aside, others: Mapping[int, Aside], ask: Callable[[Any], Aside | None], *, is_needless: bool
) -> int | None:
    """Return the vehicle on which it depends most that a policy brakes at a decision, or does not; None if on none.

    Each vehicle is hidden in this one decision. ``others`` has the decisions of a policy without each of them, and
    ``is_needless`` is whether the policy should not have braked. Of another policy than a planner it is not known how
    much it brakes, so that there any other decision counts, and only if it should not have braked.
    """
    action, found, largest = whole.of(number), None, 0.0
    for npc, without_it in others.items():
        aside = ask(without_it.at)
        if aside is None or aside.of(number) is None:
            continue
        answer = aside.of(number)
        change = (braking_of(answer) - braking_of(action)) * (-1.0 if is_needless else 1.0)
        if is_needless and not isinstance(whole.at, Observation) and differ(action, answer):
            change = HARDER
        if change >= HARDER and change > largest:
            found, largest = npc, change
    return found


def _is_other(action: Any, other: Any) -> bool:
    """Return whether an action is another decision, and not a little more or less of the same."""
    if type(action) is not type(other) or not (is_si(action) or is_dataclass(action)):
        return differ(action, other)
    here, there = parts_of(action), parts_of(other)

    def is_little(name: str) -> bool:
        if name not in LITTLE or here[name] is None or there[name] is None:
            return False
        return abs(POSSIBLE[name](here[name]) - POSSIBLE[name](there[name])) < LITTLE[name]

    return not all(is_little(name) for name in told_parts(action, other))


def _changes(seen: Observation, npc: int) -> list[tuple[str, tuple[float, float, float] | None]]:
    """Return what is tried of a vehicle, the smallest first: words, and additions to x, y and speed; None hides it."""
    other = seen.others[seen.ids.index(npc)]
    gap = other.x - seen.ego.x
    found: list[tuple[float, str, tuple[float, float, float] | None]] = [(0.0, "", None)]
    away, outwards = (1.0 if gap >= 0 else -1.0), (1.0 if other.y >= seen.ego.y else -1.0)
    for size in (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0):
        found.append((size, f"{size:g} m further away", (away * size, 0.0, 0.0)))
        if size < abs(gap):
            found.append((size, f"{size:g} m nearer", (-away * size, 0.0, 0.0)))
    for size in (0.25, 0.5, 1.0, 2.0, 4.0):
        found.append((4 * size, f"{size:g} m further to the side", (0.0, outwards * size, 0.0)))
        found.append((4 * size, f"{size:g} m less to the side", (0.0, -outwards * size, 0.0)))
    for size in (0.5, 1.0, 2.0, 4.0, 8.0, 16.0):
        found.append((2 * size, f"{size:g} m/s faster", (0.0, 0.0, size)))
        if size <= other.speed:
            found.append((2 * size, f"{size:g} m/s slower", (0.0, 0.0, -size)))
    return [(words, by) for _, words, by in sorted(found, key=lambda each: each[0])]


def text_of(action: Any, other: Any = None) -> str:
    """Describe an action; of a planner's, the parts in which it differs from another action, or from defaults."""
    if action is None:
        return "no decision"
    if not (is_si(action) or is_dataclass(action)):
        return f"{action.tolist() if isinstance(action, (np.ndarray, np.generic)) else action!r}"[:80]
    parts, shown = parts_of(action), []
    for name in told_parts(action, other):
        least, form = PARTS.get(name, (0.0, "{}"))
        if parts[name] is None or (other is None and name == "steering" and abs(parts[name]) < least):
            continue
        value, driven = form.format(parts[name]), form.format(POSSIBLE.get(name, lambda same: same)(parts[name]))
        limit = f", limited to {driven.split()[0]}" if driven != value else ""
        shown.append(f"{name.replace('_', ' ')} {value}{limit}")
    return ", ".join(shown)
