"""Random search, and a base class for algorithms that draw whole generations."""

import numpy as np
import pytest

from pytest_pafot.searching.algorithms.catalogue import RandomSearch
from pytest_pafot.searching.evaluation import GenerationFinished, NewBest
from pytest_pafot.searching.space import SearchSpace
from tests.helpers.campaigns import Fresh


def test_a_scenario_depends_on_seed_and_number_alone():
    search = RandomSearch(SearchSpace(most_npcs=(5,)))
    drawn = [search.drawn(7, number) for number in range(1000)]
    assert len(set(drawn)) == 1000
    order = np.random.default_rng(0).permutation(1000)
    assert [search.drawn(7, int(number)) for number in order] == [drawn[number] for number in order]
    assert search.drawn(8, 3) not in drawn


def test_a_new_best_is_reported_once(make_evaluation):
    search, rng = Fresh(population=2), np.random.default_rng(1)
    state, kinds = search.start(rng), []
    for fitness in (1.0, 1.0, 2.0, float("nan")):
        state, asked = search.ask(state, rng)
        state, events = search.tell(state, [make_evaluation(s, fitness=fitness) for s in asked], rng)
        kinds.append([type(event) for event in events])
    news = [GenerationFinished, NewBest]
    assert kinds == [news, [GenerationFinished], news, [GenerationFinished]]


def test_an_empty_population_is_refused():
    with pytest.raises(ValueError, match="population: expected a count from 1 to 10000, received 0"):
        Fresh(population=0)
