"""The option `begin_with`: a search that drives saved scenarios before those that it draws."""

import csv
import json

import pytest

import pytest_pafot as pafot

FOUND = "@pafot.search(SHORT, stop_after=1)\ndef test_it(run):\n    assert not run.collision\n"
SPEEDS_UP = (
    "@pafot.search(SHORT, ads=lambda: lambda seen: (2.0, 0.0))\ndef test_it(run):\n    assert not run.collision\n"
)


@pytest.fixture
def theirs(project, tmp_path_factory):
    """Return a folder with two findings in one policy; the project's test is of another policy now."""
    folder = tmp_path_factory.mktemp("theirs")
    project.write(FOUND)
    for seed in (2, 3):
        project.run(generations=10, seed=seed)
        (content,) = project.contents.values()
        (folder / f"{seed}.pafot.yaml").write_text(content)
        project.forget()
    project.write(SPEEDS_UP)
    return folder


def searched(project, *args, **options):
    """Return the ids of the scenarios that a search drove, in order, its record, and what it printed."""
    project.forget()
    given = "--pafot-runs=30", "--pafot-table=runs.csv", "--pafot-json=out.json"
    result = project.run(*given, *args, generations=None, **options)
    with (project.path / "runs.csv").open() as rows:
        driven = [row["scenario"] for row in csv.DictReader(rows)]
    (record,) = json.loads((project.path / "out.json").read_text())["searches"]
    return driven, record, result.stdout


def test_saved_scenarios_are_driven_first(project, theirs):
    ids = [pafot.load(file).scenario.id for file in sorted(theirs.iterdir())]
    driven, record, told = searched(project, f"--pafot-begin-with={theirs}")
    assert driven[:2] == ids
    assert (len(driven), record["runs"], record["given"]) == (30, 30, 2)
    told.re_match_lines([r"  saved scenarios at first: [0-2] of 2 failed by the ego's fault"])
    driven, record, told = searched(project)
    assert not set(ids) & set(driven)
    assert record["given"] == 0
    told.no_re_match_line(".*saved scenarios at first.*")


def test_their_failures_are_findings_of_the_policy_that_drives_them(project, theirs):
    _, record, _ = searched(project, f"--pafot-begin-with={theirs}", "--pafot-runs=2")
    assert record["failing"] == record["random_failing"] == 2
    assert len(project.files) == len(record["finds"]) > 0


def test_the_same_is_found_with_workers(project, theirs):
    told = []
    for more in ((), ("--pafot-workers=2",)):
        driven, record, _ = searched(project, f"--pafot-begin-with={theirs}", *more)
        told.append((driven, record["failing"], record["given"], project.contents))
    assert told[0] == told[1]


def test_the_ego_starts_where_the_search_lets_it_start(project, theirs):
    for file in theirs.iterdir():
        text = file.read_text()
        assert "ego: {lane: 1, speed: 22.0}" in text
        file.write_text(text.replace("ego: {lane: 1, speed: 22.0}", "ego: {lane: 2, speed: 25.0}"))
    _, record, _ = searched(project, f"--pafot-begin-with={theirs}", "--pafot-runs=2")
    assert record["given"] == 2
    starts = {(saved.scenario.ego_lane, saved.scenario.ego_speed) for saved in map(pafot.load, project.files)}
    assert starts == {(1, 22.0)}


def test_scenarios_of_another_road_are_left_out(project, theirs):
    crossing = "    - - {zone: o1>o3, slot: 0.0, speed: 8.0}\n"
    first, second = sorted(theirs.iterdir())
    text = first.read_text().split("original:")[0].split("shrunk:")[0]
    first.write_text(text[: text.index("    - - ")] + 2 * crossing + text[text.index("expect:") :])
    told = searched(project, f"--pafot-begin-with={theirs}", "--pafot-runs=2")[2]
    told.fnmatch_lines(["  note: began with 1 saved scenario; 1 of 2 do not fit this world"])
    second.unlink()
    result = project.run(f"--pafot-begin-with={theirs}")
    result.stdout.fnmatch_lines(["*expected scenarios that fit the world, received 1 in *, none of which does: *"])


@pytest.mark.parametrize(
    ("options", "received"),
    [
        (["--pafot-begin-with=nowhere"], "*--pafot-begin-with=nowhere: expected others or a folder with saved *"),
        (["--pafot-begin-with=.", "--pafot-algorithm=random"], "*expected the algorithm distinct or map-elites, *"),
    ],
)
def test_what_a_search_cannot_begin_with_is_refused(project, options, received):
    project.write(SPEEDS_UP)
    project.run(*options).stdout.fnmatch_lines([received])


def test_a_file_that_cannot_be_read_is_named(project, theirs):
    (theirs / "1.pafot.yaml").write_text("pafot: 2\n")
    project.run(f"--pafot-begin-with={theirs}").stdout.fnmatch_lines(["*1.pafot.yaml*"])
