"""The operators follow sections 3.4 and 3.5 of the paper."""

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.algorithms import operators
from pytest_pafot.algorithms.operators import (
    VEHICLES,
    best_of,
    crossover,
    elites,
    improves,
    mutate,
    parents,
)
from pytest_pafot.algorithms.operators import tournament as binary_tournament
from pytest_pafot.algorithms.space import OTHERS, SearchSpace, sample
from pytest_pafot.model.instructions import PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Outcome
from tests.helpers.tables import table

seeds = st.integers(0, 2**32)
spaces = st.builds(SearchSpace, npcs=st.integers(1, 4), genes=st.integers(1, 6))


def speeds(scenario):
    return [[gene.speed for gene in chain] for chain in scenario.npcs]


def swapped(a, b, in_a, in_b):
    return [*a[:in_a], b[in_b], *a[in_a + 1 :]], [*b[:in_b], a[in_a], *b[in_b + 1 :]]


KINDS = st.sampled_from([("car", "truck"), ("car", "van", "truck", "motorcycle"), ("truck",)])


@given(
    st.builds(SearchSpace, npcs=st.integers(1, 4), genes=st.integers(1, 3), vehicles=KINDS), seeds
)
def test_a_child_has_the_vehicle_of_the_npc_that_it_gets(space, seed):
    rng = np.random.default_rng(seed)
    a, b = sample(space, rng), sample(space, rng)

    def pairs(scenario):
        return {
            (chain[0].speed, kind)
            for chain, kind in zip(scenario.npcs, scenario.all_vehicles, strict=True)
        }

    for child in crossover(a, b, rng):
        assert pairs(child) <= pairs(a) | pairs(b)
        assert set(mutate(child, space, rng).all_vehicles) <= set(space.vehicles)
        assert child.vehicles == replace(child, vehicles=child.all_vehicles).vehicles


def test_some_npcs_are_other_vehicles_and_mutations_change_them():
    rng = np.random.default_rng(1)
    space = SearchSpace(npcs=3, genes=2, vehicles=("car", "van", "truck"))
    drawn = [sample(space, rng) for _ in range(600)]
    others = sum(kind.name != "car" for each in drawn for kind in each.all_vehicles)
    assert others / 1800 == pytest.approx(OTHERS, abs=0.03)
    changed = [mutate(each, space, rng).vehicles != each.vehicles for each in drawn]
    assert sum(changed) / 600 == pytest.approx(VEHICLES, abs=0.03)


def test_without_other_vehicles_random_numbers_are_those_of_before():
    cars, as_usual = SearchSpace(vehicles="car", patterns=True), SearchSpace(patterns=True)
    one, other = np.random.default_rng(3), np.random.default_rng(3)
    for _ in range(5):
        assert mutate(sample(cars, one), cars, one) == mutate(
            sample(as_usual, other), as_usual, other
        )
    assert one.bit_generator.state == other.bit_generator.state
    assert "vehicles" not in cars.plain


@given(spaces, spaces, seeds)
def test_crossover_swaps_one_whole_npc_of_each_scenario(space_a, space_b, seed):
    rng = np.random.default_rng(seed)
    a, b = sample(space_a, rng), sample(space_b, rng)
    children = tuple(map(speeds, crossover(a, b, rng)))
    choices = product(range(space_a.npcs), range(space_b.npcs))
    assert any(swapped(speeds(a), speeds(b), *choice) == children for choice in choices)


@given(seeds)
def test_crossover_retains_cells_of_chains_that_fit(seed):
    rng = np.random.default_rng(seed)
    a, b = sample(SearchSpace(npcs=1), rng), sample(SearchSpace(npcs=1), rng)
    assert [child.npcs for child in crossover(a, b, rng)] == [b.npcs, a.npcs]


