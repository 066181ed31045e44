"""Tables and scenarios of others as tracks: units, sides, gaps, and what is refused with its line and column."""

import csv
import importlib.util
import math
import os
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import pytest_pafot as pafot
from pytest_pafot.extras.export.exporter import exporter
from pytest_pafot.extras.recordings import tables, xml_data
from pytest_pafot.extras.recordings.recording import RecordedVehicle, RecordingError
from pytest_pafot.model.trace import HEADING, SPEED, X, Y
from pytest_pafot.support.errors import RequestError
from tests.helpers.tables import table
from tests.helpers.traces import trace_of, vehicle

FINDING = SimpleNamespace(id="run")
NUMBERS = st.floats(-1e6, 1e6, width=64)
HEAD = "time,vehicle,x,y,heading,speed,length,width"


def written(folder, name, rows, columns=None):
    path = folder / name
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns or rows[0])
        writer.writerows([row.values() for row in rows])
    return path


@st.composite
def traces(draw):
    vehicles = [
        np.array(draw(st.lists(st.tuples(*[NUMBERS] * 6), min_size=3, max_size=3)))
        for _ in range(draw(st.integers(1, 3)))
    ]
    lanes = draw(st.integers(-1, 3))
    return trace_of(*(np.hstack([rows, np.full((3, 1), lanes)]) for rows in vehicles))


@given(trace=traces())
def test_table_of_a_run_is_read_back_to_the_last_bit(trace, tmp_path_factory):
    path = tmp_path_factory.mktemp("run") / "run.csv"
    path.write_bytes(exporter("csv")(FINDING, trace)["run.csv"])
    read = pafot.recorded(path)
    assert np.array_equal(np.stack([each.states for each in read.vehicles], axis=1), trace.states[..., :4])
    assert [each.times.tolist() for each in read.vehicles] == [trace.times.tolist()] * len(trace.sizes)
    assert [(each.length, each.width) for each in read.vehicles] == [tuple(size) for size in trace.sizes.tolist()]
    assert (read.ego, read.rate) == ("ego", 15.0)


def test_lanes_of_a_run_are_those_of_vehicles_that_keep_theirs(tmp_path):
    trace = trace_of(vehicle(0.0, 4.0, speed=20.0, ticks=30), vehicle(30.0, 8.0, speed=20.0, ticks=30))
    (tmp_path / "run.csv").write_bytes(exporter("csv")(FINDING, trace)["run.csv"])
    read = pafot.recorded(tmp_path / "run.csv")
    assert [(lane.y, lane.width, lane.heading) for lane in read.lanes] == [(4.0, 4.0, 0.0), (8.0, 4.0, 0.0)]


HIGHD = {"width": 4.0, "height": 2.0, "xVelocity": 30.0, "yVelocity": 0.0}


@pytest.fixture
def highd(tmp_path):
    """Two vehicles of highD side by side in opposite directions, 25 rows per second, the second one with a gap."""
    rows = []
    for frame in range(1, 27):
        rows.append({"frame": frame, "id": 1, "x": 100 + 1.2 * frame, "y": 20.0, **HIGHD})
        if frame not in (5, 6):
            rows.append({"frame": frame, "id": 2, "x": 300 - 1.2 * frame, "y": 9.5, **HIGHD, "xVelocity": -30.0})
    about = [
        {"id": 1, "class": "Car", "drivingDirection": 2},
        {"id": 2, "class": "Truck", "drivingDirection": 1},
    ]
    marks = {"upperLaneMarkings": "8.5;12.5;16.5", "lowerLaneMarkings": "19.0;23.0"}
    written(tmp_path, "01_tracksMeta.csv", about)
    written(tmp_path, "01_recordingMeta.csv", [{"frameRate": 25, "speedLimit": -1, **marks}])
    return written(tmp_path, "01_tracks.csv", rows)


