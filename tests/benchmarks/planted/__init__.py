"""Thirty policies with one planted defect each, and their repaired twins: how soon does a search find a rare failure?

Six kinds of policies have five defects each. Ten defects need one rare condition, ten need two at once, ten three.
Nothing may be tuned on the policies of ``SET_ASIDE``.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import chain
from types import MappingProxyType

from tests.benchmarks.planted import changing, keeping, learned, sampling, tabled, vehicles
from tests.benchmarks.planted.policy import Planted

__all__ = ["PLANTED", "SET_ASIDE", "TUNING", "Planted"]

KINDS = (keeping, changing, sampling, tabled, learned, vehicles)
PLANTED: Mapping[str, Planted] = MappingProxyType(dict(chain.from_iterable(kind.PLANTED.items() for kind in KINDS)))
"""Name to policy."""


SET_ASIDE = (
    "clock-wraps", "frozen-list", "gate-on-the-right", "gentle-when-slow", "hand-over-from-nothing", "none-feasible",
    "out-of-queue", "past-last-column", "pulls-away", "second-lane-unchecked", "short-look-ahead",
    "standers-unlabelled", "standing-is-clutter", "taken-for-shoulder", "way-back-of-given-up-change",
)  # fmt: skip
"""What is looked at once a search is finished; drawn, as alike the other half in kinds and conditions as can be."""
TUNING = tuple(sorted(set(PLANTED) - set(SET_ASIDE)))
"""What may be looked at while a search is made."""
