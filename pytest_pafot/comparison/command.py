"""``python -m pytest_pafot compare``: run a comparison and write its report."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pytest_pafot import Highway, World
from pytest_pafot.campaign.request import BLAMES, drawn_space
from pytest_pafot.commands.policy_reference import add_world_arguments, chosen_world, worker_count
from pytest_pafot.comparison.algorithm_run import run_all
from pytest_pafot.comparison.plan import Plan, checked
from pytest_pafot.comparison.resumable import AGAIN
from pytest_pafot.searching.algorithms.catalogue import ALGORITHMS
from pytest_pafot.support.errors import RequestError, install
from pytest_pafot.support.files import write_whole, written_into
from pytest_pafot.support.references import PLANNER
from pytest_pafot.support.text import visible
from pytest_pafot.world.codec import WorldData
from pytest_pafot.world.guard.own_worlds import base_world

LIBRARIES = ("matplotlib", "pandas", "scipy")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the command."""
    parser.add_argument(
        "--algorithms",
        default="pafot,av-fuzzer,random-manoeuvre,random",
        metavar="A,B,...",
        help=f"compare these algorithms: any of {', '.join(ALGORITHMS)}, or your own as module:Class; with NAME@S its "
        "runs last S seconds, and with NAME@paper it has the paper's scenarios; the first algorithm is compared with "
        "each of the others (default: %(default)s)",
    )
    of_ads = "drive with this policy: a module of example_ads, module:factory, or module:factory:argument"
    parser.add_argument("--ads", required=True, metavar="ADS", help=of_ads)
    parser.add_argument("--out", required=True, type=Path, metavar="DIR", help="write the results to this folder")
    of_runs = "run each algorithm N times (default: %(default)s)"
    parser.add_argument("--runs", type=int, default=10, metavar="N", help=of_runs)
    budget = parser.add_mutually_exclusive_group()
    budget.add_argument("--generations", type=int, metavar="N", help="end each run after N generations (default: 100)")
    budget.add_argument("--seconds", type=float, metavar="S", help="end each run after S simulated seconds instead")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="derive seeds from N (default: %(default)s)")
    parser.add_argument("--workers", type=int, metavar="N", help="use N processes (default: one per core)")
    parser.add_argument(
        "--blame",
        choices=BLAMES,
        default="any",
        help="search for these collisions. any: all; ego: those that the ego is responsible for; preventable: only "
        "those in which a reference driver is not at fault; avoidable: also those that the rules excuse although "
        "braking late, but hard, avoids them (default: %(default)s, as in the paper)",
    )
    of_fitness = "maximise this fitness: default, paper, av-fuzzer, a measure such as headway, or module:function "
    of_fitness += "(default: that of each algorithm)"
    parser.add_argument("--fitness", help=of_fitness)
    add_world_arguments(parser, "default: a highway, in SI units")
    of_duration = "let scenarios last S seconds (default: 60, or the environment's)"
    parser.add_argument("--duration", type=float, metavar="S", help=of_duration)
    of_clearance = "set the clearance of the grid [m]; the paper has 0 (default: 3)"
    parser.add_argument("--clearance", type=float, metavar="D", help=of_clearance)


def run(arguments: argparse.Namespace, command: Sequence[str]) -> int:
    """Run a comparison and write its report, which quotes ``command``. Return 1 if most of it never drove, else 0."""
    try:
        plan = checked(plan_of(arguments))
        workers = worker_count(arguments.workers)
        # Errors on the command line are reported before the user installs anything for it.
        missing = next((name for name in LIBRARIES if find_spec(name) is None), None)
        if missing:
            raise RequestError(
                f"expected the library {missing} for the report, received a Python without it; "
                f"run `{install('compare')}`"
            )
        folder = Path(arguments.out)
        results = run_all(plan, folder, workers=workers, stream=sys.stderr, clock=time.monotonic)
        from pytest_pafot.comparison import figures, markdown, run_measures  # noqa: PLC0415

        measured = run_measures.Results.of(plan, results)
        with written_into(folder, AGAIN):
            titles = figures.draw_all(measured, folder / "figures")
            report = markdown.report(measured, command, markdown.wall_seconds(plan, folder), titles)
            for name, text in markdown.published(measured).items():
                write_whole(folder / name, text)
            write_whole(folder / "report.md", report)
    except KeyboardInterrupt as interrupt:
        interrupt.add_note("finished runs are saved, and the same command continues with the rest")
        raise
    sys.stdout.write(f"{folder / 'report.md'}\n")
    errors = [*run_measures.undriven(measured.frame)]
    sys.stderr.write("".join(f"compare: {visible(each)}\n" for each in errors))
    return int(bool(errors))


def plan_of(arguments: argparse.Namespace) -> Plan:
    """Make the plan of a comparison from parsed arguments.

    Raises:
        RequestError: for a value that no world or space accepts.
    """
    road: dict[str, Any] = {
        name: value for name in ("duration", "clearance") if (value := getattr(arguments, name)) is not None
    }
    is_planner = arguments.ads.endswith(PLANNER)
    world = chosen_world(arguments.world, arguments.config, [arguments.ads], is_planner=is_planner)
    if world is None:
        world = Highway(**road)
    elif isinstance(world, World):
        world = replace(world, **road)
        world.check()
    elif road:
        name, value = next(iter(road.items()))
        raise RequestError(
            f"--{name}: expected no such option with --world {arguments.world}, received {value!r}; leave it out, "
            "because that world has its own"
        )
    generations = None if arguments.seconds is not None else arguments.generations
    if arguments.seconds is None and generations is None:
        generations = 100
    return Plan(
        ads=arguments.ads,
        algorithms=tuple(name.strip() for name in arguments.algorithms.split(",") if name.strip()),
        runs=arguments.runs,
        generations=generations,
        seconds=arguments.seconds,
        seed=arguments.seed,
        blame=arguments.blame,
        fitness=arguments.fitness,
        world=WorldData.of(world).data,
        world_name=arguments.world or "",
        space=base_world(world).space({}).plain,
        drawn={name: value for name, value in drawn_space(world, {}).items() if name != "crossings"},
    )
