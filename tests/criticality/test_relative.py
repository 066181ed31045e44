"""NPCs' places relative to the ego in a bend, from every source, against angles and radii of a circle."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot import Cell, Run
from pytest_pafot.criticality import Encounters, RoadFrame, longitudinal_gap
from tests.helpers.drives import bent
from tests.helpers.traces import LANE_WIDTH, LENGTH, scenario_of, trace_of, vehicle
from tests.report.builders import view_of

RADIUS = 20.0
"""The radius of the ego's way, which turns to the right, in lane 1 [m]; lane 0 is outside, to the left."""


def driven(*vehicles):
    """Return a run; each vehicle has ways along its own circle [m] from a first angle [rad], and a radius [m]."""
    straight = [
        vehicle(angle * RADIUS + np.array(ways), LANE_WIDTH + RADIUS - radius, speed=10.0)
        for angle, ways, radius in vehicles
    ]
    moved, road = bent(*straight, radius=RADIUS)
    return trace_of(*moved, scenario=scenario_of(len(vehicles) - 1), **road)


def approach(last):
    """Return a run on the circle outside; the NPC is this far ahead at the end, along that circle [m]."""
    gaps, radius = np.linspace(12.0, last, 10), RADIUS + LANE_WIDTH
    return driven((1.0, np.zeros(10), radius), (1.0 + 12.0 / radius, gaps - 12.0, radius))


def test_all_sources_agree_on_cell_in_a_bend():
    """The NPC is 2.64 m ahead along their circle, but only 2.2 m along the ego's way, which is inside it."""
    trace = approach(2.64)
    run = Run(trace)
    assert trace.road.ahead[0, -1] == pytest.approx(2.64, abs=0.01)
    assert trace.track[-1, 1, 0] - trace.track[-1, 0, 0] == pytest.approx(2.2, abs=0.01)
    assert run.event_cell == run.closest_approach.cell == run.worst_ttc.cell == Cell.FRONT
    assert view_of(trace).vehicles[1].cells[-1] == Cell.FRONT


def test_npc_that_enters_ego_cell_has_its_cell_before():
    trace = approach(2.4)
    positions = trace.road
    assert positions.cell(0, trace.ticks, trace.sizes[0, 0]) is None
    assert view_of(trace).vehicles[1].cells[-1] == 0
    assert (
        Run(trace).closest_approach.cell
        == positions.last_cell(0, trace.ticks, trace.sizes[0, 0])
        == Cell.FRONT
    )


@given(
    st.floats(0.5, 2.0), st.floats(0.5, 2.0), st.floats(RADIUS - 1, RADIUS + 5), st.floats(RADIUS - 1, RADIUS + 5)
)  # fmt: skip
def test_distance_ahead_in_circle_is_the_middle_arc(ego_angle, npc_angle, ego_radius, npc_radius):
    trace = driven((ego_angle, [0.0], ego_radius), (npc_angle, [0.0], npc_radius))
    arc = (npc_angle - ego_angle) * (ego_radius + npc_radius) / 2
    frame = RoadFrame(trace)
    assert frame.ahead[0, 0] == pytest.approx(arc, abs=0.05)
    assert frame.right[0, 0] == pytest.approx(ego_radius - npc_radius, abs=0.01)
    assert longitudinal_gap(trace)[0, 0] == pytest.approx(max(abs(arc) - LENGTH, 0.0), abs=0.05)
    assert Encounters(trace).ego_follows[0, 0] == (frame.ahead[0, 0] >= 0)


def test_grid_off_a_straight_road_follows_the_road():
    """The ego has left the road and turned by a right angle; the NPC is still ahead of it along the road."""
    ego = vehicle(0.0, 40.0, heading=math.pi / 2, lane=-1, ticks=0)
    trace = trace_of(ego, vehicle(30.0, 40.0, lane=-1, ticks=0), scenario=scenario_of(1))
    assert Run(trace).closest_approach.cell == Cell.FRONT
    assert view_of(trace).vehicles[1].cells == (Cell.FRONT,)
