"""What a vehicle did shortly before an event, in the few words that tell one kind of failure from another."""

from __future__ import annotations

import math
from typing import Literal

from pytest_pafot.trace import ACROSS, LANE, Trace, X, Y

Manoeuvre = Literal["lane-change", "lane-keeping"]

WINDOW_SECONDS = 4.0
"""How far back a lane change still belongs to the event [s]; one takes about two seconds at motorway speed."""

DISPLACEMENT = 1.0
"""How far sideways a vehicle that keeps its lane moves at most in that time [m]; half of the room beside it."""


def manoeuvre_before(trace: Trace, vehicle: int, tick: int) -> Manoeuvre:
    """Whether a vehicle (0: the ego, ``i + 1``: NPC ``i``) changed lanes shortly before a tick, or was doing so."""
    first = max(0, tick - round(WINDOW_SECONDS * trace.physics_hz))
    if trace.track is not None:
        across = trace.track[first : tick + 1, vehicle, ACROSS]
    else:
        states = trace.states[first : tick + 1, vehicle]
        heading = trace.lanes[max(int(states[-1, LANE]), 0)].heading
        across = states[:, Y] * math.cos(heading) - states[:, X] * math.sin(heading)
    return "lane-change" if float(abs(across - across[-1]).max()) > DISPLACEMENT else "lane-keeping"
