"""Actions that look as if they were in other units, or in another order, than those of a planner."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from pytest_pafot.world.kernel.action import possible_acceleration, possible_steering

if TYPE_CHECKING:
    from pytest_pafot.trace import Trace

NO_STEERING = math.pi / 2
"""No car steers so far, and no planner asks for it [rad]."""
NO_ACCELERATION = 30.0
"""Likewise [m/s^2]. Full braking is often asked for by a large number, full throttle is not."""


def doubt(trace: Trace) -> str:
    """What to check in a planner whose actions cannot be meant as they are; empty for others, and for policies."""
    pairs = [action for action in trace.actions if type(action) is tuple and len(action) == 2]
    steering = max((abs(pair[1]) for pair in pairs), default=0.0)
    if steering > NO_STEERING:
        return (
            f"the ADS asked for a steering angle of {steering:.3g}, in rad, of which {possible_steering(steering):.2f} "
            "have an effect: convert degrees with math.radians(...); an action is (acceleration, steering), in this "
            "order"
        )
    acceleration = max((pair[0] for pair in pairs), default=0.0)
    if acceleration > NO_ACCELERATION:
        return (
            f"the ADS asked for an acceleration of {acceleration:.3g}, in m/s^2, of which "
            f"{possible_acceleration(acceleration):g} have an effect: an action is (acceleration, steering), and holds "
            "no speed"
        )
    return ""
