"""The default search is the paper's, until it has found a kind of failure."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.searching import DistinctSearch, PafotSearch, run_campaign
from pytest_pafot.searching.events import Evaluated, GenerationFinished, LocalSearchStarted, Restarted


class Judge:
    """Evaluates scenarios by a rule for their fitness, and one for the kind in which they fail."""

    def __init__(self, make_evaluation, kind, fitness=lambda scenario: scenario.npcs[0][0].speed):
        self.make_evaluation, self.kind, self.fitness = make_evaluation, kind, fitness

    def __call__(self, scenarios):
        return [self._one(scenario) for scenario in scenarios]

    def _one(self, scenario):
        kind = self.kind(scenario)
        fitness = self.fitness(scenario)
        return self.make_evaluation(scenario, fitness=fitness, failing=kind is not None, kind=kind)


def search(tester, algorithm, seed=0, generations=12):
    return list(run_campaign(algorithm, tester, generations=generations, seed=seed))


def of(kind, events):
    return [event for event in events if isinstance(event, kind)]


@given(st.integers(0, 50))
def test_while_nothing_fails_it_is_the_papers_search(make_evaluation, seed):
    tester = Judge(make_evaluation, lambda scenario: None)
    distinct, pafot = search(tester, DistinctSearch(), seed), search(tester, PafotSearch(), seed)
    assert distinct[1:] == pafot[1:]


def test_failures_of_no_known_kind_are_the_papers_search_too(make_evaluation):
    """A failure that nobody can name cannot be known."""

    def unnamed(scenarios):
        return [make_evaluation(each, fitness=each.npcs[0][0].speed, failing=True) for each in scenarios]

    distinct, pafot = search(unnamed, DistinctSearch()), search(unnamed, PafotSearch())
    assert distinct[1:] == pafot[1:]


def test_a_new_kind_is_followed_by_a_random_population(make_evaluation):
    events = search(Judge(make_evaluation, lambda scenario: "crash"), DistinctSearch())
    assert of(Restarted, events)[0] == Restarted(generation=1, stagnant=0)
    second = [event for event in of(Evaluated, events) if event.generation == 1]
    assert len(second) == 4, "no elite passes on"
    assert [event.generation for event in of(LocalSearchStarted, events)] == []


def test_a_kind_is_new_once(make_evaluation):
    events = search(Judge(make_evaluation, lambda scenario: "crash"), DistinctSearch(), generations=20)
    assert [event.stagnant for event in of(Restarted, events)].count(0) == 1


def test_a_known_failure_is_worth_less_than_any_run_that_does_not_fail(make_evaluation):
    rng = np.random.default_rng(0)
    algorithm = DistinctSearch()
    state = algorithm.start(rng)
    state, asked = algorithm.ask(state, rng)
    state, _ = algorithm.tell(state, [make_evaluation(each, failing=True, kind="crash") for each in asked], rng)
    state, asked = algorithm.ask(state, rng)
    told = [make_evaluation(each, fitness=9.0, failing=True, kind="crash") for each in asked]
    told[2] = make_evaluation(asked[2], fitness=-5.0)
    told[3] = make_evaluation(asked[3], fitness=-7.0, failing=True, kind="another")
    _, (finished, *_) = algorithm.tell(state, told, rng)
    assert isinstance(finished, GenerationFinished)
    ranked = sorted(finished.population, key=lambda each: each.rank)
    assert [each.scenario for each in ranked[2:]] == [asked[2], asked[3]]
    assert {each.fitness for each in ranked[:2]} == {-math.inf}


def test_a_failure_that_takes_several_steps_is_found_behind_one_that_absorbs_the_papers_search(make_evaluation):
    def slow(scenario):
        return sum(gene.speed < 7 for chain in scenario.npcs for gene in chain[:3])

    def kind(scenario):
        frequent = scenario.npcs[0][0].speed > 20
        return "frequent" if frequent else "rare" if slow(scenario) >= 5 else None

    def found(algorithm):
        judge = Judge(make_evaluation, kind, fitness=slow)
        return sum(
            any(event.evaluation.kind == "rare" for event in of(Evaluated, search(judge, algorithm, seed)))
            for seed in range(20)
        )

    assert found(DistinctSearch()) >= 2 * found(PafotSearch()) > 0


def test_the_same_draws_give_the_same_search(make_evaluation):
    tester = Judge(make_evaluation, lambda scenario: "fast" if scenario.npcs[0][0].speed > 20 else None)
    assert search(tester, DistinctSearch(), 3) == search(tester, DistinctSearch(), 3)


def test_a_new_kind_in_a_local_search_ends_it(make_evaluation):
    rng = np.random.default_rng(0)
    algorithm = DistinctSearch()
    state, fitness = algorithm.start(rng), 0.0
    while not state.local_generation:
        state, asked = algorithm.ask(state, rng)
        fitness += 1.0
        state, _ = algorithm.tell(state, [make_evaluation(each, fitness=fitness) for each in asked], rng)
    before = state
    state, asked = algorithm.ask(state, rng)
    told = [make_evaluation(each, failing=True, kind="crash") for each in asked]
    state, events = algorithm.tell(state, told, rng)
    assert state.local_generation == 0
    assert state.generation == before.generation + 1
    assert events[-1] == Restarted(generation=state.generation, stagnant=0)


def test_a_population_that_cannot_be_is_refused():
    with pytest.raises(ValueError, match="population: expected at least 2"):
        replace(DistinctSearch(), population=1)
