"""NPCs' places relative to the ego in a bend, from every source, against angles and radii of a circle."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.criticality import Encounters, RoadFrame, longitudinal_gap
from pytest_pafot.model.grid import Cell
from pytest_pafot.model.trace import HEADING, SPEED, Lane, X, Y
from pytest_pafot.model.vehicle_type import CAR
from pytest_pafot.oracle.run import Run
from pytest_pafot.world.engines.run import VehiclesOfRun
from pytest_pafot.world.kernel.bodies import COLUMNS, Body
from pytest_pafot.world.kernel.loop import EgoDriver
from pytest_pafot.world.kernel.places import Places
from pytest_pafot.world.limits import NpcLimits
from pytest_pafot.world.roads.network import STEP, Column, Line, NetworkRoad
from tests.helpers.traces import LANE_WIDTH, LENGTH, WIDTH, scenario_of, trace_of, vehicle
from tests.report.builders import view_of

RADIUS = 20.0
"""The radius of the ego's way, which turns to the right [m]; the other lane is outside, to the left."""
POINTS = 200


def circle():
    """Return a road of two lanes around the point (0, RADIUS)."""
    angle = np.arange(POINTS) * STEP / RADIUS
    line = Line(
        x=RADIUS * np.sin(angle), y=RADIUS * (1 - np.cos(angle)), heading=angle, piece=np.zeros(POINTS, dtype=np.intp)
    )
    lanes = tuple(
        Lane(x=0.0, y=across, heading=0.0, length=100.0, width=LANE_WIDTH, speed_limit=20.0)
        for across in (-LANE_WIDTH, 0.0)
    )
    zeros = [0.0] * POINTS
    columns = tuple(
        Column(
            exists=[True] * POINTS,
            across=[lane.y] * POINTS,
            direction=list(angle),
            lean=zeros,
            speed=zeros,
            sharpest=zeros,
            part=[number] * POINTS,
        )
        for number, lane in enumerate(lanes)
    )
    return NetworkRoad(
        lanes=lanes,
        columns=columns,
        shaped=lambda *_: (columns, list(lanes)),
        limits=NpcLimits(),
        sections=frozenset(),
        route=(),
        others=(),
        line=line,
        lane_width=LANE_WIDTH,
        speed_limit=20.0,
        start=20.0,
        ego_lane=0,
        ego_speed=10.0,
    )


def driven(*vehicles, touched=False):
    """Return the trace of a recorded run; each vehicle has angles and radii around the centre, in rad and m."""
    angles, radii = (np.array(rows).T for rows in zip(*vehicles, strict=True))
    states = np.zeros((*angles.shape, COLUMNS))
    states[..., X], states[..., Y] = radii * np.sin(angles), RADIUS - radii * np.cos(angles)
    states[..., HEADING], states[..., SPEED] = angles, 10.0
    road, count, ticks, rows = circle(), len(vehicles), len(states) - 1, states.ravel()
    bodies, shown = ([Body(LENGTH, WIDTH) for _ in vehicles] for _ in range(2))
    way = {"starts": angles[0] * RADIUS, "ways": [None] * count, "end": road.end, "beside": None}
    places = Places(bodies, shown, bends=road.bends, **way, ticks=ticks)
    for tick, now in enumerate(states):
        for body, state in zip(bodies, now, strict=True):
            body.place(*state[:4])
        places.see(rows, tick * count * COLUMNS)
    scenario = scenario_of(count - 1)
    run = object.__new__(VehiclesOfRun)
    run.rules = SimpleNamespace(
        physics_hz=15, ads_hz=5, road=road, crossings=None, obstacles=(), ego=CAR, step_limit=None
    )
    run.scenario, run.director = (scenario, SimpleNamespace(executed=scenario, arrivals=(), driven=()))
    run.places, run.rows, run.sizes = places, rows, [(LENGTH, WIDTH)] * count
    run.loop = SimpleNamespace(tick=ticks, is_over=touched, ego_touched=touched, npcs_touched=False)
    return run.trace(EgoDriver(bodies[0], 3))


def approach(last, radius):
    """Return an ego and an NPC on a circle; the NPC is this far ahead at the end, along that circle [m]."""
    gaps = np.linspace(12.0, last, 10)
    return (np.full(10, 1.0), np.full(10, radius)), (1.0 + gaps / radius, np.full(10, radius))


def test_all_sources_agree_on_cell_in_a_bend():
    """The NPC is 2.64 m ahead along their circle, but only 2.2 m along the ego's way, which is inside it."""
    trace = driven(*approach(2.64, RADIUS + LANE_WIDTH), touched=True)
    run = Run(trace)
    assert Encounters(trace).ahead[0, -1] == pytest.approx(2.64, abs=0.01)
    assert trace.track[-1, 1, 0] - trace.track[-1, 0, 0] == pytest.approx(2.2, abs=0.01)
    assert trace.collision.cell == run.event_cell == run.closest_approach.cell == run.worst_ttc.cell == Cell.FRONT
    assert view_of(trace).vehicles[1].cells[-1] == Cell.FRONT


def test_all_sources_agree_on_npc_entering_ego_cell():
    trace = driven(*approach(2.4, RADIUS + LANE_WIDTH), touched=True)
    positions = Encounters(trace)
    assert positions.cell(0, trace.ticks) is None
    assert view_of(trace).vehicles[1].cells[-1] == 0
    before = max(tick for tick in range(trace.ticks) if positions.cell(0, tick) is not None)
    assert trace.collision.cell == Run(trace).closest_approach.cell == positions.cell(0, before) == Cell.FRONT


@given(
    st.floats(0.5, 2.0), st.floats(0.5, 2.0), st.floats(RADIUS - 1, RADIUS + 5), st.floats(RADIUS - 1, RADIUS + 5)
)  # fmt: skip
def test_distance_ahead_in_circle_is_the_middle_arc(ego_angle, npc_angle, ego_radius, npc_radius):
    trace = driven(([ego_angle], [ego_radius]), ([npc_angle], [npc_radius]))
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
