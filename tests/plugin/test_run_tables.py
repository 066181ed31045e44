"""The option ``--pafot-table``: all runs of a session's searches in one file."""

import csv
import os

import pytest

import pytest_pafot as pafot
from pytest_pafot.campaign import run_table
from pytest_pafot.campaign.run_table import COLUMNS
from pytest_pafot.plugin import run_tables
from pytest_pafot.searching.events import GenerationFinished
from tests.plugin.test_session_records import IS_CUT, TWO


def rows_of(project, name="runs.csv"):
    with (project.path / name).open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_each_run_is_a_row_of_the_table(failing):
    result = failing.run("--pafot-table=runs.csv")
    result.stdout.fnmatch_lines(["table: runs.csv"])
    rows = rows_of(failing)
    assert rows
    assert list(rows[0]) == list(COLUMNS)
    assert [int(row["run"]) for row in rows] == list(range(1, len(rows) + 1))
    assert {row["test"] for row in rows} == {"test_it.py::test_fails[search]"}
    for row in rows:
        assert (row["outcome"] == "collision") == bool(row["responsibility"])
        assert (row["verdict"] == "failed") == (row["failing"] == "True") == bool(row["kind"])
        assert float(row["least_gap"]) >= 0.0


def test_a_run_whose_scenario_was_repaired_has_its_verdict_too():
    def holds(run):
        assert not run.collision

    found = pafot.explore(
        lambda: lambda observation: (0.0, 0.0), holds=holds, blame="ego", runs=24, seed=1, shrink_rollouts=0
    )
    simulated = [row for row in found.runs if not row["reused"]]
    assert len(simulated) == 24
    assert [row["scenario"] for row in simulated if row["verdict"] is None] == []
    assert all((row["verdict"] == "failed") == row["failing"] == bool(row["fault"]) for row in simulated)


@pytest.mark.processes
def test_workers_write_rows_in_the_same_order(project):
    project.write(TWO)
    project.run("--pafot-table=runs.csv")
    alone = rows_of(project)
    project.run("--pafot-table=again.csv", "-n2", "--pafot-save=none")
    assert rows_of(project, "again.csv") == alone
    assert len({row["test"] for row in alone}) == 2


def test_interrupted_session_writes_its_completed_runs(project):
    project.write(IS_CUT)
    project.run("--pafot-table=runs.csv", no_reraise_ctrlc=True)
    assert rows_of(project)


@pytest.mark.parametrize("name", ["runs.txt", "runs"])
def test_a_name_without_a_known_ending_is_refused(failing, name):
    result = failing.run(f"--pafot-table={name}")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines([f"*expected the name of a file FILE.csv or FILE.parquet, received '{name}'*"])


def test_unwritable_table_is_reported_and_search_continues(failing):
    (failing.path / "taken").write_text("a file")
    result = failing.run("--pafot-table=taken/runs.csv")
    result.stdout.fnmatch_lines(["*--pafot-table=taken/runs.csv: not written: *; there is a file where*"])
    assert failing.files


@pytest.mark.skipif(os.name == "nt", reason="links need rights on Windows")
@pytest.mark.parametrize("name", ["runs.csv", "runs.parquet"])
def test_table_replaces_a_link_but_not_its_target(failing, tmp_path_factory, name):
    pytest.importorskip("pyarrow")
    secret = tmp_path_factory.mktemp("elsewhere") / "secret"
    secret.write_text("mine")
    (failing.path / name).symlink_to(secret)
    failing.run(f"--pafot-table={name}")
    assert not (failing.path / name).is_symlink()
    assert secret.read_text() == "mine"


@pytest.mark.skipif(os.name == "nt", reason="links need rights on Windows")
def test_link_that_appears_in_the_session_is_not_followed(project, tmp_path_factory):
    secret = tmp_path_factory.mktemp("elsewhere") / "secret"
    secret.write_text("mine")
    body = f"    Path('runs.csv').unlink()\n    Path('runs.csv').symlink_to({str(secret)!r})\n"
    project.write(f"from pathlib import Path\n\n@pafot.search(SHORT)\ndef test_swaps(run):\n{body}")
    result = project.run("--pafot-table=runs.csv")
    assert "runs.csv: not all runs were written:" in " ".join(result.stdout.str().split())
    assert secret.read_text() == "mine"


