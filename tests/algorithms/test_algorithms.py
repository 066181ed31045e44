"""The algorithms that can be named and those of users by class, random search, and whole generations."""

from dataclasses import dataclass, field, replace

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
    rng = np.random.default_rng(0)
    with pytest.raises(RuntimeError, match="tell: expected a state that ask returned"):
        search.tell(search.start(rng), [make_evaluation()], rng)
    state, asked = search.ask(search.start(rng), rng)
    for scenarios in (asked, ()):
        with pytest.raises(
            RuntimeError,
            match=f"ask: expected a call to tell .*, which returned {len(scenarios)} scenarios",
        ):
            search.ask(replace(state, asked=scenarios), rng)
    evaluations = [make_evaluation(scenario) for scenario in asked]
    with pytest.raises(
        ValueError, match="tell: expected 4 evaluations, one per scenario, but received 3"
    ):
        search.tell(state, evaluations[:3], rng)
    with pytest.raises(
        ValueError,
        match=r"at index 0, but received the evaluation of .*\. Pass the evaluations in the order",
    ):
        search.tell(state, evaluations[::-1], rng)


@table(("given", "message"), [
    ("genetic", r"expected one of random, pafot, .*, but received 'genetic'\. Use module:Class"),
    ("rand", r"received 'rand'. Did you mean 'random'\?"),
    ("no_such:Search", r"expected a module that can be imported, received 'no_such:Search' \(ModuleNotFoundError"),
    ("tests.algorithms.test_algorithms:Onw", r"expected a name in the module tests.algorithms.test_algorithms, "
     r"received 'tests.algorithms.test_algorithms:Onw'\. Did you mean 'tests.algorithms.test_algorithms:Own'\?"),
    ("builtins:<lambda>",
     r"in the module builtins, received 'builtins:<lambda>'\. The module defines __build_class__, __import__"),
    (RandomSearch(), r"expected one of random, .*, a class or module:Class, but received RandomSearch\(.* the class"),
    (Nameless, r"expected a class with name, start, ask and tell, but Nameless lacks start, tell and name\."),
    (GenerationalSearch, r"but GenerationalSearch lacks propose, start and name\."),
    (Borrowed, r"expected a unique name for Borrowed, but received 'pafot'"),
])  # fmt: skip
def test_wrong_algorithm_error_names_what_is_expected(given, message):
    with pytest.raises(ValueError, match=f"algorithm: .*{message}"):
        resolve_algorithm(given)


def test_option_offers_exactly_the_existing_algorithms():
    assert set(BY_NAME["algorithm"].choices) == set(ALGORITHMS)


def test_custom_fitness_is_a_function_or_its_name(make_evaluation):
    assert resolve("tests.algorithms.test_algorithms:own_fitness") == resolve(own_fitness)
    told = r"fitness: expected a name in the module .*, received .*\. Did you mean '.*:own_fitness'"
    with pytest.raises(FitnessError, match=told):
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
    with pytest.raises(
        ValueError, match="population: expected a whole number from 1 to 10000, but received 0"
    ):
        Fresh(population=0)
