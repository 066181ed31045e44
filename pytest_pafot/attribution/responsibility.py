"""Responsibility for a collision, according to five rules that read only the trace of the run.

docs/explanation/verdicts.md states the rules, their numbers and the sources.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from pytest_pafot.attribution.sentences import Happened, sentences_on
from pytest_pafot.criticality import RoadFrame, RssRules
from pytest_pafot.criticality.measures import Boxes, last_stretch, overlaps, relate, stretches
from pytest_pafot.model.crossings import Stretch, Zone
from pytest_pafot.model.trace import (
    ACROSS,
    ALONG,
    HEADING,
    LANE,
    OFFSET,
    SPEED,
    FloatArray,
    Trace,
    X,
    Y,
)

# "none": there was no collision, or neither vehicle could foresee the other in time at a junction.
Responsibility = Literal["ego", "npc", "both", "none"]

# The rule that the ego broke, in this order: it moved into another vehicle's path; it did not respond to a cut-in, or
# to a vehicle ahead; it braked hard, or stopped, without a reason; at a junction it did not give way, or entered the
# conflict zone while the NPC was visibly there.
Fault = Literal[
    "entered-lane",
    "cut-in-unanswered",
    "leader-unanswered",
    "braked-for-nothing",
    "stopped-for-nothing",
    "did-not-give-way",
    "entered-taken-zone",
]

# The faults of a following ego that did not respond.
UNANSWERED: tuple[Fault, ...] = ("cut-in-unanswered", "leader-unanswered")

# What the ego did wrong, in this order: it did not keep its distance; it changed lanes into a vehicle next to it, or in
# front of a vehicle behind; it braked hard, or stopped, without a reason; it did not give way to a vehicle from one of
# four sides; it entered an occupied conflict zone.
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

# The time until a driver's brakes act, for a vehicle ahead (RSS) and for one that cuts in [s]. The second consists of
# 0.4 s to perceive the risk, 0.75 s until the brakes act, and half of the time in which braking builds up (UN R157,
# annex 4, appendix 3). The first is also the headway that a lane change must leave, and the time for which an earlier
# action still counts.
DELAY, DELAY_AFTER_CUT_IN = 1.0, 1.4
# The braking that the rules require of a driver [m/s^2] (UN R157, 5.2.5.2).
HARDEST = 6.0
# The usual headway of two seconds to a leader of equal speed must never be a fault. With these values it is safe up to
# 48 m/s (v + v^2 / 48 <= 2 v). RSS also assumes that the follower accelerates during its response time, which would
# require more than two seconds. A leader brakes at 8 m/s^2 at most, like an NPC.
DISTANCES = RssRules(
    ego_response=1.0, npc_response=1.0, acceleration=0.0, least_braking=HARDEST, hardest_braking=8.0
)
# The braking [m/s^2] that a lane change, or a vehicle at a junction, may impose on another vehicle, and the time until
# that braking starts [s] (UN R79, 5.6.4.7).
GENTLY, AFTER = 3.0, 0.4
# A vehicle moves towards another lane at this sideways speed or more [m/s]. A slower one only wanders.
DRIFTING = 0.3
# RECENT: a lane change counts if the vehicle crossed the line at most this time before both were in the same track [s].
# SOON: an NPC that left too little room shares the responsibility if the impact follows within this time [s].
RECENT, SOON = 2.0, 6.0
# BLOCKED: if an NPC cuts in with less headway than this [s] and brakes hard, an ego that slows down has one more
# second. SLOWED: the loss of speed that counts as slowing down [m/s].
BLOCKED, SLOWED = 0.3, 2.0
# A vehicle ahead or behind with at most this gap is next to the one that changes lanes [m].
NEXT_TO = 2.0
# Braking is hard above this deceleration [m/s^2] for at least this time [s]. A careful driver needs no more to keep the
# distance.
HARD, HARD_SECONDS = 4.0, 0.4
# STANDING_SPEED: a vehicle is stationary up to this speed [m/s]. LONG: the shortest stop that counts, and the time in a
# new lane after which a vehicle has led for long enough [s].
STANDING_SPEED, LONG = 0.1, 3.0
# NEAR_SECONDS: a vehicle ahead is near if the ego would reach it in less than this time at the closing speed, or at the
# ego's own speed [s]. STANDSTILL_GAP: a smaller gap is always a reason to brake [m].
NEAR_SECONDS, STANDSTILL_GAP = 4.0, 5.0
# An NPC behind an ego that brakes needlessly causes the danger itself if it accelerates by more than this [m/s].
DROVE_ON = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Attribution:
    """The responsibility for a collision, with the facts that decide it.

    Attributes:
        responsibility: side that is responsible for the collision.
        tick, time: tick and time [s] of the decisive lane change, braking or danger; None without a collision.
        fault: rule that the ego broke; None if the ego is not responsible.
        sentences: measured facts about what happened; empty without a collision.
        contested: fault that depends on whether a careful driver had enough time; None if the rules decide.
        takeover: latest takeover by a careful driver that avoids the collision [s before the impact]; 0 if none does,
            None if unknown.
        mistake: the ego's driving error; None if the ego is not responsible.
    """

    responsibility: Responsibility
    tick: int | None
    time: float | None
    fault: Fault | None = None
    sentences: tuple[str, ...] = ()
    contested: Fault | None = None
    takeover: float | None = None
    mistake: Mistake | None = None


class Ruling(NamedTuple):
    """The result of a rule, with the facts that the sentences of a verdict state."""

    responsibility: Responsibility
    tick: int
    happened: Happened
    vehicle: int = 0
    fault: Fault | None = None


def rss_rule(trace: Trace) -> Attribution:
    """Attribute a collision according to the five rules in docs/explanation/verdicts.md.

    1. At a junction, a vehicle that did not give way is responsible.
    2. A vehicle that moves into another's path without leaving room is responsible.
    3. A follower is responsible if an ordinary response would have avoided the collision.
    4. A vehicle that brakes or stops without a reason is responsible. So is a follower that could avoid the collision.
    5. If the vehicles were side by side, the one that moved sideways is responsible.

    An ego that touches a fixed object is always responsible.

    Sources: Shalev-Shwartz, Shammah, Shashua, arXiv:1708.06374 (distances, proper response, right of way); UN
    Regulations No. 79 (lane changes) and No. 157 (careful driver); Vienna Convention on Road Traffic, Art. 17 and 18.
    """
    hit, hz = trace.collision, trace.physics_hz
    if hit is None:
        return Attribution(responsibility="none", tick=None, time=None)
    npc = hit.npc
    if npc is None:  # a fixed object
        return Attribution(responsibility="ego", tick=hit.tick, time=hit.time)
    zone = trace.zones[npc] if trace.zones else None
    found = Conflict(trace, npc).verdict if zone is None else _where_ways_meet(trace, npc, zone)
    # The rules excuse an ego that ran into an NPC without time to respond. Only a simulation shows whether it had time.
    is_contested = (
        hit.side == "front" and found.fault in UNANSWERED and found.responsibility != "ego"
    )
    return Attribution(
        responsibility=found.responsibility,
        tick=found.tick,
        time=found.tick / hz,
        fault=found.fault if found.responsibility in ("ego", "both") else None,
        sentences=sentences_on(
            trace, frame_of(trace), npc, found.happened, found.vehicle, found.tick
        ),
        contested=found.fault if is_contested else None,
    )


def position_rule(trace: Trace) -> Responsibility:
    """Attribute a collision by the NPC's position at the impact, as in the code by the paper's authors.

    The ego is responsible if it moved and the NPC was ahead of it. Otherwise the NPC is responsible.
    """
    hit = trace.collision
    if hit is None or hit.npc is None:
        return "none" if hit is None else "ego"
    # An NPC in no cell was not on the ego's path. It counts as ahead if it hit the ego's front.
    was_ahead = hit.side == "front" if hit.cell is None else hit.cell.row > 0
    return "ego" if was_ahead and hit.ego_speed > STANDING_SPEED else "npc"


@lru_cache(maxsize=1)  # the verdict, the mistake and the situation of one run need it in succession
def frame_of(trace: Trace) -> RoadFrame:
    """Return a run's longitudinal and lateral positions and velocities."""
    return RoadFrame(trace)


