"""Position-Instructions and scenarios: which are valid, and the errors about the others."""

import json
import math
import pickle
from dataclasses import FrozenInstanceError, replace
from fractions import Fraction
from functools import partial

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from pytest_pafot.model.instructions import (
    Cell,
    CrossingInstruction,
    LaneInstruction,
    PositionInstruction,
    ScenarioError,
)
from pytest_pafot.model.scenario import MAX_SEED, Scenario, retimed
from pytest_pafot.model.vehicle_type import STYLES
from pytest_pafot.support.text import capitalised
from tests.helpers.refusals import refused
from tests.helpers.tables import table

instructions = st.builds(
    PositionInstruction, st.integers(1, 8), st.integers(0, 268).map(lambda tenths: tenths / 10)
)
raw_chains = st.lists(st.lists(instructions, min_size=1, max_size=6), min_size=1, max_size=8)
scenarios = st.builds(
    Scenario.repaired,
    raw_chains,
    seed=st.integers(0, MAX_SEED),
    ego_lane=st.integers(0, 5),
    ego_speed=st.floats(0, 30),
    gene_seconds=st.floats(0.1, 20),
    traffic=st.sampled_from(sorted(STYLES)),
)


def one(cell=2, speed=20.0):
    return PositionInstruction(cell, speed)


def test_position_instruction_accepts_plain_and_numpy_numbers():
    for cell, speed in ((3, 12), (np.int64(3), np.float64(12.0)), (Cell(3), np.int32(12))):
        gene = PositionInstruction(cell, speed)
        assert gene == PositionInstruction(Cell.FRONT_RIGHT, 12.0)
        assert type(gene.cell) is Cell
        assert type(gene.speed) is float


@given(st.integers(0, 10_000))
def test_speeds_are_exact_tenths_however_they_were_computed(tenths):
    exact = float(Fraction(tenths, 10))
    assert one(speed=tenths * 0.1).speed == exact
    assert one(speed=np.float64(tenths) / 10).speed == exact
    assert one(speed=sum([0.1] * min(tenths, 300))).speed == float(Fraction(min(tenths, 300), 10))


NO_CELLS = [0, 9, -1, 2.0, "2", None, True, np.bool_(True), np.array([1, 2]), 10**30]
NO_SPEEDS = {
    "no number": [math.nan, math.inf, -math.inf, "10", None, True, 10**400, np.array([1.0]), 1j],
    "beyond the bound": [1e4, 1e300, 1.7e308, 10**300],
    "a negative speed": [-0.1, -5.0, -1.7e308],
    "between tenths": [12.34, 0.05001],
}


@table("cell", NO_CELLS)
def test_invalid_cell_is_refused(cell):
    with refused("cell", ScenarioError):
        PositionInstruction(cell, 10.0)


@table("speed", [speed for speeds in NO_SPEEDS.values() for speed in speeds])
def test_invalid_speed_is_refused(speed):
    with refused("speed", ScenarioError):
        PositionInstruction(2, speed)


@table(
    ("speed", "nearest"),
    [(-0.1, "0"), (-5.0, "0"), (-1.7e308, "0"), (12.34, "12.3"), (0.05001, "0.1")],
)
def test_invalid_speed_is_refused_with_nearest_valid_one(speed, nearest):
    for make in (partial(PositionInstruction, 2), partial(LaneInstruction, "keep")):
        with refused("speed", ScenarioError) as caught:
            make(speed)
        assert caught.value.fix.split()[-2] == nearest


def test_values_are_frozen_and_hashable():
    scenario = Scenario(npcs=[[one()]])
    with pytest.raises(FrozenInstanceError):
        scenario.seed = 3
    with pytest.raises(FrozenInstanceError):
        scenario.npcs[0][0].speed = 3.0
    assert len({scenario, Scenario(npcs=[[one()]]), replace(scenario, seed=1)}) == 2


@given(scenarios)
def test_a_scenario_survives_pickling_and_repairing(scenario):
    assert pickle.loads(pickle.dumps(scenario)) == scenario
    again = Scenario.repaired(scenario.npcs, seed=(scenario.seed + 1) % MAX_SEED)
    assert again.npcs == scenario.npcs


