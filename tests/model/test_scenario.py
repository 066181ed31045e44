"""Position-Instructions and scenarios: which are valid, and the errors about the others."""

from __future__ import annotations

import json
import math
import pickle
import re
from dataclasses import FrozenInstanceError, replace
from fractions import Fraction

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


@table("cell", [0, 9, -1, 2.0, "2", None, True, np.bool_(True), np.array([1, 2]), 10**30])
def test_invalid_cell_is_refused_with_the_range(cell):
    with pytest.raises(
        ScenarioError, match=r"cell: expected a whole number from 1 .* to 8 .*, received"
    ):
        PositionInstruction(cell, 10.0)


@table("speed", [math.nan, math.inf, -math.inf, "10", None, True, 10**400, np.array([1.0]), 1j])
def test_a_speed_that_is_no_number_is_refused(speed):
    with pytest.raises(ScenarioError, match="speed: expected a finite number, received"):
        PositionInstruction(2, speed)


@table(
    ("speed", "nearest"),
    [(-0.1, "0"), (-5.0, "0"), (-1.7e308, "0"), (12.34, "12.3"), (0.05001, "0.1")],
)
def test_invalid_speed_is_refused_with_nearest_valid_one(speed, nearest):
    with pytest.raises(
        ScenarioError, match=re.escape(f"received {speed!r}. The nearest valid speed is {nearest}")
    ):
        PositionInstruction(2, speed)


@table("speed", [1e4, 1e300, 1.7e308, 10**300])
def test_an_absurd_speed_is_refused_with_the_bound(speed):
    with pytest.raises(
        ScenarioError, match="speed: expected a speed of at most 1000 m/s, received"
    ):
        PositionInstruction(2, speed)


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
    assert (
        Scenario.repaired(scenario.npcs, seed=(scenario.seed + 1) % MAX_SEED).npcs == scenario.npcs
    )


@given(raw_chains, st.integers(0, MAX_SEED))
def test_repair_preserves_speeds_and_first_cells_where_possible(chains, seed):
    scenario = Scenario.repaired(chains, seed=seed)
    assert [[g.speed for g in chain] for chain in scenario.npcs] == [
        [g.speed for g in chain] for chain in chains
    ]
    assert scenario.npcs[0][0].cell == chains[0][0].cell
    assert scenario.seed == seed


@given(scenarios, scenarios)
def test_canonical_text_is_equal_exactly_for_equal_scenarios(a, b):
    assert (a.canonical() == b.canonical()) == (a == b)
    same = Scenario(
        npcs=[list(chain) for chain in a.npcs],
        seed=np.int64(a.seed),
        ego_lane=np.int32(a.ego_lane),
        ego_speed=np.float64(a.ego_speed),
        gene_seconds=a.gene_seconds,
        traffic=a.traffic,
    )
    assert same.canonical() == a.canonical()
    assert same.id == a.id
    assert Scenario.from_canonical(json.loads(a.canonical())) == a


def test_every_field_is_part_of_the_id():
    scenario = Scenario(npcs=[[one(1), one(2)]], ego_speed=20.0)
    others = [
        replace(scenario, seed=1),
        replace(scenario, ego_lane=2),
        replace(scenario, ego_speed=20.1),
        replace(scenario, gene_seconds=9.0),
        replace(scenario, traffic="hostile"),
        replace(scenario, traffic="everyday"),
        scenario.truncated(1),
        Scenario(npcs=[[one(1), one(2, 19.9)]], ego_speed=20.0),
        Scenario(npcs=[[one(1), one(1)]], ego_speed=20.0),
        Scenario(npcs=[[one(1)], [one(2)]], ego_speed=20.0),
    ]
    assert len({other.id for other in (scenario, *others)}) == len(others) + 1


def test_the_id_is_the_same_on_every_machine():
    scenario = Scenario(npcs=[[PositionInstruction(1, 25.0), PositionInstruction(2, 8.0)]], seed=7)
    assert scenario.canonical() == "[[[[1,25.0],[2,8.0]]],7,1,22.0,10.0]"
    assert scenario.id == "4240d6"


def test_zero_and_minus_zero_are_one_speed():
    a = Scenario(npcs=[[one(2, 0.0)]], ego_speed=0.0)
    b = Scenario(npcs=[[one(2, -0.0)]], ego_speed=-0.0)
    assert a == b
    assert a.canonical() == b.canonical()


@given(scenarios, st.integers(1, 7))
def test_truncating_keeps_the_first_genes(scenario, genes):
    short = scenario.truncated(genes)
    assert short.genes == min(genes, scenario.genes)
    assert all(a == b[: len(a)] for a, b in zip(short.npcs, scenario.npcs, strict=True))


def test_a_scenario_in_a_message_is_its_chains_on_one_line():
    scenario = Scenario(npcs=[[one(1, 25), one(2, 8.5)], [one(6, 0)]])
    assert str(scenario) == f"<Scenario {scenario.id}: 1@25 2@8.5; 6@0>"


