"""Responsibility for a collision, by written rules that read only the trace of the run.

:func:`rss_rule` decides the verdict; :func:`position_rule` is a second opinion. docs/explanation/verdicts.md has the
rules, their numbers and their sources.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from pytest_pafot.attribution.manoeuvres import (
    AFTERMATH_SECONDS,
    DRIFTING,
    HARD_BRAKING,
    HARD_SECONDS,
    LEAST_LOST,
    PAUSE,
    REASON_SECONDS,
    RELEASE_SECONDS,
    STANDING_SPEED,
    LaneChange,
    LanePlaces,
    Stop,
    braking,
    first_lasting,
    hard_braking,
    lasting_braking,
    long_stop,
    reasons,
    stretches,
)
from pytest_pafot.attribution.responses import (
    ALREADY_BRAKING,
    BRAKES,
    CUT_OFF,
    DISTANCES,
    EMERGENCY,
    FOLLOWING,
    GIVING_WAY,
    HARDEST,
    HEADWAY,
    HELD,
    SPED_UP,
    VISIBLY,
    Braking,
    Fact,
    Pursuit,
    Reason,
    What,
    answer,
    brakings,
    room_to_leave,
    sentences,
)
from pytest_pafot.criticality import RoadFrame
from pytest_pafot.criticality.measures import Boxes, overlaps, relate
from pytest_pafot.model.crossings import Zone
from pytest_pafot.model.trace import ALONG, HEADING, LANE, SPEED, Trace, X, Y

# Right of way where the NPC's way meets the ego's: which vehicle did not give way, and which entered a taken zone.
#
# This is rule 9 of docs/explanation/verdicts.md. Sources: Shalev-Shwartz, Shammah, Shashua, "On a Formal Model of Safe
# and Scalable Self-driving Cars", arXiv:1708.06374, definitions 15 to 18, as ad-rss-lib has them; Vienna Convention on
# Road Traffic, Art. 1 and 18.

OUTSIDE = 1.0
"""The distance outside its stretch of a zone at which a vehicle still counts as in the zone [m]. The stretches assume
vehicles in the middle of their ways, and a vehicle may have moved back a little."""
LOOK = 0.6
"""The time, up to its chance to stop, in which a vehicle that has to give way observes the other vehicle [s]. One
tick would be too short."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Blame:
    """The vehicles that broke a rule in a zone; vehicle 0 is the ego, ``i + 1`` is NPC ``i``.

    Attributes:
        did_not_give_way: vehicles that did not give way.
        entered_taken_zone: vehicles that drove into the zone while another vehicle visibly was in it.
        tick: tick at which the first vehicle of ``did_not_give_way`` entered the zone; if there is none, the first
            vehicle of ``entered_taken_zone``.
        facts: facts that the verdict states.
    """

    did_not_give_way: tuple[int, ...]
    entered_taken_zone: tuple[int, ...]
    tick: int
    facts: Reason


class Chance(NamedTuple):
    """A tick at which a vehicle could still stop, and the response with which it could."""

    tick: int
    response: Braking


class Passing:
    """A vehicle that approaches a zone along its way.

    Attributes:
        places: position of the vehicle along its way at each tick [m].
        speeds: speed of the vehicle along its heading at each tick [m/s].
        begins, ends: stretch of the vehicle's way in the zone [m].
        entry: tick at which the vehicle enters the zone; None if it has not entered, or if it is back before the zone
            at the last tick.
    """

    def __init__(self, trace: Trace, vehicle: int, zone: Zone) -> None:
        places = trace.way_of(vehicle - 1) if vehicle else trace.track_of(0)[:, ALONG]
        self.vehicle, self.hz = vehicle, trace.physics_hz
        self.places, self.speeds = places, trace.states[:, vehicle, SPEED]
        self.begins, self.ends = zone.npc if vehicle else zone.ego
        self.half_length = float(trace.sizes[vehicle, 0]) / 2
        before = np.flatnonzero(places < self.begins - OUTSIDE)
        since, end = int(before[-1]) + 1 if before.size else 0, len(places) - 1
        entered = since + np.flatnonzero(places[since:] >= self.begins)
        self.entry = None if since > end else int(entered[0]) if entered.size else end

    @property
    def is_inside(self) -> bool:
        """True if the vehicle is in its stretch of the zone, or at most 1 m outside of it, at the last tick."""
        return bool(self.begins - OUTSIDE <= self.places[-1] <= self.ends + OUTSIDE)

    def entered(self) -> int:
        """Return the tick at which the vehicle enters the zone.

        Raises:
            ValueError: if the vehicle does not enter the zone.
        """
        if self.entry is None:
            raise ValueError("expected a vehicle that has entered the zone, received one that has not")
        return self.entry

    def chances(self) -> list[Chance]:
        """Return the chances to stop before the zone; a vehicle that was too fast had its chance at tick 0."""
        found = self.stops(self.entered(), self.begins)
        return found if found and found[0].response is FOLLOWING else [Chance(0, FOLLOWING), *found]

    def stops(self, before: int, place: float) -> list[Chance]:
        """Return the chances, before the tick ``before``, to stop before a place [m].

        The first one is the last tick at which the proper response stops the vehicle. If the vehicle visibly brakes at
        a later tick, it has a second one, because it then needs only the time to perceive.
        """
        found: list[Chance] = []
        for tick in range(before - 1, -1, -1):
            left, speed = place - self.places[tick], float(self.speeds[tick])
            if left >= stopping(speed, HARDEST):
                return [Chance(tick, FOLLOWING), *found]
            brakes = tick > 0 and (self.speeds[tick - 1] - speed) * self.hz >= VISIBLY
            if not found and brakes and left >= stopping(speed, HARDEST, ALREADY_BRAKING.delay):
                found.append(Chance(tick, ALREADY_BRAKING))
        return found

    def look(self, last: int) -> range:
        """Return the ticks up to the tick ``last`` in which the vehicle had to observe the other vehicle."""
        return range(max(last - round(LOOK * self.hz), 0), last + 1)

    def leaves(self) -> float:
        """Return the time at which the vehicle leaves the zone [s].

        If the run ends before, the vehicle is assumed to keep its last speed. Infinite if it stands at the end.
        """
        passed = (tick for tick in range(self.entered(), len(self.places)) if self.places[tick] >= self.ends)
        tick = next(passed, None)
        if tick is not None:
            return tick / self.hz
        speed = float(self.speeds[-1])
        return (len(self.places) - 1) / self.hz + float(self.ends - self.places[-1]) / speed if speed > 0 else math.inf

    def foreseen(self, tick: int, time: float) -> tuple[float, float]:
        """Return the vehicle's place [m] and speed [m/s] at a time [s], as an observer at a tick can foresee them."""
        speed, seconds = float(self.speeds[tick]), time - tick / self.hz
        if speed <= 0:
            return float(self.places[tick]), 0.0
        slowing = (float(self.speeds[tick - 1]) - speed) * self.hz if tick else 0.0
        if slowing < VISIBLY:
            return float(self.places[tick]) + speed * seconds, speed
        seconds = min(seconds, speed / slowing)
        return float(self.places[tick]) + speed * seconds - slowing * seconds**2 / 2, speed - slowing * seconds

    def slowest(self, tick: int) -> float:
        """Return the vehicle's lowest speed in the second after a tick, in which a vehicle behind may adapt [m/s]."""
        return float(self.speeds[tick : tick + round(HEADWAY * self.hz) + 1].min())


def stopping(speed: float, deceleration: float, delay: float = FOLLOWING.delay) -> float:
    """Return the distance that a vehicle needs to respond and stop [m].

    ``speed`` is in m/s, ``deceleration`` in m/s^2, and ``delay`` in seconds.
    """
    return speed * delay + speed**2 / (2 * deceleration)


