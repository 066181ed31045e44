"""The runs of a comparison: each run is a search of one algorithm, without pytest, whose scenarios become rows."""

from __future__ import annotations

import hashlib
import math
import tempfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TextIO

from pytest_pafot import Run, WorldLike
from pytest_pafot.campaign import run_table
from pytest_pafot.campaign.run_table import Row, RunTable
from pytest_pafot.extending import (
    Evaluated,
    Failure,
    SetupFaultError,
    ads_factory,
    caution,
    of_failure,
    prepared,
    replays_of,
    request_of,
    require,
)
from pytest_pafot.extras.comparison.plan import DIFFERENT, Plan
from pytest_pafot.extras.resumable import ResumableJob, Task, Tick, claim, run_job
from pytest_pafot.findings.finding import ads_failure, event_of
from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.text import csv_text

COLUMNS: Mapping[str, str] = {
    "algorithm": "name of the algorithm",
    "run": "number of the algorithm's run, from 0",
    **{name: meaning for name, meaning in run_table.COLUMNS.items() if name not in ("test", "run")},
    "index": "index in the generation, from 0",
    "clock": "simulated time of the search until the end of the run [s]; reused results take no time",
    "cell": "cell of the NPC that was hit; empty if it crossed the ego's way",
    "zone": "zone in which that NPC crossed, such as `crossing from the left`; otherwise empty",
    "position_responsibility": "who is responsible by the rule of the authors' code",
    "signature": "identity of a collision, even of one that is no failure, or of an ADS error; otherwise empty",
    "genes_started": "started genes of all NPCs",
    "genes_reached": "number of started genes whose cell, lane or zone was reached",
    "executed": "the scenario as driven, in canonical text",
}
"""The columns of the results: those of the table of runs, and those that only a comparison has."""

UNBOUNDED = 10**9  # generations of a run with a time budget

COLLISION = Failure(kind="AssertionError", assertion="not run.collision")
"""The failure of :func:`never_collides`; its signature tells different collisions apart."""


def never_collides(blame: str, run: Run) -> None:
    """Assert that there is no collision; the test function of a comparison.

    Unless the blame is ``any``, a collision for which neither vehicle is responsible is no failure.
    """
    if blame == "any" or run.responsibility is not None:
        require(not run.collision, "not run.collision", lambda: "assert not run.collision")


def text_of(rows: Iterable[Row]) -> str:
    """Format rows as CSV; equal runs give equal text."""
    return csv_text(tuple(COLUMNS), ([row.get(name) for name in COLUMNS] for row in rows))


def run_all(plan: Plan, folder: Path, *, workers: int, told: TextIO, clock: Callable[[], float]) -> Path:
    """Do the runs that are not finished yet; return the file with all rows, by algorithm and run as in the plan.

    If algorithms have different scenarios, a warning says so before hours are spent on the runs.

    The arguments and the exceptions are as for :func:`run_job`.
    """
    job = ResumableJob(
        command="compare",
        noun="comparison",
        units="runs",
        tasks=plan.tasks,
        in_order=tuple((name, run) for name in plan.names for run in range(plan.runs)),
        question=plan.question,
        question_file="comparison.json",
        identities=plan.identities,
        text=partial(_text, plan),
        caution=caution([plan.ads]),
    )
    claim(job, folder)  # report an unusable folder before anything else
    if len(plan.scenarios) > 1:
        groups = "".join(f"  {', '.join(names)}: {which}\n" for which, names in plan.scenarios.items())
        told.write(f"compare: warning: {DIFFERENT}\n{groups}")
    return run_job(job, folder, workers=workers, told=told, clock=clock)


def _text(plan: Plan, task: Task, tick: Tick) -> str:
    return text_of(run_rows(plan, *task, tick))


