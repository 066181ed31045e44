"""Responsibility for a collision, by five rules that read only the trace of the run.

:func:`rss_rule` decides the verdict; :func:`position_rule` is a second opinion. docs/explanation/verdicts.md has the
rules, each in one sentence, and their numbers with their sources.
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
from pytest_pafot.model.trace import ACROSS, ALONG, HEADING, LANE, OFFSET, SPEED, FloatArray, Trace, X, Y

Responsibility = Literal["ego", "npc", "both", "none"]
"""The vehicles that are responsible for a collision. It is ``none`` without a collision, and if the ways of the
vehicles met and neither could have foreseen the other in time."""

Fault = Literal[
    "entered-lane",
    "cut-in-unanswered",
    "leader-unanswered",
    "braked-for-nothing",
    "stopped-for-nothing",
    "did-not-give-way",
    "entered-taken-zone",
]
"""The faults of the ego, in this order. It moved into another vehicle's way. It did not answer a cut-in, or a vehicle
ahead in its lane. It braked hard, or stopped, with nothing in its way. In a zone where its way meets the NPC's, it did
not give way, or it drove in while the NPC visibly was there."""

UNANSWERED: tuple[Fault, ...] = ("cut-in-unanswered", "leader-unanswered")
"""The faults of an ego behind that did not answer."""

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
"""The mistakes of the ego, in this order. It did not keep its distance to a vehicle ahead, also after a lane change
behind that vehicle or after that vehicle's cut-in. It changed lanes into a vehicle next to it, or in front of a vehicle
behind. It braked hard, or stopped, with nothing in its way. It did not give way to a vehicle from the left, the right,
ahead or behind. It drove into a zone in which another vehicle visibly was."""

DELAY, DELAY_AFTER_CUT_IN = 1.0, 1.4
"""The time until a driver's brakes act, for a vehicle ahead (RSS) and for one that came in from the side [s]: 0.4 s to
perceive the risk, 0.75 s until the brakes act, and half the time in which they build up (UN R157, annex 4, appendix 3).
The first is also the headway that a lane change leaves, and the time for which what a vehicle did still counts."""
HARDEST = 6.0
"""The braking that the rules require of a driver [m/s^2] (UN R157, 5.2.5.2)."""
DISTANCES = RssRules(ego_response=1.0, npc_response=1.0, acceleration=0.0, least_braking=HARDEST, hardest_braking=8.0)
"""The safe distances of attribution. The usual headway of two seconds to a leader of equal speed must never be a fault:
with these values it is safe up to 48 m/s (v + v^2 / 48 <= 2 v). RSS also assumes that the follower speeds up during the
response time, which would require more than two seconds. A leader brakes with at most 8 m/s^2, the hardest that NPCs
can. Lateral values, which the rules do not use, are the defaults of :class:`~pytest_pafot.criticality.RssRules`."""
GENTLY, AFTER = 3.0, 0.4
"""The braking [m/s^2] that a lane change or a vehicle at a crossing may require of another vehicle, and the time until
it begins [s] (UN R79, 5.6.4.7)."""
DRIFTING = 0.3
"""The sideways speed from which on a vehicle moves towards a different lane [m/s]; a slower vehicle only wanders."""
RECENT, SOON = 2.0, 6.0
"""The time before the tracks met in which a vehicle moved into the other's lane, and the time before the impact in
which an NPC that left too little room shares the responsibility [s]."""
BLOCKED, SLOWED = 0.3, 2.0
"""The headway [s] below which a cut-in by an NPC that also brakes hard leaves an ego that slows down a second more, and
the speed that an ego loses at least to have slowed down for a cut-in [m/s]."""
NEXT_TO = 2.0
"""The gap up to which a vehicle ahead or behind counts as next to one that changes lanes [m]."""
HARD, HARD_SECONDS = 4.0, 0.4
"""The deceleration above which braking is hard [m/s^2], because a careful driver needs no more to keep its distance,
and the least time for which it lasts [s]."""
STANDING_SPEED, LONG = 0.1, 3.0
"""The speed up to which a vehicle stands [m/s], and the time after which it has stood, or led in its new lane, for long
[s]."""
NEAR_SECONDS, STANDSTILL_GAP = 4.0, 5.0
"""The time to collision, or at its own speed, in which a vehicle ahead is a reason to brake [s], and the gap below
which it always is [m]."""
DROVE_ON = 1.0
"""The gain in speed above which an NPC behind an ego that had braked for nothing caused the danger itself [m/s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Attribution:
    """The responsibility for a collision and what happened.

    Attributes:
        responsibility: vehicles that are responsible for the collision.
        tick, time: tick and time [s] at which the decisive lane change, braking or danger began; None without a
            collision.
        fault: fault of the ego; None if the ego is not responsible.
        sentences: lines that say what happened, each one a measured fact; empty without a collision.
        contested: fault of an ego that ran into an NPC and that the rules excuse for want of time, or that shares the
            responsibility with an NPC that moved in: a careful driver can tell whether there was time. Otherwise None.
        takeover: the latest takeover by which a careful driver has decided this [s before the impact]; 0 if none avoids
            the collision, None if no careful driver was asked.
        mistake: what the ego did wrong, in a few words; None if it is not responsible, and in the result of
            :func:`rss_rule`, which does not ask for it.
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
    """The result of a rule: who is responsible, for what fault, and for the text what a vehicle did at which tick."""

    responsibility: Responsibility
    tick: int
    happened: Happened
    vehicle: int = 0
    fault: Fault | None = None


def rss_rule(trace: Trace) -> Attribution:
    """Attribute a collision by the five rules of docs/explanation/verdicts.md, which has their numbers and sources.

    Where the ways of ego and NPC meet, who did not give way is responsible. Who moves into the other's way without
    leaving room is. Who is behind is, if an ordinary response would have avoided the collision. Who braked or stopped
    for nothing is, together with the one behind if that one could have avoided it. Of two side by side, the one that
    moved sideways is. The ego is always responsible for touching a fixed object.

    Sources: Shalev-Shwartz, Shammah, Shashua, "On a Formal Model of Safe and Scalable Self-driving Cars",
    arXiv:1708.06374 (distances, danger, proper response, right of way); UN Regulations No. 79 (lane changes) and No.
    157 (numbers of a careful driver); Vienna Convention on Road Traffic, Art. 17 (braking for nothing) and 18.
    """
    hit, hz = trace.collision, trace.physics_hz
    if hit is None:
        return Attribution(responsibility="none", tick=None, time=None)
    npc = hit.npc
    if npc is None:
        return Attribution(responsibility="ego", tick=hit.tick, time=hit.time)
    zone = trace.zones[npc] if trace.zones else None
    found = Conflict(trace, npc).verdict if zone is None else _where_ways_meet(trace, npc, zone)
    is_contested = hit.side == "front" and found.fault in UNANSWERED and found.responsibility != "ego"
    return Attribution(
        responsibility=found.responsibility,
        tick=found.tick,
        time=found.tick / hz,
        fault=found.fault if found.responsibility in ("ego", "both") else None,
        sentences=sentences_on(trace, frame_of(trace), npc, found.happened, found.vehicle, found.tick),
        contested=found.fault if is_contested else None,
    )


def position_rule(trace: Trace) -> Responsibility:
    """Attribute a collision by the NPC's position at the impact, as the released code of the paper's authors does.

    It is a second opinion. An ego at 0.1 m/s or less is never responsible. A faster ego is responsible if the NPC was
    ahead of it, in cell 1, 2 or 3; otherwise the NPC is responsible. An NPC that was not on the ego's way is in no
    cell; it counts as ahead if it hit the ego's front. The paper itself counts all collisions alike.
    """
    hit = trace.collision
    if hit is None or hit.npc is None:
        return "none" if hit is None else "ego"
    was_ahead = hit.side == "front" if hit.cell is None else hit.cell.row > 0
    return "ego" if was_ahead and hit.ego_speed > STANDING_SPEED else "npc"


@lru_cache(maxsize=1)
def frame_of(trace: Trace) -> RoadFrame:
    """Return a run's positions and velocities along and across the road.

    The last result is cached, because verdict, mistake and situation of a run all need it.
    """
    return RoadFrame(trace)


def braking(trace: Trace, vehicle: int = 0) -> FloatArray:
    """Return a vehicle's deceleration in the step before each tick [m/s^2], shape [ticks + 1].

    Negative if the vehicle speeds up. Vehicle 0 is the ego.
    """
    speed = trace.states[:, vehicle, SPEED]
    return -np.diff(speed, prepend=speed[:1]) * trace.physics_hz


def room_to_leave(follower: float, mover: float) -> float:
    """Return the gap that a vehicle has to leave to the vehicle behind when it enters a lane [m].

    ``follower`` is the speed of the vehicle behind and ``mover`` the speed of the vehicle that enters [m/s].
    """
    faster = max(follower - mover, 0.0)
    return max(faster * AFTER + faster**2 / (2 * GENTLY) + mover * DELAY, 0.0)


class Conflict:
    """The conflict of the ego (vehicle 0) and the NPC that it collided with, in a lane or side by side."""

    def __init__(self, trace: Trace, npc: int) -> None:
        self._trace, self._npc, self._frame = trace, npc + 1, frame_of(trace)
        self._end, self._hz, frame = trace.ticks, trace.physics_hz, self._frame
        self._ahead = frame.ahead[npc]  # of the NPC, from the ego
        self._gaps = np.abs(self._ahead) - frame.half_along[0] - frame.half_along[npc + 1]
        self._met = last_stretch(frame.gap_across[:, npc] <= 0)  # from here to the impact they were in one track
        self.danger = last_stretch(self._gaps < np.maximum(frame.safe_along(DISTANCES)[:, npc], 1e-9))
        self._before = max(self.danger - 1, 0)  # the last safe tick; responses count from here

    @cached_property
    def verdict(self) -> Ruling:
        """The verdict by rules 2 to 5."""
        ego, npc = self._moved_in(0), self._moved_in(self._npc)
        if max(ego, npc) >= 0 and max(ego, npc, self._met) >= self.danger:
            return self._ego_moved_in(ego) if ego >= npc else self._npc_moved_in(npc)
        if max(ego, npc) < 0 and 0 < self._met >= self.danger and self._gaps[self._met] <= 0:
            return self._came_together()
        if self._ahead[self.danger] < 0:
            return self._npc_followed(0, Ruling("npc", self.danger, "close", self._npc))
        could = self._could_avoid(0, self._before, DELAY)
        return Ruling("ego" if could else "npc", self.danger, "close", 0, "leader-unanswered")

    def _moved_in(self, vehicle: int) -> int:
        """Return the last tick at which a vehicle's box came over the line of the lane that the other is in; else -1.

        The vehicle moves there with at least 0.3 m/s, and the other stays in its lane. It counts until 2 s before the
        tracks met.
        """
        trace, end, other = self._trace, self._end, self._npc - vehicle
        tracks, lanes = trace.road.track, trace.states[:, other, LANE].astype(int)
        widths = np.array([lane.width for lane in trace.lanes])
        centre = tracks[:, other, ACROSS] - tracks[:, other, OFFSET]
        away = tracks[:, vehicle, ACROSS] - centre
        over = np.abs(away) - self._frame.half_across[vehicle] < widths[np.maximum(lanes, 0)] / 2
        towards = -np.sign(away) * self._frame.drift[vehicle] >= DRIFTING
        came = over[1 : end + 1] & ~over[:end] & towards[1 : end + 1] & (lanes[1 : end + 1] == lanes[:end])
        ticks = np.flatnonzero(came) + 1
        return int(ticks[-1]) if ticks.size and ticks[-1] >= self._met - RECENT * self._hz else -1

    def _has_room(self, mover: int, tick: int) -> bool:
        """Return whether a vehicle leaves room to the one behind at a tick."""
        behind, speed = self._frame.speed[self._npc - mover, tick], self._frame.speed[mover, tick]
        return bool(self._gaps[tick] >= room_to_leave(float(behind), float(speed)))

    def _ego_moved_in(self, tick: int) -> Ruling:
        """Rule 2 for the ego: it is responsible, unless it left room, or has led for 3 s."""
        moved, npc = Ruling("ego", tick, "moved", 0, "entered-lane"), self._npc
        if self._ahead[tick] >= 0:
            return moved
        if self._has_room(0, tick) and self._has_room(0, max(self._met, tick)):
            return self._npc_followed(tick, moved._replace(responsibility="npc"))
        led = tick + round(LONG * self._hz)
        if self._could_avoid(npc, max(led, self._before), DELAY, later=False):
            return self._npc_followed(led, moved._replace(responsibility="npc"))
        could = self._gaps[tick] >= NEXT_TO and self._could_avoid(npc, max(tick, self._before), DELAY)
        return moved._replace(responsibility="both" if could else "ego")

    def _npc_moved_in(self, tick: int) -> Ruling:
        """Rule 2 for an NPC, and rule 3 for the ego behind that NPC."""
        gap, speed = self._gaps[tick], self._frame.speed[0]
        moved = Ruling("npc", tick, "moved", self._npc, "cut-in-unanswered")
        if gap > 0 and self._ahead[tick] < 0:
            return self._npc_followed(tick, moved, moved_in=True)
        since, is_blocked = tick, gap < BLOCKED * speed[tick] and bool(self._hard_brakings(self._npc, tick + 1))
        has_slowed = speed[self._end] < speed[tick] - SLOWED
        if is_blocked and has_slowed:
            since = tick + round(DELAY * self._hz)
        if not self._could_avoid(0, since, DELAY_AFTER_CUT_IN):
            if gap > 0 and not has_slowed and self._end - tick >= DELAY_AFTER_CUT_IN * self._hz:
                return moved._replace(responsibility="both")
            return moved
        is_pushed = not self._has_room(self._npc, tick) and self._end - tick <= SOON * self._hz
        return moved._replace(responsibility="both" if is_pushed else "ego")

    def _came_together(self) -> Ruling:
        """Rule 5: side by side, who moved sideways into the other is responsible; else who is over its line."""
        tick, frame, npc = self._met, self._frame, self._npc
        side = 1.0 if frame.right[npc - 1, max(tick - 1, 0)] >= 0 else -1.0
        drifts = side * frame.drift[0, tick], -side * frame.drift[npc, tick]
        moves = [drift >= DRIFTING for drift in drifts]
        if moves[0] == moves[1] and not moves[0]:
            tracks, lanes = self._trace.road.track[tick, :, OFFSET], self._trace.states[tick, :, LANE].astype(int)
            for index, (vehicle, way) in enumerate(((0, side), (npc, -side))):
                half = self._trace.lanes[max(lanes[vehicle], 0)].width / 2
                moves[index] = bool(way * tracks[vehicle] + frame.half_across[vehicle, tick] > half)
            if moves[0] == moves[1]:
                moves = [False, True]
        who: Responsibility = "both" if all(moves) else "ego" if moves[0] else "npc"
        return Ruling(who, tick, "sideways", 0 if moves[0] else npc, "entered-lane")

    def _could_avoid(self, behind: int, first: int, delay: float, *, later: bool = True) -> bool:
        """Rule 3: return whether an ordinary response of the one behind, at a tick or later on, avoids the impact.

        It drives as recorded, but no faster, until the delay is over [s], and then brakes with 6 m/s^2 while it is
        faster than the other, which drives as recorded. At the impact, it must be further back than recorded by more
        than the distance in which it loses what it is faster.
        """
        own, other, end = self._frame.speed[behind], self._frame.speed[self._npc - behind], self._end
        starts = np.arange(first, end if later else min(first + 1, end))
        starts = starts[(self._ahead[starts] < 0) if behind else (self._ahead[starts] > 0)]
        if not starts.size:
            return False
        speed, back = np.full(len(starts), own[first]), np.zeros(len(starts))
        due, step = starts + round(delay * self._hz), HARDEST / self._hz
        for tick in range(first, end):
            back += np.where(tick >= starts, own[tick] - speed, 0.0)
            braked = np.where(speed > other[tick], np.maximum(speed - step, 0.0), speed)
            driven = np.where(tick < starts, own[tick + 1], np.minimum(speed, own[tick + 1]))
            speed = np.where(tick + 1 >= due, braked, driven)
        return bool((back / self._hz > np.maximum(speed - other[end], 0.0) ** 2 / (2 * HARDEST)).any())

    def _hard_brakings(self, vehicle: int, first: int = 0) -> list[tuple[int, int]]:
        """Return the first tick, and the tick after the last, of each hard braking of a vehicle from a tick on."""
        found = stretches(braking(self._trace, vehicle)[first : self._end + 1] > HARD)
        return [(begin, until) for begin, until in found if until - begin >= HARD_SECONDS * self._hz]

    def _npc_followed(self, duty: int, found: Ruling, *, moved_in: bool = False) -> Ruling:
        """Rule 4: the NPC behind is responsible, unless the ego braked or stopped for nothing.

        ``duty`` is the tick from which on the NPC had to answer, and ``moved_in`` whether it moved in behind the ego.
        """
        needless = self._needless
        if needless is None:
            return found
        begin, fault = needless
        could = moved_in or self._could_avoid(self._npc, max(duty, min(begin, self._before)), DELAY)
        happened: Happened = "stopped" if fault == "stopped-for-nothing" else "braked"
        return Ruling("both" if could else "ego", begin, happened, 0, fault)

    @cached_property
    def _needless(self) -> tuple[int, Fault] | None:
        """The tick at which the ego began to brake or to stop for nothing, and the fault; None if it did not.

        There are two kinds: hard braking, and a stop that has lasted for 3 s. The braking must have
        lasted until 1 s before the danger or later, and there must be no reason from 1 s before it on.
        The NPC must have been behind the ego then, and must not have sped up since.
        """
        speed, hz, end = self._trace.ego[:, SPEED], self._hz, self._end
        hard = self._hard_brakings(0)
        found: list[tuple[int, int, Fault]] = [(until - 1, begin - 1, "braked-for-nothing") for begin, until in hard]
        stopped = last_stretch(speed <= STANDING_SPEED)
        if speed[end] <= STANDING_SPEED and 0 < stopped <= end - LONG * hz:
            slows = np.append(np.diff(speed[: stopped + 1]) < 0, True)
            found.append((stopped, last_stretch(slows), "stopped-for-nothing"))
        ahead, behind = self._frame.speed[[0, self._npc]]
        for until, begin, fault in sorted(found, key=lambda each: each[0], reverse=True):
            lasts = until == stopped or until >= self.danger - DELAY * hz
            lasts = lasts and self._ahead[begin] < 0 and ahead[end] < ahead[begin]
            since = max(until, self._before)
            if lasts and behind[end] <= behind[since : end + 1].min() + DROVE_ON:
                ticks = slice(max(begin - round(DELAY * hz), 0), min(begin + round(HARD_SECONDS * hz), end) + 1)
                if not reasons(self._trace, ticks).any():
                    return begin, fault
        return None


def reasons(trace: Trace, ticks: slice) -> npt.NDArray[np.bool_]:
    """Return whether anything ahead gave the ego a reason to brake, at each of the ticks.

    There are four reasons. A vehicle ahead in the same track is closer than RSS allows, or less than four seconds from
    a collision. A vehicle within four seconds of driving brakes hard in the same track, or moves in from the next lane.
    An NPC's way meets the ego's way in a zone, and both are in the zone or within four seconds of it. The lane ends
    within four seconds.
    """
    frame = frame_of(trace)
    speed, others = frame.speed[0, ticks], frame.speed[1:, ticks]
    ahead, right = frame.ahead[:, ticks], frame.right[:, ticks]
    along = np.abs(ahead) - frame.half_along[0, ticks] - frame.half_along[1:, ticks]
    across = np.abs(right) - frame.half_across[0, ticks] - frame.half_across[1:, ticks]
    slowed = -np.diff(frame.speed[1:], prepend=frame.speed[1:, :1])[:, ticks] * trace.physics_hz
    is_near, safe = along <= NEAR_SECONDS * speed, frame.safe_along(DISTANCES).T[:, ticks]
    is_close = (along < np.maximum(safe, STANDSTILL_GAP)) | (along < NEAR_SECONDS * (speed - others))
    is_close |= is_near & (slowed > HARD)
    lane = trace.lanes[max(int(trace.states[ticks.stop - 1, 0, LANE]), 0)]
    towards = np.sign(right) * (frame.drift[0, ticks] - frame.drift[1:, ticks]) >= DRIFTING
    comes = (across > 0) & (across < lane.width) & towards & is_near
    found = (((ahead > 0) | (along <= 0)) & (((across <= 0) & is_close) | comes)).any(axis=0)

    def nears(places: FloatArray, speeds: FloatArray, stretch: Stretch) -> npt.NDArray[np.bool_]:
        before = np.maximum(NEAR_SECONDS * speeds, STANDSTILL_GAP)
        return np.asarray((places < stretch[1]) & (stretch[0] - places <= before))

    for npc, zone in enumerate(trace.zones):
        if zone is not None:
            own = nears(trace.track_of(0)[ticks, ALONG], trace.ego[ticks, SPEED], zone.ego)
            found |= own & nears(trace.way_of(npc)[ticks], trace.states[ticks, npc + 1, SPEED], zone.npc)
    finish = (lane.x + lane.length * math.cos(lane.heading), lane.y + lane.length * math.sin(lane.heading))
    finish = lane.points[-1] if lane.points else finish
    starts = [each.points[0] if each.points else (each.x, each.y) for each in trace.lanes]
    if all(math.dist(finish, start) >= 1.0 for start in starts):  # no other lane continues it
        left = np.hypot(finish[0] - trace.ego[ticks, X], finish[1] - trace.ego[ticks, Y])
        found |= left < NEAR_SECONDS * np.abs(trace.ego[ticks, SPEED])
    return np.asarray(found)


# Rule 1, right of way where the NPC's way meets the ego's. Sources: Shalev-Shwartz, Shammah, Shashua, definitions 15 to
# 18, as ad-rss-lib has them; Vienna Convention on Road Traffic, Art. 1 and 18.


def _where_ways_meet(trace: Trace, npc: int, zone: Zone) -> Ruling:
    """Attribute a collision with a crossing NPC by right of way, or by the rules for two vehicles in one lane."""
    since, until = max(stretches(~np.isnan(trace.track_of(npc + 1)[:, ALONG])), default=(0, 0))
    lane = None
    if until - since > 1 and until == trace.ticks + 1:  # it is on the ego's way at the impact
        part = {name: getattr(trace, name)[since:until] for name in ("states", "track", "on_way")}
        lane = Conflict(replace(trace, **part), npc)
        found = lane.verdict._replace(tick=lane.verdict.tick + since)
        if lane.danger > 0:
            return found
    ego, other = Passing(trace, 0, zone), Passing(trace, npc + 1, zone)
    is_in_zone = ego.is_inside and other.is_inside
    has_merged = zone.kind == "merging" and lane is not None
    if ego.has_entered and other.has_entered and (is_in_zone or has_merged):
        pairs = ((ego, other), (other, ego))
        holder = {"ego": ego, "npc": other}.get(zone.priority)
        owing = [own.vehicle for own, it in pairs if own is not holder and own.did_not_give_way(it)]
        taken = [own.vehicle for own, it in pairs if own.vehicle not in owing and own.saw_it_taken(it)]
        if owing or taken:
            first, failed = (ego, other)[(owing or taken)[0] > 0], {*owing, *taken}
            who: Responsibility = "both" if len(failed) > 1 else "npc" if 0 not in failed else "ego"
            fault: Fault = "did-not-give-way" if 0 in owing else "entered-taken-zone"
            return Ruling(who, first.entry, "entered", first.vehicle, fault)
    if lane is not None:
        return found
    return Ruling("none", trace.ticks, "entered" if is_in_zone else "elsewhere")


class Passing:
    """A vehicle that approaches a zone along its way.

    Attributes:
        places: position of the vehicle along its way at each tick [m].
        speeds: speed of the vehicle along its heading at each tick [m/s].
        begins, ends: stretch of the vehicle's way in the zone [m].
        entry: tick at which the vehicle enters the zone, or the last tick.
        has_entered: whether it has entered the zone and is not back before it at the last tick.
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
        """Return the last tick, before another, at which an ordinary response stops the vehicle before a place [m].

        It is -1 if the vehicle was always too fast.
        """
        left, speeds = place - self.places[:before], self.speeds[:before]
        could = np.flatnonzero(left >= speeds * DELAY + speeds**2 / (2 * HARDEST))
        return int(could[-1]) if could.size else -1

    def _foreseen(self, tick: int, time: float) -> float:
        """Return the vehicle's place [m] at a time [s] if it keeps the speed that it has at a tick."""
        speed = max(float(self.speeds[tick]), 0.0)
        return float(self.places[tick]) + (speed * (time - tick / self._hz) if speed else 0.0)

    def did_not_give_way(self, other: Passing) -> bool:
        """Return whether the vehicle could foresee at its chance to stop that the other would be in the zone, or near.

        Near is so near that the other would have to brake harder than 3 m/s^2, or, where ways merge, nearer than the
        room that a lane change leaves, or than the safe distance.
        """
        chance, hz, entry = max(self._stops(self.entry, self.begins), 0), self._hz, self.entry
        out, speed = np.flatnonzero(self.places[entry:] >= self.ends), float(self.speeds[-1])
        leaves = (entry + out[0]) / hz if out.size else math.inf
        if not out.size and speed > 0:
            leaves = (len(self.places) - 1) / hz + float(self.ends - self.places[-1]) / speed
        place, faster = other._foreseen(chance, entry / hz), max(float(other.speeds[chance]), 0.0)
        if other._foreseen(chance, leaves) < other.begins:
            return False
        if not self._merges:
            return other.begins - place < faster * DELAY + faster**2 / (2 * GENTLY) and place < other.ends
        lead = float((other.ends - place) - (self.ends - self.places[entry]))
        gap, own = abs(lead) - self.half_length - other.half_length, self.speeds[entry]
        if lead >= 0:
            return gap < room_to_leave(faster, float(own))
        return gap < float(DISTANCES.safe_along(own, np.asarray(faster), DELAY))

    def saw_it_taken(self, other: Passing) -> bool:
        """Return whether the vehicle drove in although it could still stop short of the other, which stayed there.

        Where ways merge, it could still slow down to the speed of the other, which had merged ahead.
        """
        if self._merges:
            ticks = np.arange(other.entry, self.entry)
            lead = self.ends - self.places[ticks] - (other.ends - other.places[ticks])
            lowest = np.minimum.accumulate(other.speeds[::-1])[::-1][ticks]
            faster = np.maximum(self.speeds[ticks] - lowest, 0.0)
            room = faster * DELAY + faster**2 / (2 * HARDEST)
            return bool(((lead > 0) & (lead - self.half_length - other.half_length >= room)).any())
        poses = self._trace.states[:, self.vehicle], self._trace.states[-1:, other.vehicle]
        mine, its = (
            Boxes.driving(*rows[:, [X, Y, HEADING, SPEED]].T, *self._trace.sizes[each.vehicle, :, None])
            for rows, each in zip(poses, (self, other), strict=True)
        )
        touched = last_stretch(overlaps(relate(mine, its)))
        tick = self._stops(touched, float(self.places[touched]))
        return tick >= other.entry and other._foreseen(tick, max(self.entry, tick) / self._hz) < other.ends