def braked(speed: float, hz: int, rate: float) -> float:
    """Return the distance in which a vehicle that brakes at a rate [m/s^2] loses a speed [m/s], tick by tick [m]."""
    return speed**2 / (2 * rate) + speed / (2 * hz)


class ZoneConflict:
    """The approach of the ego and an NPC to the zone of their ways, up to their collision."""

    def __init__(self, trace: Trace, npc: int, zone: Zone) -> None:
        self._trace, self._zone = trace, zone
        self.ego, self.npc = (Passing(trace, vehicle, zone) for vehicle in (0, npc + 1))

    @property
    def is_in_zone(self) -> bool:
        """True if ego and NPC are both in their stretches of the zone at the impact."""
        return self.ego.is_inside and self.npc.is_inside

    @property
    def has_merged(self) -> bool:
        """True if the ways merge in the zone, and ego and NPC have both entered it."""
        return self._zone.kind == "merging" and self.ego.entry is not None and self.npc.entry is not None

    @property
    def blame(self) -> Blame | None:
        """The vehicles that broke a rule of right of way; None if neither did."""
        pairs = ((self.ego, self.npc), (self.npc, self.ego))
        holder = {"ego": self.ego, "npc": self.npc}.get(self._zone.priority)
        missed = {
            own: chance
            for own, other in pairs
            if own is not holder and (chance := self._did_not_give_way(own, other)) is not None
        }
        seen = {
            own: chance
            for own, other in pairs
            if own not in missed and (chance := self._seen_taken(own, other)) is not None
        }
        without, taken = tuple(missed), tuple(seen)
        if not without and not taken:
            return None
        first, owing = (without or taken)[0], (taken or without)[0]
        chance = {**missed, **seen}[owing]
        other = self.npc if first is self.ego else self.ego
        at = first.entered() / first.hz
        entered = Fact(
            What.ENTERED, first.vehicle, at, other.vehicle, later_s=other.entered() / other.hz, zone=self._zone
        )
        answers = [self._answer(owing, chance, is_taken=bool(taken))]
        if first is self.ego and owing is self.npc:
            answers.insert(0, self._answer(first, missed[first], is_taken=False))
        return Blame(
            did_not_give_way=tuple(each.vehicle for each in without),
            entered_taken_zone=tuple(each.vehicle for each in taken),
            tick=first.entered(),
            facts=(entered, *answers),
        )

    def _answer(self, own: Passing, chance: Chance, *, is_taken: bool) -> Fact:
        """Return the fact that tells what a vehicle should have done before it entered the zone, and what it did.

        ``is_taken`` is whether the other vehicle was in the zone, so that it was enough to stop short of that vehicle,
        or to slow down behind it.
        """
        other = self.npc if own is self.ego else self.ego
        is_behind = is_taken and self._zone.kind == "merging"
        place = float(own.places[self._reaches(own, other)]) if is_taken else own.begins

        def avoids(tick: int, rate: float) -> bool:
            if is_behind:
                return self._slows_down(own, other, tick, rate)
            return bool(place - own.places[tick] >= braked(float(own.speeds[tick]), own.hz, rate))

        entry = own.entered()
        return answer(self._trace, own.vehicle, chance.tick, avoids, chance.response, entry=entry)

    @staticmethod
    def _slows_down(own: Passing, other: Passing, tick: int, rate: float) -> bool:
        """Return whether a vehicle that brakes at a rate [m/s^2] from a tick on stays behind one that merged ahead."""
        lead = float(own.ends - own.places[tick] - (other.ends - other.places[tick]))
        closing = max(float(own.speeds[tick] - other.speeds[tick:].min()), 0.0)
        return lead - own.half_length - other.half_length >= braked(closing, own.hz, rate)

    def _did_not_give_way(self, own: Passing, other: Passing) -> Chance | None:
        """Return the chance at which a vehicle could foresee another in the zone at the same time; None without one.

        The other vehicle must have been too near to stop without abrupt braking.
        """
        enters, leaves = own.entered() / own.hz, own.leaves()
        for chance in own.chances():
            for tick in own.look(chance.tick):
                place, speed = other.foreseen(tick, enters)
                if other.foreseen(tick, leaves)[0] < other.begins:
                    continue
                if self._zone.kind == "merging":
                    is_near = self._is_near_in_lane(own, other, place, speed)
                else:
                    is_near = other.begins - place < stopping(speed, GIVING_WAY.deceleration) and place < other.ends
                if is_near:
                    return chance
        return None

    def _is_near_in_lane(self, own: Passing, other: Passing, place: float, speed: float) -> bool:
        """Return whether a merging vehicle leaves too small a gap to the foreseen place [m] of the other vehicle."""
        enters = own.entered()
        lead = float((other.ends - place) - (own.ends - own.places[enters]))
        gap = abs(lead) - own.half_length - other.half_length
        if lead >= 0:
            return gap < room_to_leave(speed, own.slowest(enters))
        return gap < float(DISTANCES.safe_along(own.speeds[enters], np.asarray(speed), FOLLOWING.delay))

    def _seen_taken(self, own: Passing, other: Passing) -> Chance | None:
        """Return the last tick at which a vehicle saw that the other would stay in the zone, and could respond."""
        if self._zone.kind == "merging":
            return self._could_slow_down(own, other)
        touched = self._reaches(own, other)
        enters, since = own.entered() / own.hz, other.entered()
        for chance in own.stops(touched, float(own.places[touched])):
            for tick in reversed(own.look(chance.tick)):
                if tick >= since and other.foreseen(tick, max(enters, tick / own.hz))[0] < other.ends:
                    return Chance(tick, chance.response)
        return None

    def _reaches(self, own: Passing, other: Passing) -> int:
        """Return the tick from which on a vehicle's box touches the place where the other vehicle is hit."""
        poses = self._trace.states[:, own.vehicle], self._trace.states[-1:, other.vehicle]
        mine, others = (
            Boxes.driving(*rows[:, [X, Y, HEADING, SPEED]].T, *self._trace.sizes[each.vehicle, :, None])
            for rows, each in zip(poses, (own, other), strict=True)
        )
        free = np.flatnonzero(~overlaps(relate(mine, others))[:-1])
        return int(free[-1]) + 1 if free.size else 0

    @staticmethod
    def _could_slow_down(own: Passing, other: Passing) -> Chance | None:
        """Return the last tick at which ``other`` had merged ahead, and ``own`` could still slow down to its speed."""
        apart = own.half_length + other.half_length
        for tick in range(own.entered() - 1, other.entered() - 1, -1):
            lead = float(own.ends - own.places[tick] - (other.ends - other.places[tick]))
            faster = max(float(own.speeds[tick] - other.speeds[tick:].min()), 0.0)
            if lead > 0 and lead - apart >= stopping(faster, HARDEST):
                return Chance(tick, FOLLOWING)
        return None


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
"""The faults of the ego, in this order. It changed lanes into another vehicle's way. It did not respond properly to a
cut-in, or to a vehicle ahead in its lane. It braked hard, or stopped, with nothing in its way. In a zone where its way
meets the NPC's, it did not give way, or it drove in while the NPC visibly was there."""

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

