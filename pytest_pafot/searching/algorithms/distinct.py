"""The default search: distinct failures, one kind after the other.

The paper's search counts collisions. What a user wants is each distinct failure once, and there it stands in its own
way: whatever fails outranks all that does not, so the first defect that is found absorbs its population of four, and
every further generation breeds it again. This search keeps the paper's genes and operators, and replaces what decides
who breeds. docs/explanation/default-search.md has the comparison.

Source of the niches: Mouret, Clune, "Illuminating search spaces by mapping elites", arXiv:1504.04909, 2015.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

from numpy.random import Generator

from pytest_pafot.model.crossings import SLOTS, Crossings, slot_name
from pytest_pafot.model.grid import Cell
from pytest_pafot.model.scenario import CrossingInstruction, Scenario
from pytest_pafot.searching.ask_tell import GenerationalSearch, GenerationState, GenerationStateT, check_parameters
from pytest_pafot.searching.evaluation import Evaluation
from pytest_pafot.searching.operators import first_crossed, improves, mutate, tournament
from pytest_pafot.searching.plain import from_plain, plain
from pytest_pafot.searching.space import sample

# What searches have in common that keep the worst runs of several kinds, the niches, and vary them.


@dataclass(frozen=True, slots=True)
class NicheSearch(GenerationalSearch[GenerationStateT]):
    """A search whose first scenarios are random, and whose later ones are children of those that it kept.

    Attributes:
        random_runs: scenarios before the first children.
        crossover_rate: probability that two parents swap two NPCs.
    """

    random_runs: int = field(default=20, kw_only=True)
    crossover_rate: float = field(default=0.5, kw_only=True)

    def __post_init__(self) -> None:
        check_parameters(self, rates=("crossover_rate",), population=1, random_runs=1)

    @property
    def random_at_first(self) -> float:
        """Scenarios at the beginning of a search that are random."""
        return max(self.population, self.random_runs)

    def propose(self, state: GenerationStateT, rng: Generator) -> tuple[GenerationStateT, Iterable[Scenario]]:
        """Random scenarios at first and while there is no parent; then children."""
        parents = self.parents(state)
        to_come = self.random_runs - state.proposed if parents else self.population
        return state, (
            sample(self.space, rng) if index < to_come else self.child(parents, rng) for index in range(self.population)
        )

    @abstractmethod
    def parents(self, state: GenerationStateT) -> Sequence[Any]:
        """What children are made of."""

    @abstractmethod
    def child(self, parents: Sequence[Any], rng: Generator) -> Scenario:
        """A scenario that is a variation of one or two parents."""


SPEED_NICHE = 5.0  # width of a niche in closing speed [m/s]
FASTEST_NICHE = 5  # index of the last one, which has no upper end

# The cell of an impact and the index of its closing speed; 0 and what the ego was made to do. Of an NPC that crosses
# its zone and slot stand for the cell, with numbers beyond those of cells, and below 0 without an impact.
Niche = tuple[int, int]
Elites = tuple[tuple[Niche, Evaluation], ...]  # the best of each niche, in their order


@dataclass(frozen=True, slots=True, kw_only=True)
class DistinctState(GenerationState):
    """Where a search is, between two calls."""

    kinds: frozenset[Hashable] = frozenset()  # of failures that were shown so far
    mistakes: frozenset[str] = frozenset()  # of the ego that these failures had, and checks that failed
    # the worst run for the ego of each niche, in the order of the niches, without those of known kinds
    elites: Elites = ()
    # by the name of each check that has not failed, the runs with the worst margin in each niche
    strained: Mapping[str, Elites] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class DistinctSearch(NicheSearch[DistinctState]):
    """Varies the worst runs of all niches, and drops what shows a known failure.

    1. The first scenarios are random, as the paper's first generation is.
    2. After them a third of the scenarios is random again, and the others are children. The worst run of every niche
       may have some: of every impact cell and closing speed, and without an impact of everything that the ego was made
       to do (:func:`~pytest_pafot.searching.evaluation.demand_of`), so that no kind of run displaces the others. Where
       an NPC crosses, its zone and slot stand for its cell, and without an impact for what the ego was made to do.
       For each check (:attr:`~pytest_pafot.searching.Evaluation.margins`) that has not failed yet the niches are held
       once more, by its worst margin in place of the fitness: every check is an objective, without a weight. These
       groups are drawn equally often, and parents of a group by binary tournament on the fitness. A child has one to
       three mutations.
    3. A run that shows a failure of a known kind (:attr:`~pytest_pafot.searching.Evaluation.kind`) is no parent from
       then on: simplifying it is the shrinker's work.

    Attributes:
        population: scenarios in a generation.
        most_mutations: of a child, whose number is uniform from 1.
        fresh: share of the scenarios that are random, after the first ones.
    """

    name: ClassVar[str] = "distinct"
    batch_population: ClassVar[int] = 64

    population: int = field(default=16, kw_only=True)
    most_mutations: int = field(default=3, kw_only=True)
    fresh: float = field(default=0.35, kw_only=True)

    def __post_init__(self) -> None:
        NicheSearch.__post_init__(self)
        check_parameters(self, rates=("fresh",), most_mutations=1)

    def start(self, rng: Generator) -> DistinctState:
        """The state before the first generation; it needs no draw."""
        return DistinctState()

    def stored(self, state: DistinctState) -> Any:
        """The state as plain data; what is drawn follows from the seed and the number of the generation."""
        return plain(state)

    def restored(self, data: Any) -> DistinctState:
        """The inverse of :meth:`stored`."""
        return from_plain(DistinctState, data)

    def parents(self, state: DistinctState) -> list[list[Evaluation]]:
        """Groups that have the same chance each: the elites of the niches, and those of each check."""
        groups = (state.elites, *state.strained.values())
        return [[each for _, each in elites] for elites in groups if elites]

    def child(self, parents: Sequence[Sequence[Evaluation]], rng: Generator) -> Scenario:
        """One to three mutations of a parent, or of two that have swapped NPCs; or a random scenario."""
        if rng.random() < self.fresh:
            return sample(self.space, rng)
        child = _parent(parents, rng).executed
        if rng.random() < self.crossover_rate:
            child = first_crossed(child, _parent(parents, rng).executed, rng)
        for _ in range(int(rng.integers(1, self.most_mutations + 1))):
            child = mutate(child, self.space, rng)
        return child

    def learn(self, state: DistinctState, evaluations: Sequence[Evaluation], rng: Generator) -> DistinctState:
        """The failures that are known now, and the runs that may be parents."""
        failed = [each for each in evaluations if each.failing]
        kinds = state.kinds | {each.kind for each in failed if each.kind is not None}
        mistakes = state.mistakes | {each.mistake for each in failed if each.mistake is not None}
        return replace(
            state,
            kinds=kinds,
            mistakes=mistakes,
            elites=_elites([*(each for _, each in state.elites), *evaluations], kinds, self.space.crossings),
            strained=_strained(state.strained, evaluations, kinds, mistakes, self.space.crossings),
        )


def niche(evaluation: Evaluation, crossings: Crossings | None = None) -> Niche:
    """Where an evaluation competes, in a world with some ways that meet the ego's."""
    hit, place = evaluation.collision, meeting_place(evaluation, crossings)
    speed = 0 if hit is None else min(int(hit.closing_speed / SPEED_NICHE), FASTEST_NICHE)
    if hit is not None and hit.cell is not None and hit.npc != evaluation.crossing:
        return int(hit.cell), speed
    if place is not None:
        return (-1 - place, 0) if hit is None else (1 + len(Cell) + place, speed)
    braking, changes, has_stood = evaluation.demand
    return 0, 6 * braking + 2 * changes + has_stood


