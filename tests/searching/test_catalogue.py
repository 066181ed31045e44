"""What the room offers by name."""

import pytest

from pytest_pafot import searching
from pytest_pafot.searching import ALGORITHMS, PafotSearch, RandomSearch, SearchSpace, algorithm_named

SPACE = SearchSpace(npcs=3)


def test_everything_in_the_catalogue_is_there():
    assert all(hasattr(searching, name) for name in searching.__all__)


def test_algorithms_are_found_by_name():
    assert algorithm_named("pafot", SPACE, population=6) == PafotSearch(SPACE, population=6)
    assert algorithm_named("random", SPACE) == RandomSearch(SPACE)
    assert [algorithm_named(name, SPACE).name for name in ALGORITHMS] == list(ALGORITHMS)


def test_an_unknown_name_is_answered_with_those_that_exist():
    with pytest.raises(ValueError, match="algorithm: expected one of distinct, pafot, random, received 'genetic'"):
        algorithm_named("genetic", SPACE)


def test_an_unknown_parameter_is_answered_with_those_that_exist():
    with pytest.raises(ValueError, match="mutation_rate: expected a parameter of the algorithm 'random', which takes"):
        algorithm_named("random", SPACE, mutation_rate=0.5)
