"""What the ego nearly had to answer for: the dangers of a run, judged as the collisions that they almost were.

Collisions that the ego answers for are rare in the runs of a good policy, and those of NPCs are not. A search that is
to find the rare ones needs to know which runs come near to one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from pytest_pafot.attribution.lane_changes import stretches
from pytest_pafot.attribution.mistakes import Mistake, mistake_with
from pytest_pafot.attribution.responsibility import Conflict, Dangers
from pytest_pafot.criticality import Encounters
from pytest_pafot.trace import Trace

NEAR_SECONDS = 1.5
"""The time to contact at which half of its risk is reached [s]: between normal and critical (van der Horst 1990)."""
NEAR_METRES = 1.0
"""The gap at which half of its risk is reached [m]."""


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


def near_misses(trace: Trace) -> tuple[NearMiss, ...]:
    """The worst near-miss of each mistake of the ego, in the order of their names.

    A danger lasts as long as both distances to an NPC are shorter than RSS asks for. It is judged by
    :func:`~pytest_pafot.attribution.responsibility.rss_rule`, as if the ego had touched the NPC when the
    danger was most severe. The danger that ended in the impact of the run is none of these.
    """
    by_severity = sorted(_all(trace), key=lambda each: (each.mistake, -each.severity))  # stable: of equals the first
    return tuple(next(group) for _, group in groupby(by_severity, key=lambda each: each.mistake))


def _all(trace: Trace) -> Iterator[NearMiss]:
    dangers = Dangers(trace)
    if not dangers.is_dangerous.any():
        return
    encounters = Encounters(trace)
    severity = (1 / (1 + encounters.ttc.T / NEAR_SECONDS) + 1 / (1 + encounters.gap.T / NEAR_METRES)) / 2
    for npc in range(len(trace.scenario.npcs)):
        for start, end in stretches(dangers.is_dangerous[:, npc]):
            if trace.collision is not None and trace.collision.npc == npc and end == len(severity):
                continue  # the impact itself
            tick = start + int(np.argmax(severity[start:end, npc]))
            mistake = mistake_with(npc, Conflict(dangers, npc, start, tick).attribution, dangers.frame)
            if mistake is not None:
                yield NearMiss(mistake=mistake, npc=npc, tick=tick, severity=float(severity[tick, npc]))
