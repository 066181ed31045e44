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

SMALL = [
    "--ads",
    "constant_speed",
    "--runs",
    "3",
    "--seconds",
    "200",
    "--duration",
    "20",
    "--workers",
    "1",
]


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
    assert "python -m pytest_pafot compare --ads constant_speed" in report
    assert "Each algorithm has 3 runs of 200 simulated seconds. The base seed is 0." in report
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
    assert list(dict.fromkeys(order)) == [
        ("random", "0"),
        ("random", "1"),
        ("pafot", "0"),
        ("pafot", "1"),
    ]
    assert "compare: 3 of 4 runs\ncompare: 4 of 4 runs\n" in capsys.readouterr().err


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
    assert "expected a folder without the results of a comparison, but " in capsys.readouterr().err
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
    arguments = [
        "--algorithms",
        "random,random@paper,pafot",
        "--runs",
        "1",
        "--seconds",
        "60",
        "--seed",
        "4",
    ]
    assert compare(tmp_path, *arguments) == 0
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
    of_test, papers = (
        "3 to 6 NPCs with PositionInstructions or LaneInstructions in hostile traffic (NPCs may stop, brake hard and "
        "cut in close); the ego starts at 12 to 26.8 m/s in lanes "
        "0 to 3",
        "2 NPCs; the ego starts at 22 m/s in lane 1",
    )
    assert (
        "**Warning:** the algorithms have different scenarios, which may be the reason for differences"
        in report
    )
    assert f"- random: {of_test}; genes of 2 to 4 s, together 20 s; half of them have" in report
    assert f"- random@paper, pafot: {papers}; 2 genes of 10 s\n" in report
    assert "compare: warning: the algorithms have different scenarios" in told
    assert f"  random@paper, pafot: {papers}; 2 genes of 10 s\n" in told


def test_algorithms_that_find_nothing_have_a_report_too(tmp_path):
    """A policy that stands still is never responsible, and two seconds of driving cause no collision."""
    arguments = [
        "--duration",
        "2",
        "--seconds",
        "10",
        "--runs",
        "2",
        "--algorithms",
        "pafot,random",
    ]
    assert compare(tmp_path, "--ads", f"{__name__}:standing", *arguments) == 0
    found = tables_of((tmp_path / "report.md").read_text())
    assert {row[1] for row in found["Distinct failures for which the ego is responsible"][2:]} == {
        "0"
    }
    assert {row[-1] for row in found["Distinct failures for which the ego is responsible"][2:]} == {
        "not reached"
    }
    assert {row[3] for row in found["All collisions"][2:]} == {"no collision"}


def standing():
    return lambda observation: (-5.0, 0.0)


@pytest.mark.usefixtures("undrawn")
def test_one_algorithm_alone_is_reported_without_tests(tmp_path):
    assert compare(tmp_path, "--algorithms", "random", "--seconds", "20") == 0
    assert "There is only one algorithm" in (tmp_path / "report.md").read_text()


@pytest.mark.parametrize(("arguments", "message"), [
    (["--algorithms", "pafot,genetic"], "algorithm: expected one of random, pafot, .*, but received 'genetic'"),
    (["--algorithms", ","], "--algorithms: expected one or more of random, .*, but received none"),
    (["--algorithms", "pafot,random,pafot"], "--algorithms: expected each name once, but received pafot again"),
    (["--algorithms", "av-fuzzer@soon"],
     r"--algorithms: expected a time \[s\] or paper after the @, as in av-fuzzer@15, but received"),
    (["--ads", "constant_speedd"],
     "--ads: expected one of blind_lane_change, constant_speed, fiss, idm_mobil, junctions, ppo, or "
     "module:factory for your own policy, received 'constant_speedd'. Did you mean 'constant_speed'"),
    (["--ads", "no_such_policy:make"], "--ads: expected a module that can be imported, received 'no_such_policy:"),
    (["--runs", "0"], "--runs: expected a whole number, at least 1, but received 0"),
    (["--seed", "-1"], "--seed: expected a whole number, at least 0, but received -1"),
    (["--fitness", "papr"], "fitness: expected .* Did you mean 'paper'"),
    (["--clearance", "-1"], "clearance: expected .* received -1"),
    (["--world", "nowhere-v0"], "nowhere-v0"),
])  # fmt: skip
def test_wrong_arguments_are_one_line_and_write_nothing(tmp_path, capsys, arguments, message):
    assert compare(tmp_path / "out", *arguments) == BAD_USE
    error = capsys.readouterr().err
    assert re.match(f"compare: .*{message}", error, re.DOTALL), error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(os.name == "nt", reason="Windows calls it a lack of permission")
@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("name", ["runs.csv", "report.md", "."])
def test_unwritable_result_is_reported(tmp_path, capsys, name):
    taken = tmp_path / "out" / name
    taken.mkdir(parents=True) if name != "." else taken.touch()
    assert (
        compare(tmp_path / "out", "--algorithms", "random", "--runs", "1", "--seconds", "20")
        == BAD_USE
    )
    told = capsys.readouterr().err.splitlines()[-1]
    assert told.startswith(f"compare: --out: expected a writable folder, received {taken}: ")


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
    for part in (
        "the ADS failed: ValueError: unexpected shape ()\n",
        'raise ValueError(f"unexpected shape {shape}")\n',
        "This happened in all 4 runs of the first generation",
        "The ADS was given a pafot.Observation (time, ego,",
        "must return (acceleration [m/s^2], steering [rad]), two finite numbers, or a pafot.LaneCommand. "
        'A policy for a highway-env environment needs world=pafot.World("highway-v0", config=...). On the command '
        "line, world= is --world,",
    ):
        assert part in said.err
    assert not (tmp_path / "report.md").exists()
    more = [
        "--world",
        "highway-v0",
        "--duration",
        "5",
        "--seconds",
        "15",
        "--algorithms",
        "random",
        "--workers",
        "1",
    ]
    assert compare(tmp_path, *arguments, *more) == 0


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
    head, _, *rows = tables_of(report)["Distinct failures for which the ego is responsible"]
    assert [row[head.index("faults of the ADS among them")] for row in rows] == ["1", "1"]
    assert (
        "The search counts as failures all collisions, and exceptions and hangs of the ADS."
        in report
    )


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


@pytest.mark.parametrize(("options", "told"), [
    (["--duration", "5"], "--duration: expected no such option with --world"),
    (["--algorithms", "random@5"], "no seconds after the @ with a simulator of your own, but received random@5"),
])  # fmt: skip
def test_what_a_simulator_of_the_users_own_decides_is_no_option(tmp_path, capsys, options, told):
    assert compare_in("road", tmp_path, "constant_speed", *options) == BAD_USE
    assert told in capsys.readouterr().err
