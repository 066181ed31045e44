"""The command ``compare``, which runs a comparison and writes its report."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import fields
from functools import partial
from importlib.util import find_spec
from pathlib import Path

from pytest_pafot.algorithms.catalogue import ALGORITHMS
from pytest_pafot.commands.policy_reference import add_world_arguments, worker_count
from pytest_pafot.commands.tasks import run_tasks
from pytest_pafot.comparison.plan import COLUMNS, DIFFERENT, Plan, Row, run_rows
from pytest_pafot.searches.request import BLAMES
from pytest_pafot.support.errors import RequestError, install
from pytest_pafot.support.files import write_whole, written_into
from pytest_pafot.support.text import csv_text, visible

LIBRARIES = ("matplotlib", "pandas", "scipy")
RESULTS = "results.csv"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the command."""
    parser.add_argument(
        "--algorithms",
        default="pafot,av-fuzzer,random-manoeuvre,random",
        metavar="A,B,...",
        help=f"compare these algorithms: any of {', '.join(ALGORITHMS)}, or your own as module:Class. Use NAME@S for "
        "runs of S seconds, and NAME@paper for the paper's scenarios. The first algorithm is compared with each of the "
        "others (default: %(default)s)",
    )
    parser.add_argument(
        "--ads",
        required=True,
        metavar="ADS",
        help="test this policy: a module of example_ads, module:factory, or module:factory:argument",
    )
    parser.add_argument(
        "--out",
        required=True,
        type=Path,
        metavar="DIR",
        help="write the results to this folder, which must not contain results yet",
    )
    parser.add_argument(
        "--runs",
        type=int,
        default=10,
        metavar="N",
        help="run each algorithm N times (default: %(default)s)",
    )
    parser.add_argument(
        "--seconds",
        type=float,
        default=3600.0,
        metavar="S",
        help="stop each run after S simulated seconds (default: 3600)",
    )
    parser.add_argument(
        "--seed",
        type=int,
        default=0,
        metavar="N",
        help="derive seeds from N (default: %(default)s)",
    )
    parser.add_argument(
        "--workers", type=int, metavar="N", help="use N processes (default: one per core)"
    )
    parser.add_argument(
        "--blame",
        choices=BLAMES,
        default="any",
        help="search for these collisions: all (any), or only those for which the ego is responsible (ego) "
        "(default: %(default)s, as in the paper)",
    )
    parser.add_argument(
        "--fitness",
        help="maximise this fitness: default, paper, av-fuzzer, a measure such as headway, or module:function "
        "(default: the fitness of each algorithm)",
    )
    add_world_arguments(parser, "default: a highway, in SI units")
    parser.add_argument(
        "--duration",
        type=float,
        metavar="S",
        help="set the duration of scenarios to S seconds (default: 60, or the duration of the environment)",
    )
    parser.add_argument(
        "--clearance",
        type=float,
        metavar="D",
        help="set the clearance of the grid to D metres; the paper uses 0 (default: 3)",
    )


def run(arguments: argparse.Namespace, command: Sequence[str]) -> int:
    """Run a comparison, write a report that quotes ``command``, and return the exit code."""
    names = map(str.strip, arguments.algorithms.split(","))
    given = {each.name: getattr(arguments, each.name) for each in fields(Plan)}
    given["algorithms"] = tuple(filter(None, names))
    plan = Plan(**given)
    plan.check()
    workers = worker_count(arguments.workers)
    folder = arguments.out
    # Errors on the command line are reported first, before the user has to install anything.
    missing = next((name for name in LIBRARIES if find_spec(name) is None), None)
    if missing:
        raise RequestError(
            f"the report needs the library {missing}, which is not installed. Run `{install('compare')}`."
        )
    path = folder / RESULTS
    if path.exists():
        raise RequestError(
            f"--out: expected a folder without the results of a comparison, but {folder} contains {RESULTS}. "
            "Choose another folder."
        )
    if len(plan.scenarios) > 1:
        groups = "".join(
            f"  {', '.join(names)}: {which}\n" for which, names in plan.scenarios.items()
        )
        sys.stderr.write(f"compare: warning: {DIFFERENT}\n{groups}")
    with written_into(folder):
        folder.mkdir(parents=True, exist_ok=True)
    rows: dict[tuple[str, int], list[Row]] = {}
    # If the command is stopped or a run ends in an error, the rows of the finished runs are written, too.
    try:
        for task, found in run_tasks(partial(run_rows, plan), plan.tasks, workers):
            rows[task] = found
            sys.stderr.write(f"compare: {len(rows)} of {len(plan.tasks)} runs\n")
    finally:
        if rows:  # otherwise, the folder stays free for a corrected command
            every = []
            for name in plan.names:
                for run in range(plan.runs):
                    found = rows.get((name, run), [])
                    every += [[row.get(column) for column in COLUMNS] for row in found]
            with written_into(folder):
                write_whole(path, csv_text(tuple(COLUMNS), every))
    # pandas, scipy and matplotlib are imported only now, because they take seconds.
    from pytest_pafot.comparison import figures, markdown, run_measures  # noqa: PLC0415

    measured = run_measures.Results.read(plan, path)
    with written_into(folder):
        titles = figures.draw_all(measured, folder / "figures")
        write_whole(folder / "runs.csv", measured.runs.to_csv(index=False, lineterminator="\n"))
        tests = run_measures.comparisons(measured)
        write_whole(folder / "statistics.csv", csv_text(run_measures.Comparison._fields, tests))
        write_whole(folder / "report.md", markdown.report(measured, tests, command, titles))
    sys.stdout.write(f"{folder / 'report.md'}\n")
    errors = [*run_measures.undriven_errors(measured.frame)]
    sys.stderr.write("".join(f"compare: {visible(each)}\n" for each in errors))
    return int(bool(errors))
