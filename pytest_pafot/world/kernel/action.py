"""Checks for the actions of planners, and functions that convert them to controls within a car's limits."""

from __future__ import annotations

import inspect
import math
import numbers
import operator
from dataclasses import dataclass
from typing import Any

from pytest_pafot.support.errors import BadAction, plain_number
from pytest_pafot.support.text import safe_repr
from pytest_pafot.world.kernel.driver import clamp

EGO_ACCELERATION = 6.0
"""The maximum acceleration [m/s^2] of an ego, to which planners' actions are limited."""
EGO_BRAKING = 9.81
"""The maximum deceleration [m/s^2] of an ego, equal to full braking on a dry road."""
EGO_STEERING = math.pi / 4
"""The maximum steering angle [rad] of an ego."""

# acceleration per unit of speed error, as in highway-env's ControlledVehicle [1/s]
KP_SPEED = 1.0 / 0.6
# largest angle to the lane at which highway-env's vehicles approach its centre [rad]
STEEPEST = math.pi / 4

LATERAL_ACCELERATION = 2.5
LATERAL_JERK = 3.0
"""The default limits on lateral acceleration [m/s^2] and lateral jerk [m/s^3] in a :class:`LaneCommand`.

UN R79, 5.6.2.1.3, allows 3 and 5. The defaults are lower because braking or speeding up in a turn increases both
values.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class LaneCommand:
    """An action with a target lane and either a speed or an acceleration, instead of acceleration and steering.

    Until the next decision, the ego steers towards the centre of the lane within the lateral limits. It also
    accelerates or brakes to reach the target speed, or keeps the acceleration constant.

    Attributes:
        lane: target lane, counted from 0 at the left.
        speed: target speed [m/s], at least 0. None if ``acceleration`` is given.
        acceleration: acceleration [m/s^2]. None if ``speed`` is given.
        lateral_acceleration: limit [m/s^2] on the lateral acceleration, from 0.1 to 100.
        lateral_jerk: limit [m/s^3] on the lateral jerk, from 0.1 to 1000.
    """

    lane: int
    speed: float | None = None
    acceleration: float | None = None
    lateral_acceleration: float = LATERAL_ACCELERATION
    lateral_jerk: float = LATERAL_JERK


def checked_si_action(action: Any, lanes: int) -> tuple[float, float] | LaneCommand:
    """Check an action, and return it as a pair of floats or as a :class:`LaneCommand` with Python numbers.

    Raises:
        BadAction: if the action is neither two finite numbers nor a valid command for a road with ``lanes`` lanes.
    """
    if (
        type(action) is tuple
        and len(action) == 2
        and type(action[0]) is float
        and type(action[1]) is float
    ):
        pair = action
    elif isinstance(action, LaneCommand):
        return _checked_lane_command(action, lanes)
    else:
        pair = _floats(action)
    if not (math.isfinite(pair[0]) and math.isfinite(pair[1])):
        raise BadAction(_expected(action))
    return pair


def possible_acceleration(wanted: float) -> float:
    """Limit an acceleration [m/s^2] to the range that an ego can reach."""
    return min(max(wanted, -EGO_BRAKING), EGO_ACCELERATION)


def possible_steering(wanted: float) -> float:
    """Limit a steering angle [rad] to the range that an ego can reach."""
    return min(max(wanted, -EGO_STEERING), EGO_STEERING)


def acceleration_to_speed(wanted: float, speed: float) -> float:
    """Return an ego's acceleration [m/s^2] towards a target speed."""
    return possible_acceleration(KP_SPEED * (wanted - speed))


def lane_steering(
    offset: float,
    ahead: float,
    heading: float,
    speed: float,
    length: float,
    kp_heading: float,
    kp_lateral: float,
) -> float:
    """Return the steering angle [rad] towards the centre of a lane, without a limit.

    Args:
        offset: offset [m] from the lane's centre, positive to the right.
        ahead: direction [rad] of the lane slightly ahead of the vehicle.
        heading, speed, length: heading [rad], speed [m/s] and length [m] of the vehicle.
        kp_heading, kp_lateral: gains [1/s] of the heading control and the lateral control.
    """
    divisor = not_zero(speed)
    sideways = math.asin(clamp(-kp_lateral * offset / divisor, 1.0))
    turn = (ahead + clamp(sideways, STEEPEST) - heading + math.pi) % (2.0 * math.pi) - math.pi
    slip = math.asin(clamp(length / 2.0 / divisor * (kp_heading * turn), 1.0))
    return math.atan(2.0 * math.tan(slip))


def not_zero(value: float) -> float:
    """Replace a number close to zero with 0.01 or -0.01, so that it can be a divisor."""
    if abs(value) > 1e-2:
        return value
    if value >= 0.0:
        return 1e-2
    return -1e-2


