"""The command from its arguments to its report."""

import csv
import io
import json
import os
import re
import struct
import subprocess
import sys
from contextlib import redirect_stdout

import gymnasium
import numpy as np
import pytest

from pytest_pafot import Highway, World
from pytest_pafot.__main__ import main
from pytest_pafot.campaign.request import SLICES
from pytest_pafot.commands.policy_reference import BAD_USE
from pytest_pafot.comparison import figures
from pytest_pafot.comparison.figures import FIGURES
from pytest_pafot.comparison.markdown import PAPER

pytestmark = pytest.mark.processes

DRAW_ALL = figures.draw_all
SMALL = ["--ads", "constant_speed", "--runs", "3", "--generations", "4", "--duration", "20", "--workers", "1"]


def compare(folder, *arguments):
    return main(["compare", *SMALL, "--out", str(folder), *arguments])


@pytest.fixture
def undrawn(monkeypatch):
    """Make reports without figures, which take longer than the runs."""
    monkeypatch.setattr("pytest_pafot.comparison.figures.draw_all", lambda measured, folder: {})


def tables_of(report):
    """Return every table as rows of cells, by its heading."""
    found, heading = {}, ""
    for line in report.splitlines():
        if line.startswith("#"):
            heading = line.strip("# ")
        if line.startswith("|"):
            found.setdefault(heading, []).append([cell.strip() for cell in line.strip("|").split("|")])
    return found


def the_report_gives_the_command_the_versions_and_the_hours(made, report):
    assert "python -m pytest_pafot compare --ads constant_speed" in report
    assert re.search(
        r"3 runs of each algorithm, 4 generations each, base seed 0; \d+\.\d h of simulated driving", report
    )
    assert re.search(r"pytest-pafot \S+, highway-env \S+, numpy \S+", report)


def all_rows_of_a_table_have_as_many_cells_as_its_head(made, report):
    found = tables_of(report)
    assert len(found) == 5
    for rows in found.values():
        assert len({len(row) for row in rows}) == 1
        assert not any("nan" in cell or "inf" in cell.split() for row in rows for cell in row)


def the_papers_numbers_stand_beside(made, report):
    found = tables_of(report)
    first = {row[0]: row for row in found["How many collisions"]}
    for name, told in PAPER.items():
        assert {str(told.scenarios), str(told.collisions), f"{100 * told.collisions / told.scenarios:.1f} %"} <= set(
            first[name]
        )
    assert [f"{told.collisions / told.scenarios:.1%}" for told in PAPER.values()] == ["80.5%", "56.3%", "24.9%"]
    second = {row[0]: row for row in found["How fast"]}
    assert "28.16 s" in second["pafot"]
    assert "20.65 s (60 / 3)" in second["pafot"]


def the_report_warns_of_the_conditional_time_to_collision(made, report):
    assert "**The time to collision is conditional**" in report


def every_test_has_its_p_value(made, report):
    rows = tables_of(report)["Statistics"][2:]
    assert len(rows) == 3 * 17
    assert all(re.fullmatch(r"(1|0\.\d+|\d\.?\d*e-\d+|< 0\.0001)", row[7]) for row in rows)
    assert {row[3] for row in rows} == {"av-fuzzer", "random-manoeuvre", "random"}


def the_clock_on_the_wall_is_told_beside_the_simulated_one(made, report):
    head, _, *rows = tables_of(report)["How fast"]
    assert [head.index(f"wall clock per {each}") for each in ("scenario", "collision")] == [11, 12]
    assert all(re.fullmatch(r"\d+\.\d ms", row[11]) for row in rows)


def every_figure_is_there_as_png_and_svg_and_shown(made, report):
    shown = re.findall(r"!\[[^]]+\]\(figures/([a-z-]+)\.png\)", report)
    assert len(shown) == 7
    assert sorted(path.name for path in (made / "figures").iterdir()) == sorted(
        f"{name}.{ending}" for name in shown for ending in ("png", "svg")
    )
    for name in shown:
        image = (made / "figures" / f"{name}.png").read_bytes()
        width, height = struct.unpack(">II", image[16:24])
        assert image.startswith(b"\x89PNG")
        assert width > 800
        assert height > 500


def axes_have_names_with_units(made, report):
    texts = (made / "figures" / "first-failure.svg").read_text()
    assert texts.count("<!--") > 5
    for name in ("runs without an ego-responsible failure [%]", "simulated time of a run [h]", "pafot", "random"):
        assert f"<!-- {name} -->" in texts


