"""An intentionally flawed driver that keeps its initial speed and its lane, regardless of other vehicles.

It is a planner for ``pafot.Highway``, and the shortest possible ADS. It runs into any slower vehicle ahead, so with
nearly every seed, five generations find a collision for which it is at fault.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pytest_pafot import Observation


def make() -> Callable[[Observation], tuple[float, float]]:
    """Return a policy that neither accelerates [m/s^2] nor steers [rad]."""
    return lambda observation: (0.0, 0.0)
