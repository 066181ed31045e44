"""Who caused a collision, by written rules over the trace.

Source of the position rule: the fault rule in the code that the authors of PAFOT released; the paper itself
counts collisions without a split.
"""

from __future__ import annotations

from typing import Literal

from pytest_pafot.trace import Collision, Trace

Responsibility = Literal["ego", "npc", "none"]
"""``none`` where there was no collision."""

STANDING_SPEED = 0.1
"""Up to this speed [m/s] the ego counts as standing."""


def position_rule(trace: Trace) -> Responsibility:
    """The authors' rule: by where the NPC was at the impact.

    An ego at 0.1 m/s or less is never responsible; otherwise it is when the NPC was ahead of it, in cell 1, 2
    or 3; an NPC beside or behind the ego is responsible itself.
    """
    if trace.collision is None:
        return "none"
    if trace.collision.ego_speed <= STANDING_SPEED or trace.collision.cell.row <= 0:
        return "npc"
    return "ego"


def position_reason(trace: Trace) -> str:
    """Why :func:`position_rule` says what it says: the end of a sentence that begins with "because"."""
    collision = trace.collision
    if collision is None:
        return "there was no collision"
    if collision.ego_speed <= STANDING_SPEED:
        return f"the ego was standing ({collision.ego_speed:.1f} m/s) at the impact"
    return f"NPC {collision.npc} was {_place(collision)} the ego (cell {int(collision.cell)}) at the impact"


def _place(collision: Collision) -> str:
    return {1: "ahead of", 0: "beside", -1: "behind"}[collision.cell.row]
