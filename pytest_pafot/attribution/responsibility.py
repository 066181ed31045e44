"""Responsibility for a collision, according to five rules that read only the trace, and the ego's driving error.

docs/explanation/verdicts.md states the rules, their numbers and the sources.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from types import MappingProxyType
from typing import Literal, NamedTuple

import numpy as np

from pytest_pafot.attribution.sentences import Happened, sentences_on
from pytest_pafot.criticality import RoadFrame, RssRules
from pytest_pafot.criticality.measures import Boxes, last_stretch, overlaps, relate, stretches
from pytest_pafot.model.crossings import Origin, Stretch, Zone
from pytest_pafot.model.trace import (
    ACROSS,
    ALONG,
    HEADING,
    LANE,
    OFFSET,
    SPEED,
    BoolArray,
    FloatArray,
    Lane,
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

# The manoeuvre of a vehicle shortly before an event, which distinguishes kinds of failures.
Manoeuvre = Literal["lane-change", "lane-keeping"]

# A lane change belongs to an event that follows within this time [s]. At motorway speed, a lane change takes about 2 s.
WINDOW_SECONDS = 4.0

# A vehicle keeps its lane if it moves sideways by at most this distance within WINDOW_SECONDS [m], half of the free
# width of a lane.
DISPLACEMENT = 1.0

# The time until a driver's brakes act, for a vehicle ahead (RSS) and for one that cuts in [s]. The second consists of
# 0.4 s to perceive the risk, 0.75 s until the brakes act, and half of the time in which braking builds up (UN R157,
# annex 4, appendix 3). The first is also the headway that a lane change must leave, and the time for which an earlier
# action still counts.
DELAY = 1.0
DELAY_AFTER_CUT_IN = 1.4
# The braking that the rules require of a driver [m/s^2] (UN R157, 5.2.5.2).
HARDEST = 6.0
# The usual headway of two seconds to a leader of equal speed must never be a fault. With these values it is safe up to
# 48 m/s (v + v^2 / 48 <= 2 v). RSS also assumes that the follower accelerates during its response time, which would
# require more than two seconds. A leader brakes at 8 m/s^2 at most, like an NPC.
DISTANCES = RssRules(
    ego_response=1.0,
    npc_response=1.0,
    acceleration=0.0,
    least_braking=HARDEST,
    hardest_braking=8.0,
)
# The braking [m/s^2] that a lane change, or a vehicle at a junction, may impose on another vehicle, and the time until
# that braking starts [s] (UN R79, 5.6.4.7).
GENTLY = 3.0
AFTER = 0.4
# A vehicle moves towards another lane at this sideways speed or more [m/s]. A slower one only wanders.
DRIFTING = 0.3
# A lane change counts if the vehicle crossed the line at most this time before both were in the same track [s].
RECENT = 2.0
# An NPC that left too little room shares the responsibility if the impact follows within this time [s].
SOON = 6.0
# If an NPC cuts in with less headway than this [s] and brakes hard, an ego that slows down has one more second.
BLOCKED = 0.3
SLOWED = 2.0  # the loss of speed that counts as slowing down [m/s]
# A vehicle ahead or behind with at most this gap is next to the one that changes lanes [m].
NEXT_TO = 2.0
# Braking is hard above this deceleration [m/s^2] for at least this time [s]. A careful driver needs no more to keep the
# distance.
HARD = 4.0
HARD_SECONDS = 0.4
STANDING_SPEED = 0.1  # a vehicle is stationary up to this speed [m/s]
# The shortest stop that counts, and the time in a new lane after which a vehicle has led for long enough [s].
LONG = 3.0
# A vehicle ahead is near if the ego would reach it in less than this time at the closing speed, or at the ego's own
# speed [s].
NEAR_SECONDS = 4.0
STANDSTILL_GAP = 5.0  # a smaller gap is always a reason to brake [m]
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


def attribute_collision(trace: Trace) -> Attribution:
    """Return the verdict of :func:`rss_rule` on a run's collision, together with the ego's mistake."""
    found = rss_rule(trace)
    return replace(found, mistake=mistake(trace, found))


def decide_contested(found: Attribution, seconds: float | None) -> Attribution:
    """Return the verdict. If it is contested, a careful driver's latest takeover decides it.

    ``seconds`` is the time of that takeover [s before the impact]; 0 if none avoids the collision, None if unknown.
    """
    fault = found.contested
    if fault is None or seconds is None:
        return found
    if not seconds:
        # No takeover helps, so the ego had no time.
        return replace(found, responsibility="npc", fault=None, mistake=None, takeover=seconds)
    # The ego had time, so it shares the responsibility.
    return replace(
        found,
        responsibility="both",
        fault=fault,
        mistake=BY_FAULT[fault],
        takeover=seconds,
    )


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
    hit = trace.collision
    if hit is None:
        return Attribution(responsibility="none", tick=None, time=None)
    npc = hit.npc
    if npc is None:  # a fixed object
        return Attribution(responsibility="ego", tick=hit.tick, time=hit.time)
    zone = trace.zone_of(npc)
    found = _where_ways_meet(trace, npc, zone) if zone else Conflict(trace, npc).verdict()
    who = found.responsibility
    # The rules excuse an ego that ran into an NPC without time to respond. Only a simulation shows whether it had time.
    is_contested = hit.side == "front" and found.fault in UNANSWERED and who != "ego"
    return Attribution(
        responsibility=who,
        tick=found.tick,
        time=found.tick / trace.physics_hz,
        fault=found.fault if who in ("ego", "both") else None,
        sentences=sentences_on(
            trace,
            frame_of(trace),
            npc,
            found.happened,
            found.vehicle,
            found.tick,
        ),
        contested=found.fault if is_contested else None,
    )


def position_rule(trace: Trace) -> Responsibility:
    """Attribute a collision by the NPC's position at the impact, as in the code by the paper's authors.

    The ego is responsible if it moved and the NPC was ahead of it. Otherwise the NPC is responsible.
    """
    hit = trace.collision
    if hit is None:
        return "none"
    if hit.npc is None:
        return "ego"
    # An NPC in no cell was not on the ego's path. It counts as ahead if it hit the ego's front.
    was_ahead = hit.side == "front"
    if hit.cell is not None:
        was_ahead = hit.cell.row > 0
    if was_ahead and hit.ego_speed > STANDING_SPEED:
        return "ego"
    return "npc"


def mistake(trace: Trace, attribution: Attribution) -> Mistake | None:
    """Return the ego's mistake in a collision, or None if the ego is not responsible."""
    fault = attribution.fault
    tick = attribution.tick
    npc = None if trace.collision is None else trace.collision.npc
    if npc is None or fault is None or tick is None:
        return None
    if fault in BY_FAULT:
        return BY_FAULT[fault]
    if fault == "did-not-give-way":
        zone = trace.zone_of(npc)
        if zone is None:
            return None
        return NOT_GIVEN_WAY[zone.origin]
    frame = frame_of(trace)
    # When the ego crossed the line, the other vehicle was ahead if the gap was above NEXT_TO. It was behind if it was
    # completely behind the ego.
    ahead = frame.ahead[npc, tick]
    both = frame.half_lengths(npc)[tick]
    if ahead > both + NEXT_TO:
        return "kept-no-distance"
    if ahead < -both:
        return "moved-in-front"
    return "moved-into-side"


