"""Findings with NPCs in lanes are displayed by their lanes, seen from the ego, instead of cells."""

import numpy as np

from pytest_pafot.model.instructions import LaneInstruction, PositionInstruction
from pytest_pafot.model.scenario import Scenario
from tests.helpers.traces import trace_of, vehicle
from tests.report.builders import view_of

IN_LANES = (
    LaneInstruction("right", 25.0),
    LaneInstruction("keep", 8.0),
    LaneInstruction("left", 8.0),
)
ON_GRID = (PositionInstruction(2, 20.0), PositionInstruction(3, 20.0))


def cut_in():
    """Return a trace of 15 s: at 2 s, an NPC has changed from lane 0 to the ego's lane 1, where an NPC drives ahead."""
    ticks = np.arange(226)
    changing = vehicle(30.0 + ticks * 20.0 / 15, np.interp(ticks, [0, 30], [0.0, 4.0]), speed=20.0)
    ego, ahead = (vehicle(x, 4.0, speed=20.0, ticks=225) for x in (0.0, 60.0))
    scenario = Scenario(npcs=(IN_LANES, ON_GRID), gene_seconds=6.0)
    return trace_of(ego, changing, ahead, scenario=scenario, arrivals=((30, 90, None), (0, None)))


def test_an_instruction_has_its_lane_and_no_cell():
    first, second, third = (row for row in view_of(cut_in()).instructions if row.npc == 0)
    assert (first.lane, first.cell, first.requested, first.arrived) == ("right", 0, 0, 2.0)
    assert second.lane == "keep"
    assert (third.lane, third.started, third.arrived) == ("left", True, None)
