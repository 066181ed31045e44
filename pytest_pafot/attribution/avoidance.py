"""Would a driver have avoided a collision by braking? Against the other's motion as it was recorded.

Braking is the proper response to whoever is ahead (Shalev-Shwartz et al. 2017). The responder keeps its line, and is
integrated as the world integrates: each step goes at the speed at its beginning.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pytest_pafot.criticality.boxes import Boxes, overlaps, relate
from pytest_pafot.model.trace import FloatArray

Direction = tuple[FloatArray, FloatArray]
"""Cosine and sine of an angle, tick by tick."""

DRAWS_AWAY = 2.0
"""From so much more speed of the other on, no headway has to be restored by braking [m/s]."""

HORIZON = 12.0
"""How far the two are followed beyond the impact [s]; longer than the calmest braking to a standstill takes."""

ALIKE = 0.1
"""Whoever drove at most so much faster than the reference answered as it does [m/s]."""
SPED_UP = 0.3
"""Less is no speeding up [m/s]."""
HARDEST = 6.0
"""How hard the rules ask anybody to brake at most [m/s^2]; it is that of UN R157, 5.2.5.2."""
MARGIN = 0.2
"""Who is at most so much further ahead at the impact, in seconds of its driving, and no faster, answered [s]."""
NEARLY = 0.5
"""Who answers a cut-in may then be so much faster than the reference [m/s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Braking:
    """How a driver responds.

    Attributes:
        delay: from the moment at which there is something to respond to, until the brakes have acted for a tick, so
            that what the safe distance of RSS leaves room for is avoided in steps of time as well [s].
        deceleration: from then on, while faster than the other, or nearer than the headway [m/s^2].
        perception: first part of the delay, in which it may go on speeding up as it did [s].
        headway: that it restores [s].
    """

    delay: float
    deceleration: float
    perception: float = 0.0
    headway: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Emergency:
    """When calm braking no longer is the proper response, and what is.

    Attributes:
        time_to_contact: below which it is an emergency, at constant speeds [s].
        leader_braking: above which it is one [m/s^2].
        perception: how long it must last to be perceived as one [s].
        braking: the response, until the two no longer close in.
    """

    time_to_contact: float
    leader_braking: float
    perception: float
    braking: Braking


@dataclass(frozen=True, kw_only=True, eq=False)
class Pursuit:
    """A responder and another ahead of it, from the start of a run to their contact, or almost, at the last tick.

    All arrays have the shape [ticks + 1].

    Attributes:
        ahead, right: of the other's centre from the responder's, along and across the road [m].
        directions: of the responder and of the other, cosine and sine of the angle to the road.
        speeds: likewise, along the road [m/s].
        sizes: likewise, length and width [m].
        hz: ticks per second.
        goes_on: whether the other, if it brakes at the last tick, does so afterwards.
    """

    ahead: FloatArray
    right: FloatArray
    directions: tuple[Direction, Direction]
    speeds: tuple[FloatArray, FloatArray]
    sizes: tuple[tuple[float, float], tuple[float, float]]
    hz: int
    goes_on: bool = False

    def avoided_from(
        self, since: int, response: Braking, emergency: Emergency | None = None, spare: float = 0.0
    ) -> int | None:
        """The tick from which on a response would have kept the responder off the other; None if it would not have.

        That is the tick since which there is something to respond to, or, where the reference restores its headway, a
        later one, up to which the responder has answered: the last, once the answer was due, at which it was no faster
        than the other, and so far no faster than the reference.

        Until the impact the other moves as recorded, and the boxes are turned as they were; after it, it is ahead in
        one lane and keeps its speed, or its braking. The responder is followed until it is no faster, at most 12 s.
        One that drove no faster than the reference has answered, whatever came of it; so has one that at the impact is
        no faster, and hardly further ahead.

        Args:
            spare: by how much later the response must avoid the contact, too [s].
        """
        end = len(self.ahead) - 1
        if since >= end:
            return None
        speeds, lost = self._driven(since, response, emergency)
        recorded = end - since + 1
        is_alike = self.speeds[0][since:] <= speeds[:recorded] + ALIKE
        hardly_faster = self.speeds[0][-1] <= speeds[recorded - 1] + (ALIKE if emergency is None else NEARLY)
        if is_alike.all() or (hardly_faster and lost[recorded - 1] <= MARGIN * self.speeds[0][-1]):
            return None
        answered = slice(since + round(response.delay * self.hz), since + int(is_alike.argmin()))
        no_faster = np.flatnonzero(self.speeds[0][answered] <= self.speeds[1][answered])
        if response.headway > 0 and no_faster.size:
            return self.avoided_from(answered.start + int(no_faster[-1]), response, emergency, spare)
        is_hit = self._is_hit(since, lost)
        if spare > 0 and not is_hit:
            is_hit = self._is_hit(since, self._driven(since, *_later(spare, response, emergency))[1])
        return None if is_hit else since

    def is_no_further(self, since: int, response: Braking, emergency: Emergency) -> bool:
        """Return whether the responder is no further ahead at the impact than a response from a tick on would be."""
        end = len(self.ahead) - 1
        return since < end and bool(self._driven(since, response, emergency)[1][end - since] <= 0)

    def sped_up(self, since: int) -> int | None:
        """The last tick at which the responder was slowest since a tick; None where it is no faster at the impact."""
        recorded = self.speeds[0][since:]
        if len(recorded) < 2 or recorded[-1] <= recorded.min() + SPED_UP:
            return None
        return since + last_slowest(recorded)

    def stays_off_unless_faster(self, since: int) -> bool:
        """Return whether it would have stayed off the other, had it never driven faster than before since a tick.

        And could have slowed down to the other's speed at the impact.
        """
        end = len(self.ahead) - 1
        recorded = self.speeds[0][since:]
        held = np.minimum.accumulate(recorded)
        lost = np.concatenate(([0.0], np.cumsum(recorded - held)[:-1] / self.hz))
        closing = max(float(held[-1] - self.speeds[1][end]), 0.0)
        is_hit = self._touches(slice(since, end + 1), lost)
        return not is_hit and bool(self._gaps[-1] + lost[-1] > closing**2 / (2 * HARDEST))

    def _driven(self, since: int, response: Braking, emergency: Emergency | None) -> tuple[FloatArray, FloatArray]:
        """Speeds of the reference [m/s], and by how much it is further back than recorded [m], tick by tick.

        Until its answer is due it drives as recorded, but never speeds up once it has perceived the danger.
        """
        hz, gaps, recorded, other = self.hz, self._gaps[since:], self._lists[0][since:], self._lists[1][since:]
        end, perceives, due = len(recorded) - 1, round(response.perception * hz), round(response.delay * hz)
        alarm = None if emergency is None else Alarm(self, since, emergency)
        slowing = max(other[-2] - other[-1], 0.0) if self.goes_on else 0.0
        speed, leader, back, speeds, lost = recorded[0], other[0], 0.0, [recorded[0]], [0.0]
        for tick in range(end + math.ceil(HORIZON * hz)):
            is_recorded = tick < end
            leader = other[tick] if tick <= end else max(leader - slowing, 0.0)
            if tick >= end and speed <= leader and not (slowing and leader):
                break
            deceleration = response.deceleration if tick + 1 >= due else 0.0
            gap = gaps[min(tick, end)] + back
            if alarm is not None and alarm.acts(tick, speed - leader, gap):
                deceleration = alarm.deceleration
            is_near = gap < response.headway * speed and leader < speed + DRAWS_AWAY
            back += ((recorded[tick] if is_recorded else leader) - speed) / hz
            wanted = max(speed - deceleration / hz, 0.0) if speed > leader or is_near else speed
            if is_recorded and tick + 1 < due:
                wanted = recorded[tick + 1] if tick < perceives else min(wanted, recorded[tick + 1])
            speed = wanted
            speeds.append(speed)
            lost.append(back)
        return np.array(speeds), np.array(lost)

    @cached_property
    def _gaps(self) -> list[float]:
        """Between the boxes as if they were straight [m]."""
        gaps: list[float] = (self.ahead - (self.sizes[0][0] + self.sizes[1][0]) / 2).tolist()
        return gaps

    @cached_property
    def _lists(self) -> tuple[list[float], list[float]]:
        """Speeds as lists, which are faster one by one."""
        return self.speeds[0].tolist(), self.speeds[1].tolist()

    def _is_hit(self, since: int, lost: FloatArray) -> bool:
        """Whether the responder, so much further back than recorded since a tick [m], touches the other."""
        recorded = len(self.ahead) - since
        is_hit = self._touches(slice(since, len(self.ahead)), lost[:recorded])
        return is_hit or bool((self._gaps[-1] + lost[recorded:] <= 0).any())  # here lost counts what the other gained

    def _touches(self, ticks: slice, lost: FloatArray) -> bool:
        """Whether the boxes touch at any tick, with the responder further back."""
        responder, other = self.sizes
        ahead, right = self.ahead[ticks] + lost, self.right[ticks]
        reach = (math.hypot(*responder) + math.hypot(*other)) / 2
        near = (np.abs(ahead) <= reach) & (np.abs(right) <= reach)
        if not near.any():
            return False
        still = np.zeros(int(near.sum()))
        places = (still, still), (ahead[near], right[near])
        boxes = (
            Boxes(
                x=x, y=y, cos=cos[ticks][near], sin=sin[ticks][near], vx=still, vy=still,
                half_length=still + length / 2, half_width=still + width / 2,
            )
            for (x, y), (cos, sin), (length, width) in zip(places, self.directions, self.sizes, strict=True)
        )  # fmt: skip
        return bool(overlaps(relate(*boxes)).any())


def last_slowest(speeds: FloatArray) -> int:
    """Return the last index at which a vehicle is as slow as it has been so far."""
    return int(np.flatnonzero(speeds == np.minimum.accumulate(speeds))[-1])


def _later(seconds: float, response: Braking, emergency: Emergency | None) -> tuple[Braking, Emergency | None]:
    """Responses that begin so much later, and perceive as soon."""
    late = None if emergency is None else replace(emergency, braking=_later(seconds, emergency.braking, None)[0])
    return replace(response, delay=response.delay + seconds), late


class Alarm:
    """Tells a responder, tick by tick, whether it brakes for an emergency."""

    def __init__(self, pursuit: Pursuit, since: int, emergency: Emergency) -> None:
        hz = pursuit.hz
        self.deceleration = emergency.braking.deceleration
        self._emergency = emergency
        self._lasting, self._delay = math.ceil(emergency.perception * hz), round(emergency.braking.delay * hz)
        other = pursuit.speeds[1]
        self._brakings = (-np.diff(other, prepend=other[:1])[since:] * hz).tolist()
        self._later = self._brakings[-1] if pursuit.goes_on else 0.0
        self._held, self._from = 0, math.inf

    def acts(self, tick: int, closing: float, gap: float) -> bool:
        """Whether the emergency's braking acts in the step from a tick, at a closing speed [m/s] and a gap [m]."""
        emergency = self._emergency
        is_near = closing > 0 and gap < emergency.time_to_contact * closing
        braking = self._brakings[tick] if tick < len(self._brakings) else self._later
        is_critical = is_near or braking > emergency.leader_braking
        self._held = self._held + 1 if is_critical else 0
        if self._held >= self._lasting:
            self._from = min(self._from, tick - self._held + 1 + self._delay)
        if tick >= self._from and closing <= 0:
            self._from, self._held = math.inf, 0
        return tick + 1 >= self._from