def run_rows(plan: Plan, algorithm: str, run: int, tick: Tick = lambda share: None) -> list[Row]:
    """Run one search of an algorithm, and return a row for each scenario that it requested.

    It evaluates scenarios as :func:`~pytest_pafot.campaign.explore.explore` does, but it ends after a simulated time if
    the plan has one, and it neither runs findings again nor simplifies them.

    Raises:
        RequestError: if the ADS fails for the same reason at its first decision in the whole first generation.
    """
    (world, space), chosen = plan.setting(algorithm), plan.entrant(algorithm).algorithm
    seed = plan.run_seed(algorithm, run)
    generations, budget = plan.generations or UNBOUNDED, math.inf if plan.seconds is None else plan.seconds
    given = {"ads": ads_factory(plan.ads), "world": world, "algorithm": chosen.made_by}
    request = request_of({**given, "fitness": plan.fitness, "blame": plan.blame})
    # A finding above the largest number of saved ones is only counted.
    request = replace(request, settings=replace(request.settings, max_saved=0))
    table, seconds = RunTable(seed=seed, more=_of_run), 0.0

    def see(event: Any) -> None:
        nonlocal seconds
        table.see(event)
        if isinstance(event, Evaluated):
            evaluation = event.evaluation
            seconds += 0.0 if event.reused else evaluation.duration
            tick(max(event.generation / generations, seconds / budget))
            table.rows[-1] |= {
                "algorithm": algorithm,
                "run": run,
                "index": event.index,
                "clock": seconds,
                "genes_started": evaluation.genes_started,
                "genes_reached": evaluation.genes_reached,
                "executed": evaluation.executed.canonical(),
            }

    with tempfile.TemporaryDirectory(prefix="pafot-") as scratch:
        harness = replays_of(request, partial(never_collides, plan.blame), "compare", Path(scratch)).harness
        # Blame affects all fitnesses except AV-Fuzzer's, which its authors used without it.
        with prepared(harness, space=space, is_steered=request.fitness != "av-fuzzer") as parts:
            made, is_over = plan.made(algorithm), lambda: seconds >= budget
            try:
                for event in parts.search(made, generations=generations, seed=seed, stop=is_over):
                    see(event)
            except SetupFaultError as fault:
                raise _set_up(fault, world, request.ads) from None
    tick(1.0)
    return table.taken()


def _of_run(run: Run) -> Row:
    """Return the values of a run for columns that the table of runs lacks."""
    hit, signature = run.collision, None
    failure = ads_failure(run) or (None if hit is None else COLLISION)
    if failure is not None:
        found = of_failure(run, failure)
        # It begins with readable words, and two texts are equal only if the signatures are equal.
        signature = f"{found.mistake or found.slug}-{hashlib.sha256(repr(found).encode()).hexdigest()[:6]}"
    return {
        "cell": None if hit is None or hit.cell is None else int(hit.cell),
        "zone": None if hit is None else event_of(run, failure).zone,
        "position_responsibility": None if hit is None else run.second_opinion or "none",
        "signature": signature,
    }


def _set_up(fault: SetupFaultError, world: WorldLike, ads: Any) -> RequestError:
    """Return the error for an ADS that does not drive at all, which says nothing about algorithms."""
    traceback = "" if fault.verdict.failure is None else fault.verdict.failure.traceback
    place = traceback.rfind("  File ")
    where = f"\n{traceback[place:].rstrip()}" if place >= 0 else ""
    asked = fault.asked(
        world,
        ads,
        of_si="A policy of a highway-env environment needs that environment, such as --env highway-v0.",
        of_env="With --env the environment has its default configuration, because config= cannot be given; a planner "
        "in SI units needs the road without --env.",
    )
    return RequestError(
        f"--ads: expected a policy that drives, received {fault.received}{where}\n\n"
        f"This happened in {fault.runs}, at the first decision: it is an error of the set-up, which says nothing about "
        "the algorithms. Correct the ADS, its factory, or the world that it drives in (--env and the options after "
        f"it), and run the command again.{asked}"
    )
