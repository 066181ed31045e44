"""The algorithms that can be named and those of users by class, random search, and whole generations."""

from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import pytest

from pytest_pafot.algorithms import (
    ALGORITHMS,
    GenerationalSearch,
    GenerationState,
    PafotSearch,
    RandomSearch,
    SearchSpace,
    resolve_algorithm,
    sample,
)
from pytest_pafot.algorithms.av_fuzzer import AvFuzzerSearch
from pytest_pafot.algorithms.catalogue import CLASSES
from pytest_pafot.algorithms.evaluation import GenerationFinished, NewBest
from pytest_pafot.algorithms.fitness import FitnessError, resolve
from pytest_pafot.searches.options import BY_NAME
from tests.helpers.searches import Fresh, run_plan
from tests.helpers.tables import table

SPACE = SearchSpace(npcs=3)


@dataclass(frozen=True)
class Own(GenerationalSearch):
    name = "own"
    jump: float = field(default=0.5, kw_only=True)

    def start(self, rng):
        return GenerationState()

    def propose(self, state, rng):
        return state, [
            sample(self.space, rng) for _ in range(self.population if state.generation else 0)
        ]


class Structural:
    name = "structural"
    fitness = "paper"
    instructions = ("lanes",)

    def __init__(self, space, population=4):
        self.inner = Fresh(space, population=population)

    def start(self, rng):
        return self.inner.start(rng)

    def ask(self, state, rng):
        return self.inner.ask(state, rng)

    def tell(self, state, evaluations, rng):
        return self.inner.tell(state, evaluations, rng)


class Borrowed(Structural):
    name = "pafot"


class Nameless:
    def ask(self, state, rng):
        return state, ()


def own_fitness(trace):
    return trace.duration


def test_algorithms_are_found_by_name():
    assert resolve_algorithm("pafot").make(SPACE) == PafotSearch(SPACE)
    assert resolve_algorithm("random").make(SPACE) == RandomSearch(SPACE)
    assert [resolve_algorithm(name).make(SPACE).name for name in CLASSES] == list(CLASSES)
    assert [resolve_algorithm(name).name for name in CLASSES] == list(CLASSES)


def test_custom_algorithm_is_a_class_or_its_name():
    of_class = resolve_algorithm(Own)
    assert of_class.make(SPACE) == Own(SPACE)
    assert resolve_algorithm("tests.algorithms.test_algorithms:Own") == of_class
    assert (of_class.name, of_class.fitness, of_class.instructions) == (
        "own",
        "default",
        ("cells", "lanes", "both"),
    )


def test_algorithm_class_declares_fitness_and_kinds_of_instructions():
    told = resolve_algorithm(Structural)
    assert (told.fitness, told.instructions) == ("paper", ("lanes",))
    assert resolve_algorithm(PafotSearch) == resolve_algorithm("pafot")


@pytest.mark.parametrize("algorithm", [Own, Structural])
def test_custom_algorithm_is_searched_like_any_other(cheap_world, algorithm):
    events = [
        list(
            run_plan(resolve_algorithm(algorithm).make(SPACE), cheap_world(), generations=4, seed=1)
        )
        for _ in range(2)
    ]
    assert events[0] == events[1]
    assert events[0][0].algorithm == algorithm.name
    sizes = [len(event.population) for event in events[0] if isinstance(event, GenerationFinished)]
    assert sizes == [0 if algorithm is Own else 4, 4, 4, 4]


@pytest.mark.parametrize(
    "search", [PafotSearch(), AvFuzzerSearch(), Fresh()], ids=lambda search: search.name
)
def test_calls_out_of_turn_and_other_evaluations_are_refused(search, make_evaluation):
    for error, call in out_of_turn(search, make_evaluation).values():
        with pytest.raises(error, match=r"^(ask|tell): "):
            call()


def out_of_turn(search, make_evaluation):
    """Return calls of an algorithm that it refuses, with the types of the errors."""
    rng = np.random.default_rng(0)
    state, asked = search.ask(search.start(rng), rng)
    evaluations = [make_evaluation(scenario) for scenario in asked]
    ask, tell = partial(search.ask, rng=rng), partial(search.tell, rng=rng)
    return {
        "tell before ask": (RuntimeError, partial(tell, search.start(rng), evaluations)),
        "ask twice": (RuntimeError, partial(ask, state)),
        "ask twice for nothing": (RuntimeError, partial(ask, replace(state, asked=()))),
        "too few": (ValueError, partial(tell, state, evaluations[:3])),
        "another order": (ValueError, partial(tell, state, evaluations[::-1])),
    }


NO_ALGORITHMS = [
    "genetic", "rand", "no_such:Search", "tests.algorithms.test_algorithms:Onw", "tests.helpers.searches:<lambda>",
    RandomSearch(), Nameless, GenerationalSearch, Borrowed,
]  # fmt: skip


@table("given", NO_ALGORITHMS)
def test_what_is_no_algorithm_is_refused(given):
    with pytest.raises(ValueError, match=r"^algorithm: "):
        resolve_algorithm(given)


def test_option_offers_exactly_the_existing_algorithms():
    assert set(BY_NAME["algorithm"].choices) == set(ALGORITHMS)


def test_custom_fitness_is_a_function_or_its_name(make_evaluation):
    assert resolve("tests.algorithms.test_algorithms:own_fitness") == resolve(own_fitness)
    with pytest.raises(FitnessError, match=r"^fitness: .*:own_fitness'"):
        resolve("tests.algorithms.test_algorithms:own_fitnes")


def test_random_manoeuvres_are_drawn_in_av_fuzzer_slices():
    search = resolve_algorithm("random-manoeuvre").make(SPACE)
    rng = np.random.default_rng(0)
    _, scenarios = search.ask(search.start(rng), rng)
    assert len(set(scenarios)) == 4
    for scenario in scenarios:
        assert (len(scenario.npcs), scenario.genes, scenario.gene_seconds) == (3, 5, 12.0)
        assert scenario.positions == ()


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
        state, events = search.tell(
            state, [make_evaluation(s, fitness=fitness) for s in asked], rng
        )
        kinds.append([type(event) for event in events])
    news = [GenerationFinished, NewBest]
    assert kinds == [news, [GenerationFinished], news, [GenerationFinished]]


def test_an_empty_population_is_refused():
    with pytest.raises(ValueError, match=r"^population: "):
        Fresh(population=0)