def test_crossover_takes_each_npc_with_equal_chances(assert_rate):
    rng = np.random.default_rng(1)
    a, b = sample(SearchSpace(npcs=3), rng), sample(SearchSpace(npcs=2), rng)
    found = [tuple(map(speeds, crossover(a, b, rng))) for _ in range(600)]
    for choice in product(range(3), range(2)):
        assert_rate(found.count(swapped(speeds(a), speeds(b), *choice)), 600, 1 / 6)


@given(spaces, seeds)
def test_mutation_changes_exactly_one_instruction(space, seed):
    rng = np.random.default_rng(seed)
    scenario = sample(space, rng)
    chains, mutant = scenario.npcs, mutate(scenario, space, rng).npcs
    assert [len(chain) for chain in mutant] == [len(chain) for chain in chains]
    pairs = [
        pair
        for before, after in zip(chains, mutant, strict=True)
        for pair in zip(before, after, strict=True)
    ]
    assert sum(before != after for before, after in pairs) == 1


def test_mutation_takes_each_instruction_with_equal_chances(assert_rate):
    rng = np.random.default_rng(2)
    space = SearchSpace(npcs=2, genes=3)
    scenario = sample(space, rng)
    places = [(npc, gene) for npc in range(2) for gene in range(3)]
    counts = dict.fromkeys(places, 0)
    for _ in range(1200):
        mutant = mutate(scenario, space, rng).npcs
        counts[next((n, g) for n, g in places if mutant[n][g] != scenario.npcs[n][g])] += 1
    for count in counts.values():
        assert_rate(count, 1200, 1 / 6)


@pytest.mark.parametrize(
    "starts", [{}, {"ego_lanes": (0, 1, 2)}, {"ego_lanes": (1,), "ego_speeds": (22.0, 22.0)}]
)
def test_third_of_mutations_is_a_pattern(starts, assert_rate, monkeypatch):
    monkeypatch.setattr(operators, "_with_pattern", lambda scenario, space, rng: None)
    rng = np.random.default_rng(4)
    space = SearchSpace(patterns=True, **starts)
    scenario = sample(space, rng)
    assert_rate([mutate(scenario, space, rng) for _ in range(1200)].count(None), 1200, 0.35)


def test_mutation_changes_npc_count_and_gene_duration():
    rng = np.random.default_rng(7)
    space = SearchSpace(npcs=2, most_npcs=(3,), gene_durations=(5.0, 10.0))
    scenario = sample(replace(space, most_npcs=(), gene_durations=()), rng)
    children = [mutate(scenario, space, rng) for _ in range(300)]
    assert {len(child.npcs) for child in children} == {1, 2, 3}
    shorter = [child for child in children if child.gene_seconds == 5.0]
    assert {child.genes for child in shorter} == {12}
    assert all(
        speeds(child) == [[each for each in row for _ in "ab"] for row in speeds(scenario)]
        for child in shorter
    )


def test_crossover_converts_chain_to_gene_duration_of_child():
    rng = np.random.default_rng(8)
    a = sample(SearchSpace(npcs=1, genes=3, gene_seconds=10.0), rng)
    b = sample(SearchSpace(npcs=1, genes=12, gene_seconds=5.0), rng)
    first, second = crossover(a, b, rng)
    assert (first.gene_seconds, speeds(first)) == (10.0, [speeds(b)[0][1:6:2]])
    assert (second.gene_seconds, speeds(second)) == (
        5.0,
        [[each for each in speeds(a)[0] for _ in "ab"]],
    )


@table("speeds", [None, (22.0, 22.0)])
@table("lanes", [(1,), (0, 1)])
def test_mutation_always_changes_something_with_one_lane(lanes, speeds):
    rng = np.random.default_rng(5)
    space = SearchSpace(ego_lanes=lanes, ego_speeds=speeds)
    scenario = sample(space, rng)
    assert scenario not in [mutate(scenario, space, rng) for _ in range(100)]


