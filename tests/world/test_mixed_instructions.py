"""Scenarios in which some NPCs are on the grid, others in lanes, and others cross, on every kind of road."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pytest_pafot import Highway
from pytest_pafot.algorithms.operators import crossover, mutate
from pytest_pafot.algorithms.space import sample, space_on
from pytest_pafot.model.instructions import (
    CrossingInstruction,
    LaneInstruction,
    PositionInstruction,
)
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import LANE, SPEED, Outcome, X, Y
from tests.helpers.road_cases import violations, world_of
from tests.helpers.tables import table
from tests.helpers.world_cases import TRAFFICS, constant_speed, idm

LI, PI = LaneInstruction, PositionInstruction
BENT = ("merge-v1", "roundabout-v1", "intersection-v1", "racetrack-v1")


def world_named(name):
    return Highway(duration=8.0) if name == "Highway" else world_of(name, duration=8.0)


def space_in(world, **given):
    """Return the space of scenarios of both kinds, and of all that cross, in a world."""
    usual = {"instructions": "both", "npcs": 3, "crossings": world.crossings, "gene_seconds": 2.0}
    return space_on(world.speed_limit, world.longest_run, usual | given, world.road_start)


def repeated(world, scenario, ego):
    """Return the run of a scenario, after checking that its executed scenario gives the same run."""
    trace = world.rollout(scenario, ego)
    again = world.rollout(trace.executed, ego)
    for name in ("executed", "driven", "arrivals"):
        assert getattr(again, name) == getattr(trace, name)
    assert again.states.tobytes() == trace.states.tobytes()
    return trace


def steady():
    return lambda seen: (0.0, 0.0)


@pytest.mark.parametrize("name", ["Highway", *BENT])
@settings(max_examples=6, deadline=None)
@given(st.integers(0, 2**32))
def test_executed_scenario_gives_the_same_run_again(name, seed):
    world = world_named(name)
    space = space_in(world, npcs=2 if name in BENT else 3)
    scenario = sample(space, np.random.default_rng(seed))
    trace = repeated(world, scenario, idm)
    for chain, done in zip(scenario.npcs, trace.executed.npcs, strict=True):
        assert [type(gene) for gene in done] == [type(gene) for gene in chain]
        if isinstance(chain[0], LaneInstruction):
            pairs = zip(chain, done, strict=True)
            assert all(was.lane in (gene.lane, "keep") for gene, was in pairs)


@pytest.mark.parametrize("name", ["merge-v1", "racetrack-v1", "u-turn-v1"])
def test_npcs_in_lanes_respect_limits_and_stay_on_lanes_in_bends(name):
    world, rng = world_named(name), np.random.default_rng(7)
    for number in range(4):
        traffic = TRAFFICS[number % len(TRAFFICS)]
        space = space_in(world, npcs=2, traffic=traffic, instructions="lanes")
        trace = world.rollout(sample(space, rng), idm)
        assert violations(trace, world) == [], trace.scenario.canonical()


def test_npc_in_lanes_takes_the_first_cell_that_the_grid_leaves():
    """Its order of cells is 1, 2, 3, 8, 4, ...; the ego is in the leftmost lane, and cell 2 is taken."""
    npcs = [[LI("keep", 20.0)], [PI(2, 20.0)], [LI("keep", 20.0)]]
    for seed in range(5):
        director = Highway().rules.director(Scenario(npcs=npcs, ego_lane=0, seed=seed), 5.0)
        assert [int(cell) for cell in director.first_cells()] == [3, 2, 4]


def test_npc_on_grid_and_npc_in_lanes_do_not_head_for_one_place():
    """Both want the lane between them at the same time, side by side; the one with the lower number goes first."""
    between = [[PI(1, 20.0)] * 2, [LI("right", 20.0), LI("right", 20.0)]]
    for npcs in (between, between[::-1]):
        scenario = Scenario(npcs=npcs, ego_lane=1, ego_speed=20.0, gene_seconds=4.0)
        trace = Highway(duration=8.0).rollout(scenario, steady)
        assert trace.outcome is not Outcome.INVALID
        apart = abs(np.diff(trace.npcs[..., 0], axis=1))
        beside = abs(np.diff(trace.npcs[..., Y], axis=1)) < 2.0
        assert not (beside & (apart < 5.0)).any()


@table(("speed", "crosses"), [(20.0, True), (0.0, False)])
def test_attentive_npc_in_lanes_leaves_room_for_its_target_speed(speed, crosses):
    """It is 20 m ahead in the next lane: room for an instruction at the ego's speed, not for one that stops it."""
    npc, common = (LI("keep", 20.0), LI("right", speed)), {"ego_speed": 20.0, "gene_seconds": 2.0}
    scenario = Scenario(npcs=[npc], ego_lane=1, traffic="hostile", **common)
    trace = Highway(duration=4.0, headway=0.9, clearance=3.0).rollout(scenario, steady)
    assert bool((trace.npcs[:, 0, LANE] == 1).any()) is crosses


@pytest.mark.parametrize("name", ["Highway", "intersection-v1"])
@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 2**32))
@example(seed=1)
def test_children_of_mixed_scenarios_fit_the_world(name, seed):
    world, rng = world_named(name), np.random.default_rng(seed)
    durations = (2.0, 3.0, 4.0) if name == "Highway" else ()
    space = space_in(world, npcs=2, gene_durations=durations, patterns=name == "Highway")
    one, other = sample(space, rng), sample(space, rng)
    fields = "seed", "ego_lane", "ego_speed", "gene_seconds", "traffic"
    for _ in range(12):
        one, other = crossover(one, other, rng)
        one, other = mutate(one, space, rng), mutate(other, space, rng)
        for child in (one, other):
            world.check_fits(child)
            given = {name: getattr(child, name) for name in fields}
            assert Scenario.repaired(child.npcs, **given) == child


