"""Search algorithms: they propose scenarios and learn from the evaluations."""

from __future__ import annotations

from pytest_pafot.searching.algorithms.catalogue import (
    ALGORITHMS,
    AlgorithmClass,
    RandomManoeuvreSearch,
    RandomSearch,
    resolve_algorithm,
)
from pytest_pafot.searching.algorithms.pafot import PafotSearch
from pytest_pafot.searching.evaluation import Evaluation, Health
from pytest_pafot.searching.operators import crossover, mutate, tournament
from pytest_pafot.searching.plan import Algorithm, GenerationalSearch, GenerationState, Plan, SearchState
from pytest_pafot.searching.space import SearchSpace, sample, sample_manoeuvres

__all__ = [
    "ALGORITHMS", "Algorithm", "AlgorithmClass", "Evaluation", "GenerationState",
    "GenerationalSearch", "Health", "PafotSearch", "Plan", "RandomManoeuvreSearch", "RandomSearch",
    "SearchSpace", "SearchState", "crossover", "mutate", "resolve_algorithm",
    "sample", "sample_manoeuvres", "tournament",
]  # fmt: skip
