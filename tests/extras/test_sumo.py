"""SUMO as a world: what it moves and what it only keeps, its seeds, a user's net, files, and errors."""

import itertools
import math
import multiprocessing
import os
import re
import sys

import numpy as np
import pytest

import pytest_pafot as pafot
from pytest_pafot import (
    Cell,
    Free,
    Highway,
    Manoeuvre,
    Outcome,
    PositionInstruction,
    Scenario,
    SimulatorWorld,
    WorldError,
)
from pytest_pafot.world.codec import described, from_dict
from tests.helpers.tables import table

pytest.importorskip("libsumo", reason='needs pip install "pytest-pafot[sumo]"')

from pytest_pafot.extras.sumo import DRIVERS, Sumo, Way

WORLD = pafot.sumo(duration=12.0)
LANE = 4.0


def keeps_its_speed():
    return lambda seen: (0.0, 0.0)


def scenario(*firsts, lane=1, seed=0):
    npcs = tuple((first,) for first in firsts)
    return Scenario(npcs=npcs, ego_lane=lane, ego_speed=22.0, gene_seconds=12.0, seed=seed)


def behind(driver, speed=22.0, ahead=-40.0, beside=0):
    return Free(beside=beside, ahead=ahead, speed=speed, driver=driver)


FAR = behind("sumo-idm", ahead=190.0, beside=2)


@pytest.mark.parametrize("others", [(), (FAR,)], ids=["without its drivers", "with one far away"])
def test_vehicles_that_sumo_only_keeps_move_as_on_the_highway(others):
    told = PositionInstruction(Cell.LEFT, 20.0), PositionInstruction(Cell.FRONT_RIGHT, 25.0)
    here = WORLD.rollout(scenario(*told, *others), keeps_its_speed).states[:, :3]
    there = Highway(physics_hz=20, duration=12.0).rollout(scenario(*told), keeps_its_speed).states
    assert len(here) == len(there) == 241
    assert np.abs(here - there).max() < 1e-9


@pytest.mark.parametrize("driver", sorted(DRIVERS))
def test_drivers_of_sumo_see_the_ego_and_brake_behind_it(driver):
    trace = WORLD.rollout(scenario(behind(driver, 26.0, -60.0)), lambda: lambda seen: (-2.0, 0.0))
    npc = trace.states[:, 1]
    assert trace.outcome is Outcome.SAFE
    assert npc[0, 3] == 26.0
    beside = abs(npc[:, 1] - trace.ego[:, 1]) > LANE / 2
    assert beside.any() or npc[:, 3].min() < 15.0  # it has passed the ego, or slowed down with it


def test_a_driver_of_sumo_follows_by_its_own_model():
    in_lane = {"lcSpeedGain": 0, "lcKeepRight": 0, "lcStrategic": -1}
    world = pafot.sumo(drivers={"calm": {"carFollowModel": "IDM", "tau": 2.0, **in_lane}}, duration=12.0)
    trace = world.rollout(scenario(behind("calm", 26.0, -60.0)), lambda: lambda seen: (-1.0, 0.0))
    for tick in (40, 80, 120):  # IDM of Treiber, Hennecke and Helbing (2000), with SUMO's defaults
        (ego_x, ego_speed), (x, speed) = trace.states[tick, :2][:, [0, 3]]
        most, comfortable, least_gap, wanted = 2.6, 4.5, 2.5, 26.0
        gap = ego_x - x - 5.0
        desired = least_gap + max(0.0, 2.0 * speed + speed * (speed - ego_speed) / (2 * math.sqrt(most * comfortable)))
        expected = most * (1 - (speed / wanted) ** 4 - (desired / gap) ** 2)
        assert (trace.states[tick + 1, 1, 3] - speed) * 20 == pytest.approx(expected, rel=0.1)


def test_a_lane_change_of_sumo_takes_its_time():
    trace = WORLD.rollout(scenario(behind("sumo-krauss", 26.8, -30.0), lane=2), lambda: lambda seen: (-1.0, 0.0))
    across = np.diff(trace.states[:, 1, 1])
    moving = np.abs(across) > 1e-9
    assert np.abs(across).max() * 20 == pytest.approx(
        LANE / 3.0, rel=0.05
    )  # a lane in the three seconds of the default
    assert moving.sum() >= 3.0 * 20 - 2