def meeting_place(evaluation: Evaluation, crossings: Crossings | None) -> int | None:
    """Return a number for the zone and slot of the NPC that crosses and came nearest; None where nobody does.

    Zones are counted in the order in which the ego comes to them.
    """
    npc = evaluation.crossing
    instruction = None if npc is None else evaluation.scenario.npcs[npc][0]
    if crossings is None or not isinstance(instruction, CrossingInstruction):
        return None
    zone = [each.way for each in crossings.zones].index(instruction.zone)
    return len(SLOTS) * zone + list(SLOTS).index(slot_name(instruction.slot))


def _parent(groups: Sequence[Sequence[Evaluation]], rng: Generator) -> Evaluation:
    return tournament(groups[int(rng.integers(len(groups)))], rng)


def _strained(
    before: Mapping[str, Elites],
    evaluations: Sequence[Evaluation],
    kinds: frozenset[Hashable],
    failed: frozenset[str],
    crossings: Crossings | None,
) -> dict[str, Elites]:
    """For each check that has not failed, in the order of the names, the elites by its margin alone."""
    judged: dict[str, list[Evaluation]] = {name: [each for _, each in elites] for name, elites in before.items()}
    for each in evaluations:
        for name, margin in each.margins:
            judged.setdefault(name, []).append(replace(each, fitness=-margin))
    return {name: _elites(judged[name], kinds, crossings) for name in sorted(judged) if name not in failed}


def _elites(evaluations: Sequence[Evaluation], kinds: frozenset[Hashable], crossings: Crossings | None) -> Elites:
    """The best ranked of each niche, the first of equals."""
    best: dict[Niche, Evaluation] = {}
    for each in evaluations:
        is_known = each.failing and each.kind in kinds
        if not is_known and improves(each, best.get(niche(each, crossings))):
            best[niche(each, crossings)] = each
    return tuple(sorted(best.items()))
