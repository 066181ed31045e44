"""The ego's mistake in a collision that it is responsible for.

A verdict's *fault* is the rule by which the ego is responsible. All lane changes have the same fault. They become
different mistakes, in a few words that distinguish one defect from another, by the place of the other vehicle at the
time when the ego had to take that vehicle into account.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Literal

from pytest_pafot.attribution.responsibility import (
    NEXT_TO,
    Attribution,
    Fault,
    Mistake,
    frame_of,
    rss_rule,
)
from pytest_pafot.model.crossings import Origin
from pytest_pafot.model.trace import Trace

# The manoeuvre of a vehicle shortly before an event, in a few words that distinguish kinds of failures.

Manoeuvre = Literal["lane-change", "lane-keeping"]

WINDOW_SECONDS = 4.0
"""The time before an event in which a lane change belongs to the event [s]; a lane change takes about 2 s at motorway
speed."""

DISPLACEMENT = 1.0
"""The largest sideways move of a vehicle that keeps its lane, within ``WINDOW_SECONDS`` [m]; it is half of the free
width of a lane."""


def manoeuvre_before(trace: Trace, vehicle: int, tick: int) -> Manoeuvre:
    """Return whether a vehicle (0: the ego, ``i + 1``: NPC ``i``) changed lanes at a tick or shortly before."""
    first = max(0, tick - round(WINDOW_SECONDS * trace.physics_hz))
    return "lane-change" if trace.road.displacement(vehicle, first, tick) > DISPLACEMENT else "lane-keeping"


LANE_CHANGES: tuple[Mistake, ...] = ("kept-no-distance", "moved-into-side", "moved-in-front")
"""The mistakes of an ego that entered a lane."""

NOT_GIVEN_WAY: Mapping[Origin, Mistake] = MappingProxyType(
    {
        "left": "did-not-give-way-left",
        "right": "did-not-give-way-right",
        "ahead": "did-not-give-way-ahead",
        "behind": "did-not-give-way-behind",
    }
)
"""The mistake by the side that the other vehicle came from, because a policy may look only to one side."""

BY_FAULT: Mapping[Fault, Mistake] = MappingProxyType(
    {
        "leader-unanswered": "kept-no-distance",
        "cut-in-unanswered": "kept-no-distance",
        "braked-for-nothing": "braked-for-nothing",
        "stopped-for-nothing": "stopped-for-nothing",
        "entered-taken-zone": "entered-taken-zone",
    }
)
"""The mistake by the fault. The two other faults, a lane change and not giving way, have several mistakes each, by the
place of the other vehicle."""


def mistake(trace: Trace, attribution: Attribution) -> Mistake | None:
    """Return the ego's mistake in a collision by the verdict; None if the ego is not responsible.

    If the ego entered a lane, the mistake depends on the place of the other vehicle when the ego crossed the line. The
    other vehicle is ahead if there are more than 2 m between the boxes along the road. It is behind if its box is
    entirely behind the ego's. Otherwise it is next to the ego.
    """
    npc = None if trace.collision is None else trace.collision.npc
    if npc is None or attribution.fault is None or attribution.tick is None:
        return None
    if attribution.fault in BY_FAULT:
        return BY_FAULT[attribution.fault]
    zone = trace.zones[npc] if trace.zones else None
    if attribution.fault == "did-not-give-way":
        return None if zone is None else NOT_GIVEN_WAY[zone.origin]
    frame, tick = frame_of(trace), attribution.tick
    ahead, both = frame.ahead[npc, tick], frame.half_lengths(npc)[tick]
    if ahead > both + NEXT_TO:
        return "kept-no-distance"
    return "moved-in-front" if ahead < -both else "moved-into-side"


def attributed(trace: Trace) -> Attribution:
    """Return the verdict of :func:`rss_rule` on a run's collision, together with the ego's mistake in it."""
    found = rss_rule(trace)
    return found if found.fault is None else replace(found, mistake=mistake(trace, found))


def decided(found: Attribution, seconds: float | None) -> Attribution:
    """Return a contested verdict as a careful driver decides it: whether the ego had time that ran into an NPC.

    ``seconds`` is the latest takeover that avoids the collision [s before the impact]. If there is one, both are
    responsible; at 0, the NPC is. None stands for a world that cannot say, so the verdict stays.
    """
    if found.contested is None or seconds is None:
        return found
    if not seconds:
        return replace(found, responsibility="npc", fault=None, mistake=None, takeover=seconds)
    fault = found.contested
    return replace(found, responsibility="both", fault=fault, mistake=BY_FAULT[fault], takeover=seconds)
