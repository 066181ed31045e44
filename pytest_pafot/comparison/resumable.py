"""The runs of a comparison, in one or several processes. After a stop, finished runs are not repeated."""

from __future__ import annotations

import hashlib
import json
import math
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path, PurePath
from typing import Any, TextIO

from pytest_pafot.commands.policy_reference import CAUTION
from pytest_pafot.execution.pool import ProcessLostError, WorkerPool
from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.files import write_whole, written_into
from pytest_pafot.support.text import differences, visible

RUNS = "runs"
"""The name of the folder with a file of results for each task."""
RESULTS = "results.csv"
QUESTION = "comparison.json"
"""The name of the file with the question and the identities of a job."""
TIME = ".seconds"
"""The suffix of a task's second file, with its wall-clock time and a digest of its results.

The time is in a separate file because it is not reproducible. The digest shows whether results were changed later.
"""

OF_NAMES = "names"
"""The key for the identities of names in the file with the question of a job."""

AGAIN = "then run the same command again: finished tasks are not repeated"
"""The advice to the user if something could not be written after tasks were finished."""

POLL_SECONDS = 0.5
TOLD_EVERY = 10.0  # the interval between reports of progress if a line cannot be overwritten [s]

Task = tuple[str, int]
Tick = Callable[[float], None]  # receives the finished share of a task


@dataclass(frozen=True, slots=True, kw_only=True)
class ResumableJob:
    """The work of ``compare``, divided into tasks: the runs of its algorithms.

    Attributes:
        tasks: the tasks in the order in which they are started.
        in_order: the tasks in the order of their rows in the result.
        question: everything on which the results of all tasks depend, as plain data; only results with equal data are
            combined.
        identities: what else the results of tasks with a name depend on, such as the code of an algorithm, by name. A
            later job may have other names.
        text: a function that returns the rows of a task as CSV; it must be picklable.
    """

    tasks: tuple[Task, ...]
    in_order: tuple[Task, ...]
    question: Mapping[str, Any]
    text: Callable[[Task, Tick], str]
    identities: Mapping[str, Any] = field(default_factory=dict)


def file_name(name: str, run: int) -> str:
    """Return the name of the file with the results of one task."""
    return str(PurePath(RUNS) / f"{name}-{run:03}.csv")


def run_job(job: ResumableJob, folder: Path, *, workers: int, stream: TextIO, clock: Callable[[], float]) -> Path:
    """Run the tasks that are not finished; return the path of the file with the rows of all tasks.

    Results in the folder are reused, unless they were changed. With one worker, the tasks run in this process.

    Args:
        job: the tasks.
        folder: the folder for the results.
        workers: the number of processes.
        stream: the stream for the progress and the remaining time.
        clock: returns the seconds since some fixed moment.

    Raises:
        RequestError: if the folder holds the results of a different job, or cannot be written.
        ChildProcessError: if a worker is killed.
        Exception: any exception of a task.
    """
    claim(job, folder)
    left = [task for task in job.tasks if seconds_of(folder / file_name(*task)) is None]
    for task in left:
        if (folder / file_name(*task)).exists():
            stream.write(f"compare: {folder / file_name(*task)} was changed or damaged, so its task runs again\n")
    total = len(job.tasks)
    done = total - len(left)
    if done:
        stream.write(f"compare: {done} of {total} runs are reused from before; {CAUTION}\n")
    progress = ProgressLine(total=total, done=done, stream=stream, clock=clock)
    for task in _done(job, folder, left, progress, workers):
        progress.finished(task)
    progress.close()
    parts = [(folder / file_name(*task)).read_text(encoding="utf-8") for task in job.in_order]
    header = parts[0].partition("\n")[0] + "\n"
    with written_into(folder, AGAIN):
        write_whole(folder / RESULTS, header + "".join(part.partition("\n")[2] for part in parts))
    return folder / RESULTS


def claim(job: ResumableJob, folder: Path) -> None:
    """Reserve a folder for a job, by writing a file into it that states what the job's results depend on.

    Raises:
        RequestError: if the folder holds the results of a different job, or cannot be written.
    """
    path = folder / QUESTION
    now: dict[str, Any] = json.loads(json.dumps({**job.question, OF_NAMES: job.identities}))  # tuples become lists
    with written_into(folder):
        # Only names with a finished task count. A folder in which no task was finished is free.
        done = {each.stem.rpartition("-")[0] for each in (folder / RUNS).glob("*.csv")}
        if done:
            then = _question_in(path)
            if isinstance(then, str):
                differ = then
            else:
                others = {name: each for name, each in then[OF_NAMES].items() if name in done}
                # A name that this job lacks stays in the file, so that a later job with it is compared, too.
                now[OF_NAMES] = {**others, **now[OF_NAMES]}
                compared = {**then, OF_NAMES: others | {n: e for n, e in now[OF_NAMES].items() if n not in done}}
                differ = visible("; ".join(differences("", compared, now)))  # a folder may come from somebody else
            if differ:
                raise RequestError(
                    f"--out: expected an empty folder or the folder of this comparison, received {folder}, whose "
                    f"{QUESTION} does not agree: {differ}; give another folder, or what it was made with"
                )
        write_whole(path, json.dumps(now, indent=1, sort_keys=True) + "\n")