def manoeuvre_before(trace: Trace, vehicle: int, tick: int) -> Manoeuvre:
    """Return a vehicle's manoeuvre at a tick or shortly before it. Vehicle 0 is the ego, ``i + 1`` is NPC ``i``."""
    first = max(0, tick - round(WINDOW_SECONDS * trace.physics_hz))
    if trace.road.displacement(vehicle, first, tick) > DISPLACEMENT:
        return "lane-change"
    return "lane-keeping"


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
        frame = frame_of(trace)
        self._trace = trace
        self._frame = frame
        self._npc = npc + 1
        self._end = trace.ticks
        self._hz = trace.physics_hz
        self._ahead = frame.ahead[npc]  # of the NPC, from the ego
        ego_half = frame.half_along[0]
        npc_half = frame.half_along[npc + 1]
        self._gaps = np.abs(self._ahead) - ego_half - npc_half
        # from here to the impact they were in the same track
        self._met = last_stretch(frame.gap_across[:, npc] <= 0)
        safe = frame.safe_along(DISTANCES)[:, npc]
        # a gap of zero is always dangerous, even if both are stationary
        self.danger = last_stretch(self._gaps < np.maximum(safe, 1e-9))
        self._before = max(self.danger - 1, 0)  # the last safe tick; responses count from here

    def verdict(self) -> Ruling:
        """Return the result of the first of the rules 2 to 5 that applies."""
        ego = self._moved_in(0)
        npc = self._moved_in(self._npc)
        last = max(ego, npc)
        # Rule 2: a lane change counts unless the danger started only after the two were in the same track.
        if last >= 0 and max(last, self._met) >= self.danger:
            if ego >= npc:
                return self._ego_moved_in(ego)
            return self._npc_moved_in(npc)
        # Rule 5: they were side by side when their tracks met.
        if last < 0 and 0 < self._met >= self.danger and self._gaps[self._met] <= 0:
            return self._came_together()
        # Rules 3 and 4: one followed the other.
        if self._ahead[self.danger] < 0:
            return self._npc_followed(0, Ruling("npc", self.danger, "close", self._npc))
        could = self._could_avoid(0, self._before, DELAY)
        return Ruling("ego" if could else "npc", self.danger, "close", 0, "leader-unanswered")

    def _moved_in(self, vehicle: int) -> int:
        # The last tick at which the vehicle's box crossed the line of the other's lane, or -1.
        other = self._npc - vehicle
        track = self._trace.road.track
        lanes = self._trace.states[:, other, LANE].astype(int)
        widths = np.array([lane.width for lane in self._trace.lanes])
        width = widths[np.maximum(lanes, 0)]
        across = track[:, :, ACROSS]
        centre = across[:, other] - track[:, other, OFFSET]
        away = across[:, vehicle] - centre
        reach = np.abs(away) - self._frame.half_across[vehicle]
        is_over = reach < width / 2
        towards = -np.sign(away) * self._frame.drift[vehicle]
        comes = towards >= DRIFTING
        enters = is_over[1:] & ~is_over[:-1] & comes[1:]
        # The other must stay in its lane, since otherwise the lines move and the vehicle does not.
        stays = lanes[1:] == lanes[:-1]
        ticks = np.flatnonzero(enters & stays) + 1
        if ticks.size and ticks[-1] >= self._met - RECENT * self._hz:
            return int(ticks[-1])
        return -1

    def _has_room(self, mover: int, tick: int) -> bool:
        behind = float(self._frame.speed[self._npc - mover, tick])
        speed = float(self._frame.speed[mover, tick])
        return bool(self._gaps[tick] >= room_to_leave(behind, speed))

    def _ego_moved_in(self, tick: int) -> Ruling:
        # Rule 2 for the ego: it is responsible unless it left room, or led for long enough for the NPC to brake.
        at_fault = Ruling("ego", tick, "moved", 0, "entered-lane")
        excused = at_fault._replace(responsibility="npc")
        if self._ahead[tick] >= 0:
            return at_fault
        if self._has_room(0, tick) and self._has_room(0, max(self._met, tick)):
            return self._npc_followed(tick, excused)
        led = tick + round(LONG * self._hz)
        if self._could_avoid(self._npc, max(led, self._before), DELAY, later=False):
            return self._npc_followed(led, excused)
        # It left too little room, but an NPC that could have braked anyway shares the responsibility.
        since = max(tick, self._before)
        if self._gaps[tick] >= NEXT_TO and self._could_avoid(self._npc, since, DELAY):
            return at_fault._replace(responsibility="both")
        return at_fault

    def _npc_moved_in(self, tick: int) -> Ruling:
        # Rule 2 for an NPC, and rule 3 for the ego behind it.
        gap = self._gaps[tick]
        speed = self._frame.speed[0]
        moved = Ruling("npc", tick, "moved", self._npc, "cut-in-unanswered")
        if gap > 0 and self._ahead[tick] < 0:
            return self._npc_followed(tick, moved, moved_in=True)
        since = tick
        has_slowed = speed[self._end] < speed[tick] - SLOWED
        # An NPC that cuts in very close and brakes hard gives an ego that slows down one more second.
        is_close = gap < BLOCKED * speed[tick]
        if is_close and has_slowed and self._hard_brakings(self._npc, tick + 1):
            since = tick + round(DELAY * self._hz)
        if not self._could_avoid(0, since, DELAY_AFTER_CUT_IN):
            # No response would have helped. But an ego that had time to brake, and did not, shares the responsibility.
            if gap > 0 and not has_slowed and self._end - tick >= DELAY_AFTER_CUT_IN * self._hz:
                return moved._replace(responsibility="both")
            return moved
        is_soon = self._end - tick <= SOON * self._hz
        if is_soon and not self._has_room(self._npc, tick):
            return moved._replace(responsibility="both")
        return moved._replace(responsibility="ego")

    def _came_together(self) -> Ruling:
        # Rule 5. Drifts are positive towards the other vehicle.
        tick = self._met
        npc = self._npc
        drift = self._frame.drift[:, tick]
        is_right = self._frame.right[npc - 1, max(tick - 1, 0)] >= 0
        side = 1.0 if is_right else -1.0
        ego_moved = side * drift[0] >= DRIFTING
        npc_moved = -side * drift[npc] >= DRIFTING
        if not (ego_moved or npc_moved):
            # Neither moved sideways, so the vehicle over the line of its lane is responsible, or else the NPC.
            ego_moved = self._is_over_line(0, side)
            npc_moved = self._is_over_line(npc, -side)
            ego_moved &= not npc_moved
        found = Ruling("npc", tick, "sideways", npc, "entered-lane")
        if not ego_moved:
            return found
        return found._replace(responsibility="both" if npc_moved else "ego", vehicle=0)

    def _is_over_line(self, vehicle: int, side: float) -> bool:
        # Whether a vehicle's box is over the line of its lane on a side (1 for the right) when the tracks meet.
        lane = int(self._trace.states[self._met, vehicle, LANE])
        offset = self._trace.road.track[self._met, vehicle, OFFSET]
        reach = side * offset + self._frame.half_across[vehicle, self._met]
        return bool(reach > self._trace.lanes[max(lane, 0)].width / 2)

    def _could_avoid(self, behind: int, first: int, delay: float, *, later: bool = True) -> bool:
        # Rule 3: would an ordinary response of the follower, at the first tick or, with `later`, at any tick after it,
        # have avoided the impact? Until the delay [s] is over, the follower drives as recorded, but never speeds up.
        # Then it brakes at 6 m/s^2 while it is faster than the other vehicle, which drives as recorded.
        own = self._frame.speed[behind]
        other = self._frame.speed[self._npc - behind]
        end = self._end
        starts = np.arange(first, end if later else min(first + 1, end))
        # a response counts only while the other vehicle is ahead
        lead = self._ahead[starts]
        starts = starts[lead < 0 if behind else lead > 0]
        if not starts.size:
            return False
        # All responses are simulated together. Each has a speed, and a distance behind the recorded position.
        speed = np.full(len(starts), own[first])
        back = np.zeros(len(starts))
        due = starts + round(delay * self._hz)
        step = HARDEST / self._hz
        for tick in range(first, end):
            back += np.where(tick >= starts, own[tick] - speed, 0.0)
            slower = np.maximum(speed - step, 0.0)
            braked = np.where(speed > other[tick], slower, speed)
            recorded = own[tick + 1]
            driven = np.where(tick < starts, recorded, np.minimum(speed, recorded))
            speed = np.where(tick + 1 >= due, braked, driven)
        # At the impact, it must be farther back than the distance that it still needs to lose its excess speed.
        excess = np.maximum(speed - other[end], 0.0)
        needed = excess**2 / (2 * HARDEST)
        return bool((back / self._hz > needed).any())

    def _hard_brakings(self, vehicle: int, first: int = 0) -> list[tuple[int, int]]:
        # The first tick of each hard braking, and the first tick after it, relative to `first`.
        is_hard = braking(self._trace, vehicle)[first:] > HARD
        shortest = HARD_SECONDS * self._hz
        return [(begin, until) for begin, until in stretches(is_hard) if until - begin >= shortest]

    def _npc_followed(self, duty: int, found: Ruling, *, moved_in: bool = False) -> Ruling:
        # Rule 4. The NPC has to respond from the tick `duty`. If it moved in behind the ego, it chose the distance.
        needless = self._needless()
        if needless is None:
            return found
        begin, fault = needless
        since = max(duty, min(begin, self._before))
        could = moved_in or self._could_avoid(self._npc, since, DELAY)
        happened: Happened = "stopped" if fault == "stopped-for-nothing" else "braked"
        return Ruling("both" if could else "ego", begin, happened, 0, fault)

    def _needless(self) -> tuple[int, Fault] | None:
        # The tick at which needless braking or a needless stop started, and the fault. Candidates are hard brakings,
        # and a stop of at least 3 s.
        speed = self._trace.ego[:, SPEED]
        hz = self._hz
        end = self._end
        found: list[tuple[int, int, Fault]] = [
            (until - 1, begin - 1, "braked-for-nothing") for begin, until in self._hard_brakings(0)
        ]
        stopped = last_stretch(speed <= STANDING_SPEED)
        if speed[end] <= STANDING_SPEED and 0 < stopped <= end - LONG * hz:
            slows = np.append(np.diff(speed[: stopped + 1]) < 0, True)
            found.append((stopped, last_stretch(slows), "stopped-for-nothing"))
        ego = self._frame.speed[0]
        npc = self._frame.speed[self._npc]
        for until, begin, fault in sorted(found, key=lambda each: each[0], reverse=True):
            # It must last until shortly before the danger. The NPC must be behind, and the ego slower at the end.
            if until != stopped and until < self.danger - DELAY * hz:
                continue
            if not (self._ahead[begin] < 0 and ego[end] < ego[begin]):
                continue
            # An NPC that accelerated afterwards caused the danger itself.
            since = max(until, self._before)
            if not npc[end] <= npc[since:].min() + DROVE_ON:
                continue
            # A reason counts from a second before the start of the braking until the braking counts as hard.
            first = max(begin - round(DELAY * hz), 0)
            last = min(begin + round(HARD_SECONDS * hz), end)
            if not reasons(self._trace, slice(first, last + 1)).any():
                return begin, fault
        return None


