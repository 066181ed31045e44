"""The searches that use pymoo, pyribs and cmaes, each behind the same interface."""

import sys
from collections import Counter
from itertools import pairwise

import numpy as np
import pytest

from pytest_pafot.model.grid import Cell, is_adjacent
from pytest_pafot.model.instructions import LaneInstruction, PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Collision, Outcome
from pytest_pafot.searching import ALGORITHMS, Evaluation, SearchSpace, resolve_algorithm
from pytest_pafot.searching.events import Evaluated, GenerationFinished, NewBest
from tests.helpers.campaigns import run_campaign
from tests.helpers.tables import table

NAMES = [name for name in ALGORITHMS if resolve_algorithm(name).library]


@pytest.fixture(autouse=True, scope="module")
def libraries():
    """Import all of them in the first test, since that takes a second."""
    for name in NAMES:
        pytest.importorskip(resolve_algorithm(name).library)


def hit(cell=Cell.FRONT, closing=10.0):
    return Collision(
        tick=15,
        time=1.0,
        npc=0,
        side="front",
        cell=cell,
        ego_speed=20.0,
        npc_speed=20.0 - closing,
        closing_speed=closing,
    )


@pytest.mark.parametrize("name", NAMES)
def test_scenarios_are_valid_with_distinct_cells_in_space(name, cheap_world):
    space = SearchSpace(npcs=3, genes=4, speed_limit=20.0)
    events = list(run_campaign(resolve_algorithm(name).make(space), cheap_world(genes=4), generations=12, seed=1))
    scenarios = [event.evaluation.scenario for event in events if isinstance(event, Evaluated)]
    assert len(scenarios) == 48
    for scenario in scenarios:
        assert [len(chain) for chain in scenario.npcs] == [4, 4, 4]
        assert all(gene.speed <= 20.0 for chain in scenario.npcs for gene in chain)
        assert all(is_adjacent(a.cell, b.cell) for chain in scenario.npcs for a, b in pairwise(chain))


@pytest.mark.parametrize("name", NAMES)
def test_equal_seeds_give_equal_events_and_others_differ(name, cheap_world):
    search = resolve_algorithm(name).make(SearchSpace())
    runs = [list(run_campaign(search, cheap_world(), generations=5, seed=seed)) for seed in (3, 3, 4)]
    assert runs[0] == runs[1] != runs[2]


@pytest.mark.parametrize("name", NAMES)
def test_states_are_values_and_turns_can_repeat(name, cheap_world):
    search, world = resolve_algorithm(name).make(SearchSpace()), cheap_world()
    state = search.start(np.random.default_rng(0))
    for _ in range(3):
        asked_state, asked = search.ask(state, np.random.default_rng(1))
        assert search.ask(state, np.random.default_rng(1))[1] == asked
        told = search.tell(asked_state, list(map(world, asked)), np.random.default_rng(1))
        again = search.tell(asked_state, list(map(world, asked)), np.random.default_rng(1))
        assert told[1] == again[1]
        assert search.ask(told[0], np.random.default_rng(2))[1] == search.ask(again[0], np.random.default_rng(2))[1]
        state = told[0]


@pytest.mark.oracle
@pytest.mark.parametrize("name", NAMES)
def test_it_learns(name, cheap_world):
    """The second half has more failing scenarios than random search finds.

    It counts the sum of ten seeds, because one search of CMA-ES can stick. Which one does depends on the machine, whose
    linear algebra rounds differently.
    """

    def failing(name):
        searches = (
            run_campaign(
                resolve_algorithm(name).make(SearchSpace()), cheap_world(crash_speed=25.0), generations=30, seed=seed
            )
            for seed in range(10)
        )
        events = (event for events in searches for event in events if isinstance(event, Evaluated))
        return sum(event.evaluation.failing for event in events if event.generation >= 15)

    assert failing(name) > 1.3 * failing("random")


@pytest.mark.parametrize("name", NAMES)
def test_new_bests_rise(name, cheap_world):
    events = run_campaign(resolve_algorithm(name).make(SearchSpace()), cheap_world(), generations=12, seed=1)
    ranks = [event.evaluation.rank for event in events if isinstance(event, NewBest)]
    assert ranks == sorted(set(ranks))


@table("name", NAMES)
def test_out_of_turn_is_refused(name):
    search, rng = resolve_algorithm(name).make(SearchSpace()), np.random.default_rng(0)
    state = search.start(rng)
    with pytest.raises(RuntimeError, match="tell: expected a state that ask returned"):
        search.tell(state, [], rng)
    with pytest.raises(RuntimeError, match="ask: expected tell after"):
        search.ask(search.ask(state, rng)[0], rng)


@table("name", NAMES)
def test_a_population_that_is_too_small_is_refused(name):
    with pytest.raises(ValueError, match="population: expected"):
        resolve_algorithm(name).make(SearchSpace(), population=0)


def test_cma_es_learns_from_four_and_refuses_fewer(make_evaluation):
    algorithm = resolve_algorithm("cma-es")
    for fewer in (2, 3):
        with pytest.raises(ValueError, match=f"population: expected at least 4 for cma-es, .*, received {fewer}"):
            algorithm.make(SearchSpace(), population=fewer)
    search = algorithm.make(SearchSpace(), population=4)
    events = run_campaign(search, make_evaluation, generations=3, seed=1)
    assert list(events)[-1].generations == 3


