"""The runs of a comparison, resumable at every finished run."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TextIO

from pytest_pafot.comparison.algorithm_run import Tick, run_rows
from pytest_pafot.comparison.plan import Plan, caution
from pytest_pafot.comparison.resumable import ResumableJob, Task, run_job
from pytest_pafot.comparison.rows import text_of

QUESTION = "comparison.json"


def run_all(plan: Plan, folder: Path, *, workers: int, told: TextIO, clock: Callable[[], float]) -> Path:
    """Run what is not finished yet; the file with all rows, by algorithm and run in the order of the plan.

    The arguments, and what is raised, are those of :func:`run_job`.
    """
    job = ResumableJob(
        command="compare",
        noun="comparison",
        units="runs",
        tasks=plan.tasks,
        in_order=tuple((name, run) for name in plan.names for run in range(plan.runs)),
        question=plan.question,
        question_file=QUESTION,
        differs="the policy, its weights, the budget, the world, the seed or the versions",
        text=partial(_text, plan),
        caution=caution([plan.ads]),
    )
    return run_job(job, folder, workers=workers, told=told, clock=clock)


def _text(plan: Plan, task: Task, tick: Tick) -> str:
    return text_of(run_rows(plan, *task, tick))
