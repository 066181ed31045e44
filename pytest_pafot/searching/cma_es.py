"""CMA-ES for mixed variables: the paper's genes, searched by a distribution instead of a population.

CatCMA with margin is cmaes's. Cells are categories, so that the plain CMA-ES does not fit them.

Source: Hamano et al., "CatCMA with Margin for Single- and Multi-Objective Mixed-Variable Black-Box Optimization",
arXiv:2504.07884, 2025.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
from cmaes import CatCMAwM

from pytest_pafot.grid import Cell
from pytest_pafot.scenario import SPEED_STEPS_PER_MPS, PositionInstruction, Scenario
from pytest_pafot.searching.ask_tell import check_ask, check_evaluations, end_of_generation
from pytest_pafot.searching.evaluation import Evaluation
from pytest_pafot.searching.events import AlgorithmEvent
from pytest_pafot.searching.space import SearchSpace, fresh_seed
from pytest_pafot.searching.valid_scenario import repaired


@dataclass(frozen=True, slots=True, kw_only=True)
class CmaEsState:
    """Where a search is, between two calls.

    Attributes:
        generation: from 0.
        local_generation: always 0; there is no local search.
        optimiser: of cmaes, with its distribution and its own random state; never changed, but copied.
        solutions: of the optimiser, one for each scenario that is out.
        best: so far; None before the first eligible run.
        asked: scenarios that are out for evaluation.
    """

    generation: int = 0
    local_generation: int = 0
    optimiser: Any = None
    solutions: tuple[Any, ...] = ()
    best: Evaluation | None = None
    asked: tuple[Scenario, ...] = ()


@dataclass(frozen=True, slots=True)
class CmaEsSearch:
    """CatCMA with margin over chains of Position-Instructions.

    A chain is its first cell, a category of eight; the steps to the next cells, categories of three; and its speeds,
    whole numbers of 0.1 m/s. What two NPCs would both hold is repaired.

    Attributes:
        space: of the scenarios.
        population: scenarios in a generation.
    """

    name: ClassVar[str] = "cma-es"

    space: SearchSpace = field(default_factory=SearchSpace)
    population: int = field(default=4, kw_only=True)

    def __post_init__(self) -> None:
        if self.population < 2:
            raise ValueError(f"population: expected at least 2, to rank them, received {self.population!r}")

    def start(self, rng: np.random.Generator) -> CmaEsState:
        """The state before the first generation; the optimiser's own draws follow from one of the generator."""
        space = self.space
        optimiser = CatCMAwM(
            z_space=[list(range(space.top_step + 1))] * (space.npcs * space.genes),
            c_space=[8, *[3] * (space.genes - 1)] * space.npcs,
            population_size=self.population,
            seed=fresh_seed(rng),
        )
        return CmaEsState(optimiser=optimiser)

    def ask(self, state: CmaEsState, rng: np.random.Generator) -> tuple[CmaEsState, tuple[Scenario, ...]]:
        """The scenarios of the next generation.

        Raises:
            RuntimeError: when the last ask has not been told.
        """
        check_ask(state.asked)
        optimiser = copy.deepcopy(state.optimiser)
        solutions = tuple(optimiser.ask() for _ in range(self.population))
        asked = tuple(self._decoded(solution, fresh_seed(rng)) for solution in solutions)
        return replace(state, optimiser=optimiser, solutions=solutions, asked=asked), asked

    def tell(
        self, state: CmaEsState, evaluations: Sequence[Evaluation], rng: np.random.Generator
    ) -> tuple[CmaEsState, tuple[AlgorithmEvent, ...]]:
        """Finish a generation with the evaluations of what was asked for, in the same order.

        Raises:
            RuntimeError: without an ask before.
            ValueError: when the evaluations are not those of the scenarios asked for.
        """
        check_evaluations(state.asked, evaluations)
        best, events = end_of_generation(state.generation, state.best, evaluations)
        optimiser = copy.deepcopy(state.optimiser)
        optimiser.tell(list(zip(state.solutions, losses(evaluations), strict=True)))
        state = replace(state, generation=state.generation + 1, optimiser=optimiser, solutions=(), best=best, asked=())
        return state, events

    def _decoded(self, solution: Any, seed: int) -> Scenario:
        space = self.space
        shape = (space.npcs, space.genes)
        choices = np.argmax(solution.c, axis=1)[: space.npcs * space.genes].reshape(shape)
        speeds = np.asarray(solution.z).round().astype(int).reshape(shape)
        steps = np.hstack([choices[:, :1], choices[:, 1:] - 1])
        cells = np.cumsum(steps, axis=1) % 8 + 1
        chains = [
            [
                PositionInstruction(Cell(int(cell)), int(speed) / SPEED_STEPS_PER_MPS)
                for cell, speed in zip(*chain, strict=True)
            ]
            for chain in zip(cells, speeds, strict=True)
        ]
        return repaired(chains, seed, space)


def losses(evaluations: Sequence[Evaluation]) -> list[float]:
    """What the optimiser minimises, finite: minus fitness; for runs that are not eligible, more than all others."""
    known = [-each.fitness for each in evaluations if each.eligible and math.isfinite(each.fitness)]
    worst = max(known, default=0.0) + 1.0
    return [-each.fitness if each.eligible and math.isfinite(each.fitness) else worst for each in evaluations]
