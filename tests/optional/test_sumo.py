"""Nets of SUMO as a world: lanes, runs, files, and errors."""

import itertools
import math
import re
import sys

import numpy as np
import pytest

import pytest_pafot as pafot
from pytest_pafot import Cell, Highway, PositionInstruction, Scenario, SimulatorWorld
from pytest_pafot.model.trace import Outcome
from pytest_pafot.world import WorldError
from tests.helpers.tables import table
from tests.helpers.world_cases import constant_speed

pytest.importorskip("sumolib", reason='needs pip install "pytest-pafot[sumo]"')

from pytest_pafot.world.sumo import Sumo, Way

WORLD = pafot.sumo(duration=12.0)
LANE = 4.0


def test_vehicles_move_as_on_the_highway():
    told = PositionInstruction(Cell.LEFT, 20.0), PositionInstruction(Cell.FRONT_RIGHT, 25.0)
    scenario = Scenario(npcs=tuple((each,) for each in told), ego_speed=22.0, gene_seconds=12.0)
    here = WORLD.rollout(scenario, constant_speed).states
    there = Highway(physics_hz=20, duration=12.0).rollout(scenario, constant_speed).states
    assert len(here) == len(there) == 241
    assert np.abs(here - there).max() < 1e-9


# Nets.


def lane_text(edge, index, points, speed=20.0, width=LANE, more=""):
    shape = " ".join(f"{x:.2f},{y:.2f}" for x, y in points)
    length = sum(math.dist(*pair) for pair in itertools.pairwise(points))
    return (
        f'<lane id="{edge}_{index}" index="{index}" speed="{speed}" length="{length:.2f}" width="{width}" '
        f'shape="{shape}" {more}/>'
    )


def bent(offset):
    """Return the points of a lane: 400 m to the east, a quarter of a circle to the left, and 400 m to the north."""
    radius = 200.0 - offset
    arc = [
        (400.0 + radius * math.sin(angle), 200.0 - radius * math.cos(angle))
        for angle in np.linspace(0, math.pi / 2, 65)
    ]
    return [(0.0, offset), *arc, (400.0 + radius, 600.0)]


BENT = f"""<net version="1.20"><edge id="road" from="a" to="b" priority="1">
{lane_text("road", 0, bent(0.0))}{lane_text("road", 1, bent(LANE))}</edge>
<junction id="a" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape=""/>
<junction id="b" type="dead_end" x="600" y="600" incLanes="road_0 road_1" intLanes="" shape=""/></net>"""

JOINED = f"""<net version="1.20">
<edge id=":m_0" function="internal">
{lane_text(":m_0", 0, [(500, 0), (505, 0)])}{lane_text(":m_0", 1, [(500, LANE), (505, LANE)])}</edge>
<edge id="two" from="a" to="m" priority="1">{lane_text("two", 0, [(0, 0), (500, 0)])}
{lane_text("two", 1, [(0, LANE), (500, LANE)], 15.0)}</edge>
<edge id="three" from="m" to="b" priority="1">{lane_text("three", 0, [(505, -LANE), (2000, -LANE)])}
{lane_text("three", 1, [(505, 0), (2000, 0)])}{lane_text("three", 2, [(505, LANE), (2000, LANE)])}
{lane_text("three", 3, [(505, 7), (2000, 7)], more='disallow="passenger"')}</edge>
<edge id="back" from="b" to="a" priority="1">{lane_text("back", 0, [(2000, 20), (0, 20)])}</edge>
<junction id="a" type="dead_end" x="0" y="0" incLanes="back_0" intLanes="" shape=""/>
<junction id="m" type="priority" x="500" y="0" incLanes="two_0 two_1" intLanes=":m_0_0 :m_0_1" shape="">
<request index="0" response="00" foes="00" cont="0"/><request index="1" response="00" foes="00" cont="0"/></junction>
<junction id="b" type="dead_end" x="2000" y="0" incLanes="three_0 three_1 three_2 three_3" intLanes="" shape=""/>
<connection from="two" to="three" fromLane="0" toLane="1" via=":m_0_0" dir="s" state="M"/>
<connection from="two" to="three" fromLane="1" toLane="2" via=":m_0_1" dir="s" state="M"/>
<connection from=":m_0" to="three" fromLane="0" toLane="1" dir="s" state="M"/>
<connection from=":m_0" to="three" fromLane="1" toLane="2" dir="s" state="M"/></net>"""