def braking(trace: Trace, vehicle: int = 0) -> FloatArray:
    """Return a vehicle's deceleration [m/s^2] in the step before each tick, as an array of shape [ticks + 1]."""
    speed = trace.states[:, vehicle, SPEED]
    return -np.diff(speed, prepend=speed[:1]) * trace.physics_hz


def room_to_leave(follower: float, mover: float) -> float:
    """Return the gap [m] that a lane change must leave to the vehicle behind, given both speeds [m/s]."""
    faster = max(follower - mover, 0.0)
    return max(faster * AFTER + faster**2 / (2 * GENTLY) + mover * DELAY, 0.0)


class Conflict:
    """The conflict between the ego (vehicle 0) and the NPC in the collision, in a lane or side by side."""

    def __init__(self, trace: Trace, npc: int) -> None:
        self._trace, self._npc, self._frame = trace, npc + 1, frame_of(trace)
        self._end, self._hz, frame = trace.ticks, trace.physics_hz, self._frame
        self._ahead = frame.ahead[npc]  # of the NPC, from the ego
        self._gaps = np.abs(self._ahead) - frame.half_along[0] - frame.half_along[npc + 1]
        # from here to the impact they were in the same track
        self._met = last_stretch(frame.gap_across[:, npc] <= 0)
        self.danger = last_stretch(
            self._gaps < np.maximum(frame.safe_along(DISTANCES)[:, npc], 1e-9)
        )
        self._before = max(self.danger - 1, 0)  # the last safe tick; responses count from here

    @cached_property
    def verdict(self) -> Ruling:
        ego, npc = self._moved_in(0), self._moved_in(self._npc)
        # Rule 2: a lane change counts unless the danger started only after the two were in the same track.
        if max(ego, npc) >= 0 and max(ego, npc, self._met) >= self.danger:
            return self._ego_moved_in(ego) if ego >= npc else self._npc_moved_in(npc)
        # Rule 5: they were side by side when their tracks met.
        if max(ego, npc) < 0 and 0 < self._met >= self.danger and self._gaps[self._met] <= 0:
            return self._came_together()
        # Rules 3 and 4: one followed the other.
        if self._ahead[self.danger] < 0:
            return self._npc_followed(0, Ruling("npc", self.danger, "close", self._npc))
        could = self._could_avoid(0, self._before, DELAY)
        return Ruling("ego" if could else "npc", self.danger, "close", 0, "leader-unanswered")

    def _moved_in(self, vehicle: int) -> int:
        # The last tick at which the vehicle's box crossed the line of the other's lane, or -1. The other must stay in
        # its lane, since otherwise the lines move and the vehicle does not.
        trace, end, other = self._trace, self._end, self._npc - vehicle
        tracks, lanes = trace.road.track, trace.states[:, other, LANE].astype(int)
        widths = np.array([lane.width for lane in trace.lanes])
        centre = tracks[:, other, ACROSS] - tracks[:, other, OFFSET]
        away = tracks[:, vehicle, ACROSS] - centre
        over = np.abs(away) - self._frame.half_across[vehicle] < widths[np.maximum(lanes, 0)] / 2
        towards = -np.sign(away) * self._frame.drift[vehicle] >= DRIFTING
        came = (
            over[1 : end + 1]
            & ~over[:end]
            & towards[1 : end + 1]
            & (lanes[1 : end + 1] == lanes[:end])
        )
        ticks = np.flatnonzero(came) + 1
        return int(ticks[-1]) if ticks.size and ticks[-1] >= self._met - RECENT * self._hz else -1

    def _has_room(self, mover: int, tick: int) -> bool:
        behind, speed = self._frame.speed[self._npc - mover, tick], self._frame.speed[mover, tick]
        return bool(self._gaps[tick] >= room_to_leave(float(behind), float(speed)))

    def _ego_moved_in(self, tick: int) -> Ruling:
        # Rule 2 for the ego: it is responsible unless it left room, or led for long enough for the NPC to brake.
        moved, npc = Ruling("ego", tick, "moved", 0, "entered-lane"), self._npc
        if self._ahead[tick] >= 0:
            return moved
        if self._has_room(0, tick) and self._has_room(0, max(self._met, tick)):
            return self._npc_followed(tick, moved._replace(responsibility="npc"))
        led = tick + round(LONG * self._hz)
        if self._could_avoid(npc, max(led, self._before), DELAY, later=False):
            return self._npc_followed(led, moved._replace(responsibility="npc"))
        # It left too little room, but an NPC that could have braked anyway shares the responsibility.
        could = self._gaps[tick] >= NEXT_TO and self._could_avoid(
            npc, max(tick, self._before), DELAY
        )
        return moved._replace(responsibility="both" if could else "ego")

    def _npc_moved_in(self, tick: int) -> Ruling:
        # Rule 2 for an NPC, and rule 3 for the ego behind it.
        gap, speed = self._gaps[tick], self._frame.speed[0]
        moved = Ruling("npc", tick, "moved", self._npc, "cut-in-unanswered")
        if gap > 0 and self._ahead[tick] < 0:
            return self._npc_followed(tick, moved, moved_in=True)
        since, is_blocked = (
            tick,
            gap < BLOCKED * speed[tick] and bool(self._hard_brakings(self._npc, tick + 1)),
        )
        has_slowed = speed[self._end] < speed[tick] - SLOWED
        # An NPC that cuts in very close and brakes hard gives an ego that slows down one more second.
        if is_blocked and has_slowed:
            since = tick + round(DELAY * self._hz)
        if not self._could_avoid(0, since, DELAY_AFTER_CUT_IN):
            # No response would have helped. But an ego that had time to brake, and did not, shares the responsibility.
            if gap > 0 and not has_slowed and self._end - tick >= DELAY_AFTER_CUT_IN * self._hz:
                return moved._replace(responsibility="both")
            return moved
        is_pushed = not self._has_room(self._npc, tick) and self._end - tick <= SOON * self._hz
        return moved._replace(responsibility="both" if is_pushed else "ego")

    def _came_together(self) -> Ruling:
        tick, frame, npc = self._met, self._frame, self._npc
        # Rule 5. Drifts are positive towards the other vehicle.
        side = 1.0 if frame.right[npc - 1, max(tick - 1, 0)] >= 0 else -1.0
        drifts = side * frame.drift[0, tick], -side * frame.drift[npc, tick]
        moves = [drift >= DRIFTING for drift in drifts]
        # If neither moved sideways, the vehicle over the line of its lane is responsible, or else the NPC.
        if moves[0] == moves[1] and not moves[0]:
            tracks, lanes = (
                self._trace.road.track[tick, :, OFFSET],
                self._trace.states[tick, :, LANE].astype(int),
            )
            for index, (vehicle, way) in enumerate(((0, side), (npc, -side))):
                half = self._trace.lanes[max(lanes[vehicle], 0)].width / 2
                moves[index] = bool(way * tracks[vehicle] + frame.half_across[vehicle, tick] > half)
            if moves[0] == moves[1]:
                moves = [False, True]
        who: Responsibility = "both" if all(moves) else "ego" if moves[0] else "npc"
        return Ruling(who, tick, "sideways", 0 if moves[0] else npc, "entered-lane")

    def _could_avoid(self, behind: int, first: int, delay: float, *, later: bool = True) -> bool:
        # Rule 3: would an ordinary response of the follower, at the first tick or, with `later`, at any tick after it,
        # have avoided the impact? Until the delay [s] is over, the follower drives as recorded, but never speeds up.
        # Then it brakes at 6 m/s^2 while it is faster than the other vehicle, which drives as recorded.
        own, other, end = (
            self._frame.speed[behind],
            self._frame.speed[self._npc - behind],
            self._end,
        )
        starts = np.arange(first, end if later else min(first + 1, end))
        starts = starts[(self._ahead[starts] < 0) if behind else (self._ahead[starts] > 0)]
        if not starts.size:
            return False
        # All responses are simulated together. Each has a speed, and a distance behind the recorded position.
        speed, back = np.full(len(starts), own[first]), np.zeros(len(starts))
        due, step = starts + round(delay * self._hz), HARDEST / self._hz
        for tick in range(first, end):
            back += np.where(tick >= starts, own[tick] - speed, 0.0)
            braked = np.where(speed > other[tick], np.maximum(speed - step, 0.0), speed)
            driven = np.where(tick < starts, own[tick + 1], np.minimum(speed, own[tick + 1]))
            speed = np.where(tick + 1 >= due, braked, driven)
        # At the impact, it must be farther back than the distance that it still needs to lose its excess speed.
        return bool(
            (back / self._hz > np.maximum(speed - other[end], 0.0) ** 2 / (2 * HARDEST)).any()
        )

    def _hard_brakings(self, vehicle: int, first: int = 0) -> list[tuple[int, int]]:
        # The first tick of each hard braking, and the first tick after it, relative to `first`.
        found = stretches(braking(self._trace, vehicle)[first : self._end + 1] > HARD)
        return [
            (begin, until) for begin, until in found if until - begin >= HARD_SECONDS * self._hz
        ]

    def _npc_followed(self, duty: int, found: Ruling, *, moved_in: bool = False) -> Ruling:
        # Rule 4. The NPC has to respond from the tick `duty`. If it moved in behind the ego, it chose the distance.
        needless = self._needless
        if needless is None:
            return found
        begin, fault = needless
        could = moved_in or self._could_avoid(self._npc, max(duty, min(begin, self._before)), DELAY)
        happened: Happened = "stopped" if fault == "stopped-for-nothing" else "braked"
        return Ruling("both" if could else "ego", begin, happened, 0, fault)

    @cached_property
    def _needless(self) -> tuple[int, Fault] | None:
        # The tick at which needless braking or a needless stop started, and the fault. Candidates are hard brakings,
        # and a stop of at least 3 s.
        speed, hz, end = self._trace.ego[:, SPEED], self._hz, self._end
        hard = self._hard_brakings(0)
        found: list[tuple[int, int, Fault]] = [
            (until - 1, begin - 1, "braked-for-nothing") for begin, until in hard
        ]
        stopped = last_stretch(speed <= STANDING_SPEED)
        if speed[end] <= STANDING_SPEED and 0 < stopped <= end - LONG * hz:
            slows = np.append(np.diff(speed[: stopped + 1]) < 0, True)
            found.append((stopped, last_stretch(slows), "stopped-for-nothing"))
        ahead, behind = self._frame.speed[[0, self._npc]]
        for until, begin, fault in sorted(found, key=lambda each: each[0], reverse=True):
            # It must last until shortly before the danger. The NPC must be behind, and the ego slower at the end.
            lasts = until == stopped or until >= self.danger - DELAY * hz
            lasts = lasts and self._ahead[begin] < 0 and ahead[end] < ahead[begin]
            # An NPC that accelerated afterwards caused the danger itself.
            since = max(until, self._before)
            if lasts and behind[end] <= behind[since : end + 1].min() + DROVE_ON:
                # A reason counts from a second before the start of the braking until the braking counts as hard.
                ticks = slice(
                    max(begin - round(DELAY * hz), 0),
                    min(begin + round(HARD_SECONDS * hz), end) + 1,
                )
                if not reasons(self._trace, ticks).any():
                    return begin, fault
        return None


