"""Processes that run the scenarios of a job, and the handling of their answers in the process of the session."""

from __future__ import annotations

import io
import logging
import pickle
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass, field, fields
from functools import partial
from logging.handlers import QueueHandler
from pathlib import Path
from queue import SimpleQueue
from typing import Any, TypeAlias

from pytest_pafot.execution.crash_records import CrashRecord, left_by
from pytest_pafot.execution.pool import FAREWELL, GRACE, IGNORED, START_METHOD, ProcessLostError, WorkerPool
from pytest_pafot.findings.finding import Expect
from pytest_pafot.findings.signature import PROCESS_CRASH
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Outcome, Trace
from pytest_pafot.support import monotonic
from pytest_pafot.world.base_world import BaseWorld
from pytest_pafot.world.driving.policy import Policy
from pytest_pafot.world.engines.simulation import CLOSING, Simulators
from pytest_pafot.world.guard.chance import GENERATORS
from pytest_pafot.world.guard.own_worlds import rollout_of
from pytest_pafot.world.simulator_world import SimulatorWorld

# The output of code in a different process: printed text, log records and warnings. The process of the test repeats it,
# because pytest captures only the output of that process.


@dataclass(slots=True, kw_only=True)
class CapturedOutput:
    """The captured output: printed text, log records, warnings and what ended threads, each in their order.

    A warning that passes the filters is stored as text, category, file and line, without the objects that it refers to.
    """

    out: str = ""
    err: str = ""
    records: list[logging.LogRecord] = field(default_factory=list)
    warned: list[tuple[str, type[Warning], str, int]] = field(default_factory=list)
    threads: list[tuple[str, str]] = field(default_factory=list)  # those that an exception ended, with the traceback

    def __bool__(self) -> bool:
        return bool(self.out or self.err or self.records or self.warned or self.threads)

    def followed_by(self, other: CapturedOutput) -> CapturedOutput:
        """Return this output and a later one as one."""
        names = [each.name for each in fields(self)]
        return CapturedOutput(**{name: getattr(self, name) + getattr(other, name) for name in names})

    def repeat(self) -> None:
        """Print the texts, handle the log records, issue the warnings and tell of the threads in this process."""
        for stream, text in ((sys.stdout, self.out), (sys.stderr, self.err)):
            if text:
                stream.write(text)
        for record in self.records:
            logging.getLogger().callHandlers(record)
        with warnings.catch_warnings():
            warnings.simplefilter("always")  # They passed the filters of the process in which they were raised.
            for each in self.warned:
                warnings.warn_explicit(*each)
        for name, text in self.threads:  # The hook of the session is pytest's, which warns, or fails the test.
            error = RuntimeError(f"in another process:\n{text}")
            threading.excepthook(threading.ExceptHookArgs((type(error), error, None, threading.Thread(name=name))))


@contextmanager
def capture_output() -> Iterator[CapturedOutput]:
    """Capture the output of the code in the ``with`` block; it is complete when the block ends."""
    captured, out, err = CapturedOutput(), _Stream(), _Stream()
    root, queue = logging.getLogger(), SimpleQueue[logging.LogRecord]()
    handlers, root.handlers = root.handlers, [QueueHandler(queue)]

    def note(ended: threading.ExceptHookArgs) -> None:
        text = "".join(traceback.format_exception(ended.exc_type, ended.exc_value, ended.exc_traceback))
        captured.threads.append((ended.thread.name if ended.thread else "", text))

    hook, threading.excepthook = threading.excepthook, note
    try:
        with redirect_stdout(out), redirect_stderr(err), warnings.catch_warnings(record=True) as warned:
            yield captured
    finally:
        root.handlers = handlers
        threading.excepthook = hook
    captured.out, captured.err = out.text, err.text
    captured.records = [queue.get() for _ in range(queue.qsize())]
    captured.warned = [(str(each.message), each.category, each.filename, each.lineno) for each in warned]


