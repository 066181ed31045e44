"""The option `begin_with`: a search that drives saved scenarios before those that it draws."""

import csv
import json
import re

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
    told.fnmatch_lines(["  note: 1 of 2 saved scenarios fit this search"])
    second.unlink()
    result = project.run(f"--pafot-begin-with={theirs}")
    result.stdout.fnmatch_lines(["  note: 0 of 1 saved scenarios fit this search"])


def test_a_folder_without_files_is_refused_with_its_whole_path(project):
    project.write(SPEEDS_UP)
    told = project.run("--pafot-begin-with=nowhere").stdout
    told.fnmatch_lines(["*--pafot-begin-with=nowhere: expected others, a saved scenario (*.pafot.yaml) or a folder *"])
    assert str(project.path / "nowhere") in told.str().replace("\n", "").replace("  ", " ")


def test_a_name_that_is_the_packages_and_a_folder_here_is_refused(project):
    project.write(SPEEDS_UP)
    (project.path / "others").mkdir()
    project.run("--pafot-begin-with=others").stdout.fnmatch_lines(["*received a name that is both; write ./others *"])


def test_one_file_is_enough(project, theirs):
    assert searched(project, f"--pafot-begin-with={theirs / '2.pafot.yaml'}")[1]["given"] == 1


def test_an_algorithm_that_begins_with_nothing_says_so(project, theirs):
    _, record, told = searched(project, f"--pafot-begin-with={theirs}", "--pafot-algorithm=random")
    assert record["given"] == 0
    told.fnmatch_lines(["*the algorithm random begins with no saved scenarios"])


def test_fewer_runs_than_scenarios_are_counted_as_they_are(project, theirs):
    assert searched(project, f"--pafot-begin-with={theirs}", "--pafot-runs=1")[1]["given"] == 1


def test_a_search_is_resumed_with_the_same_scenarios_only(project, theirs):
    begin = f"--pafot-begin-with={theirs}"
    whole = searched(project, begin)[0]
    first = searched(project, begin, "--pafot-runs=8", "--pafot-resume=states")[0]
    project.run("--pafot-runs=22", "--pafot-table=more.csv", begin, "--pafot-resume=states", generations=None)
    with (project.path / "more.csv").open() as rows:
        assert [*first, *(row["scenario"] for row in csv.DictReader(rows))] == whole
    (theirs / "3.pafot.yaml").unlink()
    told = project.run("--pafot-runs=8", begin, "--pafot-resume=states", generations=None).stdout.str()
    assert re.search(r"begin_with", told)


def test_a_search_does_not_begin_with_its_own_findings(project, theirs):
    searched(project, f"--pafot-begin-with={theirs}", "--pafot-runs=2")
    assert project.files
    told = project.run("--pafot-begin-with=pafot_corpus", generations=1).stdout
    told.fnmatch_lines(["*--pafot-begin-with=pafot_corpus: expected others, *"])


def test_speeds_keep_to_the_traffic_of_the_search(project, theirs):
    project.write(SPEEDS_UP.replace("SHORT", 'traffic="everyday"'))
    _, record, _ = searched(project, f"--pafot-begin-with={theirs}", "--pafot-runs=2")
    assert record["given"] == 2
    lowest = pafot.Traffic("everyday").least_speed(26.8)
    driven = [pafot.load(file).finding for file in project.files]
    for finding in driven:
        scenario = finding.original or finding.scenario
        assert min(gene.speed for chain in scenario.npcs for gene in chain) >= lowest - 0.05


def test_a_file_that_cannot_be_read_is_named(project, theirs):
    (theirs / "1.pafot.yaml").write_text("pafot: 2\n")
    project.run(f"--pafot-begin-with={theirs}").stdout.fnmatch_lines(["*1.pafot.yaml*"])
