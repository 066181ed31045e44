"""AV-Fuzzer, the baseline of the paper's evaluation: a genetic algorithm over manoeuvres, without a grid.

Source: Li et al., "AV-FUZZER: Finding Safety Violations in Autonomous Driving Systems", ISSRE 2020.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
from numpy.random import Generator

from pytest_pafot.algorithms.evaluation import (
    AlgorithmEvent,
    Evaluation,
    Events,
    GenerationFinished,
    LocalSearchStarted,
    NewBest,
    Population,
    Restarted,
)
from pytest_pafot.algorithms.operators import with_chain
from pytest_pafot.algorithms.plan import (
    check_ask,
    check_evaluations,
    check_parameters,
    end_of_local_search,
)
from pytest_pafot.algorithms.space import SearchSpace, sample_manoeuvres
from pytest_pafot.model.instructions import SHIFTS, LaneInstruction, pick
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import FloatArray

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
    population: Population = ()
    local_population: Population = ()  # the same for the current local search
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
    _: KW_ONLY
    population: int = 4  # number of scenarios in a generation
    # number of manoeuvres of each NPC, one per time slice
    slices: int = 5
    # A generation of n scenarios has n // 2 possible crossovers, each with this probability.
    crossover_rate: float = 0.4
    # probability that one manoeuvre of a scenario changes
    mutation_rate: float = 0.4
    # Number of generations in a local search after its mutants; 0 disables local searches.
    local_generations: int = 5
    # the resulting rate is at most 1
    local_mutation_factor: float = 1.5
    # generations without local searches after a random one
    local_after: int = 2
    # generations without progress before a restart
    restart_after: int = 5

    def __post_init__(self) -> None:
        if self.population < 2:
            raise ValueError(
                f"population: expected at least 2 parents for crossovers, but received {self.population!r}"
            )
        check_parameters(
            self,
            rates=("crossover_rate", "mutation_rate"),
            factors=("local_mutation_factor",),
            slices=1,
            local_generations=0,
            local_after=0,
            restart_after=1,
        )

    @property
    def sliced(self) -> SearchSpace:
        return self.space.sliced(self.slices)

    def start(self, rng: Generator) -> AvFuzzerState:
        fresh = [sample_manoeuvres(self.sliced, rng) for _ in range(self.population)]
        return AvFuzzerState(fresh=tuple(fresh))

    def ask(
        self,
        state: AvFuzzerState,
        rng: Generator,
    ) -> tuple[AvFuzzerState, tuple[Scenario, ...]]:
        check_ask(state.asked)
        asked = tuple(enumerate(state.fresh))
        if not asked:
            # Members that were selected neither for crossover nor for mutation are not run again. That can be all
            # members.
            asked = self._vary(state, rng)
        scenarios = tuple(scenario for _, scenario in asked)
        return replace(state, asked=asked, fresh=()), scenarios

    def tell(
        self,
        state: AvFuzzerState,
        evaluations: Sequence[Evaluation],
        rng: Generator,
    ) -> tuple[AvFuzzerState, Events]:
        scenarios = None
        if state.asked is not None:
            scenarios = [scenario for _, scenario in state.asked]
        check_evaluations(scenarios, evaluations)
        is_local = state.local_generation > 0
        population = list(state.local_population if is_local else state.population)
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
        step = self._after_local_generation if is_local else self._after_generation
        state, events = step(state, selected, rng)
        return state, (finished, *events)

    def _vary(self, state: AvFuzzerState, rng: Generator) -> tuple[tuple[int, Scenario], ...]:
        is_local = state.local_generation > 0
        members = state.local_population if is_local else state.population
        scenarios = [member.scenario for member in members]
        # A local search starts with copies of the incumbent. Each copy gets one mutation.
        if state.local_generation == 1:
            mutants = [mutate_manoeuvre(scenario, self.space, rng) for scenario in scenarios]
            return tuple(enumerate(mutants))
        rate = self.mutation_rate
        if is_local:
            rate = min(1.0, rate * self.local_mutation_factor)
        touched: set[int] = set()
        for _ in range(len(scenarios) // 2):
            if rng.random() < self.crossover_rate:
                first, second = rng.choice(len(scenarios), size=2, replace=False).tolist()
                children = swap_npc(scenarios[first], scenarios[second], rng)
                scenarios[first], scenarios[second] = children
                touched |= {first, second}
        for index, scenario in enumerate(scenarios):
            if rng.random() < rate:
                scenarios[index] = mutate_manoeuvre(scenario, self.space, rng)
                touched.add(index)
        return tuple((index, scenarios[index]) for index in sorted(touched))

    def _after_generation(
        self,
        state: AvFuzzerState,
        selected: Population,
        rng: Generator,
    ) -> tuple[AvFuzzerState, Events]:
        weights = [_weight(member) for member in selected]
        fitness = max(weights)
        slot = weights.index(fitness)
        best = selected[slot]
        generation = state.generation
        earlier = state.bests
        age = generation - state.restarted_at
        events: list[AlgorithmEvent] = []
        beaten = state.global_best
        if best.eligible and (beaten is None or fitness > _weight(beaten)):
            events.append(NewBest(generation=generation, local_generation=0, evaluation=best))
            state = replace(state, global_best=best)
        state = replace(state, population=selected, bests=(*earlier, fitness), slot=slot)
        # The search restarts if the best fitness is not above the mean of the last generations.
        stagnant = earlier[-self.restart_after :]
        if age >= self.restart_after and sum(stagnant) / len(stagnant) >= fitness:
            events.append(Restarted(generation=generation + 1, stagnant=self.restart_after))
            candidates = [sample_manoeuvres(self.sliced, rng) for _ in range(RESTART_CANDIDATES)]
            state = replace(
                state,
                generation=generation + 1,
                population=(),
                restarted_at=generation + 1,
                bests=(),
                fresh=farthest(candidates, np.concatenate(state.checkpoints), self.population),
            )
            return state, tuple(events)
        # A local search needs a new best since the last restart, and enough generations since then.
        improves = fitness > max(earlier, default=-math.inf)
        incumbent = state.global_best
        is_due = age > self.local_after and self.local_generations > 0
        if not improves or not is_due or incumbent is None:
            return replace(state, generation=generation + 1), tuple(events)
        events.append(LocalSearchStarted(generation=generation, incumbent=incumbent))
        copies = (incumbent,) * self.population
        state = replace(state, local_generation=1, local_population=copies, local_best=None)
        return state, tuple(events)

    def _after_local_generation(
        self,
        state: AvFuzzerState,
        selected: Population,
        rng: Generator,
    ) -> tuple[AvFuzzerState, Events]:
        best = max(selected, key=_weight)
        # of equal members, the one from the last generation counts
        if state.local_best is not None and _weight(state.local_best) > _weight(best):
            best = state.local_best
        state = replace(state, local_population=selected, local_best=best)
        if state.local_generation <= self.local_generations:
            return replace(state, local_generation=state.local_generation + 1), ()
        incumbent = state.global_best
        assert incumbent is not None, "a local search starts from a best"  # noqa: S101
        # The result replaces the best member of the main population only if it beats the best of the whole search.
        better = None
        population = list(state.population)
        if best.eligible and _weight(best) > _weight(incumbent):
            better = best
            population[state.slot] = best
        after = replace(
            state,
            generation=state.generation + 1,
            local_generation=0,
            population=tuple(population),
            local_population=(),
            local_best=None,
            global_best=better or incumbent,
        )
        return after, end_of_local_search(state, incumbent, better)


def swap_npc(a: Scenario, b: Scenario, rng: Generator) -> tuple[Scenario, Scenario]:
    """Swap the NPCs with the same random index in two scenarios."""
    npc = int(rng.integers(len(a.npcs)))
    of_a = with_chain(a.npcs, npc, b.npcs[npc])
    of_b = with_chain(b.npcs, npc, a.npcs[npc])
    return replace(a, npcs=of_a), replace(b, npcs=of_b)


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
        gene = gene.with_speed(space.choices.any_speed(rng))
    elif kind == 1:
        gene = gene.aimed(pick(SHIFTS, rng))
    changed = (*chain[:index], gene, *chain[index + 1 :])
    return replace(scenario, npcs=with_chain(scenario.npcs, npc, changed))


def roulette(population: Sequence[Evaluation], rng: Generator) -> Population:
    """Sample a population of the same size with replacement, with probabilities proportional to fitness."""
    # If a fitness is negative, all are raised until the lowest is 0. Runs that are not eligible, such as collisions
    # between NPCs, are selected only if all other runs have the same negative fitness, or if there are no others.
    fitness = np.array([_weight(member) or LEAST_WEIGHT for member in population])
    finite = np.isfinite(fitness)
    low = min(0.0, float(fitness[finite].min(initial=0.0)))
    weights = np.where(finite, fitness - low, 0.0)
    total = float(weights.sum())
    count = len(population)
    shares = np.full(count, 1 / count)
    if 0 < total < math.inf:
        shares = weights / total
    chosen = rng.choice(count, size=count, p=shares).tolist()
    return tuple(population[index] for index in chosen)


def farthest(
    candidates: Sequence[Scenario],
    checkpoints: FloatArray,
    count: int,
) -> tuple[Scenario, ...]:
    """Return the ``count`` candidates with the greatest mean distance to earlier scenarios.

    ``checkpoints`` contains the :func:`features` of these scenarios, as an array of shape [scenarios, NPCs, slices, 2].
    """
    # makes the values of all scenarios contiguous
    of_all = np.ascontiguousarray(np.moveaxis(checkpoints, 0, -1))
    checkpoints = np.moveaxis(of_all, -1, 0)

    def nearness(candidate: Scenario) -> float:
        return -float(np.mean(distance(features(candidate), checkpoints)))

    return tuple(sorted(candidates, key=nearness)[:count])


def features(scenario: Scenario) -> FloatArray:
    """Return the numbers by which AV-Fuzzer compares scenarios, as an array of shape [NPCs, slices, 2]."""
    # Per slice: the speed, and -34 for a change to the left or 34 for a change to the right. Both are accumulated.
    rows = []
    for chain in scenario.npcs:
        genes: Any = chain
        rows.append([(gene.speed, LANE_CHANGE * gene.column) for gene in genes])
    return np.cumsum(np.array(rows, dtype=np.float64), axis=1)


def distance(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the distances between the :func:`features` of one scenario and of others."""
    # The distance is Euclidean in each slice, summed over the slices and averaged over the NPCs.
    total = np.zeros(b.shape[:-3])
    # A loop over few NPCs and slices is faster than numpy's sums over short axes.
    for npc, slices in enumerate(a):
        along = np.zeros(b.shape[:-3])
        for index, (speed, change) in enumerate(slices):
            faster = b[..., npc, index, 0] - speed
            aside = b[..., npc, index, 1] - change
            along += np.sqrt(faster * faster + aside * aside)
        total += along
    mean: FloatArray = total / len(a)
    return mean


def _weight(evaluation: Evaluation) -> float:
    if evaluation.eligible:
        return evaluation.fitness
    return -math.inf
