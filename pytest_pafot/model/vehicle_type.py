"""Types of vehicles, and driving styles of NPCs."""
# In every style except the paper's, NPCs are *attentive*: behind the ego in its lane, an NPC keeps the same distance as
# behind other NPCs. It responds immediately if it moved in itself or if there is a vehicle ahead of the ego. If the ego
# moved in ahead of the NPC, or brakes with nothing ahead, the NPC responds a second later and with at most 6 m/s^2. An
# NPC enters the ego's lane only if the ego, or the NPC itself, has room to adapt its speed.

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Any, Literal

from pytest_pafot.support.errors import FieldError, plain_number
from pytest_pafot.support.text import Pasteable, listed

# The gap that an NPC adds to the smallest gap of its style when it drives to a position ahead of the ego [m].
AMPLE = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class DrivingStyle:
    """The limits that a style sets for NPCs.

    Attributes:
        described: description for reports.
        is_attentive: True if NPCs respond to the ego.
        least_speed_share: lowest speed of an NPC with nothing ahead, as a proportion of the speed limit or, if lower,
            of the ego's speed. It also limits target speeds in a search.
        least_gap: smallest gap [m], bumper to bumper, at which an NPC moves in ahead of the ego.
        time_gap: smallest time gap [s] at which an NPC moves in ahead of the ego, at the ego's speed.
        braking: hardest braking [m/s^2] of an NPC if nothing ahead requires more.
        lateral_speed: highest lateral speed [m/s] of an NPC.
    """

    described: str = ""
    is_attentive: bool = True
    least_speed_share: float = 0.0
    least_gap: float = 0.0
    time_gap: float = 0.0
    braking: float = 100.0
    lateral_speed: float = 100.0

    def least_speed(self, speed_limit: float) -> float:
        # Rounded up to a multiple of 0.1 m/s.
        return math.ceil(10 * self.least_speed_share * speed_limit - 1e-6) / 10


Style = Literal["paper", "hostile", "assertive", "everyday"]  # the name of a style

# The styles by name. docs/explanation/search.md has the sources of the values for everyday driving. The paper's NPCs
# run into the rear of an ego that is slower than their instruction. Hostile NPCs do anything to which the ego can still
# respond.
STYLES: Mapping[Style, DrivingStyle] = MappingProxyType(
    {
        "paper": DrivingStyle(is_attentive=False),
        "hostile": DrivingStyle(
            described="hostile traffic (NPCs may stop, brake hard and cut in close)"
        ),
        "assertive": DrivingStyle(
            described="assertive traffic (hard but ordinary driving)",
            least_speed_share=0.5,
            least_gap=6.0,
            time_gap=0.3,
            braking=3.5,
            lateral_speed=1.8,
        ),
        "everyday": DrivingStyle(
            described="everyday traffic (as most drivers drive)",
            least_speed_share=0.75,
            least_gap=11.0,
            time_gap=0.5,
            braking=2.0,
            lateral_speed=1.5,
        ),
    }
)

PAPERS: Style = "paper"  # the style of the paper's NPCs, which is the default of a scenario
HOSTILE: Style = "hostile"  # the default of a search


# The smallest and largest value of each number of a vehicle. NPCs keep their distance as if all of them braked at 5
# m/s^2, which is also the minimum that UN Regulation 13 requires.
BOUNDS: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "length": (1.0, 20.0),
        "width": (0.5, 3.0),
        "acceleration": (0.5, math.inf),
        "braking": (5.0, math.inf),
        "lateral_acceleration": (1.0, math.inf),
        "top_speed": (5.0, math.inf),
    }
)

# The curvature of the tightest curve that a car can follow [1/m]. The radius grows with the length of a vehicle.
TIGHTEST = 1 / 6.5

