"""What the ego nearly had to answer for: the dangers of a run, judged as the collisions that they almost were.

Collisions that the ego answers for are rare in the runs of a good policy, and those of NPCs are not. A search that is
to find the rare ones needs to know which runs come near to one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple, get_args

import numpy as np

from pytest_pafot.attribution.lane_changes import stretches
from pytest_pafot.attribution.mistakes import Mistake, mistake_with
from pytest_pafot.attribution.needless_braking import STANDING_SPEED, hard_braking
from pytest_pafot.attribution.responsibility import DISTANCES, Conflict, Fault, dangers_of
from pytest_pafot.criticality import Encounters
from pytest_pafot.model.trace import SPEED, Trace

NEAR_SECONDS = 1.5
"""The time to contact at which half of its risk is reached [s]: between normal and critical (van der Horst 1990)."""
NEAR_METRES = 1.0
"""The gap at which half of its risk is reached [m]."""

Floors = Mapping[Mistake, float]
"""Mistakes that matter, and of each the severity up to which a near-miss does not."""

ALL: Floors = MappingProxyType(dict.fromkeys(get_args(Mistake), 0.0))
"""Floors above which there is every near-miss."""
NONE: Floors = MappingProxyType({})
"""No mistake matters."""
BY_MISTAKE: Mapping[Mistake, Fault] = MappingProxyType(
    {
        "moved-into-side": "entered-lane",
        "moved-in-front": "entered-lane",
        "braked-for-nothing": "braked-for-nothing",
        "stopped-for-nothing": "stopped-for-nothing",
    }
)
"""The only fault that makes a mistake; the other one is made by several."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NearMiss:
    """A danger that no impact ended, though the ego would have answered for it.

    Attributes:
        mistake: of the ego, had they touched then.
        tick: of the greatest severity.
        severity: mean of the risks of the time to contact and of the gap of the boxes, 0 to 1.
    """

    mistake: Mistake
    npc: int
    tick: int
    severity: float


class Danger(NamedTuple):
    """A stretch of ticks, up to before ``end``, in which both distances to an NPC are shorter than RSS asks for."""

    npc: int
    start: int
    end: int
    tick: int  # of the greatest severity
    severity: float


def near_misses(trace: Trace, floors: Floors = ALL) -> tuple[NearMiss, ...]:
    """The worst near-miss of each mistake of the ego, in the order of their names.

    A danger lasts as long as both distances to an NPC are shorter than RSS asks for. It is judged by
    :func:`~pytest_pafot.attribution.responsibility.rss_rule`, as if the ego had touched the NPC when the
    danger was most severe. The danger that ended in the impact of the run is none of these.

    Args:
        floors: the mistakes that matter, and the severity from which on they do not. To judge is dear, and only what
            may be above its floor is judged.
    """
    return trace.reading(("near-misses", *floors.items()), lambda trace: _worst(trace, floors)) if floors else ()


def _worst(trace: Trace, floors: Floors) -> tuple[NearMiss, ...]:
    found: dict[Mistake, NearMiss] = {}
    possible = [each for each in floors if _is_possible(each, trace)]
    for danger in sorted(_dangers(trace) if possible else (), key=lambda each: -each.severity):  # of equals the first
        wanted = [each for each in possible if danger.severity > floors[each] and each not in found]
        if not wanted:
            break
        dangers, npc = dangers_of(trace), danger.npc
        conflict = Conflict(dangers, npc, danger.start, danger.tick)
        if any(conflict.may_be(BY_MISTAKE.get(each)) for each in wanted):
            mistake = mistake_with(npc, conflict.attribution, dangers.frame)
            if mistake in wanted:
                found[mistake] = NearMiss(mistake=mistake, npc=npc, tick=danger.tick, severity=danger.severity)
    return tuple(found[mistake] for mistake in sorted(found))


def _is_possible(mistake: Mistake, trace: Trace) -> bool:
    """Whether a run can have a mistake at all, by how the ego brakes."""
    if mistake == "braked-for-nothing":
        return hard_braking(trace, 0, 0, trace.ticks) is not None
    return mistake != "stopped-for-nothing" or not trace.ego[:, SPEED].min() > STANDING_SPEED


def _dangers(trace: Trace) -> list[Danger]:
    """All but that of the impact, in the order of the NPCs and of time."""
    passes = Encounters(trace).passes
    found = None if passes is None else passes.dangers(DISTANCES, trace.physics_hz, NEAR_SECONDS, NEAR_METRES)
    dangers = [Danger(*each) for each in found or ()]
    if found is None:  # the compiled pass does not answer
        is_dangerous, encounters = dangers_of(trace).is_dangerous, Encounters(trace)
        risks = 1 / (1 + encounters.ttc.T / NEAR_SECONDS), 1 / (1 + encounters.gap.T / NEAR_METRES)
        severity = (risks[0] + risks[1]) / 2
        for npc in range(is_dangerous.shape[1]):
            for start, end in stretches(is_dangerous[:, npc]):
                tick = start + int(np.argmax(severity[start:end, npc]))
                dangers.append(Danger(npc, start, end, tick, float(severity[tick, npc])))
    last = None if trace.collision is None else (trace.collision.npc, trace.ticks + 1)
    return [each for each in dangers if (each.npc, each.end) != last]