def the_files_to_publish_have_the_numbers_of_the_report(made, report):
    with (made / "statistics.csv").open() as file:
        tests = list(csv.DictReader(file))
    rows = tables_of(report)["Statistics"][2:]
    assert [(row["measure"], row["second"]) for row in tests] == [(row[0], row[3]) for row in rows]
    assert [f"{float(row['p']):.2g}" for row in tests if float(row["p"]) >= 1e-4] == [
        row[7] for row in rows if "<" not in row[7]
    ]
    with (made / "runs.csv").open() as file:
        runs = list(csv.DictReader(file))
    totals = {row[0]: row[1] for row in tables_of(report)["How many collisions"][2:]}
    sums = {name: sum(int(row["scenarios"]) for row in runs if row["algorithm"] == name) for name in totals}
    assert {name: str(count) for name, count in sums.items()} == totals
    assert f"numpy=={np.__version__}\n" in (made / "versions.txt").read_text()


def the_same_again_changes_nothing_but_takes_no_time(made, report):
    before = {
        path.name: path.read_bytes() for path in made.rglob("*") if path.suffix in (".csv", ".png", ".svg", ".md")
    }
    with redirect_stdout(io.StringIO()) as printed, pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "draw_all", draw_first_failure)
        assert compare(made) == 0
    after = {path.name: path.read_bytes() for path in made.rglob("*") if path.suffix in (".csv", ".png", ".svg", ".md")}
    assert after == before
    assert printed.getvalue() == f"{made / 'report.md'}\n"


