"""The geometry of the picture."""

from pytest_pafot import Highway, PositionInstruction, Scenario
from tests.helpers.picture import picture_at, vehicle_at
from tests.helpers.tables import table
from tests.helpers.traces import trace_of, vehicle
from tests.report.builders import view_of


def driving(*npcs, **more):
    """Return a run with the ego at 20 m/s in lane 1 from the origin, for 2 s, and the given NPCs."""
    return view_of(trace_of(vehicle(0.0, 4.0, speed=20.0, ticks=30), *npcs, **more))


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
    asked = Scenario(npcs=npcs, ego_speed=24.0, traffic=style)
    trace = Highway().rollout(asked, lambda: lambda seen: (0.0, 0.0))
    view = view_of(trace)
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
