"""Right of way where the NPC's way meets the ego's: which vehicle did not give way, and which entered a taken zone.

This is rule 9 of docs/explanation/verdicts.md, clause by clause. Sources: Shalev-Shwartz, Shammah, Shashua, "On a
Formal Model of Safe and Scalable Self-driving Cars", arXiv:1708.06374, definitions 15 to 18, as ad-rss-lib has them;
Vienna Convention on Road Traffic, Art. 1 and 18.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pytest_pafot.attribution.avoidance import HARDEST, Braking
from pytest_pafot.attribution.responses import (
    ALREADY_BRAKING,
    DISTANCES,
    FOLLOWING,
    GIVING_WAY,
    HEADWAY,
    VISIBLY,
    answer,
    room_to_leave,
)
from pytest_pafot.attribution.sentences import Fact, Reason, What
from pytest_pafot.criticality.boxes import Boxes, overlaps, relate
from pytest_pafot.model.crossings import Zone
from pytest_pafot.model.trace import ALONG, HEADING, SPEED, Trace, X, Y

SPARE = 1.0
"""The distance outside its stretch of a zone at which a vehicle still counts as in the zone [m]. The stretches assume
vehicles in the middle of their ways, and a vehicle may have moved back a little."""
LOOK = 0.6
"""The time, up to its last chance to stop, in which a vehicle that has to give way observes the other vehicle [s]. One
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
        before = np.flatnonzero(places < self.begins - SPARE)
        since, end = int(before[-1]) + 1 if before.size else 0, len(places) - 1
        entered = since + np.flatnonzero(places[since:] >= self.begins)
        self.entry = None if since > end else int(entered[0]) if entered.size else end

    @property
    def is_inside(self) -> bool:
        """True if the vehicle is in its stretch of the zone, or at most 1 m outside of it, at the last tick."""
        return bool(self.begins - SPARE <= self.places[-1] <= self.ends + SPARE)

    def entered(self) -> int:
        """Return the tick at which the vehicle enters the zone.

        Raises:
            ValueError: if the vehicle does not enter the zone.
        """
        if self.entry is None:
            raise ValueError("expected a vehicle that has entered the zone, received one that has not")
        return self.entry

    def chances(self) -> list[Chance]:
        """Return the last chances to stop before the zone; a vehicle that was too fast had its chance at tick 0."""
        found = self.stops(self.entered(), self.begins)
        return found if found and found[0].response is FOLLOWING else [Chance(0, FOLLOWING), *found]

    def stops(self, before: int, place: float) -> list[Chance]:
        """Return the last chances, before the tick ``before``, to stop before a place [m].

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
