"""A run's account of NPCs that cross the ego's way: their places, their instructions, and the result."""

from dataclasses import replace

import numpy as np
import pytest

from pytest_pafot import Cell, Run
from pytest_pafot.model.trace import Outcome
from tests.helpers.crossing_traces import CROSSES, MERGES, ZONES, junction_trace
from tests.helpers.tables import table
from tests.helpers.traces import collision_at


def crash(**more):
    """Return a run in which the ego hits an NPC from the left in the middle of the zone."""
    return Run(junction_trace((CROSSES, 10.0), hits=0, seconds=4.8, **more))


def lines_of(*npcs, **more):
    return Run(junction_trace(*npcs, **more)).explain().splitlines()


def test_collision_at_a_zone_has_no_cell():
    run = crash()
    assert (run.event_cell, run.collision.cell) == (None, None)
    assert run.zone_of(run.collision) == ZONES[CROSSES]


PLACES = {"before": -10.0, "in": 10.0, "past": 25.0}


def place(start):
    """Return where an NPC is after 5 s that has this place on its way at first."""
    run = Run(junction_trace((CROSSES, start), seconds=5.0))
    return run.place_of(replace(run.closest_approach, tick=75))


@table(("where", "start"), PLACES.items())
def test_place_is_before_in_or_past_the_zone(where, start):
    assert f" {where} " in place(start)


def test_merged_npc_has_a_cell_after_its_zone():
    """It is on the ego's way from 4.1 s, and out of the zone at 5.4 s."""
    run = Run(junction_trace((MERGES, 0.0)))
    road, length = run.trace.road, run.trace.sizes[0, 0]
    for tick, zone in ((59, ZONES[MERGES]), (80, ZONES[MERGES]), (82, None)):
        cell = road.cell(0, tick, length)
        moment = replace(run.closest_approach, tick=tick, cell=cell)
        assert run.zone_of(moment) == zone
        assert ("2 (front)" in run.place_of(moment)) is (zone is None)
    assert road.cell(0, 80, length) == Cell.FRONT


def test_moments_of_a_run_include_crossing_npcs():
    run = Run(junction_trace((CROSSES, 5.0), (None, 40.0)))
    assert (run.closest_approach.npc, run.closest_approach.cell) == (0, None)
    assert run.closest_time == pytest.approx(5.0, abs=0.5)


@table("others", [(), ((None, 60.0),)])
@table("count", [1, 4, 5, 6, 7])
def test_explanations_stay_short_however_many_cross(count, others):
    npcs = [(CROSSES, -7.0 * number) for number in range(count)]
    for hits in (None, 0):
        lines = lines_of(*npcs, *others, hits=hits)
        assert len(lines) < 17
        assert all(len(line) < 100 and line.isascii() for line in lines)
    told = [line for line in lines if line.startswith("  NPC ") and "; " in line]
    left_out = count - len(told)
    assert any(f"... and {left_out} more" in line for line in lines) is (left_out > 0)


def test_a_run_has_the_passages_of_its_zones():
    run = Run(junction_trace((CROSSES, 0.0), (None, 20.0), (MERGES, 0.0)))
    assert [each.npc for each in run.passages] == [0, 2]
    assert run.npcs[2].passage == run.passages[1]
    assert min(each.post_encroachment_time for each in run.passages) == pytest.approx(0.1, abs=0.05)
    assert Run(junction_trace((None, 20.0))).passages == ()


def test_data_frame_has_signals_of_crossing_npcs():
    pytest.importorskip("pandas")
    frame = Run(junction_trace((CROSSES, 0.0), (None, 20.0))).to_pandas()
    assert np.isnan(frame["npcs[0].ahead"]).all()
    assert np.isfinite(frame["npcs[0].time_advantage"]).all()
    assert "npcs[1].time_advantage" not in frame


def test_collision_with_npc_merged_long_ago_has_cell():
    hit = collision_at(90, cell=Cell.FRONT)
    run = Run(junction_trace((MERGES, 0.0), seconds=6.0, outcome=Outcome.COLLISION, collision=hit))
    assert run.zone_of(hit) is None
    assert run.zone_of(replace(hit, cell=None)) == ZONES[MERGES]