def reasons(trace: Trace, ticks: slice) -> BoolArray:
    """Return for each tick whether the ego had a reason to brake."""
    return np.asarray(
        _has_traffic(trace, ticks) | _has_crossing(trace, ticks) | _ends(trace, ticks)
    )


def _has_traffic(trace: Trace, ticks: slice) -> BoolArray:
    # Whether a vehicle ahead or alongside is a reason to brake.
    frame = frame_of(trace)
    speed = frame.speed[0, ticks]
    others = frame.speed[1:, ticks]
    ahead = frame.ahead[:, ticks]
    right = frame.right[:, ticks]
    half_along = frame.half_along[:, ticks]
    half_across = frame.half_across[:, ticks]
    along = np.abs(ahead) - half_along[0] - half_along[1:]
    across = np.abs(right) - half_across[0] - half_across[1:]
    gained = np.diff(frame.speed[1:], prepend=frame.speed[1:, :1])
    slowed = -gained[:, ticks] * trace.physics_hz
    # A vehicle in the same track is too close by RSS, near a collision, or near and brakes hard.
    is_near = along <= NEAR_SECONDS * speed
    safe = frame.safe_along(DISTANCES).T[:, ticks]
    is_close = along < np.maximum(safe, STANDSTILL_GAP)
    is_close |= along < NEAR_SECONDS * (speed - others)
    is_close |= is_near & (slowed > HARD)
    # A near vehicle moves in from the next lane.
    lane = _lane_of_ego(trace, ticks)
    drift = frame.drift[:, ticks]
    towards = np.sign(right) * (drift[0] - drift[1:])
    is_in_next_lane = (across > 0) & (across < lane.width)
    comes = is_in_next_lane & (towards >= DRIFTING) & is_near
    is_reason = ((across <= 0) & is_close) | comes
    is_reason &= (ahead > 0) | (along <= 0)
    return np.asarray(is_reason.any(axis=0))