def test_runs_repeat_to_the_last_bit_and_follow_from_their_seed():
    drives = behind("sumo-krauss", 24.0), behind("sumo-eidm", 24.0, 30.0, 1)
    first, other, again = (WORLD.rollout(scenario(*drives, seed=seed), keeps_its_speed) for seed in (3, 4, 3))
    assert np.array_equal(first.states, again.states)
    assert not np.array_equal(first.states, other.states)


def states_of(seed):
    return WORLD.rollout(scenario(behind("sumo-krauss", 24.0), seed=seed), keeps_its_speed).states.tobytes()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_forked_process_has_the_same_runs():
    here = states_of(7)
    with multiprocessing.get_context("fork").Pool(1) as pool:
        assert pool.apply(states_of, (7,)) == here


def test_runs_of_two_worlds_follow_each_other_in_a_process():
    other = pafot.sumo(lanes=3, hz=10, duration=12.0)
    drives = scenario(behind("sumo-krauss", 24.0))
    before = WORLD.rollout(drives, keeps_its_speed)
    other.rollout(drives, keeps_its_speed)
    assert np.array_equal(WORLD.rollout(drives, keeps_its_speed).states, before.states)


def test_a_policy_that_uses_libsumo_in_the_same_process_is_noticed():
    import libsumo

    def steps_it(seen):
        libsumo.simulationStep()
        return 0.0, 0.0

    with pytest.raises(WorldError, match="nobody else uses libsumo in this process"):
        WORLD.rollout(scenario(behind("sumo-krauss", 24.0)), lambda: steps_it)


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


def test_vehicles_that_are_placed_ask_nobody_for_room():
    import libsumo

    modes = []

    def looks(seen):
        modes.append([libsumo.vehicle.getLaneChangeMode(name) for name in ("ego", "npc0", "npc1")])
        return 0.0, 0.0

    WORLD.rollout(scenario(PositionInstruction(Cell.LEFT, 20.0), behind("sumo-idm")), lambda: looks)
    assert modes[0][:2] == [0, 0]
    assert modes[0][2] != 0


def test_drivers_of_sumo_follow_a_bend_of_a_users_net(net):
    world = pafot.sumo(net(BENT), start_speed=15.0, duration=30.0)
    _, speed = world.start
    drives = Scenario(npcs=((behind("sumo-idm", 15.0, 40.0),),), ego_lane=0, ego_speed=speed, gene_seconds=30.0)
    trace = world.rollout(drives, lambda: lambda seen: pafot.Drive(lane=0, acceleration=0.0))
    assert trace.outcome is Outcome.SAFE, trace.error
    x, y, heading = trace.states[:, 1, :3].T
    in_bend = (x > 420) & (y > -180)  # y grows to the right in a run
    assert in_bend.sum() > 100
    from_centre = np.hypot(x[in_bend] - 400.0, y[in_bend] + 200.0)
    lane = np.where(from_centre > 198.0, 200.0, 196.0)
    assert np.abs(from_centre - lane).max() < 2.1  # within its lane, or on the way to the other one
    course = np.arctan2(np.diff(y), np.diff(x))
    assert np.abs(np.diff(heading)).max() < 0.1
    assert np.abs(course[in_bend[1:]] - heading[1:][in_bend[1:]]).max() < 0.1


@table(
    ("route", "message"),
    [
        (["two", "none"], "edges of the net for passenger cars, received 'none'; there are"),
        (None, "this net has more than one, received None; write route="),
    ],
)
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


