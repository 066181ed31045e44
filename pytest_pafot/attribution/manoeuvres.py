"""What a vehicle does that bears on responsibility: changes of lanes, and needless braking."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
import numpy.typing as npt

from pytest_pafot.criticality import RoadFrame, RssRules
from pytest_pafot.model.crossings import Stretch
from pytest_pafot.model.trace import ACROSS, ALONG, LANE, OFFSET, SPEED, FloatArray, Lane, Trace, X, Y

# Lane changes: when a vehicle came into the lane of another vehicle, and since when it has kept that lane. The centre
# of a vehicle determines the lane that it is in.

DRIFTING = 0.3
"""The sideways speed from which on a vehicle moves towards a different lane [m/s]; a slower vehicle only wanders."""
PAUSE = 0.5
"""Sideways motions with a shorter pause between them count as one motion [s]."""
KEEPING = 0.375
"""The largest offset from the lane's centre at which a vehicle keeps its lane; a larger offset distinguishes a cut-in
from wandering (UN R157, annex 4, appendix 3) [m]."""
KEPT_SECONDS = 1.0
"""The time near the lane's centre after which a vehicle has kept its lane [s]."""
BETWEEN_SECONDS = 2.0
"""The time between the lane's lines after which a vehicle has kept its lane, even if it is not near the centre [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LaneChange:
    """One continuous sideways motion of a vehicle into the track of another vehicle.

    Attributes:
        vehicle: index of the vehicle; 0 is the ego.
        seen: tick from which on the motion could be distinguished from wandering in the lane.
        tick: moment of the lane change, the tick from which on the vehicle's box was over the last line that it
            crossed.
    """

    vehicle: int
    seen: int
    tick: int


class LanePlaces:
    """The places of the vehicles of a run on the lanes. Arrays of all vehicles have the shape [vehicles, ticks + 1]."""

    def __init__(self, trace: Trace, frame: RoadFrame) -> None:
        self.trace, self.frame = trace, frame

    def offset(self, vehicle: int) -> FloatArray:
        """Return the offset to the right from the centre of the vehicle's lane, or of the nearest lane [m]."""
        return np.asarray(self._offsets[vehicle])

    @cached_property
    def _offsets(self) -> FloatArray:
        return np.ascontiguousarray(self._track[:, :, OFFSET].T)

    def over_line(self, vehicle: int, side: float, tick: int) -> bool:
        """Return whether a vehicle's box reaches over the line of its lane on one side (1: right, -1: left)."""
        return bool(self._over[side][vehicle, tick])

    @cached_property
    def _over(self) -> dict[float, npt.NDArray[np.bool_]]:
        """The values of :meth:`over_line` by side, shape [vehicles, ticks + 1]."""
        return {side: side * self._offsets + self.frame.half_across > self._half_widths for side in (1.0, -1.0)}

    def kept_since(self, vehicle: int, tick: int, end: int) -> tuple[int, int] | None:
        """Return two ticks: a vehicle keeps its lane from the first on, and has kept it for long enough at the second.

        Long enough is a second near the lane's centre, or two seconds between the lane's lines. None if that does not
        happen between the ticks ``tick`` and ``end``.
        """
        part = slice(tick, end + 1)
        offset = np.abs(self._offsets[vehicle, part])
        between = offset + self.frame.half_across[vehicle, part] <= self._half_widths[vehicle, part]
        kept = []
        for holds, seconds in ((offset <= KEEPING, KEPT_SECONDS), (between, BETWEEN_SECONDS)):
            ticks = round(seconds * self.trace.physics_hz)
            begin = first_lasting(holds, ticks + 1)
            if begin is not None:
                kept.append((tick + begin, tick + begin + ticks))
        return min(kept, key=lambda each: each[1], default=None)

    def change(self, vehicle: int, other: int, side: float, onset: int) -> LaneChange | None:
        """Return the lane change that put a vehicle into another's track at the tick ``onset``; None without one.

        ``side`` is 1 for a lane change to the right and -1 for one to the left.
        """
        began = self._motion(vehicle, side, onset)
        if began is None:
            return None
        part = slice(began, onset + 1)
        over = self._over[side][vehicle, part]
        if over.any():
            moment = began + _run_start(over, int(np.flatnonzero(over)[-1]))
        elif not self.trace.road.is_straight:  # in a bend a lane itself may lead into the other's
            line = side * (self._across - self._offsets)[other, onset] - self._half_widths[other, onset]
            beyond = side * self._across[vehicle, part] + self.frame.half_across[vehicle, part] > line
            if not beyond.any():
                return None
            moment = began + int(beyond.argmax())
        else:
            return None
        return self._made(vehicle, side, began, moment)

    def is_back(self, change: LaneChange, side: float, tick: int) -> bool:
        """Return whether a vehicle has given up a lane change, so that its box is again within its former lane."""
        lanes, over = self._lanes[change.vehicle], self._over[side][change.vehicle]
        return bool(over[change.tick] and not over[tick] and lanes[tick] == lanes[change.tick] and lanes[tick] >= 0)

    def moved_in_behind(self, npc: int, side: float, first: int, last: int) -> LaneChange | None:
        """Return an NPC's lane change into the ego's lane, behind the ego, while their tracks overlapped; or None."""
        return self._crossing_after(npc + 1, 0, side, first, last, is_ahead=False)

    def moved_over(self, npc: int, first: int, last: int) -> LaneChange | None:
        """Return the lane change of the vehicle ahead, ego or NPC, into the lane of the vehicle behind; None if none.

        The vehicle behind had left their common lane first, but their tracks overlapped all the time. The lane change
        must be between the ticks ``first`` and ``last``.
        """
        pairs = product(((0, npc + 1), (npc + 1, 0)), (1.0, -1.0))
        crossings = (self._crossing_after(*pair, side, first, last) for pair, side in pairs)
        return max((each for each in crossings if each is not None), key=lambda each: each.tick, default=None)

    def _crossing_after(
        self, mover: int, other: int, side: float, first: int, last: int, *, is_ahead: bool = True
    ) -> LaneChange | None:
        """Return the last lane change in which a vehicle crossed its line towards the other vehicle's lane, or None.

        ``is_ahead`` is whether the vehicle that changes lanes must be ahead of the other vehicle or behind it.
        """
        over = self._over[side][mover, first : last + 1]
        crosses = over[1:] > over[:-1]
        if not crosses.any():
            return None
        crosses &= side * self.frame.drift[mover, first + 1 : last + 1] >= DRIFTING
        for before in (first + np.flatnonzero(crosses)[::-1]).tolist():
            ego_leads = self.frame.ahead[max(mover, other) - 1, before] < 0
            centres = (self._across[each, before] - self._offsets[each, before] for each in (mover, other))
            lanes_apart = np.round(side * -np.subtract(*centres) / (2 * self._half_widths[mover, before]))
            are_in_lanes = self._lanes[[mover, other], before].min() >= 0
            if ego_leads == ((mover == 0) == is_ahead) and lanes_apart == 1 and are_in_lanes:
                return self._made(mover, side, first, before + 1)
        return None

    def _made(self, vehicle: int, side: float, began: int, moment: int) -> LaneChange:
        """Return the record of a vehicle's lane change to a side, 1 for right and -1 for left.

        The sideways motion began at the tick ``began``; the lane change counts from the tick ``moment`` on.
        """
        left = side * self._offsets[vehicle, began : moment + 1] > KEEPING
        seen = began + _run_start(left, moment - began) if left[-1] else moment
        return LaneChange(vehicle=vehicle, seen=seen, tick=moment)

    def _motion(self, vehicle: int, side: float, onset: int) -> int | None:
        """Return the first tick of the sideways motion that lasts until a tick or ended just before; None if none."""
        pause = PAUSE * self.trace.physics_hz
        moving = np.flatnonzero(side * self.frame.drift[vehicle, : onset + 1] >= DRIFTING)
        if not moving.size or onset - moving[-1] >= pause:
            return None
        breaks = np.flatnonzero(np.diff(moving) - 1 >= pause)
        return int(moving[breaks[-1] + 1] if breaks.size else moving[0])

    @cached_property
    def _across(self) -> FloatArray:
        return np.ascontiguousarray(self._track[:, :, ACROSS].T)

    @cached_property
    def _track(self) -> FloatArray:
        return self.trace.road.track

    @cached_property
    def _lanes(self) -> npt.NDArray[np.intp]:
        return self.trace.states[:, :, LANE].T.astype(np.intp, order="C")

    @cached_property
    def _half_widths(self) -> FloatArray:
        """Half the width of each vehicle's lane, or of the first lane if the vehicle is off the road [m]."""
        widths = np.array([lane.width for lane in self.trace.lanes])
        return np.asarray(widths[np.maximum(self._lanes, 0)] / 2)


def _run_start(holds: npt.NDArray[np.bool_], tick: int) -> int:
    """Return the first tick of the unbroken stretch, up to a tick, in which a condition holds."""
    fails = np.flatnonzero(~holds[:tick])
    return int(fails[-1]) + 1 if fails.size else 0


def stretches(holds: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the first tick and the tick after the last of each unbroken stretch in which a condition holds."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], holds, [False])))).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def first_lasting(holds: npt.NDArray[np.bool_], ticks: int) -> int | None:
    """Return the first tick from which on a condition holds for ``ticks`` ticks; None if there is none."""
    count = np.concatenate(([0], np.cumsum(holds)))
    lasting = np.flatnonzero(count[ticks:] - count[:-ticks] == ticks)
    return int(lasting[0]) if lasting.size else None


# Needless braking: a vehicle brakes hard, or stops, with nothing in its way.
#
# Sources: Vienna Convention on Road Traffic, Art. 17 (1), no abrupt braking unless needed for safety; UN R157, by which
# more than 5 m/s^2 is an emergency manoeuvre and counts as hard here.

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
