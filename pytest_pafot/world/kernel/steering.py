"""The lateral and the longitudinal controller of highway-env's ``ControlledVehicle``, operation by operation."""

from __future__ import annotations

import math

from pytest_pafot.world.kernel.action import possible_acceleration, possible_steering
from pytest_pafot.world.kernel.driver import clamped

KP_HEADING = 1.0 / 0.2
"""Turning rate per heading error [1/s]; highway-env's, like the two others."""
KP_LATERAL = 1.0 / 0.6
"""Lateral speed per distance to the lane's centre [1/s]."""
KP_SPEED = 1.0 / 0.6
"""Acceleration per speed error [1/s]."""
STEEPEST = math.pi / 4
"""Largest heading to the lane that is steered for [rad]."""


def steering_to_lane(offset: float, heading: float, speed: float, length: float) -> float:
    """The angle that steers to the centre of a lane [rad], with arguments as of :func:`lane_steering`."""
    return possible_steering(lane_steering(offset, heading, speed, length, KP_HEADING, KP_LATERAL))


def acceleration_to_speed(wanted: float, speed: float) -> float:
    """The acceleration that drives to a speed [m/s^2]."""
    return possible_acceleration(KP_SPEED * (wanted - speed))


def lane_steering(
    offset: float, heading: float, speed: float, length: float, kp_heading: float, kp_lateral: float
) -> float:
    """The angle that steers to the centre of a lane [rad], which may be more than wheels can turn.

    Args:
        offset: from the lane's centre, positive to the right [m].
        heading: to the lane [rad].
        speed: [m/s].
        length: of the vehicle [m].
        kp_heading, kp_lateral: gains [1/s].
    """
    divisor = not_zero(speed)
    sideways = math.asin(clamped(-kp_lateral * offset / divisor, 1.0))
    turn = (clamped(sideways, STEEPEST) - heading + math.pi) % (2.0 * math.pi) - math.pi
    slip = math.asin(clamped(length / 2.0 / divisor * (kp_heading * turn), 1.0))
    return math.atan(2.0 * math.tan(slip))


def not_zero(value: float) -> float:
    """A number that is at least a hundredth away from zero, to divide by."""
    if abs(value) > 1e-2:
        return value
    return 1e-2 if value >= 0.0 else -1e-2