def _has_crossing(trace: Trace, ticks: slice) -> BoolArray:
    # Whether the ego and a crossing NPC are both in their conflict zone, or near it.
    found = np.zeros(len(trace.ego[ticks]), dtype=np.bool_)

    def nears(vehicle: int, places: FloatArray, stretch: Stretch) -> BoolArray:
        enters, leaves = stretch
        places = places[ticks]
        speeds = trace.states[ticks, vehicle, SPEED]
        before = np.maximum(NEAR_SECONDS * speeds, STANDSTILL_GAP)
        return np.asarray((places < leaves) & (enters - places <= before))

    for npc, zone in enumerate(trace.zones):
        if zone is not None:
            ego_nears = nears(0, trace.track_of(0)[:, ALONG], zone.ego)
            found |= ego_nears & nears(npc + 1, trace.way_of(npc), zone.npc)
    return found


def _ends(trace: Trace, ticks: slice) -> BoolArray:
    # Whether the ego's lane ends soon, and no other lane continues it.
    lane = _lane_of_ego(trace, ticks)
    x = lane.x + lane.length * math.cos(lane.heading)
    y = lane.y + lane.length * math.sin(lane.heading)
    if lane.points:
        x, y = lane.points[-1]
    for each in trace.lanes:
        start = each.points[0] if each.points else (each.x, each.y)
        if not math.dist((x, y), start) >= 1.0:
            return np.zeros(len(trace.ego[ticks]), dtype=np.bool_)
    ego = trace.ego[ticks]
    left = np.hypot(x - ego[:, X], y - ego[:, Y])
    return np.asarray(left < NEAR_SECONDS * np.abs(ego[:, SPEED]))


