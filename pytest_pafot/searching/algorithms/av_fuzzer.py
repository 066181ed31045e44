"""AV-Fuzzer, the baseline of the paper's evaluation: a genetic algorithm over manoeuvres, without a grid.

Source: Li et al., "AV-FUZZER: Finding Safety Violations in Autonomous Driving Systems", ISSRE 2020, as its authors
released it. docs/comparisons/README.md lists the differences.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

import numpy as np
from numpy.random import Generator

from pytest_pafot.model.instructions import LaneInstruction
from pytest_pafot.model.scenario import Chromosome, Scenario
from pytest_pafot.model.trace import FloatArray
from pytest_pafot.searching.evaluation import (
    AlgorithmEvent,
    Evaluation,
    GenerationFinished,
    LocalSearchStarted,
    NewBest,
    Restarted,
)
from pytest_pafot.searching.plan import check_ask, check_evaluations, check_parameters, end_of_local_search
from pytest_pafot.searching.space import SearchSpace, sample_manoeuvres

ACTIONS: tuple[Literal["keep", "left", "right"], ...] = ("keep", "left", "right")  # the lanes of a Lane-Instruction
LANE_CHANGE = 34.0  # weight of a lane change in the distance of two scenarios, in which speeds count in m/s
RESTART_CANDIDATES = 1000
LEAST_WEIGHT = 0.001  # replaces a fitness of 0, which the roulette would never select


@dataclass(frozen=True, slots=True, kw_only=True)
class AvFuzzerState:
    """The state of the search between two calls of ``ask`` or ``tell``."""

    generation: int = 0  # generation of the main search, from 0, which is the random population
    local_generation: int = 0  # 0 in the main search; in a local search it counts from 1, the mutants
    # selected at the end of the last generation; empty before a random population
    population: tuple[Evaluation, ...] = ()
    local_population: tuple[Evaluation, ...] = ()  # the same within a local search
    global_best: Evaluation | None = None  # the fittest of all generations, stored separately
    local_best: Evaluation | None = None  # the best of the current local search
    slot: int = 0  # index of the best in the population, which the result of a local search may replace
    # the highest fitness of each selected population since the last random one, starting with that one
    bests: tuple[float, ...] = ()
    restarted_at: int = 0  # the generation whose population was random
    # the features of all selected populations so far, including those of local searches
    checkpoints: tuple[FloatArray, ...] = ()
    fresh: tuple[Scenario, ...] = ()  # a random population to evaluate next
    # positions and scenarios under evaluation; None if the next call must be ask
    asked: tuple[tuple[int, Scenario], ...] | None = None


@dataclass(frozen=True, slots=True)
class AvFuzzerSearch:
    """AV-Fuzzer's search. The defaults are the numbers of its released code, except for the length of a slice.

    Attributes:
        space: space whose NPCs, speed limit and start are used. All slices together last as long as all genes of a
            chain in this space, so that algorithms are compared over equal times. By default, each of five slices lasts
            12 s; in the released code, it lasts 3 s.
        population: number of scenarios in a generation.
        slices: number of manoeuvres of each NPC, one per time slice.
        crossover_rate: probability of each crossover; a generation of four scenarios has two possible crossovers.
        mutation_rate: probability that one manoeuvre of a scenario is changed.
        local_generations: number of generations of a local search, without its first generation, which consists of
            mutants of the best scenario; 0 turns local searches off.
        local_mutation_factor: factor of the mutation rate in local searches, up to a rate of 1.
        local_after: number of generations that must follow a random population before a local search may start.
        restart_after: number of generations without progress after which the population is abandoned.
    """

    name: ClassVar[str] = "av-fuzzer"
    is_papers: ClassVar[bool] = True
    fitness: ClassVar[str] = "av-fuzzer"
    instructions: ClassVar[tuple[str, ...]] = ("lanes",)

    space: SearchSpace = field(default_factory=SearchSpace)
    population: int = field(default=4, kw_only=True)
    slices: int = field(default=5, kw_only=True)
    crossover_rate: float = field(default=0.4, kw_only=True)
    mutation_rate: float = field(default=0.4, kw_only=True)
    local_generations: int = field(default=5, kw_only=True)
    local_mutation_factor: float = field(default=1.5, kw_only=True)
    local_after: int = field(default=2, kw_only=True)
    restart_after: int = field(default=5, kw_only=True)

    def __post_init__(self) -> None:
        if self.population < 2:
            raise ValueError(f"population: expected at least 2, for a crossover, received {self.population!r}")
        rates, factors = ("crossover_rate", "mutation_rate"), ("local_mutation_factor",)
        counts = {"slices": 1, "local_generations": 0, "local_after": 0, "restart_after": 1}
        check_parameters(self, rates=rates, factors=factors, **counts)

    @property
    def sliced(self) -> SearchSpace:
        """The space with one gene for each slice."""
        return self.space.sliced(self.slices)

    def start(self, rng: Generator) -> AvFuzzerState:
        """Return the state before the first generation, whose population is random."""
        return AvFuzzerState(fresh=tuple(sample_manoeuvres(self.sliced, rng) for _ in range(self.population)))

    def ask(self, state: AvFuzzerState, rng: Generator) -> tuple[AvFuzzerState, tuple[Scenario, ...]]:
        """Return the scenarios of the next generation that crossover or mutation changed; there may be none."""
        check_ask(state.asked)
        asked = tuple(enumerate(state.fresh)) if state.fresh else self._varied(state, rng)
        return replace(state, asked=asked, fresh=()), tuple(scenario for _, scenario in asked)

    def tell(
        self, state: AvFuzzerState, evaluations: Sequence[Evaluation], rng: Generator
    ) -> tuple[AvFuzzerState, tuple[AlgorithmEvent, ...]]:
        """Finish a generation with the evaluations of the requested scenarios, in the same order."""
        check_evaluations(None if state.asked is None else [scenario for _, scenario in state.asked], evaluations)
        population = list(state.local_population if state.local_generation else state.population)
        is_random = not population
        for (index, _), evaluation in zip(state.asked or (), evaluations, strict=True):
            population[index : index + 1] = [evaluation]
        finished = GenerationFinished(
            generation=state.generation,
            local_generation=state.local_generation,
            population=tuple(population),
            elites=len(population) - len(evaluations),
        )
        state = replace(state, asked=None)
        # There is no selection from a random population or from the mutants of an incumbent before they are varied.
        selected = tuple(population)
        if not is_random and state.local_generation != 1:
            selected = roulette(selected, rng)
        seen = np.stack([features(member.scenario) for member in selected])
        state = replace(state, checkpoints=(*state.checkpoints, seen))
        step = self._after_local_generation if state.local_generation else self._after_generation
        state, events = step(state, selected, rng)
        return state, (finished, *events)

    def _varied(self, state: AvFuzzerState, rng: Generator) -> tuple[tuple[int, Scenario], ...]:
        """Return the positions and scenarios that crossover or mutation applied to, even if they did not change."""
        is_local = state.local_generation > 0
        members = state.local_population if is_local else state.population
        scenarios = [member.scenario for member in members]
        if state.local_generation == 1:
            return tuple(enumerate([mutated(scenario, self.space, rng) for scenario in scenarios]))
        rate = min(1.0, self.mutation_rate * self.local_mutation_factor) if is_local else self.mutation_rate
        touched: set[int] = set()
        for _ in range(len(scenarios) // 2):
            if rng.random() < self.crossover_rate:
                first, second = (int(index) for index in rng.choice(len(scenarios), size=2, replace=False))
                scenarios[first], scenarios[second] = swapped(scenarios[first], scenarios[second], rng)
                touched |= {first, second}
        for index, scenario in enumerate(scenarios):
            if rng.random() < rate:
                scenarios[index] = mutated(scenario, self.space, rng)
                touched.add(index)
        return tuple((index, scenarios[index]) for index in sorted(touched))

    def _after_generation(
        self, state: AvFuzzerState, selected: tuple[Evaluation, ...], rng: Generator
    ) -> tuple[AvFuzzerState, tuple[AlgorithmEvent, ...]]:
        slot = max(range(len(selected)), key=lambda index: _weight(selected[index]))
        best, generation = selected[slot], state.generation
        fitness = _weight(best)
        earlier, age = state.bests, generation - state.restarted_at
        events: list[AlgorithmEvent] = []
        if best.eligible and (state.global_best is None or fitness > _weight(state.global_best)):
            events.append(NewBest(generation=generation, local_generation=0, evaluation=best))
            state = replace(state, global_best=best)
        state = replace(state, population=selected, bests=(*earlier, fitness), slot=slot)
        stagnant = earlier[-self.restart_after :]
        if age >= self.restart_after and sum(stagnant) / len(stagnant) >= fitness:
            events.append(Restarted(generation=generation + 1, stagnant=self.restart_after))
            candidates = [sample_manoeuvres(self.sliced, rng) for _ in range(RESTART_CANDIDATES)]
            fresh, after = farthest(candidates, np.concatenate(state.checkpoints), self.population), generation + 1
            state = replace(state, generation=after, population=(), restarted_at=after, bests=(), fresh=fresh)
            return state, tuple(events)
        improves = fitness > max(earlier, default=-math.inf)
        incumbent = state.global_best
        if age == 0 or not improves or age <= self.local_after or self.local_generations == 0 or incumbent is None:
            return replace(state, generation=generation + 1), tuple(events)
        events.append(LocalSearchStarted(generation=generation, incumbent=incumbent))
        copies = (incumbent,) * self.population
        return replace(state, local_generation=1, local_population=copies, local_best=None), tuple(events)

    def _after_local_generation(
        self, state: AvFuzzerState, selected: tuple[Evaluation, ...], rng: Generator
    ) -> tuple[AvFuzzerState, tuple[AlgorithmEvent, ...]]:
        best = max((*selected, *filter(None, [state.local_best])), key=_weight)
        state = replace(state, local_population=selected, local_best=best)
        if state.local_generation <= self.local_generations:
            return replace(state, local_generation=state.local_generation + 1), ()
        incumbent = state.global_best
        assert incumbent is not None, "a local search starts from a best"  # noqa: S101
        replaced = best.eligible and _weight(best) > _weight(incumbent)
        population = list(state.population)
        if replaced:
            population[state.slot] = best
        after = replace(
            state,
            generation=state.generation + 1,
            local_generation=0,
            population=tuple(population),
            local_population=(),
            local_best=None,
            global_best=best if replaced else incumbent,
        )
        return after, end_of_local_search(state, incumbent, best if replaced else None)


def swapped(a: Scenario, b: Scenario, rng: Generator) -> tuple[Scenario, Scenario]:
    """Swap the NPCs of two scenarios that have the same random index."""
    npc = int(rng.integers(len(a.npcs)))
    return _with(a, npc, b.npcs[npc]), _with(b, npc, a.npcs[npc])


def mutated(scenario: Scenario, space: SearchSpace, rng: Generator) -> Scenario:
    """Give a random manoeuvre of a random NPC a new speed, a new action or no change, with equal probability.

    Speeds are sampled as in ``sample_manoeuvres``.
    """
    npc = int(rng.integers(len(scenario.npcs)))
    chain = scenario.npcs[npc]
    index = int(rng.integers(len(chain)))
    gene = chain[index]
    assert isinstance(gene, LaneInstruction), "AV-Fuzzer's scenarios have Lane-Instructions"  # noqa: S101
    kind = int(rng.integers(3))
    if kind == 0:
        gene = replace(gene, speed=int(rng.integers(space.low_step, space.top_step + 1)) / 10)
    elif kind == 1:
        gene = replace(gene, lane=ACTIONS[int(rng.integers(len(ACTIONS)))])
    return _with(scenario, npc, (*chain[:index], gene, *chain[index + 1 :]))


def _with(scenario: Scenario, npc: int, chain: Chromosome) -> Scenario:
    return replace(scenario, npcs=(*scenario.npcs[:npc], chain, *scenario.npcs[npc + 1 :]))


def roulette(population: Sequence[Evaluation], rng: Generator) -> tuple[Evaluation, ...]:
    """Sample a population of the same size with replacement, in proportion to fitness.

    If a fitness is negative, all are raised so that the lowest is 0. Runs that are not eligible, such as crashes
    between NPCs, are never selected, unless there are no others or all others have the same negative fitness.
    """
    fitness = np.array([_weight(member) or LEAST_WEIGHT for member in population])
    finite = np.isfinite(fitness)
    low = min(0.0, float(fitness[finite].min(initial=0.0)))
    weights = np.where(finite, fitness - low, 0.0)
    total = float(weights.sum())
    shares = weights / total if 0 < total < math.inf else np.full(len(population), 1 / len(population))
    return tuple(population[int(index)] for index in rng.choice(len(population), size=len(population), p=shares))


def farthest(candidates: Sequence[Scenario], checkpoints: FloatArray, count: int) -> tuple[Scenario, ...]:
    """Return the ``count`` candidates with the greatest mean distance to earlier scenarios, the first of equals.

    The earlier scenarios, ``checkpoints``, are given by their :func:`features`, shape [scenarios, NPCs, slices, 2].
    """
    of_all = np.ascontiguousarray(np.moveaxis(checkpoints, 0, -1))  # in memory, each number of all scenarios in a row
    checkpoints = np.moveaxis(of_all, -1, 0)
    by_distance = sorted(candidates, key=lambda each: -float(np.mean(distance(features(each), checkpoints))))
    return tuple(by_distance[:count])


def features(scenario: Scenario) -> FloatArray:
    """Return the numbers by which AV-Fuzzer compares scenarios, shape [NPCs, slices, 2].

    For each slice: the sum of the speeds so far, and the sum of -34 per change to the left and 34 per change to the
    right.
    """
    rows = [
        [(gene.speed, LANE_CHANGE * gene.column) for gene in chain if isinstance(gene, LaneInstruction)]
        for chain in scenario.npcs
    ]
    return np.cumsum(np.array(rows, dtype=np.float64), axis=1)


def distance(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the distance between scenarios: Euclidean per slice, summed over slices, then the mean over NPCs.

    ``a`` and ``b`` are :func:`features`; ``b`` may be those of many scenarios.
    """
    total = np.zeros(b.shape[:-3])
    # A loop over few NPCs and slices is faster than numpy's sums over short axes.
    for npc, slices in enumerate(a):
        along = np.zeros(b.shape[:-3])
        for index, (speed, change) in enumerate(slices):
            faster, aside = b[..., npc, index, 0] - speed, b[..., npc, index, 1] - change
            along += np.sqrt(faster * faster + aside * aside)
        total += along
    mean: FloatArray = total / len(a)
    return mean


def _weight(evaluation: Evaluation) -> float:
    return evaluation.fitness if evaluation.eligible else -math.inf
