"""Each format as a library or program reads it: the positions, the lanes, and the tick of the collision."""

import csv
import json
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from pytest_pafot import VehicleType
from pytest_pafot.export.exporter import centre_line, exporter
from pytest_pafot.model.trace import HEADING, SPEED, Lane, X, Y
from tests.helpers.tables import table
from tests.helpers.traces import straight_lanes, trace_of, vehicle

# CommonRoad's library imports packages that use deprecated functions.
pytestmark = pytest.mark.filterwarnings(
    "ignore:Call to deprecated create function:DeprecationWarning"
)


LIBRARIES = {"xosc": "scenariogeneration", "xosc-1.0": "scenariogeneration", "mcap": "foxglove"}
"""The libraries with other names than their formats."""


def written(exported, name, folder):
    """Return the paths of a format's files, in order."""
    paths = []
    for file, content in exporter(name)(*exported).items():
        paths.append(folder / file)
        paths[-1].write_bytes(content)
    return paths


def centres(trace):
    """Return every vehicle's x and y [m], y to the left, shape [ticks + 1, vehicles, 2]."""
    return trace.states[..., [X, Y]] * (1, -1)


def lines(trace):
    """Yield the centre line of every lane [m], y to the left."""
    for lane in trace.lanes:
        end = (
            lane.x + lane.length * math.cos(lane.heading),
            lane.y + lane.length * math.sin(lane.heading),
        )
        yield np.array(lane.points or ((lane.x, lane.y), end)) * (1, -1)


def distance(points, line):
    """Return the largest distance of points to a line of straight pieces [m]."""
    start, along = line[:-1], np.diff(line, axis=0)
    share = ((points[:, None] - start) * along).sum(-1) / (along**2).sum(-1)
    nearest = start + np.clip(share, 0, 1)[..., None] * along
    return np.hypot(*np.moveaxis(points[:, None] - nearest, -1, 0)).min(axis=1).max()


@pytest.mark.parametrize("exported", ["gym-merge"], indirect=True)
@pytest.mark.parametrize("name", ["csv", "xosc", "xosc-1.0", "mcap", "commonroad"])
def test_same_run_gives_same_files_named_by_finding(exported, name):
    pytest.importorskip(LIBRARIES.get(name, name))
    files = exporter(name)(*exported)
    assert files == exporter(name)(*exported)
    assert all(file.startswith(exported[0].id) for file in files)


def test_a_table_read_back_is_what_was_driven(exported, tmp_path):
    finding, trace = exported
    (path,) = written(exported, "csv", tmp_path)
    rows = list(csv.DictReader(path.read_text().splitlines()))
    names = ["ego", *(f"npc{n}" for n in range(len(trace.npcs[0])))]
    assert [row["vehicle"] for row in rows[: len(names)]] == names
    read = np.array(
        [
            [float(row[column]) for column in row if column not in ("time", "vehicle")]
            for row in rows
        ]
    )
    read = read.reshape(*trace.states.shape[:2], 9)
    assert np.array_equal(read[..., :7] * (1, -1, -1, 1, 1, -1, 1), trace.states)
    assert np.array_equal(read[0, :, 7:], trace.sizes)
    assert [float(row["time"]) for row in rows[:: len(trace.sizes)]] == trace.times.tolist()
    assert path.name == f"{finding.id}.csv"


@pytest.mark.parametrize("name", ["csv", "xosc", "xosc-1.0", "mcap", "commonroad"])
def test_run_ending_at_first_decision_exports_its_start(ended_at_once, name):
    pytest.importorskip(LIBRARIES.get(name, name))
    files = exporter(name)(*ended_at_once)
    assert all(files.values())
    if name == "xosc":
        root = ElementTree.fromstring(next(iter(files.values())))
        assert len(list(root.iter("TeleportAction"))) == len(ended_at_once[1].sizes)
        assert list(root.iter("Story")) == []


