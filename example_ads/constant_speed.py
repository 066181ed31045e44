"""An intentionally flawed driver, which keeps its initial speed and its lane whatever happens, and looks at nothing.

Kind (a), for ``pafot.Highway``. It runs into any slower vehicle ahead, so five generations find it at fault with nearly
every seed. It is the shortest possible ADS.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pytest_pafot import Observation


def make() -> Callable[[Observation], tuple[float, float]]:
    """Return a policy that neither accelerates [m/s^2] nor steers [rad]."""
    return lambda observation: (0.0, 0.0)
