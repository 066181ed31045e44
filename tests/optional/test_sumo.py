"""Nets of SUMO as a world: lanes, runs, files, and errors."""

import functools
import itertools
import math
import re
import sys
from typing import Any, ClassVar

import numpy as np
import pytest

import pytest_pafot as pafot
from pytest_pafot import Cell, Highway, PositionInstruction, Scenario, SimulatorWorld
from pytest_pafot.model.trace import Outcome
from pytest_pafot.world import WorldError
from tests.helpers.tables import table
from tests.helpers.world_cases import constant_speed

pytest.importorskip("sumolib", reason='needs pip install "pytest-pafot[sumo]"')

from pytest_pafot.simulators.sumo import Sumo, Way

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
    # so all lanes of the edge are one lane further to the left
    for index, y in ((0, 0), (1, 4), (2, 8)):
        old = y - 4
        at_left = at_left.replace(
            lane_text("three", index, [(505, old), (2000, old)]),
            lane_text("three", index, [(505, y), (2000, y)]),
        )
    way = Way(str(net(at_left)), ["two", "three"])
    assert way.left == 1
    assert [line[0] for line in way.lines] == [(505.0, 8.0), (0.0, LANE), (0.0, 0.0)]
    assert [line[-1] for line in way.lines] == [(2000.0, 8.0), (2000.0, LANE), (2000.0, 0.0)]


@table(("route", "message"), [
    (["two", "none"], "edges for passenger cars, received 'none'. Use edges such as"),
    (None, "this network has more than one route, received None. Write route="),
])  # fmt: skip
def test_a_route_that_a_net_does_not_have_is_refused_by_its_edge(net, route, message):
    path = net(JOINED)
    with pytest.raises(WorldError, match=message):
        _ = pafot.sumo(path, route=route).road


def test_a_first_lane_that_the_route_does_not_have_is_refused(net):
    with pytest.raises(
        WorldError, match=re.escape("start_lane: expected lane 0 or 1 of the edge 'two'")
    ):
        _ = pafot.sumo(net(JOINED), route=["two", "three"], start_lane=2).road


def test_what_is_no_net_is_refused(tmp_path):
    (tmp_path / "text.net.xml").write_text("<net", encoding="utf-8")
    for name in ("missing.net.xml", "text.net.xml"):
        with pytest.raises(WorldError, match="a SUMO network, as written by netconvert, received"):
            _ = pafot.sumo(tmp_path / name).road


def test_a_file_names_the_net_by_its_content(net):
    path = net(BENT)
    data = pafot.sumo(path, duration=30.0).to_dict()
    assert SimulatorWorld.from_dict(Sumo, data).to_dict() == data
    path.write_text(BENT.replace('speed="20.0"', 'speed="19.0"'), encoding="utf-8")
    with pytest.raises(WorldError, match=r"user.net.xml as it was saved, received a changed file"):
        SimulatorWorld.from_dict(Sumo, data)


# Arguments and files.


def test_npcs_follow_a_bend_of_a_users_net(net):
    world = pafot.sumo(net(BENT), start_speed=15.0, duration=30.0)
    told = PositionInstruction(Cell.FRONT, 15.0)
    scenario = Scenario(npcs=((told,),), ego_lane=0, ego_speed=world.start[1], gene_seconds=30.0)
    trace = world.rollout(
        scenario, lambda: lambda seen: pafot.LaneCommand(lane=0, acceleration=0.0)
    )
    assert trace.outcome is Outcome.COMPLETED, trace.error
    x, y = trace.states[:, 1, :2].T
    in_bend = (x > 420) & (y > -180)  # y grows to the right in a run
    assert in_bend.sum() > 100
    from_centre = np.hypot(x[in_bend] - 400.0, y[in_bend] + 200.0)
    assert np.abs(from_centre - 196.0).max() < 1.0


def test_without_sumolib_the_error_names_the_extra(monkeypatch, net):
    monkeypatch.setitem(sys.modules, "sumolib.net", None)
    with pytest.raises(WorldError, match=re.escape("pip install 'pytest-pafot[sumo]'")):
        _ = pafot.sumo(net(BENT)).road


# Findings in SUMO itself.


class Logged(Sumo):
    """A net that keeps what it has stated of the last run, in SUMO's own axes, in ``log``."""

    log: ClassVar[list[tuple[Any, ...]]] = []
    starts: ClassVar[list[Any]] = []

    def start(self, vehicles, seed):
        super().start(vehicles, seed)
        self.log[:], self.starts[:] = [tuple(self.states())], vehicles

    def step(self, controls):
        super().step(controls)
        self.log.append(tuple(self.states()))