def test_openscenario_has_every_vehicle_at_every_tick(exported, tmp_path, largest):
    pytest.importorskip("scenariogeneration")
    finding, trace = exported
    path, road = written(exported, "xosc", tmp_path)
    root = ElementTree.parse(path).getroot()
    assert (
        root.find("FileHeader").attrib | {"revMajor": "1", "revMinor": "2"}
        == root.find("FileHeader").attrib
    )
    assert root.find("RoadNetwork/LogicFile").get("filepath") == road.name
    back = {
        each.get("name"): float(each.find("Vehicle/BoundingBox/Center").get("x"))
        for each in root.iter("ScenarioObject")
    }
    assert list(back) == ["ego", *(f"npc{n}" for n in range(len(trace.sizes) - 1))]
    driven = []
    for group in root.iter("ManeuverGroup"):
        shift = back[group.find("Actors/EntityRef").get("entityRef")]
        vertices = list(group.iter("Vertex"))
        assert [float(vertex.get("time")) for vertex in vertices] == trace.times.tolist()
        poses = [vertex.find("Position/WorldPosition").attrib for vertex in vertices]
        x, y, heading = (np.array([float(pose[key]) for pose in poses]) for key in "xyh")
        driven.append(np.stack([x + shift * np.cos(heading), y + shift * np.sin(heading)], axis=-1))
    assert (
        largest(f"OpenSCENARIO, {finding.id} [m]", np.stack(driven, axis=1), centres(trace)) < 1e-9
    )


def test_openscenario_1_0_has_what_that_version_and_its_reader_require(exported, tmp_path):
    pytest.importorskip("scenariogeneration")
    path, _ = written(exported, "xosc-1.0", tmp_path)
    root = ElementTree.parse(path).getroot()
    assert (root.find("FileHeader").get("revMajor"), root.find("FileHeader").get("revMinor")) == (
        "1",
        "0",
    )
    assert {event.get("priority") for event in root.iter("Event")} == {"overwrite"}
    assert {each.get("rule") for each in root.iter("SimulationTimeCondition")} == {"greaterThan"}
    follows = list(root.iter("FollowTrajectoryAction"))
    assert len(follows) == len(exported[1].sizes)
    assert all(follow[0].tag == "Trajectory" for follow in follows)
    types = [each.get("value") for each in root.iter("Property")]
    assert types == ["ego_vehicle", *["simulation"] * (len(follows) - 1)]
    # The version is a setting of the whole library, so the next file must have its own again.
    again, _ = written(exported, "xosc", tmp_path)
    assert ElementTree.parse(again).getroot().find("FileHeader").get("revMinor") == "2"


CHECKERS = {".xosc": ("qc_openscenario", "xoscBundle"), ".xodr": ("qc_opendrive", "xodrBundle")}


@pytest.mark.parametrize("suffix", CHECKERS)
def test_asams_checkers_report_no_issue(exported, tmp_path, suffix):
    pytest.importorskip("scenariogeneration")
    checker, bundle = CHECKERS[suffix]
    pytest.importorskip(checker)
    (path,) = (path for path in written(exported, "xosc", tmp_path) if path.suffix == suffix)
    config, result = tmp_path / "config.xml", tmp_path / "result.xqar"
    config.write_text(
        f'<Config><Param name="InputFile" value="{path}"/><CheckerBundle application="{bundle}">'
        f'<Param name="resultFile" value="{result}"/></CheckerBundle></Config>'
    )
    subprocess.run(
        [sys.executable, "-m", f"{checker}.main", "-c", config], check=True, cwd=tmp_path
    )
    told = ElementTree.parse(result).getroot()
    assert [issue.get("description") for issue in told.iter("Issue")] == []
    statuses = [check.get("status") for check in told.iter("Checker")]
    assert set(statuses) <= {"completed", "skipped"}
    assert statuses.count("completed") >= 10


def test_sumos_netconvert_reads_the_lanes_where_they_are(exported, tmp_path, largest):
    pytest.importorskip("scenariogeneration")
    sumo = pytest.importorskip("sumo")
    finding, trace = exported
    _, road = written(exported, "xosc", tmp_path)
    net = tmp_path / "road.net.xml"
    subprocess.run(
        [Path(sumo.SUMO_HOME) / "bin" / "netconvert", "--opendrive-files", road, "-o", net,
         "--offset.disable-normalization", "--opendrive.import-all-lanes", "--opendrive.curve-resolution", "0.5"],
        check=True,
    )  # fmt: skip
    shapes = {}
    for edge in ElementTree.parse(net).getroot().iter("edge"):
        if edge.get("function") is None:
            for lane in edge.iter("lane"):
                shape = np.array(
                    [
                        [float(value) for value in point.split(",")[:2]]
                        for point in lane.get("shape").split()
                    ]
                )
                shapes[abs(int(edge.get("id").partition(".")[0])), int(lane.get("index"))] = shape
    count = len(trace.lanes)
    # SUMO counts lanes from the right.
    keys = [
        (0, count - 1 - n) if len({road for road, _ in shapes}) == 1 else (n, 0)
        for n in range(count)
    ]
    assert sorted(shapes) == sorted(keys)
    apart = [distance(line, shapes[key]) for key, line in zip(keys, lines(trace), strict=True)]
    # It writes whole centimetres, and bends as corners that are half a metre apart.
    assert largest(f"netconvert, {finding.id} [m]", apart, 0) < 0.02
    assert (
        max(distance(shapes[key], line) for key, line in zip(keys, lines(trace), strict=True))
        < 0.05
    )


