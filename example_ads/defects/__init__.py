"""Positive controls: variants of highway-env's IDM+MOBIL driver with one defect each, and one with two defects.

Each policy is a vehicle class that drives itself. For example, ``make("follows-too-close")`` returns a class. Importing
this package does not import highway-env. Each class's docstring describes the defect and why it occurs in practice.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from types import MappingProxyType
from typing import Any

POLICIES: Mapping[str, str] = MappingProxyType(
    {
        "healthy": "driver:Driver",
        "follows-too-close": "following:FollowsTooClose",
        "brakes-late-above-20": "following:BrakesLateAboveTwenty",
        "brakes-weakly": "following:BrakesWeakly",
        "blind-beside-front-wheel": "perception:BlindBesideFrontWheel",
        "sees-old-speeds": "perception:SeesOldSpeeds",
        "sees-cut-ins-late": "perception:SeesCutInsLate",
        "ignores-standing-vehicles": "perception:IgnoresStandingVehicles",
        "forgets-after-lane-change": "perception:ForgetsAfterLaneChange",
        "looks-only-ahead": "lane_change:LooksOnlyAhead",
        "changes-lanes-unchecked": "lane_change:ChangesLanesUnchecked",
        "trusts-any-gap-behind": "lane_change:TrustsAnyGapBehind",
        "brakes-for-ghosts": "braking:BrakesForGhosts",
        "stops-in-its-lane": "braking:StopsInItsLane",
        "two-defects": "combined:IgnoresStandingAndLooksOnlyAhead",
    }
)
"""The module and class of each policy, by its name. The policy ``healthy`` has no defect."""

COMBINED: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {"two-defects": ("ignores-standing-vehicles", "looks-only-ahead")}
)
"""The policies with more than one defect, each with the names of its defects."""


def make(name: str) -> type[Any]:
    """Return the vehicle class of a policy. Pass the class to the world unchanged.

    Raises:
        KeyError: if the name is not in :data:`POLICIES`.
    """
    module, _, class_name = POLICIES[name].partition(":")
    policy: type[Any] = getattr(import_module(f".{module}", __name__), class_name)
    return policy
