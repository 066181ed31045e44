"""The ego's mistake in a collision that it is responsible for, and whether a driver that takes over avoids it.

A verdict's *fault* is the rule by which the ego is responsible. All lane changes have the same fault. They become
different mistakes, in a few words that distinguish one defect from another, by the place of the other vehicle at the
time when the ego had to take that vehicle into account. The driver that takes over brakes, or is a reference driver.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from pytest_pafot.attribution.responses import FOLLOWING, avoidance_sentence
from pytest_pafot.attribution.responsibility import Attribution, Fault, Mistake, frame_of, rss_rule
from pytest_pafot.criticality.measures import Encounters, depth
from pytest_pafot.model.crossings import Origin
from pytest_pafot.model.trace import LANE, SPEED, Outcome, Trace

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

CLOSE_AHEAD = 2.0
"""A vehicle ahead of an ego that changes lanes counts as next to the ego if the gap is at most this large [m]."""

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
    ahead, both = frame.ahead[npc, tick], frame.half_along[0, tick] + frame.half_along[npc + 1, tick]
    if ahead > both + CLOSE_AHEAD:
        return "kept-no-distance"
    return "moved-in-front" if ahead < -both else "moved-into-side"


def attributed(trace: Trace) -> Attribution:
    """Return the verdict of :func:`rss_rule` on a run's collision, together with the ego's mistake in it."""
    found = rss_rule(trace)
    return found if found.fault is None else replace(found, mistake=mistake(trace, found))


STEADY_BRAKING = "steady-braking"
"""The driver that brakes with 6 m/s^2 down to a standstill, and keeps its lane."""
CAREFUL = "careful-human"
"""The driver that keeps its lane, and its distance to vehicles ahead."""

ANSWERED_BY_BRAKING: tuple[Fault, ...] = (
    "leader-unanswered",
    "cut-in-unanswered",
    "did-not-give-way",
    "entered-taken-zone",
)
"""The faults of an ego that should have braked, so that it is worth searching for braking that avoids the collision."""

FREE_FOR = 12.0
"""The time after a driver takes over in which the ego must not touch a vehicle [s]; a stop from 60 m/s takes less."""

LEEWAY = 2
"""The ticks for which a run lasts longer than it must, because a world may end it a tick earlier than asked."""

SCANNED = 10.0
"""The time before the impact in which the ego's decisions are tried [s]."""

ROUNDING = 1e-6
"""The largest difference between the states of a run and of its repetition. They may differ because some environments
compute sines in a different way."""

BRAKING_SHARE, BRAKING_TICKS = 0.1, 2
"""The differences from steady braking at which a run still shows it: a share of the speed that is lost, for a simulated
vehicle that only nearly reaches the rate, and ticks, for brakes that act a tick later than the decision."""

TOUCHING = 0.1
"""The deepest overlap of two boxes that may be a rounding of a world that finds its contacts by other means [m]."""

UNSAID = (Outcome.INVALID, Outcome.ADS_ERROR, Outcome.HANG)
"""The outcomes of a run that say nothing about whoever drove in it."""

TakeOver = Callable[[Trace, int, str], Trace]
"""A function that simulates a trace again, with a reference driver by name in the ego's place from a tick on.

If it can be called only with some names, its attribute ``drivers`` has them. If its runs can last longer, its attribute
``lasting`` returns from a duration [s] the same function for runs of that duration, or None.
"""


def _may_drive(name: str, take_over: TakeOver) -> bool:
    """Return whether a driver can take over: unless the function, or its world, declares other drivers."""
    world: Any = getattr(take_over, "__self__", None)  # of a bound method
    if hasattr(world, "reference_drivers"):
        return name in (*world.reference_drivers, *getattr(world, "takes_over", ()))
    return name in getattr(take_over, "drivers", (name,))


def _lasting(take_over: TakeOver, seconds: float) -> TakeOver | None:
    """Return a function that simulates runs of some duration [s]; None if the world of the runs cannot go on."""
    world: Any = getattr(take_over, "__self__", None)  # of a bound method
    if hasattr(type(world), "lasting"):
        longer: TakeOver = getattr(world.lasting(seconds), take_over.__name__)
        return longer
    lasting: Callable[[float], TakeOver | None] = getattr(take_over, "lasting", lambda seconds: None)
    return lasting(seconds)


@dataclass(frozen=True, slots=True, kw_only=True)
class Avoidance:
    """The last decision of the ego from which braking in its lane, or else a driver who keeps it, avoids a collision.

    Attributes:
        time: time of the decision [s], to milliseconds.
        braking: deceleration to a standstill [m/s^2]; None if not braking avoids it, but ``careful-human``, who keeps
            the lane.
    """

    time: float
    braking: float | None = None

    @property
    def sentence(self) -> str:
        """A sentence with what avoids the collision, and the time from which on it does."""
        return avoidance_sentence(self.time, self.braking)


