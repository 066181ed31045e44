"""Tasks of a command that takes long, in one process or several, resumable at every finished task."""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path, PurePath
from typing import TextIO

from pytest_pafot.campaign.options import cores
from pytest_pafot.commands.policy_reference import PlanError
from pytest_pafot.execution.pool import ProcessLostError, WorkerPool
from pytest_pafot.support.files import way_out, write_whole

RUNS = "runs"
"""Folder of the results of single tasks."""
RESULTS = "results.csv"
TIME = ".seconds"
"""Ending of the file with the wall-clock time of a task, the only thing that is not reproducible, and a digest of its
rows, by which a file is known that was damaged or changed since."""

AGAIN = "then give the same command again: what is finished is kept"
"""The way out where something could not be written after work was done."""

POLL_SECONDS = 0.5
TOLD_EVERY = 10.0  # how often progress is told where it cannot be rewritten in place [s]

Task = tuple[str, int]
Tick = Callable[[float], None]  # is told the share of a task that is done


@dataclass(frozen=True, slots=True, kw_only=True)
class ResumableJob:
    """What a command has to do.

    Attributes:
        command: its name.
        noun: what its results are, such as ``comparison``.
        units: what its progress counts, such as ``runs``.
        tasks: in the order in which they are started.
        in_order: the same in the order of their rows.
        question: on what results depend, as canonical text; results of equal questions go together.
        question_file: where that stands.
        differs: in what another question may differ, in words.
        text: the rows of a task as CSV; must be possible to pickle.
        sizes: units of each task that is not one; then progress counts units of tasks that are going on, too.
        caution: what to mind where results from before are kept; empty for nothing.
    """

    command: str
    noun: str
    units: str
    tasks: tuple[Task, ...]
    in_order: tuple[Task, ...]
    question: str
    question_file: str
    differs: str
    text: Callable[[Task, Tick], str]
    sizes: dict[Task, int] = field(default_factory=dict)
    caution: str = ""

    def size(self, task: Task) -> int:
        """How many units a task is."""
        return self.sizes.get(task, 1)

    @property
    def total(self) -> int:
        """How many units all tasks are."""
        return sum(map(self.size, self.tasks))


def file_name(name: str, run: int) -> str:
    """Of the results of one task."""
    return str(PurePath(RUNS) / f"{name}-{run:03}.csv")


def run_job(job: ResumableJob, folder: Path, *, workers: int, told: TextIO, clock: Callable[[], float]) -> Path:
    """Run what is not finished yet; the file with all rows.

    What the folder has of the job is kept, unless it was changed since. One worker is this process itself. The progress
    is ``told`` with the time that is left, by a clock of seconds.

    Raises:
        PlanError: when the folder holds the results of another question, or cannot be written.
        ChildProcessError: when a worker is killed.
        Exception: what a task raises.
    """
    claim(job, folder)
    left = [task for task in job.tasks if seconds_of(folder / file_name(*task)) is None]
    for task in left:
        if (folder / file_name(*task)).exists():
            told.write(f"{job.command}: {folder / file_name(*task)} is not as it was written, and is made again\n")
    done = job.total - sum(map(job.size, left))
    if done and job.caution:
        told.write(f"{job.command}: {done} of {job.total} {job.units} are from before; {job.caution}\n")
    progress = ProgressLine(job=job, done=done, told=told, clock=clock)
    for task in _done(job, folder, left, progress, workers):
        progress.finished(task)
    progress.close()
    parts = [(folder / file_name(*task)).read_text(encoding="utf-8") for task in job.in_order]
    header = parts[0].partition("\n")[0] + "\n"
    with written_into(folder, AGAIN):
        write_whole(folder / RESULTS, header + "".join(part.partition("\n")[2] for part in parts))
    return folder / RESULTS


def worker_count(given: int | None) -> int:
    """How many processes ``--workers`` asks for: one for each core where it is not given.

    Raises:
        PlanError: for less than one.
    """
    if given is not None and given < 1:
        raise PlanError(f"--workers: expected at least 1, received {given}")
    return given or cores()


def claim(job: ResumableJob, folder: Path) -> None:
    """Make the folder one of this job.

    Raises:
        PlanError: when it is of another one, or cannot be written.
    """
    path = folder / job.question_file
    with written_into(folder):
        holds_results = any((folder / RUNS).glob("*.csv"))  # A folder in which no task was finished is free.
        is_there = path.exists()
        if holds_results and not (is_there and path.read_bytes() == job.question.encode()):
            why = f"differs in {job.differs}" if is_there else "is gone"
            raise PlanError(
                f"--out: expected an empty folder or one of this {job.noun}, received {folder}, whose "
                f"{job.question_file} {why}; give another folder, or the same arguments"
            )
        write_whole(path, job.question)


