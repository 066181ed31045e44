"""Whether NPCs that cross came as they were asked to, measured in the trace of a run.

An NPC that crosses has a slot relative to the ego, which counts when the NPC no longer adapts to the ego.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from pytest_pafot.criticality.zones import passages, times_expected
from pytest_pafot.model.trace import SPEED, Trace

SLOT = 0.3
"""The tolerance of a slot [s]."""
ADAPTING_UNTIL, WAITING = 3.0, 0.5
"""The time before its entry into the zone until which an NPC adapts to the ego's arrival [s], and the smallest share of
its speed to which it slows down for that; both are those of ``world/kernel/crossing.py``."""


@dataclass(frozen=True, slots=True)
class Asked:
    """What an NPC that crosses was asked for.

    Attributes:
        npc: index of the NPC.
        what: ``slot``; or ``zone`` if it did not come to its zone.
        asked: the slot that was asked [s]; NaN if it did not come.
        was: what it was [s]; NaN if it did not come.
    """

    npc: int
    what: str
    asked: float = math.nan
    was: float = math.nan

    @property
    def is_met(self) -> bool:
        """True if it was as asked."""
        return abs(self.was - self.asked) <= SLOT

    @property
    def words(self) -> str:
        """The words for it: ``slot asked 0.5 s, was 0.6 s``."""
        if self.what == "zone":
            return "the NPC did not come to its zone"
        return f"slot asked {self.asked:g} s, was {self.was:.1f} s"


def asked(trace: Trace) -> tuple[Asked, ...]:
    """Return what the crossing NPCs of a run were asked for; empty without them."""
    found: list[Asked] = []
    for npc, instruction in enumerate(trace.scenario.crossings):
        if instruction is not None and instruction.act == "pass":
            found += _of_crossing(trace, npc, instruction.slot)
    return tuple(found)


def _of_crossing(trace: Trace, npc: int, slot: float) -> Iterator[Asked]:
    """Yield the slot of an NPC, at the ego's speed when the NPC no longer adapted to the ego.

    An ego may answer in two ways that leave no slot to judge. It may wait for the NPC, which does not become slow
    enough to come after it. Or it may slow down in the zone, so that the NPC waits for it.
    """
    passage = passages(trace)[npc]
    if passage is None:
        return
    if passage.npc_enters == math.inf:
        is_broken_off = trace.collision is not None or trace.error is not None or trace.off_road_tick == trace.ticks
        if not is_broken_off:
            yield Asked(npc, "zone")
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
        yield Asked(npc, "slot", slot, was)