def reasons(trace: Trace, ticks: slice) -> npt.NDArray[np.bool_]:
    """Return for each tick whether the ego had a reason to brake."""
    frame = frame_of(trace)
    speed, others = frame.speed[0, ticks], frame.speed[1:, ticks]
    ahead, right = frame.ahead[:, ticks], frame.right[:, ticks]
    along = np.abs(ahead) - frame.half_along[0, ticks] - frame.half_along[1:, ticks]
    across = np.abs(right) - frame.half_across[0, ticks] - frame.half_across[1:, ticks]
    slowed = -np.diff(frame.speed[1:], prepend=frame.speed[1:, :1])[:, ticks] * trace.physics_hz
    # A vehicle in the same track is too close by RSS, near a collision, or near and brakes hard.
    is_near, safe = along <= NEAR_SECONDS * speed, frame.safe_along(DISTANCES).T[:, ticks]
    is_close = (along < np.maximum(safe, STANDSTILL_GAP)) | (
        along < NEAR_SECONDS * (speed - others)
    )
    is_close |= is_near & (slowed > HARD)
    # A near vehicle moves in from the next lane.
    lane = trace.lanes[max(int(trace.states[ticks.stop - 1, 0, LANE]), 0)]
    towards = np.sign(right) * (frame.drift[0, ticks] - frame.drift[1:, ticks]) >= DRIFTING
    comes = (across > 0) & (across < lane.width) & towards & is_near
    found = (((ahead > 0) | (along <= 0)) & (((across <= 0) & is_close) | comes)).any(axis=0)

    def nears(places: FloatArray, speeds: FloatArray, stretch: Stretch) -> npt.NDArray[np.bool_]:
        before = np.maximum(NEAR_SECONDS * speeds, STANDSTILL_GAP)
        return np.asarray((places < stretch[1]) & (stretch[0] - places <= before))

    # The ego and a crossing NPC are both in their conflict zone, or near it.
    for npc, zone in enumerate(trace.zones):
        if zone is not None:
            own = nears(trace.track_of(0)[ticks, ALONG], trace.ego[ticks, SPEED], zone.ego)
            found |= own & nears(
                trace.way_of(npc)[ticks], trace.states[ticks, npc + 1, SPEED], zone.npc
            )
    # The lane ends soon.
    finish = (
        lane.x + lane.length * math.cos(lane.heading),
        lane.y + lane.length * math.sin(lane.heading),
    )
    finish = lane.points[-1] if lane.points else finish
    starts = [each.points[0] if each.points else (each.x, each.y) for each in trace.lanes]
    if all(math.dist(finish, start) >= 1.0 for start in starts):  # no other lane continues it
        left = np.hypot(finish[0] - trace.ego[ticks, X], finish[1] - trace.ego[ticks, Y])
        found |= left < NEAR_SECONDS * np.abs(trace.ego[ticks, SPEED])
    return np.asarray(found)