@table(("fields", "message"), [
    ({"npcs": []}, "npcs: expected 1 to 8 NPCs, at most one per cell, received 0"),
    ({"npcs": [[one()], []]}, "npcs[1]: expected at least one instruction, received an empty chain"),
    ({"npcs": [[(2, 20.0)]]}, "LaneInstruction or a CrossingInstruction, received (2, 20.0). Write, for example, Posi"),
    ({"npcs": None}, "npcs: expected a list with one chain of instructions per NPC, received None. Write npcs=[["),
    ({"seed": -1}, "seed: expected a whole number from 0 to 9223372036854775807, received -1"),
    ({"seed": 2**63}, "seed: expected a whole number from 0 to 9223372036854775807, received 9223372036854775808"),
    ({"seed": 1.5}, "seed: expected a whole number"),
    ({"ego_lane": -1}, "ego_lane: expected a whole number from 0 to 1000, received -1"),
    ({"ego_speed": -1}, "ego_speed: expected a speed of at least 0 m/s, received -1"),
    ({"ego_speed": math.nan}, "ego_speed: expected a speed of at least 0 m/s, received nan"),
    ({"gene_seconds": 0}, "gene_seconds: expected a duration of more than 0 s and at most 86400 s, received 0"),
    ({"gene_seconds": 1e9},
     "gene_seconds: expected a duration of more than 0 s and at most 86400 s, received 1000000000.0"),
])  # fmt: skip
@table("make", [Scenario, Scenario.repaired])
def test_broken_field_is_refused_by_name(make, fields, message):
    with pytest.raises(ScenarioError, match=re.escape(message)):
        make(**{"npcs": [[one()]], **fields})


def test_leap_across_the_ring_is_refused_with_alternatives():
    expected = (
        "npcs[0][1]: expected cell 1 again, or one of the adjacent cells 2 and 8, received cell 5. Use "
        "Scenario.repaired(...)"
    )
    with pytest.raises(ScenarioError, match=re.escape(expected)):
        Scenario(npcs=[[one(1), one(5)]])


def test_error_fields_are_readable_also_after_pickling():
    with pytest.raises(ScenarioError) as caught:
        Scenario(npcs=[[one(1), one(5)]])
    for error in (caught.value, pickle.loads(pickle.dumps(caught.value))):
        assert (error.field, error.received) == ("npcs[0][1]", "cell 5")
        assert error.expected == "cell 1 again, or one of the adjacent cells 2 and 8"
        assert (
            str(error)
            == f"{error.field}: expected {error.expected}, received {error.received}. {capitalised(error.fix)}"
        )


def test_two_npcs_in_one_cell_are_refused():
    expected = (
        "npcs[1][1]: expected a cell that no other NPC occupies in gene 1, received cell "
        "2, which npcs[0] occupies"
    )
    with pytest.raises(ScenarioError, match=re.escape(expected)):
        Scenario(npcs=[[one(1), one(2)], [one(3), one(2)]])


def test_npc_with_ended_chain_holds_no_cell():
    assert Scenario(npcs=[[one(2)], [one(3), one(2)]]).genes == 2


@given(raw_chains)
def test_scenario_is_accepted_exactly_if_repair_changes_nothing(chains):
    repaired = Scenario.repaired(chains).npcs
    assume(len(chains) > 0)
    if repaired == tuple(map(tuple, chains)):
        assert Scenario(npcs=chains).npcs == repaired
    else:
        with pytest.raises(ScenarioError, match=r"npcs\[\d\]\[\d\]: expected .*Scenario\.repaired"):
            Scenario(npcs=chains)


class TestLaneInstructions:
    """Lane-Instructions are genes without a cell: keep the own lane or change it by one, at a speed."""

    def test_lane_instructions_take_three_lanes_and_tenths(self):
        assert LaneInstruction("left", 12).speed == 12.0
        assert [LaneInstruction(lane, 1.0).column for lane in ("keep", "left", "right")] == [
            0,
            -1,
            1,
        ]

    @table("lane", ["up", "", None, 1, "Left"])
    def test_another_lane_is_refused_with_those_that_exist(self, lane):
        with pytest.raises(
            ScenarioError, match="lane: expected one of keep, left, right, received"
        ):
            LaneInstruction(lane, 10.0)

    def test_lane_speed_between_tenths_is_refused(self):
        with pytest.raises(
            ScenarioError,
            match=r"speed: expected a non-negative multiple of 0.1 m/s, .* The nearest valid speed is 12\.3",
        ):
            LaneInstruction("keep", 12.34)

    def test_valid_speed_of_an_npc_that_crosses_is_above_0(self):
        with pytest.raises(ScenarioError, match=r"The nearest valid speed is 0\.1"):
            CrossingInstruction("a>b", 0, 0.04)

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
        for chain, kind in (
            ([one(), lane], "PositionInstruction"),
            ([lane, one()], "LaneInstruction"),
        ):
            with pytest.raises(
                ScenarioError, match=rf"npcs\[1\]\[1\]: expected a {kind}, as in npcs\[1\]\[0\]"
            ):
                Scenario(npcs=([one()], chain))

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
