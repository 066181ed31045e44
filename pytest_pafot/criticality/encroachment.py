"""Post-encroachment time: how narrowly two vehicles missed each other in time.

Source: Allen, Shin, Cooper, "Analysis of traffic conflicts and collisions", Transportation Research Record 667,
1978: the time between one road user leaving a place and another arriving at it.
"""

from __future__ import annotations

import numpy as np

from pytest_pafot.criticality.boxes import Boxes, overlaps, relate
from pytest_pafot.criticality.measures import Encounters
from pytest_pafot.trace import FloatArray, Trace


def post_encroachment_time(trace: Trace, *, horizon: float = 10.0) -> FloatArray:
    """Shortest time between one of ego and NPC leaving a place and the other arriving at it [s], shape [NPCs].

    Lower is worse; 0 at overlap, infinite where nobody arrives within ``horizon`` seconds. The place is any: the
    result is the smallest lag at which the box of one, where it is now, overlaps the box of the other, where it
    was before. For a crossing that is the usual measure at its conflict area, for following the net time gap.
    Lags are whole physics ticks, so that it exceeds the exact time by up to one tick.

    Args:
        trace: the run.
        horizon: longest time looked for [s]; the work grows with it.
    """
    boxes = Encounters(trace).boxes
    lags = range(min(int(horizon * trace.physics_hz), trace.ticks) + 1)
    met = [
        next((lag for lag in lags if _meets(boxes, 0, npc, lag) or _meets(boxes, npc, 0, lag)), np.inf)
        for npc in range(1, len(boxes.x))
    ]
    return np.array(met) / trace.physics_hz


def _meets(boxes: Boxes, first: int, second: int, lag: int) -> bool:
    """Whether ``second`` ever is, ``lag`` ticks later, where ``first`` was."""
    ticks = boxes.x.shape[1]
    before = boxes.part(slice(first, first + 1), slice(0, ticks - lag))
    after = boxes.part(slice(second, second + 1), slice(lag, ticks))
    # Most lags are settled by the circles around the boxes, at a fraction of the cost.
    reach = np.hypot(before.half_length, before.half_width) + np.hypot(after.half_length, after.half_width)
    if not ((after.x - before.x) ** 2 + (after.y - before.y) ** 2 <= reach**2).any():
        return False
    return bool(overlaps(relate(before, after)).any())