# Rule 1, right of way at junctions. Sources: Shalev-Shwartz, Shammah, Shashua, definitions 15 to 18, as implemented in
# ad-rss-lib; Vienna Convention on Road Traffic, Art. 1 and 18.


def _where_ways_meet(trace: Trace, npc: int, zone: Zone) -> Ruling:
    since, until = max(stretches(~np.isnan(trace.track_of(npc + 1)[:, ALONG])), default=(0, 0))
    lane = None
    # If the NPC is on the ego's path at the impact, rules 2 to 5 can apply. They decide if the danger started there.
    if until - since > 1 and until == trace.ticks + 1:
        part = {name: getattr(trace, name)[since:until] for name in ("states", "track", "on_way")}
        lane = Conflict(replace(trace, **part), npc)
        found = lane.verdict._replace(tick=lane.verdict.tick + since)
        if lane.danger > 0:
            return found
    ego, other = Passing(trace, 0, zone), Passing(trace, npc + 1, zone)
    is_in_zone = ego.is_inside and other.is_inside
    has_merged = zone.kind == "merging" and lane is not None
    if ego.has_entered and other.has_entered and (is_in_zone or has_merged):
        # The vehicle with the right of way never has to give way, but it must not drive into an occupied zone either.
        pairs = ((ego, other), (other, ego))
        holder = {"ego": ego, "npc": other}.get(zone.priority)
        owing = [own.vehicle for own, it in pairs if own is not holder and own.did_not_give_way(it)]
        taken = [
            own.vehicle for own, it in pairs if own.vehicle not in owing and own.saw_it_taken(it)
        ]
        if owing or taken:
            first, failed = (ego, other)[(owing or taken)[0] > 0], {*owing, *taken}
            who: Responsibility = "both" if len(failed) > 1 else "npc" if 0 not in failed else "ego"
            fault: Fault = "did-not-give-way" if 0 in owing else "entered-taken-zone"
            return Ruling(who, first.entry, "entered", first.vehicle, fault)
    if lane is not None:
        return found
    return Ruling("none", trace.ticks, "entered" if is_in_zone else "elsewhere")