def test_cells_at_a_junction_are_those_of_their_own_npcs():
    """Skipped cells are recorded for the NPC on the grid, although one in lanes and one that crosses come before it."""
    world = world_of("intersection-v1", duration=8.0)
    crossing = CrossingInstruction(sorted(world.crossings.ways)[0], 2.0, 8.0)
    npcs = [[LI("keep", 5.0)] * 4, [crossing], [PI(cell, 8.0) for cell in (6, 7, 8, 1)]]
    lane, speed = world.start
    scenario = Scenario(npcs=npcs, ego_lane=lane, ego_speed=speed, gene_seconds=1.0)
    trace = repeated(world, scenario, idm)
    assert trace.driven[:2] == ((), ())
    assert len(trace.driven[2]) > 1
    assert [type(chain[0]) for chain in trace.chains] == [LI, CrossingInstruction, PI]


# Under Lane-Instructions alone: the own lane or the next one, at a speed, wherever the ego is.


def chain(*genes):
    """Return a chain from texts such as "left@22.5"."""
    pairs = (gene.split("@") for gene in genes)
    return tuple(LI(lane, float(speed)) for lane, speed in pairs)


def scenario(*chains, **fields):
    return Scenario(npcs=chains, **({"gene_seconds": 5.0} | fields))


def drive(given, ego=constant_speed, **world):
    return Highway(**({"duration": 20.0} | world)).rollout(given, ego)


@table("ego_lane", [0, 3])
def test_npcs_start_like_those_of_av_fuzzer_or_in_nearest_cells(ego_lane):
    trace = drive(scenario(chain("keep@22"), chain("keep@22")))
    assert trace.npcs[0, :, LANE].tolist() == [0, 1]
    assert np.all(trace.npcs[0, :, X] - trace.ego[0, X] > 40)
    trace = drive(scenario(*[chain("keep@22")] * 5, ego_lane=ego_lane, ego_speed=20.0))
    places = {tuple(row) for row in trace.npcs[0, :, [X, Y]].T.tolist()}
    assert len(places) == 5
    assert np.all(trace.npcs[0, :, LANE] >= 0)


def test_lane_instructions_count_lanes_from_the_npc_and_its_own_lane_if_there_is_no_other():
    keeps = drive(scenario(chain("keep@10"), ego_speed=22.0))
    assert keeps.npcs[75, 0, SPEED] == pytest.approx(10.0, abs=0.2)
    assert np.all(keeps.npcs[:, 0, LANE] == 0)
    assert keeps.arrivals == ((0,),)
    moves = drive(scenario(chain("right@26", "right@26", "right@26", "left@26"), ego_speed=10.0))
    assert moves.npcs[[0, 74, 149, 224, 299], 0, LANE].tolist() == [0, 1, 2, 3, 2]
    stays = drive(scenario(chain("left@20", "left@12")))
    assert np.all(stays.npcs[:, 0, LANE] == 0)
    assert stays.arrivals == ((0, 75),)
    assert stays.npcs[149, 0, SPEED] == pytest.approx(12.0, abs=0.2)


@pytest.mark.parametrize(("lane", "end"), [("left", 0), ("right", 2)])
def test_left_and_right_mean_one_lane_from_npc(lane, end):
    trace = drive(scenario(chain("keep@26"), chain(f"{lane}@15"), ego_speed=15.0))
    (tick,) = trace.arrivals[1]
    assert 0 < tick <= 75
    assert trace.npcs[0, 1, LANE] == 1
    assert np.all(trace.npcs[tick:, 1, LANE] == end)
    assert trace.npcs[tick, 1, Y] == pytest.approx(4.0 * end, abs=0.5)


def test_only_one_of_two_npcs_enters_a_gap():
    beside = chain("keep@20", "right@20"), chain("keep@26", "keep@26"), chain("keep@20", "left@20")
    trace = drive(scenario(*beside, ego_speed=15.0), duration=10.0)
    assert np.ptp(trace.npcs[75, [0, 2], X]) < 0.5, "they should be side by side"
    assert trace.outcome is Outcome.COMPLETED
    assert trace.npcs[-1, [0, 2], LANE].tolist() == [1, 2]


def test_npc_waits_until_the_one_beside_it_has_left_the_lane():
    """Side by side, both have the instruction to change to the right; the line on the right of lane 1 is at 6 m."""
    trace = drive(scenario(*[chain("keep@20", "right@20")] * 2, ego_speed=10.0, gene_seconds=3.0))
    moves = int(np.argmax(trace.npcs[:, 0, Y] > 1e-6))
    assert np.ptp(trace.npcs[moves, :, X]) < 0.5
    assert trace.npcs[moves - 1, 1, Y] - 1.0 > 6.0
    assert trace.npcs[-1, :, LANE].tolist() == [1, 2]


def test_npc_does_not_steer_into_another_npc():
    """NPC 0, to the left of NPC 1 and equally fast, has the instruction to move over; NPC 1 stays where it is."""
    chains = chain("right@22", "keep@22"), chain("keep@22", "keep@22")
    trace = drive(scenario(*chains), duration=10.0)
    assert trace.outcome is Outcome.COMPLETED
    assert trace.arrivals[0] == (None, 75)
    assert np.all(trace.npcs[:, 0, LANE] == 0)
