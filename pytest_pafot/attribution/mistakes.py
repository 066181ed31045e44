"""What the ego did wrong in a collision that it answers for, in the few words that tell one defect from another.

A verdict's *fault* is the branch of the rules that blames the ego. In a lane change that is one for all defects: where
the other was, when the ego had to take it into account, tells them apart.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal

from pytest_pafot.attribution.responsibility import Attribution, Fault, frame_of, rss_rule
from pytest_pafot.model.crossings import Origin
from pytest_pafot.model.trace import ACROSS, LANE, Trace, X, Y

# What a vehicle did shortly before an event, in the few words that tell one kind of failure from another.

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


Mistake = Literal[
    "kept-no-distance",
    "moved-into-side",
    "moved-in-front",
    "braked-for-nothing",
    "stopped-for-nothing",
    "did-not-give-way-left",
    "did-not-give-way-right",
    "did-not-give-way-ahead",
    "did-not-give-way-behind",
    "entered-taken-zone",
]
"""It did not keep off a vehicle ahead, which it followed, behind which it changed lanes, or which had cut in; it
changed lanes into a vehicle beside it, or into the way of one behind; it braked hard, or stopped, with nothing in its
way; it did not give way to one that came from the left, from the right, from ahead or from behind; it drove with
priority into a zone in which somebody visibly was."""

NOT_GIVEN_WAY: Mapping[Origin, Mistake] = MappingProxyType(
    {
        "left": "did-not-give-way-left",
        "right": "did-not-give-way-right",
        "ahead": "did-not-give-way-ahead",
        "behind": "did-not-give-way-behind",
    }
)
"""An ego that looks to one side alone gives no way to who comes from the other: where from tells defects apart."""

CLOSE_AHEAD = 2.0
"""Who begins no further ahead, between the boxes along the road, is beside the ego that changes lanes [m]."""

BY_FAULT: Mapping[Fault, Mistake] = MappingProxyType(
    {
        "leader-unanswered": "kept-no-distance",
        "cut-in-unanswered": "kept-no-distance",
        "braked-for-nothing": "braked-for-nothing",
        "stopped-for-nothing": "stopped-for-nothing",
        "entered-taken-zone": "entered-taken-zone",
    }
)
"""Those that the fault alone tells; one that entered a lane, or did not give way, is told by where the other was."""


def mistake(trace: Trace, attribution: Attribution) -> Mistake | None:
    """What the ego did wrong in a run that ended in a collision, by the verdict; None where it does not answer.

    An ego that entered a lane is judged at the verdict's moment, when it came over the line: the other is ahead when
    there are more than 2 m between the boxes along the road, behind when it is further back than level, else beside.
    """
    if trace.collision is None or attribution.fault is None or attribution.tick is None:
        return None
    if attribution.fault in BY_FAULT:
        return BY_FAULT[attribution.fault]
    zone = trace.zones[trace.collision.npc] if trace.zones else None
    if attribution.fault == "did-not-give-way":
        return None if zone is None else NOT_GIVEN_WAY[zone.origin]
    frame, npc, tick = frame_of(trace), trace.collision.npc, attribution.tick
    ahead, both = frame.ahead[npc, tick], frame.half_along[0, tick] + frame.half_along[npc + 1, tick]
    if ahead > both + CLOSE_AHEAD:
        return "kept-no-distance"
    return "moved-in-front" if ahead < -both else "moved-into-side"


def mistake_of(trace: Trace) -> Mistake | None:
    """What the ego did wrong in a run, by the rule of attribution."""
    return trace.reading("mistake", lambda trace: mistake(trace, rss_rule(trace)))