class _Stream(io.TextIOWrapper):
    """A text stream in memory that accepts bytes as well, like a standard stream."""

    def __init__(self) -> None:
        self._bytes = io.BytesIO()
        super().__init__(self._bytes, encoding="utf-8", errors="replace", newline="", write_through=True)

    def close(self) -> None:
        """Stay open, so that code that closes a standard stream does not lose its earlier output."""

    @property
    def text(self) -> str:
        return self._bytes.getvalue().decode("utf-8", "replace")


# The processes.

METHOD = START_METHOD
"""The start method of the processes that run scenarios."""

NOT_REPEATED = (
    "This was raised in the process in which the ADS has to run, and is not tried again in the session. If it works in "
    "the session, the ADS or its factory uses something that a different process cannot have, such as CUDA, a thread "
    "or a connection: open that in the factory, not before."
)

LostRun: TypeAlias = ProcessLostError[Scenario]


Timed: TypeAlias = tuple[Any, CapturedOutput, float]
"""What a process sends: the trace of a run, what it has made of the trace, or what it has counted of a chunk; with the
captured output of the runs that this is about, and their duration in wall-clock time [s]."""


@dataclass(frozen=True, slots=True)
class Chunk:
    """A task of a process that draws and drives consecutive scenarios of a random search by itself.

    Attributes:
        first, end: the first number, and the one after the last.
        known: the failures of which no run must be sent.
        fatal: scenarios that must not be run.
    """

    first: int
    end: int
    known: frozenset[Any] = field(compare=False)
    fatal: frozenset[Scenario] = field(compare=False)

    def __repr__(self) -> str:
        return f"scenarios {self.first} to {self.end - 1} of the search"


@dataclass(frozen=True, slots=True)
class Whole:
    """A task of a process that runs a scenario by a method of the world, and sends the trace in any case."""

    scenario: Scenario
    method: str = "rollout"

    def __str__(self) -> str:
        return str(self.scenario)


Answer: TypeAlias = Timed | Exception
"""The answer to a scenario: a run, or an exception. This process may repeat the run after any exception, except after a
:class:`~pytest_pafot.execution.pool.ProcessLostError`."""

