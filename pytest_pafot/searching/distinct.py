"""The default search: distinct failures, one kind after the other.

The paper's search counts collisions. What a user wants is each distinct failure once, and there it stands in its own
way: whatever fails outranks all that does not, so the first defect that is found absorbs its population of four, and
every further generation breeds it again. This search keeps the paper's genes and operators, and replaces what decides
who breeds. docs/explanation.md has the comparison.

Source of the niches: Mouret, Clune, "Illuminating search spaces by mapping elites", arXiv:1504.04909, 2015.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from pytest_pafot.scenario import Scenario
from pytest_pafot.searching.evaluation import Evaluation
from pytest_pafot.searching.events import AlgorithmEvent
from pytest_pafot.searching.operators import crossover, improves, mutate, tournament
from pytest_pafot.searching.parameters import check_counts, check_rates
from pytest_pafot.searching.space import SearchSpace, sample
from pytest_pafot.searching.turns import check_ask, check_evaluations, end_of_generation

SPEED_NICHE = 5.0
"""Width of a niche in closing speed [m/s]."""
FASTEST_NICHE = 5
"""Index of the last one, which has no upper end."""
NO_IMPACT = (0, 0)
"""The niche of all runs without a collision, in which the nearest miss stays."""

Niche = tuple[int, int]
"""The cell of an impact, 1 to 8, and the index of its closing speed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DistinctState:
    """Where a search is, between two calls.

    Attributes:
        generation: from 0.
        local_generation: always 0; there is no local search.
        kinds: of failures that were shown so far.
        elites: the worst run for the ego of each niche, in the order of the niches, without those of known kinds.
        best: so far; None before the first eligible run.
        asked: scenarios that are out for evaluation.
    """

    generation: int = 0
    local_generation: int = 0
    kinds: frozenset[Hashable] = frozenset()
    elites: tuple[tuple[Niche, Evaluation], ...] = ()
    best: Evaluation | None = None
    asked: tuple[Scenario, ...] = ()


@dataclass(frozen=True, slots=True)
class DistinctSearch:
    """Varies the worst runs of all niches, and drops what shows a known failure.

    1. The first generations are random, as the paper's first one is.
    2. After them the worst run of every niche, impact cell by closing speed, may have children, so that no kind of
       near-miss displaces the others. Parents are drawn by binary tournament; a child has one to three mutations.
    3. A run that shows a failure of a known kind (:attr:`~pytest_pafot.searching.Evaluation.kind`) is no parent from
       then on: simplifying it is the shrinker's work.

    Attributes:
        space: of the scenarios.
        population: scenarios in a generation.
        random_generations: before the first children.
        crossover_rate: probability that two parents swap two NPCs.
        most_mutations: of a child, whose number is uniform from 1.
    """

    name: ClassVar[str] = "distinct"

    space: SearchSpace = field(default_factory=SearchSpace)
    population: int = field(default=4, kw_only=True)
    random_generations: int = field(default=5, kw_only=True)
    crossover_rate: float = field(default=0.5, kw_only=True)
    most_mutations: int = field(default=3, kw_only=True)

    def __post_init__(self) -> None:
        check_counts(self, population=1, random_generations=1, most_mutations=1)
        check_rates(self, "crossover_rate")

    def start(self, rng: np.random.Generator) -> DistinctState:
        """The state before the first generation; it needs no draw."""
        return DistinctState()

    def ask(self, state: DistinctState, rng: np.random.Generator) -> tuple[DistinctState, tuple[Scenario, ...]]:
        """The scenarios of the next generation.

        Raises:
            RuntimeError: when the last ask has not been told.
        """
        check_ask(state.asked)
        parents = [evaluation for _, evaluation in state.elites]
        is_random = state.generation < self.random_generations or not parents
        asked = tuple(
            sample(self.space, rng) if is_random else self._child(parents, rng) for _ in range(self.population)
        )
        return replace(state, asked=asked), asked

    def tell(
        self, state: DistinctState, evaluations: Sequence[Evaluation], rng: np.random.Generator
    ) -> tuple[DistinctState, tuple[AlgorithmEvent, ...]]:
        """Finish a generation with the evaluations of what was asked for, in the same order.

        Raises:
            RuntimeError: without an ask before.
            ValueError: when the evaluations are not those of the scenarios asked for.
        """
        check_evaluations(state.asked, evaluations)
        best, events = end_of_generation(state.generation, state.best, evaluations)
        kinds = state.kinds | {each.kind for each in evaluations if each.failing and each.kind is not None}
        elites = _elites([*(each for _, each in state.elites), *evaluations], kinds)
        state = replace(state, generation=state.generation + 1, kinds=kinds, elites=elites, best=best, asked=())
        return state, events

    def _child(self, elites: Sequence[Evaluation], rng: np.random.Generator) -> Scenario:
        child = tournament(elites, rng).executed
        if rng.random() < self.crossover_rate:
            child, _ = crossover(child, tournament(elites, rng).executed, rng)
        for _ in range(int(rng.integers(1, self.most_mutations + 1))):
            child = mutate(child, self.space, rng)
        return child


def niche(evaluation: Evaluation) -> Niche:
    """Where an evaluation competes."""
    hit = evaluation.collision
    if hit is None:
        return NO_IMPACT
    return int(hit.cell), min(int(hit.closing_speed / SPEED_NICHE), FASTEST_NICHE)


def _elites(evaluations: Sequence[Evaluation], kinds: frozenset[Hashable]) -> tuple[tuple[Niche, Evaluation], ...]:
    """The best ranked of each niche, the first of equals."""
    best: dict[Niche, Evaluation] = {}
    for each in evaluations:
        is_known = each.failing and each.kind in kinds
        if not is_known and improves(each, best.get(niche(each))):
            best[niche(each)] = each
    return tuple(sorted(best.items()))