@given(raw_chains, st.integers(0, MAX_SEED))
def test_repair_preserves_speeds_and_first_cells_where_possible(chains, seed):
    scenario = Scenario.repaired(chains, seed=seed)
    for repaired, chain in zip(scenario.npcs, chains, strict=True):
        assert [gene.speed for gene in repaired] == [gene.speed for gene in chain]
    assert scenario.npcs[0][0].cell == chains[0][0].cell
    assert scenario.seed == seed


@given(scenarios, scenarios)
def test_canonical_text_is_equal_exactly_for_equal_scenarios(a, b):
    assert (a.canonical() == b.canonical()) == (a == b)
    same = replace(
        a, npcs=[list(chain) for chain in a.npcs], seed=np.int64(a.seed), ego_lane=np.int32(a.ego_lane),
        ego_speed=np.float64(a.ego_speed),
    )  # fmt: skip
    assert same.canonical() == a.canonical()
    assert same.id == a.id
    assert Scenario.from_canonical(json.loads(a.canonical())) == a


def test_every_field_is_part_of_the_id():
    scenario = Scenario(npcs=[[one(1), one(2)]], ego_speed=20.0)
    fields = {"seed": 1, "ego_lane": 2, "ego_speed": 20.1, "gene_seconds": 9.0}
    others = [
        *(replace(scenario, **{name: value}) for name, value in fields.items()),
        *(replace(scenario, traffic=style) for style in ("hostile", "everyday")),
        scenario.truncated(1),
        Scenario(npcs=[[one(1), one(2, 19.9)]], ego_speed=20.0),
        Scenario(npcs=[[one(1), one(1)]], ego_speed=20.0),
        Scenario(npcs=[[one(1)], [one(2)]], ego_speed=20.0),
    ]
    assert len({other.id for other in (scenario, *others)}) == len(others) + 1


def test_text_and_id_are_the_same_on_every_machine():
    scenario = Scenario(npcs=[[PositionInstruction(1, 25.0), PositionInstruction(2, 8.0)]], seed=7)
    assert scenario.canonical() == "[[[[1,25.0],[2,8.0]]],7,1,22.0,10.0]"
    assert (scenario.id, str(scenario)) == ("4240d6", "<Scenario 4240d6: 1@25 2@8>")
    assert str(Scenario(npcs=[[one(2, 8.5)], [one(6, 0)]])).endswith(": 2@8.5; 6@0>")
    a, b = (Scenario(npcs=[[one(2, zero)]], ego_speed=zero) for zero in (0.0, -0.0))
    assert a == b
    assert a.canonical() == b.canonical()


@given(scenarios, st.integers(1, 7))
def test_truncating_keeps_the_first_genes(scenario, genes):
    short = scenario.truncated(genes)
    assert short.genes == min(genes, scenario.genes)
    assert all(a == b[: len(a)] for a, b in zip(short.npcs, scenario.npcs, strict=True))


BROKEN = {
    "no NPCs": ({"npcs": []}, "npcs"),
    "an empty chain": ({"npcs": [[one()], []]}, "npcs[1]"),
    "a pair": ({"npcs": [[(2, 20.0)]]}, "npcs[0][0]"),
    "no list": ({"npcs": None}, "npcs"),
    "a negative seed": ({"seed": -1}, "seed"),
    "a large seed": ({"seed": 2**63}, "seed"),
    "half a seed": ({"seed": 1.5}, "seed"),
    "a negative lane": ({"ego_lane": -1}, "ego_lane"),
    "a negative speed": ({"ego_speed": -1}, "ego_speed"),
    "no speed": ({"ego_speed": math.nan}, "ego_speed"),
    "no duration": ({"gene_seconds": 0}, "gene_seconds"),
    "a long duration": ({"gene_seconds": 1e9}, "gene_seconds"),
}


@table(("fields", "field"), BROKEN.values())
@table("make", [Scenario, Scenario.repaired])
def test_broken_field_is_refused_by_name(make, fields, field):
    with refused(field, ScenarioError):
        make(**{"npcs": [[one()]], **fields})