def test_highd_has_centres_classes_and_lanes_of_both_directions(highd):
    read = pafot.recorded(highd)
    right, left = read.vehicles
    assert (right.kind, left.kind, read.rate, read.ego) == ("car", "truck", 25.0, None)
    assert right.states[0].tolist() == [103.2, 21.0, 0.0, 30.0]
    assert left.states[0, [X, Y, SPEED]].tolist() == pytest.approx([300.8, 10.5, 30.0])
    assert abs(left.states[0, HEADING]) == pytest.approx(math.pi)
    assert [(lane.y, lane.width, lane.heading) for lane in read.lanes] == [
        (21.0, 4.0, 0.0),
        (10.5, 4.0, math.pi),
        (14.5, 4.0, math.pi),
    ]
    assert {lane.speed_limit for lane in read.lanes} == {math.inf}


def test_short_gap_is_filled_by_straight_lines(highd):
    left = pafot.recorded(highd).vehicle(2)
    assert len(left.times) == 26
    assert np.diff(left.times) == pytest.approx(np.full(25, 0.04))
    assert np.diff(left.states[:, X]) == pytest.approx(np.full(25, -1.2))


def test_recording_is_turned_so_that_its_ego_drives_along_x(highd):
    read = pafot.recorded(highd, ego=2)
    ego, other = read.vehicle(2), read.vehicle(1)
    assert np.diff(ego.states[:, X]) == pytest.approx(np.full(25, 1.2))
    assert ego.states[:, HEADING] == pytest.approx(np.zeros(26), abs=1e-12)
    assert np.cos(other.states[:, HEADING]) == pytest.approx(np.full(26, -1.0))
    # From the left, as the ego sees its lanes: the one next to the other direction, then its own one.
    assert [(round(lane.y, 6), round(math.cos(lane.heading), 6)) for lane in read.lanes] == [
        (-14.5, 1.0),
        (-10.5, 1.0),
        (-21.0, -1.0),
    ]
    assert ego.states[0, Y] == pytest.approx(-10.5)


def test_highd_needs_the_other_files_of_the_recording(highd):
    (highd.parent / "01_recordingMeta.csv").unlink()
    with pytest.raises(RecordingError, match=r"01_tracks.csv: expected the file 01_recordingMeta.csv next to it"):
        pafot.recorded(highd)


@table(
    "column, value, message",
    [
        (
            "xVelocity",
            "fast",
            r"01_tracks.csv:2: xVelocity: expected a finite number, received 'fast'; correct the cell",
        ),
        ("x", "nan", r"01_tracks.csv:2: x: expected a finite number, received 'nan'"),
        ("y", "1_0", r"expected a finite number, received '1_0'"),
        ("y", "1e300", r"expected a finite number"),
        ("width", "0", r"01_tracks.csv:2: width, height: expected sizes above 0, received \[0.0, 2.0\]"),
        ("id", "7", r"01_tracks.csv:2: id: expected a vehicle of 01_tracksMeta.csv, received 7"),
    ],
)
def test_wrong_cell_is_refused_with_line_and_column(highd, column, value, message):
    before = highd.read_text()
    lines = before.splitlines()
    cells = lines[1].split(",")
    cells[lines[0].split(",").index(column)] = value
    highd.write_text("\n".join([lines[0], ",".join(cells), *lines[2:]]))
    with pytest.raises(RecordingError, match=message):
        pafot.recorded(highd)
    highd.write_text(before)


def test_row_that_is_cut_off_is_refused(highd):
    highd.write_text(highd.read_text()[:-40])
    with pytest.raises(RecordingError, match=r"01_tracks.csv:50: expected at least 8 cells, received"):
        pafot.recorded(highd)


def test_only_rows_between_two_times_are_read(highd):
    read = pafot.recorded(highd, between=(0.5, 0.8))
    assert read.vehicle(1).times == pytest.approx(np.arange(13, 21) / 25)
    with pytest.raises(RecordingError, match=r"expected rows at that time, received none; give another time"):
        pafot.recorded(highd, between=(50.0, 60.0))


