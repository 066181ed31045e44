"""The ego's driving error in a collision for which it is responsible."""

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

# The manoeuvre of a vehicle shortly before an event, which distinguishes kinds of failures.
Manoeuvre = Literal["lane-change", "lane-keeping"]

# A lane change belongs to an event that follows within this time [s]. At motorway speed, a lane change takes about 2 s.
WINDOW_SECONDS = 4.0

# A vehicle keeps its lane if it moves sideways by at most this distance within WINDOW_SECONDS [m], half of the free
# width of a lane.
DISPLACEMENT = 1.0


def manoeuvre_before(trace: Trace, vehicle: int, tick: int) -> Manoeuvre:
    """Return a vehicle's manoeuvre at a tick or shortly before it. Vehicle 0 is the ego, ``i + 1`` is NPC ``i``."""
    first = max(0, tick - round(WINDOW_SECONDS * trace.physics_hz))
    return (
        "lane-change"
        if trace.road.displacement(vehicle, first, tick) > DISPLACEMENT
        else "lane-keeping"
    )


# The mistakes of an ego that entered a lane.
LANE_CHANGES: tuple[Mistake, ...] = ("kept-no-distance", "moved-into-side", "moved-in-front")

# The mistake depends on the side that the other vehicle came from, because a policy may look to only one side.
NOT_GIVEN_WAY: Mapping[Origin, Mistake] = MappingProxyType(
    {
        "left": "did-not-give-way-left",
        "right": "did-not-give-way-right",
        "ahead": "did-not-give-way-ahead",
        "behind": "did-not-give-way-behind",
    }
)

# The faults with only one mistake. The mistake of the other two faults, a lane change and not giving way, depends on
# the position of the other vehicle.
BY_FAULT: Mapping[Fault, Mistake] = MappingProxyType(
    {
        "leader-unanswered": "kept-no-distance",
        "cut-in-unanswered": "kept-no-distance",
        "braked-for-nothing": "braked-for-nothing",
        "stopped-for-nothing": "stopped-for-nothing",
        "entered-taken-zone": "entered-taken-zone",
    }
)


def mistake(trace: Trace, attribution: Attribution) -> Mistake | None:
    """Return the ego's mistake in a collision, or None if the ego is not responsible."""
    npc = None if trace.collision is None else trace.collision.npc
    if npc is None or attribution.fault is None or attribution.tick is None:
        return None
    if attribution.fault in BY_FAULT:
        return BY_FAULT[attribution.fault]
    zone = trace.zones[npc] if trace.zones else None
    if attribution.fault == "did-not-give-way":
        return None if zone is None else NOT_GIVEN_WAY[zone.origin]
    frame, tick = frame_of(trace), attribution.tick
    # When the ego crossed the line, the other vehicle was ahead if the gap was above NEXT_TO. It was behind if it was
    # completely behind the ego.
    ahead, both = frame.ahead[npc, tick], frame.half_lengths(npc)[tick]
    if ahead > both + NEXT_TO:
        return "kept-no-distance"
    return "moved-in-front" if ahead < -both else "moved-into-side"


def attribute_collision(trace: Trace) -> Attribution:
    """Return the verdict of :func:`rss_rule` on a run's collision, together with the ego's mistake."""
    found = rss_rule(trace)
    return found if found.fault is None else replace(found, mistake=mistake(trace, found))


def decide_contested(found: Attribution, seconds: float | None) -> Attribution:
    """Return the verdict. If it is contested, a careful driver's latest takeover decides it.

    ``seconds`` is the time of that takeover [s before the impact]; 0 if none avoids the collision, None if unknown.
    """
    if found.contested is None or seconds is None:
        return found
    # If no takeover helps, the ego had no time. If one does, the ego shares the responsibility.
    if not seconds:
        return replace(found, responsibility="npc", fault=None, mistake=None, takeover=seconds)
    fault = found.contested
    return replace(
        found, responsibility="both", fault=fault, mistake=BY_FAULT[fault], takeover=seconds
    )
