"""Pictures of runs with crossing NPCs have ways and zones, and words for places without a cell."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import pytest_pafot as pafot
from pytest_pafot.model.instructions import CrossingInstruction
from pytest_pafot.model.scenario import Scenario
from tests.helpers.crossing_traces import CROSSES, MERGES, ZONES, junction_trace
from tests.report.builders import view_of


@cache
def mixed():
    """Return an NPC that crosses after the ego, one that merges ahead of it, and one on the grid."""
    return view_of(junction_trace((CROSSES, 0.0), (MERGES, 0.0), (None, 20.0)))


@cache
def crash():
    """Return a run in which an NPC from the left hits the ego; a second NPC is still on its way."""
    return view_of(junction_trace((CROSSES, 10.0), (MERGES, -60.0), hits=0, seconds=4.8))


def test_npc_off_the_ego_way_has_no_cell_but_a_zone_and_times_of_both():
    ego, crosses, merges, ahead = mixed().vehicles
    assert ego.cells == ()
    assert set(crosses.cells) == {None}
    frame = next(frame for frame, time in enumerate(mixed().times) if time > 4.1)
    assert set(merges.cells[:frame]) == {None}
    assert set(merges.cells[frame:]) == set(ahead.cells) == {2}
    assert (crosses.zone.name, merges.zone.name, ahead.zone) == (CROSSES, MERGES, None)
    assert crosses.advantage[-1] == pytest.approx(0.13, abs=0.01)
    assert ahead.advantage == ()


def test_zone_area_is_where_bodies_are_inside_it():
    zone = mixed().vehicles[1].zone
    assert zone.way[0] == (50.0, -60.0)
    assert zone.way[-1] == (50.0, 60.0)
    assert zone.area == ((50.0, -2.0), (50.0, -1.0), (50.0, 0.0), (50.0, 1.0), (50.0, 2.0))
    assert zone.width == 4.0
    first, *_, last = mixed().vehicles[2].zone.area
    # 7.5 m of 15 m turned
    assert first == pytest.approx((75 - 15 * np.cos(0.5), 15 - 15 * np.sin(0.5)), abs=0.05)
    assert last[1] == pytest.approx(0.0, abs=0.05)


def test_zone_with_unknown_way_is_named_but_undrawn():
    trace = junction_trace((CROSSES, 0.0))
    view = view_of(replace(trace, zones=(replace(ZONES[CROSSES], line=()),)))
    assert (view.vehicles[1].zone.way, view.vehicles[1].zone.area) == ((), ())


def test_world_gives_ways_that_its_npcs_drive():
    world = pafot.World("intersection-v0")
    told = CrossingInstruction("o1>o3", 0.0, 8.0), CrossingInstruction("o3>o1", 1.0, 7.0)
    scenario = Scenario(
        npcs=[[each] for each in told], ego_lane=0, ego_speed=world.crossings.ego_speed
    )
    trace = world.rollout(scenario, lambda: lambda seen: 1)
    view = view_of(trace)
    for npc, vehicle in enumerate(view.vehicles[1:]):
        way, places = np.array(vehicle.zone.way), trace.states[:, npc + 1, :2]
        gaps = np.hypot(*(places[:, None] - way).transpose(2, 0, 1)).min(axis=1)
        assert gaps.max() < 1.3  # there is a point every 2 m


def test_an_instruction_of_a_crossing_npc_has_its_zone_and_no_cell():
    crosses, merges, ahead = mixed().instructions
    assert (crosses.zone, merges.zone, ahead.zone) == (CROSSES, MERGES, "")
    assert (crosses.cell, crosses.requested, crosses.arrived) == (0, 0, 5.6)
    assert ahead.words == ""
