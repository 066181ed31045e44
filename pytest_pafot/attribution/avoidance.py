"""Would the vehicle behind have avoided a collision by braking? Against the other's motion as it was recorded.

One dimension, along the road: braking is the proper response to whoever is ahead (Shalev-Shwartz et al. 2017), and
braking harder or longer never brings a follower closer to its leader. So it is enough to brake to a standstill, and
everything is a handful of array operations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from pytest_pafot.trace import FloatArray

_Scalar = TypeVar("_Scalar", bound=np.generic)

HORIZON = 12.0
"""How far the motions are followed beyond the impact [s]; longer than the calmest braking to a standstill takes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Braking:
    """How a driver responds.

    Attributes:
        delay: from the moment at which there is something to respond to, until the brakes act [s].
        deceleration: from then on [m/s^2].
        perception: first part of the delay, in which it may go on speeding up as it did [s].
    """

    delay: float
    deceleration: float
    perception: float = 0.0


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Chase:
    """A follower and a leader along the road, from the start of a run to their contact, or almost, at the last tick.

    Attributes:
        gap: between the boxes, leader's rear minus follower's front [m]; negative beside each other. Shape [ticks + 1].
        abreast: whether the boxes overlap across the road, so that a gap of 0 is contact.
        follower, leader: speeds [m/s].
        leader_acceleration: [m/s^2].
        hz: ticks per second.
    """

    gap: FloatArray
    abreast: npt.NDArray[np.bool_]
    follower: FloatArray
    leader: FloatArray
    leader_acceleration: FloatArray
    hz: int

    def is_avoided(self, since: int, response: Braking, emergency: Emergency | None = None) -> bool:
        """Whether the follower keeps off the leader by braking.

        Since a tick there is something to respond to. During the delay of the response it drives as it did, except that
        it does not speed up once it perceives the danger; then it brakes at least so hard, to a standstill, and harder
        in an emergency. Beyond the last tick the leader goes on braking as it did then, or keeps its speed.
        """
        ticks = len(self.gap) + math.ceil(HORIZON * self.hz) - since
        leader = self._extended(self.leader, since, ticks)
        beyond = np.arange(ticks) - (len(self.gap) - 1 - since)
        braking = min(float(self.leader_acceleration[-1]), 0.0)
        leader = np.where(beyond > 0, np.maximum(leader + braking * beyond / self.hz, 0.0), leader)
        recorded = self._extended(self.follower, since, ticks)
        perceives = round(response.perception * self.hz)
        recorded[perceives:] = np.minimum(recorded[perceives:], recorded[perceives])
        speed = self._braked(recorded, 0, response)
        if emergency is not None:
            speed = self._with_emergencies(speed, leader, since, response, emergency)
        touching = (self._gap(since, speed, leader) <= 0) & self._extended(self.abreast, since, ticks)
        return not touching.any()

    def _with_emergencies(
        self, speed: FloatArray, leader: FloatArray, since: int, response: Braking, emergency: Emergency
    ) -> FloatArray:
        """Braking harder in each emergency, and calmly again after it."""
        calm = Braking(delay=0.0, deceleration=response.deceleration)
        brakes_hard = self._extended(self.leader_acceleration, since, len(speed)) < -emergency.leader_braking
        over = 0
        while True:
            closing = speed - leader
            near = (closing > 0) & (self._gap(since, speed, leader) < emergency.time_to_contact * closing)
            begin = _first_lasting((near | brakes_hard)[over:], math.ceil(emergency.perception * self.hz))
            if begin is None:
                return speed
            acts = over + begin + round(emergency.braking.delay * self.hz)
            speed = self._braked(speed, over + begin, emergency.braking)
            ends = np.flatnonzero(speed[acts:] <= leader[acts:])
            if not ends.size:
                return speed
            over = acts + int(ends[0])
            held = np.where(np.arange(len(speed)) < over, speed, speed[over])
            speed = self._braked(held, over, calm)

    def _braked(self, speed: FloatArray, begin: int, braking: Braking) -> FloatArray:
        """Speeds as given until the delay is over, then braking at least so hard."""
        acts = begin + round(braking.delay * self.hz)
        if acts >= len(speed):
            return speed
        later = np.arange(len(speed) - acts) * (braking.deceleration / self.hz)
        braked = speed.copy()
        braked[acts:] = np.maximum(np.minimum(speed[acts:], speed[acts] - later), 0.0)
        return braked

    def _gap(self, since: int, speed: FloatArray, leader: FloatArray) -> FloatArray:
        """With the follower at other speeds from a tick on; each step goes at the speed at its beginning."""
        gained = np.cumsum(leader - speed) / self.hz
        gap: FloatArray = self.gap[since] + np.concatenate(([0.0], gained[:-1]))
        return gap

    def _extended(self, values: npt.NDArray[_Scalar], since: int, ticks: int) -> npt.NDArray[_Scalar]:
        """From a tick on, with the last value held."""
        recorded = values[since:]
        return np.concatenate((recorded, np.repeat(recorded[-1:], ticks - len(recorded))))


def _first_lasting(holds: npt.NDArray[np.bool_], ticks: int) -> int | None:
    """Where a condition first begins to hold for so many ticks; None if it never does."""
    count = np.concatenate(([0], np.cumsum(holds)))
    lasting = np.flatnonzero(count[ticks:] - count[:-ticks] == ticks)
    return int(lasting[0]) if lasting.size else None