@pytest.fixture
def net(tmp_path):
    def written(text):
        path = tmp_path / "user.net.xml"
        path.write_text(text, encoding="utf-8")
        return path

    return written


def test_lanes_of_a_route_are_lines_from_the_left(net):
    way = Way(str(net(JOINED)), ["two", "three"])
    assert way.edges == ["two", "three"]
    assert way.lines == [
        [(0.0, LANE), (500.0, LANE), (505.0, LANE), (2000.0, LANE)],
        [(0.0, 0.0), (500.0, 0.0), (505.0, 0.0), (2000.0, 0.0)],
        [(505.0, -LANE), (2000.0, -LANE)],  # the lane that is not for cars is none
    ]
    assert (way.width, way.limit, way.left) == (LANE, 15.0, 0)


def test_a_lane_that_begins_at_the_left_is_the_first_line(net):
    at_left = JOINED.replace('fromLane="0" toLane="1"', 'fromLane="0" toLane="0"')
    at_left = at_left.replace('fromLane="1" toLane="2"', 'fromLane="1" toLane="1"')
    for index, y in ((0, 0), (1, 4), (2, 8)):  # so all lanes of the edge are one lane further to the left
        old = y - 4
        at_left = at_left.replace(
            lane_text("three", index, [(505, old), (2000, old)]), lane_text("three", index, [(505, y), (2000, y)])
        )
    way = Way(str(net(at_left)), ["two", "three"])
    assert way.left == 1
    assert [line[0] for line in way.lines] == [(505.0, 8.0), (0.0, LANE), (0.0, 0.0)]
    assert [line[-1] for line in way.lines] == [(2000.0, 8.0), (2000.0, LANE), (2000.0, 0.0)]


@table(("route", "message"), [
    (["two", "none"], "edges of the net for passenger cars, received 'none'; there are"),
    (None, "this net has more than one, received None; write route="),
])  # fmt: skip
def test_a_route_that_a_net_does_not_have_is_refused_by_its_edge(net, route, message):
    path = net(JOINED)
    with pytest.raises(WorldError, match=message):
        _ = pafot.sumo(path, route=route).road


def test_a_first_lane_that_the_route_does_not_have_is_refused(net):
    with pytest.raises(WorldError, match=re.escape("start_lane: expected one of 0, 1, the lanes of 'two'")):
        _ = pafot.sumo(net(JOINED), route=["two", "three"], start_lane=2).road


def test_what_is_no_net_is_refused(tmp_path):
    (tmp_path / "text.net.xml").write_text("<net", encoding="utf-8")
    for name in ("missing.net.xml", "text.net.xml"):
        with pytest.raises(WorldError, match="a net of SUMO, as its netconvert writes it, received"):
            _ = pafot.sumo(tmp_path / name).road


def test_a_file_names_the_net_by_its_content(net):
    path = net(BENT)
    data = pafot.sumo(path, duration=30.0).to_dict()
    assert SimulatorWorld.of(Sumo, data).to_dict() == data
    path.write_text(BENT.replace('speed="20.0"', 'speed="19.0"'), encoding="utf-8")
    with pytest.raises(WorldError, match=r"user.net.xml as it was, received another content"):
        SimulatorWorld.of(Sumo, data)


# Arguments and files.


def test_npcs_follow_a_bend_of_a_users_net(net):
    world = pafot.sumo(net(BENT), start_speed=15.0, duration=30.0)
    told = PositionInstruction(Cell.FRONT, 15.0)
    scenario = Scenario(npcs=((told,),), ego_lane=0, ego_speed=world.start[1], gene_seconds=30.0)
    trace = world.rollout(scenario, lambda: lambda seen: pafot.Drive(lane=0, acceleration=0.0))
    assert trace.outcome is Outcome.SAFE, trace.error
    x, y = trace.states[:, 1, :2].T
    in_bend = (x > 420) & (y > -180)  # y grows to the right in a run
    assert in_bend.sum() > 100
    from_centre = np.hypot(x[in_bend] - 400.0, y[in_bend] + 200.0)
    assert np.abs(from_centre - 196.0).max() < 1.0


def test_without_sumolib_the_error_names_the_extra(monkeypatch, net):
    monkeypatch.setitem(sys.modules, "sumolib.net", None)
    with pytest.raises(WorldError, match=re.escape("pip install 'pytest-pafot[sumo]'")):
        _ = pafot.sumo(net(BENT)).road
