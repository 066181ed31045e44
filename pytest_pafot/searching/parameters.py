"""Checks of the numbers that search algorithms are made with."""

from __future__ import annotations

import math
from typing import Any


def check_parameters(search: Any, *, rates: tuple[str, ...] = (), factors: tuple[str, ...] = (), **least: int) -> None:
    """Refuse numbers that are too small or too large.

    Args:
        search: with attributes of all names.
        rates: names of probabilities and shares.
        factors: names of factors, finite and at least 0.
        least: names of counts, and the smallest value of each.

    Raises:
        ValueError: naming the first that is wrong.
    """
    limits: dict[str, tuple[float, float, str]] = dict.fromkeys(rates, (0, 1, "a number from 0 to 1"))
    limits |= {name: (0, math.nextafter(math.inf, 0), "a finite number, at least 0") for name in factors}
    limits |= {name: (bound, math.inf, f"a count of at least {bound}") for name, bound in least.items()}
    for name, (low, high, expected) in limits.items():
        if not low <= getattr(search, name) <= high:
            raise ValueError(f"{name}: expected {expected}, received {getattr(search, name)!r}")
