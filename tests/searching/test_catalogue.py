"""What the room offers by name."""

import numpy as np
import pytest

from pytest_pafot import searching
from pytest_pafot.campaign.options import BY_NAME
from pytest_pafot.searching import ALGORITHMS, PafotSearch, RandomSearch, SearchSpace, algorithm_named, fitness_of
from pytest_pafot.searching.fitness import FITNESSES

SPACE = SearchSpace(npcs=3)


def test_everything_in_the_catalogue_is_there():
    assert all(hasattr(searching, name) for name in searching.__all__)


def test_algorithms_are_found_by_name():
    assert algorithm_named("pafot", SPACE, population=6) == PafotSearch(SPACE, population=6)
    assert algorithm_named("random", SPACE) == RandomSearch(SPACE)
    assert [algorithm_named(name, SPACE).name for name in ALGORITHMS] == list(ALGORITHMS)


def test_an_unknown_name_is_answered_with_those_that_exist():
    with pytest.raises(ValueError, match=r"algorithm: expected one of distinct, pafot, .*, received 'genetic'"):
        algorithm_named("genetic", SPACE)


def test_a_name_that_nearly_exists_is_answered_with_the_near_one():
    with pytest.raises(ValueError, match=r"received 'rand'; did you mean 'random'\?"):
        algorithm_named("rand", SPACE)


def test_an_unknown_parameter_is_answered_with_those_that_exist():
    with pytest.raises(ValueError, match="mutation_rate: expected a parameter of the algorithm 'random', which takes"):
        algorithm_named("random", SPACE, mutation_rate=0.5)


def test_the_option_offers_exactly_the_algorithms_that_there_are():
    assert set(BY_NAME["algorithm"].choices) == set(ALGORITHMS)


def test_each_algorithm_has_a_fitness_of_its_own_by_default():
    own = {name: fitness_of(name) for name in ALGORITHMS if fitness_of(name) != "default"}
    assert own == {"av-fuzzer": "av-fuzzer"}
    assert all(fitness_of(name) in FITNESSES for name in ALGORITHMS)


def test_random_manoeuvres_are_drawn_anew_in_the_slices_of_av_fuzzer():
    search = algorithm_named("random-manoeuvre", SPACE)
    rng = np.random.default_rng(0)
    _, scenarios = search.ask(search.start(rng), rng)
    assert len(set(scenarios)) == 4
    for scenario in scenarios:
        assert (len(scenario.npcs), scenario.genes, scenario.gene_seconds) == (3, 5, 12.0)
        assert scenario.positions == ()
