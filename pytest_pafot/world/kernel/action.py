"""What a planner returns, checked, and what of it a car can do."""

from __future__ import annotations

import math
from typing import Any

EGO_ACCELERATION = 6.0
"""Strongest acceleration that a planner's action has an effect up to [m/s^2]."""
EGO_BRAKING = 9.81
"""Strongest deceleration, likewise: full braking on a dry road [m/s^2]."""
EGO_STEERING = math.pi / 4
"""Largest steering angle, likewise [rad]."""


class BadAction(Exception):  # noqa: N818  (named in findings as the fault it is)
    """What an ADS returned is no action; the message says what was expected."""


def checked_si_action(action: Any) -> tuple[float, float]:
    """(acceleration, steering) as two floats.

    Raises:
        BadAction: unless it is a pair of finite numbers.
    """
    if type(action) is tuple and len(action) == 2 and type(action[0]) is float and type(action[1]) is float:
        pair = action
    else:
        pair = _floats(action)
    if not (math.isfinite(pair[0]) and math.isfinite(pair[1])):
        raise BadAction(_expected(action))
    return pair


def possible_acceleration(wanted: float) -> float:
    """A wanted acceleration, cut to what has an effect [m/s^2]."""
    return min(max(wanted, -EGO_BRAKING), EGO_ACCELERATION)


def possible_steering(wanted: float) -> float:
    """A wanted steering angle, likewise [rad]."""
    return min(max(wanted, -EGO_STEERING), EGO_STEERING)


def without_reversing(wanted: float, speed: float, dt: float) -> float:
    """An acceleration that brakes to a standstill and not into reverse [m/s^2]."""
    return max(wanted, -speed / dt) if wanted < 0.0 else wanted


def shown(value: Any) -> str:
    """A value in an error message, cut to a line."""
    return one_line(repr(value))


def one_line(text: str) -> str:
    """A text on one line, cut to what one can hold."""
    line = " ".join(text.split())
    return line if len(line) <= 120 else f"{line[:117]}..."


def _floats(action: Any) -> tuple[float, float]:
    if isinstance(action, (str, bytes, dict, set)):
        raise BadAction(_expected(action))
    try:
        acceleration, steering = action
        if isinstance(acceleration, (str, bytes)) or isinstance(steering, (str, bytes)):
            raise TypeError("text is no number")
        return float(acceleration), float(steering)
    except (TypeError, ValueError, OverflowError):
        raise BadAction(_expected(action)) from None


def _expected(action: Any) -> str:
    return f"expected (acceleration [m/s^2], steering [rad]), two finite numbers, received {shown(action)}"