@pytest.fixture
def ind(tmp_path):
    """A car and a pedestrian of inD."""
    rows = [
        {
            "trackId": track, "frame": frame, "xCenter": 10.0, "yCenter": frame / 25 * 5, "heading": 90.0,
            "width": 1.8 * (track == 0), "length": 4.5 * (track == 0), "xVelocity": 0.0, "yVelocity": 5.0,
        }
        for track in (0, 1) for frame in range(3)
    ]  # fmt: skip
    written(tmp_path, "00_tracksMeta.csv", [{"trackId": 0, "class": "car"}, {"trackId": 1, "class": "pedestrian"}])
    written(tmp_path, "00_recordingMeta.csv", [{"frameRate": 25.0}])
    return written(tmp_path, "00_tracks.csv", rows)


def test_ind_has_left_as_negative_and_headings_clockwise(ind):
    read = pafot.recorded(ind)
    (car,) = read.vehicles
    assert car.states[2].tolist() == pytest.approx([10.0, -0.4, -math.pi / 2, 5.0])
    assert (car.kind, car.length, car.width, read.lanes) == ("car", 4.5, 1.8, ())
    assert read.notes == ("the data have no lanes", "1 pedestrian or cyclist without a size left out")
    turned = pafot.recorded(ind, ego=0).vehicle(0)
    assert np.diff(turned.states[:, X]) == pytest.approx([0.2, 0.2])
    assert turned.states[:, HEADING] == pytest.approx(np.zeros(3))


def ngsim(folder, **changes):
    """A car of NGSIM that drives at 30 feet a second, stands for two seconds, and drives on; and one next to it."""
    rows, along = [], 0.0
    for frame in range(60):
        speed = 0.0 if 20 <= frame < 40 else 30.0
        for number, across in ((1, 6.0), (2, 18.0)):
            jump = 0.3 * (frame % 2) if speed == 0.0 else 0.0
            rows.append({
                "Vehicle_ID": number, "Frame_ID": 100 + frame, "Local_X": across + jump, "Local_Y": along,
                "v_Length": 16.0, "v_Width": 6.0, "v_Class": 2, "v_Vel": speed, "Lane_ID": number, **changes,
            })  # fmt: skip
        along += speed / 10
    return written(folder, "trajectories.csv", rows)


def test_ngsim_is_in_metres_of_centres_with_lanes_where_vehicles_drove(tmp_path):
    read = pafot.recorded(ngsim(tmp_path))
    car = read.vehicle(1)
    assert car.times[0] == 10.0
    assert car.states[1].tolist() == pytest.approx([(3.0 - 8.0) * 0.3048, 6 * 0.3048, 0.0, 30 * 0.3048])
    assert (car.kind, round(car.length, 3), round(car.width, 3)) == ("car", 4.877, 1.829)
    assert [lane.width for lane in read.lanes] == pytest.approx([12 * 0.3048] * 2)
    assert read.notes == ("lanes are estimated from what drove in them",)


def test_standing_vehicle_keeps_the_direction_in_which_it_moved(tmp_path):
    car = pafot.recorded(ngsim(tmp_path)).vehicle(1)
    assert np.abs(car.states[22:38, HEADING]).max() < 0.1


def test_ngsim_of_several_places_is_refused(tmp_path):
    path = ngsim(tmp_path, Location="us-101")
    path.write_text(path.read_text().rpartition(",")[0] + ",i-80\n")
    with pytest.raises(RecordingError, match=r"csv:121: Location: expected one place, us-101, received i-80; split"):
        pafot.recorded(path)


def test_vehicle_that_was_away_for_long_is_another_one(tmp_path):
    path = ngsim(tmp_path)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], *(line for line in lines[1:] if not 110 <= int(line.split(",")[1]) < 125)]))
    assert [(each.name, len(each.times)) for each in pafot.recorded(path).vehicles] == [
        ("1", 10), ("1/2", 35), ("2", 10), ("2/2", 35),
    ]  # fmt: skip