class Passing:
    """A vehicle that approaches a conflict zone along its path.

    Attributes:
        places: position [m] along the path at each tick.
        speeds: speed [m/s] at each tick.
        begins, ends: start and end [m] of the zone along the path.
        entry: tick at which the vehicle enters the zone, or the last tick.
        has_entered: True if the vehicle is in the zone or past it at the last tick.
    """

    def __init__(self, trace: Trace, vehicle: int, zone: Zone) -> None:
        self.vehicle, self._trace, self._hz = vehicle, trace, trace.physics_hz
        self._merges = zone.kind == "merging"
        self.places = trace.way_of(vehicle - 1) if vehicle else trace.track_of(0)[:, ALONG]
        self.speeds = trace.states[:, vehicle, SPEED]
        self.begins, self.ends = zone.npc if vehicle else zone.ego
        self.half_length = float(trace.sizes[vehicle, 0]) / 2
        self.has_entered = bool(self.places[-1] >= self.begins)
        self.entry = last_stretch(self.places >= self.begins) if self.has_entered else trace.ticks
        self.is_inside = self.has_entered and bool(self.places[-1] <= self.ends)

    def _stops(self, before: int, place: float) -> int:
        # The last tick, before another, at which an ordinary response stops the vehicle short of a position [m].
        left, speeds = place - self.places[:before], self.speeds[:before]
        could = np.flatnonzero(left >= speeds * DELAY + speeds**2 / (2 * HARDEST))
        return int(could[-1]) if could.size else -1

    def _foreseen(self, tick: int, time: float) -> float:
        # The position [m] at a time [s], if the vehicle keeps the speed that it has at the tick.
        speed = max(float(self.speeds[tick]), 0.0)
        return float(self.places[tick]) + (speed * (time - tick / self._hz) if speed else 0.0)

    def did_not_give_way(self, other: Passing) -> bool:
        """Return whether the vehicle could have foreseen that it should stop for the other one."""
        # Everything is foreseen at the last chance to stop before the zone.
        chance, hz, entry = max(self._stops(self.entry, self.begins), 0), self._hz, self.entry
        out, speed = np.flatnonzero(self.places[entry:] >= self.ends), float(self.speeds[-1])
        leaves = (entry + out[0]) / hz if out.size else math.inf
        if not out.size and speed > 0:
            leaves = (len(self.places) - 1) / hz + float(self.ends - self.places[-1]) / speed
        place, faster = other._foreseen(chance, entry / hz), max(float(other.speeds[chance]), 0.0)
        if other._foreseen(chance, leaves) < other.begins:
            return False
        # Crossing: the other vehicle would have to brake harder than GENTLY. Merging: behind, it is closer than a lane
        # change permits; ahead, it is closer than the safe distance.
        if not self._merges:
            return (
                other.begins - place < faster * DELAY + faster**2 / (2 * GENTLY)
                and place < other.ends
            )
        lead = float((other.ends - place) - (self.ends - self.places[entry]))
        gap, own = abs(lead) - self.half_length - other.half_length, self.speeds[entry]
        if lead >= 0:
            return gap < room_to_leave(faster, float(own))
        return gap < float(DISTANCES.safe_along(own, np.asarray(faster), DELAY))

    def saw_it_taken(self, other: Passing) -> bool:
        """Return whether the vehicle entered although it could have stopped or slowed down for the other one."""
        # Merging: could it still slow down to the speed of the other, which had merged ahead of it?
        if self._merges:
            ticks = np.arange(other.entry, self.entry)
            lead = self.ends - self.places[ticks] - (other.ends - other.places[ticks])
            lowest = np.minimum.accumulate(other.speeds[::-1])[::-1][ticks]
            faster = np.maximum(self.speeds[ticks] - lowest, 0.0)
            room = faster * DELAY + faster**2 / (2 * HARDEST)
            return bool(((lead > 0) & (lead - self.half_length - other.half_length >= room)).any())
        # Crossing: could it still stop before it touched the other at its final position?
        poses = self._trace.states[:, self.vehicle], self._trace.states[-1:, other.vehicle]
        mine, its = (
            Boxes.driving(
                *rows[:, [X, Y, HEADING, SPEED]].T, *self._trace.sizes[each.vehicle, :, None]
            )
            for rows, each in zip(poses, (self, other), strict=True)
        )
        touched = last_stretch(overlaps(relate(mine, its)))
        tick = self._stops(touched, float(self.places[touched]))
        return (
            tick >= other.entry
            and other._foreseen(tick, max(self.entry, tick) / self._hz) < other.ends
        )
