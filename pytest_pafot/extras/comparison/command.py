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
from pytest_pafot.extending import (
    ALGORITHMS,
    WorldData,
    add_world_arguments,
    base_world,
    chosen_world,
    drawn_space,
)
from pytest_pafot.extras.comparison.algorithm_run import run_all
from pytest_pafot.extras.comparison.plan import Plan, checked
from pytest_pafot.extras.resumable import AGAIN, worker_count, written_into
from pytest_pafot.support.errors import RequestError, install
from pytest_pafot.support.files import write_whole
from pytest_pafot.support.references import PLANNER

LIBRARIES = ("matplotlib", "pandas", "scipy")
SAMPLED_NPCS = "sampled, or 2 in the paper's scenarios and on a bent road where none crosses the ego's way"
SAMPLED_GENES = "sampled, or 10 in the paper's scenarios; on a bent road 3, and at most 10 in the paper's scenarios"
START = " in the paper's scenarios and with --world, otherwise sampled; on a bent road, the environment's"


SPACE = ("npcs", "genes", "gene_seconds", "traffic", "vehicles", "ego_lane", "ego_speed")
"""The options that are fields of a space of scenarios."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the command."""
    parser.add_argument(
        "--algorithms",
        default="pafot,av-fuzzer,random-manoeuvre,random",
        metavar="A,B,...",
        help=f"the algorithms: any of {', '.join(ALGORITHMS)}, or your own as module:Class; with NAME@S its runs last "
        "S seconds, and with NAME@paper it has the paper's scenarios; the first algorithm is compared with each of the "
        "others (default: %(default)s)",
    )
    of_ads = "the policy: a module of example_ads, module:factory, or module:factory:argument"
    parser.add_argument("--ads", required=True, metavar="ADS", help=of_ads)
    parser.add_argument("--out", required=True, type=Path, metavar="DIR", help="folder for the results and the report")
    of_runs = "runs of each algorithm (default: %(default)s)"
    parser.add_argument("--runs", type=int, default=10, metavar="N", help=of_runs)
    budget = parser.add_mutually_exclusive_group()
    budget.add_argument("--generations", type=int, metavar="N", help="generations of each run (default: 100)")
    budget.add_argument("--seconds", type=float, metavar="S", help="simulated time of each run, instead of generations")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="base seed (default: %(default)s)")
    parser.add_argument("--workers", type=int, metavar="N", help="number of processes (default: one per core)")
    parser.add_argument(
        "--blame",
        choices=("any", "ego", "preventable", "avoidable"),
        default="any",
        help="ego: search for collisions that the ego is responsible for; preventable: only for those in which a "
        "reference driver is not at fault; avoidable: also for those that the rules excuse although braking late, but "
        "hard, avoids them (default: %(default)s, as in the paper)",
    )
    of_fitness = "fitness for all algorithms: default, paper, av-fuzzer, a measure such as headway, or module:function "
    of_fitness += "(default: that of each algorithm)"
    parser.add_argument("--fitness", help=of_fitness)
    of_population = "scenarios per generation (default: that of each algorithm)"
    parser.add_argument("--population", type=int, metavar="N", help=of_population)
    add_world_arguments(parser, "default: a highway, in SI units")
    for name, number, metavar, meaning in (
        ("--lanes", int, "N", f"number of lanes (default: {Highway().lanes})"),
        ("--speed-limit", float, "V", f"speed limit [m/s] (default: {Highway().speed_limit})"),
        ("--duration", float, "S", "duration of a scenario [s] (default: 60, or the environment's)"),
        ("--clearance", float, "D", "clearance of the grid [m]; the paper has 0 (default: 3)"),
        ("--npcs", int, "N", f"number of NPCs, 1 to 8 (default: {SAMPLED_NPCS})"),
        ("--genes", int, "N", "genes of each NPC (default: as many as fill a scenario)"),
        ("--gene-seconds", float, "S", f"duration of a gene [s] (default: {SAMPLED_GENES})"),
    ):
        parser.add_argument(name, type=number, metavar=metavar, help=meaning)
    of_traffic = "how the NPCs drive (default: as in a test with the algorithm)"
    parser.add_argument("--traffic", metavar="STYLE", help=of_traffic)
    of_vehicles = "what vehicles NPCs can be, such as car,truck (default: cars)"
    parser.add_argument("--vehicles", type=lambda text: text.split(","), metavar="A,B", help=of_vehicles)
    of_ego_lane = f"first lane of the ego, from 0 at the left (default: 1{START})"
    parser.add_argument("--ego-lane", type=int, metavar="N", help=of_ego_lane)
    of_ego_speed = f"first speed of the ego and of NPCs that do not cross [m/s] (default: 22{START})"
    parser.add_argument("--ego-speed", type=float, metavar="V", help=of_ego_speed)


def run(arguments: argparse.Namespace, command: Sequence[str]) -> int:
    """Run a comparison and write its report, which quotes ``command``; return the exit code."""
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
        from pytest_pafot.extras.comparison import figures, markdown, run_measures  # noqa: PLC0415

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
    return 0


def plan_of(arguments: argparse.Namespace) -> Plan:
    """Make the plan of a comparison from parsed arguments.

    Raises:
        RequestError: for a value that no world or space accepts.
    """
    road: dict[str, Any] = {
        name: value
        for name in ("lanes", "speed_limit", "duration", "clearance")
        if (value := getattr(arguments, name)) is not None
    }
    is_planner = arguments.ads.endswith(PLANNER)
    world = chosen_world(arguments.world, arguments.config, [arguments.ads], is_planner=is_planner)
    is_own = world is not None and not isinstance(world, World)
    for name in road if is_own else ("lanes", "speed_limit") if world is not None else ():
        if name in road:
            raise RequestError(
                f"--{name.replace('_', '-')}: expected no such option with --world {arguments.world}, received "
                f"{road[name]!r}; leave it out, because that world has its own"
            )
    world = Highway(**road) if world is None else world if is_own else replace(world, **road)
    if isinstance(world, World):
        world.check()
    given = {name: value for name in SPACE if (value := getattr(arguments, name)) is not None}
    try:
        space = base_world(world).space(given)
    except ValueError as error:
        raise RequestError(str(error)) from None
    if odd := next((each for each in space.vehicles if not base_world(world).can_drive(each)), None):
        raise RequestError(f"--vehicles: expected some that follow the bends of {world!r}, received {odd.described}")
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
        parameters={} if arguments.population is None else {"population": arguments.population},
        world=WorldData.of(world).data,
        world_name=arguments.world or "",
        space=space.plain,
        drawn={name: value for name, value in drawn_space(world, given).items() if name != "crossings"},
    )
