"""Worker processes that run one task after the other, tell how far they are, and end when their parent does."""

from __future__ import annotations

import contextlib
import multiprocessing
import pickle
import sys
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any, TypeVar

TaskT = TypeVar("TaskT")

Work = Callable[[Any, Callable[[float], None]], None]
"""Does a task and tells the share that is done; can be pickled."""

POLL_SECONDS = 0.5


class WorkerDied(RuntimeError):  # noqa: N818  (it says what happened)
    """A worker process ended without an answer, as one that the system kills."""


@dataclass(slots=True)
class _Worker:
    """One process, its end of the line, its task, and the share of it that is done."""

    process: SpawnProcess
    line: Connection
    task: Any = None
    share: float = field(default=0.0)


def side_by_side(work: Work, tasks: Iterable[TaskT], count: int, tick: Callable[[float], None]) -> Iterator[TaskT]:
    """Do all tasks in so many processes, and yield each when it is done.

    Args:
        work: of one task.
        tasks: values that can be pickled.
        count: of processes.
        tick: told the sum of the shares of the tasks that are going on, every now and then.

    Raises:
        WorkerDied: when a process is killed.
        Exception: what ``work`` raises.
    """
    left = deque(tasks)
    context = multiprocessing.get_context("spawn")
    busy = [_started(context, work) for _ in range(min(count, len(left)))]
    everyone = list(busy)
    try:
        for worker in busy:
            _give(worker, left.popleft())
        while busy:
            for line in wait([worker.line for worker in busy], timeout=POLL_SECONDS):
                worker = next(each for each in busy if each.line is line)
                if _heard(worker):
                    yield worker.task
                    if left:
                        _give(worker, left.popleft())
                    else:
                        busy.remove(worker)
            tick(sum(worker.share for worker in busy))
    finally:
        for worker in everyone:
            worker.line.close()  # Which ends it, wherever it is.
            worker.process.terminate()
            worker.process.join()


def _started(context: SpawnContext, work: Work) -> _Worker:
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(theirs, work, list(sys.path)), daemon=True)
    process.start()
    theirs.close()
    return _Worker(process=process, line=ours)


def _give(worker: _Worker, task: Any) -> None:
    worker.task, worker.share = task, 0.0
    with contextlib.suppress(OSError):  # A worker that is gone is heard of when it should answer.
        worker.line.send(task)


def _heard(worker: _Worker) -> bool:
    """Whether what a worker said is that its task is done."""
    try:
        said = worker.line.recv()
    except (EOFError, OSError):
        worker.process.join()
        raise WorkerDied(
            f"compare: expected a worker to finish {worker.task!r}, received its end with exit code "
            f"{worker.process.exitcode}; the system may be short of memory: use fewer --workers, then run it again, "
            "what is finished is kept"
        ) from None
    if isinstance(said, BaseException):
        raise said
    if said is None:
        return True
    worker.share = float(said)
    return False


def _serve(line: Connection, work: Work, path: list[str]) -> None:
    """In the worker: until the parent hangs up, which it also does when it is killed."""
    sys.path[:] = path
    try:
        while True:
            task = line.recv()
            try:
                work(task, line.send)
            except OSError:
                raise
            except Exception as error:  # noqa: BLE001  (raised again in the parent)
                told = _portable(error)
                told.add_note(f"In a worker:\n{traceback.format_exc()}")  # Its own traceback does not travel.
                line.send(told)
            else:
                line.send(None)
    except (EOFError, OSError, KeyboardInterrupt):
        return


def _portable(error: Exception) -> Exception:
    """The error, or, where it cannot be sent to another process, one that says the same."""
    try:
        pickle.loads(pickle.dumps(error))  # noqa: S301  (what this very process has made)
    except Exception:  # noqa: BLE001  (whatever somebody's error does when it is pickled)
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error
