"""What a search draws from."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.scenario import Scenario
from pytest_pafot.searching.space import SearchSpace, random_instruction, repaired, sample

spaces = st.builds(SearchSpace, npcs=st.integers(1, 8), genes=st.integers(1, 8), speed_limit=st.floats(0, 40))
seeds = st.integers(0, 2**32)


@given(spaces, seeds)
def test_a_sample_is_valid_and_of_the_space(space, seed):
    scenario = sample(space, np.random.default_rng(seed))
    assert [len(chain) for chain in scenario.npcs] == [space.genes] * space.npcs
    assert all(0 <= gene.speed <= space.speed_limit + 1e-6 for chain in scenario.npcs for gene in chain)
    start = (scenario.ego_lane, scenario.ego_speed, scenario.gene_seconds)
    assert start == (space.ego_lane, space.ego_speed, space.gene_seconds)


@given(spaces, seeds)
def test_the_same_generator_gives_the_same_sample(space, seed):
    assert sample(space, np.random.default_rng(seed)) == sample(space, np.random.default_rng(seed))


def test_first_cells_and_speeds_are_uniform(assert_rate):
    rng = np.random.default_rng(3)
    space = SearchSpace(speed_limit=0.9)
    scenarios = [sample(space, rng) for _ in range(2000)]
    for npc in range(2):
        first = [scenario.npcs[npc][0].cell for scenario in scenarios]
        for cell in range(1, 9):
            assert_rate(first.count(cell), 2000, 1 / 8)
    speeds = [gene.speed for scenario in scenarios for chain in scenario.npcs for gene in chain]
    for step in range(10):
        assert_rate(speeds.count(step / 10), len(speeds), 1 / 10)


def test_a_single_npc_holds_or_steps_to_either_side_with_equal_chances(assert_rate):
    rng = np.random.default_rng(4)
    space = SearchSpace(npcs=1, genes=2)
    chains = [sample(space, rng).npcs[0] for _ in range(3000)]
    steps = [(second.cell - first.cell) % 8 for first, second in chains]
    for step in (0, 1, 7):
        assert_rate(steps.count(step), 3000, 1 / 3)


def test_a_random_instruction_is_uniform_over_the_cells(assert_rate):
    rng = np.random.default_rng(5)
    cells = [random_instruction(SearchSpace(), rng).cell for _ in range(3000)]
    for cell in range(1, 9):
        assert_rate(cells.count(cell), 3000, 1 / 8)


@given(seeds, st.integers(1, 4), st.integers(1, 6), st.integers(0, 2**63 - 1))
def test_the_quick_repair_is_the_repair_of_a_scenario(seed, npcs, genes, repair_seed):
    rng = np.random.default_rng(seed)
    space = SearchSpace(npcs=npcs, genes=genes)
    chains = [[random_instruction(space, rng) for _ in range(genes)] for _ in range(npcs)]
    assert repaired(chains, repair_seed, space) == Scenario.repaired(chains, seed=repair_seed)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"npcs": 0}, "npcs: expected 1 to 8"),
        ({"npcs": 9}, "npcs: expected 1 to 8"),
        ({"genes": 0}, "genes: expected at least one"),
        ({"speed_limit": -1.0}, "speed_limit: expected a finite speed"),
        ({"speed_limit": float("nan")}, "speed_limit: expected a finite speed"),
    ],
)
def test_a_space_that_holds_nothing_is_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        SearchSpace(**fields)
