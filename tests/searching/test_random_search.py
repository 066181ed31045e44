"""The random baseline learns nothing."""

import numpy as np
import pytest

from pytest_pafot.searching.algorithms.random_search import RandomSearch
from pytest_pafot.searching.events import GenerationFinished, NewBest


def test_every_generation_is_drawn_anew(make_evaluation):
    search = RandomSearch()
    rng = np.random.default_rng(0)
    state = search.start(rng)
    seen = set()
    for generation in range(20):
        state, asked = search.ask(state, rng)
        state, (finished, *_) = search.tell(state, [make_evaluation(scenario) for scenario in asked], rng)
        assert (finished.generation, finished.elites, len(asked)) == (generation, 0, 4)
        seen |= set(asked)
    assert len(seen) == 80


def test_results_do_not_change_what_random_search_asks(make_evaluation):
    def asked(fitness):
        search, rng = RandomSearch(), np.random.default_rng(1)
        state, first = search.ask(search.start(rng), rng)
        state, _ = search.tell(state, [make_evaluation(scenario, fitness=fitness) for scenario in first], rng)
        return first, search.ask(state, rng)[1]

    assert asked(0.0) == asked(9.0)


def test_a_new_best_is_reported_once(make_evaluation):
    search, rng = RandomSearch(population=2), np.random.default_rng(1)
    state, kinds = search.start(rng), []
    for fitness in (1.0, 1.0, 2.0, float("nan")):
        state, asked = search.ask(state, rng)
        state, events = search.tell(state, [make_evaluation(s, fitness=fitness) for s in asked], rng)
        kinds.append([type(event) for event in events])
    news = [GenerationFinished, NewBest]
    assert kinds == [news, [GenerationFinished], news, [GenerationFinished]]


def test_an_empty_population_is_refused():
    with pytest.raises(ValueError, match="population: expected a count from 1 to 10000, received 0"):
        RandomSearch(population=0)
