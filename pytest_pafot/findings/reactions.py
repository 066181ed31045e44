"""What an ADS answers to: its decisions in a failing run, and in the same run with one vehicle hidden from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, Self

import numpy as np

PARTS = {
    "acceleration": (0.2, "{:.1f} m/s^2"),
    "steering": (0.02, "{:.2f} rad"),
    "speed": (0.2, "{:.1f} m/s"),
    "lateral_acceleration": (0.2, "{:.1f} m/s^2"),
    "lateral_jerk": (0.2, "{:.1f} m/s^3"),
}
"""The parts of a planner's decision: the smallest difference that counts, and how each is shown."""
SHARE = 0.05
"""The smallest difference between two values of an action in an environment's own units."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reaction:
    """The first decision of an ADS that is another one if a vehicle is hidden from it.

    Attributes:
        npc: the NPC's index in the scenario.
        time: time of the decision [s]; None if all decisions until the event are the same.
        before: time from this decision to the event [s].
        action: the action in the failing run.
        hidden: the action at the same time with the vehicle hidden.
        unseen: True if the observations until the event are the same with the vehicle hidden, too, so that the ADS
            could not have reacted; False if they are others, or if that is unknown.
    """

    npc: int
    time: float | None = None
    before: float = 0.0
    action: str = ""
    hidden: str = ""
    unseen: bool = False

    @classmethod
    def of(
        cls, npc: int, actions: Sequence[Any], hidden: Sequence[Any], *, times: Sequence[float], until: float
    ) -> Self:
        """Compare the decisions of a failing run with those of the run in which an NPC is hidden.

        Args:
            npc: the NPC's index in the scenario.
            actions: the actions of the failing run, one per decision.
            hidden: the actions of the other run.
            times: the time of each decision of the failing run [s].
            until: time of the event [s]; later decisions do not count.
        """
        for number, (action, at) in enumerate(zip(actions, times, strict=False)):
            if at > until + 1e-9:
                break
            other = hidden[number] if number < len(hidden) else None
            if _differ(action, other):
                time = round(at, 3)
                before, shown = round(until - time, 3), _text(action, other)
                return cls(npc=npc, time=time, before=before, action=shown, hidden=_text(other, action))
        return cls(npc=npc)

    def __str__(self) -> str:
        if self.unseen:
            return f"never reacts to NPC {self.npc}, which is in none of its observations"
        if self.time is None:
            return f"never reacts to NPC {self.npc}: with it hidden, all decisions are the same"
        when = f"first at {self.time:.1f} s, {self.before:.1f} s before the event"
        return f"reacts to NPC {self.npc}, {when}: {self.action}; with it hidden {self.hidden}"


def _differ(action: Any, other: Any) -> bool:
    """Return whether two actions differ by more than a vehicle far away changes in the output of a network."""
    if other is None or type(action) is not type(other):
        return True
    if is_si(action) or is_dataclass(action):
        return bool(_told(action, other))
    if isinstance(action, (float, np.ndarray, np.floating)) and np.asarray(action).dtype.kind == "f":
        is_like = np.shape(action) == np.shape(other)
        return not is_like or bool(np.max(np.abs(np.subtract(action, other)), initial=0) >= SHARE)
    return not bool(np.array_equal(action, other)) if isinstance(action, np.ndarray) else repr(action) != repr(other)


def is_si(action: Any) -> bool:
    """Return whether an action is a pair of acceleration [m/s^2] and steering angle [rad], as planners return it."""
    return type(action) is tuple and len(action) == 2 and all(isinstance(each, float) for each in action)


def _parts(action: Any) -> dict[str, Any]:
    """Return the named parts of a planner's decision, which is a pair or a :class:`pytest_pafot.Drive`."""
    if is_si(action):
        return dict(zip(("acceleration", "steering"), action, strict=True))
    return {field.name: getattr(action, field.name) for field in fields(action)}


def _told(action: Any, other: Any) -> list[str]:
    """Return the names of the parts in which a planner's decision differs from another one; all if that is None."""
    parts = _parts(action)
    if type(action) is not type(other) or is_si(action) is not is_si(other):
        return list(parts)
    names = []
    for name, there in _parts(other).items():
        here, (least, _) = parts[name], PARTS.get(name, (0.0, ""))
        is_number = isinstance(here, float) and isinstance(there, float)
        if abs(here - there) >= least if is_number else here != there:
            names.append(name)
    return names


def _text(action: Any, other: Any) -> str:
    """Describe an action; of a planner's, only the parts in which it differs from the other action."""
    if action is None:
        return "no decision"
    if not (is_si(action) or is_dataclass(action)):
        return f"{action.tolist() if isinstance(action, (np.ndarray, np.generic)) else action!r}"[:80]
    parts, shown = _parts(action), []
    for name in _told(action, other):
        _, form = PARTS.get(name, (0.0, "{}"))
        if parts[name] is not None:
            shown.append(f"{name.replace('_', ' ')} {form.format(parts[name])}")
    return ", ".join(shown)