def test_mutation_drops_npcs_without_room_in_new_lane():
    rng = np.random.default_rng(6)
    space = SearchSpace(ego_lanes=(0, 1, 2), most_npcs=(4, 6, 4))
    crowd = sample(SearchSpace(npcs=6, ego_lane=1), rng)
    started = [mutate(crowd, space, rng) for _ in range(200)]
    assert {(each.ego_lane, len(each.npcs)) for each in started} == {(0, 4), (1, 5), (1, 6), (2, 4)}


def test_mutation_reaches_every_cell_between_its_neighbours():
    rng = np.random.default_rng(3)
    scenario = Scenario(npcs=(tuple(PositionInstruction(cell, 9.0) for cell in (1, 1, 2)),))
    space = SearchSpace(npcs=1, genes=3)
    middles = {mutate(scenario, space, rng).npcs[0][1].cell for _ in range(200)}
    firsts = {mutate(scenario, space, rng).npcs[0][0].cell for _ in range(200)}
    assert (middles, firsts) == ({1, 2}, {8, 1, 2})


@given(seeds)
def test_variation_keeps_the_start_of_the_parent(seed):
    rng = np.random.default_rng(seed)
    space = SearchSpace(ego_lane=2, ego_speed=19.0, gene_seconds=5.0)
    other = SearchSpace(ego_lane=0, ego_speed=11.0, gene_seconds=3.0)
    a, b = crossover(mutate(sample(space, rng), space, rng), sample(other, rng), rng)
    assert [(s.ego_lane, s.ego_speed, s.gene_seconds) for s in (a, b)] == [
        (2, 19.0, 5.0),
        (0, 11.0, 3.0),
    ]


def test_tournament_win_rates_follow_rank_among_four(make_population, assert_rate):
    rng = np.random.default_rng(6)
    population = make_population(4)
    winners = [population.index(binary_tournament(population, rng)) for _ in range(3000)]
    for place, rate in enumerate((1 / 16, 3 / 16, 5 / 16, 7 / 16)):
        assert_rate(winners.count(place), 3000, rate)


@given(st.integers(2, 6), seeds)
def test_parents_are_two_different_members(make_population, size, seed):
    population = make_population(size)
    first, second = parents(population, np.random.default_rng(seed))
    assert first is not second
    assert first in population
    assert second in population


def test_equal_members_are_still_two(make_evaluation):
    population = (make_evaluation(), make_evaluation())
    first, second = parents(population, np.random.default_rng(0))
    assert first is not second


kinds = st.tuples(
    st.booleans(),
    st.floats(),
    st.sampled_from([Outcome.COMPLETED, Outcome.COLLISION, Outcome.INVALID]),
)


@given(st.lists(kinds, min_size=1, max_size=12), st.floats(0, 1))
def test_elites_are_the_best_share_rounded_up(make_evaluation, fields, share):
    population = [make_evaluation(failing=f, fitness=x, outcome=o) for f, x, o in fields]
    chosen = elites(population, share)
    eligible = [member for member in population if member.eligible]
    assert len(chosen) == min(len(eligible), math.ceil(round(share * len(population), 9)))
    assert all(any(elite is member for member in eligible) for elite in chosen)
    rest = [member.rank for member in population if not any(member is elite for elite in chosen)]
    assert all(elite.rank >= rank for elite in chosen for rank in rest)


def test_rounding_error_does_not_add_an_elite(make_population):
    assert len(elites(make_population(100), 0.07)) == 7


@given(st.lists(kinds, max_size=8))
def test_best_is_never_invalid_or_without_fitness(make_evaluation, fields):
    population = [make_evaluation(failing=f, fitness=x, outcome=o) for f, x, o in fields]
    best = best_of(population)
    if best is None:
        assert not any(member.eligible for member in population)
    else:
        assert best.eligible
        assert not any(improves(member, best) for member in population)


def test_an_equal_one_is_no_improvement(make_evaluation):
    assert improves(make_evaluation(fitness=1.0), None)
    assert not improves(make_evaluation(fitness=1.0), make_evaluation(fitness=1.0))
    assert not improves(make_evaluation(fitness=math.nan), None)
    assert not improves(None, None)
