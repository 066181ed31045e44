"""Shared parts of all policies with a planted defect: how to list one, and the basis of a planner in SI units.

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
    """A policy with one defect, and its twin without it.

    Attributes:
        kind: The kind of policy.
        conditions: The number of things that must coincide before the defect shows, 1 to 3.
        make, twin: Return the ADS factory of the policy, and of the repaired one.
        about: What is wrong, and when.
    """

    kind: str
    conditions: int
    make: Callable[[], Any]
    twin: Callable[[], Any]
    about: str


def listed(kind: str, policies: Mapping[str, tuple[Any, int]]) -> dict[str, Planted]:
    """Return the policies of planner classes by name; each class takes ``repaired`` and has a number of conditions."""
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
    """A planner with one defect, unless it is ``repaired``."""

    def __init__(self, repaired=False):
        self.repaired = repaired
        super().__init__()


def braking_needed(v, c):
    """Return the deceleration that another vehicle in the way requires [m/s^2]; v is the own speed."""
    f, room = max(c.v, 0.0), max(c.gap - 2.0, 0.3)
    needed = (v - f) ** 2 / (2 * room) if v > f else 0.0
    if c.a < -1.0 or (room < 0.9 * v and v > f - 2.0):  # it brakes, or is so near that its hardest braking counts
        needed = max(needed, v * v / (2 * max(room + f * f / 15 - 0.4 * v, 0.5)))
    return needed
