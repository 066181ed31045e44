"""The physical limits of NPCs, and the default values of all worlds."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

from pytest_pafot.model.vehicle_type import CAR, VehicleType
from pytest_pafot.support.errors import WorldError, checked_number, checked_whole

# The defaults of worlds: the gap between the ego and the cells ahead of and behind it [m], the time gap at which NPCs
# start in these cells [s], and the wall-clock limit of a decision [s].
CLEARANCE = 3.0
HEADWAY = 2.0
HANG_LIMIT = 30.0
# Decisions of a planner per second, as in a Highway. If there are fewer ticks per second, each tick has a decision.
PLANNER_HZ = 5
# The highest speed of highway-env's vehicles [m/s].
TOP_SPEED = 40.0

# The proportion of the lateral acceleration that is available for following a bend. The rest is left for control.
BEND_SHARE = 0.8

# The smallest and largest accepted value of each limit of NPCs, and the reason that the error message gives. With other
# values, the computation of an NPC's controls is not reliable.
NPC_BOUNDS: Mapping[str, tuple[float, float, str]] = MappingProxyType(
    {
        "acceleration": (0.1, 100.0, ""),
        "braking": (0.1, 100.0, ""),
        "jerk": (0.1, 1000.0, ""),
        "lateral_acceleration": (0.1, 100.0, ""),
        "overspeed": (1.0, 8.0, ", so that NPCs can reach target speeds up to the speed limit"),
        "heading": (0.01, math.pi / 4, ", so that no NPC drives sideways"),
    }
)


def number_within(
    name: str,
    value: object,
    low: float,
    high: float,
    why: str = "",
) -> float:
    """Return ``value`` as a float, or raise an error with ``why`` if it is not a number from ``low`` to ``high``."""
    expected = f"a number from {low:g} to {high:g}{why}"
    return checked_number(value, name, expected, least=low, most=high, error=WorldError)


def whole_within(name: str, value: object, low: int, high: int) -> int:
    """Return ``value`` as an int, or raise an error if it is not a whole number from ``low`` to ``high``."""
    expected = f"a whole number from {low} to {high}"
    return checked_whole(value, name, expected, least=low, most=high, error=WorldError)


@dataclass(frozen=True, slots=True, kw_only=True)
class NpcLimits:
    """Physical limits that every NPC obeys at every tick.

    A vehicle type can have lower limits.

    Attributes:
        acceleration: largest acceleration [m/s^2].
        braking: largest deceleration [m/s^2], as a positive number.
        jerk: largest change in acceleration per second [m/s^3]. An NPC that comes to a stop can exceed this limit.
        lateral_acceleration: largest product [m/s^2] of the speed and the turning rate, either of the heading or of the
            direction of motion.
        overspeed: top speed as a multiple of the speed limit.
        heading: largest angle [rad] between an NPC and its lane.
    """

    acceleration: float = 5.0
    braking: float = 8.0
    jerk: float = 10.0
    lateral_acceleration: float = 4.0
    overspeed: float = 1.1
    heading: float = 0.5

    def __post_init__(self) -> None:
        for name, (low, high, why) in NPC_BOUNDS.items():
            number = number_within(f"limits.{name}", getattr(self, name), low, high, why)
            object.__setattr__(self, name, number)

    def for_vehicle(self, vehicle: VehicleType) -> NpcLimits:
        """Return the limits for NPCs of a vehicle type, which can be lower than these limits."""
        if vehicle is CAR:
            return self  # the result of the code below, but faster
        lower = {}
        for name in ("acceleration", "braking", "lateral_acceleration"):
            own = getattr(vehicle, name)
            if own < getattr(self, name):
                lower[name] = own
        if not lower:
            return self
        return replace(self, **lower)

    def top_speed(self, speed_limit: float) -> float:
        """Return the highest speed [m/s] of NPCs on a road with a speed limit.

        Raises:
            WorldError: if highway-env's vehicles cannot drive that fast.
        """
        speed = self.overspeed * speed_limit
        if speed > TOP_SPEED:
            most = math.floor(10 * TOP_SPEED / self.overspeed) / 10
            why = f"NPCs can drive {self.overspeed:g} times the limit, and highway-env's top speed is {TOP_SPEED:g} m/s"
            expected = f"at most {most:.1f} m/s, because {why}"
            raise WorldError(field="speed_limit", expected=expected, received=f"{speed_limit:g}")
        return speed
