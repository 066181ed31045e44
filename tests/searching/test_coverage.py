"""The instructions that a search requested, that were driven, and that were reached."""

from pytest_pafot.model.grid import Cell, is_adjacent
from pytest_pafot.model.instructions import LaneInstruction, PositionInstruction
from pytest_pafot.model.instructions.cell import CELLS, STEPS
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.searching import Health, RandomSearch
from pytest_pafot.searching.health import Coverage, speed_bins
from tests.helpers.campaigns import run_campaign

CHAINS = (
    (PositionInstruction(8, 0.0), PositionInstruction(1, 5.0), PositionInstruction(2, 26.8)),
    (PositionInstruction(4, 4.9), PositionInstruction(4, 4.9)),
)


def keys(counter, kind):
    return {key[1:] for key in counter if key[0] == kind}


def counted(runs):
    coverage = Coverage()
    for run in runs:
        coverage = coverage.counted(run)
    return coverage


def test_everything_that_can_be_covered_is_listed_once():
    assert [key[1] for key in CELLS] == [1, 2, 3, 4, 5, 6, 7, 8]
    assert len(set(STEPS)) == len(STEPS) == 24
    assert all(is_adjacent(a, b) for _, a, b in STEPS)
    assert [key[1] for key in speed_bins(26.8)] == [0, 1, 2, 3, 4, 5]


def test_genes_not_started_count_only_as_requested(make_evaluation):
    run = make_evaluation(
        Scenario(npcs=CHAINS), genes_started=4, genes_reached=2, arrived=((True, False), (True, False))
    )
    coverage = counted([run])
    assert keys(coverage.requested, "cell") == {(8,), (1,), (2,), (4,)}
    assert keys(coverage.driven, "cell") == {(8,), (1,), (4,)}
    assert keys(coverage.reached, "cell") == {(8,), (4,)}
    assert keys(coverage.driven, "step") == {(8, 1), (4, 4)}
    assert keys(coverage.reached, "step") == set()
    assert keys(coverage.driven, "bin") == {(0,), (1,)}
    assert coverage.describe(26.8) == "reached 2/8 cells, 0/24 ring steps, 1/6 speed bins; requested 4/8, 3/24, 3/6"


def test_driven_cells_count_instead_of_missing_ones(make_evaluation):
    chain = (PositionInstruction(2, 8.0), PositionInstruction(3, 8.0))
    run = make_evaluation(Scenario(npcs=(chain,)), driven=((Cell(2), Cell(6)),), arrived=((True, True),))
    coverage = counted([run])
    assert keys(coverage.requested, "cell") == {(2,), (3,)}
    assert keys(coverage.driven, "cell") == keys(coverage.reached, "cell") == {(2,), (6,)}
    assert keys(coverage.driven, "bin") == {(1,)}


def test_every_run_counts(make_evaluation):
    run = make_evaluation(Scenario(npcs=CHAINS), arrived=((True,) * 3, (True,) * 2))
    assert counted([run, run, run]).driven["cell", 4] == 6


def test_lane_instructions_cover_lanes_and_speeds_and_no_cells(make_evaluation):
    asked = Scenario(npcs=((LaneInstruction("left", 12.0), LaneInstruction("keep", 3.0)),))
    executed = Scenario(npcs=((LaneInstruction("keep", 12.0), LaneInstruction("keep", 3.0)),))
    coverage = counted([make_evaluation(asked, executed=executed, arrived=((True, False),))])
    assert set(coverage.requested) == {("bin", 2), ("bin", 0), ("lane", "left"), ("lane", "keep")}
    assert coverage.driven == {("bin", 2): 1, ("bin", 0): 1, ("lane", "keep"): 2}
    assert coverage.reached == {("bin", 2): 1, ("lane", "keep"): 1}
    assert coverage.describe(26.8) == "reached 1/3 lane choices, 1/6 speed bins; requested 2/3, 2/6"


def test_cells_and_lanes_are_covered_side_by_side(make_evaluation):
    lanes = (LaneInstruction("right", 12.0), LaneInstruction("right", 3.0))
    run = make_evaluation(Scenario(npcs=(*CHAINS, lanes)), arrived=((True,) * 3, (True,) * 2, (False, True)))
    coverage = counted([run])
    assert coverage.requested["lane", "right"] == 2
    assert coverage.reached["lane", "right"] == 1
    described = coverage.describe(26.8)
    assert described.startswith("reached 4/8 cells, 3/24 ring steps, 1/3 lane choices, ")


def test_a_run_without_a_started_gene_drives_nothing(make_evaluation):
    coverage = Health().counted(make_evaluation(genes_started=0, genes_reached=0)).coverage
    assert not coverage.driven
    assert not coverage.reached


def test_a_long_random_search_covers_all_there_is(cheap_world):
    events = list(run_campaign(RandomSearch(), cheap_world(crash_speed=99.0), generations=40, seed=1))
    coverage = Health.of(events).coverage
    assert keys(coverage.requested, "cell") == {(cell,) for cell in range(1, 9)}
    # The fast world has no left lane, so no run reaches its three cells.
    assert keys(coverage.driven, "cell") == {(cell,) for cell in (2, 3, 4, 5, 6)}
    assert len(keys(coverage.driven, "step")) == 13
