"""Needless braking: a vehicle brakes hard, or stops, with nothing in its way.

Sources: Vienna Convention on Road Traffic, Art. 17 (1), no abrupt braking unless needed for safety; UN R157, by which
more than 5 m/s^2 is an emergency manoeuvre and counts as hard here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pytest_pafot.attribution.lane_changes import DRIFTING, stretches
from pytest_pafot.criticality import RoadFrame, RssRules
from pytest_pafot.model.crossings import Stretch
from pytest_pafot.model.trace import ALONG, LANE, SPEED, FloatArray, Lane, Trace, X, Y

HARD_BRAKING = 5.0
"""The deceleration above which braking is hard [m/s^2]."""
HARD_SECONDS = 0.4
"""The least duration of hard braking [s]."""
LASTING_BRAKING = 4.0
"""The deceleration above which braking also counts as hard if it takes half of the speed [m/s^2]; a careful driver
needs less to keep its distance."""
LEAST_LOST = 5.0
"""The least loss of speed in a braking that counts as hard because it takes half of the speed [m/s]."""
STANDING_SPEED = 0.1
"""The speed up to which the ego counts as standing [m/s]."""
STANDING_SECONDS = 3.0
"""The least duration of a stop that counts as a fault [s]."""
STANDSTILL_GAP = 5.0
"""The largest gap to a standing vehicle at which a stop behind that vehicle is not needless [m]."""
NEAR_SECONDS = 4.0
"""The time to collision below which a vehicle ahead is a reason to brake [s]. Also the largest distance at which a
vehicle that enters the ego's track is a reason, as a time at the ego's speed [s]."""
REASON_SECONDS = 1.6
"""The time after a reason to brake in which hard braking may still begin because of it [s]. A careful driver takes
0.4 s to perceive the reason, 0.75 s until the brakes act, and the rest until they act fully (UN R157, annex 4,
appendix 3)."""
RELEASE_SECONDS = 1.0
"""The time after the last reason to brake in which braking may still go on because of it [s]. A careful driver takes
0.4 s to perceive that the reason is gone, and brakes are released in the 0.6 s in which they build up (UN R157, annex
4, appendix 3)."""
AFTERMATH_SECONDS = 1.0
"""The time after a braking in which it still counts as the cause of a danger behind the vehicle [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Stop:
    """A braking of a vehicle, as an interval of ticks.

    Attributes:
        begin: the last tick before the braking began to act.
        end: the last tick at which the braking acted.
        had_reason: whether the vehicle began to brake earlier, for a reason that was gone.
    """

    begin: int
    end: int
    had_reason: bool = False


def braking(trace: Trace, vehicle: int = 0) -> FloatArray:
    """Return a vehicle's deceleration in the step before each tick [m/s^2], shape [ticks + 1].

    Negative if the vehicle speeds up. Vehicle 0 is the ego.
    """
    speed = trace.states[:, vehicle, SPEED]
    return -np.diff(speed, prepend=speed[:1]) * trace.physics_hz


def hard_braking(trace: Trace, vehicle: int, first: int, last: int) -> Stop | None:
    """Return a vehicle's last hard braking that acted between the ticks ``first`` and ``last``; None without one."""
    for begin, end in reversed(stretches(braking(trace, vehicle) > HARD_BRAKING)):
        until = min(end, last + 1)
        if until - 1 < first:
            return None
        if until - begin >= HARD_SECONDS * trace.physics_hz:
            return Stop(begin=begin - 1, end=until - 1)
    return None


def lasting_braking(trace: Trace, first: int) -> Stop | None:
    """Return the ego's last braking after the tick ``first`` that took half of its speed; None if there was none.

    The braking must be above 4 m/s^2 and take at least 5 m/s.
    """
    for begin, end in reversed(stretches(braking(trace) > LASTING_BRAKING)):
        before, after = trace.ego[[begin - 1, end - 1], SPEED]
        if end - 1 >= first and before - after >= max(before / 2, LEAST_LOST):
            return Stop(begin=begin - 1, end=end - 1)
    return None


def long_stop(trace: Trace) -> Stop | None:
    """Return the ego's braking to a stop that has lasted for at least 3 s at the end of the run; None without one."""
    speed = trace.ego[:, SPEED]
    if speed[-1] > STANDING_SPEED:
        return None
    driving = np.flatnonzero(speed > STANDING_SPEED)
    stopped = int(driving[-1]) + 1 if driving.size else 0
    if not stopped or trace.ticks - stopped < STANDING_SECONDS * trace.physics_hz:
        return None
    steady = np.flatnonzero(np.diff(speed[: stopped + 1]) >= 0)
    return Stop(begin=int(steady[-1]) + 1 if steady.size else 0, end=stopped)


def reasons(trace: Trace, frame: RoadFrame, rules: RssRules, vehicle: int, ticks: slice) -> npt.NDArray[np.bool_]:
    """Return whether anything ahead gave a vehicle a reason to brake, at each of the ticks; vehicle 0 is the ego.

    There are four reasons. A vehicle ahead in the same track is closer than RSS allows, or less than four seconds from
    a collision. A vehicle within four seconds of driving brakes hard in the same track, or enters it. Another vehicle's
    way meets this vehicle's way in a zone, and both vehicles are in the zone or within four seconds of it. The lane
    ends within four seconds.
    """
    speeds, drifts = frame.speed[:, ticks], frame.drift[:, ticks]
    speed, drift = speeds[vehicle], drifts[vehicle]
    of_npcs = frame.ahead[:, ticks], frame.right[:, ticks]  # from the ego
    from_ego = (np.concatenate((np.zeros_like(places[:1]), places)) for places in of_npcs)
    ahead, right = (places - places[vehicle] for places in from_ego)
    along = np.abs(ahead) - frame.half_along[vehicle, ticks] - frame.half_along[:, ticks]
    across = np.abs(right) - frame.half_across[vehicle, ticks] - frame.half_across[:, ticks]
    is_ahead = (ahead > 0) | (along <= 0)
    is_ahead[vehicle] = False
    is_near = along <= NEAR_SECONDS * speed
    slowed = -np.diff(frame.speed, prepend=frame.speed[:, :1])[:, ticks] * trace.physics_hz
    delays = np.where(np.arange(len(speeds)) == 0, rules.ego_response, rules.npc_response)[:, None]
    safe = np.where(
        ahead >= 0, rules.safe_along(speed, speeds, delays[vehicle]), rules.safe_along(speeds, speed, delays)
    )
    is_close = (
        (along < np.maximum(safe, STANDSTILL_GAP))
        | (along < NEAR_SECONDS * (speed - speeds))
        | (is_near & (slowed > HARD_BRAKING))
    )
    lane = trace.lanes[max(int(trace.states[ticks.stop - 1, vehicle, LANE]), 0)]
    is_entering = (across > 0) & (across < lane.width) & (np.sign(right) * (drift - drifts) >= DRIFTING) & is_near
    found = (is_ahead & (((across <= 0) & is_close) | is_entering)).any(axis=0)
    found |= _is_near_zone(trace, vehicle, ticks)
    return np.asarray(found | _is_near_end(trace.states[ticks, vehicle], trace.lanes, lane))


def _is_near_zone(trace: Trace, vehicle: int, ticks: slice) -> npt.NDArray[np.bool_]:
    """Return, for each tick, whether a vehicle and an NPC are both in the zone of their ways or within 4 s of it."""
    found = np.zeros(ticks.stop - ticks.start, dtype=np.bool_)
    for npc, zone in enumerate(trace.zones):
        if zone is None or npc + 1 == vehicle:
            continue
        places = trace.track_of(vehicle)[ticks, ALONG], trace.way_of(npc)[ticks]
        speeds = trace.states[ticks, vehicle, SPEED], trace.states[ticks, npc + 1, SPEED]
        found |= _is_near(places[0], speeds[0], zone.ego) & _is_near(places[1], speeds[1], zone.npc)
    return found


def _is_near(places: FloatArray, speeds: FloatArray, stretch: Stretch) -> npt.NDArray[np.bool_]:
    before = np.maximum(NEAR_SECONDS * speeds, STANDSTILL_GAP)
    return np.asarray((places < stretch[1]) & (stretch[0] - places <= before))


def _is_near_end(states: FloatArray, lanes: tuple[Lane, ...], lane: Lane) -> npt.NDArray[np.bool_]:
    """Return, for each tick, whether a vehicle's lane ends within four seconds and no other lane continues it."""
    end = (lane.x + lane.length * math.cos(lane.heading), lane.y + lane.length * math.sin(lane.heading))
    end = lane.points[-1] if lane.points else end
    starts = [each.points[0] if each.points else (each.x, each.y) for each in lanes]
    if any(math.dist(end, start) < 1.0 for start in starts):
        return np.zeros(len(states), dtype=np.bool_)
    left = np.hypot(end[0] - states[:, X], end[1] - states[:, Y])
    return np.asarray(left < NEAR_SECONDS * np.abs(states[:, SPEED]))
