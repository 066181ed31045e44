"""Forty policies with one planted defect each, and their repaired twins: how soon does a search find a rare failure?

There are eight kinds of policies with five defects each. Thirteen defects need one rare condition, fourteen need two at
once, thirteen three.
No search may be tuned on the policies of ``SET_ASIDE``.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import chain
from types import MappingProxyType

from tests.benchmarks.planted import changing, keeping, learned, merging, predicting, sampling, tabled, vehicles
from tests.benchmarks.planted.policy import Planted

__all__ = ["PLANTED", "SET_ASIDE", "TUNING", "Planted"]

KINDS = (keeping, changing, sampling, tabled, learned, vehicles, predicting, merging)
PLANTED: Mapping[str, Planted] = MappingProxyType(dict(chain.from_iterable(kind.PLANTED.items() for kind in KINDS)))
"""The policies by name."""


SET_ASIDE = (
    "clock-wraps", "flicker-held", "frozen-list", "gate-on-the-right", "gentle-when-slow", "hand-over-from-nothing",
    "lower-root", "none-feasible", "out-of-queue", "outlier-gate", "past-last-column", "pulls-away", "remembered-speed",
    "second-lane-unchecked", "short-look-ahead", "standers-unlabelled", "standing-is-clutter", "still-passed",
    "taken-for-shoulder", "way-back-of-given-up-change",
)  # fmt: skip
"""Policies for the evaluation of a finished search: a random half, as similar to the other half as possible."""
TUNING = tuple(sorted(set(PLANTED) - set(SET_ASIDE)))
"""Policies that may be used while a search is developed."""
