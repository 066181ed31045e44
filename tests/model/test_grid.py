"""The grid around the ego, and the repair that keeps chains on its ring."""

from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot import Cell
from pytest_pafot.model.instructions import (
    ALL_CELLS,
    cell_at,
    is_adjacent,
    longitudinal_target,
    repair_chains,
    repair_gene,
    toss,
)
from tests.helpers.tables import table
from tests.helpers.traces import ring_distance

LENGTH, LANE = 5.0, 4.0

cells = st.sampled_from(Cell)
seeds = st.integers(0, 2**63 - 1)
LEFTMOST = {Cell.FRONT, Cell.FRONT_RIGHT, Cell.RIGHT, Cell.REAR_RIGHT, Cell.REAR}
RIGHTMOST = {Cell.FRONT, Cell.FRONT_LEFT, Cell.LEFT, Cell.REAR_LEFT, Cell.REAR}
ONE_LANE = {Cell.FRONT, Cell.REAR}
roads = st.sampled_from([ALL_CELLS, *map(frozenset, (LEFTMOST, RIGHTMOST, ONE_LANE))])


@st.composite
def gene_requests(draw, most=8):
    """Return (previous distinct cells, requested cells, cells whose lane exists, one coin per NPC)."""
    previous = draw(st.lists(cells, min_size=1, max_size=most, unique=True))
    requested = draw(st.lists(cells, min_size=len(previous), max_size=len(previous)))
    coins = draw(st.lists(st.booleans(), min_size=len(previous), max_size=len(previous)))
    return previous, requested, draw(roads), coins


def test_cells_run_clockwise_from_the_front_left_in_a_ring():
    around = [(-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0)]
    assert [(cell.column, cell.row) for cell in sorted(Cell)] == around
    labels = {1: "front-left", 2: "front", 5: "rear-right", 8: "left"}
    assert {number: Cell(number).label for number in labels} == labels
    assert Cell.FRONT_LEFT.neighbours == (Cell.LEFT, Cell.FRONT)
    assert Cell.LEFT.neighbours == (Cell.REAR_LEFT, Cell.FRONT_LEFT)


@given(cells, cells)
def test_cell_is_adjacent_to_itself_and_both_neighbours(a, b):
    assert is_adjacent(a, b) == (b in (a, *a.neighbours))
    assert is_adjacent(a, b) == is_adjacent(b, a)
    assert ring_distance(a, b) == ring_distance(b, a) <= 4
    assert abs(a.row - b.row) + abs(a.column - b.column) <= 1 or not is_adjacent(a, b)


@table("clearance", [0.0, 3.0])
@table("cell", Cell)
def test_centre_of_a_cell_is_inside_that_cell(cell, clearance):
    longitudinal = longitudinal_target(cell, LENGTH, clearance)
    assert longitudinal == cell.row * (LENGTH + clearance)
    assert cell_at(longitudinal, cell.column * LANE, LENGTH, LANE) == cell


def test_outer_cells_are_endless_without_the_ego_place():
    assert cell_at(0.0, 0.0, LENGTH, LANE) is None
    assert cell_at(LENGTH / 2, -LANE / 2, LENGTH, LANE) is None
    assert cell_at(80.0, 0.5, LENGTH, LANE) is Cell.FRONT
    assert cell_at(-300.0, -9.0, LENGTH, LANE) is Cell.REAR_LEFT


@given(st.lists(cells, min_size=1, max_size=6), seeds)
def test_single_chain_changes_only_where_it_leaves_ring(chain, seed):
    (repaired,) = repair_chains([chain], seed)
    assert repaired[0] == chain[0]
    for gene in range(1, len(chain)):
        before = repaired[gene - 1]
        if is_adjacent(before, chain[gene]):
            assert repaired[gene] == chain[gene]
        else:
            assert repaired[gene] == before.neighbours[toss(seed, 0, gene)]


def test_both_neighbours_are_drawn_equally_for_every_npc():
    for npc, gene in product(range(8), range(6)):
        heads = sum(toss(seed, npc, gene) for seed in range(2000))
        assert 880 <= heads <= 1120, (npc, gene, heads)  # +- 5 standard deviations


def test_draws_of_one_scenario_are_independent():
    genes = [*product(range(3), range(3))]
    draws = [[toss(seed, npc, gene) for npc, gene in genes] for seed in range(2000)]
    for a, b in product(range(9), repeat=2):
        alike = sum(draw[a] == draw[b] for draw in draws)
        assert a == b or 880 <= alike <= 1120, (a, b, alike)


@given(st.lists(st.lists(cells, min_size=4, max_size=4), min_size=1, max_size=8), seeds)
def test_repaired_gene_does_not_depend_on_later_genes(chains, seed):
    longer = repair_chains([[*chain, Cell.FRONT] for chain in chains], seed)
    assert tuple(chain[:-1] for chain in longer) == repair_chains(chains, seed)