def without_reversing(wanted: float, speed: float, dt: float) -> float:
    """Limit an acceleration [m/s^2] so that the vehicle stops instead of reversing."""
    if wanted < 0.0:
        return max(wanted, -speed / dt)
    return wanted


def _floats(action: Any) -> tuple[float, float]:
    if isinstance(action, (str, bytes, dict, set)):
        raise BadAction(_expected(action))
    try:
        acceleration, steering = action
        if isinstance(acceleration, (str, bytes)) or isinstance(steering, (str, bytes)):
            raise TypeError("a string is not a number")
        return float(acceleration), float(steering)
    except (TypeError, ValueError, OverflowError):
        raise BadAction(_expected(action)) from None


def _checked_lane_command(command: LaneCommand, lanes: int) -> LaneCommand:
    given = [value for value in (command.speed, command.acceleration) if value is not None]
    if len(given) != 1:
        raise _bad_lane_command("either a speed [m/s] or an acceleration [m/s^2]", command)
    most = command.lateral_acceleration
    jerk = command.lateral_jerk
    is_plain = (
        type(command.lane) is int
        and type(given[0]) is float
        and type(most) is float
        and type(jerk) is float
    )
    lane = command.lane
    value = given[0]
    if not is_plain:  # these conversions take longer than the rest of a tick
        lane, value = _lane_and_value(command, given[0])
        most = _finite(most)
        jerk = _finite(jerk)
    if not 0 <= lane < lanes:
        raise _bad_lane_command(f"a lane from 0, at the left, to {lanes - 1}", command)
    if not math.isfinite(value):
        raise _bad_lane_command("finite numbers", command)
    if command.speed is not None and value < 0.0:
        raise _bad_lane_command("a speed of at least 0 m/s", command)
    if not 0.1 <= most <= 100.0:
        raise _bad_lane_command(
            "lateral_acceleration= from 0.1 to 100 m/s^2, or without it", command
        )
    if not 0.1 <= jerk <= 1000.0:
        raise _bad_lane_command("lateral_jerk= from 0.1 to 1000 m/s^3, or without it", command)
    if is_plain and type(command) is LaneCommand:
        return command
    if command.speed is None:
        return LaneCommand(
            lane=lane,
            acceleration=value,
            lateral_acceleration=most,
            lateral_jerk=jerk,
        )
    return LaneCommand(lane=lane, speed=value, lateral_acceleration=most, lateral_jerk=jerk)


def _lane_and_value(command: LaneCommand, given: Any) -> tuple[int, float]:
    try:
        if isinstance(command.lane, bool) or isinstance(given, (str, bytes)):
            raise TypeError("booleans and strings are not numbers")
        # 2.0 also counts as whole, because JSON may contain it
        is_whole = isinstance(command.lane, numbers.Real) and command.lane == int(command.lane)
        return operator.index(int(command.lane) if is_whole else command.lane), float(given)
    except (TypeError, ValueError, OverflowError):
        raise _bad_lane_command("numbers, with a whole number for the lane", command) from None


def _finite(value: Any) -> float:
    number = plain_number(value)
    if number is None:
        return -1.0
    return float(number)


def _bad_lane_command(expected: str, command: LaneCommand) -> BadAction:
    return BadAction(f"expected pafot.LaneCommand with {expected}, received {safe_repr(command)}")


def _expected(action: Any) -> str:
    hint = hint_at(action)
    if not hint and getattr(action, "ndim", 0) == 0 and hasattr(action, "__int__"):
        hint = 'policies of a highway-env environment need world=pafot.World("highway-v0")'
    if not hint and isinstance(action, dict):
        hint = "return the two values as a tuple"
    expected = "expected (acceleration [m/s^2], steering [rad]), two finite numbers, or a pafot.LaneCommand"
    received = f"{expected}, received {safe_repr(action)}"
    if hint:
        return f"{received}; {hint}"
    return received


def hint_at(action: Any) -> str:
    """Return a hint about the likely cause of an invalid action, or an empty string."""
    if action is None:
        return "is a `return` missing?"
    if (
        type(action) is tuple
        and len(action) == 2
        and (action[1] is None or isinstance(action[1], tuple))
    ):
        return (
            "(action, state) is what `model.predict` returns: use "
            "`model.predict(observation, deterministic=True)[0]`"
        )
    if isinstance(action, LaneCommand):
        return "pafot.LaneCommand is for planners in SI units: leave world= out, or give pafot.World(..., planner_hz=5)"
    if inspect.iscoroutine(action) or inspect.isgenerator(action):
        if inspect.iscoroutine(action):
            action.close()  # otherwise Python would also warn that it was never awaited
        return "an ADS is an ordinary function, without `async` and `yield`"
    shape = getattr(action, "shape", ())
    if isinstance(shape, tuple) and len(shape) > 1 and shape[0] == 1:
        return (
            f"its shape {tuple(shape)} is for several environments; use its first row, `action[0]`"
        )
    return ""
