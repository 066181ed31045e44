"""PAFOT: the paper's genetic algorithm with its local fuzzer and restarts.

Source: Crespo-Rodriguez, Neelofar, Aleti, "PAFOT", AST 2024, section 3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import ClassVar

from numpy.random import Generator

from pytest_pafot.algorithms.evaluation import (
    Evaluation,
    EvaluationCache,
    Events,
    GenerationFinished,
    LocalSearchStarted,
    NewBest,
    Population,
    Restarted,
)
from pytest_pafot.algorithms.operators import best_of, breed, elites, improves, mutate, parents
from pytest_pafot.algorithms.plan import (
    check_ask,
    check_evaluations,
    check_parameters,
    end_of_local_search,
)
from pytest_pafot.algorithms.space import SearchSpace, sample
from pytest_pafot.model.scenario import Scenario


@dataclass(frozen=True, slots=True, kw_only=True)
class PafotState:
    """The state of a PAFOT search."""

    # generation of the main search, from 0; it advances after each generation's local search
    generation: int = 0
    # 0 in the main search; a local search starts at 1, the generation of the mutants
    local_generation: int = 0
    population: Population = ()  # population of the main search
    local_population: Population = ()  # population of the current local search
    # the best since the last restart; None before the first eligible run
    best: Evaluation | None = None
    restarted_at: int = 0  # the generation whose population was random
    improved_at: int = 0  # the last generation that set a new best, or ``restarted_at``
    kept: Population = ()  # evaluated members that the next population keeps
    fresh: tuple[Scenario, ...] = ()  # scenarios that the next ask returns instead of breeding
    # scenarios under evaluation; None if the next call must be ask
    asked: tuple[Scenario, ...] | None = None


@dataclass(frozen=True, slots=True)
class PafotSearch:
    """The paper's search, with the parameters from the paper as defaults.

    Attributes:
        space: space from which scenarios are sampled.
        population: number of scenarios in a generation.
        crossover_rate: probability p_c that a pair of parents swaps two NPCs.
        mutation_rate: probability p_m that one instruction of a child is replaced.
        elite_share: fraction of the population that is kept unchanged, rounded up.
        local_generations: number of generations in a local search after its mutants; 0 disables local searches.
        local_mutation_factor: factor by which a local search multiplies the mutation rate.
        local_after: number of generations without local searches after each random population.
        restart_after: number of generations without a new best scenario before a restart.
        breeding_attempts: number of times a child is bred again if its run is already known.
    """

    name: ClassVar[str] = "pafot"
    is_papers: ClassVar[bool] = True

    space: SearchSpace = field(default_factory=SearchSpace)
    _: KW_ONLY
    # the paper gives no number, but its totals imply 4
    population: int = 4
    crossover_rate: float = 0.5
    mutation_rate: float = 0.5
    elite_share: float = 0.25
    # With a population of 4, a local search requests 3 mutants and 3 children; the paper's totals imply about 5
    # scenarios.
    local_generations: int = 1
    local_mutation_factor: float = 1.5
    local_after: int = 2
    restart_after: int = 5
    # A run is known if the child equals a member of the population, or differs only in genes after the end of the run.
    # In the paper's simulator, another run could show something new. Here, runs are deterministic.
    breeding_attempts: int = 20

    def __post_init__(self) -> None:
        if self.population < 2:
            raise ValueError(
                f"population: expected at least 2, an elite and a child, but received {self.population!r}"
            )
        check_parameters(
            self,
            rates=("crossover_rate", "mutation_rate", "elite_share"),
            factors=("local_mutation_factor",),
            local_generations=0,
            local_after=0,
            restart_after=1,
            breeding_attempts=0,
        )
        if self.elite_share * self.population > self.population - 1:
            raise ValueError(
                f"elite_share: expected a fraction that leaves room for a child in a population of {self.population}, "
                f"but received {self.elite_share!r}. Use at most {1 - 1 / self.population:.2g}."
            )

    def start(self, rng: Generator) -> PafotState:
        # The first population is random and valid (section 3.2).
        return PafotState(fresh=self._random_population(rng))

    def ask(self, state: PafotState, rng: Generator) -> tuple[PafotState, tuple[Scenario, ...]]:
        check_ask(state.asked)
        if not state.fresh:
            state = self._breed(state, rng)
        return replace(state, asked=state.fresh, fresh=()), state.fresh

    def tell(
        self,
        state: PafotState,
        evaluations: Sequence[Evaluation],
        rng: Generator,
    ) -> tuple[PafotState, Events]:
        check_evaluations(state.asked, evaluations)
        finished = GenerationFinished(
            generation=state.generation,
            local_generation=state.local_generation,
            population=(*state.kept, *evaluations),
            elites=len(state.kept),
        )
        state = replace(state, kept=(), asked=None)
        if state.local_generation:
            state, events = self._after_local_generation(state, finished.population)
        else:
            state, events = self._after_generation(state, finished.population, rng)
        return state, (finished, *events)

    def _random_population(self, rng: Generator) -> tuple[Scenario, ...]:
        return tuple(sample(self.space, rng) for _ in range(self.population))

    def _breed(self, state: PafotState, rng: Generator) -> PafotState:
        population = state.population
        crossover_rate = self.crossover_rate
        mutation_rate = self.mutation_rate
        if state.local_generation:
            # A local search only mutates (section 3.6: "a mutation-based fuzzing process").
            population = state.local_population
            crossover_rate = 0.0
            mutation_rate = min(1.0, mutation_rate * self.local_mutation_factor)
        kept = elites(population, self.elite_share)
        known = EvaluationCache(population)
        children: list[Scenario] = []
        attempts = self.breeding_attempts * self.population
        missing = self.population - len(kept)
        while len(children) < missing:
            # Parents are bred as executed, including the repairs during their runs (section 2.1).
            driven = (parent.executed for parent in parents(population, rng))
            pair = breed(driven, self.space, crossover_rate, mutation_rate, rng)
            children += [child for child in pair if attempts <= 0 or known.recall(child) is None]
            attempts -= 1
        return replace(state, kept=kept, fresh=tuple(children[:missing]))

    def _mutant(self, incumbent: Evaluation, known: EvaluationCache, rng: Generator) -> Scenario:
        """Return a mutant of the incumbent, if possible one that has not been run."""
        for _ in range(self.breeding_attempts):
            mutant = mutate(incumbent.executed, self.space, rng)
            if known.recall(mutant) is None:
                return mutant
        return mutate(incumbent.executed, self.space, rng)

    def _after_generation(
        self,
        state: PafotState,
        population: Population,
        rng: Generator,
    ) -> tuple[PafotState, Events]:
        generation = state.generation
        candidate = best_of(population)
        state = replace(state, population=population)
        if candidate is not None and improves(candidate, state.best):
            best = NewBest(generation=generation, local_generation=0, evaluation=candidate)
            state = replace(state, best=candidate, improved_at=generation)
            if self.local_generations == 0 or generation <= state.restarted_at + self.local_after:
                return replace(state, generation=generation + 1), (best,)
            # The local population consists of the incumbent, and of mutants that differ from it by one mutation each.
            known = EvaluationCache([candidate])
            mutants = [self._mutant(candidate, known, rng) for _ in range(self.population - 1)]
            state = replace(state, local_generation=1, kept=(candidate,), fresh=tuple(mutants))
            return state, (best, LocalSearchStarted(generation=generation, incumbent=candidate))
        after = generation + 1
        stagnant = generation - state.improved_at
        if stagnant < self.restart_after:
            return replace(state, generation=after), ()
        fresh = self._random_population(rng)
        state = PafotState(generation=after, restarted_at=after, improved_at=after, fresh=fresh)
        return state, (Restarted(generation=after, stagnant=stagnant),)

    def _after_local_generation(
        self,
        state: PafotState,
        population: Population,
    ) -> tuple[PafotState, Events]:
        local_generation = state.local_generation
        if local_generation <= self.local_generations:
            after = replace(
                state,
                local_generation=local_generation + 1,
                local_population=population,
            )
            return after, ()
        # The best of the local search replaces the incumbent in the main population, if it is better (section 3.6).
        incumbent = state.best
        candidate = best_of(population)
        assert incumbent is not None, "a local search starts from a best"  # noqa: S101
        better = candidate if improves(candidate, incumbent) else None
        best = better or incumbent
        after = replace(
            state,
            generation=state.generation + 1,
            local_generation=0,
            local_population=(),
            population=tuple(
                best if member is incumbent else member for member in state.population
            ),
            best=best,
        )
        return after, end_of_local_search(state, incumbent, better)
