"""The items of `@pafot.recorded`: one for each vehicle in whose place the policy drives."""

import csv
import re

import pytest

POLICY = """
@pytest.fixture
def ads():
    return lambda: lambda seen: (0.0, 0.0)
"""
TEST = "def test_it(run):\n    assert not run.collision\n"


@pytest.fixture
def tracks(project):
    """Write a recording of an ego, a car that cuts in and brakes, one that is seen shortly and one far behind."""
    with (project.pytester.path / "tracks.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["time", "vehicle", "x", "y", "heading", "speed", "length", "width"])
        for tick in range(101):
            time = tick / 10
            table.writerow([time, "1", 20 * time, 0, 0, 20, 4.6, 1.8])
            across = min(max(time - 2, 0), 3.5) - 3.5
            table.writerow(
                [time, "2", 15 + 20 * time - max(time - 5, 0) ** 2, across, 0, 20 - 2 * max(time - 5, 0), 4.6, 1.8]
            )
            table.writerow([time, "4", 20 * time - 900, 0, 0, 20, 4.6, 1.8])
            if time < 3:
                table.writerow([time, "3", 60 + 20 * time, 0, 0, 20, 4.6, 1.8])
    return project


def run(project, decorator, *args):
    project.write(f"import pytest\n{POLICY}\n{decorator}\n{TEST}")
    lines = project.run("-v", "-rs", *args).outlines
    return dict(re.findall(r"test_it\.py::test_it\[(\S+)\] (\w+)", "\n".join(lines))), "\n".join(lines)


def test_each_vehicle_that_is_seen_long_enough_is_an_item(tracks):
    items, text = run(tracks, '@pafot.recorded("tracks.csv")')
    assert items == {"tracks/1": "FAILED", "tracks/2": "PASSED", "tracks/4": "SKIPPED"}
    assert "NPC 0: as recorded, from 15 m ahead" in text
    assert re.search(r"tracks/4: this world cannot drive it: .*expected vehicles within 200 m of 4", text, re.DOTALL)


def test_named_ego_is_the_only_item(tracks):
    assert run(tracks, '@pafot.recorded("tracks.csv", ego=2)')[0] == {"tracks/2": "PASSED"}


def test_recording_without_a_vehicle_that_is_seen_long_enough_is_no_green_test(tracks):
    lines = (tracks.pytester.path / "tracks.csv").read_text().splitlines()
    (tracks.pytester.path / "short.csv").write_text("\n".join(lines[:100]))  # the first 2.5 s
    items, text = run(tracks, '@pafot.recorded("short.csv")')
    assert items == {"?": "FAILED"}
    assert "expected a vehicle that is seen for 5 s or more" in text
    assert "received 4, each of them for less; name one with ego=" in text
    assert run(tracks, '@pafot.recorded("short.csv", ego=1)')[0].keys() == {"short/1"}


def test_recording_is_driven_with_other_values_beside_named_scenarios(tracks):
    mark = '@pafot.catalogue(pafot.recorded("tracks.csv", ego=1), "classic/pulls-away", seconds=3.0)'
    items, text = run(tracks, mark)
    assert items.keys() == {"tracks/1", "classic/pulls-away"}
    assert "leaves the recording after 3.0 s" in text or items["tracks/1"] == "PASSED"


def test_wrong_argument_fails_the_items(tracks):
    items, text = run(tracks, '@pafot.catalogue(pafot.recorded("tracks.csv", ego=1), gap=3.0)')
    assert items == {"tracks/1": "FAILED"}
    assert "expected ads, world or one of seconds, received 'gap'" in text


SEARCH = """
import pytest

@pytest.fixture
def ads():
    return lambda: lambda seen: (0.0, 0.0)

@pafot.search({arguments})
def test_it(run):
    assert not run.collision
"""
AROUND = 'around=pafot.recorded("tracks.csv", ego=1), runs=64'


def searched(project, arguments):
    project.write(SEARCH.format(arguments=arguments))
    return " ".join(" ".join(project.run("--pafot-corpus=corpus").outlines).split())


def test_search_begins_with_the_recording_and_goes_around_it(tracks):
    text = searched(tracks, f"{AROUND}, speed_limit=36.3")
    assert "NPCs around the recording" in text
    assert "new finding" in text
    (file, *_) = (tracks.pytester.path / "corpus").rglob("*.pafot.yaml")
    assert "  ego_track: |-\n" in file.read_text()
    replayed = "\n".join(tracks.run(str(file), "--pafot-corpus=corpus").outlines)
    assert "1 failed" in replayed


def test_search_around_what_is_no_recording_is_refused(tracks):
    assert "around=...): expected no arguments of scenarios beside it, received npcs" in searched(
        tracks, f"{AROUND}, npcs=2"
    )
    assert "expected an algorithm that varies manoeuvres, received av-fuzzer" in searched(
        tracks, f"{AROUND}, algorithm='av-fuzzer'"
    )
    assert "expected pafot.recorded(...), or a scenario that its scenario() returns, received 3" in searched(
        tracks, "around=3"
    )
    assert "ego_speed: expected at most 16.50 m/s" in searched(tracks, f"{AROUND}, speed_limit=15.0")
