"""What the picture of a road is made of: the world's lanes, and the distances of cells from the ego."""

import pytest

from pytest_pafot import Highway
from tests.helpers.tables import table
from tests.helpers.traces import LENGTH
from tests.report.builders import bend_trace, constant_speed, is_close, scenario, view_of


def test_curved_lanes_are_lines_and_vehicles_are_where_the_world_has_them():
    trace = bend_trace()
    view = view_of(trace)
    assert view.road.lanes == ()
    for shape, lane in zip(view.road.shapes, trace.lanes, strict=True):
        assert shape.points[0] == pytest.approx((lane.x, lane.y), abs=0.01)
        assert shape.width == lane.width
    for shown, (x, y, *_) in zip(view.vehicles, trace.states[-1], strict=True):
        assert is_close(shown.along[-1], x)
        assert is_close(shown.across[-1], y)


@table("style", ["paper", "hostile", "everyday"])
def test_npcs_arrive_at_the_distance_of_their_cells_in_any_traffic(style):
    chains = [(8, 24.0), (1, 24.0), (2, 24.0)], [(4, 24.0), (5, 24.0), (6, 24.0)]
    trace = Highway().rollout(scenario(*chains, ego_speed=24.0, traffic=style), constant_speed)
    road, (ego, *npcs) = view_of(trace).road, trace.states.swapaxes(0, 1)
    for npc, (least, start, seconds), row in zip(
        (0, 1), (road.ahead, road.behind), (1, -1), strict=True
    ):
        tick = trace.arrivals[npc][2]
        place = LENGTH + max(road.clearance, least, start + seconds * ego[tick, 3])
        assert npcs[npc][tick, 0] - ego[tick, 0] == pytest.approx(row * place, abs=2.6)
