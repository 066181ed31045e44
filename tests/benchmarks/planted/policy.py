"""What all policies with a planted defect share: how one is listed, and what a planner in SI units is made of.

Units are metres, seconds and radians throughout.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from tests.benchmarks.policies_with_defects_2 import WIDE, Planner, clip

__all__ = ["WIDE", "Driver", "Planted", "braking_needed", "clip", "listed"]


@dataclass(frozen=True)
class Planted:
    """A policy with one defect, and the same without it.

    Attributes:
        kind: what sort of policy it is.
        conditions: how many things must come together before the defect shows, 1 to 3.
        make, twin: give the ADS factory of the policy, and of the one that has been repaired.
        about: what is wrong, and when.
    """

    kind: str
    conditions: int
    make: Callable[[], Any]
    twin: Callable[[], Any]
    about: str


def listed(kind: str, policies: Mapping[str, tuple[Any, int]]) -> dict[str, Planted]:
    """List classes of planners, which take ``repaired``, by their names and numbers of conditions."""
    return {
        name: Planted(
            kind, conditions, partial(partial, planner), partial(partial, planner, repaired=True), about_of(planner)
        )
        for name, (planner, conditions) in policies.items()
    }


def about_of(policy: Any) -> str:
    """Return the first sentence of a class's docstring in one line."""
    return " ".join(policy.__doc__.split("\n\n")[0].split())


class Driver(Planner):
    """A planner whose one defect is in place unless it is ``repaired``."""

    def __init__(self, repaired=False):
        self.repaired = repaired
        super().__init__()


def braking_needed(v, c):
    """Return the deceleration [m/s^2] that another vehicle in the way calls for, at an own speed of v."""
    f, room = max(c.v, 0.0), max(c.gap - 2.0, 0.3)
    needed = (v - f) ** 2 / (2 * room) if v > f else 0.0
    if c.a < -1.0 or (room < 0.9 * v and v > f - 2.0):  # it brakes, or is so near that its hardest braking counts
        needed = max(needed, v * v / (2 * max(room + f * f / 15 - 0.4 * v, 0.5)))
    return needed