@pytest.mark.parametrize("exported", ["collision-xfail"], indirect=True)
@pytest.mark.parametrize(
    ("changes", "roads"),
    [
        ({}, 1),
        ({"heading": 0.1}, 4),
        ({"y": 30.0}, 4),
        ({"length": 90.0}, 4),
        ({"points": ((0, 12), (9, 12))}, 4),
    ],
)
def test_only_adjacent_lanes_form_one_road(exported, changes, roads):
    pytest.importorskip("scenariogeneration")
    finding, trace = exported
    lanes = (*trace.lanes[:-1], replace(trace.lanes[-1], **changes))
    road = exporter("xosc")(finding, replace(trace, lanes=lanes))[f"{finding.id}.xodr"]
    assert road.count(b"<road ") == roads


def test_a_turned_straight_road_is_turned_in_opendrive():
    pytest.importorskip("scenariogeneration")
    from pytest_pafot.export.openscenario import road_file

    trace = trace_of(vehicle([0.0]), lanes=straight_lanes(heading=0.3))
    (line,) = ElementTree.fromstring(road_file("turned", trace)).iter("geometry")
    x, y, heading, length = (float(line.get(key)) for key in ("x", "y", "hdg", "length"))
    end = x + length * math.cos(heading), y + length * math.sin(heading)
    assert end == pytest.approx(tuple(next(lines(trace))[-1]))


def along(points):
    """Return a lane with these points."""
    return Lane(
        x=points[0][0],
        y=points[0][1],
        heading=0.0,
        length=1.0,
        width=4.0,
        speed_limit=9.0,
        points=points,
    )


def circle(laps, radius=30.0, steps=100):
    """Return points of a circle; each lap has its points at different places."""
    turns = 2 * math.pi * np.arange(round(laps * steps) + 1) / (steps + 0.25)
    return tuple(
        zip((radius * np.sin(turns)).tolist(), (radius * np.cos(turns)).tolist(), strict=True)
    )


def test_only_one_lap_of_circular_lane_is_exported():
    line = centre_line(along(circle(2.5)))
    assert line.tolist() == (np.array(circle(2.5))[:101] * (1, -1)).tolist()
    assert distance(np.array(circle(2.5)) * (1, -1), np.concatenate([line, line[:1]])) < 0.02


@table(
    "points",
    [
        circle(0.99),
        ((0.0, 0.0), (9.0, 0.0)),
        ((0.0, 0.0), (9.0, 0.0), (9.0, 9.0), (5.0, 9.0), (0.0, 1.0), (0.0, -9.0)),
    ],
)
def test_lane_that_does_not_close_is_exported_whole(points):
    assert centre_line(along(points)).tolist() == (np.array(points) * (1, -1)).tolist()


def test_foxglove_file_has_same_numbers_and_times(exported, tmp_path):
    pytest.importorskip("foxglove")
    reader = pytest.importorskip("mcap.reader")
    _, trace = exported
    (path,) = written(exported, "mcap", tmp_path)
    with path.open("rb") as stream:
        messages = list(reader.make_reader(stream).iter_messages())
    by_topic = {}
    for _, channel, message in messages:
        by_topic.setdefault(channel.topic, []).append(message)
    counts = {"/road": 1, "/vehicles": trace.ticks + 1, "/states": trace.ticks + 1}
    assert {topic: len(found) for topic, found in by_topic.items()} == counts
    told = [json.loads(message.data) for message in by_topic["/states"]]
    names = ("x", "y", "heading", "speed", "acceleration", "steering", "lane")
    read = np.array(
        [[[vehicle[name] for name in names] for vehicle in each["vehicles"]] for each in told]
    )
    assert np.array_equal(read * (1, -1, -1, 1, 1, -1, 1), trace.states)
    assert [each["time"] for each in told] == trace.times.tolist()
    for topic in ("/vehicles", "/states"):
        assert [m.log_time for m in by_topic[topic]] == [
            round(time * 1e9) for time in trace.times.tolist()
        ]
    # The boxes are at the vehicles' places: a message contains its numbers as in memory.
    for tick, message in enumerate(by_topic["/vehicles"]):
        for value in centres(trace)[tick].ravel():
            assert value == 0 or np.float64(value).tobytes() in message.data
        assert np.float64(1.5 / 2).tobytes() in message.data  # boxes of 1.5 m stand on the road


