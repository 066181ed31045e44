"""A run says where the lanes of Lane-Instructions are relative to the ego."""

import math

import numpy as np
import pytest

import pytest_pafot as pafot
from pytest_pafot import LaneInstruction, Run, Scenario
from pytest_pafot.model.trace import ACROSS
from pytest_pafot.oracle.run import LINE_LENGTH, arrival, lanes_apart
from tests.helpers.tables import table
from tests.helpers.traces import trace_of, vehicle


def in_lanes(text):
    """Return a chain from a text such as "left@22 keep@24.5"."""
    pairs = (gene.split("@") for gene in text.split())
    return tuple(LaneInstruction(lane, float(speed)) for lane, speed in pairs)


def run_of(*chains, ego=1, lanes=(0,), arrivals=(), **fields):
    """Return a run of 4 s whose genes last 2 s; ``lanes`` are the lanes of each NPC, one for each half of the run."""
    halves = [np.repeat(np.resize(each, 2) * 4.0, (30, 31)) for each in lanes]
    own, cars = vehicle(0.0, ego * 4.0, speed=20.0), []
    for npc, half in enumerate(halves):
        cars.append(vehicle(np.full(61, 40.0 * (npc + 1)), half, speed=20.0))
    scenario = Scenario(npcs=chains, gene_seconds=2.0)
    return Run(trace_of(own, *cars, scenario=scenario, arrivals=arrivals, **fields))


def rows(run):
    """Return the table of genes without the lines around it."""
    lines = run.explain().splitlines()
    first = next(number for number, line in enumerate(lines) if line.startswith("  from [s]"))
    return lines[first + 1 : -1]


@table(("run", "gene", "apart"), [
    (run_of(in_lanes("right@8"), lanes=((0, 0),)), 0, -1),
    (run_of(in_lanes("left@8"), lanes=((2, 2),)), 0, 1),
    (run_of(in_lanes("keep@8"), ego=0, lanes=((4, 4),)), 0, 4),
    # the ego is off the road
    (run_of(in_lanes("left@8"), ego=-1, lanes=((1, 1),)), 0, math.nan),
    # the run never reached this gene
    (run_of(in_lanes("keep@8 keep@8 keep@8 left@8")), 3, math.nan),
])  # fmt: skip
def test_lane_is_counted_from_the_egos_if_both_are_known(run, gene, apart):
    assert lanes_apart(run.trace, 0, gene) == pytest.approx(apart, nan_ok=True)


def test_lane_change_may_end_in_the_next_gene():
    run = run_of(in_lanes("right@20 keep@0"), lanes=((0, 1),), arrivals=((None, 36),))
    assert arrival(run.trace, 0, 0) == 36


def test_lane_change_that_was_given_up_has_not_arrived():
    """The next gene keeps the old lane, so an arrival in it is not one in the new lane."""
    run = run_of(in_lanes("right@10 keep@0"), lanes=((0, 0),), arrivals=((None, 36),))
    assert arrival(run.trace, 0, 0) is None


def test_next_change_does_not_end_the_one_before():
    run = run_of(in_lanes("right@10 right@10"), lanes=((0, 1),), arrivals=((None, 50),))
    assert [arrival(run.trace, 0, gene) for gene in (0, 1)] == [None, 50]


def test_npcs_that_go_on_as_before_need_no_row():
    lanes = ((0, 0), (1, 1))
    run = run_of(in_lanes("keep@10 keep@10"), in_lanes("keep@5"), lanes=lanes)
    assert len(rows(run)) == 2  # NPC 1 has no instruction in the second gene
    run = run_of(in_lanes("keep@10 keep@10"), in_lanes("keep@5 keep@5"), lanes=lanes)
    assert len(rows(run)) == 1
    run = run_of(*[in_lanes("left@8 left@8")] * 3, lanes=((2, 2), (3, 3), (3, 3)))
    assert len(rows(run)) == 2, "equal changes in a row are all told"


def test_header_fits_above_two_wide_columns():
    chains = [in_lanes("left@26.8 keep@20 " + "keep@20.5 keep@21 " * 3)] * 2
    scenario = Scenario(npcs=chains, gene_seconds=0.5)
    ego, *cars = (vehicle(40.0 * n, 4.0 + 4.0 * (n > 0), speed=20.0, ticks=60) for n in range(3))
    lines = Run(trace_of(ego, *cars, scenario=scenario)).explain().splitlines()
    assert max(map(len, lines)) <= LINE_LENGTH
    assert any(line.endswith("(3 earlier)") for line in lines)


def test_lanes_of_a_bend_are_counted_across_it():
    scenario = Scenario(npcs=[in_lanes("right@8 keep@8 left@8")], ego_speed=8.0, gene_seconds=4.0)
    world = pafot.World("racetrack-v0", planner_hz=5)
    trace = world.rollout(scenario, lambda: lambda seen: (-0.2, 0.0))
    # the ego keeps 0, lanes are 5 m wide
    npc_across = trace.track[:: 4 * trace.physics_hz, 1, ACROSS]
    assert npc_across[:3] == pytest.approx([-5.0, 0.0, 0.0], abs=0.5)
    assert [lanes_apart(trace, 0, gene) for gene in range(3)] == [-1, 0, 0]
