"""Checks of the arguments of worlds: numbers within bounds, plain data, frequencies.

Each check raises a :class:`WorldError` that names the field, the possible values and the received value.
"""

from __future__ import annotations

import math
from typing import Any

from pytest_pafot.support.errors import WorldError, checked_number, checked_whole

OTHER_KIND = 'a world of your own around a simulator of another kind (page "A simulator of your own")'
"""The way out for a user whose simulator is none of highway-env."""

PHYSICS_HZ, ADS_HZ = (5, 1000), (1, 1000)
"""The smallest and largest accepted number of physics ticks per second, and of decisions of an ADS per second."""

MOST_TICKS = 400_000
"""The largest accepted number of ticks in a run. With 8 NPCs, the record of a run takes about 0.5 KB per tick."""


def number_within(name: str, value: object, low: float, high: float, why: str = "") -> float:
    """Return ``value`` as a float if it is from ``low`` to ``high``; else raise an error with both and ``why``."""
    expected = f"a number from {low:g} to {high:g}{why}"
    return checked_number(value, name, expected, least=low, most=high, error=WorldError)


def whole_within(name: str, value: object, low: int, high: int) -> int:
    """Return ``value`` as an int if it is a whole number from ``low`` to ``high``; else raise an error."""
    expected = f"a whole number from {low} to {high}"
    return checked_whole(value, name, expected, least=low, most=high, error=WorldError)


def plain_data(name: str, value: Any) -> Any:
    """Copy plain data in the form that a corpus file can hold: tuples and numpy arrays become lists."""
    if isinstance(value, dict):
        for key in value:
            if not isinstance(key, str):
                raise WorldError(field=name, expected="text as keys", received=repr(key))
        return {key: plain_data(f"{name}.{key}", item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain_data(f"{name}[{index}]", item) for index, item in enumerate(value)]
    if type(value).__module__ == "numpy" and hasattr(value, "tolist"):
        return plain_data(name, value.tolist())
    if value is None or (isinstance(value, (bool, int, str)) or (isinstance(value, float) and not math.isnan(value))):
        return value
    expected = "plain data (numbers, text, lists, mappings), which a corpus file can hold"
    raise WorldError(field=name, expected=expected, received=repr(value))


def check_ticks(duration: float, physics_hz: int) -> None:
    """Refuse a duration [s] with more than :data:`MOST_TICKS` ticks, whose record would take too much memory."""
    if duration * physics_hz > MOST_TICKS:
        expected = f"at most {MOST_TICKS // physics_hz} s at {physics_hz} ticks a second"
        raise WorldError(field="duration", expected=expected, received=f"{duration:g}")


def check_divides(physics: tuple[str, int], ads: tuple[str, int]) -> None:
    """Refuse rates at which a decision does not last a whole number of ticks; arguments are pairs (name, rate)."""
    (physics_name, physics_hz), (ads_name, ads_hz) = physics, ads
    if physics_hz % ads_hz == 0:
        return
    divisors = ", ".join(str(n) for n in range(1, physics_hz + 1) if physics_hz % n == 0)
    expected = f"a divisor of {physics_name}={physics_hz}, so that every decision lasts a whole number of ticks"
    higher = math.ceil(physics_hz / ads_hz) * ads_hz
    fix = f"use one of {divisors}" + (f", or {physics_name}={higher}" if higher <= PHYSICS_HZ[1] else "")
    raise WorldError(field=ads_name, expected=expected, received=str(ads_hz), fix=fix)