def test_two_rows_of_a_vehicle_at_one_time_are_refused(tmp_path):
    path = ngsim(tmp_path)
    path.write_text(path.read_text() + path.read_text().splitlines()[-1] + "\n")
    with pytest.raises(RecordingError, match=r"expected one row of a vehicle at 15.9 s, received two of vehicle 2"):
        pafot.recorded(path)


def test_heading_turns_the_shorter_way_between_rows():
    headings = np.array([3.1, -3.1])
    states = np.stack([np.zeros(2), np.zeros(2), headings, np.ones(2)], axis=-1)
    car = RecordedVehicle(name="1", kind="", length=4.0, width=2.0, times=[0.0, 1.0], states=states)
    assert car.at(0.5)[0, HEADING] == pytest.approx(math.pi)
    assert np.isnan(car.at(1.5)).all()


COMMONROAD = """<?xml version='1.0' encoding='UTF-8'?>
<commonRoad timeStepSize="0.1" commonRoadVersion="{version}">
  <lanelet id="1">
    <leftBound><point><x>0.0</x><y>2.0</y></point><point><x>50.0</x><y>2.0</y></point></leftBound>
    <rightBound><point><x>0.0</x><y>-2.0</y></point><point><x>50.0</x><y>-2.0</y></point></rightBound>
  </lanelet>
  <{obstacle} id="7">{role}<type>car</type>
    <shape>{shape}</shape>
    <initialState><position><point><x>1.0</x><y>0.5</y></point></position><orientation><exact>0.1</exact></orientation>
      <time><exact>0</exact></time><velocity><exact>10.0</exact></velocity></initialState>
    <trajectory>
      <state><position><point><x>2.0</x><y>0.6</y></point></position><orientation><exact>0.1</exact></orientation>
      <time><exact>1</exact></time><velocity><intervalStart>9.0</intervalStart><intervalEnd>11.0</intervalEnd></velocity>
      </state>
    </trajectory>
  </{obstacle}>
</commonRoad>
"""
RECTANGLE = "<rectangle><length>4.5</length><width>1.8</width></rectangle>"


@pytest.mark.parametrize(
    ("version", "obstacle", "role"), [("2020a", "dynamicObstacle", ""), ("2018b", "obstacle", "<role>dynamic</role>")]
)
def test_commonroad_has_obstacles_with_trajectories_and_lanelets(tmp_path, version, obstacle, role):
    path = tmp_path / "scenario.xml"
    path.write_text(COMMONROAD.format(version=version, obstacle=obstacle, role=role, shape=RECTANGLE))
    read = pafot.recorded(path)
    (car,) = read.vehicles
    assert car.states.tolist() == [[1.0, -0.5, -0.1, 10.0], [2.0, -0.6, -0.1, 10.0]]
    assert (car.name, car.kind, car.times.tolist(), read.rate) == ("7", "car", [0.0, 0.1], 10.0)
    (lane,) = read.lanes
    assert (lane.y, lane.heading, lane.length, lane.width, lane.points) == (0.0, 0.0, 50.0, 4.0, ())


def test_commonroad_obstacle_that_is_no_box_is_refused_with_its_line(tmp_path):
    path = tmp_path / "scenario.xml"
    circle = "<circle><radius>1.0</radius></circle>"
    path.write_text(COMMONROAD.format(version="2020a", obstacle="dynamicObstacle", role="", shape=circle))
    with pytest.raises(RecordingError, match=r"xml:8: commonRoad/dynamicObstacle/shape: expected its shape as a recta"):
        pafot.recorded(path)


