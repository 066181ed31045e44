"""What an NPC's driver may do: the limits that make NPCs vehicles and not missiles."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from pytest_pafot.world.errors import WorldError


@dataclass(frozen=True, slots=True, kw_only=True)
class NpcLimits:
    """Hard limits of every NPC; they hold at every tick of every trace.

    Attributes:
        acceleration: strongest acceleration [m/s^2].
        braking: strongest deceleration, as a positive number [m/s^2].
        jerk: largest change of acceleration per second [m/s^3]; exceeded only in the tick of standstill.
        lateral_acceleration: speed times the turning rate of the course, and of the heading [m/s^2].
        overspeed: top speed as a multiple of the speed limit.
        heading: largest angle to the lane [rad]; an NPC never drives sideways.
    """

    acceleration: float = 5.0
    braking: float = 8.0
    jerk: float = 10.0
    lateral_acceleration: float = 4.0
    overspeed: float = 1.1
    heading: float = 0.5

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < math.inf:
                raise WorldError(f"limits.{field.name}: expected a number above 0, received {value!r}")
            object.__setattr__(self, field.name, float(value))
        if self.heading > math.pi / 4:
            raise WorldError(
                f"limits.heading: expected at most pi/4 rad, so that no NPC drives sideways, received {self.heading!r}"
            )
        if self.overspeed < 1:
            raise WorldError(
                f"limits.overspeed: expected at least 1, so that target speeds up to the limit can be driven, "
                f"received {self.overspeed!r}"
            )
