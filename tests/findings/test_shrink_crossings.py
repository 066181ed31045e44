"""Shrinking scenarios with crossing NPCs, with predicates instead of runs."""

from dataclasses import replace
from functools import partial

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.findings.shrink import instructions, size_of, sort_key
from pytest_pafot.model.instructions import (
    Cell,
    CrossingInstruction,
    PositionInstruction,
    ScenarioError,
)
from pytest_pafot.model.scenario import Scenario
from tests.helpers.crossings import junction
from tests.helpers.shrinking import shrunk_by
from tests.helpers.tables import table

JUNCTION = junction()


def crosses(**changes):
    return CrossingInstruction(
        **({"zone": "o1>o3", "slot": 0.7, "speed": 8.6, "act": "pass"} | changes)
    )


def scenario(*npcs, **fields):
    """Return a scenario with one NPC for each instruction at a zone, or for each list of cells."""
    chains = [
        (each,)
        if isinstance(each, CrossingInstruction)
        else tuple(PositionInstruction(Cell(cell), 7.3) for cell in each)
        for each in npcs
    ]
    return Scenario(npcs=tuple(chains), ego_lane=0, ego_speed=10.0, gene_seconds=4.0, **fields)


BUSY = scenario(
    [2, 2, 3],
    crosses(zone="o3>o1", slot=-1.3),
    crosses(act="stop"),
    [6, 6, 7],
    crosses(slot=4.2, speed=7.9),
    seed=77,
)


shrunk = partial(shrunk_by, rollouts=3000, plain=(0, 10.0), plain_seconds=4.0, top_speed=12.0)


def told(each):
    return [gene for gene in each.crossings if gene is not None]


def some(test):
    """Return a predicate that is true if a test holds for a crossing NPC."""
    return lambda each: any(map(test, told(each)))


@table(("test", "slot", "speeds", "act"), [
    (lambda each: True, 0.0, (5.0, 10.0), "pass"),
    (lambda each: each.zone == "o1>o3", 0.0, (5.0, 10.0), "pass"),
    (lambda each: each.slot > 0.3, 1.0, (5.0, 10.0), "pass"),
    (lambda each: 0 < each.slot < 1, 0.5, (5.0, 10.0), "pass"),
    (lambda each: 0.6 < each.slot < 1, 0.7, (5.0, 10.0), "pass"),
    (lambda each: each.slot < -1.1, -2.0, (5.0, 10.0), "pass"),
    (lambda each: each.act == "stop", 0.0, (5.0, 10.0), "stop"),
    (lambda each: 7 < each.speed < 9, 0.0, (8.0,), "pass"),
    (lambda each: 7.8 < each.speed < 7.95, 0.0, (7.9,), "pass"),
    (lambda each: 8.3 < each.speed < 8.9 and each.slot > 0.5, 1.0, (8.6,), "pass"),
])  # fmt: skip
def test_one_passing_npc_remains_with_round_values(test, slot, speeds, act):
    simplest, how = shrunk(BUSY, some(test))
    assert how.is_minimal
    ((found,),) = simplest.npcs
    assert (found.slot, found.act, simplest.seed, simplest.gene_seconds) == (slot, act, 0, 10.0)
    assert found.speed in speeds


def test_needed_npc_on_grid_stays_and_becomes_short():
    def fails(each):
        return some(lambda gene: gene.slot > 0)(each) and any(
            chain[0].cell == 2 for chain in each.positions
        )

    simplest, how = shrunk(BUSY, fails)
    assert how.is_minimal
    assert [[(gene.cell, gene.speed) for gene in chain] for chain in simplest.positions] == [
        [(2, 0.0)]
    ]
    assert [(each.slot, each.act) for each in told(simplest)] == [(1.0, "pass")]


def test_instruction_without_room_on_its_way_is_rejected():
    def fails(each):
        return all(map(JUNCTION.fits, told(each))) and some(lambda gene: gene.slot >= 3)(each)

    simplest, _ = shrunk(BUSY, fails)
    assert told(simplest) == [replace(told(simplest)[0], slot=3.0)]
    assert JUNCTION.fits(told(simplest)[0])


def test_crossing_scenario_is_as_long_as_a_run():
    assert size_of(scenario(crosses()), 13.0) == "1 NPC, 1 instruction, 13 s"
    assert instructions(BUSY) == 7
    assert size_of(scenario([2, 2, 3]), 13.0) == "1 NPC, 2 instructions, 12 s"


instructions_at_zones = st.builds(
    crosses,
    zone=st.sampled_from(sorted(JUNCTION.ways)),
    slot=st.integers(-50, 50).map(lambda tenths: tenths / 10),
    speed=st.integers(1, 120).map(lambda tenths: tenths / 10),
    act=st.sampled_from(["pass", "hold", "stop", "late"]),
)
npcs = st.lists(
    instructions_at_zones | st.lists(st.just(2), min_size=1, max_size=3), min_size=1, max_size=4
)


@given(npcs, st.floats(-6, 6), st.floats(0, 13))
def test_shrinking_always_ends_with_valid_failing_scenario(npcs, slot, speed):
    try:
        given_one = scenario(*npcs)
    except ScenarioError:  # two in one cell
        return

    def fails(each):
        return each == given_one or some(lambda gene: gene.slot >= slot and gene.speed <= speed)(
            each
        )

    simplest, _ = shrunk(given_one, fails, rollouts=300)
    assert Scenario(npcs=simplest.npcs) == replace(
        simplest, seed=0, ego_lane=1, ego_speed=22.0, gene_seconds=10.0
    )


@pytest.mark.parametrize(("simple", "rough"), [
    ({"slot": 0.0}, {"slot": 0.5}),
    ({"slot": 0.5}, {"slot": 0.6}),
    ({"slot": 1.0}, {"slot": 0.5}),
    ({"slot": -1.0}, {"slot": 2.0}),
    ({"speed": 10.0}, {"speed": 8.0}),
    ({"speed": 8.0}, {"speed": 7.9}),
    ({"act": "pass", "slot": 4.2}, {"act": "hold", "slot": 0.0}),
])  # fmt: skip
def test_simpler_means_passing_then_round_then_near(simple, rough):
    assert sort_key(scenario(crosses(**simple))) < sort_key(scenario(crosses(**rough)))
