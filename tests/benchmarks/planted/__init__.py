"""Thirty policies with one planted defect each, and their repaired twins: how soon does a search find a rare failure?

Six kinds of policies have five defects each. Ten defects need one rare condition, ten need two at once, ten three.
Nothing may be tuned on the policies of ``SET_ASIDE``.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Mapping
from itertools import chain
from types import MappingProxyType

from tests.benchmarks.planted import changing, keeping, learned, sampling, tabled, vehicles
from tests.benchmarks.planted.policy import Planted

__all__ = ["PLANTED", "SET_ASIDE", "TUNING", "Planted"]

KINDS = (keeping, changing, sampling, tabled, learned, vehicles)
PLANTED: Mapping[str, Planted] = MappingProxyType(dict(chain.from_iterable(kind.PLANTED.items() for kind in KINDS)))
"""Name to policy."""


def halves() -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Draw two halves that are as alike in kinds and numbers of conditions as they can be."""
    drawn = random.Random(29).sample(sorted(PLANTED), len(PLANTED))
    strata = {name: (PLANTED[name].conditions, PLANTED[name].kind) for name in PLANTED}
    sizes = Counter(strata.values())
    # Each kind has two pairs with one number of conditions, and a policy without such a partner. Neighbours in this
    # order are such a pair, or two without partners and with one number of conditions: each half gets one of them.
    order = sorted(drawn, key=lambda name: (PLANTED[name].conditions, sizes[strata[name]], PLANTED[name].kind))
    first = {min(pair, key=drawn.index) for pair in zip(order[::2], order[1::2], strict=True)}
    return tuple(sorted(first)), tuple(sorted(set(PLANTED) - first))


TUNING, SET_ASIDE = halves()
"""What may be looked at while a search is made, and what may not."""
