"""Processes that run scenarios of a job, and what becomes of their answers in this one."""

from __future__ import annotations

import pickle
import sys

from pytest_pafot.execution.job import Job
from pytest_pafot.execution.worker_pool import GRACE, Crew, Errand, Lost, ProcessLostError, trace_from

__all__ = ["ExecutionError", "Lost", "ProcessLostError", "ScenarioPool", "pool_for", "recovery_note", "trace_from"]

METHOD = "fork" if sys.platform == "linux" else "spawn"
"""Forked processes have the factory and the fixtures that it uses. Elsewhere the systems' own libraries do not survive
it, and the factory must be one that can be pickled."""

ScenarioPool = Crew


class ExecutionError(Exception):
    """A run must be made in another process, and none can be had; the message says why, and the way out."""


def pool_for(job: Job, size: int) -> ScenarioPool:
    """A pool of up to so many processes, which start when they are needed.

    Raises:
        ExecutionError: where processes cannot be given what they need.
    """
    errand = Errand(world=job.world, ads=job.ads, folder=job.records, owner=job.owner, plain_world=job.world_data)
    if METHOD != "fork":
        try:
            pickle.dumps(errand)
        except Exception as error:  # noqa: BLE001  (whatever the objects of the user raise when they are pickled)
            raise ExecutionError(
                "where processes cannot be forked, the ADS factory must be one that can be pickled, such as a class of "
                f"a module that can be imported, received one that raises {type(error).__name__}: {error}"
            ) from None
    limit = float(getattr(job.world, "hang_limit", 30.0))
    return Crew(errand, size, method=METHOD, patience=limit + GRACE, grace=GRACE)


def recovery_note(lost: Lost) -> str:
    """What to tell of a process that died in a run that came to its end when it was tried again."""
    return (
        f"a process (pid {lost.pid}) {lost.how} while it ran {lost.scenario!r}, which ran to its end when it was tried "
        "alone: there may be too little memory for so many workers, or the process was killed from outside"
    )