TOGETHER = 1.0
"""The longest time between two lane changes into the same lane that count as simultaneous [s]."""
SOON = 5.0
"""The time after an NPC's lane change in which its braking counts as part of the lane change [s]. If the NPC is hit in
that time, its braking is assumed to continue."""
SPARE = 0.2
"""The additional delay of a response to a cut-in [s]. An ego that brakes for a cut-in is responsible only if even a
response with this additional delay would have avoided the collision."""
ANSWERS_BY, ANSWERS_FOR = 1.2, 0.5
"""The time from a cut-in until which the ego may drive on before its answer counts, and the least time up to the impact
for which it counts [s]."""
BLOCKED = 0.3
AT_ONCE = 2.0
"""The headway and the time [s] of a cut-in to which no driver can respond: the NPC moves in with a headway below
``BLOCKED`` and begins to brake hard within ``AT_ONCE``."""
AMPLE = 1.0
"""The headway above which a follower can always respond to hard braking of the vehicle ahead [s]."""
LEAST_ROOM = 2.0
"""The gap from which on a vehicle that changed lanes ahead of another is not responsible if the vehicle behind speeds
up into it [m]."""
NEARER = 0.5
"""The distance by which a gain in speed must have brought the ego nearer to a vehicle that cut in to count as a cause
of the impact, even if the ego could not have slowed down to that vehicle's speed without the gain [m]."""
DECIDED = 0.5
"""The time to contact below which an NPC that moves in behind the ego did not cause the danger by its lane change
[s]."""
LET_GO = 0.4
"""The pause after which a braking counts as finished [s]."""
ROLLED = 0.5
"""The time before the impact for which an ego must have stood to be excused from a missing response [s]."""
LATER = 3.0
"""The time after the ego's needless braking in which an NPC can adapt to the ego's new speed [s]."""
CRAWLING = 3.0
"""The speed up to which an NPC can stop behind a standing vehicle when the danger begins [m/s]."""
DROVE_ON = 1.0
"""The gain in speed above which an NPC behind an ego that had braked for nothing caused the danger itself [m/s]."""
LEAVING = 1.0
"""The time for which an NPC still counts as on the ego's way after it has left that way [s]."""
BRAKED_VISIBLY = 3.0
BRAKED_BEFORE = 1.0
"""A sentence mentions the braking of a vehicle ahead if it is at least this hard [m/s^2], and at most this long before
the described moment [s]."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Attribution:
    """The responsibility for a collision and its reason. Two attributions are equal if they have the same text.

    Attributes:
        responsibility: vehicles that are responsible for the collision.
        tick, time: tick and time [s] at which the decisive lane change, braking or danger began; None without a
            collision.
        fault: fault of the ego; None if the ego is not responsible.
        facts: facts that explain the verdict.
        avoidable: whether the rules excuse the ego for want of time, although braking with 6 m/s^2 from 1.4 s after
            ``time`` on would have avoided the collision, by the rules' computation.
        mistake: what the ego did wrong, in a few words; None if it is not responsible, and in the result of
            :func:`rss_rule`, which does not ask for it.
    """

    responsibility: Responsibility
    tick: int | None
    time: float | None
    fault: Fault | None = None
    facts: Reason = ()
    avoidable: bool = False
    mistake: Mistake | None = None

    @property
    def blames_ego(self) -> bool:
        """True if the ego is responsible for the collision, alone or with the NPC."""
        return self.responsibility in ("ego", "both")

    @property
    def sentences(self) -> tuple[str, ...]:
        """Lines that say what happened, and then what should have happened; empty without a collision."""
        return sentences(self.facts)  # formatted on demand: a search judges many collisions and prints few

    @property
    def reason(self) -> str:
        """The sentences joined into one line."""
        return " ".join(self.sentences) or "There was no collision."

    def __repr__(self) -> str:
        told = (f"{name}={getattr(self, name)!r}" for name in ("responsibility", "tick", "time", "reason", "fault"))
        return f"Attribution({', '.join(told)})"

    def __eq__(self, other: object) -> bool:
        return self._said == other._said if isinstance(other, Attribution) else NotImplemented

    def __hash__(self) -> int:
        return hash(self._said)

    def __reduce__(self) -> tuple[Callable[[], Attribution], tuple[()]]:
        facts = tuple(fact.in_full for fact in self.facts)  # what is still unread needs the trace
        whole = partial(Attribution, responsibility=self.responsibility, tick=self.tick, time=self.time)
        return partial(whole, fault=self.fault, facts=facts, avoidable=self.avoidable, mistake=self.mistake), ()

    @property
    def _said(self) -> tuple[object, ...]:
        return self.responsibility, self.tick, self.time, self.reason, self.fault


def rss_rule(trace: Trace) -> Attribution:
    """Attribute a collision to the vehicle that caused the danger or did not respond to it properly.

    The danger is the last stretch of time, up to the impact, in which both the longitudinal and the lateral distance
    were shorter than :data:`DISTANCES` requires (Responsibility-Sensitive Safety). If the vehicles came into one track
    by a lane change after the danger had begun, the vehicle that changed lanes is responsible. It is not responsible if
    it gave way to the vehicle behind, or if it had been the leader for long enough that the other could respond. The
    ego is responsible, too, if a careful driver would have avoided a cut-in by braking. Without a lane change, the
    follower is responsible if braking with 6 m/s^2 after 1 s would have avoided the collision. An ego ahead is
    responsible only for braking hard, or stopping, with nothing in its way. If the NPC's way meets the ego's, right of
    way is decided first. The ego is always responsible for touching a fixed object. The rules, their
    numbers and their sources are in docs/explanation/verdicts.md.

    Sources: Shalev-Shwartz, Shammah, Shashua, "On a Formal Model of Safe and Scalable Self-driving Cars",
    arXiv:1708.06374 (distances, danger, blame, proper response); UN Regulations No. 79 (lane changes) and No. 157
    (numbers of a careful driver); Vienna Convention on Road Traffic, Art. 17 (braking for nothing).
    """
    if trace.collision is None:
        return Attribution(responsibility="none", tick=None, time=None)
    npc = trace.collision.npc
    if npc is None:
        hit = trace.collision
        return Attribution(responsibility="ego", tick=hit.tick, time=hit.time)
    zone = trace.zones[npc] if trace.zones else None
    return Conflict(trace, npc).attribution if zone is None else _where_ways_meet(trace, npc, zone)


def _where_ways_meet(trace: Trace, npc: int, zone: Zone) -> Attribution:
    """Attribute a collision with a crossing NPC by right of way, or by the rules for two vehicles in one lane."""
    along = trace.track_of(npc + 1)[:, ALONG]
    since, until = max(stretches(~np.isnan(along)), default=(0, 0))  # the last time on the ego's way
    is_lane = until - since > 1 and trace.ticks + 1 - until <= LEAVING * trace.physics_hz
    lane = Conflict(_part(trace, since, until), npc) if is_lane else None
    if lane is not None and lane.has_begun_safely:
        return _later(lane.attribution, since, trace)
    meeting = ZoneConflict(trace, npc, zone)
    by_priority = meeting.is_in_zone or (meeting.has_merged and lane is not None)
    blame = meeting.blame if by_priority else None
    if blame is not None:
        return _blamed(blame, trace.physics_hz)
    if lane is not None:
        return _later(lane.attribution, since, trace)
    end = trace.ticks / trace.physics_hz
    touched = Fact(What.NONE_FORESAW if by_priority else What.TOUCHED_ELSEWHERE, 0, end, npc + 1)
    return Attribution(responsibility="none", tick=trace.ticks, time=end, facts=(touched,))


def _blamed(blame: Blame, hz: int) -> Attribution:
    """Attribute a collision to the vehicles that broke a rule of right of way."""
    failed = {*blame.did_not_give_way, *blame.entered_taken_zone}
    fault: Fault | None = None
    if 0 in failed:
        fault = "did-not-give-way" if 0 in blame.did_not_give_way else "entered-taken-zone"
    responsibility: Responsibility = "both" if len(failed) > 1 else "ego" if 0 in failed else "npc"
    return Attribution(
        responsibility=responsibility, tick=blame.tick, time=blame.tick / hz, fault=fault, facts=blame.facts
    )


def _part(trace: Trace, first: int, end: int) -> Trace:
    """Return the part of a run from the tick ``first`` up to, but without, the tick ``end``."""
    return replace(trace, **{name: getattr(trace, name)[first:end] for name in ("states", "track", "on_way")})


def _later(found: Attribution, ticks: int, trace: Trace) -> Attribution:
    """Return the attribution of a part of a run with its times counted from the beginning of the whole run.

    ``ticks`` is the number of ticks before the part.
    """
    hz = trace.physics_hz

    def shifted(time: float) -> float:
        return (round(time * hz) + ticks) / hz

    facts = tuple(
        fact._replace(
            time_s=shifted(fact.time_s),
            later_s=shifted(fact.later_s),
            due_s=None if fact.due_s is None else shifted(fact.due_s),
            unread=None if fact.unread is None else fact.unread.later(trace, ticks),
        )
        for fact in found.facts
    )
    tick = (found.tick or 0) + ticks
    return replace(found, tick=tick, time=tick / hz, facts=facts)


def position_rule(trace: Trace) -> Responsibility:
    """Attribute a collision by the NPC's position at the impact, as the released code of the paper's authors does.

    It is a second opinion. An ego at 0.1 m/s or less is never responsible. A faster ego is responsible if the NPC was
    ahead of it, in cell 1, 2 or 3; otherwise the NPC is responsible. An NPC that was not on the ego's way is in no
    cell; it counts as ahead if it hit the ego's front. The paper itself counts all collisions alike.
    """
    hit = trace.collision
    if hit is None:
        return "none"
    if hit.npc is None:
        return "ego"
    was_ahead = hit.side == "front" if hit.cell is None else hit.cell.row > 0
    return "ego" if was_ahead and hit.ego_speed > STANDING_SPEED else "npc"


@lru_cache(maxsize=1)
def frame_of(trace: Trace) -> RoadFrame:
    """Return a run's positions and velocities along and across the road.

    The last result is cached, because verdict, mistake and situation of a run all need it.
    """
    return RoadFrame(trace)


class Conflict:
    """The conflict of the ego and the NPC that it collided with, from the first tick to the impact.

    ``onset`` is the tick from which on the two count as in one track; by default the last time that they came into one.
    """

    def __init__(self, trace: Trace, npc: int, onset: int | None = None) -> None:
        frame = frame_of(trace)
        self._frame, self._trace, self._npc = frame, trace, npc
        self._end, self._hz = trace.ticks, trace.physics_hz
        self._lanes = LanePlaces(trace, frame)
        self._safe_along = frame.safe_along(DISTANCES)[:, npc]
        along, across = frame.gap_along[:, npc], frame.gap_across[:, npc]
        is_close = (along < self._safe_along) | (along <= 0)
        self._is_apart = across[:-1] > 0
        # from here to the end they were in one track
        self._onset = self._one_track_since(self._is_apart) if onset is None else onset
        is_dangerous = is_close & (across < frame.safe_across(DISTANCES)[:, npc])
        is_dangerous[self._onset :] = is_close[self._onset :]
        safe = np.flatnonzero(~is_dangerous[:-1])
        self._start = int(safe[-1]) + 1 if safe.size else 0
        self._before = max(self._start - 1, 0)  # the last safe tick; responses count from here
        self._side = 1.0 if frame.right[npc, max(self._onset - 1, 0)] >= 0 else -1.0

    def _one_track_since(self, is_apart: npt.NDArray[np.bool_]) -> int:
        """Return the tick from which on the two were in one track.

        A motorcycle that swerves in the lane of the other does not leave that track, even where the boxes do not
        overlap: otherwise its swerve would hide how it came in.
        """
        lanes = self._trace.states[: len(is_apart), [0, self._npc + 1], LANE]
        left = np.flatnonzero(is_apart & (lanes[:, 0] != lanes[:, 1]))
        first = int(left[-1]) + 1 if left.size else 0
        return first + next((at for at, apart in enumerate(is_apart[first:]) if not apart), len(is_apart) - first)

    @property
    def has_begun_safely(self) -> bool:
        """True if the danger began after the first tick."""
        return self._start > 0

    @property
    def attribution(self) -> Attribution:
        """The attribution by the rules of docs/explanation/verdicts.md."""
        over = self._lanes.moved_over(self._npc, max(self._start, self._onset), self._end)
        if self._is_in_one_track:
            return self._in_one_lane() if over is None else self._changed(over)
        ego, npc = self._change(0), self._npc_change
        latest = max((each for each in (ego, npc) if each is not None), key=lambda each: each.tick, default=None)
        if over is not None and (latest is None or over.tick > latest.tick):
            return self._changed(over)
        if latest is None:
            if self._gap(self._onset) <= 0:
                return self._strayed()
            earlier = self._earlier
            return self._in_one_lane() if earlier is None else earlier.attribution
        if ego is not None and npc is not None and abs(ego.tick - npc.tick) <= TOGETHER * self._hz:
            return self._both_changed(ego, npc)
        return self._changed(latest)

    # Lane changes.

    @property
    def _is_in_one_track(self) -> bool:
        """True if the danger began after ego and NPC came into one track, or if they were in one track all the time."""
        return self._onset == 0 or self._start > self._onset

    @property
    def _earlier(self) -> Conflict | None:
        """The conflict from the last lane change in this danger on, if the two came together again without any.

        Otherwise, a vehicle that cuts in, swerves on over the other line of the lane, and comes back would have the
        follower answer from when the cut-in began, as if it had been the leader since then. None without such a change.
        """
        together = np.flatnonzero(~self._is_apart[: self._onset])
        onset = self._one_track_since(self._is_apart[: together[-1] + 1]) if together.size else 0
        if onset < max(self._start, 1):
            return None
        earlier = Conflict(self._trace, self._npc, onset)
        has_changed = earlier._change(0) is not None or earlier._npc_change is not None
        return earlier if has_changed else earlier._earlier

    def _change(self, vehicle: int) -> LaneChange | None:
        npc = self._npc + 1
        other, side = (npc, self._side) if vehicle == 0 else (0, -self._side)
        change = self._lanes.change(vehicle, other, side, self._onset)
        return None if change is None or self._lanes.is_back(change, side, self._end) else change

    @property
    def _npc_change(self) -> LaneChange | None:
        """The NPC's last lane change, including a lane change behind an ego that reached over the line; or None."""
        changes = [self._change(self._npc + 1)]
        for side in (1.0, -1.0):
            change = self._lanes.moved_in_behind(self._npc, side, self._onset, self._end)
            if change is not None and not self._lanes.is_back(change, side, self._end):
                closing = self._frame.speed[self._npc + 1, change.tick] - self._frame.speed[0, change.tick]
                if self._gap(change.tick) >= DECIDED * closing:
                    changes.append(change)
        return max((each for each in changes if each is not None), key=lambda each: each.tick, default=None)

    def _changed(self, change: LaneChange) -> Attribution:
        return self._npc_changed(change) if change.vehicle else self._ego_changed(change)

    def _both_changed(self, ego: LaneChange, npc: LaneChange) -> Attribution:
        if self._leads(ego.tick) and self._gives_way(ego):
            return self._gave_way(ego)
        both, pursuit = max(ego.tick, npc.tick), self._pursuit(by_ego=False)
        if self._leads(both) and self._gap(both) > 0:
            later = self._later_cause(both, LEAST_ROOM, self._crossed(npc), pursuit, moved_in=npc.tick)
            if later is not None:
                return later
        first, by_ego = (ego, False) if self._leads(self._onset) else (npc, True)
        passed = self._duty_passed(first, both, self._pursuit(by_ego=by_ego))
        if passed is not None:
            return passed
        ego_at, npc_at = self._at(ego.tick), self._at(npc.tick)
        crossed = Fact(What.BOTH_CROSSED, 0, ego_at, other=self._npc + 1, later_s=npc_at)
        return self._attributed("both", ego.tick, (crossed,), "entered-lane")

    def _ego_changed(self, change: LaneChange) -> Attribution:
        crossed, tick = self._crossed(change), change.tick
        if not self._leads(tick):
            return self._attributed("ego", tick, (crossed,), "entered-lane")
        if self._gives_way(change):
            return self._gave_way(change)
        pursuit, speed = self._pursuit(by_ego=False), self._frame.speed[0, tick : self._end + 1]
        has_slowed = speed.min() < speed[0] - SPED_UP
        first_room = self._room(tick, float(speed[0]))
        later = self._later_cause(tick, math.inf if has_slowed else first_room, crossed, pursuit)
        later = later or self._duty_passed(change, tick, pursuit)
        if later is not None:
            return later
        entered, room = max(self._onset, tick), self._room(tick, self._lowest(change))
        if self._gap(tick) >= room:  # the gap was too small only when the two had come into one track
            crossed = self._placed(What.CAME_IN, 0, entered)
            room = self._room(entered, float(self._frame.speed[0, entered]))
        drove = answer(self._trace, 0, max(tick, self._before), None, danger=tick)
        if self._gap(tick) >= first_room and self._gap(entered) > 0:
            since = pursuit.avoided_from(max(tick, self._before), FOLLOWING)  # there was room at first
            if since is not None:
                facts = (crossed, drove, self._answer(self._npc + 1, since, tick))
                return self._attributed("both", tick, facts, "entered-lane")
        chance = self._second_chance(tick, pursuit, by_ego=False)
        if chance is None and self._gap(tick) >= LEAST_ROOM:
            chance = self._sped_up(self._npc + 1, tick, pursuit)
        if chance is not None:
            return self._attributed("both", tick, (crossed, drove, *self._missed(chance, tick)), "entered-lane")
        asked = Fact(What.LEFT_TOO_LITTLE, 0, self._at(tick), other=self._npc + 1, asked_m=room)
        return self._attributed("ego", tick, (crossed, asked, drove), "entered-lane")

    def _duty_passed(self, change: LaneChange, tick: int, pursuit: Pursuit) -> Attribution | None:
        """Attribute to the follower if it could still have avoided a leader that had kept its new lane for a while.

        None if the leader did not keep the lane for long enough, or if the follower could not avoid the collision.
        """
        kept = self._lanes.kept_since(change.vehicle, tick, self._end)
        since = None if kept is None else pursuit.avoided_from(max(kept[1], self._before), FOLLOWING)
        if kept is None or since is None:
            return None
        lane = self._placed(What.KEPT_LANE, change.vehicle, kept[0])
        if change.vehicle == 0:
            return self._npc_followed(kept[1], kept[0], (lane, self._answer(self._npc + 1, since, kept[0])))
        return self._unanswered(kept[0], lane, self._answer(0, since, kept[0]), "leader-unanswered", change)

    def _gave_way(self, change: LaneChange) -> Attribution:
        room = self._room(change.tick, self._lowest(change))
        gave = Fact(What.GAVE_WAY, 0, self._at(change.tick), other=self._npc + 1, asked_m=room)
        return self._npc_followed(change.tick, change.tick, (self._crossed(change), gave))

    def _npc_changed(self, change: LaneChange) -> Attribution:
        crossed, tick = self._crossed(change), change.tick
        if self._gap(tick) > 0 and self._leads(tick):
            return self._npc_followed(tick, tick, (crossed,), moved_in=tick)
        seen, pursuit = change.seen, self._pursuit(by_ego=True, goes_on=self._end - tick <= SOON * self._hz)
        if min(self._gap(tick), self._gap(max(self._onset, tick))) <= 0:
            return self._excused_behind(tick, (crossed,), pursuit, change)
        late = crossed, Fact(What.HAD_NO_TIME, 0, self._at(tick))
        at_once = tick + round(AT_ONCE * self._hz) + math.ceil(HARD_SECONDS * self._hz)
        is_close = self._gap(tick) < BLOCKED * self._frame.speed[0, tick]
        if is_close and self._npc_braked_hard(tick, min(at_once, self._end)):
            return self._excused_if_answered(tick, late, pursuit, change, seen)
        in_time = slice(seen + 1, seen + 1 + round((CUT_OFF.delay + SPARE) * self._hz))
        spare = SPARE if (braking(self._trace)[in_time] >= BRAKES).any() else 0.0
        since = None if self._is_too_late(seen) else pursuit.avoided_from(seen, CUT_OFF, EMERGENCY, spare)
        if since is not None:
            return self._unanswered(tick, crossed, self._answer(0, since, tick, CUT_OFF), "cut-in-unanswered", change)
        has_answered = pursuit.is_no_further(seen, CUT_OFF, EMERGENCY)
        passed = None if has_answered else self._duty_passed(change, tick, pursuit)
        return self._excused_if_answered(tick, late, pursuit, change, seen) if passed is None else passed

    def _excused_if_answered(
        self, tick: int, late: Reason, pursuit: Pursuit, change: LaneChange, seen: int
    ) -> Attribution:
        """Attribute a cut-in at a tick to the NPC, or to both if the ego did not answer it but could have."""
        excused = self._unless_avoidable(self._excused_behind(tick, late, pursuit, change, seen), tick, pursuit)
        judged = tick + round(ANSWERS_BY * self._hz)
        if excused.responsibility != "npc" or self._stands or self._end < judged + round(ANSWERS_FOR * self._hz):
            return excused
        since, due = (tick + round(response.delay * self._hz) for response in (FOLLOWING, CUT_OFF))
        lost = float(self._frame.speed[0, judged] - self._frame.speed[0, self._end])
        calmly = CUT_OFF.deceleration * (self._end - due) / self._hz
        if lost >= calmly or pursuit.avoided_from(since, HELD) is None:
            return excused
        has_braked = bool((braking(self._trace)[judged + 1 : self._end + 1] >= BRAKES).any())
        ignored = Fact(What.IGNORED, 0, self._at(tick), self._npc + 1, self._at(judged), self._at(since))
        ignored = ignored._replace(has_braked=has_braked, braking_m_per_s2=lost * self._hz / (self._end - judged))
        return self._attributed("both", tick, (late[0], ignored), "cut-in-unanswered")

    def _unless_avoidable(self, found: Attribution, tick: int, pursuit: Pursuit) -> Attribution:
        """Return an attribution, marked if it excuses the ego from a danger that it could have avoided late."""
        if found.responsibility != "npc" or self._stands:
            return found
        since = tick + round(CUT_OFF.delay * self._hz)
        return replace(found, avoidable=pursuit.avoided_from(since, HELD) is not None)

    def _pushed_in(self, change: LaneChange | None) -> bool:
        """Return whether the NPC changed lanes ahead of the ego in the last 5 s without giving way to a driving ego."""
        if change is None or self._stands or self._end - change.tick > SOON * self._hz:
            return False
        speeds = float(self._frame.speed[self._npc + 1, change.tick]), self._lowest(change)
        return any(self._gap(change.tick) < self._room(change.tick, speed, behind=0) for speed in speeds)

    def _npc_braked_hard(self, first: int, last: int) -> bool:
        """Return whether the NPC braked hard between two ticks, for long enough."""
        slowed = -np.diff(self._frame.speed[self._npc + 1, first : last + 1]) * self._hz
        return first_lasting(slowed > HARD_BRAKING, math.ceil(HARD_SECONDS * self._hz)) is not None

    def _strayed(self) -> Attribution:
        """Decide who is responsible for a sideways contact without a lane change, as by drift or in merging lanes."""
        tick, right = self._onset, self._side
        towards = right * self._frame.drift[0, tick], -right * self._frame.drift[self._npc + 1, tick]
        ego, npc = (drift >= DRIFTING for drift in towards)
        if ego == npc:
            ego, npc = (self._lanes.over_line(each, side, tick) for each, side in ((0, right), (self._npc + 1, -right)))
        if ego == npc:
            ego = towards[0] >= towards[1] + DRIFTING
        if not ego:
            return self._excused(tick, (Fact(What.CAME_SIDEWAYS, self._npc + 1, self._at(tick)),))
        sideways = Fact(What.CAME_SIDEWAYS, 0, self._at(tick), other=self._npc + 1)
        return self._blamed_unless_standing(tick, (sideways,), "entered-lane")

    def _later_cause(
        self, tick: int, room: float, crossed: Fact, pursuit: Pursuit, moved_in: int = 0
    ) -> Attribution | None:
        """Attribute to a cause that is later than a lane change at a tick; None if there is none.

        There are two such causes. The ego, which already kept the lane, braked for nothing. Or the NPC behind, which
        was no faster at the tick and at least ``room`` away [m], sped up into the ego.
        """
        kept = self._lanes.kept_since(0, tick, self._end)
        stop = None if kept is None else self._needless_braking(0, moved_in)
        if kept is not None and stop is not None and stop.begin >= kept[1]:
            return self._npc_followed(stop.begin, tick, (crossed,), moved_in)
        ego, npc = self._frame.speed[0, tick], self._frame.speed[self._npc + 1, tick]
        if npc > ego + SPED_UP or self._gap(tick) < room:
            return None
        sped_up = self._sped_up(self._npc + 1, tick, pursuit)
        return None if sped_up is None else self._npc_followed(tick, moved_in or tick, (crossed, sped_up), moved_in)

    def _sped_up(self, behind: int, tick: int, pursuit: Pursuit) -> Fact | None:
        """Return the fact that the follower, which saw the leader from a tick on, sped up into it; None if it did not.

        The follower must have been able to avoid the leader without speeding up. An ego may instead have been able to
        avoid the collision by the response that the rules require. If it came no further than that, it did no harm.
        """
        perceived = tick + round(CUT_OFF.perception * self._hz)
        if perceived >= self._end:
            return None
        since, nearer = perceived, math.inf
        if behind == 0:
            since, nearer = pursuit.last_at_ease(perceived, CUT_OFF.headway), NEARER
        gain = pursuit.gain(since)
        if gain is None or (behind == 0 and pursuit.is_no_further(tick, CUT_OFF, EMERGENCY)):
            return None
        would_answer = behind == 0 and pursuit.avoided_from(tick, CUT_OFF, EMERGENCY) is not None
        if not (would_answer or pursuit.stays_off_unless_faster(since, nearer)):
            return None
        began, until = gain
        return Fact(What.SPED_UP, behind, self._at(began), speed_m_per_s=float(self._frame.speed[behind, until]))

    def _gives_way(self, change: LaneChange) -> bool:
        """Return whether the ego leaves enough room to the NPC that drives behind it when it changes lanes.

        The gap is measured when the ego crosses the lane line, and when the NPC would touch the ego if it drove on.
        """
        entered = max(self._onset, change.tick)
        asked = (change.tick, self._lowest(change)), (entered, float(self._frame.speed[0, entered]))
        return all(self._gap(tick) >= self._room(tick, speed) for tick, speed in asked)

    def _room(self, tick: int, speed: float, behind: int | None = None) -> float:
        """Return the gap [m] that a lane change must leave to the vehicle behind (UN R79, 5.6.4.7).

        ``speed`` is the speed of the vehicle that changes lanes [m/s], and ``behind`` the index of the vehicle behind.
        """
        follower = self._frame.speed[self._npc + 1 if behind is None else behind, tick]
        return room_to_leave(float(follower), speed)

    def _lowest(self, change: LaneChange) -> float:
        """Return a vehicle's lowest speed during its lane change [m/s].

        A vehicle that slows down while it changes lanes has to leave more room to the vehicle behind.
        """
        over = max(self._onset, change.tick) + round(HEADWAY * self._hz)
        return float(self._frame.speed[change.vehicle, change.tick : min(over, self._end) + 1].min())

    def _is_too_late(self, seen: int) -> bool:
        """Return whether the time to collision is too short to respond to a cut-in that the ego sees at a tick."""
        frame = self._frame
        closing = float(frame.speed[0, seen] - frame.speed[self._npc + 1, seen])
        hardest = EMERGENCY.braking.deceleration
        return closing > 0 and self._gap(seen) <= closing * (CUT_OFF.delay + closing / (2 * hardest))

    # One behind the other.

    def _in_one_lane(self) -> Attribution:
        if self._leads(self._start):
            return self._npc_followed(0, self._start, (self._too_close(self._npc + 1),))
        close, pursuit = self._too_close(0), self._pursuit(by_ego=True)
        since = pursuit.avoided_from(self._before, FOLLOWING)
        if since is None and self._steered_behind:
            since = pursuit.avoided_from(self._tailing_since, FOLLOWING)
        if since is not None:
            return self._unanswered(self._start, close, self._answer(0, since, self._start), "leader-unanswered")
        late = close, Fact(What.HAD_NO_TIME, 0, self._at(self._start))
        found = self._excused_behind(self._start, late, pursuit, seen=self._before)
        return self._unless_avoidable(found, self._start, pursuit)

    @property
    def _steered_behind(self) -> bool:
        """True if the ego and the NPC ahead came into one track because only the ego moved sideways."""
        if self._is_in_one_track:
            return False
        drifts = self._side * self._frame.drift[[0, self._npc + 1], self._onset] * (1.0, -1.0)
        return bool(drifts[0] >= DRIFTING > drifts[1])

    @property
    def _tailing_since(self) -> int:
        """The last tick before the ego was behind the NPC and too close along the road, in its track or next to it."""
        ticks = range(self._before, -1, -1)
        near = (0 < self._gap(tick) < self._safe_along[tick] and not self._leads(tick) for tick in ticks)
        return next((tick for tick, is_near in zip(ticks, near, strict=True) if not is_near), 0)

    def _unanswered(
        self, tick: int, danger: Fact, answer: Fact, fault: Fault, change: LaneChange | None = None
    ) -> Attribution:
        """Attribute to the ego, which did not respond, and to an NPC that braked hard for nothing or after a cut-in."""
        npc = self._npc + 1
        stop = None if self._stands else self._needless_braking(npc)
        braked = stop is not None and self._gap(stop.begin) <= AMPLE * self._frame.speed[0, stop.begin]
        if braked or (change and self._pushed_in(change) and self._npc_braked_hard(change.tick, self._end)):
            return self._attributed("both", tick, (danger, answer), fault)
        return self._blamed_unless_standing(tick, (danger, answer), fault)

    def _excused_behind(
        self,
        tick: int,
        reason: Reason,
        pursuit: Pursuit,
        change: LaneChange | None = None,
        seen: int | None = None,
    ) -> Attribution:
        """Attribute to the NPC ahead, unless the ego had escaped the danger, or sped up, and then still ran into it."""
        chance = self._second_chance(tick, pursuit, by_ego=True)
        if chance is None and seen is not None:
            chance = self._sped_up(0, seen, pursuit)
        if chance is None:
            chance = self._eased(tick, pursuit, change)
        if chance is None:
            return self._excused(tick, reason)
        if self._pushed_in(change):
            return self._attributed("both", tick, (reason[0], *self._missed(chance, tick)), "leader-unanswered")
        return self._blamed_unless_standing(tick, (reason[0], chance), "leader-unanswered")

    def _second_chance(self, tick: int, pursuit: Pursuit, *, by_ego: bool) -> Fact | None:
        """Return the fact that the follower had escaped the danger after a tick and then did not respond; else None.

        The follower has escaped if it is no faster than the leader, or if it brakes hard enough to avoid the leader.
        """
        behind, ahead = (0, self._npc + 1) if by_ego else (self._npc + 1, 0)
        closing = self._frame.speed[behind] - self._frame.speed[ahead]
        first = max(tick, self._before) + round(FOLLOWING.delay * self._hz)
        ticks = [at for at in range(first, self._end) if self._gap(at) > 0 and self._leads(at) != by_ego]
        over = max((at for at in ticks if closing[at] <= 0), default=None)
        since = None if over is None else pursuit.avoided_from(over, CUT_OFF, EMERGENCY)
        if over is not None and since is not None:
            return self._answer(behind, since, tick, CUT_OFF)
        braked = [*brakings(self._trace.states[:, behind, SPEED], self._hz), (self._end, self._end)]
        for (_, at), (again, _) in pairwise(braked):
            is_let_go = again - at >= math.ceil(LET_GO * self._hz) and at in ticks and closing[at] > 0
            if is_let_go and pursuit.avoided_from(at, HELD) is not None:
                return Fact(What.LET_BRAKES_GO, behind, self._at(at))
        return None

    def _eased(self, tick: int, pursuit: Pursuit, change: LaneChange | None) -> Fact | None:
        """Return the fact that the ego already braked when it became dangerous, and then braked less; None if not.

        It braked less although it was faster than the vehicle ahead, and could have avoided the collision without the
        time in which a driver moves the foot to the brake. If the NPC changed lanes, it must also have been enough to
        keep the braking that it had, and to brake hard as late as a follower.
        """
        since, slowed = max(tick, self._before), braking(self._trace)
        brakes_behind = slowed[since] >= VISIBLY and self._gap(since) > 0 and not self._leads(since)
        had = float(slowed[since])
        kept = replace(FOLLOWING, deceleration=max(had, HARDEST), delay_deceleration=had)
        required = (ALREADY_BRAKING, kept) if change else (ALREADY_BRAKING,)
        if not brakes_behind or any(pursuit.avoided_from(since, each) is None for each in required):
            return None
        until = min(since + round(FOLLOWING.delay * self._hz), self._end)
        is_faster = self._frame.speed[0] > self._frame.speed[self._npc + 1]
        eases = (is_faster & (slowed < slowed[since] / 2))[since + 1 : until + 1]
        weak = first_lasting(eases, math.ceil(LET_GO * self._hz))
        return None if weak is None else Fact(What.BRAKED_LESS, 0, self._at(since + weak))

    def _npc_followed(self, duty: int, tick: int, reason: Reason, moved_in: int = 0) -> Attribution:
        """Attribute to the NPC behind, which had to respond from a tick on, unless the ego braked for nothing.

        If the NPC moved in behind an ego that had braked for nothing, both are responsible.
        """
        braked = self._needless_braking(0, moved_in)
        if braked is not None and braked.end < duty:
            braked = None
        stop = None if braked is not None and self._is_hard(braked, 0) else long_stop(self._trace)
        is_slow = self._frame.speed[self._npc + 1, self._start] <= CRAWLING
        if stop is not None and not is_slow:
            if not self._is_needless(stop, slice(stop.begin, stop.end + 1), moved_in):
                stop = self._needless_rest(stop, moved_in)
            if stop is not None:
                standing = self._at(self._end - stop.end)
                stopped = Fact(What.STOPPED_FOR_NOTHING, 0, self._at(stop.begin), lasting_s=standing)
                stopped = self._braked_for_nothing(stop) if stop.had_reason else stopped
                return self._needless(stop, max(duty, self._before), stopped, "stopped-for-nothing", moved_in)
        if braked is None:
            return self._excused(tick, reason)
        since = max(duty, min(self._before, braked.begin))  # the braking requires a response at any distance
        fault: Fault = "braked-for-nothing" if self._is_hard(braked, 0) else "stopped-for-nothing"
        return self._needless(braked, since, self._braked_for_nothing(braked), fault, moved_in)

    def _is_hard(self, stop: Stop, vehicle: int) -> bool:
        return bool((braking(self._trace, vehicle)[stop.begin + 1 : stop.end + 1] > HARD_BRAKING).any())

    def _needless_braking(self, leader: int, moved_in: int = 0) -> Stop | None:
        """Return the hard braking of the vehicle ahead for which there was no reason; None if there is none.

        The vehicle must have braked in the last second before the danger began, or later. ``leader`` is the index of
        the vehicle ahead, and ``moved_in`` the tick at which the vehicle behind changed lanes; 0 if it did not.
        """
        first = self._start - round(AFTERMATH_SECONDS * self._hz)
        stops = (
            hard_braking(self._trace, leader, first, self._end),
            None if leader else lasting_braking(self._trace, first),
        )
        stop = max((each for each in stops if each), key=lambda each: (each.end, -each.begin), default=None)
        if stop is None:
            return None
        later = round(HARD_SECONDS * self._hz) if self._is_hard(stop, leader) else 0
        ticks = slice(stop.begin, min(stop.begin + later, self._end) + 1)
        if self._is_needless(stop, ticks, moved_in, leader):
            return stop
        return None if leader else self._needless_rest(stop, moved_in)

    def _needless_rest(self, stop: Stop, moved_in: int) -> Stop | None:
        """Return the part of the ego's braking after its last reason was gone; None if that part does not count.

        It begins 1.0 s after the last reason, at least 1.0 s after the braking began, and must take at least half of
        the speed that the ego has then.
        """
        since = max(stop.begin - round(REASON_SECONDS * self._hz), 0)
        ticks = slice(since, min(stop.end, self._end - 1) + 1)  # at the impact, the vehicle behind is side by side
        found = np.flatnonzero(reasons(self._trace, self._frame, DISTANCES, 0, ticks))
        if not found.size:
            return None
        begin = max(since + int(found[-1]), stop.begin) + round(RELEASE_SECONDS * self._hz)
        if begin >= stop.end:
            return None
        before, after = self._trace.ego[[begin, stop.end], SPEED]
        if before - after < max(before / 2, LEAST_LOST):
            return None
        rest = Stop(begin=begin, end=stop.end, had_reason=True)
        return rest if self._is_needless(rest, slice(begin, begin + 1), moved_in) else None

    def _is_needless(self, stop: Stop, ticks: slice, moved_in: int, leader: int = 0) -> bool:
        """Return whether a braking was needless: the leader had no reason to brake and never regained its speed.

        The other vehicle must have been behind when the braking began, and must not have moved in or sped up later.
        """
        ahead, behind = self._frame.speed[leader], self._frame.speed[0 if leader else self._npc + 1]
        if self._leads(stop.begin) == bool(leader) or ahead[self._end] >= ahead[stop.begin]:
            return False
        closing = behind[stop.begin] - ahead[stop.begin]
        if self._end - stop.end > LATER * self._hz and ahead[self._end] > STANDING_SPEED:
            return False  # it could have adapted to the new speed
        if self._gap(stop.begin) < EMERGENCY.time_to_contact * closing:
            return False  # it would have hit the one ahead anyway
        late = moved_in > stop.end + AFTERMATH_SECONDS * self._hz
        since = max(stop.end, self._before)
        if late or behind[self._end] > behind[since : self._end + 1].min() + DROVE_ON:
            return False
        if stop.had_reason:
            return True
        ticks = slice(max(ticks.start - round(REASON_SECONDS * self._hz), 0), ticks.stop)
        return not reasons(self._trace, self._frame, DISTANCES, leader, ticks).any()

    def _needless(self, stop: Stop, since: int, braked: Fact, fault: Fault, moved_in: int) -> Attribution:
        npc = self._npc + 1
        if moved_in:
            moved = Fact(What.MOVED_IN_BEHIND, npc, self._at(moved_in))
            return self._attributed("both", stop.begin, (braked, moved), fault)
        counted = self._pursuit(by_ego=False).avoided_from(since, FOLLOWING)
        if counted is not None:
            return self._attributed("both", stop.begin, (braked, self._answer(npc, counted, counted)), fault)
        return self._attributed("ego", stop.begin, (braked, Fact(What.HAD_NO_TIME, npc, self._at(since))), fault)

    # The facts of reasons.

    def _attributed(
        self, responsibility: Responsibility, tick: int, facts: Reason, fault: Fault | None = None
    ) -> Attribution:
        return Attribution(responsibility=responsibility, tick=tick, time=self._at(tick), fault=fault, facts=facts)

    def _blamed_unless_standing(self, tick: int, reason: Reason, fault: Fault) -> Attribution:
        """Attribute to the ego, or to the NPC if the ego stood at the impact and for half a second before."""
        rolled = self._frame.speed[0, max(self._end - round(ROLLED * self._hz), 0) : self._end]
        if self._stands and not (rolled > STANDING_SPEED).any():
            return self._excused(tick, reason)
        return self._attributed("ego", tick, reason, fault)

    def _excused(self, tick: int, reason: Reason) -> Attribution:
        if self._stands:
            reason = (Fact(What.STOOD, 0, self._at(self._end), other=self._npc + 1),)
        return self._attributed("npc", tick, reason)

    @property
    def _stands(self) -> bool:
        return bool(abs(self._frame.speed[0, self._end]) <= STANDING_SPEED)

    def _crossed(self, change: LaneChange) -> Fact:
        """Return the fact that a vehicle changed lanes, with its place relative to the other vehicle at that time.

        If it paused over the line, the lane change is the motion after the pause.
        """
        vehicle, tick = change.vehicle, change.tick
        before, side = int(self._trace.road.numbers(vehicle)[tick]), 1 if self._frame.drift[vehicle, tick] > 0 else -1
        earlier = range(max(tick - round(PAUSE * self._hz), 0), tick)
        lanes = self._trace.states[:, vehicle, LANE]
        has_paused = any(lanes[at] == lanes[tick] and self._lanes.over_line(vehicle, side, at) for at in earlier)
        crossed = self._placed(What.MOVED_FURTHER if has_paused else What.CROSSED_LINE, vehicle, tick)
        lane = before + side
        is_numbered = before >= 0 and 0 <= lane < len(self._trace.lanes)
        return crossed._replace(lane=lane if is_numbered else None)

    def _placed(self, what: What, vehicle: int, tick: int) -> Fact:
        """Return a fact about a vehicle at a tick, with its place relative to the other vehicle at that tick."""
        other, gap = self._npc + 1 - vehicle, max(self._gap(tick), 0.0)
        ahead = gap if self._leads(tick) == (vehicle == 0) else -gap
        faster = float(self._frame.speed[other, tick] - self._frame.speed[vehicle, tick])
        braked = self._led_braking(tick) if (ahead > 0) == (vehicle > 0) and ahead else 0.0
        return Fact(what, vehicle, self._at(tick), other, gap_m=ahead, faster_m_per_s=faster, leader_m_per_s2=braked)

    def _led_braking(self, tick: int) -> float:
        """Return the hardest braking of the NPC ahead from one second before a tick on [m/s^2]; 0 if below 3 m/s^2."""
        since = max(tick - round(BRAKED_BEFORE * self._hz), 0)
        peak = float(braking(self._trace, self._npc + 1)[since + 1 : self._end + 1].max(initial=0.0))
        return peak if peak >= BRAKED_VISIBLY else 0.0

    def _too_close(self, follower: int) -> Fact:
        close, safe = self._placed(What.CAME_TOO_CLOSE, follower, self._start), float(self._safe_along[self._start])
        return close._replace(gap_m=min(close.gap_m, -1e-9), asked_m=safe)  # a gap of 0 would read as "next to"

    def _braked_for_nothing(self, stop: Stop) -> Fact:
        peak = float(braking(self._trace)[stop.begin : stop.end + 1].max())
        what = What.BRAKED_ON if stop.had_reason else What.BRAKED_FOR_NOTHING
        return Fact(what, 0, self._at(stop.begin), braking_m_per_s2=peak)

    def _answer(self, vehicle: int, since: int, danger: int, response: Braking = FOLLOWING) -> Fact:
        """Return the fact that tells what the follower should have done, and what it did instead.

        The follower had to respond from the tick ``since`` on. What it did is told from the tick ``danger`` on.
        """
        pursuit = cache(partial(self._pursuit, by_ego=vehicle == 0, goes_on=True))  # made if somebody reads the fact

        def avoids(tick: int, rate: float) -> bool:
            return pursuit().is_avoided_by_braking(tick, rate)

        return answer(self._trace, vehicle, since, avoids, response, danger=danger)

    def _missed(self, chance: Fact, tick: int) -> Reason:
        """Return the fact on a second chance that the follower missed, with what it should have done and did."""
        since = max(tick, self._before)
        return (chance,) if chance.what is What.ANSWERED else (chance, self._answer(chance.vehicle, since, tick))

    def _at(self, tick: int) -> float:
        """Return the time of a tick [s]."""
        return tick / self._hz

    def _gap(self, tick: int) -> float:
        """Return the gap between the boxes of ego and NPC along the road [m]; negative if they are side by side."""
        frame, npc = self._frame, self._npc
        half = frame.half_along[0, tick] + frame.half_along[npc + 1, tick]
        return float(abs(frame.ahead[npc, tick]) - half)

    def _leads(self, tick: int) -> bool:
        """Return whether the ego is ahead of the NPC at a tick."""
        return bool(self._frame.ahead[self._npc, tick] < 0)

    def _pursuit(self, *, by_ego: bool, goes_on: bool = False) -> Pursuit:
        """Return the pursuit of the NPC by the ego, or of the ego by the NPC.

        ``goes_on`` is whether the vehicle ahead continues to brake after the last tick.
        """
        frame, npc, past, way = self._frame, self._npc, slice(self._end + 1), 1.0 if by_ego else -1.0
        vehicles = (0, npc + 1) if by_ego else (npc + 1, 0)
        first, second = ((frame.cos[vehicle, past], frame.sin[vehicle, past]) for vehicle in vehicles)
        responder, other = (frame.speed[vehicle, past] for vehicle in vehicles)
        own, theirs = ((float(length), float(width)) for length, width in self._trace.sizes[list(vehicles)])
        return Pursuit(
            ahead=way * frame.ahead[npc, past],
            right=way * frame.right[npc, past],
            directions=(first, second),
            speeds=(responder, other),
            sizes=(own, theirs),
            hz=self._hz,
            goes_on=goes_on,
        )
