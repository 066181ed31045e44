"""Right of way where the NPC's way meets the ego's: which vehicle did not give way, and which entered a taken zone.

This is rule 9 of docs/explanation/verdicts.md, clause by clause. Sources: Shalev-Shwartz, Shammah, Shashua, "On a
Formal Model of Safe and Scalable Self-driving Cars", arXiv:1708.06374, definitions 15 to 18, as ad-rss-lib has them;
Vienna Convention on Road Traffic, Art. 1 and 18.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pytest_pafot.attribution.avoidance import HARDEST
from pytest_pafot.attribution.responses import DISTANCES, FOLLOWING, GIVING_WAY, HEADWAY, answer, room_to_leave
from pytest_pafot.attribution.sentences import Fact, Reason, What
from pytest_pafot.criticality.boxes import Boxes, overlaps, relate
from pytest_pafot.model.crossings import Zone
from pytest_pafot.model.trace import ALONG, HEADING, SPEED, Trace, X, Y

SPARE = 1.0
"""The distance outside its stretch of a zone at which a vehicle may still be touched there, or may have backed away a
little: the stretches assume vehicles in the middle of their ways [m]."""
STOPS = 1.3
"""The deceleration from which on a vehicle brakes to stop; a smaller one needs no brake light (UN R13-H, 5.2.22.4) and
only means that it arrives later [m/s^2]."""
LOOK = 0.6
"""The time up to its last chance in which a vehicle that has to give way observes the other: one tick is too little
[s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Blame:
    """The vehicles that failed in a zone; vehicle 0 is the ego, ``i + 1`` NPC ``i``.

    Attributes:
        did_not_give_way, entered_taken_zone: vehicles that did so.
        tick: tick at which the first vehicle that did not give way entered, or else the first that entered a taken
            zone.
        facts: facts that the reason states.
    """

    did_not_give_way: tuple[int, ...]
    entered_taken_zone: tuple[int, ...]
    tick: int
    facts: Reason


class Passing:
    """A vehicle that approaches a zone along its way.

    Attributes:
        places: position along its way at each tick [m].
        speeds: speed along its body at each tick [m/s].
        begins, ends: its stretch of the zone [m].
        entry: tick at which it enters; None if it has not, or is back before the zone at the last tick.
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
        """True if it is in its stretch of the zone at the last tick, or hardly outside."""
        return bool(self.begins - SPARE <= self.places[-1] <= self.ends + SPARE)

    def entered(self) -> int:
        """Return the tick at which it enters.

        Raises:
            ValueError: if it does not enter.
        """
        if self.entry is None:
            raise ValueError("expected a vehicle that has entered the zone, received one that has not")
        return self.entry

    def last_chance(self) -> int:
        """Return the last tick before it enters at which the proper response stops it before the zone.

        That is the first tick if there is none, because it came too fast.
        """
        return self.last_stop(self.entered(), self.begins) or 0

    def last_stop(self, before: int, place: float) -> int | None:
        """Return the last tick before a tick at which the proper response stops it before a place; None if none."""
        for tick in range(before - 1, -1, -1):
            if place - self.places[tick] >= stopping(float(self.speeds[tick]), HARDEST):
                return tick
        return None

    def look(self, last: int) -> range:
        """Return the ticks up to its last chance in which it had to observe the other."""
        return range(max(last - round(LOOK * self.hz), 0), last + 1)

    def leaves(self) -> float:
        """Return when it leaves, after the last tick with its last speed [s]; infinite if it stands then."""
        passed = (tick for tick in range(self.entered(), len(self.places)) if self.places[tick] >= self.ends)
        tick = next(passed, None)
        if tick is not None:
            return tick / self.hz
        speed = float(self.speeds[-1])
        return (len(self.places) - 1) / self.hz + float(self.ends - self.places[-1]) / speed if speed > 0 else math.inf

    def foreseen(self, tick: int, time: float) -> tuple[float, float]:
        """Return the place [m] and speed [m/s] at a time [s] that can be foreseen for it at a tick."""
        speed, seconds = float(self.speeds[tick]), time - tick / self.hz
        if speed <= 0:
            return float(self.places[tick]), 0.0
        slowing = (float(self.speeds[tick - 1]) - speed) * self.hz if tick else 0.0
        if slowing < STOPS:
            return float(self.places[tick]) + speed * seconds, speed
        seconds = min(seconds, speed / slowing)
        return float(self.places[tick]) + speed * seconds - slowing * seconds**2 / 2, speed - slowing * seconds

    def slowest(self, tick: int) -> float:
        """Return its lowest speed from a tick on, for as long as a vehicle behind may still adapt [m/s]."""
        return float(self.speeds[tick : tick + round(HEADWAY * self.hz) + 1].min())


def stopping(speed: float, deceleration: float) -> float:
    """Return the distance that a vehicle needs to respond and stop [m]."""
    return speed * FOLLOWING.delay + speed**2 / (2 * deceleration)


class ZoneConflict:
    """The ego and the NPC of a collision in the zone of their ways, up to the impact."""

    def __init__(self, trace: Trace, npc: int, zone: Zone) -> None:
        self._trace, self._zone = trace, zone
        self.ego, self.npc = (Passing(trace, vehicle, zone) for vehicle in (0, npc + 1))

    @property
    def is_in_zone(self) -> bool:
        """True if both are in their stretches of the zone at the impact."""
        return self.ego.is_inside and self.npc.is_inside

    @property
    def has_merged(self) -> bool:
        """True if both have reached a zone in which their ways merge."""
        return self._zone.kind == "merging" and self.ego.entry is not None and self.npc.entry is not None

    @property
    def blame(self) -> Blame | None:
        """The vehicles that failed; None if neither did."""
        pairs = ((self.ego, self.npc), (self.npc, self.ego))
        holder = {"ego": self.ego, "npc": self.npc}.get(self._zone.priority)
        without = tuple(own for own, other in pairs if own is not holder and self._did_not_give_way(own, other))
        seen = {own: self._seen_taken(own, other) for own, other in pairs if own not in without}
        taken = tuple(own for own, ticks in seen.items() if ticks)
        if not without and not taken:
            return None
        first, owing = (without or taken)[0], (taken or without)[0]
        since = seen[owing][-1] if taken else owing.last_chance()
        other = self.npc if first is self.ego else self.ego
        at = first.entered() / first.hz
        entered = Fact(
            What.ENTERED, first.vehicle, at, other.vehicle, later_s=other.entered() / other.hz, zone=self._zone
        )
        return Blame(
            did_not_give_way=tuple(each.vehicle for each in without),
            entered_taken_zone=tuple(each.vehicle for each in taken),
            tick=first.entered(),
            facts=(entered, answer(self._trace, owing.vehicle, owing.speeds, since)),
        )

    def _did_not_give_way(self, own: Passing, other: Passing) -> bool:
        """Return whether the other was foreseen in the zone with it, too near to stop without abrupt braking."""
        enters, leaves = own.entered() / own.hz, own.leaves()
        for tick in own.look(own.last_chance()):
            place, speed = other.foreseen(tick, enters)
            if other.foreseen(tick, leaves)[0] < other.begins:
                continue
            if self._zone.kind == "merging":
                is_near = self._is_near_in_lane(own, other, place, speed)
            else:
                is_near = other.begins - place < stopping(speed, GIVING_WAY.deceleration) and place < other.ends
            if is_near:
                return True
        return False

    def _is_near_in_lane(self, own: Passing, other: Passing, place: float, speed: float) -> bool:
        """Return whether a merging vehicle leaves too small a gap to the foreseen place of the other."""
        enters = own.entered()
        lead = float((other.ends - place) - (own.ends - own.places[enters]))
        gap = abs(lead) - own.half_length - other.half_length
        if lead >= 0:
            return gap < room_to_leave(speed, own.slowest(enters))
        return gap < float(DISTANCES.safe_along(own.speeds[enters], np.asarray(speed), FOLLOWING.delay))

    def _seen_taken(self, own: Passing, other: Passing) -> list[int]:
        """Return the ticks at which the other was visibly in the zone to stay and it could still respond."""
        if self._zone.kind == "merging":
            return self._could_slow_down(own, other)
        touched = self._reaches(own, other)
        last = own.last_stop(touched, float(own.places[touched]))
        if last is None:
            return []
        enters, since = own.entered() / own.hz, other.entered()
        ticks = (tick for tick in own.look(last) if tick >= since)
        return [tick for tick in ticks if other.foreseen(tick, max(enters, tick / own.hz))[0] < other.ends]

    def _reaches(self, own: Passing, other: Passing) -> int:
        """Return the tick from which on its box always touches the place of the other's box at the impact."""
        poses = self._trace.states[:, own.vehicle], self._trace.states[-1:, other.vehicle]
        mine, others = (
            Boxes.driving(*rows[:, [X, Y, HEADING, SPEED]].T, *self._trace.sizes[each.vehicle, :, None])
            for rows, each in zip(poses, (own, other), strict=True)
        )
        free = np.flatnonzero(~overlaps(relate(mine, others))[:-1])
        return int(free[-1]) + 1 if free.size else 0

    @staticmethod
    def _could_slow_down(own: Passing, other: Passing) -> list[int]:
        """Return the ticks at which the other merged ahead of it and it could have slowed down to the other's speed."""
        ticks = range(other.entered(), own.entered())
        leads = {tick: float(own.ends - own.places[tick] - (other.ends - other.places[tick])) for tick in ticks}
        slowest = {tick: float(other.speeds[tick:].min()) for tick in ticks}
        apart = own.half_length + other.half_length
        return [
            tick
            for tick, lead in leads.items()
            if lead > 0 and lead - apart >= stopping(max(float(own.speeds[tick]) - slowest[tick], 0.0), HARDEST)
        ]
