"""Thirty policies with one planted defect each, and their repaired twins: how soon does a search find a rare failure?

Six kinds of policies have five defects each. Ten defects need one rare condition, ten need two at once, ten three.
Nothing may be tuned on the policies of ``SET_ASIDE``.
"""

from __future__ import annotations

import random
from collections.abc import Mapping
from types import MappingProxyType

from tests.benchmarks.planted import changing, keeping, learned, sampling, tabled
from tests.benchmarks.planted.policy import Planted

__all__ = ["PLANTED", "SET_ASIDE", "TUNING", "Planted"]

PLANTED: Mapping[str, Planted] = MappingProxyType(
    {**keeping.PLANTED, **changing.PLANTED, **sampling.PLANTED, **tabled.PLANTED, **learned.PLANTED}
)
"""Name to policy."""


def halves() -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Draw two halves that are as alike in kinds and numbers of conditions as they can be."""
    drawn = random.Random(29).sample(sorted(PLANTED), len(PLANTED))
    # Of neighbours in the order of conditions and kinds each half has one; who is drawn first goes to the first half.
    order = sorted(drawn, key=lambda name: (PLANTED[name].conditions, PLANTED[name].kind))
    first = {min(pair, key=drawn.index) for pair in zip(order[::2], order[1::2], strict=False)}
    return tuple(sorted(first)), tuple(sorted(set(PLANTED) - first))


TUNING, SET_ASIDE = halves()
"""What may be looked at while a search is made, and what may not."""
