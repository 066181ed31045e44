"""CMA-ES for mixed variables: the paper's genes, searched by a distribution instead of a population.

The optimiser, CatCMA with margin, is from the library cmaes. Plain CMA-ES does not fit, because cells are categories.

Source: Hamano et al., "CatCMA with Margin for Single- and Multi-Objective Mixed-Variable Black-Box Optimization",
arXiv:2504.07884, 2025.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.random import Generator

from pytest_pafot import Cell, PositionInstruction, Scenario
from pytest_pafot.extending import Evaluation, GenerationalSearch, GenerationState, SearchSpace

if TYPE_CHECKING:
    from cmaes import CatCMAwM


@dataclass(frozen=True, slots=True, kw_only=True)
class CmaEsState(GenerationState):
    """The state of the search between two calls of ``ask`` or ``tell``."""

    optimiser: CatCMAwM  # from cmaes, with its distribution and random state; copied before every change
    solutions: tuple[Any, ...] = ()  # the optimiser's solutions, one for each scenario under evaluation


@dataclass(frozen=True, slots=True)
class CmaEsSearch(GenerationalSearch[CmaEsState]):
    """A search by CatCMA with margin over chains of Position-Instructions.

    The optimiser's variables for a chain are its first cell, one of eight categories; each step to the next cell, one
    of three; and its speeds, integers in steps of 0.1 m/s. If two NPCs would hold the same cell, the chain is repaired.
    """

    name: ClassVar[str] = "cma-es"
    is_papers: ClassVar[bool] = True
    instructions: ClassVar[tuple[str, ...]] = ("cells",)
    library: ClassVar[str] = "cmaes"

    def __post_init__(self) -> None:
        if self.population < 4:
            raise ValueError(
                f"population: expected at least 4 for cma-es, which learns from the better half of it, received "
                f"{self.population!r}"
            )

    def start(self, rng: Generator) -> CmaEsState:
        """Return the state before the first generation; one random number seeds the optimiser's own randomness."""
        from cmaes import CatCMAwM  # noqa: PLC0415  (slow to import)

        space = self.space
        optimiser = CatCMAwM(
            z_space=[list(range(space.low_step, space.top_step + 1))] * (space.npcs * space.genes),
            c_space=[8, *[3] * (space.genes - 1)] * space.npcs,
            population_size=self.population,
            seed=int(rng.integers(2**31)),
        )
        return CmaEsState(optimiser=optimiser)

    def propose(self, state: CmaEsState, rng: Generator) -> tuple[CmaEsState, Sequence[Scenario]]:
        """Sample scenarios from the optimiser's distribution."""
        optimiser = copy.deepcopy(state.optimiser)
        solutions = tuple(optimiser.ask() for _ in range(self.population))
        space, shape, proposed = self.space, (self.space.npcs, self.space.genes), []
        for solution in solutions:
            choices = np.argmax(solution.c, axis=1)[: space.npcs * space.genes].reshape(shape)
            speeds = np.asarray(solution.z).round().astype(int).reshape(shape)
            # The first choice is a cell; each of the others is a step on the ring: -1, 0 or 1.
            cells = np.cumsum(np.hstack([choices[:, :1], choices[:, 1:] - 1]), axis=1) % 8 + 1
            proposed.append(scenario_of(cells.tolist(), speeds.tolist(), space, seed=int(rng.integers(2**31))))
        return replace(state, optimiser=optimiser, solutions=solutions), proposed

    def learn(self, state: CmaEsState, evaluations: Sequence[Evaluation], rng: Generator) -> CmaEsState:
        """Move the distribution towards scenarios that are worse for the ego."""
        optimiser = copy.deepcopy(state.optimiser)
        optimiser.tell(list(zip(state.solutions, losses(evaluations), strict=True)))
        return replace(state, optimiser=optimiser, solutions=())


def scenario_of(
    cells: Sequence[Sequence[int]], speeds: Sequence[Sequence[int]], space: SearchSpace, *, seed: int
) -> Scenario:
    """Make a valid scenario of Position-Instructions from each NPC's cells, and its speeds in steps of 0.1 m/s."""
    return Scenario.repaired(
        [
            [PositionInstruction(Cell(cell), step / 10) for cell, step in zip(*chain, strict=True)]
            for chain in zip(cells, speeds, strict=True)
        ],
        seed=seed,
        ego_lane=space.ego_lane,
        ego_speed=space.ego_speed,
        gene_seconds=space.gene_seconds,
        traffic=space.traffic,
    )


def losses(evaluations: Sequence[Evaluation]) -> list[float]:
    """Return a finite loss for each run, to be minimised: minus the fitness; ineligible runs have the highest loss."""
    known = [-each.fitness for each in evaluations if each.eligible and math.isfinite(each.fitness)]
    worst = max(known, default=0.0) + 1.0
    return [-each.fitness if each.eligible and math.isfinite(each.fitness) else worst for each in evaluations]
