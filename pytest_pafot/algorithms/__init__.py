"""Search algorithms, which propose scenarios and learn from their evaluations."""

from __future__ import annotations

from pytest_pafot.algorithms.catalogue import (
    ALGORITHMS,
    AlgorithmClass,
    RandomManoeuvreSearch,
    RandomSearch,
    resolve_algorithm,
)
from pytest_pafot.algorithms.evaluation import Evaluation, Health
from pytest_pafot.algorithms.operators import crossover, mutate, tournament
from pytest_pafot.algorithms.pafot import PafotSearch
from pytest_pafot.algorithms.plan import (
    Algorithm,
    GenerationalSearch,
    GenerationState,
    Plan,
    SearchState,
)
from pytest_pafot.algorithms.space import SearchSpace, sample, sample_manoeuvres

__all__ = [
    "ALGORITHMS", "Algorithm", "AlgorithmClass", "Evaluation", "GenerationState",
    "GenerationalSearch", "Health", "PafotSearch", "Plan", "RandomManoeuvreSearch", "RandomSearch",
    "SearchSpace", "SearchState", "crossover", "mutate", "resolve_algorithm",
    "sample", "sample_manoeuvres", "tournament",
]  # fmt: skip
