"""The runs of a comparison: each run is a search of one algorithm, without pytest, whose scenarios become rows."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, TextIO

from pytest_pafot import WorldLike
from pytest_pafot.campaign.explore import AlgorithmRun
from pytest_pafot.campaign.setup_fault import SetupFaultError
from pytest_pafot.comparison.plan import DIFFERENT, Plan
from pytest_pafot.comparison.resumable import ResumableJob, Task, Tick, claim, run_job
from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.references import PLANNER
from pytest_pafot.support.text import csv_text
from pytest_pafot.world.driving.policy import Policy

COLUMNS: Mapping[str, str] = {
    "algorithm": "name of the algorithm",
    "run": "number of the algorithm's run, from 0",
    **AlgorithmRun.COLUMNS,
}
"""The columns of the results: those of a run of an algorithm, and what is compared."""

Row = Mapping[str, Any]


def text_of(rows: Iterable[Row]) -> str:
    """Format rows as CSV; equal runs give equal text."""
    return csv_text(tuple(COLUMNS), ([row.get(name) for name in COLUMNS] for row in rows))


def run_all(plan: Plan, folder: Path, *, workers: int, stream: TextIO, clock: Callable[[], float]) -> Path:
    """Do the runs that are not finished yet; return the file with all rows, by algorithm and run as in the plan.

    If algorithms have different scenarios, a warning says so before hours are spent on the runs.

    The arguments and the exceptions are as for :func:`run_job`.
    """
    job = ResumableJob(
        tasks=plan.tasks,
        in_order=tuple((name, run) for name in plan.names for run in range(plan.runs)),
        question=plan.question,
        identities=plan.identities,
        text=partial(_text, plan),
    )
    claim(job, folder)  # report an unusable folder before anything else
    if len(plan.scenarios) > 1:
        groups = "".join(f"  {', '.join(names)}: {which}\n" for which, names in plan.scenarios.items())
        stream.write(f"compare: warning: {DIFFERENT}\n{groups}")
    return run_job(job, folder, workers=workers, stream=stream, clock=clock)


def _text(plan: Plan, task: Task, tick: Tick) -> str:
    return text_of(run_rows(plan, *task, tick))


def run_rows(plan: Plan, algorithm: str, run: int, tick: Tick = lambda share: None) -> list[Row]:
    """Run one search of an algorithm, and return a row for each scenario that it requested.

    Raises:
        RequestError: if the ADS fails for the same reason at its first decision in the whole first generation.
    """
    made = plan.run(algorithm, run)
    try:
        return [{**row, "algorithm": algorithm, "run": run} for row in made.rows(tick)]
    except SetupFaultError as fault:
        raise _set_up(fault, made.world, Policy(made.ads)) from None


def _set_up(fault: SetupFaultError, world: WorldLike, policy: Policy) -> RequestError:
    """Return the error for an ADS that does not drive at all, which says nothing about algorithms."""
    traceback = "" if fault.verdict.failure is None else fault.verdict.failure.traceback
    place = traceback.rfind("  File ")
    where = f"\n{traceback[place:].rstrip()}" if place >= 0 else ""
    asked = fault.first_decision(
        world,
        policy,
        of_si="A policy of a highway-env environment needs that environment, such as --world highway-v0.",
        of_env="Without --config the environment has its default configuration; a planner in SI units needs "
        f"{PLANNER} after its name, or the road without --world.",
    )
    return RequestError(
        f"--ads: expected a policy that drives, received {fault.received}{where}\n\n"
        f"This happened in {fault.runs}, at the first decision: it is an error of the set-up, which says nothing about "
        "the algorithms. Correct the ADS, its factory, or the world that it drives in (--world and the options after "
        f"it), and run the command again.{asked}"
    )