def avoidance(trace: Trace, fault: Fault | None, take_over: TakeOver) -> Avoidance | None:
    """Return the last of the ego's decisions from which braking with 6 m/s^2 in its lane avoids the collision.

    Braking avoids the collision if the ego is seen to brake at that rate until it stands, and touches no vehicle in the
    12 s after the decision, and no two NPCs touch. A run that ends before is driven on. The decisions of the last 10 s
    before the impact are tried, the latest first. None if braking from none of them avoids the collision, if the runs
    that could show it end before and their world cannot go on, if the fault is not a missing response to a vehicle
    ahead or crossing, if ``take_over`` does not know ``steady-braking``, or if a repetition of the run differs from the
    trace.

    Args:
        trace: trace of the run.
        fault: fault of the ego in the run.
        take_over: function that simulates the run again with a driver that takes over, see
            :meth:`pytest_pafot.world.base_world.BuiltInWorld.take_over`.
    """
    if trace.collision is None or fault not in ANSWERED_BY_BRAKING or not _may_drive(STEADY_BRAKING, take_over):
        return None
    first, ticks = max(trace.ticks - round(SCANNED * trace.physics_hz), 0), trace.decision_ticks
    for tick in reversed(ticks[bisect_left(ticks, first) : bisect_left(ticks, trace.ticks)]):
        taken = take_over(trace, tick, STEADY_BRAKING)
        if not repeats(taken, trace, tick):
            return None
        # Driving on takes another run, so it is done only after braking that helps as far as the run goes.
        driven = _driven_on(taken, trace, tick, take_over, STEADY_BRAKING) if brakes_untouched(taken, tick) else None
        if driven is not None and (driven is taken or brakes_untouched(driven, tick)):
            return Avoidance(time=round(tick / trace.physics_hz, 3), braking=FOLLOWING.deceleration)
    return None


def keeping_lane(trace: Trace, tick: int, take_over: TakeOver) -> Avoidance | None:
    """Return that ``careful-human``, who takes over at a decision of the ego and keeps the lane, avoids the collision.

    None if that driver leaves the lane or touches a vehicle in the 12 s after the decision, if two NPCs touch, and for
    the other reasons for which :func:`avoidance` returns None.

    Args:
        trace: trace of the run.
        tick: tick of the decision with which the ego began to change lanes.
        take_over: as for :func:`avoidance`.
    """
    if trace.collision is None or not _may_drive(CAREFUL, take_over):
        return None
    taken = take_over(trace, tick, CAREFUL)
    if not (repeats(taken, trace, tick) and keeps_untouched(taken, tick)):
        return None
    driven = _driven_on(taken, trace, tick, take_over, CAREFUL)
    is_free = driven is not None and (driven is taken or keeps_untouched(driven, tick))
    return Avoidance(time=round(tick / trace.physics_hz, 3)) if is_free else None


def brakes_untouched(trace: Trace, tick: int) -> bool:
    """Return whether the ego brakes with 6 m/s^2 in its lane from a tick on, until it stands, and touches no NPC."""
    speed, rate = trace.ego[_free_time(trace, tick), SPEED], FOLLOWING.deceleration / trace.physics_hz
    wanted = np.maximum(speed[0] - rate * np.arange(len(speed)), 0.0)
    is_braking = np.abs(speed - wanted) <= BRAKING_SHARE * (speed[0] - wanted) + BRAKING_TICKS * rate
    return bool(is_braking.all()) and keeps_untouched(trace, tick)


def keeps_untouched(trace: Trace, tick: int) -> bool:
    """Return whether the ego stays in its lane from a tick on, and touches no NPC."""
    ticks = _free_time(trace, tick)
    lane, depths = trace.ego[ticks, LANE], depth(Encounters(trace).pairs)[:, ticks]
    return bool((lane == lane[0]).all() and not (depths > TOUCHING).any())


def _free_time(trace: Trace, tick: int) -> slice:
    return slice(tick, min(tick + round(FREE_FOR * trace.physics_hz), trace.ticks) + 1)


def _driven_on(taken: Trace, trace: Trace, tick: int, take_over: TakeOver, driver: str) -> Trace | None:
    """Return the run in which a driver takes over at a tick, to beyond the 12 s after it; None if it ends before.

    ``taken`` is that run as long as the world makes it, and ``trace`` is the run of the ego. If ``taken`` ends before
    without an event, it is simulated again and lasts longer, if the world can go on.
    """
    until = tick + round(FREE_FOR * trace.physics_hz)
    if taken.ticks < trace.ticks:  # such as at the end of a road: it does not show that the impact is avoided
        return None
    if taken.ticks > until:
        return taken
    longer = None
    if taken.outcome not in (Outcome.COLLISION, *UNSAID):
        longer = _lasting(take_over, (until + LEEWAY) / trace.physics_hz)
    driven = None if longer is None else longer(trace, tick, driver)
    is_longer = driven is not None and driven.ticks > until and repeats(driven, taken, taken.ticks)
    return driven if is_longer else None


def repeats(taken: Trace, trace: Trace, tick: int) -> bool:
    """Return whether a run in which a driver takes over at a tick is the same as the recorded run up to that tick."""
    repeated, recorded = taken.states[: tick + 1], trace.states[: tick + 1]
    return repeated.shape == recorded.shape and bool((np.abs(repeated - recorded) <= ROUNDING).all())
