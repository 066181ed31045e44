"""AV-Fuzzer, the baseline of the paper's evaluation: a genetic algorithm over manoeuvres, without a grid.

Source: Li et al., "AV-FUZZER: Finding Safety Violations in Autonomous Driving Systems", ISSRE 2020.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

import numpy as np
from numpy.random import Generator

from pytest_pafot.algorithms.evaluation import (
    AlgorithmEvent,
    Evaluation,
    GenerationFinished,
    LocalSearchStarted,
    NewBest,
    Restarted,
)
from pytest_pafot.algorithms.plan import (
    check_ask,
    check_evaluations,
    check_parameters,
    end_of_local_search,
)
from pytest_pafot.algorithms.space import SearchSpace, sample_manoeuvres
from pytest_pafot.model.instructions import LaneInstruction
from pytest_pafot.model.scenario import Chromosome, Scenario
from pytest_pafot.model.trace import FloatArray

# The values of `lane` in a Lane-Instruction.
ACTIONS: tuple[Literal["keep", "left", "right"], ...] = ("keep", "left", "right")
# weight of a lane change in the distance between two scenarios; 1 m/s has the weight 1
LANE_CHANGE = 34.0
RESTART_CANDIDATES = 1000  # random scenarios from which a restart selects its population
LEAST_WEIGHT = 0.001  # replaces a fitness of 0, which the roulette would never select


@dataclass(frozen=True, slots=True, kw_only=True)
class AvFuzzerState:
    """The state of an AV-Fuzzer search."""

    generation: int = 0  # generation of the main search; 0 is the first random population
    # 0 in the main search; a local search starts at 1, the generation of the mutants
    local_generation: int = 0
    # the members that the last generation selected; empty before a random population
    population: tuple[Evaluation, ...] = ()
    local_population: tuple[Evaluation, ...] = ()  # the same for the current local search
    global_best: Evaluation | None = None  # the fittest of all generations; it survives restarts
    local_best: Evaluation | None = None  # the best of the current local search
    # index of the best member of the population, which the result of a local search can replace
    slot: int = 0
    # the highest fitness of each selected population, from the last random population on
    bests: tuple[float, ...] = ()
    restarted_at: int = 0  # the generation whose population was random
    # the features of all selected populations so far, including those of local searches
    checkpoints: tuple[FloatArray, ...] = ()
    fresh: tuple[Scenario, ...] = ()  # a random population to evaluate next
    # the scenarios under evaluation, each with its position in the population; None if the next call must be ask
    asked: tuple[tuple[int, Scenario], ...] | None = None


@dataclass(frozen=True, slots=True)
class AvFuzzerSearch:
    """AV-Fuzzer's search, with the default values from its released code."""

    # It differs from the released code as follows. The five slices fill the scenario (12 s each in 60 s; the released
    # code has 3 s). Two NPCs start two seconds ahead at the ego's speed, have hard limits and give way to each other. A
    # random population is a separate generation. A collision between NPCs makes the run invalid.

    name: ClassVar[str] = "av-fuzzer"
    is_papers: ClassVar[bool] = True
    fitness: ClassVar[str] = "av-fuzzer"
    instructions: ClassVar[tuple[str, ...]] = ("lanes",)

    # The NPCs, the speed limit and the start of the scenarios. All slices together last as long as all genes of a
    # chain in this space, so that algorithms are compared over the same duration.
    space: SearchSpace = field(default_factory=SearchSpace)
    population: int = field(default=4, kw_only=True)  # number of scenarios in a generation
    # number of manoeuvres of each NPC, one per time slice
    slices: int = field(default=5, kw_only=True)
    # A generation of n scenarios has n // 2 possible crossovers, each with this probability.
    crossover_rate: float = field(default=0.4, kw_only=True)
    # probability that one manoeuvre of a scenario changes
    mutation_rate: float = field(default=0.4, kw_only=True)
    # Number of generations in a local search after its mutants; 0 disables local searches.
    local_generations: int = field(default=5, kw_only=True)
    # the resulting rate is at most 1
    local_mutation_factor: float = field(default=1.5, kw_only=True)
    # generations without local searches after a random one
    local_after: int = field(default=2, kw_only=True)
    # generations without progress before a restart
    restart_after: int = field(default=5, kw_only=True)

    def __post_init__(self) -> None:
        if self.population < 2:
            raise ValueError(
                f"population: expected at least 2 parents for crossovers, but received {self.population!r}"
            )
        rates, factors = ("crossover_rate", "mutation_rate"), ("local_mutation_factor",)
        counts = {"slices": 1, "local_generations": 0, "local_after": 0, "restart_after": 1}
        check_parameters(self, rates=rates, factors=factors, **counts)

    @property
    def sliced(self) -> SearchSpace:
        return self.space.sliced(self.slices)

    def start(self, rng: Generator) -> AvFuzzerState:
        return AvFuzzerState(
            fresh=tuple(sample_manoeuvres(self.sliced, rng) for _ in range(self.population))
        )

    def ask(
        self, state: AvFuzzerState, rng: Generator
    ) -> tuple[AvFuzzerState, tuple[Scenario, ...]]:
        check_ask(state.asked)
        # Members that were selected neither for crossover nor for mutation are not run again. That can be all members.
        asked = tuple(enumerate(state.fresh)) if state.fresh else self._vary(state, rng)
        return replace(state, asked=asked, fresh=()), tuple(scenario for _, scenario in asked)

    def tell(
        self, state: AvFuzzerState, evaluations: Sequence[Evaluation], rng: Generator
    ) -> tuple[AvFuzzerState, tuple[AlgorithmEvent, ...]]:
        check_evaluations(
            None if state.asked is None else [scenario for _, scenario in state.asked], evaluations
        )
        population = list(state.local_population if state.local_generation else state.population)
        is_random = not population
        # An index at the end of the list appends, which fills a random population.
        for (index, _), evaluation in zip(state.asked or (), evaluations, strict=True):
            population[index : index + 1] = [evaluation]
        finished = GenerationFinished(
            generation=state.generation,
            local_generation=state.local_generation,
            population=tuple(population),
            elites=len(population) - len(evaluations),
        )
        state = replace(state, asked=None)
        # A random population and the mutants of an incumbent are varied without selection.
        selected = tuple(population)
        if not is_random and state.local_generation != 1:
            selected = roulette(selected, rng)
        seen = np.stack([features(member.scenario) for member in selected])
        state = replace(state, checkpoints=(*state.checkpoints, seen))
        step = self._after_local_generation if state.local_generation else self._after_generation
        state, events = step(state, selected, rng)
        return state, (finished, *events)

    def _vary(self, state: AvFuzzerState, rng: Generator) -> tuple[tuple[int, Scenario], ...]:
        is_local = state.local_generation > 0
        members = state.local_population if is_local else state.population
        scenarios = [member.scenario for member in members]
        # A local search starts with copies of the incumbent. Each copy gets one mutation.
        if state.local_generation == 1:
            return tuple(
                enumerate([mutate_manoeuvre(scenario, self.space, rng) for scenario in scenarios])
            )
        rate = (
            min(1.0, self.mutation_rate * self.local_mutation_factor)
            if is_local
            else self.mutation_rate
        )
        touched: set[int] = set()
        for _ in range(len(scenarios) // 2):
            if rng.random() < self.crossover_rate:
                first, second = (
                    int(index) for index in rng.choice(len(scenarios), size=2, replace=False)
                )
                scenarios[first], scenarios[second] = swap_npc(
                    scenarios[first], scenarios[second], rng
                )
                touched |= {first, second}
        for index, scenario in enumerate(scenarios):
            if rng.random() < rate:
                scenarios[index] = mutate_manoeuvre(scenario, self.space, rng)
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
        # The search restarts if the best fitness is not above the mean of the last generations.
        stagnant = earlier[-self.restart_after :]
        if age >= self.restart_after and sum(stagnant) / len(stagnant) >= fitness:
            events.append(Restarted(generation=generation + 1, stagnant=self.restart_after))
            candidates = [sample_manoeuvres(self.sliced, rng) for _ in range(RESTART_CANDIDATES)]
            fresh, after = (
                farthest(candidates, np.concatenate(state.checkpoints), self.population),
                generation + 1,
            )
            state = replace(
                state, generation=after, population=(), restarted_at=after, bests=(), fresh=fresh
            )
            return state, tuple(events)
        # A local search needs a new best since the last restart, and enough generations since then.
        improves = fitness > max(earlier, default=-math.inf)
        incumbent = state.global_best
        if (
            age == 0
            or not improves
            or age <= self.local_after
            or self.local_generations == 0
            or incumbent is None
        ):
            return replace(state, generation=generation + 1), tuple(events)
        events.append(LocalSearchStarted(generation=generation, incumbent=incumbent))
        copies = (incumbent,) * self.population
        return replace(state, local_generation=1, local_population=copies, local_best=None), tuple(
            events
        )

    def _after_local_generation(
        self, state: AvFuzzerState, selected: tuple[Evaluation, ...], rng: Generator
    ) -> tuple[AvFuzzerState, tuple[AlgorithmEvent, ...]]:
        best = max((*selected, *filter(None, [state.local_best])), key=_weight)
        state = replace(state, local_population=selected, local_best=best)
        if state.local_generation <= self.local_generations:
            return replace(state, local_generation=state.local_generation + 1), ()
        incumbent = state.global_best
        assert incumbent is not None, "a local search starts from a best"  # noqa: S101
        # The result replaces the best member of the main population only if it beats the best of the whole search.
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


def swap_npc(a: Scenario, b: Scenario, rng: Generator) -> tuple[Scenario, Scenario]:
    """Swap the NPCs with the same random index in two scenarios."""
    npc = int(rng.integers(len(a.npcs)))
    return _replace_chain(a, npc, b.npcs[npc]), _replace_chain(b, npc, a.npcs[npc])


def mutate_manoeuvre(scenario: Scenario, space: SearchSpace, rng: Generator) -> Scenario:
    """Give one random manoeuvre of a random NPC a new speed or a new action, or leave it unchanged."""
    npc = int(rng.integers(len(scenario.npcs)))
    chain = scenario.npcs[npc]
    index = int(rng.integers(len(chain)))
    gene = chain[index]
    assert isinstance(gene, LaneInstruction), "AV-Fuzzer's scenarios have Lane-Instructions"  # noqa: S101
    kind = int(rng.integers(3))
    if kind == 0:
        # Speeds are uniform over steps of 0.1 m/s, as in sample_manoeuvres.
        gene = replace(gene, speed=int(rng.integers(space.low_step, space.top_step + 1)) / 10)
    elif kind == 1:
        gene = replace(gene, lane=ACTIONS[int(rng.integers(len(ACTIONS)))])
    return _replace_chain(scenario, npc, (*chain[:index], gene, *chain[index + 1 :]))


def _replace_chain(scenario: Scenario, npc: int, chain: Chromosome) -> Scenario:
    return replace(scenario, npcs=(*scenario.npcs[:npc], chain, *scenario.npcs[npc + 1 :]))


def roulette(population: Sequence[Evaluation], rng: Generator) -> tuple[Evaluation, ...]:
    """Sample a population of the same size with replacement, with probabilities proportional to fitness."""
    # If a fitness is negative, all are raised until the lowest is 0. Runs that are not eligible, such as collisions
    # between NPCs, are selected only if all other runs have the same negative fitness, or if there are no others.
    fitness = np.array([_weight(member) or LEAST_WEIGHT for member in population])
    finite = np.isfinite(fitness)
    low = min(0.0, float(fitness[finite].min(initial=0.0)))
    weights = np.where(finite, fitness - low, 0.0)
    total = float(weights.sum())
    shares = (
        weights / total if 0 < total < math.inf else np.full(len(population), 1 / len(population))
    )
    return tuple(
        population[int(index)]
        for index in rng.choice(len(population), size=len(population), p=shares)
    )


def farthest(
    candidates: Sequence[Scenario], checkpoints: FloatArray, count: int
) -> tuple[Scenario, ...]:
    """Return the ``count`` candidates with the greatest mean distance to earlier scenarios.

    ``checkpoints`` contains the :func:`features` of these scenarios, as an array of shape [scenarios, NPCs, slices, 2].
    """
    # makes the values of all scenarios contiguous
    of_all = np.ascontiguousarray(np.moveaxis(checkpoints, 0, -1))
    checkpoints = np.moveaxis(of_all, -1, 0)
    by_distance = sorted(
        candidates, key=lambda each: -float(np.mean(distance(features(each), checkpoints)))
    )
    return tuple(by_distance[:count])


def features(scenario: Scenario) -> FloatArray:
    """Return the numbers by which AV-Fuzzer compares scenarios, as an array of shape [NPCs, slices, 2]."""
    rows = [
        # Per slice: the speed, and -34 for a change to the left or 34 for a change to the right. Both are accumulated
        # below.
        [
            (gene.speed, LANE_CHANGE * gene.column)
            for gene in chain
            if isinstance(gene, LaneInstruction)
        ]
        for chain in scenario.npcs
    ]
    return np.cumsum(np.array(rows, dtype=np.float64), axis=1)


def distance(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the distances between the :func:`features` of one scenario and of others."""
    # The distance is Euclidean in each slice, summed over the slices and averaged over the NPCs.
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
