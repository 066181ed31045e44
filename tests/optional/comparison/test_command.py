"""The command from its arguments to its report."""

import csv
import json
import os
import re
import struct
import subprocess
import sys

import gymnasium
import numpy as np
import pytest

from pytest_pafot import SimulatorWorld, World
from pytest_pafot.__main__ import main
from pytest_pafot.commands.policy_reference import BAD_USE
from pytest_pafot.searches.request import SLICES
from tests.optional.export import test_export_command as export

pytestmark = pytest.mark.processes

DISTINCT, FAULTS = (
    "Distinct failures for which the ego is responsible",
    "faults of the ADS among them",
)
"""The headings of a table in the report, and of one of its columns."""

SMALL = [
    "--ads", "constant_speed", "--runs", "3", "--seconds", "200", "--duration", "20", "--workers", "1",
]  # fmt: skip


def compare(folder, *arguments):
    return main(["compare", *SMALL, "--out", str(folder), *arguments])


@pytest.fixture
def undrawn(monkeypatch):
    """Make reports without figures, which take longer than the runs."""
    monkeypatch.setattr("pytest_pafot.comparison.figures.draw_all", lambda measured, folder: {})


def rows_in(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def tables_of(report):
    """Return every table as rows of cells, by its heading."""
    found, heading = {}, ""
    for line in report.splitlines():
        if line.startswith("#"):
            heading = line.strip("# ")
        if line.startswith("|"):
            found.setdefault(heading, []).append(
                [cell.strip() for cell in line.strip("|").split("|")]
            )
    return found


def the_report_gives_the_command_and_the_versions(made, report):
    assert re.search(r"^python -m pytest_pafot compare --ads constant_speed", report, re.MULTILINE)
    assert re.search(r" 3 runs of 200 .* is 0\.", report)
    assert re.search(r"pytest-pafot \S+, highway-env \S+, numpy \S+", report)


def all_rows_of_a_table_have_as_many_cells_as_its_head(made, report):
    found = tables_of(report)
    assert len(found) == 3
    for rows in found.values():
        assert len({len(row) for row in rows}) == 1
        assert not any("nan" in cell or "inf" in cell.split() for row in rows for cell in row)


def every_test_has_its_p_value(made, report):
    rows = tables_of(report)["Statistics"][2:]
    assert len(rows) == 3 * 5
    assert all(re.fullmatch(r"(1|0\.\d+|\d\.?\d*e-\d+|< 0\.0001)", row[6]) for row in rows)
    assert {row[2] for row in rows} == {"av-fuzzer", "random-manoeuvre", "random"}


def every_figure_is_there_and_shown(made, report):
    shown = re.findall(r"!\[[^]]+\]\(figures/([a-z-]+)\.png\)", report)
    assert sorted(path.name for path in (made / "figures").iterdir()) == sorted(
        f"{name}.png" for name in shown
    )
    assert len(shown) == 2
    for name in shown:
        image = (made / "figures" / f"{name}.png").read_bytes()
        width, height = struct.unpack(">II", image[16:24])
        assert image.startswith(b"\x89PNG")
        assert width > 800
        assert height > 500


def the_files_to_publish_have_the_numbers_of_the_report(made, report):
    tests, rows = rows_in(made / "statistics.csv"), tables_of(report)["Statistics"][2:]
    assert [(row["measure"], row["second"]) for row in tests] == [(row[0], row[2]) for row in rows]
    assert [f"{float(row['p']):.2g}" for row in tests if float(row["p"]) >= 1e-4] == [
        row[6] for row in rows if "<" not in row[6]
    ]
    totals = {row[0]: row[1] for row in tables_of(report)["All collisions"][2:]}
    for name, told in totals.items():
        runs = [row for row in rows_in(made / "runs.csv") if row["algorithm"] == name]
        assert told == " of ".join(
            str(sum(int(row[each]) for row in runs)) for each in ("collisions", "scenarios")
        )


CHECKS = (
    the_report_gives_the_command_and_the_versions,
    all_rows_of_a_table_have_as_many_cells_as_its_head,
    every_test_has_its_p_value,
    every_figure_is_there_and_shown,
    the_files_to_publish_have_the_numbers_of_the_report,
)


@pytest.mark.usefixtures("copies")
def test_the_report_of_a_comparison_and_its_figures(tmp_path, subtests):
    """One item has all checks, so that only one worker makes the comparison, most of which is drawing."""
    assert compare(tmp_path, "--workers", "2") == 0
    report = (tmp_path / "report.md").read_text()
    for check in CHECKS:
        with subtests.test(check.__name__):
            check(tmp_path, report)


@pytest.mark.usefixtures("undrawn", "copies")
def test_any_number_of_workers_gives_the_same_rows_by_algorithm_and_run(tmp_path, capsys):
    algorithms = ["--algorithms", "random,pafot", "--runs", "2"]
    assert [compare(tmp_path / n, *algorithms, "--workers", n) for n in "12"] == [0, 0]
    one, two = ((tmp_path / n / "results.csv").read_bytes() for n in "12")
    assert one == two
    order = [(row["algorithm"], row["run"]) for row in rows_in(tmp_path / "1" / "results.csv")]
    expected = [("random", "0"), ("random", "1"), ("pafot", "0"), ("pafot", "1")]
    assert list(dict.fromkeys(order)) == expected
    assert re.findall(r" (\d) of 4 ", capsys.readouterr().err)[-2:] == ["3", "4"]


@pytest.mark.usefixtures("undrawn")
def test_rows_of_finished_runs_are_written_if_another_fails(tmp_path, capsys, monkeypatch):
    made = []

    def run_rows(plan, task):
        if made:
            raise KeyboardInterrupt
        made.append(task)
        return [{"algorithm": task[0], "run": task[1]}]

    monkeypatch.setattr("pytest_pafot.comparison.command.run_rows", run_rows)
    assert compare(tmp_path, "--algorithms", "random") == 130
    assert [(row["algorithm"], row["run"]) for row in rows_in(tmp_path / "results.csv")] == [
        ("random", "0")
    ]
    assert not (tmp_path / "report.md").exists()
    assert compare(tmp_path, "--algorithms", "random") == BAD_USE
    assert str(tmp_path) in capsys.readouterr().err
    assert len(rows_in(tmp_path / "results.csv")) == 1


@pytest.mark.usefixtures("undrawn")
def test_runs_of_different_lengths_are_compared_at_equal_seconds(tmp_path):
    arguments = ["--runs", "2", "--seconds", "100", "--algorithms", "pafot,av-fuzzer@5,random@15"]
    assert compare(tmp_path, *arguments) == 0
    rows = rows_in(tmp_path / "results.csv")
    for name, length, seconds in (
        ("av-fuzzer@5", 5, [1.0]),
        ("random@15", 15, SLICES),
        ("pafot", 20, [10.0]),
    ):
        own = [row for row in rows if row["algorithm"] == name]
        assert max(float(row["duration"]) for row in own) <= length
        assert {json.loads(row["executed"])[4] for row in own} <= set(seconds), "of a gene"


@pytest.mark.usefixtures("undrawn")
def test_algorithms_use_test_scenarios_unless_paper_is_requested(tmp_path, capsys):
    few = ["--runs", "1", "--seconds", "60", "--seed", "4"]
    assert compare(tmp_path, "--algorithms", "random,random@paper,pafot", *few) == 0
    rows = [
        (row["algorithm"], json.loads(row["executed"])) for row in rows_in(tmp_path / "results.csv")
    ]
    npcs, speeds = ({name: {of(each) for own, each in rows if own == name} for name, _ in rows}
                    for of in (lambda each: len(each[0]), lambda each: each[3]))  # fmt: skip
    assert (npcs["random@paper"], npcs["pafot"]) == ({2}, {2})
    assert (speeds["random@paper"], speeds["pafot"]) == ({22.0}, {22.0})
    assert npcs["random"] <= {3, 4, 5, 6}
    assert len(speeds["random"]) > 2
    report, told = (tmp_path / "report.md").read_text(), capsys.readouterr().err
    assert re.findall("(?m)^- ([^:]*): .* NPCs", report) == ["random", "random@paper, pafot"]
    assert re.findall("(?m)^  ([^:]*): .* NPCs", told) == ["random", "random@paper, pafot"]


def test_algorithms_that_find_nothing_have_a_report_too(tmp_path):
    """A policy that stands still is never responsible, and two seconds of driving cause no collision."""
    few = ["--duration", "2", "--seconds", "10", "--runs", "2", "--algorithms", "pafot,random"]
    assert compare(tmp_path, "--ads", f"{__name__}:standing", *few) == 0
    found = tables_of((tmp_path / "report.md").read_text())
    rows = found[DISTINCT][2:]
    assert {(row[1], row[-1]) for row in rows} == {("0", "not reached")}
    assert {row[3] for row in found["All collisions"][2:]} == {"no collision"}


def standing():
    return lambda observation: (-5.0, 0.0)


@pytest.mark.usefixtures("undrawn")
def test_one_algorithm_alone_is_reported_without_tests(tmp_path):
    assert compare(tmp_path, "--algorithms", "random", "--seconds", "20") == 0
    assert "Statistics" not in tables_of((tmp_path / "report.md").read_text())


WRONG = [
    ("--algorithms", "pafot,genetic"),
    ("--algorithms", ","),
    ("--algorithms", "pafot,random,pafot"),
    ("--algorithms", "av-fuzzer@soon"),
    ("--ads", "constant_speedd"),
    ("--ads", "no_such_policy:make"),
    ("--runs", "0"),
    ("--seed", "-1"),
    ("--fitness", "papr"),
    ("--clearance", "-1"),
    ("--world", "highway-fast-v1"),
]


@pytest.mark.parametrize("arguments", WRONG, ids=" ".join)
def test_wrong_arguments_are_one_line_and_write_nothing(tmp_path, capsys, arguments):
    assert compare(tmp_path / "out", *arguments) == BAD_USE
    error = capsys.readouterr().err
    assert (error[:9], error.count("\n")) == ("compare: ", 1)
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(os.name == "nt", reason="Windows calls it a lack of permission")
@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("name", ["runs.csv", "report.md", "."])
def test_unwritable_result_is_reported(tmp_path, capsys, name):
    taken = tmp_path / "out" / name
    taken.mkdir(parents=True) if name != "." else taken.touch()
    few = ["--algorithms", "random", "--runs", "1", "--seconds", "20"]
    assert compare(tmp_path / "out", *few) == BAD_USE
    told = capsys.readouterr().err.splitlines()[-1]
    assert (told[:16], f" {taken}: " in told) == ("compare: --out: ", True)


def test_missing_libraries_error_says_how_to_install_them(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    assert compare(tmp_path / "out") == BAD_USE
    assert "pip install 'pytest-pafot[compare]'" in capsys.readouterr().err


@pytest.mark.usefixtures("undrawn", "copies")
@pytest.mark.parametrize("workers", ["1", "2"])
def test_policy_failing_in_every_run_is_setup_error(tmp_path, capsys, workers):
    """The cause may be a policy for an environment without --world. The folder stays free for the right command."""
    arguments = ["--ads", f"{__name__}:of_an_environment", "--workers", workers, "--runs", "1"]
    assert compare(tmp_path, *arguments) == BAD_USE
    said = capsys.readouterr()
    assert said.out == ""
    assert "ValueError: unexpected shape ()\n" in said.err
    assert not (tmp_path / "report.md").exists()
    few = ["--duration", "5", "--seconds", "15", "--algorithms", "random", "--workers", "1"]
    assert compare(tmp_path, *arguments, "--world", "highway-v0", *few) == 0


def of_an_environment():
    def drive(observation):
        shape = np.shape(observation)
        if shape != (5, 5):
            raise ValueError(f"unexpected shape {shape}")
        return 1

    return drive


@pytest.mark.usefixtures("undrawn")
def test_policy_that_raises_later_is_an_ads_fault(tmp_path):
    arguments = ["--ads", f"{__name__}:raising_later", "--algorithms", "pafot,random"]
    assert compare(tmp_path, *arguments) == 0
    report = (tmp_path / "report.md").read_text()
    head, _, *rows = tables_of(report)[DISTINCT]
    assert [row[head.index(FAULTS)] for row in rows] == ["1", "1"]


def raising_later():
    def drive(observation):
        if observation.time > 0.5:
            raise RuntimeError("no plan")
        return 0.0, 0.0

    return drive


def test_the_help_needs_no_library():
    code = (
        "import sys\nfrom pytest_pafot.__main__ import main\n"
        "try:\n    main(['compare', '--help'])\nexcept SystemExit:\n    pass\n"
        "assert not {'pandas', 'scipy', 'matplotlib', 'pytest', 'highway_env'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "--algorithms" in done.stdout


def road():
    return SimulatorWorld(export.Road, duration=10.0)


def wrapped():
    return World("highway-fast-v0", wrappers=[gymnasium.Wrapper])


def compare_in(world, folder, ads, *arguments):
    given = ["--ads", ads, "--out", str(folder), "--runs", "1", "--seconds", "10", *arguments]
    return main(["compare", *given, "--world", f"{__name__}:{world}"])


@pytest.mark.usefixtures("undrawn")
def test_algorithms_are_compared_in_the_world_of_a_factory(tmp_path):
    random = ("--algorithms", "random", "--workers")
    assert compare_in("road", tmp_path / "own", "constant_speed", *random, "2") == 0
    assert '"class": "Road"' in (tmp_path / "own" / "report.md").read_text()
    given = (f"{__name__}:of_an_environment", *random, "1", "--duration", "5")
    assert compare_in("wrapped", tmp_path / "wrapped", *given) == 0
    assert '"duration": 5.0' in (tmp_path / "wrapped" / "report.md").read_text()


DECIDED = [("--duration", "5"), ("--algorithms", "random@5")]


@pytest.mark.parametrize("options", DECIDED)
def test_what_a_simulator_of_the_users_own_decides_is_no_option(tmp_path, capsys, options):
    assert compare_in("road", tmp_path, "constant_speed", *options) == BAD_USE
    assert capsys.readouterr().err.startswith(f"compare: {options[0]}: ")
