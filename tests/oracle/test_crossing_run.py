"""A run's account of NPCs that cross the ego's way: their places, their instructions, and the result."""

from dataclasses import replace

import numpy as np
import pytest

from pytest_pafot.model.instructions import ACTS, Cell, CrossingInstruction
from pytest_pafot.model.trace import Outcome
from pytest_pafot.oracle.run import Run
from tests.helpers.crossing_traces import CROSSES, MERGES, ZONES, junction_trace
from tests.helpers.tables import table
from tests.helpers.traces import collision_at


def crash(**more):
    """Return a run in which the ego hits an NPC from the left in the middle of the zone."""
    return Run(junction_trace((CROSSES, 10.0), hits=0, seconds=4.8, **more))


def lines_of(*npcs, **more):
    return Run(junction_trace(*npcs, **more)).explain().splitlines()


def test_headline_names_origin_of_npc():
    run = crash()
    assert (
        run.impact == "The ego hit NPC 0, which came from the left, after 4.8 s, closing at 0.0 m/s"
    )
    assert " ".join(run.explain().split()).startswith(
        f"{run.impact} (ego 10.0 m/s, NPC 10.0 m/s) The ego entered "
    )
    assert run.event_cell is None
    assert run.place_of(run.collision) == "from the left in the zone o3>o1"


@table(
    ("start", "where"),
    [(-10.0, "from the left before"), (10.0, "from the left in"), (25.0, "from the left past")],
)
def test_place_is_before_in_or_past_the_zone(start, where):
    run = Run(junction_trace((CROSSES, start), seconds=5.0))
    assert run.place_of(replace(run.closest_approach, tick=75)) == f"{where} the zone o3>o1"


def test_merged_npc_has_a_cell_after_its_zone():
    """It is on the ego's way from 4.1 s, and out of the zone at 5.4 s."""
    run = Run(junction_trace((MERGES, 0.0)))
    for tick, place in (
        (59, "from the right in the zone o2>o4"),
        (80, "from the right in the zone o2>o4"),
        (82, "in cell 2 (front)"),
    ):
        cell = run.trace.road.cell(0, tick, run.trace.sizes[0, 0])
        assert run.place_of(replace(run.closest_approach, tick=tick, cell=cell)) == place
    assert run.trace.road.cell(0, 80, run.trace.sizes[0, 0]) == Cell.FRONT


def test_collision_place_without_record_is_left_out():
    """A user's own world may have such a track, and no zones."""
    trace = replace(crash().trace, zones=(), on_way=None)
    run = Run(trace)
    assert run.impact == "The ego's front hit NPC 0 after 4.8 s, closing at 0.0 m/s"
    assert run.sentences[0] == "NPC 0 drove at 10.0 m/s and did not brake from 2.8 s on."


def test_moments_of_a_run_include_crossing_npcs():
    run = Run(junction_trace((CROSSES, 5.0), (None, 40.0)))
    assert (run.closest_approach.npc, run.closest_approach.cell) == (0, None)
    assert run.closest_time == pytest.approx(5.0, abs=0.5)


@table(
    ("npc", "came"),
    [
        ((CROSSES, 0.0), "; arrived 0.1 s after it (5.6 s)"),
        ((CROSSES, 10.0), "; both in the zone from 4.6 s"),
        ((CROSSES, 25.0), "; left 0.6 s before it (4.0 s)"),
        ((CROSSES, -60.0), "; never arrived"),
    ],
)
def test_explanation_has_crossing_instruction_and_arrival_time(npc, came):
    told = "  NPC 0: o3>o1 from the left, 0.5 s after the ego leaves, 10.0 m/s"
    assert told + came in lines_of(npc)


def test_npc_at_zone_without_ego_has_own_time():
    assert lines_of((CROSSES, 0.0), ego_speed=2.0)[-2].endswith("10.0 m/s; arrived at 5.6 s")


def test_npcs_on_grid_have_table_besides_crossing_ones():
    lines = lines_of((CROSSES, 0.0), (None, 20.0), (MERGES, 0.0))
    assert lines[-5].startswith("  NPC 0: o3>o1 from the left, ")
    assert lines[-4].startswith("  NPC 2: o2>o4 from the right, ")
    assert lines[-3] == "  from [s]  NPC 1"
    assert lines[-2] == "       0.0  2 front 10.0 m/s not reached"


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
    assert (f"  ... and {left_out} more crossing NPCs" in lines) is (left_out > 0)


@table("act", ACTS)
def test_instruction_words_have_slot_and_act(act):
    words = {
        "pass": "from the left, 0.5 s after the ego leaves",
        "hold": "from the left, 1 s before the ego enters, holds at the line",
        "stop": "from the left, together with the ego, stops there",
        "late": "5 s after the ego leaves, starts late",
    }
    slot = {"pass": 0.5, "hold": -1.0, "stop": 0.0, "late": 5.0}[act]
    whence = "" if act == "late" else ZONES[CROSSES].whence
    assert CrossingInstruction(CROSSES, slot, 8.6, act).words_from(whence) == words[act]


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


def test_run_that_left_route_is_described_with_crossing():
    trace = replace(junction_trace((CROSSES, 0.0)), outcome=Outcome.LEFT_ROUTE)
    assert (
        Run(trace).explain().splitlines()[0]
        == "no collision in 8.0 s, after which the ego left its route"
    )


def test_collision_with_npc_merged_long_ago_has_cell():
    hit = collision_at(90, cell=Cell.FRONT)
    run = Run(junction_trace((MERGES, 0.0), seconds=6.0, outcome=Outcome.COLLISION, collision=hit))
    assert run.impact.startswith("The ego hit NPC 0 from behind after 6.0 s")
    assert run.zone_of(hit) is None
    assert run.zone_of(replace(hit, cell=None)) == ZONES[MERGES]