ScenarioPool: TypeAlias = WorkerPool[Any, Any]
"""Its tasks are scenarios, also :class:`Whole`, with an :data:`Answer`, or a :class:`Chunk`, of which it says
several :data:`Timed`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """Everything that a run of any scenario needs, in this process or in a different one.

    ``records`` is the folder of crash records. ``owner``, the node id of the test, and ``world_data``, the world as
    plain data, are written into them.
    """

    world: BaseWorld
    policy: Policy
    records: Path
    owner: str
    world_data: Mapping[str, Any] | None = None
    root: Path = Path()
    """The folder of the project, whose modules are sent with the ADS to other machines."""
    read: Callable[[Trace], Any] | None = None
    """A function that returns what a process sends of a run instead of its trace; None if it sends the trace."""
    drive: Callable[[Chunk, Job, CrashRecord, Callable[[Timed], object]], None] | None = None
    """A function that drives a chunk in a process, with this job and its crash record; None if there is none."""
    remark: str = ""
    """What the note on the use of processes says in addition."""
    reference: str = ""
    """The name of the ADS if it is the reference of a search; empty for the tested one."""

    @property
    def patience(self) -> float:
        """The longest time for which a process may not answer while it makes a run [s]."""
        return self.world.hang_limit + GRACE

    @property
    def closing(self) -> dict[str, Any]:
        """The arguments of a pool whose processes close their simulators when they end; none in other worlds."""
        if not isinstance(self.world, SimulatorWorld):
            return {}
        return {"leave": _close_simulators, "left": CapturedOutput.repeat, "farewell": FAREWELL + CLOSING}

    @staticmethod
    def run(
        made: Callable[[], Job], scenario: Scenario, method: str = "rollout"
    ) -> tuple[Trace, CapturedOutput, float]:
        """Run a scenario of the job that a function returns, by a method of its world.

        Return the trace, the output of that function and of the run, and the duration of the run [s].
        """
        with capture_output() as output:
            job = made()
            started = monotonic()
            trace = rollout_of(job.world, method)(scenario, job.policy.factory)
            seconds = monotonic() - started
        return trace, output, seconds

    def crash_record(self, *, is_watched: bool = False) -> CrashRecord:
        """Return a crash record for the process that writes it; its file is created only for the first scenario."""
        return CrashRecord(self.records, self.owner, world=self.world_data, is_watched=is_watched)


class ExecutionError(Exception):
    """Error for a run that must be made in a different process if no such process can be started or used."""


def pool_for(job: Job, size: int) -> ScenarioPool:
    """Return a pool of up to ``size`` processes that run the scenarios of a job.

    Raises:
        ExecutionError: if processes cannot be forked, and world and ADS cannot be pickled.
    """
    work = partial(_run_task, job, job.crash_record(is_watched=True))
    if METHOD != "fork":
        try:
            pickle.dumps(work)
        except Exception as error:  # noqa: BLE001  (pickling the user's objects may raise anything)
            raise ExecutionError(
                "expected an ADS factory that can be pickled, such as a class in a module that can be imported, since "
                f"processes cannot be forked here, received one that raises {type(error).__name__}: {error}"
            ) from None
    grace = min(IGNORED, GRACE)
    return WorkerPool(
        work,
        size,
        method=METHOD,
        patience=job.patience,
        grace=grace,
        ended=partial(_forget, job),
        **job.closing,
    )


def _close_simulators() -> CapturedOutput:
    with capture_output() as output:
        Simulators.close_all()
    return output


def _run_task(
    job: Job, record: CrashRecord, task: Scenario | Whole | Chunk, say: Callable[[Timed], object]
) -> Timed | None:
    """Run a scenario or a chunk in a process of the pool; the crash record of each scenario is on disk during its run.

    The record is closed after each task, since nothing would remove it after the session.
    """
    with record, GENERATORS.held():
        if isinstance(task, Whole):
            return run_recorded(job, record, task.scenario, None, task.method)
        if not isinstance(task, Chunk):
            return run_recorded(job, record, task, job.read)
        assert job.drive is not None  # noqa: S101  (only then there are such tasks)
        job.drive(task, job, record, say)
        return None


def run_recorded(
    job: Job, record: CrashRecord, scenario: Scenario, read: Callable[[Trace], Any] | None, method: str = "rollout"
) -> Timed:
    """Run a scenario by a method of the world, with its crash record on disk; the trace is read as by ``Job.read``."""
    record.write(scenario, reference=job.reference)
    trace, output, seconds = Job.run(lambda: job, scenario, method)
    if read is None:
        return trace, output, seconds
    made = None
    with capture_output() as said, suppress(Exception):  # it is raised again in the session, which reads the trace
        made = read(trace)
    return (trace, output, seconds) if made is None else (made, output.followed_by(said), seconds)


def _forget(job: Job, pid: int) -> None:
    """Remove the crash record of a process that has ended, because this session knows about its end already."""
    for leftover in left_by(job.owner, job.records):
        if leftover.pid == pid:
            leftover.discard()


def made_from(answer: Answer) -> Any:
    """Return what an answer says of its run and repeat its output here; None if the scenario must be run here.

    Raises:
        ProcessLostError: if the process died or hung.
    """
    __tracebackhide__ = True
    if isinstance(answer, ProcessLostError):
        answer.task = getattr(answer.task, "scenario", answer.task)  # of a Whole one
        raise answer
    if isinstance(answer, Exception):
        return None
    answer[1].repeat()
    return answer[0]


def made_apart(answer: Answer) -> Any:
    """Return what an answer says of its run; raise if nothing, because the ADS must not run in this process.

    Raises:
        Exception: the exception of the other process.
    """
    __tracebackhide__ = True
    made = made_from(answer)
    if made is None and isinstance(answer, Exception):
        answer.add_note(NOT_REPEATED)
        raise answer
    return made


def expectation(lost: LostRun) -> Expect:
    """Return the expectation that a saved scenario stores if the process that ran it died or hung.

    The ADS is assumed to be the cause.
    """
    outcome = Outcome.HANG if lost.is_hang else Outcome.ADS_ERROR
    message = f"the process that ran this scenario {lost.end}"
    return Expect(failure=PROCESS_CRASH, outcome=outcome, time=0.0, message=message)