def draw_first_failure(measured, folder):
    """Draw one of the figures, which takes a seventh of the time; return the titles of all."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "FIGURES", {"first-failure": FIGURES["first-failure"]})
        DRAW_ALL(measured, folder)
    return {name: title for name, (title, *_) in FIGURES.items()}


CHECKS = (
    the_report_gives_the_command_the_versions_and_the_hours,
    all_rows_of_a_table_have_as_many_cells_as_its_head,
    the_papers_numbers_stand_beside,
    the_report_warns_of_the_conditional_time_to_collision,
    every_test_has_its_p_value,
    the_clock_on_the_wall_is_told_beside_the_simulated_one,
    every_figure_is_there_as_png_and_svg_and_shown,
    axes_have_names_with_units,
    the_files_to_publish_have_the_numbers_of_the_report,
    the_same_again_changes_nothing_but_takes_no_time,
)


def test_the_report_of_a_comparison_and_its_figures(tmp_path, subtests):
    """One item has all checks, so that only one worker makes the comparison, most of which is drawing."""
    assert compare(tmp_path) == 0
    report = (tmp_path / "report.md").read_text()
    for check in CHECKS:
        with subtests.test(check.__name__):
            check(tmp_path, report)


@pytest.mark.usefixtures("undrawn")
def test_runs_of_equal_seconds_are_compared_separately(tmp_path):
    arguments = ["--ads", "constant_speed", "--runs", "2", "--seconds", "100", "--duration", "20", "--workers", "1"]
    algorithms = ["--algorithms", "pafot,av-fuzzer@5,random@15"]
    assert main(["compare", *arguments, *algorithms, "--out", str(tmp_path)]) == 0
    found = tables_of((tmp_path / "report.md").read_text())
    assert {row[1] for row in found["Statistics"][2:]} == {"seconds"}
    lengths = {row[0]: float(row[1].removesuffix(" s")) for row in found["How fast"][2:]}
    assert lengths["av-fuzzer@5"] <= 5 < lengths["pafot"]
    for name, seconds in (("av-fuzzer@5", [1.0]), ("random@15", SLICES), ("pafot", [10.0])):
        with (tmp_path / "runs" / f"{name}-000.csv").open() as file:
            assert {json.loads(row["executed"])[4] for row in csv.DictReader(file)} <= set(seconds), "of a gene"


@pytest.mark.usefixtures("undrawn")
def test_algorithms_use_test_scenarios_unless_paper_is_requested(tmp_path, capsys):
    arguments = ["--algorithms", "random,random@paper,pafot", "--runs", "1", "--generations", "1", "--seed", "4"]
    assert compare(tmp_path, *arguments) == 0
    drawn = {}
    for name in ("random", "random@paper", "pafot"):
        with (tmp_path / "runs" / f"{name}-000.csv").open() as file:
            scenarios = [json.loads(row["executed"]) for row in csv.DictReader(file)]
        drawn[name] = (
            len(scenarios),
            {len(npcs) for npcs, *_ in scenarios},
            len({speed for _, _, _, speed, *_ in scenarios}),
        )
    runs, npcs, speeds = drawn.pop("random")
    assert drawn == {"random@paper": (4, {2}, 1), "pafot": (4, {2}, 1)}
    assert (runs, speeds) == (4, 4), "speeds of the ego at first"
    assert npcs <= {3, 4, 5, 6}
    report, told = (tmp_path / "report.md").read_text(), capsys.readouterr().err
    assert "; of random with `{" in report
    of_test, papers = (
        "3 to 6 NPCs with Position- or Lane-Instructions in hostile traffic (NPCs may stop, brake hard and "
        "cut in close); the ego starts at 12 to 26.8 m/s in lanes "
        "0 to 3",
        "2 NPCs; the ego starts at 22 m/s in lane 1",
    )
    warning, _, tables = report.partition("## How many collisions")
    assert "**Warning:** the algorithms have different scenarios, so differences" in warning
    assert f"- random: {of_test}; genes of 2 to 4 s, together 20 s; half of them have" in warning
    assert f"- random@paper, pafot: {papers}; 2 genes of 10 s\n" in warning
    assert "| pafot |" in tables
    assert "compare: warning: the algorithms have different scenarios" in told
    assert f"  random@paper, pafot: {papers}; 2 genes of 10 s\n" in told


def test_algorithms_that_find_nothing_have_a_report_too(tmp_path):
    """A policy that stands still is never responsible, and two seconds of driving cause no collision."""
    arguments = ["--duration", "2", "--generations", "2", "--runs", "2"]
    arguments += ["--algorithms", "pafot,random"]
    assert compare(tmp_path, "--ads", "tests.optional.comparison.test_command:standing", *arguments) == 0
    found = tables_of((tmp_path / "report.md").read_text())
    assert {row[1] for row in found["Distinct failures for which the ego answers"][2:]} == {"0"}
    assert {row[-1] for row in found["Distinct failures for which the ego answers"][2:]} == {"not reached"}


def standing():
    return lambda observation: (-5.0, 0.0)


@pytest.mark.usefixtures("undrawn")
def test_one_algorithm_alone_is_reported_without_tests(tmp_path):
    assert compare(tmp_path, "--algorithms", "random", "--generations", "1") == 0
    assert "There is only one algorithm" in (tmp_path / "report.md").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--algorithms", "pafot,genetic"], "algorithm: expected one of random, pafot, .*, received 'genetic'"),
        (["--algorithms", ","], "--algorithms: expected one or more of random, .*, received none"),
        (["--algorithms", "pafot,random,pafot"], "--algorithms: expected each name once, received pafot again"),
        (
            ["--algorithms", "av-fuzzer@soon"],
            "--algorithms: expected seconds or paper after the @, as in av-fuzzer@15, received",
        ),
        (
            ["--ads", "constant_speedd"],
            "--ads: expected one of blind_lane_change, constant_speed, fiss, idm_mobil, junctions, ppo, or "
            "module:factory for your own policy, received 'constant_speedd'; did you mean 'constant_speed'",
        ),
        (["--ads", "no_such_policy:make"], "--ads: expected a module that can be imported, received 'no_such_policy:"),
        (["--runs", "0"], "--runs: expected a whole number, at least 1, received 0"),
        (["--seed", "-1"], "--seed: expected a whole number, at least 0, received -1"),
        (["--fitness", "papr"], "fitness: expected .* did you mean 'paper'"),
        (["--clearance", "-1"], "clearance: expected .* received -1"),
        (["--world", "nowhere-v0"], "nowhere-v0"),
    ],
)
def test_wrong_arguments_are_one_line_and_write_nothing(tmp_path, capsys, arguments, message):
    assert compare(tmp_path / "out", *arguments) == BAD_USE
    error = capsys.readouterr().err
    assert re.match(f"compare: .*{message}", error, re.DOTALL), error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(os.name == "nt", reason="Windows calls it a lack of permission")
@pytest.mark.usefixtures("undrawn", "copies")
@pytest.mark.parametrize(("name", "workers"), [("runs", "1"), ("runs", "2"), ("results.csv", "1"), ("report.md", "1")])
def test_unwritable_result_is_reported_and_command_can_continue(tmp_path, capsys, name, workers):
    taken = tmp_path / name
    taken.touch() if name == "runs" else taken.mkdir()
    arguments = ("--algorithms", "pafot,random", "--runs", "1", "--generations", "2", "--workers", workers)
    assert compare(tmp_path, *arguments) == BAD_USE
    told = capsys.readouterr().err.splitlines()[-1]
    assert told.startswith(f"compare: --out: expected a folder that can be written, received {taken}: ")
    assert told.endswith(": rename or delete it, then run the same command again: finished tasks are not repeated")
    taken.unlink() if name == "runs" else taken.rmdir()
    assert compare(tmp_path, *arguments) == 0


def test_command_interrupted_while_drawing_continues_when_repeated(tmp_path, capsys, monkeypatch):
    def interrupted(measured, folder):
        raise KeyboardInterrupt

    monkeypatch.setattr("pytest_pafot.comparison.figures.draw_all", interrupted)
    assert compare(tmp_path, "--algorithms", "random", "--runs", "1", "--generations", "1") == 130
    assert capsys.readouterr().err.endswith(
        "interrupted; finished runs are saved, and the same command continues with the rest\n"
    )


def test_two_budgets_are_refused(tmp_path, capsys):
    with pytest.raises(SystemExit):
        compare(tmp_path, "--seconds", "100")
    assert "not allowed with argument" in capsys.readouterr().err


def test_missing_libraries_error_says_how_to_install_them(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    assert compare(tmp_path / "out") == BAD_USE
    assert "pip install 'pytest-pafot[compare]'" in capsys.readouterr().err


@pytest.mark.usefixtures("undrawn", "copies")
@pytest.mark.parametrize("workers", ["1", "2"])
def test_policy_failing_in_every_run_is_setup_error(tmp_path, capsys, workers):
    """The cause may be a policy for an environment without --world; the folder stays free for the right command."""
    arguments = [
        "--ads",
        "tests.optional.comparison.test_command:of_an_environment",
        "--workers",
        workers,
        "--runs",
        "1",
    ]
    assert compare(tmp_path, *arguments) == BAD_USE
    said = capsys.readouterr()
    assert said.out == ""
    for part in (
        "received ValueError: unexpected shape ()\n",
        'raise ValueError(f"unexpected shape {shape}")\n',
        "This happened in all 4 runs of the first generation",
        "The ADS was given a pafot.Observation (time, ego,",
        "must return (acceleration [m/s^2], steering [rad]), two finite numbers, or a pafot.Drive. "
        "A policy of a highway-env environment needs that environment, such as --world highway-v0.\n",
    ):
        assert part in said.err
    assert not (tmp_path / "report.md").exists()
    more = ["--world", "highway-v0", "--duration", "5", "--generations", "1", "--algorithms", "random"]
    assert compare(tmp_path, *arguments, *more, "--workers", "1") == 0


def of_an_environment():
    def drive(observation):
        shape = np.shape(observation)
        if shape != (5, 5):
            raise ValueError(f"unexpected shape {shape}")
        return 1

    return drive


@pytest.mark.usefixtures("undrawn")
def test_policy_that_raises_later_is_an_ads_fault(tmp_path):
    arguments = ["--ads", "tests.optional.comparison.test_command:raising_later", "--algorithms", "pafot,random"]
    assert compare(tmp_path, *arguments) == 0
    report = (tmp_path / "report.md").read_text()
    head, _, *rows = tables_of(report)["Distinct failures for which the ego answers"]
    assert [row[head.index("faults of the ADS among them")] for row in rows] == ["1", "1"]
    assert "What counts as a failure in the search: all collisions; and faults of the ADS" in report


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


class Road:
    """A world of the user's own, which is code."""

    speed_limit, longest_run = 20.0, 10.0
    rollout = staticmethod(Highway().rollout)

    def to_dict(self):
        return {}


