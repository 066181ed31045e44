"""The default search: niches, and each kind of failure once."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from pytest_pafot.model.grid import Cell
from pytest_pafot.model.trace import Outcome
from pytest_pafot.searching import DistinctSearch, PafotSearch, RandomSearch
from pytest_pafot.searching.algorithms.distinct import niche
from pytest_pafot.searching.events import Evaluated, NewBest
from tests.helpers.campaigns import run_campaign
from tests.helpers.tables import table
from tests.helpers.traces import collision_at


class Judge:
    """Evaluate scenarios by one rule for their fitness, and one for the kind of their failure."""

    def __init__(self, make_evaluation, kind, fitness=lambda scenario: scenario.npcs[0][0].speed):
        self.make_evaluation, self.kind, self.fitness = make_evaluation, kind, fitness

    def __call__(self, scenario):
        kind = self.kind(scenario)
        return self.make_evaluation(scenario, fitness=self.fitness(scenario), failing=kind is not None, kind=kind)


def search(judge, algorithm, seed=0, generations=20):
    return list(run_campaign(algorithm, judge, generations=generations, seed=seed))


def of(kind, events):
    return [event for event in events if isinstance(event, kind)]


def crash(make_evaluation, scenario, cell, closing_speed, **fields):
    hit = replace(collision_at(30, cell=Cell(cell)), closing_speed=closing_speed)
    return make_evaluation(scenario, outcome=Outcome.COLLISION, collision=hit, **fields)


def told(algorithm, state, evaluate, rng):
    state, asked = algorithm.ask(state, rng)
    state, _ = algorithm.tell(state, [evaluate(index, scenario) for index, scenario in enumerate(asked)], rng)
    return state


def test_the_first_generations_are_random_ones(make_evaluation):
    judge = Judge(make_evaluation, lambda scenario: None)
    distinct, random = (search(judge, each, generations=5) for each in (DistinctSearch(population=4), RandomSearch()))
    assert [e.evaluation for e in of(Evaluated, distinct)] == [e.evaluation for e in of(Evaluated, random)]


def test_niche_without_impact_is_the_demand_on_ego(make_evaluation):
    demands = list(product(range(5), range(3), (False, True)))
    niches = {niche(make_evaluation(demand=demand)) for demand in demands}
    assert len(niches) == len(demands)
    assert {cell for cell, _ in niches} == {0}


def test_niche_is_impact_cell_and_closing_speed(make_evaluation):
    speeds = [0.0, 4.9, 5.0, 24.9, 25.0, 60.0]
    assert [niche(crash(make_evaluation, None, 2, speed)) for speed in speeds] == [
        (2, 0), (2, 0), (2, 1), (2, 4), (2, 5), (2, 5)
    ]  # fmt: skip


def test_the_worst_run_of_each_niche_stays(make_evaluation):
    rng, algorithm = np.random.default_rng(0), DistinctSearch(population=4)
    cells = [2, 2, 6, 6]
    first = told(algorithm, algorithm.start(rng), lambda i, s: crash(make_evaluation, s, cells[i], 3.0, fitness=i), rng)
    assert [(key, each.fitness) for key, each in first.elites] == [((2, 0), 1.0), ((6, 0), 3.0)]
    second = told(algorithm, first, lambda i, s: crash(make_evaluation, s, 2, 3.0, fitness=0.5 + i / 4), rng)
    assert [(key, each.fitness) for key, each in second.elites] == [((2, 0), 1.25), ((6, 0), 3.0)]


@table("fields", [{"outcome": Outcome.INVALID}, {"discarded": True}, {"fitness": float("nan")}])
def test_what_is_never_a_best_is_no_parent(make_evaluation, fields):
    rng, algorithm = np.random.default_rng(0), DistinctSearch(population=4)
    state = told(algorithm, algorithm.start(rng), lambda i, s: make_evaluation(s, **fields), rng)
    assert state.elites == ()


def test_what_shows_a_known_failure_is_no_parent(make_evaluation):
    rng, algorithm = np.random.default_rng(0), DistinctSearch(population=4)
    kinds = ["front", "front", None, None]

    def evaluate(index, scenario):
        return make_evaluation(scenario, fitness=9.0 - index, failing=kinds[index] is not None, kind=kinds[index])

    state = told(algorithm, algorithm.start(rng), evaluate, rng)
    assert state.kinds == {"front"}
    assert [each.fitness for _, each in state.elites] == [7.0]


def test_a_failure_that_nobody_names_cannot_be_known(make_evaluation):
    rng, algorithm = np.random.default_rng(0), DistinctSearch(population=4)
    state = told(algorithm, algorithm.start(rng), lambda i, s: make_evaluation(s, failing=True), rng)
    assert state.kinds == frozenset()
    assert len(state.elites) == 1


def test_children_differ_from_parent_in_few_instructions(make_evaluation):
    rng, algorithm = np.random.default_rng(0), DistinctSearch(population=4, crossover_rate=0.0, fresh=0.0)
    state = algorithm.start(rng)
    for _ in range(5):
        state = told(algorithm, state, lambda i, s: make_evaluation(s, fitness=s.npcs[0][0].speed), rng)
    ((_, parent),) = state.elites
    counts = set()
    for _ in range(50):
        _, children = algorithm.ask(state, rng)
        for child in children:
            pairs = zip(child.npcs, parent.executed.npcs, strict=True)
            counts.add(sum(a != b for own, other in pairs for a, b in zip(own, other, strict=True)))
    assert counts <= {0, 1, 2, 3}  # none if a later mutation reverts an earlier one
    assert {1, 2, 3} <= counts


def test_rare_failure_is_found_behind_a_frequent_one(make_evaluation):
    def slow(scenario):
        return sum(gene.speed < 7 for chain in scenario.npcs for gene in chain[:3])

    def kind(scenario):
        frequent = scenario.npcs[0][0].speed > 20
        return "frequent" if frequent else "rare" if slow(scenario) >= 5 else None

    def found(algorithm):
        judge = Judge(make_evaluation, kind, fitness=slow)
        return sum(
            any(event.evaluation.kind == "rare" for event in of(Evaluated, search(judge, algorithm, seed)))
            for seed in range(5)
        )

    assert found(DistinctSearch(population=4)) >= 1.5 * found(PafotSearch()) > 0


def test_every_best_of_a_block_is_announced_once(make_evaluation):
    events = search(Judge(make_evaluation, lambda scenario: None), DistinctSearch(population=4), generations=16)
    fitnesses = [event.evaluation.fitness for event in of(NewBest, events)]
    assert fitnesses == sorted(set(fitnesses))
    assert fitnesses[-1] == max(event.evaluation.fitness for event in of(Evaluated, events))


@table(
    ("parameters", "message"),
    [
        ({"population": 0}, "population: expected a count from 1 to 10000, received 0"),
        ({"random_runs": 0}, "random_runs: expected a count of at least 1, received 0"),
        ({"most_mutations": 0}, "most_mutations: expected a count of at least 1, received 0"),
        ({"crossover_rate": 1.5}, "crossover_rate: expected a number from 0 to 1, received 1.5"),
    ],
)
def test_a_search_that_cannot_work_is_refused(parameters, message):
    with pytest.raises(ValueError, match=message):
        DistinctSearch(**parameters)


def test_worst_margin_of_each_check_survives_any_fitness(make_evaluation):
    algorithm, rng = DistinctSearch(population=4), np.random.default_rng(0)
    margins = [{"jerk": 0.5, "gap": 0.1}, {"jerk": 0.2}, {"gap": 0.9}, {}]

    def judged(index, scenario):
        return make_evaluation(scenario, fitness=float(index), margins=tuple(margins[index].items()))

    state = told(algorithm, algorithm.start(rng), judged, rng)
    kept = {name: [-each.fitness for _, each in elites] for name, elites in state.strained.items()}
    assert kept == {"gap": [0.1], "jerk": [0.2]}
    worst, *checks = algorithm.parents(state)
    assert [each.fitness for each in worst] == [3.0]
    assert [[-each.fitness for each in group] for group in checks] == [[0.1], [0.2]]


def test_failed_check_is_not_climbed_any_further(make_evaluation):
    algorithm, rng = DistinctSearch(population=4), np.random.default_rng(0)

    def judged(index, scenario):
        failed = index == 2
        fields = {"failing": failed, "kind": "jerk" if failed else None, "mistake": "jerk" if failed else None}
        return make_evaluation(scenario, margins=(("gap", 0.5), ("jerk", 0.1 - failed)), **fields)

    state = told(algorithm, algorithm.start(rng), judged, rng)
    assert list(state.strained) == ["gap"]
    assert all(not each.failing for group in algorithm.parents(state) for each in group)