@pytest.mark.skipif(importlib.util.find_spec("commonroad") is None, reason="needs commonroad-io")
@pytest.mark.filterwarnings("ignore:Call to deprecated create function:DeprecationWarning")
def test_run_that_commonroads_library_has_written_is_read_as_driven(tmp_path):
    trace = trace_of(vehicle(0.0, 4.0, speed=20.0, ticks=30), vehicle(30.0, 8.0, speed=15.0, ticks=30))
    (tmp_path / "run.xml").write_bytes(exporter("commonroad")(FINDING, trace)["run.xml"])
    read = pafot.recorded(tmp_path / "run.xml")
    states = np.stack([each.states for each in read.vehicles], axis=1)
    assert states == pytest.approx(trace.states[..., :4], abs=1e-8)
    assert [lane.y for lane in read.lanes] == pytest.approx([0.0, 4.0, 8.0, 12.0])


@table(
    "content, message",
    [
        ("<!DOCTYPE a [<!ENTITY b 'c'>]><commonRoad/>", r":1: expected no document type, received <!DOCTYPE a; remove"),
        ("<commonRoad><a></commonRoad>", r":1: expected XML, received mismatched tag; the file may be cut off"),
        ("<other/>", r"other: expected OpenSCENARIO or commonRoad, received other"),
        ("a,b\n1,2\n", r":1: expected the columns of export --to csv \(time, vehicle, .* received a, b; rename"),
        ("<a>" * 70, r"expected at most 5000000 elements, 60 deep, received more"),
        ("", r"received none"),
        (
            f"{HEAD}\n0,ego,0,0,0,20,4,2\n0,5,ego,1,0,0,20,4,2\n",
            r":3: expected 8 cells, as in the first line, received 9; w",
        ),
        (f"{HEAD},x\n0,ego,0,0,0,20,4,2,0\n", r":1: x: expected one column of this name, received several; rename"),
        (f"{HEAD}\n0,ego,0,0,0,20,4,2,, \n0,ego,1,0,0,20,4,2\n", r"at 0 s, received two of vehicle ego; remove one"),
        ("t\0i\0,x\0\n", r"save it with commas between the cells, in UTF-8"),
        ("time;vehicle\n1;2\n", r"received time;vehicle; save it with commas between the cells, in UTF-8"),
        ('time,"vehicle\n', r":1: expected cells between commas, received unexpected end of data; save it as plain"),
        ("\n\n" + "e" * 100_000, r":3: expected lines below 100000 characters, received a longer one"),
        ('<?xml version="1.0" encoding="utf-7"?><a/>', r":1: expected XML in UTF-8, received multi-byte"),
    ],
)
def test_other_files_are_refused(tmp_path, content, message):
    path = tmp_path / "file"
    path.write_text(content)
    with pytest.raises(RecordingError, match=message):
        pafot.recorded(path)


def test_scenario_in_utf_16_is_read(tmp_path):
    path = tmp_path / "scenario.xml"
    text = COMMONROAD.format(version="2020a", obstacle="dynamicObstacle", role="", shape=RECTANGLE)
    path.write_text(text.replace("UTF-8", "UTF-16"), encoding="utf-16")
    assert [each.name for each in pafot.recorded(path).vehicles] == ["7"]


def test_names_of_elements_are_cut_where_messages_name_places(tmp_path):
    path = tmp_path / "file"
    path.write_text(f'<{"a" * 100} name="{"n" * 100}"/>')
    with pytest.raises(RecordingError, match=r": a{60}\[n{60}\]: expected OpenSCENARIO"):
        pafot.recorded(path)


def test_text_of_an_element_is_limited(tmp_path, monkeypatch):
    monkeypatch.setattr(xml_data, "LONGEST_TEXT", 10)
    path = tmp_path / "file"
    path.write_text(f"<other>{' ' * 20000}{'x' * 11}</other>")
    with pytest.raises(RecordingError, match=r"other: expected at most 10 characters, received more"):
        pafot.recorded(path)


