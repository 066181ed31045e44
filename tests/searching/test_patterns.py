"""Dangerous patterns, and chains made from them."""

from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.model.instructions import Cell, is_adjacent
from pytest_pafot.searching.space import PATTERNS, chain_of_patterns
from tests.helpers.tables import table


@table("pattern", PATTERNS)
def test_pattern_is_short_ring_path_with_a_source(pattern):
    assert 1 <= len(pattern.steps) <= 3
    assert all(is_adjacent(before.cell, after.cell) for before, after in pairwise(pattern.steps))
    assert "NHTSA" in pattern.source or "R157" in pattern.source


@given(st.integers(1, 9), st.floats(0, 40), st.integers(0, 400), st.integers(0, 400), st.integers(0, 2**32))
def test_chain_of_patterns_stays_on_ring_within_bounds(genes, ego_speed, one_step, other_step, seed):
    bounds = min(one_step, other_step), max(one_step, other_step)
    chain = chain_of_patterns(genes, ego_speed, bounds, np.random.default_rng(seed))
    assert len(chain) == genes
    assert all(is_adjacent(before.cell, after.cell) for before, after in pairwise(chain))
    assert all(bounds[0] / 10 <= gene.speed <= bounds[1] / 10 for gene in chain)


def test_patterns_use_both_sides_and_similar_speeds():
    rng = np.random.default_rng(1)
    chains = [chain_of_patterns(6, 20.0, (0, 268), rng) for _ in range(300)]
    assert {chain[0].cell for chain in chains} == set(Cell)
    beside = [chain[0].speed for chain in chains if chain[0].cell in (Cell.LEFT, Cell.RIGHT)]
    assert 18.0 <= min(beside) < 19.0
    assert 21.0 < max(beside) <= 22.0


def test_a_leader_of_a_pattern_may_stand():
    rng = np.random.default_rng(1)
    first = [chain_of_patterns(1, 20.0, (0, 268), rng)[0] for _ in range(1000)]
    assert min(gene.speed for gene in first if gene.cell is Cell.FRONT) == 0.0
