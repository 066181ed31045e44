"""MAP-Elites with the paper's genes and operators: the fittest scenario of every kind of impact.

The archive is pyribs's.

Source: Mouret, Clune, "Illuminating search spaces by mapping elites", arXiv:1504.04909, 2015.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
from ribs.archives import GridArchive

from pytest_pafot.scenario import Scenario
from pytest_pafot.searching.ask_tell import check_ask, check_evaluations, end_of_generation
from pytest_pafot.searching.evaluation import Evaluation
from pytest_pafot.searching.events import AlgorithmEvent
from pytest_pafot.searching.operators import crossover, mutate
from pytest_pafot.searching.parameters import check_counts, check_rates
from pytest_pafot.searching.space import SearchSpace, sample

NO_IMPACT = 0
"""The cell of a run without a collision; all of these share one niche, in which the nearest miss stays."""

TOP_CLOSING_SPEED = 30.0
"""Closing speeds beyond it share the last niche [m/s]."""

CLOSING_SPEED_NICHES = 6


@dataclass(frozen=True, slots=True, kw_only=True)
class MapElitesState:
    """Where a search is, between two calls.

    Attributes:
        generation: from 0.
        local_generation: always 0; there is no local search.
        archive: of pyribs, with numbers of evaluations for solutions; never changed, but copied.
        evaluations: all eligible ones so far.
        best: so far; None before the first eligible run.
        asked: scenarios that are out for evaluation.
    """

    generation: int = 0
    local_generation: int = 0
    archive: Any = None
    evaluations: tuple[Evaluation, ...] = ()
    best: Evaluation | None = None
    asked: tuple[Scenario, ...] = ()


@dataclass(frozen=True, slots=True)
class MapElitesSearch:
    """MAP-Elites over chains of Position-Instructions; niches are the impact cell and the closing speed.

    Attributes:
        space: of the scenarios.
        population: scenarios in a generation.
        random_generations: generations of random scenarios before the first children.
        crossover_rate: probability that two elites swap two NPCs.
    """

    name: ClassVar[str] = "map-elites"

    space: SearchSpace = field(default_factory=SearchSpace)
    population: int = field(default=4, kw_only=True)
    random_generations: int = field(default=5, kw_only=True)
    crossover_rate: float = field(default=0.5, kw_only=True)

    def __post_init__(self) -> None:
        check_counts(self, population=1, random_generations=1)
        check_rates(self, "crossover_rate")

    def start(self, rng: np.random.Generator) -> MapElitesState:
        """The state before the first generation: an empty archive."""
        archive = GridArchive(
            solution_dim=1,
            dims=(9, CLOSING_SPEED_NICHES),
            ranges=((-0.5, 8.5), (0.0, TOP_CLOSING_SPEED)),
        )
        return MapElitesState(archive=archive)

    def ask(self, state: MapElitesState, rng: np.random.Generator) -> tuple[MapElitesState, tuple[Scenario, ...]]:
        """The scenarios of the next generation: random ones at first, then varied elites.

        Raises:
            RuntimeError: when the last ask has not been told.
        """
        check_ask(state.asked)
        elites = _elites(state)
        is_random = state.generation < self.random_generations or not elites
        asked = tuple(
            sample(self.space, rng) if is_random else self._child(elites, rng) for _ in range(self.population)
        )
        return replace(state, asked=asked), asked

    def tell(
        self, state: MapElitesState, evaluations: Sequence[Evaluation], rng: np.random.Generator
    ) -> tuple[MapElitesState, tuple[AlgorithmEvent, ...]]:
        """Finish a generation with the evaluations of what was asked for, in the same order.

        Raises:
            RuntimeError: without an ask before.
            ValueError: when the evaluations are not those of the scenarios asked for.
        """
        check_evaluations(state.asked, evaluations)
        best, events = end_of_generation(state.generation, state.best, evaluations)
        eligible = [each for each in evaluations if each.eligible and np.isfinite(each.fitness)]
        archive = copy.deepcopy(state.archive)
        if eligible:
            first = len(state.evaluations)
            archive.add(
                solution=np.arange(first, first + len(eligible), dtype=np.float64)[:, None],
                objective=np.array([each.fitness for each in eligible]),
                measures=np.array([niche(each) for each in eligible]),
            )
        state = replace(
            state,
            generation=state.generation + 1,
            archive=archive,
            evaluations=(*state.evaluations, *eligible),
            best=best,
            asked=(),
        )
        return state, events

    def _child(self, elites: Sequence[Evaluation], rng: np.random.Generator) -> Scenario:
        a, b = (elites[int(index)].executed for index in rng.integers(len(elites), size=2))
        child = crossover(a, b, rng)[0] if rng.random() < self.crossover_rate else a
        return mutate(child, self.space, rng)


def niche(evaluation: Evaluation) -> tuple[float, float]:
    """The cell of the impact, 0 without one, and the closing speed [m/s]."""
    hit = evaluation.collision
    return (NO_IMPACT, 0.0) if hit is None else (float(hit.cell), hit.closing_speed)


def _elites(state: MapElitesState) -> list[Evaluation]:
    """In the order of the niches, so that the same draws give the same elites."""
    found = state.archive.data(["solution", "index"], return_type="tuple") if len(state.archive) else ((), ())
    numbers = [int(solution[0]) for solution in found[0]]
    return [state.evaluations[number] for _, number in sorted(zip(map(int, found[1]), numbers, strict=True))]
