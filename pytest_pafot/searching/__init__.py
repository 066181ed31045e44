"""The search as a plan: an algorithm proposes scenarios, and learns from their evaluations.

This package does not simulate: whoever follows a :class:`~pytest_pafot.searching.plan.Plan` does.
"""

from __future__ import annotations

from pytest_pafot.searching.algorithms.catalogue import ALGORITHMS, AlgorithmClass, resolve_algorithm
from pytest_pafot.searching.algorithms.pafot import PafotSearch
from pytest_pafot.searching.algorithms.random_search import RandomManoeuvreSearch, RandomSearch
from pytest_pafot.searching.ask_tell import Algorithm, GenerationalSearch, GenerationState, SearchState
from pytest_pafot.searching.evaluation import Evaluation
from pytest_pafot.searching.health import Health
from pytest_pafot.searching.operators import crossover, mutate, tournament
from pytest_pafot.searching.plan import Plan
from pytest_pafot.searching.space import SearchSpace, sample, sample_manoeuvres

__all__ = [
    "ALGORITHMS", "Algorithm", "AlgorithmClass", "Evaluation", "GenerationState",
    "GenerationalSearch", "Health", "PafotSearch", "Plan", "RandomManoeuvreSearch", "RandomSearch",
    "SearchSpace", "SearchState", "crossover", "mutate", "resolve_algorithm",
    "sample", "sample_manoeuvres", "tournament",
]  # fmt: skip
