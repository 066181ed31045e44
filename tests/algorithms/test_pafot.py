"""PAFOT's parts act exactly when and as often as they should."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.algorithms.evaluation import (
    EvaluationCache,
    GenerationFinished,
    LocalSearchFinished,
    LocalSearchStarted,
    NewBest,
    Restarted,
)
from pytest_pafot.algorithms.pafot import PafotSearch, PafotState
from pytest_pafot.algorithms.space import SearchSpace
from pytest_pafot.model.instructions import PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Outcome
from tests.helpers.tables import table


class Driver:
    """Drive a search generation by generation, with given fitnesses."""

    def __init__(self, make_evaluation, search=None, seed=0):
        self.make_evaluation = make_evaluation
        self.search = search or PafotSearch()
        self.rng = np.random.default_rng(seed)
        self.state = self.search.start(self.rng)
        self.asked = ()

    def round(self, *fitnesses, **fields):
        """Ask and tell once; the last fitness applies to all further scenarios."""
        self.state, self.asked = self.search.ask(self.state, self.rng)
        given = [*fitnesses, *[fitnesses[-1]] * len(self.asked)]
        evaluations = [
            self.make_evaluation(scenario, fitness=fitness, **fields)
            for scenario, fitness in zip(self.asked, given, strict=False)
        ]
        self.state, events = self.search.tell(self.state, evaluations, self.rng)
        return events


@pytest.fixture
def driver(make_evaluation):
    return Driver(make_evaluation)


def kinds(events):
    return [type(event) for event in events]


def test_the_defaults_are_the_papers_numbers():
    search = PafotSearch()
    assert (search.population, search.crossover_rate, search.mutation_rate, search.elite_share) == (
        4,
        0.5,
        0.5,
        0.25,
    )
    assert (search.local_generations, search.local_mutation_factor, search.restart_after) == (
        1,
        1.5,
        5,
    )


def test_one_elite_of_four_survives_without_new_run(driver):
    (first, *_) = driver.round(1.0, 3.0, 2.0, 0.0)
    (second, *_) = driver.round(0.5)
    assert len(driver.asked) == 3
    assert second.elites == 1
    assert second.population[0] is first.population[1]


@given(st.integers(2, 9), st.integers(0, 2**32))
def test_every_generation_has_the_full_population(make_evaluation, size, seed):
    driver = Driver(make_evaluation, PafotSearch(population=size), seed)
    for fitness in (1.0, 0.5, 0.0):
        (finished, *_) = driver.round(fitness)
        assert len(finished.population) == size
        assert finished.elites == len(finished.population) - len(driver.asked)


@given(st.lists(st.booleans(), min_size=1, max_size=40), st.integers(0, 5), st.integers(1, 6))
def test_local_searches_and_restarts_come_on_schedule(
    make_evaluation, improvements, local_after, restart_after
):
    search = PafotSearch(local_after=local_after, restart_after=restart_after)
    driver = Driver(make_evaluation, search)
    random_at = best_at = 0
    for generation, improves in enumerate(improvements):
        new_best = improves or generation == random_at
        events = kinds(driver.round(float(generation) if new_best else -1.0))
        best_at = generation if new_best else best_at
        assert (NewBest in events) == new_best
        assert (LocalSearchStarted in events) == (new_best and generation > random_at + local_after)
        assert (Restarted in events) == (generation - best_at >= restart_after)
        if LocalSearchStarted in events:
            assert kinds(driver.round(-1.0)) == [GenerationFinished]
            assert kinds(driver.round(-1.0)) == [GenerationFinished, LocalSearchFinished]
        if Restarted in events:
            random_at = best_at = generation + 1
        assert driver.state.generation == generation + 1


def test_a_restart_forgets_the_population_and_its_best(driver):
    driver.round(9.0)
    for _ in range(4):
        assert Restarted not in kinds(driver.round(1.0))
    (_, restarted) = driver.round(1.0)
    assert restarted == Restarted(generation=6, stagnant=5)
    (finished, new_best) = driver.round(0.5)
    assert (finished.elites, len(driver.asked)) == (0, 4)
    assert new_best.evaluation.fitness == 0.5


def start_local_search(driver):
    """Run three generations, then one that sets a new best."""
    for fitness in (4.0, 1.0, 1.0):
        driver.round(fitness)
    events = driver.round(5.0, 1.0)
    assert isinstance(events[-1], LocalSearchStarted)
    return events[-1].incumbent


def test_a_local_search_evolves_mutants_of_the_incumbent(driver):
    incumbent = start_local_search(driver)
    (mutants,) = driver.round(1.0)
    assert mutants.population[0] is incumbent
    assert len(driver.asked) == 3
    assert all(scenario.seed != incumbent.scenario.seed for scenario in driver.asked)
    for mutant in driver.asked:
        speeds = [
            [a.speed != b.speed for a, b in zip(*chains, strict=True)]
            for chains in zip(mutant.npcs, incumbent.executed.npcs, strict=True)
        ]
        assert sum(map(sum, speeds)) <= 1


def test_main_search_pauses_during_a_local_search(driver):
    start_local_search(driver)
    paused = driver.state.population, driver.state.generation
    for local_generation in (1, 2):
        assert driver.state.local_generation == local_generation
        driver.round(1.0)
    assert driver.state.local_generation == 0
    assert driver.state.population == paused[0]
    assert driver.state.generation == paused[1] + 1


@table("local_generations", [1, 2, 5])
def test_local_search_asks_for_three_mutants_and_children(make_evaluation, local_generations):
    driver = Driver(make_evaluation, PafotSearch(local_generations=local_generations))
    start_local_search(driver)
    asked = 0
    while driver.state.local_generation:
        driver.round(1.0)
        asked += len(driver.asked)
    assert asked == 3 + 3 * local_generations


def test_without_local_generations_there_are_no_local_searches(make_evaluation):
    driver = Driver(make_evaluation, PafotSearch(local_generations=0))
    for fitness in range(9):
        assert kinds(driver.round(float(fitness))) == [GenerationFinished, NewBest]


@pytest.mark.parametrize("found_in", [1, 2])
def test_a_better_one_takes_the_incumbents_place(driver, found_in):
    incumbent = start_local_search(driver)
    place = driver.state.population.index(incumbent)
    driver.round(*((1.0, 7.0, 1.0) if found_in == 1 else (1.0,)))
    _, new_best, finished = driver.round(*((0.0,) if found_in == 1 else (1.0, 7.0, 1.0)))
    assert finished.replaced
    assert finished.incumbent is incumbent
    assert finished.best.fitness == 7.0
    assert new_best.evaluation is finished.best
    assert driver.state.population[place] is finished.best
    assert driver.state.best is finished.best
    (next_generation, *_) = driver.round(0.0)
    assert next_generation.population[0] is finished.best


def test_equal_scenario_does_not_replace_the_incumbent(driver):
    incumbent = start_local_search(driver)
    driver.round(5.0)
    _, finished = driver.round(5.0)
    assert not finished.replaced
    assert finished.best is incumbent
    assert driver.state.best is incumbent


def bred(search, state, rounds=400):
    """Return the children of many calls of ask from the same state, in order."""
    rng = np.random.default_rng(8)
    return [search.ask(state, rng)[1] for _ in range(rounds)]


def test_half_of_the_pairs_swap_npcs(make_population, assert_rate):
    population = make_population()
    search = PafotSearch(mutation_rate=0.0, breeding_attempts=0)
    pairs = [children[:2] for children in bred(search, PafotState(population=population), 500)]
    seeds = {member.scenario.seed for member in population}
    varied = [tuple(child.seed not in seeds for child in pair) for pair in pairs]
    assert set(varied) == {(True, True), (False, False)}
    assert_rate(varied.count((True, True)), 500, 0.5)


@pytest.mark.parametrize(
    ("rate", "local", "expected"),
    [(0.5, False, 0.5), (0.5, True, 0.75), (0.2, True, 0.3), (0.2, False, 0.2)],
)
def test_children_mutate_at_the_rate_of_the_search(
    make_population, assert_rate, rate, local, expected
):
    population = make_population()
    search = PafotSearch(crossover_rate=0.0, mutation_rate=rate, breeding_attempts=0)
    state = PafotState(
        population=population, local_population=population, local_generation=2 * local
    )
    seeds = {member.scenario.seed for member in population}
    children = [child for generation in bred(search, state, 200) for child in generation]
    assert_rate(sum(child.seed not in seeds for child in children), len(children), expected)


def test_the_local_mutation_rate_is_capped_at_1(make_population):
    population = make_population()
    search = PafotSearch(crossover_rate=0.0, mutation_rate=0.8)
    state = PafotState(local_population=population, local_generation=2)
    seeds = {member.scenario.seed for member in population}
    assert all(
        child.seed not in seeds for generation in bred(search, state, 20) for child in generation
    )


def test_a_local_search_never_swaps_npcs(make_population):
    population = make_population()
    search = PafotSearch(crossover_rate=1.0, mutation_rate=0.0)
    state = PafotState(local_population=population, local_generation=2)
    known = {member.scenario for member in population}
    assert all(child in known for generation in bred(search, state, 20) for child in generation)


@pytest.mark.parametrize("local", [False, True])
def test_child_with_known_run_is_bred_again(make_population, local):
    crashed_early = tuple(replace(member, genes_started=2) for member in make_population())
    state = PafotState(
        population=crashed_early, local_population=crashed_early, local_generation=2 * local
    )
    known = EvaluationCache(crashed_early)
    children = [child for generation in bred(PafotSearch(), state, 40) for child in generation]
    assert all(known.recall(child) is None for child in children)


def test_individuals_evolve_as_they_were_driven(make_evaluation):
    driven = Scenario(npcs=((PositionInstruction(2, 1.5),),))
    driver = Driver(make_evaluation, PafotSearch(crossover_rate=0.0, mutation_rate=0.0))
    driver.round(1.0, executed=driven)
    driver.round(1.0)
    assert driver.asked == (driven,) * 3


@table("fields", [{"outcome": Outcome.INVALID}, {"discarded": True}, {"failing": True}])
def test_ineligible_run_is_neither_best_nor_elite(make_evaluation, fields):
    driver = Driver(make_evaluation)
    fitnesses = [
        float("nan") if fields.get("failing") else 9.0 + generation for generation in range(6)
    ]
    seen = []
    for fitness in fitnesses:
        (finished, *others) = driver.round(fitness, **fields)
        assert finished.elites == 0
        seen += kinds(others)
    assert seen == [Restarted]


WRONG = [
    ("population", 1),
    ("mutation_rate", float("nan")),
    ("elite_share", 0.8),
    ("local_generations", -1),
    ("local_mutation_factor", -1.0),
]


@table(("name", "value"), WRONG)
def test_a_search_that_cannot_work_is_refused(name, value):
    with pytest.raises(ValueError, match=f"^{name}: "):
        PafotSearch(SearchSpace(), **{name: value})