def weaving(seed, hz=10, seconds=8, *, speed=1.0, heading=1.0, along=0.0, grid=0.0, noise=0.0):
    """Return a table of a car at 5 to 30 m/s that weaves and one that stops, with factors of two columns.

    The road leads in the direction ``along`` [rad]. Places are rounded to a multiple of ``grid``, after noise [m].
    """
    rng = np.random.default_rng(seed)
    times = np.arange(hz * seconds + 1) / hz
    moved, lines = 5.0 + 25.0 * rng.random(), [HEAD]
    for name, pace, turn in (("a", moved + 0 * times, 0.1 * np.sin(times)), ("b", np.maximum(9 - 3 * times, 0), 0)):
        angle = along + turn + 0 * times
        places = np.cumsum(pace / hz * np.exp(1j * angle)) - pace[0] / hz
        places += noise * (rng.normal(size=len(times)) + 1j * rng.normal(size=len(times)))
        x, y = (np.round(each / grid) * grid if grid else each for each in (places.real, places.imag))
        columns = zip(times, x, y, heading * angle, speed * pace, strict=True)
        lines += [f"{time},{name},{x},{y},{angle},{pace},4,2" for time, x, y, angle, pace in columns]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("hz", [1, 10, 25])
def test_table_in_other_units_is_refused_with_the_likely_cause(tmp_path, seed, hz):
    path = tmp_path / "tracks.csv"
    for factor, unit in ((3.6, "km/h"), (1 / 0.3048, "feet per second"), (1 / 0.44704, "miles per hour")):
        path.write_text(weaving(seed, hz, 20, speed=factor))
        fix = f"speed: expected m/s, received {factor:.4g} times .* in {unit}; divide the column by {factor:.4g}$"
        with pytest.raises(RecordingError, match=fix):
            pafot.recorded(path)
    path.write_text(weaving(seed, hz, 20, heading=180 / math.pi))
    fix = r"heading: expected radians, received 57.3 times .* as in degrees; multiply the column by pi / 180$"
    with pytest.raises(RecordingError, match=fix):
        pafot.recorded(path)


@table(
    "errors",
    [
        {},
        {"along": 2.0},
        {"grid": 0.3048},  # NGSIM has places in steps of a foot
        {"grid": 1.0},
        {"noise": 0.05, "hz": 25},  # inD and highD have errors of centimetres
        {"noise": 0.3},
        {"speed": 1.3},
        {"heading": 0.0},
        {"seconds": 1, "speed": 3.6},  # too short to say
    ],
)
def test_table_with_errors_of_measurement_is_read(tmp_path, errors):
    path = tmp_path / "tracks.csv"
    for seed in range(5):
        path.write_text(weaving(seed, **errors))
        assert len(pafot.recorded(path).vehicles) == 2


def test_number_of_vehicles_is_limited_with_those_that_were_lost_in_between(tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "MOST_VEHICLES", 3)
    path = tmp_path / "tracks.csv"
    row = "{},{},0,0,0,20,4,2"
    for names, gap, message in (
        ("abc", 0.5, ""),
        (
            "abcd",
            0.5,
            r"csv:5: expected at most 3 vehicles, received more; read a part of it, such as between=\(0, 60\)",
        ),
        ("aaa", 2.0, ""),
        ("aaaa", 2.0, r"csv: expected at most 3 vehicles, received more, since each gap of .* makes another one; read"),
    ):
        path.write_text("\n".join([HEAD, *(row.format(gap * at, name) for at, name in enumerate(names))]))
        if message:
            with pytest.raises(RecordingError, match=message):
                pafot.recorded(path)
            assert len(pafot.recorded(path, between=(0.0, 1.0)).vehicles) < 4
        else:
            assert len(pafot.recorded(path).vehicles) == 3


def test_gap_is_left_open_if_times_differ_so_little_that_millions_of_rows_would_fill_it(tmp_path):
    path = tmp_path / "tracks.csv"
    path.write_text(
        "time,vehicle,x,y,heading,speed,length,width\n"
        + "".join(f"{time},ego,0,0,0,20,4,2\n" for time in (0, 1e-9, 2e-9, 0.5))
    )
    assert len(pafot.recorded(path).vehicles[0].times) == 4