def preference(previous, requested, existing, clockwise):
    """Return the order of `repair_gene`: the request, a neighbour by coin, the other one, the present cell."""
    order = [requested] if previous == requested or requested in previous.neighbours else []
    order += reversed(previous.neighbours) if clockwise else previous.neighbours
    order = [cell for cell in order if cell in existing]
    order.append(previous)
    return [cell for rank, cell in enumerate(order) if cell not in order[:rank]]


@given(gene_requests(most=5))
def test_repair_takes_first_complete_assignment_by_preference(case):
    previous, requested, existing, coins = case
    wishes = zip(previous, requested, coins, strict=True)
    orders = [preference(before, wanted, existing, coin) for before, wanted, coin in wishes]
    complete = product(*map(enumerate, orders))
    distinct = [choice for choice in complete if len({cell for _, cell in choice}) == len(orders)]
    best = tuple(cell for _, cell in min(distinct))
    assert repair_gene(previous, requested, existing, coins) == best


@given(gene_requests())
def test_repaired_cells_are_distinct_adjacent_and_existing(case):
    previous, requested, existing, coins = case
    executed = repair_gene(previous, requested, existing, coins)
    assert len(set(executed)) == len(executed)
    for before, cell in zip(previous, executed, strict=True):
        assert is_adjacent(before, cell)
        assert cell in existing or cell == before


@given(gene_requests(), st.lists(st.booleans(), min_size=8, max_size=8))
def test_executed_cells_are_executed_again_for_any_coins(case, others):
    """With the same coins always; with others wherever every executed cell exists."""
    previous, requested, existing, coins = case
    executed = repair_gene(previous, requested, existing, coins)
    assert repair_gene(previous, executed, existing, coins) == executed
    if set(executed) <= existing:
        assert repair_gene(previous, executed, existing, others[: len(executed)]) == executed


@given(st.lists(cells, min_size=1, max_size=8), roads, seeds)
def test_first_gene_gives_every_npc_nearest_free_cell(requested, existing, seed):
    coins = [toss(seed, npc, 0) for npc in range(len(requested))]
    if len(requested) > len(existing):
        with pytest.raises(ValueError, match=f"{len(requested)} .* {len(existing)}"):
            repair_gene(None, requested, existing, coins)
        return
    executed = repair_gene(None, requested, existing, coins)
    free = set(existing)
    for wanted, cell in zip(requested, executed, strict=True):
        nearest = min(ring_distance(wanted, other) for other in free)
        assert cell in free
        assert ring_distance(wanted, cell) == nearest
        free.remove(cell)
    assert repair_gene(None, executed, existing, [not coin for coin in coins]) == executed


@table(("requested", "existing", "clockwise", "executed"), [
    # the next cell that exists is a neighbour
    (Cell.FRONT_LEFT, {Cell.FRONT, Cell.REAR}, True, Cell.REAR),
    (Cell.FRONT_RIGHT, {Cell.FRONT, Cell.REAR}, True, Cell.REAR),
    (Cell.REAR, {Cell.FRONT, Cell.REAR}, True, Cell.REAR),
    (Cell.FRONT, {Cell.FRONT, Cell.REAR}, True, Cell.FRONT),  # to hold is no step
    # on in its own direction
    (Cell.FRONT_RIGHT, {Cell.FRONT, Cell.RIGHT, Cell.LEFT}, True, Cell.RIGHT),
    (Cell.FRONT_LEFT, {Cell.FRONT, Cell.RIGHT, Cell.LEFT}, True, Cell.LEFT),
    # a distant cell: a neighbour by the coin
    (Cell.REAR, {*Cell} - {Cell.FRONT_RIGHT}, True, Cell.RIGHT),
    (Cell.REAR, {*Cell} - {Cell.FRONT_RIGHT}, False, Cell.FRONT_LEFT),
    (Cell.FRONT_RIGHT, {Cell.FRONT}, True, Cell.FRONT),  # nothing else exists
    (Cell.FRONT_RIGHT, set(), True, Cell.FRONT),
])  # fmt: skip
def test_skipping_repair_goes_on_to_the_next_cell_that_exists(
    requested, existing, clockwise, executed
):
    given = [Cell.FRONT], [requested], frozenset(existing), [clockwise]
    assert repair_gene(*given, skipping=True) == (executed,)


@given(gene_requests(most=4), st.frozensets(cells), st.booleans())
def test_result_of_the_skipping_repair_is_distinct_and_a_fixed_point(case, existing, clockwise):
    previous, requested, *_ = case
    common = existing, [clockwise] * len(previous)
    executed = repair_gene(previous, requested, *common, skipping=True)
    assert len(set(executed)) == len(executed)
    assert repair_gene(previous, executed, *common, skipping=True) == executed
    pairs = zip(executed, previous, strict=True)
    assert all(cell in existing or cell == before for cell, before in pairs)
