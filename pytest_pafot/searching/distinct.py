"""The default search: PAFOT that turns to the next kind of failure once it has found one.

The paper's search counts collisions. What a user wants is each distinct failure once, and there the paper's search
stands in its own way: whatever fails outranks all that does not, so the first defect that is found absorbs the
population, and every further generation breeds it again. docs/explanation.md has the comparison.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from pytest_pafot.scenario import Scenario
from pytest_pafot.searching.evaluation import Evaluation
from pytest_pafot.searching.events import AlgorithmEvent, Restarted
from pytest_pafot.searching.genetic import PafotSearch, PafotState
from pytest_pafot.searching.space import SearchSpace


@dataclass(frozen=True, slots=True, kw_only=True)
class DistinctState:
    """Where a search is, between two calls.

    Attributes:
        pafot: the state of the genetic algorithm.
        kinds: of failures that finished generations showed.
    """

    pafot: PafotState
    kinds: frozenset[Hashable] = frozenset()

    @property
    def generation(self) -> int:
        """Of the main search, from 0."""
        return self.pafot.generation

    @property
    def local_generation(self) -> int:
        """Within a local search from 1; 0 in the main search."""
        return self.pafot.local_generation


@dataclass(frozen=True, slots=True)
class DistinctSearch:
    """The paper's genetic algorithm with two rules on top.

    1. A generation that shows a new kind of failure (:attr:`~pytest_pafot.searching.Evaluation.kind`) is followed by
       a new random population: simplifying the failure is the shrinker's work.
    2. From then on a scenario that fails in a known way is worth less than any that does not fail.

    Attributes:
        space: of the scenarios.
        population: individuals in a generation.
    """

    name: ClassVar[str] = "distinct"

    space: SearchSpace = field(default_factory=SearchSpace)
    population: int = field(default=4, kw_only=True)

    def __post_init__(self) -> None:
        _ = self._pafot  # refuses a population that cannot be

    @property
    def _pafot(self) -> PafotSearch:
        return PafotSearch(self.space, population=self.population)

    def start(self, rng: np.random.Generator) -> DistinctState:
        """The state before the first generation, whose population is random and valid."""
        return DistinctState(pafot=self._pafot.start(rng))

    def ask(self, state: DistinctState, rng: np.random.Generator) -> tuple[DistinctState, tuple[Scenario, ...]]:
        """The scenarios to evaluate next.

        Raises:
            RuntimeError: when the last ask has not been told.
        """
        pafot, scenarios = self._pafot.ask(state.pafot, rng)
        return replace(state, pafot=pafot), scenarios

    def tell(
        self, state: DistinctState, evaluations: Sequence[Evaluation], rng: np.random.Generator
    ) -> tuple[DistinctState, tuple[AlgorithmEvent, ...]]:
        """Finish a generation with the evaluations of what was asked for, in the same order.

        Raises:
            RuntimeError: without an ask before.
            ValueError: when the evaluations are not those of the scenarios asked for.
        """
        pafot, events = self._pafot.tell(state.pafot, [_valued(each, state.kinds) for each in evaluations], rng)
        kinds = state.kinds | {each.kind for each in evaluations if each.failing and each.kind is not None}
        if kinds != state.kinds and not pafot.fresh:
            generation = pafot.generation + (pafot.local_generation > 0)
            pafot = self._pafot.restarted(generation, rng)
            events = (*events, Restarted(generation=generation, stagnant=0))
        return DistinctState(pafot=pafot, kinds=kinds), events


def _valued(evaluation: Evaluation, kinds: frozenset[Hashable]) -> Evaluation:
    """As the search values it: a failure of a known kind below everything that does not fail."""
    if not (evaluation.failing and evaluation.kind in kinds):
        return evaluation
    return replace(evaluation, failing=False, fitness=-math.inf)
