"""Checks of the numbers that search algorithms are made with."""

from __future__ import annotations

import math
from typing import Any


def check_counts(search: Any, **least: int) -> None:
    """Refuse counts that are too small.

    Args:
        search: with attributes of these names.
        least: the smallest value of each.

    Raises:
        ValueError: naming the first that is smaller.
    """
    for name, bound in least.items():
        if getattr(search, name) < bound:
            raise ValueError(f"{name}: expected a count of at least {bound}, received {getattr(search, name)!r}")


def check_rates(search: Any, *names: str) -> None:
    """Refuse attributes of these names that are no probabilities and no shares.

    Raises:
        ValueError: naming the first that is not.
    """
    for name in names:
        if not 0 <= getattr(search, name) <= 1:
            raise ValueError(f"{name}: expected a number from 0 to 1, received {getattr(search, name)!r}")


def check_factor(search: Any, name: str) -> None:
    """Refuse a factor that is negative, infinite or no number.

    Raises:
        ValueError: naming it.
    """
    if not 0 <= getattr(search, name) < math.inf:
        raise ValueError(f"{name}: expected a finite number, at least 0, received {getattr(search, name)!r}")
