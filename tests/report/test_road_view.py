"""The picture of roads that are not straight: the world's lanes, and cells along the bend."""

import math
from dataclasses import replace

import numpy as np
import pytest

from pytest_pafot.model.grid import Cell
from pytest_pafot.model.trace import HEADING, LANE, X, Y
from tests.helpers.picture import picture_at
from tests.report.builders import bend_trace, view_of


@pytest.fixture(scope="module")
def view():
    return view_of(bend_trace())


def test_curved_lanes_are_lines_and_straight_roads_none(view):
    trace = bend_trace()
    assert view.road.lanes == ()
    assert len(view.road.shapes) == len(trace.lanes)
    for shape, lane in zip(view.road.shapes, trace.lanes, strict=True):
        assert shape.points[0] == pytest.approx((lane.x, lane.y), abs=0.01)
        assert shape.width == lane.width


def test_vehicles_are_where_they_are_in_the_world(view):
    trace = bend_trace()
    vehicles = picture_at(view, trace.duration).vehicles
    for box, state in zip(vehicles, trace.states[-1], strict=True):
        assert (box.along, box.across) == pytest.approx((state[X], state[Y]), abs=0.01)
        assert math.cos(box.heading) == pytest.approx(math.cos(state[HEADING]), abs=0.01)


def test_cells_follow_the_bend_and_lie_on_lanes(view):
    trace = bend_trace()
    width = trace.lanes[0].width
    for time in (0.0, 2.5, 5.0, trace.duration):
        picture = picture_at(view, time)
        ego = picture.vehicles[0]
        places = {cell.cell: cell for cell in picture.cells if cell.exists}
        assert set(places) in ({1, 2, 6, 7, 8}, {2, 3, 4, 5, 6})
        for cell, place in places.items():
            away = math.hypot(place.along - ego.along, place.across - ego.across)
            assert away == pytest.approx(math.hypot(8.0 * Cell(cell).row, width * Cell(cell).column), abs=3.0)
            lanes = [np.array(shape.points) for shape in view.road.shapes]
            assert min(np.hypot(*(each - (place.along, place.across)).T).min() for each in lanes) < 1.5


def test_an_ego_off_all_lanes_has_no_cells(view):
    trace = bend_trace()
    states = trace.states.copy()
    states[:, 0, LANE] = -1
    assert {place for row in view_of(replace(trace, states=states)).grid for place in row} == {None}