@pytest.mark.parametrize("name", NAMES)
def test_missing_library_error_says_how_to_install_it(name, monkeypatch):
    library = resolve_algorithm(name).library
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ValueError, match=f"pip install {library}"):
        resolve_algorithm(name).make(SearchSpace())


@pytest.mark.parametrize("name", NAMES)
def test_search_ends_even_if_every_run_is_invalid(name, make_evaluation):
    def invalid(scenario):
        return make_evaluation(scenario, outcome=Outcome.INVALID, fitness=-np.inf)

    events = list(run_campaign(resolve_algorithm(name).make(SearchSpace()), invalid, generations=8, seed=1))
    assert (events[-1].reason, events[-1].best) == ("generations", None)
    assert sum(isinstance(event, GenerationFinished) for event in events) == 8


def test_nsga2_prefers_what_nothing_dominates(make_evaluation, make_population):
    from pytest_pafot.extras.algorithms.nsga2 import objectives, surviving

    scenarios = [each.scenario for each in make_population(4)]
    mild, fierce, both, invalid = (
        make_evaluation(scenarios[0], fitness=1.9, collision=hit(closing=1.0)),
        make_evaluation(scenarios[1], fitness=1.1, collision=hit(closing=20.0)),
        make_evaluation(scenarios[2], fitness=1.0, collision=None),
        make_evaluation(scenarios[3], fitness=9.0, outcome=Outcome.INVALID),
    )
    values = objectives([mild, fierce, both, invalid])
    assert values[0, :2].tolist() == [-1.9, -1.0]
    assert np.all(values[3] > values[:3])
    kept = surviving([both, invalid, mild, fierce], 3, np.random.default_rng(0))
    assert {id(each) for each in kept} == {id(mild), id(fierce), id(both)}


def test_nsga2_novelty_is_distance_to_nearest_neighbour(make_evaluation, make_population):
    from pytest_pafot.extras.algorithms.nsga2 import objectives

    a, b, _ = (each.scenario for each in make_population(3))
    values = objectives([make_evaluation(a), make_evaluation(a), make_evaluation(b)])
    assert values[:2, 2].tolist() == [0.0, 0.0]
    differ = np.mean([x.cell != y.cell for p, q in zip(a.npcs, b.npcs, strict=True) for x, y in zip(p, q, strict=True)])
    assert values[2, 2] == pytest.approx(-differ)


def test_nsga2_compares_scenarios_of_different_sizes_by_time(make_evaluation):
    from pytest_pafot.extras.algorithms.nsga2 import objectives

    ahead, left = PositionInstruction(Cell.FRONT, 20.0), PositionInstruction(Cell.FRONT_LEFT, 20.0)
    alone = Scenario(npcs=[[ahead] * 2], gene_seconds=10.0)
    split = Scenario(npcs=[[ahead] * 4], gene_seconds=5.0)
    both = Scenario(npcs=[[ahead] * 4, [left] * 4], gene_seconds=5.0)
    values = objectives([make_evaluation(each) for each in (alone, split, both)])
    assert values[:, 2].tolist() == [0.0, 0.0, -0.5]


def test_nsga2_novelty_counts_lanes_as_different_from_each_other_and_cells(make_evaluation):
    from pytest_pafot.extras.algorithms.nsga2 import objectives

    genes = LaneInstruction("left", 20.0), LaneInstruction("right", 20.0), PositionInstruction(Cell.FRONT, 20.0)
    values = objectives([make_evaluation(Scenario(npcs=[[gene, gene]])) for gene in genes])
    assert values[:, 2].tolist() == [-1.0] * 3
    half = Scenario(npcs=[[genes[0], genes[1]]])
    values = objectives([make_evaluation(each) for each in (Scenario(npcs=[[genes[0]] * 2]), half)])
    assert values[:, 2].tolist() == [-0.5] * 2


def test_map_elites_retains_fittest_of_each_impact_kind(make_evaluation, make_population):
    from pytest_pafot.extras.algorithms.map_elites import MapElitesSearch

    search, rng = MapElitesSearch(population=5), np.random.default_rng(0)
    state, asked = search.ask(search.start(rng), rng)
    told = [
        make_evaluation(asked[0], fitness=1.2, collision=hit(Cell.FRONT, 2.0), outcome=Outcome.COLLISION),
        make_evaluation(asked[1], fitness=1.8, collision=hit(Cell.FRONT, 3.0), outcome=Outcome.COLLISION),
        make_evaluation(asked[2], fitness=1.1, collision=hit(Cell.FRONT, 22.0), outcome=Outcome.COLLISION),
        make_evaluation(asked[3], fitness=1.0, collision=hit(Cell.REAR, 2.0), outcome=Outcome.COLLISION),
        make_evaluation(asked[4], fitness=0.3),
    ]
    state, _ = search.tell(state, told, rng)
    assert Counter(each.fitness for each in search.parents(state)) == Counter([0.3, 1.8, 1.1, 1.0])


def test_cma_es_ranks_runs_without_fitness_worst(make_evaluation):
    from pytest_pafot.extras.algorithms.cma_es import losses

    population: list[Evaluation] = [
        make_evaluation(fitness=0.5),
        make_evaluation(fitness=-2.0),
        make_evaluation(fitness=float("nan")),
        make_evaluation(outcome=Outcome.INVALID, fitness=-np.inf),
    ]
    assert losses(population) == [-0.5, 2.0, 3.0, 3.0]
