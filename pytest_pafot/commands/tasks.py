"""The tasks of a command, which run in this process or in several others."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Hashable, Iterator, Sequence
from functools import partial
from typing import Any, TypeVar

from pytest_pafot.execution.pool import ProcessLostError, WorkerPool

TaskT = TypeVar("TaskT", bound=Hashable)
ResultT = TypeVar("ResultT")


def finished(work: Callable[[TaskT], ResultT], tasks: Sequence[TaskT], workers: int) -> Iterator[tuple[TaskT, ResultT]]:
    """Run tasks, and yield each with its result as soon as it is finished.

    With one worker the tasks run here. Otherwise ``work`` has to be picklable, and processes are spawned on every
    system, so that each imports the policy and no state of this process can affect a result.

    Raises:
        ChildProcessError: if a process ends in a task.
        Exception: the exception of a task.
    """
    workers = min(workers, len(tasks))
    if workers == 1:
        yield from ((task, work(task)) for task in tasks)
        return
    with (
        tempfile.TemporaryDirectory(prefix="pafot-") as scratch,
        WorkerPool[TaskT, Any](
            partial(_run, work, scratch), workers, method="spawn", patience=math.inf, grace=math.inf
        ) as pool,
    ):
        pool.expect(tasks)
        for task, answer in pool.completed():
            if pool.failure or isinstance(answer, ProcessLostError):
                ended = f"its process {answer.end}" if isinstance(answer, ProcessLostError) else pool.failure
                raise ChildProcessError(
                    f"expected a worker to finish {task!r}, received: {ended}; correct a policy that ends its "
                    "process, or if memory was short, use fewer --workers"
                )
            if isinstance(answer, Exception):
                raise answer
            yield task, answer


def _run(work: Callable[[Any], Any], scratch: str, task: Any, tell: object) -> Any:
    """Run a task in a worker, whose temporary files go with the command: a worker that is killed removes none."""
    tempfile.tempdir = scratch
    return work(task)
