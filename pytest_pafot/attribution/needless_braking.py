"""Whether the ego braked, or stopped, with nothing in its way.

Sources: Vienna Convention on Road Traffic, Art. 17 (1), no abrupt braking unless needed for safety; UN R157 for what is
hard: more than 5 m/s^2 is an emergency manoeuvre's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pytest_pafot.attribution.lane_changes import DRIFTING
from pytest_pafot.criticality import RoadFrame
from pytest_pafot.trace import LANE, SPEED, FloatArray, Lane, Trace, X, Y

HARD_BRAKING = 5.0
"""[m/s^2]."""
HARD_SECONDS = 0.4
"""For so long at least [s]."""
STANDING_SPEED = 0.1
"""Up to this speed the ego counts as standing [m/s]."""
STANDING_SECONDS = 3.0
"""A stop that lasts so long at least is one of its own [s]."""
STANDSTILL_GAP = 5.0
"""Behind whoever stands, a stop within that is no needless one [m]."""
NEAR_SECONDS = 4.0
"""Time to collision below which a vehicle ahead is a reason to brake; and how far ahead one that is entering is, in
seconds of the ego's driving [s]."""
REASON_SECONDS = 1.6
"""A reason that was there so long before the braking still is one: a careful driver takes 0.4 s to perceive it, 0.75 s
until the brakes act, and the rest until they brake hard (UN R157, annex 4, appendix 3) [s]."""
AFTERMATH_SECONDS = 1.0
"""The danger behind is the braking's until so long after it [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Stop:
    """A braking of the ego.

    Attributes:
        begin: the last tick before it began to act.
        end: the last tick in which it acted.
    """

    begin: int
    end: int


def braking(trace: Trace) -> FloatArray:
    """How much the ego slows down in the step to each tick [m/s^2], shape [ticks + 1]; negative where it speeds up."""
    speed = trace.ego[:, SPEED]
    return -np.diff(speed, prepend=speed[:1]) * trace.physics_hz


def hard_braking(trace: Trace, first: int, last: int) -> Stop | None:
    """The last hard braking that acted at some tick from the first to the last; None if there was none."""
    hard = np.concatenate(([False], braking(trace)[: last + 1] > HARD_BRAKING, [False]))
    edges = np.flatnonzero(np.diff(hard.astype(np.int8)))
    for begin, end in zip(edges[-2::-2].tolist(), edges[::-2].tolist(), strict=True):
        if end - 1 < first:
            return None
        if end - begin >= HARD_SECONDS * trace.physics_hz:
            return Stop(begin=begin - 1, end=end - 1)
    return None


def long_stop(trace: Trace, end: int) -> Stop | None:
    """The braking to a standstill that has lasted for long at a tick; None where there was none."""
    speed = trace.ego[: end + 1, SPEED]
    driving = np.flatnonzero(speed > STANDING_SPEED)
    stopped = int(driving[-1]) + 1 if driving.size else 0
    if not stopped or end - stopped < STANDING_SECONDS * trace.physics_hz:
        return None
    steady = np.flatnonzero(np.diff(speed[: stopped + 1]) >= 0)
    return Stop(begin=int(steady[-1]) + 1 if steady.size else 0, end=stopped)


def reasons(trace: Trace, frame: RoadFrame, safe_along: FloatArray, ticks: slice) -> npt.NDArray[np.bool_]:
    """Whether anything ahead gave the ego a reason to brake, at each of the ticks.

    A vehicle in its track, closer than RSS allows or less than four seconds to a collision; one that brakes hard there,
    or is coming into it, no farther than the ego drives in that time; the end of its lane, as if a vehicle stood there.
    """
    speed = frame.speed[:1, ticks]
    along = np.abs(frame.ahead[:, ticks]) - frame.half_along[:1, ticks] - frame.half_along[1:, ticks]
    across = frame.gap_across.T[:, ticks]
    is_ahead = (frame.ahead[:, ticks] > 0) | (along <= 0)
    closing = speed - frame.speed[1:, ticks]
    is_near = along <= NEAR_SECONDS * speed
    slowed = -np.diff(frame.speed[1:], prepend=frame.speed[1:, :1])[:, ticks] * trace.physics_hz
    is_close = (
        (along < np.maximum(safe_along.T[:, ticks], STANDSTILL_GAP))
        | (along < NEAR_SECONDS * closing)
        | (is_near & (slowed > HARD_BRAKING))
    )
    sideways = np.sign(frame.right[:, ticks]) * (frame.drift[:1, ticks] - frame.drift[1:, ticks])
    lane = trace.lanes[max(int(trace.ego[ticks.stop - 1, LANE]), 0)]
    is_entering = (across > 0) & (across < lane.width) & (sideways >= DRIFTING) & is_near
    found = (is_ahead & (((across <= 0) & is_close) | is_entering)).any(axis=0)
    return np.asarray(found | _is_near_end(trace, lane, ticks))


def _is_near_end(trace: Trace, lane: Lane, ticks: slice) -> npt.NDArray[np.bool_]:
    """Whether the ego's lane ends, and no other goes on from there, within four seconds."""
    end = (lane.x + lane.length * math.cos(lane.heading), lane.y + lane.length * math.sin(lane.heading))
    end = lane.points[-1] if lane.points else end
    starts = [each.points[0] if each.points else (each.x, each.y) for each in trace.lanes]
    states = trace.ego[ticks]
    if any(math.dist(end, start) < 1.0 for start in starts):
        return np.zeros(len(states), dtype=np.bool_)
    left = np.hypot(end[0] - states[:, X], end[1] - states[:, Y])
    return np.asarray(left < NEAR_SECONDS * np.abs(states[:, SPEED]))
