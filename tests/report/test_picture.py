"""The geometry of the picture."""

from dataclasses import replace

import pytest

from pytest_pafot import Highway, PositionInstruction, Scenario, Traffic
from pytest_pafot.report.views import run_view
from tests.helpers.picture import instruction_at, picture_at, vehicle_at
from tests.helpers.tables import table
from tests.helpers.traces import trace_of, vehicle
from tests.report.builders import cut_in_trace, scenario, view_of


def driving(*npcs, **more):
    """Return a run with the ego at 20 m/s in lane 1 from the origin, for 2 s, and the given NPCs."""
    return view_of(trace_of(vehicle(0.0, 4.0, speed=20.0, ticks=30), *npcs, **more))


def test_positions_between_frames_are_interpolated():
    view = driving(vehicle(10.0, 0.0, speed=20.0, ticks=30))
    assert vehicle_at(view, 0, 0.5).along == pytest.approx(10.0, abs=0.01)
    assert vehicle_at(view, 0, 1.2345).along == pytest.approx(24.69, abs=0.01)


def test_times_outside_the_run_show_start_or_end():
    view = driving(vehicle(10.0, 0.0, speed=20.0, ticks=30))
    assert vehicle_at(view, 0, -1.0).along == 0.0
    assert vehicle_at(view, 0, 99.0).along == pytest.approx(40.0)


def test_cells_surround_the_ego_with_clearance_between_them():
    picture = picture_at(driving(vehicle(10.0, 0.0, speed=20.0, ticks=30)), 0.0)
    places = {cell.cell: (cell.along, cell.across) for cell in picture.cells}
    assert places == {
        1: (8.0, 0.0), 2: (8.0, 4.0), 3: (8.0, 8.0), 4: (0.0, 8.0),
        5: (-8.0, 8.0), 6: (-8.0, 4.0), 7: (-8.0, 0.0), 8: (0.0, 0.0),
    }  # fmt: skip


@table("style", ["paper", "hostile", "everyday"])
def test_npc_arrives_in_drawn_cell_in_any_traffic(style):
    chains = [[(8, 24.0), (1, 24.0), (2, 24.0)], [(4, 24.0), (5, 24.0), (6, 24.0)]]
    npcs = tuple(tuple(PositionInstruction(*gene) for gene in chain) for chain in chains)
    asked = Scenario(npcs=npcs, ego_speed=24.0, traffic=Traffic(style))
    trace = Highway().rollout(asked, lambda: lambda seen: (0.0, 0.0))
    view = run_view(trace)
    for npc, cell in enumerate((2, 6)):
        time = trace.arrivals[npc][2] / trace.physics_hz
        drawn, place = vehicle_at(view, npc + 1, time), picture_at(view, time).cells[cell - 1]
        assert abs(drawn.along - place.along) <= 2.6
        assert abs(drawn.across - place.across) <= 0.6


def test_cells_beyond_the_road_do_not_exist():
    view = view_of(trace_of(vehicle(0.0, 0.0, speed=20.0, ticks=15), vehicle(30.0, 0.0, speed=20.0, ticks=15)))
    assert {cell.cell for cell in picture_at(view, 0.0).cells if not cell.exists} == {1, 7, 8}


@table(("across", "lane"), [(5.9, 4.0), (6.0, 4.0), (6.1, 8.0)])
def test_grid_belongs_to_the_nearest_lane_centre(across, lane):
    view = view_of(trace_of(vehicle(0.0, across, speed=20.0, ticks=15), vehicle(30.0, 0.0, speed=20.0, ticks=15)))
    assert {cell.cell: cell.across for cell in picture_at(view, 0.0).cells}[2] == lane


def test_npc_is_under_way_until_it_arrives():
    chain = scenario([(1, 20.0), (2, 8.0)], gene_seconds=1.0)
    states = vehicle(0.0, 4.0, speed=20.0, ticks=60)
    view = view_of(trace_of(states, vehicle(9.0, 0.0, speed=20.0, ticks=60), scenario=chain, arrivals=((6, None),)))
    phases = [
        (instruction_at(view, 0, time)[0].cell, instruction_at(view, 0, time)[1]) for time in (0.1, 0.5, 1.0, 1.9, 2.5)
    ]
    assert phases == [(1, "approach"), (1, "arrived"), (2, "approach"), (2, "approach"), (2, "ended")]


def test_only_an_npc_under_way_has_a_target():
    view = driving(vehicle(9.0, 0.0, speed=20.0, ticks=30), arrivals=((15, None),))
    assert picture_at(view, 0.5).targets[0].cell == 1
    assert picture_at(view, 1.5).targets == (None,)


def test_npc_with_constant_place_has_no_trail():
    picture = picture_at(driving(vehicle(9.0, 0.0, speed=20.0, ticks=30)), 2.0)
    assert {round(along - 40.0, 2) for along, _ in picture.trails[1]} == {9.0}
    assert picture.trails[0][0][0] == pytest.approx(0.0, abs=0.01)


def test_impact_is_between_both_vehicles_from_its_time():
    view = view_of(cut_in_trace())
    assert picture_at(view, view.event.time - 0.2).impact is None
    picture = picture_at(view, view.event.time)
    ego, npc = picture.vehicles[0], picture.vehicles[view.event.npc + 1]
    assert ego.along <= picture.impact[0] <= npc.along


def test_vehicle_with_unknown_position_is_left_out():
    view = driving(vehicle(9.0, 0.0, speed=20.0, ticks=30))
    unknown = replace(view.vehicles[1], along=(None,) * len(view.times))
    assert picture_at(replace(view, vehicles=(view.vehicles[0], unknown)), 1.0).vehicles[1] is None


def test_a_finding_without_frames_is_refused():
    with pytest.raises(ValueError, match="expected frames to draw, received none"):
        picture_at(replace(view_of(cut_in_trace()), times=()), 0.0)
