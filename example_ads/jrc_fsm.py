"""The European Commission's safety models for UN Regulation 157, behind an adapter that keeps the lane.

Kind (a), for ``pafot.Highway``. Needs numba, and the environment variable ``JRC_FSM`` with the folder of a clone of
https://github.com/ec-jrc/JRC-FSM (commit 01b05c2, licence EUPL-1.2). Nothing in it was changed.

Theirs is the speed: ``utility.movement.control``, one step of their own simulations. As long as a model's check says
safe, the ego approaches its desired speed with up to 1 m/s^2. Otherwise it reacts as the model says, and after the
danger it holds its speed.

The adapter adds:

- the other vehicles: their simulations have one, so there is one of their egos for each, and the lowest speed counts;
- the time after a danger: their simulations end there. Here an ego that saw no danger for a second is replaced by a
  fresh one, which may accelerate again;
- the desired speed: the speed limit, or the speed at the start if it is higher.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from pytest_pafot import Drive, Observation
from pytest_pafot.world import VehicleState

from . import import_from_clone

import_from_clone("JRC_FSM", "ec-jrc/JRC-FSM", "01b05c29dc9a1a410d3f9de1ed3f1a6dfe978116", "utility")
from utility import models, movement, vehicle  # noqa: E402 - of the clone

CALM = 1.0
NOW = 1
"""The index of the present in their arrays over time, which have three values here: before, now and next."""
NOBODY = VehicleState(x=-1e3, y=0.0, heading=0.0, speed=0.0, lane=0, length=5.0, width=2.0)
NOBODYS_ID = -1


class SafetyModel:
    """A driver that keeps its lane, with the speed of one of their models: "FSM" or "RSS"."""

    def __init__(self, model: str) -> None:
        self._check, self._react = getattr(models, f"{model}_check_safety"), getattr(models, f"{model}_react")
        self._egos: dict[int, Any] = {}
        self._last_danger: dict[int, float] = {}
        self._lane: int | None = None
        self._speed_before = self._desired_speed = 0.0

    def __call__(self, seen: Observation) -> Drive:
        """Return the acceleration to the lowest of the speeds that the other vehicles allow."""
        if self._lane is None:
            self._lane, self._speed_before = seen.ego.lane, seen.ego.speed
            self._desired_speed = max(seen.ego.speed, seen.speed_limit)
        others = [*zip(seen.ids, seen.others, seen.lateral_velocities[1:], strict=True), (NOBODYS_ID, NOBODY, 0.0)]
        speed = min(self._next_speed(seen, *each) for each in others)
        self._speed_before = seen.ego.speed
        return Drive(lane=self._lane, acceleration=(speed - seen.ego.speed) / seen.decision_period)

    def _next_speed(self, seen: Observation, number: int, other: VehicleState, lateral: float) -> float:
        """Return the ego's next speed [m/s] as if this were the only other vehicle."""
        now, hz = seen.ego, 1 / seen.decision_period
        ego, them = self._egos.setdefault(number, vehicle.vehicle()), vehicle.vehicle()
        side = 1.0 if other.y >= now.y else -1.0  # their vehicles cut in from a positive position
        _place(ego, now, [self._speed_before, now.speed, self._desired_speed], 0.0, 0.0, 0.0)
        _place(them, other, [other.speed] * 3, other.x - now.x, side * (other.y - now.y), side * lateral)
        with np.errstate(divide="ignore", invalid="ignore"):  # they divide by the difference of the speeds
            is_safe = self._check(ego, them, now.speed, 0.0, hz, NOW)
            movement.control(ego, them, hz, self._check, self._react, NOW)
        if not is_safe:
            self._last_danger[number] = seen.time
        elif not ego.safe and seen.time - self._last_danger[number] >= CALM:
            del self._egos[number]
        return float(ego.speed_profile_long[NOW + 1])


def _place(theirs: Any, car: VehicleState, speeds: list[float], x: float, y: float, lateral: float) -> None:
    """Give one of their vehicles the size of a car, its speeds, its place [m], and its lateral velocity [m/s]."""
    # Their boxes have no heading, and the corner of one that stands askew reaches into the next lane.
    askew = abs(math.sin(car.heading))
    theirs.length, theirs.width = car.length, car.width * abs(math.cos(car.heading)) + car.length * askew
    theirs.speed_profile_long, theirs.pos_profile_long = np.array(speeds), np.full(3, x)
    theirs.speed_profile_lat, theirs.pos_profile_lat = np.full(3, lateral), np.full(3, y)


def make() -> SafetyModel:
    """Return a driver with the Fuzzy Safety Model, the Commission's own."""
    return SafetyModel("FSM")


def rss() -> SafetyModel:
    """Return a driver with their version of Responsibility-Sensitive Safety."""
    return SafetyModel("RSS")
