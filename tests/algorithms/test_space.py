"""The space that a search samples."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.algorithms.operators import mutate
from pytest_pafot.algorithms.space import PATTERNS, SearchSpace, chain_of_patterns, repaired, sample
from pytest_pafot.model.instructions import Cell, Choices, PositionInstruction, is_adjacent
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.vehicle_type import STYLES
from tests.helpers.tables import table

spaces = st.builds(
    SearchSpace, npcs=st.integers(1, 8), genes=st.integers(1, 8), speed_limit=st.floats(0, 40)
)
seeds = st.integers(0, 2**32)


@given(spaces, seeds)
def test_a_sample_is_valid_and_of_the_space(space, seed):
    scenario = sample(space, np.random.default_rng(seed))
    assert [len(chain) for chain in scenario.npcs] == [space.genes] * space.npcs
    assert all(
        0 <= gene.speed <= space.speed_limit + 1e-6 for chain in scenario.npcs for gene in chain
    )
    start = (scenario.ego_lane, scenario.ego_speed, scenario.gene_seconds)
    assert start == (space.ego_lane, space.ego_speed, space.gene_seconds)


wide_spaces = st.builds(
    SearchSpace,
    npcs=st.integers(1, 8),
    genes=st.integers(1, 8),
    speed_limit=st.floats(5, 40),
    ego_lanes=st.sampled_from([(), (2,), (0, 1, 2, 3)]),
    ego_speeds=st.sampled_from([None, (12.0, 26.8), (2.5, 5.0)]),
    patterns=st.booleans(),
    traffic=st.sampled_from(["paper", "hostile", "everyday"]),
)
sizes = st.sampled_from([{}, {"most_npcs": 6}, {"gene_durations": (4.0, 7.0, 10.0)}])


@given(wide_spaces, sizes, seeds, st.integers(0, 20))
def test_drawn_and_varied_scenarios_are_valid_within_limits(space, sizes, seed, mutations):
    if "most_npcs" in sizes:
        sizes = {"most_npcs": tuple(6 - lane for lane in space.ego_lanes or (0,))}
    space, rng = replace(space, **sizes), np.random.default_rng(seed)
    scenario = sample(space, rng)
    for _ in range(mutations):
        scenario = mutate(scenario, space, rng)
    # which checks all of its rules
    assert scenario == Scenario.from_canonical(json.loads(scenario.canonical()))
    assert scenario.traffic == space.traffic
    assert 1 <= len(scenario.npcs) <= space.most_on(scenario.ego_lane)
    assert scenario.gene_seconds in (space.gene_durations or (space.gene_seconds,))
    if not space.most_npcs:
        assert len(scenario.npcs) == space.npcs
    assert {len(chain) for chain in scenario.npcs} <= {
        space.genes_of(scenario.gene_seconds),
        *some_genes(space),
    }
    least = STYLES[space.traffic].least_speed_share * space.speed_limit - 1e-6
    assert all(
        least <= gene.speed <= space.speed_limit + 1e-6 for chain in scenario.npcs for gene in chain
    )
    assert scenario.ego_lane in (space.ego_lanes or (space.ego_lane,))
    low, high = space.ego_speeds or (space.ego_speed, space.ego_speed)
    assert low <= scenario.ego_speed <= high
    assert scenario.ego_speed == round(scenario.ego_speed, 1)


def some_genes(space):
    """Return possible numbers of genes in a changed chain: an NPC keeps its lane and speed after its last gene."""
    return (
        range(1, max(map(space.genes_of, space.gene_durations)) + 1) if space.gene_durations else ()
    )


def test_wide_space_draws_all_npc_counts_durations_and_starts():
    rng = np.random.default_rng(6)
    space = SearchSpace(ego_lanes=(0, 1), most_npcs=(2, 3), gene_durations=(4.0, 7.0))
    drawn = [sample(space, rng) for _ in range(200)]
    counts = {(each.ego_lane, len(each.npcs)) for each in drawn}
    assert counts == {(0, 1), (0, 2), (1, 1), (1, 2), (1, 3)}
    assert {(each.gene_seconds, each.genes) for each in drawn} == {(4.0, 15), (7.0, 9)}
    space = SearchSpace(ego_lanes=(0, 2), ego_speeds=(12.0, 12.3))
    starts = {(each.ego_lane, each.ego_speed) for each in (sample(space, rng) for _ in range(200))}
    assert starts == {(lane, speed) for lane in (0, 2) for speed in (12.0, 12.1, 12.2, 12.3)}


def test_first_cells_and_speeds_are_uniform(assert_rate):
    rng = np.random.default_rng(3)
    space = SearchSpace(speed_limit=0.9)
    scenarios = [sample(space, rng) for _ in range(600)]
    for npc in range(2):
        first = [scenario.npcs[npc][0].cell for scenario in scenarios]
        for cell in range(1, 9):
            assert_rate(first.count(cell), 600, 1 / 8)
    speeds = [gene.speed for scenario in scenarios for chain in scenario.npcs for gene in chain]
    for step in range(10):
        assert_rate(speeds.count(step / 10), len(speeds), 1 / 10)


def test_single_npc_holds_or_steps_aside_equally_often(assert_rate):
    rng = np.random.default_rng(4)
    space = SearchSpace(npcs=1, genes=2)
    chains = [sample(space, rng).npcs[0] for _ in range(3000)]
    steps = [(second.cell - first.cell) % 8 for first, second in chains]
    for step in (0, 1, 7):
        assert_rate(steps.count(step), 3000, 1 / 3)


def test_a_random_instruction_is_uniform_over_the_cells(assert_rate):
    rng = np.random.default_rng(5)
    cells = [
        PositionInstruction(1, 0.0).varied(SearchSpace().choices, rng).cell for _ in range(3000)
    ]
    for cell in range(1, 9):
        assert_rate(cells.count(cell), 3000, 1 / 8)


@given(seeds, st.integers(1, 4), st.integers(1, 6), st.integers(0, 2**63 - 1))
def test_quick_repair_equals_repair_of_the_scenario(seed, npcs, genes, repair_seed):
    rng = np.random.default_rng(seed)
    space = SearchSpace(npcs=npcs, genes=genes)
    chains = [
        [PositionInstruction(1, 0.0).varied(space.choices, rng) for _ in range(genes)]
        for _ in range(npcs)
    ]
    assert repaired(chains, repair_seed, space) == Scenario.repaired(chains, seed=repair_seed)


EMPTY = [("npcs", 0), ("genes", 0), ("speed_limit", -1.0), ("speed_limit", float("nan"))]


@table(("name", "value"), EMPTY)
def test_a_space_that_holds_nothing_is_refused(name, value):
    with pytest.raises(ValueError, match=f"^{name}: "):
        SearchSpace(**{name: value})


# Dangerous patterns, and chains made from them.


@table("pattern", PATTERNS)
def test_pattern_is_short_ring_path_with_a_source(pattern):
    assert 1 <= len(pattern.steps) <= 3
    assert all(is_adjacent(before.cell, after.cell) for before, after in pairwise(pattern.steps))
    assert "NHTSA" in pattern.source or "R157" in pattern.source


@given(
    st.integers(1, 9),
    st.floats(0, 40),
    st.integers(0, 400),
    st.integers(0, 400),
    st.integers(0, 2**32),
)
def test_chain_of_patterns_stays_on_ring_within_bounds(
    genes, ego_speed, one_step, other_step, seed
):
    bounds = Choices(min(one_step, other_step), max(one_step, other_step))
    chain = chain_of_patterns(genes, ego_speed, bounds, np.random.default_rng(seed))
    assert len(chain) == genes
    assert all(is_adjacent(before.cell, after.cell) for before, after in pairwise(chain))
    assert all(bounds[0] / 10 <= gene.speed <= bounds[1] / 10 for gene in chain)


def test_patterns_use_both_sides_and_similar_speeds():
    rng = np.random.default_rng(1)
    chains = [chain_of_patterns(6, 20.0, Choices(0, 268), rng) for _ in range(300)]
    assert {chain[0].cell for chain in chains} == set(Cell)
    beside = [chain[0].speed for chain in chains if chain[0].cell in (Cell.LEFT, Cell.RIGHT)]
    assert 18.0 <= min(beside) < 19.0
    assert 21.0 < max(beside) <= 22.0


def test_a_leader_of_a_pattern_may_stand():
    rng = np.random.default_rng(1)
    first = [chain_of_patterns(1, 20.0, Choices(0, 268), rng)[0] for _ in range(1000)]
    assert min(gene.speed for gene in first if gene.cell is Cell.FRONT) == 0.0
