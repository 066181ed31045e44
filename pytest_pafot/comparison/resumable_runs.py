"""The runs of a comparison, in one process or several, resumable at every finished run."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TextIO

from pytest_pafot.comparison.algorithm_run import Tick, run_rows
from pytest_pafot.comparison.plan import RUNS, Plan, PlanError, file_name
from pytest_pafot.comparison.rows import text_of
from pytest_pafot.execution.pool import ProcessLostError, WorkerPool
from pytest_pafot.files import write_whole

QUESTION = "comparison.json"
RESULTS = "results.csv"
TIME = ".seconds"  # ending of the file with the wall-clock time of a run, the only thing that is not reproducible

POLL_SECONDS = 0.5
TOLD_EVERY = 10.0  # how often progress is told where it cannot be rewritten in place [s]

Task = tuple[str, int]


def run_all(plan: Plan, folder: Path, *, workers: int, told: TextIO, clock: Callable[[], float]) -> Path:
    """Run what is not finished yet; the file with all rows, by algorithm and run in the order of the plan.

    What the folder has of the comparison is kept. One worker is this process itself. The progress is ``told`` with the
    time that is left, by a clock of seconds.

    Raises:
        PlanError: when the folder holds another comparison.
        ChildProcessError: when a worker is killed.
        Exception: what a run raises.
    """
    claim(plan, folder)
    left = [task for task in plan.tasks if not (folder / file_name(*task)).exists()]
    progress = ProgressLine(total=len(plan.tasks), done=len(plan.tasks) - len(left), told=told, clock=clock)
    for task in _done(plan, folder, left, progress, workers):
        progress.finished(task)
    progress.close()
    in_order = [(name, run) for name in plan.names for run in range(plan.runs)]
    parts = [(folder / file_name(*task)).read_text(encoding="utf-8") for task in in_order]
    header = parts[0].partition("\n")[0] + "\n"
    write_whole(folder / RESULTS, header + "".join(part.partition("\n")[2] for part in parts))
    return folder / RESULTS


def claim(plan: Plan, folder: Path) -> None:
    """Make the folder one of this comparison.

    Raises:
        PlanError: when it is of another one.
    """
    path = folder / QUESTION
    holds_results = any((folder / RUNS).glob("*.csv"))  # A folder in which no run was finished is free.
    if holds_results and path.exists() and path.read_text(encoding="utf-8") != plan.question:
        raise PlanError(
            f"--out: expected an empty folder or one of this comparison, received {folder}, whose {QUESTION} differs "
            "in the policy, the budget, the world, the seed or the versions; give another folder, or the same arguments"
        )
    write_whole(path, plan.question)


@dataclass(slots=True)
class ProgressLine:
    """Tells how far the runs are and how long they will take."""

    total: int
    done: int
    told: TextIO  # where to
    clock: Callable[[], float]  # seconds since any moment
    started: float = 0.0
    told_at: float = float("-inf")
    first_done: int = 0

    def __post_init__(self) -> None:
        self.started, self.first_done = self.clock(), self.done

    def tick(self, shares: float) -> None:
        """Told the sum of the shares of the runs that are going on."""
        now = self.clock()
        is_terminal = self.told.isatty()
        if now - self.told_at < (POLL_SECONDS if is_terminal else TOLD_EVERY):
            return
        self.told_at = now
        line = self.line(shares, now)
        self._tell(f"\r{line}\x1b[K" if is_terminal else f"{line}\n")

    def line(self, shares: float, now: float) -> str:
        """``compare: 12 of 30 runs, 43 %, 6 min left``."""
        share = (self.done + shares) / max(self.total, 1)
        gained = self.done - self.first_done + shares
        missing = self.total - self.done - shares
        left = "" if gained <= 0.02 else f", {_duration((now - self.started) / gained * missing)} left"
        return f"compare: {self.done} of {self.total} runs, {share:.0%}{left}".replace("%", " %")

    def finished(self, task: Task) -> None:
        """One more run."""
        self.done += 1
        if not self.told.isatty():
            spent = _duration(self.clock() - self.started)
            self._tell(f"compare: {self.done} of {self.total} runs, {task[0]} run {task[1]} done after {spent}\n")

    def close(self) -> None:
        """End the line that was rewritten."""
        if self.told.isatty():
            self._tell("\r\x1b[K")

    def _tell(self, text: str) -> None:
        print(text, end="", file=self.told, flush=True)


def _done(plan: Plan, folder: Path, tasks: Sequence[Task], progress: ProgressLine, workers: int) -> Iterator[Task]:
    """Each task when its results are written."""
    work = partial(_run_task, plan, folder)
    if workers == 1:
        for task in tasks:
            work(task, progress.tick)
            yield task
        return
    # Started anew on every system, so that nothing of this process has a part in the results.
    with WorkerPool(work, workers, method="spawn", patience=math.inf, grace=math.inf) as pool:
        pool.expect(tasks)
        for task, answer in pool.completed(progress.tick):
            if pool.failure or isinstance(answer, ProcessLostError):
                ended = f"its process {answer.how}" if isinstance(answer, ProcessLostError) else pool.failure
                raise ChildProcessError(
                    f"compare: expected a worker to finish {task!r}, received: {ended}; the system may be short of "
                    "memory: use fewer --workers, then run it again, what is finished is kept"
                )
            if isinstance(answer, Exception):
                raise answer
            yield task


def _run_task(plan: Plan, folder: Path, task: Task, tick: Tick) -> None:
    """Simulate a run, then write all its rows at once, and beside them the wall-clock time."""
    started, told = time.perf_counter(), -1.0

    def tick_sparsely(share: float) -> None:  # every hundredth, so that telling costs nothing
        nonlocal told
        if share - told >= 0.01:
            told = share
            tick(share)

    path = folder / file_name(*task)
    text = text_of(run_rows(plan, *task, tick_sparsely))
    write_whole(path.with_suffix(TIME), f"{time.perf_counter() - started:.3f}\n")
    write_whole(path, text)


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
