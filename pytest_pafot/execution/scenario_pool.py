"""Processes that run the scenarios of a job, and what becomes of their answers in this one."""

from __future__ import annotations

import os
import pickle
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

from pytest_pafot.execution.captured_output import CapturedOutput, capture_output
from pytest_pafot.execution.crash_records import CrashRecord, left_by
from pytest_pafot.execution.pool import GRACE, IGNORED, ProcessLostError, WorkerPool
from pytest_pafot.findings.finding import Expect
from pytest_pafot.findings.signature import PROCESS_CRASH
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Outcome, Trace
from pytest_pafot.world import protocol

METHOD = "fork" if sys.platform == "linux" else "spawn"
"""Forked processes have the factory and the fixtures that it uses. Elsewhere the systems' own libraries do not survive
it, and the factory must be one that can be pickled."""

NOT_REPEATED = (
    "This was raised in the process in which alone the ADS may run, and is not repeated in the session. Where it works "
    "in the session, the ADS or its factory uses what another process cannot have, such as CUDA, a thread or a "
    "connection: open that in the factory, and not before it."
)

LEAST_MEMORY = 2 << 30
"""What each process may take at least unless an option says otherwise: libraries set aside some before they need it."""

LostRun: TypeAlias = ProcessLostError[Scenario]
Timed: TypeAlias = tuple[Trace, CapturedOutput, float]
"""A run, what was said in it, and how long it took [s]."""
Answer: TypeAlias = Timed | Exception
"""For any exception but a lost process, this process can show what happens."""
ScenarioPool: TypeAlias = WorkerPool[Scenario, Timed]


def _read_nothing(trace: Trace) -> None:
    """Of runs in which nobody searches."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """Everything that a run of any scenario needs, in this process or in another one.

    The folder ``records``, the ``owner``, a node id, and ``world_data``, the world as plain data, are for the crash
    records.
    """

    world: Any
    ads: Callable[..., Any]
    """The factory, called once for each run."""
    records: Path
    owner: str
    world_data: Mapping[str, Any] | None = None
    root: Path = Path()
    """Folder of the project, whose modules travel with the ADS where it runs on other machines."""
    read: Callable[[Trace], None] = _read_nothing
    """What another process reads from a run that it has made; the trace keeps it."""
    memory: int | None = None
    """How many MB a process may take beyond what it begins with; 0 for any number, None for its share of all."""
    reference: str = ""
    """What to call the ADS where it is the reference of a search; empty for the one that is tested."""

    def crash_record(self) -> CrashRecord:
        """The record of what the calling process runs; nothing is on disk before its first scenario."""
        return CrashRecord(self.records, self.owner, world=self.world_data)


class ExecutionError(Exception):
    """A run must be made in another process, and none can be had; the message says why, and the way out."""


def pool_for(job: Job, size: int) -> ScenarioPool:
    """A pool of up to so many processes; an ``ExecutionError`` where they cannot be given what they need."""
    work = partial(_run_recorded, job, job.crash_record())
    check_can_be_given(work)
    patience, grace = protocol.hang_limit(job.world) + GRACE, min(IGNORED, GRACE)
    return WorkerPool(
        work,
        size,
        method=METHOD,
        patience=patience,
        grace=grace,
        memory=_memory(job, size),
        ended=partial(_forget, job),
    )


def check_can_be_given(work: Callable[..., Any]) -> None:
    """Check that processes can be given their work.

    Raises:
        ExecutionError: where they cannot be forked, and the work cannot be pickled.
    """
    if METHOD == "fork":
        return
    try:
        pickle.dumps(work)
    except Exception as error:  # noqa: BLE001  (whatever the objects of the user raise when they are pickled)
        raise ExecutionError(
            "where processes cannot be forked, the ADS factory must be one that can be pickled, such as a class of "
            f"a module that can be imported, received one that raises {type(error).__name__}: {error}"
        ) from None


def _memory(job: Job, size: int) -> int | None:
    """How many bytes more than it begins with each of so many processes may take."""
    if job.memory is not None:
        return job.memory << 20 or None
    if METHOD != "fork":
        return None
    limits = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    with suppress(OSError, ValueError):  # "max" where the container has all of the machine's
        limits.append(int(Path("/sys/fs/cgroup/memory.max").read_text("ascii")))
    return max(min(limits) * 3 // 4 // size, LEAST_MEMORY)


def _run_recorded(job: Job, record: CrashRecord, scenario: Scenario, tell: object) -> Timed:
    """The work of each process: a run, with the scenario on disk meanwhile."""
    with record, capture_output() as output:  # closed each time: nobody could if the session died meanwhile
        record.write(scenario, reference=job.reference)
        trace, seconds = timed(job.world, scenario, job.ads)
    with suppress(Exception):  # which is raised where somebody asks for it
        job.read(trace)
    return trace, output, seconds


def timed(world: Any, scenario: Scenario, ads: Callable[..., Any]) -> tuple[Trace, float]:
    """A run, and how long it took [s]."""
    started = time.perf_counter()
    trace = world.rollout(scenario, ads)
    return trace, time.perf_counter() - started


def _forget(job: Job, pid: int) -> None:
    """Remove the record of a process that has ended: this session is told otherwise."""
    for leftover in left_by(job.owner, job.records):
        if leftover.pid == pid:
            leftover.discard()


def trace_from(answer: Answer) -> Trace | None:
    """The trace of an answer, once what was said in the run is said again here; None where it must run here.

    Raises:
        ProcessLostError: where the process that made it did not come back.
    """
    __tracebackhide__ = True
    if isinstance(answer, ProcessLostError):
        raise answer
    if isinstance(answer, Exception):
        return None
    trace, output, _ = answer
    output.repeat()
    return trace


def trace_apart(answer: Answer) -> Trace:
    """The trace of an answer from where alone the ADS may run: what was raised there is raised here as well.

    Raises:
        Exception: why there is no trace. To run the scenario here would show the same error, or end this process.
    """
    __tracebackhide__ = True
    trace = trace_from(answer)
    if trace is not None:
        return trace
    if isinstance(answer, Exception):
        answer.add_note(NOT_REPEATED)
        raise answer
    raise TypeError(f"answer: expected a trace or an exception, received {answer!r:.100}")


def expectation(lost: LostRun) -> Expect:
    """What running a scenario again is expected to show. Nobody saw it; the ADS is the code that a process dies in."""
    outcome = Outcome.HANG if lost.is_hang else Outcome.ADS_ERROR
    message = f"the process that ran this scenario {lost.how}"
    return Expect(failure=PROCESS_CRASH, outcome=outcome, time=0.0, message=message)


def recovery_note(lost: LostRun) -> str:
    """What to tell of a process that died in a run that came to its end when it was tried again."""
    return (
        f"a {lost.who} {lost.how} while it ran {lost.task!r}, which ran to its end when it was tried "
        "alone: there may be too little memory for so many workers, or the process was killed from outside"
    )
