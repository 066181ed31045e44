"""The execution of a command's tasks, in this process or in worker processes."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Hashable, Iterator, Sequence
from functools import partial
from typing import Any, TypeVar, assert_never

from pytest_pafot.execution.pool import Done, Lost, RunItHere, WorkerPool

TaskT = TypeVar("TaskT", bound=Hashable)
ResultT = TypeVar("ResultT")


def run_tasks(
    work: Callable[[TaskT], ResultT], tasks: Sequence[TaskT], workers: int
) -> Iterator[tuple[TaskT, ResultT]]:
    """Run tasks, and yield each task with its result as soon as it is finished.

    Raises:
        ChildProcessError: if a process ends during a task.
        Exception: if a task raises an exception.
    """
    # With one worker, the tasks run here. Otherwise, processes are spawned on every system, so that each imports the
    # policy and no state of this process can affect a result. `work` must then be picklable.
    workers = min(workers, len(tasks))
    if workers == 1:
        yield from ((task, work(task)) for task in tasks)
        return
    with (
        tempfile.TemporaryDirectory(prefix="pafot-") as scratch,
        WorkerPool[TaskT](
            partial(_run, work, scratch), workers, method="spawn", patience=math.inf, grace=math.inf
        ) as pool,
    ):
        pool.expect(tasks)
        for task, answer in pool.completed():
            match answer:
                case Done(result) if not pool.failure:
                    yield task, result
                case RunItHere(error) if not pool.failure:
                    raise error
                case Lost(death) if not pool.failure:
                    raise _unfinished(task, f"its process {death.end}")
                case Done() | Lost() | RunItHere():
                    raise _unfinished(task, pool.failure)
                case other:
                    assert_never(other)


def _unfinished(task: object, why: str) -> ChildProcessError:
    return ChildProcessError(
        f"expected a worker to finish the task {task!r}, but {why}. Did the policy end its process? If it ran out of "
        "memory, use fewer processes with --workers"
    )


def _run(work: Callable[[Any], Any], scratch: str, task: Any, tell: object) -> Any:
    # deleted at the end of the command, because a killed worker deletes no files
    tempfile.tempdir = scratch
    return work(task)