class BrakesLate:
    def __call__(self, seen):
        ego = seen.ego
        gaps = [each.x - ego.x for each in seen.others if each.lane == ego.lane and each.x > ego.x]
        return pafot.LaneCommand(
            lane=ego.lane, acceleration=-3.0 if min(gaps, default=99.0) < 12.0 else 0.0
        )


class ChangesBlindly:
    def __call__(self, seen):
        return pafot.LaneCommand(lane=int(seen.time / 4) % 2, acceleration=0.0)


class Steady:
    def __call__(self, seen):
        return pafot.LaneCommand(lane=0, acceleration=0.0)


def never_collides(run):
    assert not run.collision, run.explain()


def box(x, y, degrees, length, width):
    """Return the corners of a vehicle from SUMO's place of its front and its compass heading."""
    ahead = np.array([math.sin(math.radians(degrees)), math.cos(math.radians(degrees))])
    aside = np.array([-ahead[1], ahead[0]]) * width / 2
    front, back = np.array([x, y]), np.array([x, y]) - ahead * length
    return np.array([front - aside, front + aside, back + aside, back - aside])


def touch(one, two):
    """Return whether two boxes overlap: along no side of either, their corners are apart."""
    axes = [side for each in (one, two) for side in (each[1] - each[0], each[2] - each[1])]
    return all(
        (one @ axis).max() >= (two @ axis).min() and (two @ axis).max() >= (one @ axis).min()
        for axis in axes
    )


def in_sumo(net, edges, npc):
    """Replay the last run in SUMO, and return the ticks at which the boxes that it states overlap, and it says so."""
    libsumo = pytest.importorskip("libsumo")
    quiet = [
        "--no-step-log",
        "--no-warnings",
        "--collision.action",
        "warn",
        "--collision.mingap-factor",
        "0",
    ]
    # Without the resolution, SUMO takes vehicles next to each other in a lane for a collision.
    libsumo.start(
        ["sumo", "-n", str(net), "--step-length", "0.05", "--lateral-resolution", "0.25", *quiet]
    )
    overlaps, reports = [], []
    try:
        libsumo.route.add("route", edges)
        names = ["ego", *(f"npc {number}" for number in range(len(Logged.starts) - 1))]
        for name, start in zip(names, Logged.starts, strict=True):
            libsumo.vehicletype.copy("DEFAULT_VEHTYPE", name)
            libsumo.vehicletype.setLength(name, start.length)
            libsumo.vehicletype.setWidth(name, start.width)
            libsumo.vehicle.add(name, "route", typeID=name)
            libsumo.vehicle.setSpeedMode(name, 0)
            libsumo.vehicle.setLaneChangeMode(name, 0)
        pair = ("ego", f"npc {npc}")
        for tick, states in enumerate(Logged.log):
            for name, (x, y, heading, speed) in zip(names, states, strict=True):
                libsumo.vehicle.moveToXY(name, "", -1, x, y, heading, 2)
                libsumo.vehicle.setSpeed(name, speed)
            libsumo.simulationStep()
            ego, other = (
                box(
                    *libsumo.vehicle.getPosition(name), libsumo.vehicle.getAngle(name),
                    libsumo.vehicle.getLength(name), libsumo.vehicle.getWidth(name),
                )
                for name in pair
            )  # fmt: skip
            if touch(ego, other):
                overlaps.append(tick)
            if any(
                {each.collider, each.victim} == {*pair}
                for each in libsumo.simulation.getCollisions()
            ):
                reports.append(tick)
    finally:
        libsumo.close()
    return overlaps, reports


@pytest.mark.parametrize("count", [3, pytest.param(20, marks=pytest.mark.oracle)])
def test_findings_hold_when_sumo_moves_the_vehicles(tmp_path, count):
    """SUMO's own check takes boxes along the lane, so it may be early or silent where only corners touch."""
    nets = {
        "bent": (BENT, {"start_speed": 15.0}, ["road"]),
        "joined": (JOINED, {}, ["two", "three"]),
    }
    tried, seen = 0, 0
    for seed, (name, (text, arguments, edges)), ads in itertools.product(
        range(1, 20), nets.items(), (BrakesLate, ChangesBlindly, Steady)
    ):
        path = tmp_path / f"{name}.net.xml"
        path.write_text(text, encoding="utf-8")
        world = SimulatorWorld(
            functools.partial(Logged, net=str(path), route=edges, **arguments), duration=20.0
        )
        for finding in pafot.explore(
            ads, holds=never_collides, world=world, runs=25, seed=seed
        ).findings:
            collision = world.rollout(finding.scenario, ads).collision
            overlaps, reports = in_sumo(path, edges, collision.npc)
            assert overlaps == [collision.tick], finding.id
            tried, seen = tried + 1, seen + (reports[-1:] == [collision.tick])
        if tried >= count:
            break
    print(f"{tried} findings, of which SUMO's own check reports {seen}")
    assert seen >= 0.9 * tried