@pytest.mark.parametrize("name", ["runs.csv", "runs.parquet"])
@pytest.mark.parametrize(
    ("given", "code"),
    [
        (["none.py"], pytest.ExitCode.USAGE_ERROR),
        (["-k", "nothing"], pytest.ExitCode.NO_TESTS_COLLECTED),
    ],
)
def test_session_that_is_refused_leaves_the_earlier_table(failing, name, given, code):
    pytest.importorskip("pyarrow")
    (failing.path / name).write_text("an earlier one")
    result = failing.run(f"--pafot-table={name}", *given)
    assert result.ret == code
    result.stdout.fnmatch_lines([f"*--pafot-table={name}: nothing was written, since no search ran"])
    assert (failing.path / name).read_text() == "an earlier one"


def test_session_without_a_search_writes_a_table_without_rows(failing):
    failing.run("--pafot-table=runs.csv", generations=0)
    assert rows_of(failing) == []


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_pipe_receives_the_table_at_the_end(failing):
    os.mkfifo(failing.path / "runs.csv")
    reader = os.open(failing.path / "runs.csv", os.O_RDONLY | os.O_NONBLOCK)
    failing.run("--pafot-table=runs.csv", "--pafot-save=none")
    received = os.read(reader, 1_000_000).decode()
    os.close(reader)
    failing.run("--pafot-table=file.csv", "--pafot-save=none")
    assert received == (failing.path / "file.csv").read_text()


def test_a_parquet_file_has_the_same_rows(failing):
    pandas = pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    failing.run("--pafot-table=runs.csv", "--pafot-save=none")
    failing.run("--pafot-table=runs.parquet", "--pafot-save=none")
    written, read = pandas.read_parquet(failing.path / "runs.parquet"), pandas.read_csv(failing.path / "runs.csv")
    assert list(written.columns) == list(read.columns)
    assert written["least_gap"].tolist() == read["least_gap"].tolist()


SEVERAL = """
@pafot.search(SHORT)
def test_b(run):
    pass

@pafot.search(SHORT)
def test_a(run):
    assert not run.collision
"""


def test_rows_are_sorted_by_test_though_another_order_ran(project):
    project.write(SEVERAL)
    project.run("--pafot-table=runs.csv", "--pafot-save=none")
    order = [(row["test"], int(row["run"])) for row in rows_of(project)]
    assert order == sorted(order)
    assert len({test for test, _ in order}) == 2


def test_parquet_written_in_pieces_has_types_of_all_rows(monkeypatch):
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    monkeypatch.setattr(run_tables, "AT_ONCE", 2)
    names, rows = list(COLUMNS), run_tables.StoredRows()
    hit = names.index("collision_time")
    made = [["t", 0, number, *[None] * (len(names) - 3)] for number in range(1, 6)]
    made[3][hit] = 2.5  # the first piece has no collision, so no type for its time
    rows.add(made)
    table = parquet.read_table(pyarrow.BufferReader(run_tables._parquet(names, rows)))
    rows.close()
    assert table.column("collision_time").to_pylist() == [None, None, None, 2.5, None]
    assert table.column("run").to_pylist() == [1, 2, 3, 4, 5]


def test_columns_of_old_runs_are_forgotten_between_generations(monkeypatch):
    monkeypatch.setattr(run_table, "EVALUATIONS", 10)
    table = run_table.RunTable()

    def see(event):
        table.see(event)
        if isinstance(event, GenerationFinished):
            assert all(row["verdict"] for row in table.taken() if not row["reused"])
            assert len(table._judged) == 10

    def ads():
        return lambda observation: (0.0, 0.0)

    pafot.explore(ads, holds=lambda run: None, runs=64, seed=1, on_event=see)
    assert table.number >= 64
