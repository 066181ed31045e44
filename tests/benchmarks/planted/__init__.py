"""Twenty policies with one planted defect each, and their repaired twins: how soon does a search find a rare failure?

There are eight kinds of policies. A defect needs up to three rare conditions at once. No search may be tuned on these
policies: no search was, and what they measure would be worth nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import chain
from types import MappingProxyType

from tests.benchmarks.planted import (
    changing,
    keeping,
    learned,
    merging,
    predicting,
    sampling,
    tabled,
    vehicles,
)
from tests.benchmarks.planted.policy import Planted

__all__ = ["PLANTED", "Planted"]

KINDS = (keeping, changing, sampling, tabled, learned, vehicles, predicting, merging)
PLANTED: Mapping[str, Planted] = MappingProxyType(
    dict(chain.from_iterable(kind.PLANTED.items() for kind in KINDS))
)
"""The policies by name."""