def test_commonroad_reads_the_same_vehicles_and_lanes(exported, tmp_path, largest):
    reader = pytest.importorskip("commonroad.common.file_reader")
    from commonroad.common.writer.file_writer_xml import XMLFileWriter

    finding, trace = exported
    (path,) = written(exported, "commonroad", tmp_path)
    assert XMLFileWriter.check_validity_of_commonroad_file(path.read_bytes())
    scenario, problems = reader.CommonRoadFileReader(str(path)).open()
    assert scenario.dt == trace.dt
    (problem,) = problems.planning_problem_dict.values()
    assert problem.initial_state.position.tolist() == pytest.approx(centres(trace)[0, 0].tolist())
    assert [obstacle.obstacle_id for obstacle in scenario.dynamic_obstacles] == list(
        range(1, len(trace.sizes) + 1)
    )
    states = [
        [obstacle.state_at_time(tick) for obstacle in scenario.dynamic_obstacles]
        for tick in range(trace.ticks + 1)
    ]
    read = np.array(
        [
            [(*state.position, state.orientation, state.velocity) for state in each]
            for each in states
        ]
    )
    there = trace.states[..., [X, Y, HEADING, SPEED]] * (1, -1, -1, 1)
    turned = (read[..., 2] - there[..., 2] + np.pi) % (2 * np.pi) - np.pi
    assert (
        largest(f"CommonRoad, {finding.id} [m], [m/s]", read[..., [0, 1, 3]], there[..., [0, 1, 3]])
        < 1e-8
    )
    assert np.abs(turned).max() < 1e-8
    lanelets = scenario.lanelet_network.lanelets
    for lanelet, line in zip(lanelets, lines(trace), strict=True):
        assert np.abs(lanelet.center_vertices - line[: len(lanelet.center_vertices)]).max() < 1e-8
        # Only one of several laps is exported; highway-env's tracks have corners, where each lap has different points.
        assert distance(line, lanelet.center_vertices) < 0.2
    for lanelet, lane in zip(lanelets, trace.lanes, strict=True):
        along, across = (
            np.diff(lanelet.center_vertices, axis=0),
            lanelet.left_vertices - lanelet.right_vertices,
        )
        assert np.hypot(*across.T) == pytest.approx(lane.width)
        assert (along[:, 0] * across[:-1, 1] - along[:, 1] * across[:-1, 0] > 0).all()


def test_commonroad_checker_finds_collision_at_the_same_tick(exported, tmp_path):
    checker = pytest.importorskip(
        "commonroad_dc.collision.collision_detection.pycrcc_collision_dispatch"
    )
    from commonroad.common.file_reader import CommonRoadFileReader

    _, trace = exported
    (path,) = written(exported, "commonroad", tmp_path)
    scenario, _ = CommonRoadFileReader(str(path)).open()
    ego, *others = (checker.create_collision_object(each) for each in scenario.dynamic_obstacles)
    touching = [
        tick
        for tick in range(trace.ticks + 1)
        if any(ego.obstacle_at_time(tick).collide(other.obstacle_at_time(tick)) for other in others)
    ]
    assert touching[:1] == ([] if trace.collision is None else [trace.collision.tick])


@table(
    ("kind", "category"),
    [
        ("car", "car"),
        ("van", "van"),
        ("truck", "truck"),
        ("motorcycle", "motorbike"),
        ("my truck", "truck"),
    ],
)
def test_openscenario_knows_what_vehicle_the_ego_and_an_npc_are(exported, kind, category):
    pytest.importorskip("scenariogeneration")
    finding, trace = exported
    vehicle = (
        VehicleType(name=kind, length=9.0, width=2.5) if " " in kind else VehicleType.parse(kind)
    )
    trace = replace(trace, scenario=trace.scenario.with_vehicle(0, vehicle), ego_vehicle=vehicle)
    content = exporter("xosc")(finding, trace)[f"{finding.id}.xosc"]
    found = [
        each.get("vehicleCategory") for each in ElementTree.fromstring(content).iter("Vehicle")
    ]
    assert found[:2] == [category, category]