LONGEST_NAME = 40  # the largest number of characters of a vehicle's name


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class VehicleType(Pasteable):
    """A type of vehicle, with its size and its own limits.

    The names ``"car"``, ``"van"``, ``"truck"`` and ``"motorcycle"`` select built-in vehicles. If a limit is omitted or
    higher than the world's limit, the world's limit applies.

    Attributes:
        name: name of the vehicle, such as ``"truck"``.
        length, width: size [m] of the box, from 1 to 20 and from 0.5 to 3. The length is at least the width.
        acceleration: strongest acceleration [m/s^2], at least 0.5.
        braking: strongest deceleration, as a positive number [m/s^2], at least 5.
        lateral_acceleration: largest product of speed and turning rate [m/s^2], at least 1.
        top_speed: highest speed [m/s], at least 5, also at the start.
    """

    name: str
    length: float
    width: float
    acceleration: float = math.inf
    braking: float = math.inf
    lateral_acceleration: float = math.inf
    top_speed: float = math.inf

    def __post_init__(self) -> None:
        name = self.name
        is_text = isinstance(name, str) and name.isprintable() and name == name.strip()
        if not is_text or not 1 <= len(name) <= LONGEST_NAME:
            expected = (
                f"a name of 1 to {LONGEST_NAME} printable characters, without spaces at either end"
            )
            raise FieldError(field="name", expected=expected, received=f"{name!r:.100}")
        object.__setattr__(self, "name", str(name))
        for limit, (low, high) in BOUNDS.items():
            given = getattr(self, limit)
            number = plain_number(given)
            # infinity means no limit
            if isinstance(given, float) and given == high == math.inf:
                number = math.inf
            if number is None or not low <= number <= high:
                expected = f"a number from {low:g} to {high:g}"
                if high == math.inf:
                    expected = f"a number of at least {low:g}"
                raise FieldError(field=limit, expected=expected, received=f"{given!r:.100}")
            object.__setattr__(self, limit, number + 0.0)
        if self.length < self.width:
            expected = f"a length of at least the width, {self.width:g} m"
            raise FieldError(field="length", expected=expected, received=f"{self.length:g} m")
        if READY.get(self.name, self) != self:
            expected = f"a name other than {listed([*READY], 'or')}"
            fix = f"to use the built-in vehicle, write {self.name!r} instead of the VehicleType"
            raise FieldError(field="name", expected=expected, received=repr(self.name), fix=fix)

    def __reduce__(self) -> tuple[Any, ...]:
        # A built-in vehicle is one object in every process, so comparing it takes no time.
        return _unpickled, (self.plain(),)

    def __repr__(self) -> str:
        if self.name in READY:
            return repr(self.name)
        return Pasteable.__repr__(self)  # super() does not work in a dataclass with slots

    def plain(self) -> str | dict[str, Any]:
        # A built-in vehicle is stored as its name.
        if self.name in READY:
            return self.name
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        return {name: value for name, value in values.items() if value != math.inf}

    def can_follow(self, curvature: float) -> bool:
        # The curvature is in 1/m.
        return self.length <= CAR.length or curvature <= TIGHTEST * CAR.length / self.length

    @property
    def has_limits(self) -> bool:
        limits = self.acceleration, self.braking, self.lateral_acceleration, self.top_speed
        return min(limits) < math.inf

    def limited(self, acceleration: float, steering: float, speed: float) -> tuple[float, float]:
        # The acceleration [m/s^2] and steering [rad] of an ego with these limits.
        # Near the top speed, the ego accelerates less, as highway-env's own vehicles do.
        acceleration = min(acceleration, self.acceleration, self.top_speed - speed)
        acceleration = max(acceleration, -self.braking)
        slip = self.lateral_acceleration * self.length / 2 / max(speed * speed, 1e-9)
        if slip < 1.0:
            most = math.atan(2 * math.tan(math.asin(slip)))
            steering = min(max(steering, -most), most)
        return acceleration, steering

    @property
    def described(self) -> str:
        return f"{self.name}, {self.length:g} x {self.width:g} m"

    @property
    def kind(self) -> str:
        # For formats with classes of vehicles: a `recorded truck` is a truck.
        return self.name.rpartition(" ")[2]

    @classmethod
    def parse(cls, given: Any) -> VehicleType:
        """Return the vehicle for a name, or for a dict from :meth:`plain`."""
        if isinstance(given, VehicleType):
            return given
        if isinstance(given, str) and given in READY:
            return READY[given]
        names = {each.name for each in fields(cls)}
        if isinstance(given, Mapping) and {"name", "length", "width"} <= set(given) <= names:
            return cls(**given)
        expected = f"{', '.join(READY)} or pafot.VehicleType(name=..., length=..., width=...)"
        raise FieldError(field="vehicle", expected=expected, received=f"{given!r:.100}")


VehicleName = Literal["car", "van", "truck", "motorcycle"]  # the name of a built-in vehicle

READY: Mapping[str, VehicleType] = MappingProxyType({})  # the built-in vehicles by name, see below

# Sources of the numbers:
# - SUMO, "Vehicle Type Parameter Defaults", https://sumo.dlr.de/docs/Vehicle_Type_Parameter_Defaults.html: sizes of the
#   classes `delivery` and `motorcycle`; `accel` and `emergencyDecel` of all classes.
# - Directive 96/53/EC, Annex I: the largest length and width of a motor vehicle without a trailer, 12.00 m and 2.55 m.
# - Directive 92/6/EEC: a speed limitation device keeps a heavy goods vehicle to 90 km/h.
# - New Zealand's rule on vehicle dimensions and mass: a static rollover threshold of at least 0.35 g. A loaded truck
#   tips over above it.
# - UN Regulation 13: the brakes of a heavy vehicle decelerate it by at least 5 m/s^2.

# A car of highway-env's size, with the limits that the world sets for all NPCs.
CAR = VehicleType(name="car", length=5.0, width=2.0)

# A delivery van of SUMO's size. It accelerates and brakes as a car does, as in SUMO.
VAN = VehicleType(name="van", length=6.5, width=2.16)

# A loaded truck of the largest size without a trailer, with SUMO's acceleration and emergency braking of a truck, a
# lateral acceleration up to the threshold of rolling over, and a speed limitation device.
TRUCK = VehicleType(
    name="truck",
    length=12.0,
    width=2.55,
    acceleration=1.3,
    braking=7.0,
    lateral_acceleration=3.4,
    top_speed=25.0,
)

# A motorcycle with SUMO's size, acceleration and braking. The limits of most worlds are lower and apply instead.
MOTORCYCLE = VehicleType(name="motorcycle", length=2.2, width=0.9, acceleration=6.0, braking=10.0)

READY = MappingProxyType({each.name: each for each in (CAR, VAN, TRUCK, MOTORCYCLE)})


def _unpickled(plain: Any) -> VehicleType:
    # Not the class method itself: cloudpickle would send its code, and call it before the names in it are defined.
    return VehicleType.parse(plain)


def without_last_cars(vehicles: Sequence[VehicleType]) -> tuple[VehicleType, ...]:
    """Return the vehicles without the cars at the end of the sequence."""
    # Equal scenarios must have equal vehicles.
    count = len(vehicles)
    while count and vehicles[count - 1] == CAR:
        count -= 1
    return tuple(vehicles[:count])


def named_vehicles(given: Any) -> tuple[VehicleType, ...]:
    """Return the vehicle types for one or several vehicles or names, without duplicates."""
    if isinstance(given, str) or not isinstance(given, Sequence):
        given = [given]
    found = tuple(dict.fromkeys(map(VehicleType.parse, given)))
    if not found:
        raise FieldError(
            field="vehicles",
            expected=f"one or more of {', '.join(READY)}",
            received=repr(given),
        )
    return found