def wrapped():
    return World("highway-fast-v0", wrappers=[gymnasium.Wrapper])


def compare_in(world, folder, ads, *arguments):
    given = ["--ads", ads, "--out", str(folder), "--runs", "1", "--generations", "1", *arguments]
    return main(["compare", *given, "--world", f"{__name__}:{world}"])


@pytest.mark.usefixtures("undrawn")
def test_algorithms_are_compared_in_the_world_of_a_factory(tmp_path):
    random = ("--algorithms", "random", "--workers")
    assert compare_in("Road", tmp_path / "own", "constant_speed", *random, "2") == 0
    assert '"class": "Road"' in (tmp_path / "own" / "comparison.json").read_text()
    given = (f"{__name__}:of_an_environment", *random, "1", "--duration", "5")
    assert compare_in("wrapped", tmp_path / "wrapped", *given) == 0
    assert json.loads((tmp_path / "wrapped" / "comparison.json").read_text())["plan"]["world"]["duration"] == 5.0


@pytest.mark.parametrize(("options", "told"), [
    (["--duration", "5"], "--duration: expected no such option with --world"),
    (["--algorithms", "random@5"], "expected no seconds after the @ in a world of your own, received random@5"),
])  # fmt: skip
def test_what_a_world_of_the_users_own_decides_is_no_option(tmp_path, capsys, options, told):
    assert compare_in("Road", tmp_path, "constant_speed", *options) == BAD_USE
    assert told in capsys.readouterr().err