def _lane_of_ego(trace: Trace, ticks: slice) -> Lane:
    # At the last of the ticks.
    lane = int(trace.ego[ticks.stop - 1, LANE])
    return trace.lanes[max(lane, 0)]


# Rule 1, right of way at junctions. Sources: Shalev-Shwartz, Shammah, Shashua, definitions 15 to 18, as implemented in
# ad-rss-lib; Vienna Convention on Road Traffic, Art. 1 and 18.


def _where_ways_meet(trace: Trace, npc: int, zone: Zone) -> Ruling:
    is_on_path = ~np.isnan(trace.track_of(npc + 1)[:, ALONG])
    since, until = max(stretches(is_on_path), default=(0, 0))
    in_lane = None
    # If the NPC is on the ego's path at the impact, rules 2 to 5 can apply. They decide if the danger started there.
    if until - since > 1 and until == trace.ticks + 1:
        part = {name: getattr(trace, name)[since:until] for name in ("states", "track", "on_way")}
        conflict = Conflict(replace(trace, **part), npc)
        in_lane = conflict.verdict()
        in_lane = in_lane._replace(tick=in_lane.tick + since)
        if conflict.danger > 0:
            return in_lane
    ego = Passing(trace, 0, zone)
    other = Passing(trace, npc + 1, zone)
    is_in_zone = ego.is_inside and other.is_inside
    has_merged = zone.kind == "merging" and in_lane is not None
    if ego.has_entered and other.has_entered and (is_in_zone or has_merged):
        # The vehicle with the right of way never has to give way, but it must not drive into an occupied zone either.
        owing = []
        taken = []
        for own, it, name in ((ego, other, "ego"), (other, ego, "npc")):
            if zone.priority != name and own.did_not_give_way(it):
                owing.append(own)
            elif own.saw_it_taken(it):
                taken.append(own)
        # A vehicle that did not give way is decisive, otherwise the ego.
        at_fault = owing + taken
        if at_fault:
            first = at_fault[0]
            fault: Fault = "did-not-give-way" if ego in owing else "entered-taken-zone"
            found = Ruling("ego", first.entry, "entered", first.vehicle, fault)
            if len(at_fault) > 1:
                return found._replace(responsibility="both")
            if first is other:
                return found._replace(responsibility="npc")
            return found
    if in_lane is not None:
        return in_lane
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
        self.vehicle = vehicle
        self._trace = trace
        self._hz = trace.physics_hz
        self._merges = zone.kind == "merging"
        if vehicle:
            self.places = trace.way_of(vehicle - 1)
            self.begins, self.ends = zone.npc
        else:
            self.places = trace.track_of(0)[:, ALONG]
            self.begins, self.ends = zone.ego
        self.speeds = trace.states[:, vehicle, SPEED]
        self.half_length = float(trace.sizes[vehicle, 0]) / 2
        self.has_entered = bool(self.places[-1] >= self.begins)
        self.is_inside = self.has_entered and bool(self.places[-1] <= self.ends)
        self.entry = trace.ticks
        if self.has_entered:
            self.entry = last_stretch(self.places >= self.begins)

    def _stops(self, before: int, place: float) -> int:
        # The last tick, before another, at which an ordinary response stops the vehicle short of a position [m].
        left = place - self.places[:before]
        speeds = self.speeds[:before]
        could = np.flatnonzero(left >= speeds * DELAY + speeds**2 / (2 * HARDEST))
        if could.size:
            return int(could[-1])
        return -1

    def _foreseen(self, tick: int, time: float) -> float:
        # The position [m] at a time [s], if the vehicle keeps the speed that it has at the tick.
        place = float(self.places[tick])
        speed = max(float(self.speeds[tick]), 0.0)
        # a vehicle at rest stays where it is, even for an infinite time
        if speed:
            return place + speed * (time - tick / self._hz)
        return place

    def _leaves(self) -> float:
        # The time [s] at which the vehicle leaves the zone; after the run, it keeps its last speed.
        out = np.flatnonzero(self.places[self.entry :] >= self.ends)
        if out.size:
            return float((self.entry + out[0]) / self._hz)
        speed = float(self.speeds[-1])
        if not speed > 0:
            return math.inf
        left = float(self.ends - self.places[-1])
        return (len(self.places) - 1) / self._hz + left / speed

    def did_not_give_way(self, other: Passing) -> bool:
        """Return whether the vehicle could have foreseen that it should stop for the other one."""
        # Everything is foreseen at the last chance to stop before the zone.
        chance = max(self._stops(self.entry, self.begins), 0)
        if other._foreseen(chance, self._leaves()) < other.begins:
            return False
        place = other._foreseen(chance, self.entry / self._hz)
        faster = max(float(other.speeds[chance]), 0.0)
        # Crossing: the other vehicle would have to brake harder than GENTLY. Merging: behind, it is closer than a lane
        # change permits; ahead, it is closer than the safe distance.
        if not self._merges:
            needed = faster * DELAY + faster**2 / (2 * GENTLY)
            return other.begins - place < needed and place < other.ends
        left = other.ends - place
        lead = float(left - (self.ends - self.places[self.entry]))
        gap = abs(lead) - self.half_length - other.half_length
        own = self.speeds[self.entry]
        if lead >= 0:
            return gap < room_to_leave(faster, float(own))
        return gap < float(DISTANCES.safe_along(own, np.asarray(faster), DELAY))

    def saw_it_taken(self, other: Passing) -> bool:
        """Return whether the vehicle entered although it could have stopped or slowed down for the other one."""
        # Merging: could it still slow down to the speed of the other, which had merged ahead of it?
        if self._merges:
            ticks = np.arange(other.entry, self.entry)
            left = other.ends - other.places[ticks]
            lead = self.ends - self.places[ticks] - left
            gap = lead - self.half_length - other.half_length
            # the lowest speed of the other from each tick on
            lowest = np.minimum.accumulate(other.speeds[::-1])[::-1]
            faster = np.maximum(self.speeds[ticks] - lowest[ticks], 0.0)
            room = faster * DELAY + faster**2 / (2 * HARDEST)
            return bool(((lead > 0) & (gap >= room)).any())
        # Crossing: could it still stop before it touched the other at its final position?
        boxes = self._boxes(slice(None))
        final = other._boxes(slice(-1, None))
        touched = last_stretch(overlaps(relate(boxes, final)))
        tick = self._stops(touched, float(self.places[touched]))
        if tick < other.entry:
            return False
        return other._foreseen(tick, max(self.entry, tick) / self._hz) < other.ends

    def _boxes(self, ticks: slice) -> Boxes:
        states = self._trace.states[ticks, self.vehicle]
        poses = states[:, [X, Y, HEADING, SPEED]].T
        sizes = self._trace.sizes[self.vehicle, :, None]
        return Boxes.driving(*poses, *sizes)
