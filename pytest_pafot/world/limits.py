"""The physical limits of NPCs, and the default values of all worlds."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

from pytest_pafot.model.vehicle_type import CAR, VehicleType
from pytest_pafot.support.errors import WorldError, checked_number, checked_whole

# The highest speed of highway-env's vehicles [m/s].
TOP_SPEED = 40.0
# The proportion of the lateral acceleration that is available for following a bend. The rest is left for control.
BEND_SHARE = 0.8
# The defaults of worlds: the gap between the ego and the cells ahead of and behind it [m], the time gap at which NPCs
# start in these cells [s], and the wall-clock limit of a decision [s].
CLEARANCE, HEADWAY, HANG_LIMIT = 3.0, 2.0, 30.0
# Decisions of a planner per second, as in a Highway. If there are fewer ticks per second, each tick has a decision.
PLANNER_HZ = 5
# The environment option that lets highway-env's IDM also look for vehicles in connected lanes. Only egos of its class
# do so.
CONNECTED = "neighbour_vehicles_connected_lanes"
# The smallest and largest accepted value of each limit, and the reason that the error message gives. With other
# values, the computation of an NPC's controls is not reliable.
BOUNDS: Mapping[str, tuple[float, float, str]] = MappingProxyType(
    {
        "acceleration": (0.1, 100.0, ""),
        "braking": (0.1, 100.0, ""),
        "jerk": (0.1, 1000.0, ""),
        "lateral_acceleration": (0.1, 100.0, ""),
        "overspeed": (1.0, 8.0, ", so that NPCs can reach target speeds up to the speed limit"),
        "heading": (0.01, math.pi / 4, ", so that no NPC drives sideways"),
    }
)

# The limits that a vehicle type can have as well.
OF_VEHICLES = ("acceleration", "braking", "lateral_acceleration")


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
        for name, bounds in BOUNDS.items():
            object.__setattr__(
                self, name, number_within(f"limits.{name}", getattr(self, name), *bounds)
            )

    def for_vehicle(self, vehicle: VehicleType) -> NpcLimits:
        """Return the limits for NPCs of a vehicle type, which can be lower than these limits."""
        if vehicle is CAR:
            return self  # the result of the code below, but faster
        own = {
            name: getattr(vehicle, name)
            for name in OF_VEHICLES
            if getattr(vehicle, name) < getattr(self, name)
        }
        return replace(self, **own) if own else self

    def top_speed(self, speed_limit: float) -> float:
        """Return the highest speed [m/s] of NPCs on a road with a speed limit.

        Raises:
            WorldError: if highway-env's vehicles cannot drive that fast.
        """
        speed = self.overspeed * speed_limit
        if speed > TOP_SPEED:
            why = f"NPCs can drive {self.overspeed:g} times the limit, and highway-env's top speed is {TOP_SPEED:g} m/s"
            expected = (
                f"at most {math.floor(10 * TOP_SPEED / self.overspeed) / 10:.1f} m/s, because {why}"
            )
            raise WorldError(field="speed_limit", expected=expected, received=f"{speed_limit:g}")
        return speed


# The end of error messages for users whose simulator is not highway-env.
OTHER_KIND = 'a pafot.Simulator, and use it in a pafot.SimulatorWorld (see the page "A simulator of your own")'

# The smallest and largest accepted rates: physics ticks, and decisions per second.
PHYSICS_HZ, ADS_HZ = (5, 1000), (1, 1000)

# The largest accepted number of ticks in a run. With 8 NPCs, the record takes about 0.5 KB per tick.
MOST_TICKS = 400_000


def number_within(name: str, value: object, low: float, high: float, why: str = "") -> float:
    """Return ``value`` as a float, or raise an error with ``why`` if it is not a number from ``low`` to ``high``."""
    expected = f"a number from {low:g} to {high:g}{why}"
    return checked_number(value, name, expected, least=low, most=high, error=WorldError)


def whole_if_possible(rate: float) -> float:
    """Return a rate as an int if, apart from rounding errors, it is a whole number."""
    return round(rate) if abs(rate - round(rate)) < 1e-9 * rate else rate


def whole_within(name: str, value: object, low: int, high: int) -> int:
    """Return ``value`` as an int, or raise an error if it is not a whole number from ``low`` to ``high``."""
    expected = f"a whole number from {low} to {high}"
    return checked_whole(value, name, expected, least=low, most=high, error=WorldError)


def plain_data(name: str, value: Any) -> Any:
    """Copy data, with tuples and numpy arrays replaced by lists, so that a corpus file can contain it."""
    if isinstance(value, dict):
        for key in value:
            if not isinstance(key, str):
                raise WorldError(field=name, expected="strings as keys", received=repr(key))
        return {key: plain_data(f"{name}.{key}", item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain_data(f"{name}[{index}]", item) for index, item in enumerate(value)]
    if type(value).__module__ == "numpy" and hasattr(value, "tolist"):
        return plain_data(name, value.tolist())
    if value is None or (
        isinstance(value, (bool, int, str)) or (isinstance(value, float) and not math.isnan(value))
    ):
        return value
    fix = "use numbers, strings, lists and mappings, which a corpus file can contain"
    raise WorldError(field=name, expected="JSON-compatible data", received=repr(value), fix=fix)


def check_ticks(duration: float, physics_hz: float) -> None:
    """Reject a duration [s] with more than ``MOST_TICKS`` ticks, because the record would need too much memory."""
    if duration * physics_hz > MOST_TICKS:
        expected = f"at most {int(MOST_TICKS / physics_hz)} s at {physics_hz:.6g} ticks per second"
        raise WorldError(field="duration", expected=expected, received=f"{duration:g}")


def check_divides(physics: tuple[str, int], ads: tuple[str, int]) -> None:
    """Reject two rates, each given as a pair (name, rate), if a decision does not last a whole number of ticks."""
    (physics_name, physics_hz), (ads_name, ads_hz) = physics, ads
    if physics_hz % ads_hz == 0:
        return
    divisors = ", ".join(str(n) for n in range(1, physics_hz + 1) if physics_hz % n == 0)
    expected = f"a divisor of {physics_name} ({physics_hz}), so that every decision lasts a whole number of ticks"
    higher = math.ceil(physics_hz / ads_hz) * ads_hz
    fix = f"use one of {divisors}" + (
        f", or set {physics_name} to {higher}" if higher <= PHYSICS_HZ[1] else ""
    )
    raise WorldError(field=ads_name, expected=expected, received=str(ads_hz), fix=fix)
