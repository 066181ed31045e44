"""Findings with NPCs in lanes are displayed by their lanes, seen from the ego, instead of cells."""

from dataclasses import replace

import numpy as np
import pytest

from pytest_pafot.model.instructions import LaneInstruction, PositionInstruction
from pytest_pafot.model.scenario import Scenario
from tests.helpers.picture import DrawnCell, instruction_at, picture_at
from tests.helpers.traces import trace_of, vehicle
from tests.report.builders import view_of

IN_LANES = (LaneInstruction("right", 25.0), LaneInstruction("keep", 8.0), LaneInstruction("left", 8.0))
ON_GRID = (PositionInstruction(2, 20.0), PositionInstruction(3, 20.0))


def cut_in():
    """Return a trace of 15 s: at 2 s, an NPC has changed from lane 0 to the ego's lane 1, where an NPC drives ahead."""
    ticks = np.arange(226)
    changing = vehicle(30.0 + ticks * 20.0 / 15, np.interp(ticks, [0, 30], [0.0, 4.0]), speed=20.0)
    ego, ahead = (vehicle(x, 4.0, speed=20.0, ticks=225) for x in (0.0, 60.0))
    scenario = Scenario(npcs=(IN_LANES, ON_GRID), gene_seconds=6.0)
    return trace_of(ego, changing, ahead, scenario=scenario, arrivals=((30, 90, None), (0, None)))


@pytest.fixture
def view():
    return view_of(cut_in())


def test_an_instruction_has_its_lane_and_no_cell(view):
    first, second, third = (row for row in view.instructions if row.npc == 0)
    assert (first.lane, first.cell, first.requested, first.arrived) == ("right", 0, 0, 2.0)
    assert (second.lane, second.words) == ("keep", "keep the ego's lane")
    assert (third.lane, third.started, third.arrived) == ("left", True, None)


def test_line_leads_to_the_target_lane_beside_the_npc(view):
    assert instruction_at(view, 0, 1.0)[1] == "approach"
    lane_1 = DrawnCell(0, pytest.approx(50.0), 4.0, exists=True)
    assert picture_at(view, 1.0).targets == (lane_1, None)
    assert picture_at(view, 3.0).targets == (None, None)
    assert picture_at(view, 13.0).targets[0].across == 0.0


def test_target_outside_of_the_road_is_not_drawn():
    """Only the trace of a user's world can have it: the plugin's NPCs keep their lanes if there is no other."""
    trace = cut_in()
    outwards = Scenario(npcs=((LaneInstruction("left", 8.0),), ON_GRID), gene_seconds=6.0)
    view = view_of(replace(trace, scenario=outwards, executed=outwards, arrivals=((None,), (0, None))))
    assert picture_at(view, 1.0).targets == (None, None)


def test_an_instruction_says_which_change_was_requested():
    trace = cut_in()
    asked = replace(trace.scenario, npcs=((LaneInstruction("left", 25.0), *IN_LANES[1:]), ON_GRID))
    stayed = replace(trace.scenario, npcs=((LaneInstruction("keep", 25.0), *IN_LANES[1:]), ON_GRID))
    first = view_of(replace(trace, scenario=asked, executed=stayed)).instructions[0]
    assert first.words == "keep the lane left of the ego (requested one lane left)"