def test_leap_across_the_ring_is_refused_with_fields_that_are_readable_also_after_pickling():
    with refused("npcs[0][1]", ScenarioError) as caught:
        Scenario(npcs=[[one(1), one(5)]])
    error, again = caught.value, pickle.loads(pickle.dumps(caught.value))
    assert error.received == again.received == "cell 5"
    assert (vars(again), str(again)) == (vars(error), str(error))
    for part in (error.field, error.expected, error.received, capitalised(error.fix)):
        assert part
        assert part in str(error)


def test_two_npcs_in_one_cell_are_refused_unless_a_chain_has_ended():
    with refused("npcs[1][1]", ScenarioError):
        Scenario(npcs=[[one(1), one(2)], [one(3), one(2)]])
    assert Scenario(npcs=[[one(2)], [one(3), one(2)]]).genes == 2


@given(raw_chains)
def test_scenario_is_accepted_exactly_if_repair_changes_nothing(chains):
    repaired = Scenario.repaired(chains).npcs
    assume(len(chains) > 0)
    if repaired == tuple(map(tuple, chains)):
        assert Scenario(npcs=chains).npcs == repaired
    else:
        with pytest.raises(ScenarioError, match=r"^npcs\[\d\]\[\d\]:"):
            Scenario(npcs=chains)


class TestLaneInstructions:
    """Lane-Instructions are genes without a cell: keep the own lane or change it by one, at a speed."""

    @table("lane", ["up", "", None, 1, "Left"])
    def test_lane_instructions_take_three_lanes_and_tenths(self, lane):
        assert LaneInstruction("left", 12).speed == 12.0
        columns = {each: LaneInstruction(each, 1.0).column for each in ("keep", "left", "right")}
        assert columns == {"keep": 0, "left": -1, "right": 1}
        with refused("lane", ScenarioError):
            LaneInstruction(lane, 10.0)

    def test_valid_speed_of_an_npc_that_crosses_is_above_0(self):
        with refused("speed", ScenarioError) as caught:
            CrossingInstruction("a>b", 0, 0.04)
        assert caught.value.fix.split()[-2] == "0.1"

    def test_lane_scenario_needs_no_repair_and_may_repeat(self):
        chain = (LaneInstruction("left", 10.0),) * 3
        scenario = Scenario(npcs=(chain, chain))
        assert Scenario.repaired(scenario.npcs) == scenario
        assert scenario.positions == ()
        assert scenario.truncated(1).npcs == ((chain[0],), (chain[0],))

    def test_the_canonical_text_tells_them_from_cells(self):
        scenario = Scenario(npcs=((LaneInstruction("right", 10.0),),))
        assert scenario.canonical() == '[[[["right",10.0]]],0,1,22.0,10.0]'
        assert "right@10" in str(scenario)
        others = [
            Scenario(npcs=((gene,),)).id for gene in (LaneInstruction("left", 10.0), one(4, 10.0))
        ]
        assert len({scenario.id, *others}) == 3

    def test_mixed_kinds_in_a_chain_are_refused_with_place(self):
        lane = LaneInstruction("keep", 1.0)
        for chain in ([one(), lane], [lane, one()]):
            with refused("npcs[1][1]", ScenarioError) as caught:
                Scenario(npcs=([one()], chain))
            assert type(chain[0]).__name__ in caught.value.expected

    def test_npcs_may_differ_in_kind_and_only_cells_are_repaired(self):
        lanes = LaneInstruction("left", 1.0), LaneInstruction("left", 2.0)
        scenario = Scenario.repaired([lanes, [one(2), one(5)], [one(2), one(2)]], seed=3)
        alone = Scenario.repaired([[one(2), one(5)], [one(2), one(2)]], seed=3)
        assert scenario.npcs == (lanes, *alone.npcs)
        assert scenario.positions == alone.npcs
        assert scenario.canonical().startswith('[[[["left",1.0],["left",2.0]],[[2,')

    def test_a_change_that_lasts_several_genes_happens_once(self):
        chain = LaneInstruction("left", 20.0), LaneInstruction("keep", 8.0)
        keeps = LaneInstruction("keep", 20.0)
        assert retimed(chain, 6.0, 2.0) == (chain[0], keeps, keeps, *[chain[1]] * 3)
        assert retimed((chain[0],) * 2, 3.0, 3.0) == (chain[0],) * 2, "two changes stay two"