@contextmanager
def written_into(folder: Path, elsewhere: str = "or give another folder") -> Iterator[None]:
    """Call a folder that cannot be written a wrong ``--out``, with the rest of the way out.

    Raises:
        PlanError: in place of an OSError.
    """
    try:
        yield
    except OSError as error:
        # What is in the way is named; of a file that was being written the name says nothing.
        what = error.filename2 or (error.filename if isinstance(error, FileExistsError) else folder)
        raise PlanError(
            f"--out: expected a folder that can be written, received {what}: {error.strerror or error}; "
            f"{way_out(error, elsewhere)}"
        ) from None


@dataclass(slots=True)
class ProgressLine:
    """Tells how far a command is and how long it will take."""

    job: ResumableJob
    done: int  # units
    told: TextIO  # where to
    clock: Callable[[], float]  # seconds since any moment
    started: float = field(init=False)
    told_at: float = field(default=-math.inf, init=False)
    first_done: int = field(init=False)

    def __post_init__(self) -> None:
        self.started, self.first_done = self.clock(), self.done

    def tick(self, shares: float) -> None:
        """Told the sum of the shares of the tasks that are going on."""
        now = self.clock()
        is_terminal = self.told.isatty()
        if now - self.told_at < (POLL_SECONDS if is_terminal else TOLD_EVERY):
            return
        if not is_terminal and self.done + shares >= self.job.total:
            return  # the line of the end follows at once
        self.told_at = now
        line = self.line(shares, now)
        self._tell(f"\r{line}\x1b[K" if is_terminal else f"{line}\n")

    def line(self, shares: float, now: float) -> str:
        """``compare: 12 of 30 runs, 43 %, 6 min left``."""
        job, gained = self.job, self.done - self.first_done + shares
        share = (self.done + shares) / max(job.total, 1)
        missing = job.total - self.done - shares
        left = "" if gained <= 0.02 else f", {_duration((now - self.started) / gained * missing)} left"
        done = self.done + (math.floor(shares + 1e-6) if job.sizes else 0)
        return f"{job.command}: {done} of {job.total} {job.units}, {share:.0%}{left}".replace("%", " %")

    def finished(self, task: Task) -> None:
        """One more task; those of many units show in :meth:`tick`, which also knows what the others have done."""
        job = self.job
        self.done += job.size(task)
        if self.told.isatty():
            return
        which = "100 %," if job.sizes else f"{task[0]} {job.units.removesuffix('s')} {task[1]} done"
        if not job.sizes or self.done == job.total:
            spent = _duration(self.clock() - self.started)
            self._tell(f"{job.command}: {self.done} of {job.total} {job.units}, {which} after {spent}\n")

    def close(self) -> None:
        """End the line that was rewritten."""
        if self.told.isatty():
            self._tell("\r\x1b[K")

    def _tell(self, text: str) -> None:
        print(text, end="", file=self.told, flush=True)


def _done(
    job: ResumableJob, folder: Path, tasks: Sequence[Task], progress: ProgressLine, workers: int
) -> Iterator[Task]:
    """Each task when its results are written."""
    work = partial(_run_task, job, folder)
    if workers == 1:
        for task in tasks:
            work(task, progress.tick)
            yield task
        return
    # Started anew on every system, so that nothing of this process has a part in the results.
    with WorkerPool[Task, None](work, workers, method="spawn", patience=math.inf, grace=math.inf) as pool:
        pool.expect(tasks)
        for task, answer in pool.completed(progress.tick):
            if pool.failure or isinstance(answer, ProcessLostError):
                ended = f"its process {answer.how}" if isinstance(answer, ProcessLostError) else pool.failure
                raise ChildProcessError(
                    f"{job.command}: expected a worker to finish {task!r}, received: {ended}; the system may be short "
                    "of memory: use fewer --workers, then run it again, what is finished is kept"
                )
            if isinstance(answer, Exception):
                raise answer
            yield task


def _run_task(job: ResumableJob, folder: Path, task: Task, tick: Tick) -> None:
    """Do a task, then write all its rows at once, and beside them the wall-clock time."""
    started, told = time.perf_counter(), -1.0

    def tick_sparsely(share: float) -> None:  # every hundredth, so that telling costs nothing
        nonlocal told
        if share - told >= 0.01:
            told = share
            tick(share * job.size(task))

    path = folder / file_name(*task)
    text = job.text(task, tick_sparsely)
    with written_into(folder, AGAIN):
        seconds = f"{time.perf_counter() - started:.3f}"
        write_whole(path.with_suffix(TIME), f"{seconds} {_digest(seconds, text.encode())}\n")
        write_whole(path, text)


def seconds_of(results: Path) -> float | None:
    """Return how long a task took whose rows are there as they were written [s], and None where they are not."""
    try:
        seconds, digest = results.with_suffix(TIME).read_text(encoding="utf-8").split()
        return float(seconds) if digest == _digest(seconds, results.read_bytes()) else None
    except (OSError, ValueError):  # a folder in its place, or text that is none
        return None


def _digest(seconds: str, rows: bytes) -> str:
    return hashlib.sha256(seconds.encode() + rows).hexdigest()


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