def test_lanes_with_two_numbers_are_left_out(tmp_path):
    path = tmp_path / "tracks.csv"
    rows = [f"{time},ego,{20 * time},0,0,20,4,2,{lane}\n" for time, lane in ((0, 1), (1, 1), (2, 2), (3, 2))]
    path.write_text("time,vehicle,x,y,heading,speed,length,width,lane\n" + "".join(rows))
    assert pafot.recorded(path).lanes == ()


def test_ego_of_a_table_is_found_by_any_usual_name(tmp_path):
    path = tmp_path / "tracks.csv"
    path.write_text("time,vehicle,x,y,heading,speed,length,width\n0,van,9,0,0,20,4,2\n0,Hero,0,0,0,20,4,2\n")
    assert pafot.recorded(path).ego == "Hero"


@table(
    "arguments, message",
    [
        ({"between": 5}, r"expected a first and a last time \[s\], such as between=\(0, 60\), received 5"),
        ({"between": (60, 0)}, r"a first and a last time"),
        ({"between": (0, math.nan)}, r"a first and a last time"),
        ({"between": ("0", "1")}, r"a first and a last time"),
        ({"without": "EnvironmentAction"}, r"expected a list, such as without=\['EnvironmentAction'\], received"),
        ({"vehicles": "cars.xosc"}, r"expected a list, such as vehicles=\['cars.xosc'\]"),
        ({"lane_width": 0}, r"expected lane_width in metres, above 0 and at most 20, received 0"),
        ({"lane_width": "3.5"}, r"expected lane_width in metres"),
    ],
)
def test_argument_that_would_be_misread_is_refused(highd, arguments, message):
    with pytest.raises(RequestError, match=message):
        pafot.recorded(highd, **arguments)


def test_file_that_is_not_there_and_vehicle_that_is_not_in_it_are_refused(highd):
    os.mkfifo(highd.parent / "pipe.csv")  # opening it would wait for somebody who writes
    for path, what in (
        ("nothing.csv", "does not exist"),
        (highd.parent, "is a folder"),
        (highd.parent / "pipe.csv", "is no regular file"),
    ):
        with pytest.raises(RequestError, match=rf"expected a file, received '{path}', which {what}; correct the path"):
            pafot.recorded(path)
    with pytest.raises(RequestError, match=r"recorded: expected the path of a file, received None; write its name"):
        pafot.recorded(None)
    with pytest.raises(RequestError, match=r"a file that can be read, received 'n+'?.*: File name too long; correct"):
        pafot.recorded("n" * 300)
    with pytest.raises(RequestError, match=r"expected one of the vehicles 1, 2, received 3"):
        pafot.recorded(highd, ego=3)


def test_name_of_a_vehicle_cannot_command_the_terminal(tmp_path):
    path = tmp_path / "tracks.csv"
    path.write_text("time,vehicle,x,y,heading,speed,length,width\n0,\x1b[31mred,0,0,0,20,4,2\n")
    with pytest.raises(RequestError, match=r"vehicles \\x1b\[31mred, received 'ego'"):
        pafot.recorded(path, ego="ego")


def test_lanes_of_a_named_ego_come_from_the_left_in_any_order_of_the_file(tmp_path):
    path = tmp_path / "scenario.xml"
    text = COMMONROAD.format(version="2020a", obstacle="dynamicObstacle", role="", shape=RECTANGLE)
    before, rest = text.split("  <lanelet", 1)
    lane, after = rest.split("</lanelet>", 1)
    left = lane.replace("<y>2.0", "<y>6.0").replace("<y>-2.0", "<y>2.0")
    path.write_text(f"{before}<lanelet{lane}</lanelet><lanelet{left}</lanelet>{after}")
    assert [each.y for each in pafot.recorded(path).lanes] == [0.0, -4.0]
    assert [each.y for each in pafot.recorded(path, ego=7).lanes] == [-4.0, 0.0]
