"""The default search: distinct failures, one kind after the other.

The paper's search counts collisions. A user wants each distinct failure once. The paper's search hinders this: failing
runs outrank all others, so the first defect takes over its population of four, and every further generation breeds the
same defect again. The default search has the paper's genes and operators, but a different choice of parents.
docs/explanation/default-search.md has the comparison.

Source of the niches: Mouret, Clune, "Illuminating search spaces by mapping elites", arXiv:1504.04909, 2015.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

from numpy.random import Generator

from pytest_pafot.model.crossings import Crossings
from pytest_pafot.model.grid import Cell
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.searching.ask_tell import GenerationalSearch, GenerationState, check_parameters
from pytest_pafot.searching.evaluation import Evaluation
from pytest_pafot.searching.operators import first_crossed, improves, mutate, tournament
from pytest_pafot.searching.space import sample

SPEED_NICHE = 5.0  # width of a niche in closing speed [m/s]
FASTEST_NICHE = 5  # index of the last niche, which has no upper end

# The cell of an impact and the index of its closing speed; without an impact, 0 and the demand on the ego. For an NPC
# that crosses, its zone and slot replace the cell, with numbers beyond those of cells, and below 0 without an impact.
Niche = tuple[int, int]
Elites = tuple[tuple[Niche, Evaluation], ...]  # the best of each niche, in their order


@dataclass(frozen=True, slots=True, kw_only=True)
class DistinctState(GenerationState):
    """The state of the search between two calls of ``ask`` or ``tell``."""

    kinds: frozenset[Hashable] = frozenset()  # kinds of the failures so far
    mistakes: frozenset[str] = frozenset()  # the ego's mistakes in these failures, and the failed checks
    # the worst run for the ego in each niche, in the order of the niches, without those of known kinds
    elites: Elites = ()
    # by the name of each check that has not failed, the runs with the worst margin in each niche
    strained: Mapping[str, Elites] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class DistinctSearch(GenerationalSearch[DistinctState]):
    """A search that varies the worst run of each niche, which is a kind of run, and drops runs with a known failure.

    1. The first scenarios are random, like the paper's first generation.
    2. After them a third of the scenarios are random, and the others are children of the worst run of every niche. The
       niche of a run with an impact is the cell and closing speed of the impact. Without an impact, it is how the ego
       reacted (:func:`~pytest_pafot.searching.evaluation.demand_of`). So no kind of run displaces the others. For an
       NPC that crosses, its zone and slot replace the cell or, without an impact, the reaction. Each check that has not
       failed yet (:attr:`~pytest_pafot.searching.Evaluation.margins`) has a separate group of niches, in which its
       worst margin replaces the fitness: every check is an objective, without a weight. The groups are equally likely,
       and parents are selected in a group by binary tournament on the fitness. A child has one to three mutations.
    3. A run that shows a failure of a known kind (:attr:`~pytest_pafot.searching.Evaluation.kind`) is no longer a
       parent, because the shrinker simplifies such failures.
    4. The search begins anew after some generations, so that any process can drive such a block by itself.

    Attributes:
        population: number of scenarios in a generation.
        random_runs: number of random scenarios before the first children.
        crossover_rate: probability that two parents swap two NPCs.
        most_mutations: largest number of mutations of a child; the number is uniform from 1.
        fresh: share of random scenarios after the first ``random_runs``.
    """

    name: ClassVar[str] = "distinct"
    draws_vehicles: ClassVar[bool] = True
    block_runs: ClassVar[int] = 64  # as good as one population of all runs, also where a margin has to be climbed

    population: int = field(default=16, kw_only=True)
    random_runs: int = field(default=20, kw_only=True)
    crossover_rate: float = field(default=0.5, kw_only=True)
    most_mutations: int = field(default=3, kw_only=True)
    fresh: float = field(default=0.35, kw_only=True)

    def __post_init__(self) -> None:
        check_parameters(self, rates=("crossover_rate", "fresh"), population=1, random_runs=1, most_mutations=1)

    @property
    def counted_at_first(self) -> float:
        """The number of random scenarios at the beginning of a search."""
        return max(self.population, self.random_runs)

    def start(self, rng: Generator) -> DistinctState:
        """Return the state before the first generation, without using a random number."""
        return DistinctState()

    def propose(self, state: DistinctState, rng: Generator) -> tuple[DistinctState, Iterable[Scenario]]:
        """Propose ``random_runs`` random scenarios, and more while there is no parent.

        All others are children.
        """
        parents = self.parents(state)
        to_come = self.random_runs - state.proposed if parents else self.population
        return state, (
            sample(self.space, rng) if index < to_come else self.child(parents, rng) for index in range(self.population)
        )

    def parents(self, state: DistinctState) -> list[list[Evaluation]]:
        """Return the equally likely groups of parents: elites by fitness, and elites by the margin of each check."""
        groups = (state.elites, *state.strained.values())
        return [[each for _, each in elites] for elites in groups if elites]

    def child(self, parents: Sequence[Sequence[Evaluation]], rng: Generator) -> Scenario:
        """Return a random scenario, or a parent, perhaps crossed with a second parent, after one to three mutations."""
        if rng.random() < self.fresh:
            return sample(self.space, rng)
        child = _parent(parents, rng).executed
        if rng.random() < self.crossover_rate:
            child = first_crossed(child, _parent(parents, rng).executed, rng)
        for _ in range(int(rng.integers(1, self.most_mutations + 1))):
            child = mutate(child, self.space, rng)
        return child

    def learn(self, state: DistinctState, evaluations: Sequence[Evaluation], rng: Generator) -> DistinctState:
        """Update the known failures, and the runs that may be parents."""
        if not evaluations:
            return state
        failed, crossings = [each for each in evaluations if each.failing], self.space.crossings
        kinds = state.kinds | {each.kind for each in failed if each.kind is not None}
        mistakes = state.mistakes | {each.mistake for each in failed if each.mistake is not None}
        # The runs for the elites of each check that has not failed, with the margin in the place of the fitness.
        judged: dict[str, list[Evaluation]] = {
            name: [each for _, each in elites] for name, elites in state.strained.items()
        }
        for each in evaluations:
            for name, margin in each.margins:
                judged.setdefault(name, []).append(replace(each, fitness=-margin))
        return replace(
            state,
            kinds=kinds,
            mistakes=mistakes,
            elites=_elites([*(each for _, each in state.elites), *evaluations], kinds, crossings),
            strained={name: _elites(judged[name], kinds, crossings) for name in sorted(judged) if name not in mistakes},
        )


def niche(evaluation: Evaluation, crossings: Crossings | None = None) -> Niche:
    """Return the niche of an evaluation; ``crossings`` are the world's ways that meet the ego's way."""
    hit, place = evaluation.collision, evaluation.meeting_place(crossings)
    speed = 0 if hit is None else min(int(hit.closing_speed / SPEED_NICHE), FASTEST_NICHE)
    if hit is not None and hit.cell is not None and hit.npc != evaluation.crossing:
        return int(hit.cell), speed
    if place is not None:
        return (-1 - place, 0) if hit is None else (1 + len(Cell) + place, speed)
    braking, changes, has_stood = evaluation.demand
    return 0, 6 * braking + 2 * changes + has_stood


def _parent(groups: Sequence[Sequence[Evaluation]], rng: Generator) -> Evaluation:
    return tournament(groups[int(rng.integers(len(groups)))], rng)


def _elites(evaluations: Sequence[Evaluation], kinds: frozenset[Hashable], crossings: Crossings | None) -> Elites:
    """Return the best ranked evaluation of each niche, the first of equals, without failures of known kinds."""
    best: dict[Niche, Evaluation] = {}
    for each in evaluations:
        is_known = each.failing and each.kind in kinds
        if not is_known and improves(each, best.get(niche(each, crossings))):
            best[niche(each, crossings)] = each
    return tuple(sorted(best.items()))
