"""The picture of roads that are not straight: the world's lanes, and cells along the bend."""

import math

import pytest

from pytest_pafot.model.trace import HEADING, X, Y
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