@table(
    ("arguments", "message"),
    [
        ({"hz": 15}, re.escape("hz: expected a divisor of 1000, such as 10, 20, 25 or 50")),
        ({"drivers": {"long": {"length": 9}}}, r"drivers\['long'\]: expected SUMO's attributes.*received length"),
        ({"drivers": {"long": 9}}, r"drivers\['long'\]: expected SUMO's attributes.*received 9"),
        ({"drivers": {"long": {"tau ": 1}}}, r"drivers\['long'\]: expected SUMO's attributes.*received {'tau ': 1}"),
        ({"drivers": 5}, "drivers: expected SUMO's attributes.*received 5"),
        ({"drivers": {"idm": {}}}, "other names than idm, mobil, policy"),
    ],
)
def test_arguments_that_sumo_cannot_use_are_refused(arguments, message):
    with pytest.raises(WorldError, match=message):
        _ = pafot.sumo(**arguments).road


def test_a_model_that_sumo_does_not_have_is_refused(capfd):
    wrong = pafot.sumo(drivers={"odd": {"carFollowModel": "Nobody's"}}, duration=12.0)
    with pytest.raises(WorldError, match=r"Sumo\.start: expected that SUMO starts, received Process Error"):
        wrong.rollout(scenario(behind("odd")), keeps_its_speed)
    assert "Nobody's" in capfd.readouterr().err


def test_without_libsumo_the_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "libsumo", None)
    with pytest.raises(WorldError, match=re.escape("pip install 'pytest-pafot[sumo]'")):
        _ = pafot.sumo().road


def test_a_world_is_made_from_its_file():
    world = pafot.sumo(drivers={"calm": {"carFollowModel": "IDM", "tau": 2}}, hz=25, ads_hz=5, duration=12.0)
    assert described(world)["kind"] == "sumo"
    again = from_dict(described(world))
    assert described(again) == described(world)
    drives = scenario(behind("calm", 24.0))
    assert np.array_equal(again.rollout(drives, keeps_its_speed).states, world.rollout(drives, keeps_its_speed).states)


def test_the_names_of_attributes_in_a_strangers_file_give_sumo_no_orders(tmp_path):
    stolen = tmp_path / "written.xml"
    order = f"""tau="1"/><edgeData id="x" freq="1" file="{stolen}"/><vType id="y" minGap"""
    data = described(pafot.sumo(drivers={"calm": {}}, duration=12.0))
    data["data"]["simulator"]["drivers"] = {"calm": {order: "1"}}
    with pytest.raises(WorldError, match=r"drivers\['calm'\]: expected SUMO's attributes"):
        from_dict(data).rollout(scenario(behind("calm")), keeps_its_speed)
    assert not stolen.exists()
    data["data"]["simulator"]["drivers"] = {"calm": {"length": "9"}}
    with pytest.raises(WorldError, match="received length"):
        _ = from_dict(data).road


def brakes_late():
    return lambda seen: (-3.0 if any(0 < each.x - seen.ego.x < 9.0 for each in seen.others) else 0.0, 0.0)


def never_collides(run):
    assert not run.collision, run.explain()


def test_a_search_with_drivers_of_sumo_saves_what_a_replay_repeats(tmp_path):
    asked = {"holds": never_collides, "world": pafot.sumo(duration=15.0), "runs": 12, "seed": 2}
    found = pafot.explore(
        brakes_late, drivers=["sumo-krauss", "sumo-idm"], shrink_rollouts=20, corpus=str(tmp_path), **asked
    )
    assert any(isinstance(chain[0], Free) for row in found.findings for chain in row.scenario.npcs) or found.findings
    for path in tmp_path.rglob("*.pafot.yaml"):
        saved = pafot.load(path)
        assert "libsumo" in saved.finding.found.versions
        assert saved.matches(saved.replay(brakes_late, world=asked["world"]))
    assert list(tmp_path.rglob("*.pafot.yaml"))


def test_reference_drivers_and_exact_take_over_work_among_drivers_of_sumo():
    brakes = behind("sumo-krauss", 18.0, 25.0), Manoeuvre(beside=1, ahead=10.0, speed=20.0)
    trace = WORLD.rollout(scenario(*brakes), keeps_its_speed)
    careful = WORLD.take_over(trace, 40, WORLD.reference_drivers[0])
    assert np.array_equal(careful.states[:41], trace.states[:41])
