"""The strategies generate valid values by construction, reach all of them, and shrink to the simplest."""

import itertools
import random
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import Phase, find, given, settings
from hypothesis import strategies as st

import pytest_pafot
from pytest_pafot import Highway, strategies
from pytest_pafot.model.instructions import LaneInstruction, is_adjacent
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.vehicle_type import CAR, TRUCK
from tests.helpers.tables import table

# no need to explain which parts matter
SIMPLEST = settings(max_examples=500, phases=[Phase.generate, Phase.shrink])


EVERY = st.one_of(
    strategies.chromosomes(instructions="both"),
    strategies.scenarios(max_npcs=4, gene_seconds=0.1 + 0.2, ego_speed=1 / 3),
    strategies.scenarios(traffic="paper", instructions="lanes"),
    strategies.scenarios(traffic="everyday", ego_speed=np.float64(20.5)),
)


@given(EVERY)
def test_repr_of_a_value_makes_an_equal_value(value):
    again = eval(repr(value), {name: getattr(pytest_pafot, name) for name in pytest_pafot.__all__})
    assert again == value
    assert type(again) is type(value)


@pytest.mark.parametrize(("strategy", "text"), [
    (strategies.chromosomes(), "(PositionInstruction(Cell.FRONT_LEFT, 0.0),)"),
    (strategies.scenarios(), "Scenario(npcs=((PositionInstruction(Cell.FRONT_LEFT, 0.0),),), traffic='hostile')"),
])  # fmt: skip
def test_failing_example_is_printed_so_that_it_can_be_pasted(strategy, text):
    @settings(max_examples=10, database=None, phases=[Phase.generate, Phase.shrink])
    @given(strategy)
    def fails(value):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError) as failed:
        fails()
    assert f"value={text}," in "".join(failed.value.__notes__)


def test_module_lists_its_public_names_alone():
    assert [name for name in dir(strategies) if not name.startswith("__")] == sorted(
        strategies.__all__
    )


@given(strategies.chromosomes(min_genes=2, max_genes=9))
def test_chains_take_only_steps_along_the_ring(chain):
    assert 2 <= len(chain) <= 9
    assert all(is_adjacent(a.cell, b.cell) for a, b in itertools.pairwise(chain))


@given(strategies.chromosomes(cells=[1, 2, 3], max_genes=8))
def test_chains_visit_only_the_cells_given(chain):
    assert {gene.cell for gene in chain} <= {1, 2, 3}


@given(strategies.scenarios(min_npcs=1, max_npcs=8, lanes=5))
def test_scenarios_are_valid_whatever_the_number_of_npcs(scenario):
    again = Scenario.repaired(
        scenario.npcs, seed=scenario.seed, ego_lane=scenario.ego_lane, traffic=scenario.traffic
    )
    assert again == scenario


@given(strategies.scenarios())
def test_scenarios_have_two_npcs_at_most_and_hostile_traffic_by_default(scenario):
    assert len(scenario.npcs) <= 2
    assert scenario.traffic == "hostile"


@given(strategies.scenarios(lanes=3, max_npcs=5))
def test_npcs_of_both_kinds_fit_the_road(scenario):
    Highway(lanes=3).check_fits(scenario)


@table(("instructions", "kinds"), [("cells", {False}), ("lanes", {True}), ("both", {False, True})])
def test_chains_and_scenarios_have_the_wanted_instructions(instructions, kinds):
    drawn = {"chain": set(), "scenario": set()}

    @given(
        strategies.chromosomes(instructions=instructions),
        strategies.scenarios(min_npcs=2, instructions=instructions),
    )
    def draw(chain, scenario):
        for name, chains in (("chain", [chain]), ("scenario", scenario.npcs)):
            drawn[name].add(
                frozenset(isinstance(gene, LaneInstruction) for each in chains for gene in each)
            )

    draw()
    for name, seen in drawn.items():
        mixed = {frozenset(kinds)} if len(kinds) > 1 and name != "chain" else set()
        assert seen == {frozenset([kind]) for kind in kinds} | mixed


def test_failing_change_of_lanes_shrinks_to_one_npc():
    def changes(scenario):
        return any(
            isinstance(gene, LaneInstruction) and gene.lane == "right"
            for npc in scenario.npcs
            for gene in npc
        )

    found = find(strategies.scenarios(max_npcs=4), changes, settings=SIMPLEST)
    assert found.npcs == ((LaneInstruction("right", 0.0),),)


@given(strategies.scenarios(traffic="everyday", min_speed=3.0))
def test_instructions_respect_the_minimum_speed_of_traffic(scenario):
    assert scenario.traffic == "everyday"
    assert all(0.75 * 26.8 <= gene.speed <= 26.8 for chain in scenario.npcs for gene in chain)


def test_failing_chain_shrinks_to_staying_and_round_speeds():
    found = find(
        strategies.chromosomes(min_genes=3), lambda chain: chain[1].speed > 7.35, settings=SIMPLEST
    )
    assert [int(gene.cell) for gene in found] == [1, 1, 1]
    assert [gene.speed for gene in found] == [0.0, 8.0, 0.0]


def test_npcs_may_follow_each_other_around_the_ring():
    def follows(step):
        def both_move(scenario):
            return all(
                (chain[1].cell - chain[0].cell) % 8 == step % 8 for chain in scenario.npcs
            ) and is_adjacent(scenario.npcs[0][0].cell, scenario.npcs[1][0].cell)

        return both_move

    pairs = strategies.scenarios(
        min_npcs=2, max_npcs=2, min_genes=2, max_genes=2, instructions="cells"
    )
    many = settings(max_examples=5000, phases=[Phase.generate])
    for step, seed in ((1, 1), (-1, 5)):  # these seeds find one soon
        assert find(pairs, follows(step), settings=many, random=random.Random(seed))


IMPOSSIBLE = [
    {"cells": []},
    {"min_speed": 5.0, "max_speed": 4.0},
    {"min_genes": 0},
    {"max_npcs": 9},
    {"lanes": 2, "max_npcs": 8},
    {"ego_lane": 7},
    {"lanes": 0},
    {"instructions": "cell"},
    {"traffic": "rude"},
]


@table("arguments", IMPOSSIBLE)
def test_impossible_bounds_are_refused(arguments):
    *_, name = arguments
    with pytest.raises(ValueError, match=name.removeprefix("max_").removesuffix("s")):
        strategies.scenarios(**arguments)


def test_hypothesis_finds_the_strategies_by_its_entry_point():
    code = (
        "from hypothesis import strategies as st; import sys;"
        "from pytest_pafot.model.scenario import Scenario;"
        "st.from_type(Scenario).validate();"
        "assert 'highway_env' not in sys.modules and 'numpy' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_vehicles_are_drawn_that_fit_and_shrink_to_the_first():
    drawn = strategies.scenarios(vehicles=["car", "truck"], min_npcs=2)
    found = find(drawn, lambda scenario: bool(scenario.vehicles), settings=SIMPLEST)
    assert (len(found.npcs), found.vehicles) in ((2, (TRUCK,)), (2, (CAR, TRUCK)))
    assert find(drawn, lambda _: True, settings=SIMPLEST).vehicles == ()
    assert find(strategies.scenarios(), lambda _: True, settings=SIMPLEST).vehicles == ()