def _question_in(path: Path) -> dict[str, Any] | str:
    """Return the data of a folder's job, or why there is none."""
    try:
        data = json.loads(path.read_bytes())
    except FileNotFoundError:
        return "it is gone"
    except (ValueError, RecursionError):
        return "it cannot be read"
    return data if isinstance(data, dict) and isinstance(data.get(OF_NAMES), dict) else "it cannot be read"


@dataclass(slots=True)
class ProgressLine:
    """The report of how far ``compare`` is and how long it will still take."""

    total: int  # number of runs
    done: int  # number of finished runs
    stream: TextIO  # the stream for the report
    clock: Callable[[], float]  # returns the seconds since some fixed moment
    started: float = field(init=False)
    told_at: float = field(default=-math.inf, init=False)
    first_done: int = field(init=False)

    def __post_init__(self) -> None:
        self.started, self.first_done = self.clock(), self.done

    def tick(self, shares: float) -> None:
        """Report progress, unless the last report is recent; ``shares`` is the sum of the running tasks' shares."""
        now = self.clock()
        is_terminal = self.stream.isatty()
        if now - self.told_at < (POLL_SECONDS if is_terminal else TOLD_EVERY):
            return
        if not is_terminal and self.done + shares >= self.total:
            return  # the last line follows at once
        self.told_at = now
        line = self.line(shares, now)
        self._tell(f"\r{line}\x1b[K" if is_terminal else f"{line}\n")

    def line(self, shares: float, now: float) -> str:
        """Return a line such as ``compare: 12 of 30 runs, 43 %, 6 min left``."""
        gained = self.done - self.first_done + shares
        share = (self.done + shares) / max(self.total, 1)
        missing = self.total - self.done - shares
        left = "" if gained <= 0.02 else f", {_duration((now - self.started) / gained * missing)} left"
        return f"compare: {self.done} of {self.total} runs, {share:.0%}{left}".replace("%", " %")

    def finished(self, task: Task) -> None:
        """Count a finished task and report it."""
        self.done += 1
        if not self.stream.isatty():
            spent = _duration(self.clock() - self.started)
            self._tell(f"compare: {self.done} of {self.total} runs, {task[0]} run {task[1]} done after {spent}\n")

    def close(self) -> None:
        """Erase the line of progress on a terminal."""
        if self.stream.isatty():
            self._tell("\r\x1b[K")

    def _tell(self, text: str) -> None:
        print(text, end="", file=self.stream, flush=True)


def _done(
    job: ResumableJob, folder: Path, tasks: Sequence[Task], progress: ProgressLine, workers: int
) -> Iterator[Task]:
    """Run the tasks, and yield each task as soon as its results are written."""
    work = partial(_run_task, job, folder)
    if workers == 1:
        for task in tasks:
            work(task, progress.tick)
            yield task
        return
    with ExitStack() as stack:
        scratch = stack.enter_context(tempfile.TemporaryDirectory(prefix="pafot-"))
        # Spawned on every system, not forked, so that no state of this process can affect the results.
        pool = WorkerPool[Task, None](
            partial(_run_in, scratch, work), workers, method="spawn", patience=math.inf, grace=math.inf
        )
        stack.enter_context(pool)
        pool.expect(tasks)
        for task, answer in pool.completed(progress.tick):
            if pool.failure or isinstance(answer, ProcessLostError):
                ended = f"its process {answer.end}" if isinstance(answer, ProcessLostError) else pool.failure
                raise ChildProcessError(
                    f"expected a worker to finish {task!r}, received: {ended}; correct a policy that ends its "
                    "process, or if memory was short, use fewer --workers; finished tasks are not repeated"
                )
            if isinstance(answer, Exception):
                raise answer
            yield task


def _run_in(scratch: str, work: Callable[[Task, Tick], None], task: Task, tick: Tick) -> None:
    """Run a task in a worker, whose temporary files go with the command: a worker that is killed removes none."""
    before, tempfile.tempdir = tempfile.tempdir, scratch
    try:
        work(task, tick)
    finally:
        tempfile.tempdir = before


def _run_task(job: ResumableJob, folder: Path, task: Task, tick: Tick) -> None:
    """Run a task; then write the file of its rows, and next to it the file of its wall-clock time."""
    started, stream = time.perf_counter(), -1.0

    def tick_sparsely(share: float) -> None:  # only each hundredth, because a report costs time
        nonlocal stream
        if share - stream >= 0.01:
            stream = share
            tick(share)

    path = folder / file_name(*task)
    text = job.text(task, tick_sparsely)
    with written_into(folder, AGAIN):
        seconds = f"{time.perf_counter() - started:.3f}"
        write_whole(path.with_suffix(TIME), f"{seconds} {_digest(seconds, text.encode())}\n")
        write_whole(path, text)


def seconds_of(results: Path) -> float | None:
    """Return how long the task with a file of results took [s]; None if the file is missing or was changed."""
    try:
        seconds, digest = results.with_suffix(TIME).read_text(encoding="utf-8").split()
        return float(seconds) if digest == _digest(seconds, results.read_bytes()) else None
    except (OSError, ValueError):  # also if a folder has this name, or the content is not text
        return None


def _digest(seconds: str, rows: bytes) -> str:
    return hashlib.sha256(seconds.encode() + rows).hexdigest()


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
