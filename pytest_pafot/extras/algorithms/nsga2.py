"""NSGA-II with the paper's genes and operators: risk, severity and novelty at once, instead of one fitness.

The paper names it as its next step (section 5). Sorting by dominance and crowding is from the library pymoo.

Source: Deb et al., "A fast and elitist multiobjective genetic algorithm: NSGA-II", IEEE TEC 6(2), 2002.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from numpy.random import Generator

from pytest_pafot import Chromosome, Scenario
from pytest_pafot.extending import (
    Evaluation,
    FloatArray,
    GenerationalSearch,
    GenerationState,
    check_parameters,
    sample,
    varied,
)

WORST = 1e9  # the objectives of an ineligible run; finite, because crowding is a difference


@dataclass(frozen=True, slots=True, kw_only=True)
class Nsga2State(GenerationState):
    """The state of the search between two calls of ``ask`` or ``tell``."""

    population: tuple[Evaluation, ...] = ()  # survivors, the best rank first, and within a rank the least crowded


@dataclass(frozen=True, slots=True)
class Nsga2Search(GenerationalSearch[Nsga2State]):
    """NSGA-II over scenarios. Its first generation is random.

    Attributes:
        population: number of survivors, and of children in a generation.
        crossover_rate: probability that a pair of parents swaps two NPCs, as in the paper.
        mutation_rate: probability that a child has one instruction replaced, as in the paper.
    """

    name: ClassVar[str] = "nsga2"
    library: ClassVar[str] = "pymoo"

    crossover_rate: float = field(default=0.5, kw_only=True)
    mutation_rate: float = field(default=0.5, kw_only=True)

    def __post_init__(self) -> None:
        if self.population < 2:
            raise ValueError(f"population: expected at least 2, for a crossover, received {self.population!r}")
        check_parameters(self, rates=("crossover_rate", "mutation_rate"))

    def start(self, rng: Generator) -> Nsga2State:
        """Return the state before the first generation, without using a random number."""
        return Nsga2State()

    def propose(self, state: Nsga2State, rng: Generator) -> tuple[Nsga2State, Sequence[Scenario]]:
        """Return children of the survivors, or random scenarios in the first generation."""
        proposed: list[Scenario] = []
        while not state.population and len(proposed) < self.population:
            proposed.append(sample(self.space, rng))
        while len(proposed) < self.population:
            # The minimum of two indices is a tournament, because the population is sorted by preference.
            first, second = (int(rng.integers(len(state.population), size=2).min()) for _ in range(2))
            pair = state.population[first].executed, state.population[second].executed
            proposed += varied(pair, self.space, self.crossover_rate, self.mutation_rate, rng)
        return state, proposed[: self.population]

    def kept(self, state: Nsga2State) -> Sequence[Evaluation]:
        """Return the survivors of the previous generation."""
        return state.population

    def learn(self, state: Nsga2State, evaluations: Sequence[Evaluation], rng: Generator) -> Nsga2State:
        """Select the survivors of the generation."""
        return replace(state, population=surviving((*state.population, *evaluations), self.population, rng))


def surviving(evaluations: Sequence[Evaluation], count: int, rng: Generator) -> tuple[Evaluation, ...]:
    """Return at most ``count`` survivors, first by non-dominated rank and then by the largest crowding distance."""
    from pymoo.core.population import Population  # noqa: PLC0415  (slow to import)
    from pymoo.core.problem import Problem  # noqa: PLC0415
    from pymoo.operators.survival.rank_and_crowding import RankAndCrowding  # noqa: PLC0415

    values = objectives(evaluations)
    members = Population.new(F=values, index=np.arange(len(evaluations)))
    problem = Problem(n_var=1, n_obj=values.shape[1])
    chosen = RankAndCrowding().do(problem, members, n_survive=min(count, len(evaluations)), random_state=rng)
    order = sorted(chosen, key=lambda member: (member.get("rank"), -member.get("crowding")))
    return tuple(evaluations[int(member.get("index"))] for member in order)


def objectives(evaluations: Sequence[Evaluation]) -> FloatArray:
    """Return the objectives to minimise, shape [evaluations, 3 + checks].

    They are minus the fitness, minus the closing speed at the impact [m/s] and minus the novelty, then the margin of
    each check that any of the runs evaluated, sorted by name. Novelty is the share of genes in which a scenario, as
    driven, differs from the most similar other scenario: in the cell or lane, in the zone or slot, or by an NPC that
    only one of the two has.
    """
    cells = cells_of(evaluations)
    one, other = cells[:, None, :], cells[None, :, :]
    differ = (one != other).sum(axis=-1) / ((one > 0) | (other > 0)).sum(axis=-1)
    np.fill_diagonal(differ, 1.0)
    severity = [0.0 if each.collision is None else each.collision.closing_speed for each in evaluations]
    checks = sorted({name for each in evaluations for name, _ in each.margins})
    rows = [
        (-each.fitness, -speed, -float(others.min()), *(dict(each.margins).get(name, WORST) for name in checks))
        if each.eligible
        else (WORST,) * (3 + len(checks))
        for each, speed, others in zip(evaluations, severity, differ, strict=True)
    ]
    return np.clip(np.array(rows, dtype=np.float64), -WORST, WORST)


def cells_of(evaluations: Sequence[Evaluation]) -> FloatArray:
    """Return the driven cells, shape [evaluations, npcs * genes], in steps of the shortest gene; 0 for no gene.

    Numbers from 9 on stand for the lanes of Lane-Instructions, and for the zone and slot of an NPC that crosses.
    """
    shortest = min(each.executed.gene_seconds for each in evaluations)
    chains = [each.chains_in(shortest) for each in evaluations]
    genes = max(len(chain) for npcs in chains for chain in npcs)
    cells = np.zeros((len(chains), max(map(len, chains)), genes))
    places: dict[tuple[object, ...], int] = {}
    for index, npcs in enumerate(chains):
        for npc, chain in enumerate(npcs):
            cells[index, npc, : len(chain)] = [*_numbers(chain, places)]
    return cells.reshape(len(chains), -1)


def _numbers(chain: Chromosome, places: dict[tuple[object, ...], int]) -> Iterator[int]:
    for gene in chain:
        if gene.on_grid:
            yield gene.cell
        else:
            place = tuple(key for key in gene.counted([gene])[0] if key[0] != "bin")
            yield 9 + places.setdefault(place, len(places))
