"""Who runs scenarios: this process, others that are started from it, or a process for a single run.

The :class:`Runner` of a search receives the next scenarios in advance and returns one run after the other. Whether
another process makes them depends on the duration of a run. It affects only the time of the search, not its results.
"""

from __future__ import annotations

import io
import logging
import pickle
import sys
import tempfile
import threading
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass, field, fields, replace
from functools import partial
from logging.handlers import QueueHandler
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Self, TypeAlias, cast

from pytest_pafot.execution.crash_records import CrashRecord, left_by
from pytest_pafot.execution.pool import FAREWELL, GRACE, IGNORED, START_METHOD, ProcessLostError, WorkerPool
from pytest_pafot.findings.finding import Expect
from pytest_pafot.findings.verdict import PROCESS_CRASH
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Outcome, Trace
from pytest_pafot.oracle.run import Run
from pytest_pafot.support import isolates, monotonic
from pytest_pafot.support.errors import flag
from pytest_pafot.support.text import plural
from pytest_pafot.world.base_world import BaseWorld
from pytest_pafot.world.driving.policy import Policy, ending_after
from pytest_pafot.world.engines.simulation import CLOSING, Simulators
from pytest_pafot.world.guard.chance import GENERATORS
from pytest_pafot.world.guard.own_worlds import base_world, rollout_of
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


def forks() -> bool:
    """Return whether processes are forked, so that they have all that this one has."""
    return METHOD == "fork"


NOT_TRIED_HERE = (
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

Cluster: TypeAlias = Callable[[Any], Any]
"""A function that makes pools of the workers on other machines, like a :data:`ScenarioPool`, for a :class:`Job`."""


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
    if not forks():
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
        answer.add_note(NOT_TRIED_HERE)
        raise answer
    return made


def expectation(lost: LostRun) -> Expect:
    """Return the expectation that a saved scenario stores if the process that ran it died or hung.

    The ADS is assumed to be the cause.
    """
    outcome = Outcome.HANG if lost.is_hang else Outcome.ADS_ERROR
    message = f"the process that ran this scenario {lost.end}"
    return Expect(failure=PROCESS_CRASH, outcome=outcome, time=0.0, message=message)


def runner_for(
    job: Job,
    record: CrashRecord,
    *,
    workers: int = 1,
    isolate: bool = False,
    cluster: Cluster | None = None,
    clock: Callable[[], float] = monotonic,
) -> Runner:
    """Return the runner of a job.

    Args:
        job: everything that a run needs.
        record: the open crash record of this process; the caller clears it after each verdict, and closes it.
        workers: the largest number of other processes; with 1, all runs are made in this process, unless ``isolate`` is
            set.
        isolate: True if the ADS must never run in this process.
        cluster: workers that make the announced runs, and with ``isolate`` all runs; None for those of this machine.
        clock: a monotonic clock [s].

    Raises:
        WorldError: if the world cannot be used.
    """
    kind = Isolated if isolate else Runner
    return kind(job, record, workers=workers, cluster=cluster, clock=clock)


DEAR = 0.010
"""The mean duration of a run from which on a search is faster with other processes [s].

A run in a different process takes half a millisecond longer, and starting a process takes as long as several runs.
"""

WARM_RUNS = 2
"""The number of runs, after the first run of a search, that decide whether other processes are used.

The first run is slower, because it loads libraries. If it was slow, processes are started after it. If the next runs
turn out to be fast, the processes are ended.
"""


class Runner:
    """A runner, which returns runs that other processes made in advance, and makes all other runs in this process.

    Other processes are started if runs turn out to be slow. With one worker, no process is ever started. If there is a
    cluster, its workers make all announced runs.

    The end of a ``with`` statement ends the processes that the runner has started, at once after an exception, and
    drops the announced scenarios. The runner can still be used after that, also in a second ``with`` statement.
    """

    def __init__(
        self, job: Job, record: CrashRecord, *, workers: int, cluster: Cluster | None, clock: Callable[[], float]
    ) -> None:
        self.job = job
        self.decisions = 0
        """The number of decisions of the ADS for which :meth:`run` has asked."""
        self.announced: dict[Scenario | Whole, None] = {}
        """The announced runs that were not requested yet, in order."""
        self.recovered: list[LostRun] = []
        """The deaths of processes of earlier pools, and in chunks, in scenarios that ran to their end later."""
        self._record = record
        self._workers = workers
        self._cluster = cluster
        self._clock = clock
        self._held = ExitStack()
        self._pool: ScenarioPool | None = None
        self._failure = ""
        self._is_measured = self._drives = False
        self._runs = self._runs_before = 0  # all runs, and the runs before processes were started
        self._warm_seconds = 0.0

    def __enter__(self) -> Self:
        self._held.enter_context(GENERATORS.held(may_share=not self.is_elsewhere))  # clients have threads
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        self._held.close()
        self.announce(())
        if self._pool is not None:
            self._pool.close(at_once=kind is not None)

    def run(self, scenario: Scenario, *, announced: bool = False, most: int | None = None) -> Trace:
        """Return the trace of a run of a scenario; its crash record stays on disk, as for :meth:`made`.

        Args:
            scenario: the scenario to run.
            announced: True if the :class:`Whole` run may have been announced, so that another process may have made it.
            most: the number of decisions after which the run is of no interest, and ends with an error of the ADS. A
                run in a different process has more decisions.

        Raises:
            ProcessLostError: if the run was in a different process, which died or hung.
            ExecutionError: if the run must be in a different process, and none can be started.
            Exception: any exception of the world or the factory.
        """
        __tracebackhide__ = True
        trace: Trace = self._made(Whole(scenario), scenario, announced=announced, most=most)
        self.decisions += min(len(trace.actions), most or sys.maxsize)  # the same for any number of processes
        return trace

    def made(self, scenario: Scenario) -> Any:
        """Return what the process has sent that made an announced run of a scenario, or the trace of its run.

        The crash record of a trace's scenario stays on disk, because the judgement of the run may end the process, too.

        Raises:
            Exception: as for :meth:`run`.
        """
        __tracebackhide__ = True
        return self._made(scenario, scenario, announced=True)

    def _made(self, task: Scenario | Whole, scenario: Scenario, *, announced: bool, most: int | None = None) -> Any:
        __tracebackhide__ = True
        made = self._collect(task, announced=announced)
        if made is not None and not isinstance(made, Trace):
            return made
        self._record.write(scenario, reference=self.job.reference)
        if made is None:
            factory = self.job.policy.factory
            started = self._clock()
            made = rollout_of(self.job.world)(scenario, factory if most is None else ending_after(factory, most))
            if self._is_measured:
                self._is_measured = False
                self._learn(self._clock() - started)
        return made

    @property
    def is_elsewhere(self) -> bool:
        """True if workers on other machines make the announced runs."""
        return self._cluster is not None

    @property
    def notes(self) -> list[str]:
        """Notes on the use of processes if the user requested them; complete after the processes have ended."""
        if self._failure:
            return [f"{flag('workers')} is 1: {self._failure}"]
        if self.is_elsewhere and self._pool is not None:
            return list(getattr(self._pool, "notes"))  # noqa: B009
        option = flag("workers", self._workers)
        if self._runs_before:
            used = f"{option}: in use after {plural(self._runs_before, 'run')} of this process{self.job.remark}"
            if self._pool is not None and self._pool.failure:
                used = f"{flag('workers')}: this process ran the scenarios; no other one could: {self._pool.failure}"
            return [used, *self._retried]
        if self._workers == 1 or self._runs <= WARM_RUNS:
            return []
        mean, dear = 1000 * self._warm_seconds / (self._runs - 1), 1000 * DEAR
        return [f"{option}: not in use, since a run took {mean:.1f} ms, and it pays off from {dear:g} ms on"]

    @property
    def in_use(self) -> int:
        """The number of processes in use; 0 if none are, or if they are on other machines."""
        return 0 if self.is_elsewhere or self._pool is None or self._pool.failure else self._workers

    @property
    def run_seconds(self) -> float:
        """The mean time of the runs so far, without the first one, which loads libraries [s]; 0 if there is none."""
        return self._warm_seconds / (self._runs - 1) if self._runs > 1 else 0.0

    def announce(self, tasks: Iterable[Scenario | Whole], *, more: bool = False) -> None:
        """Announce the next runs in the order in which they will be requested.

        Other processes start to make them if they are in use. Earlier ones that were not requested are dropped,
        unless these are ``more`` of them.
        """
        if not more:
            self.announced = {}
        if self._pool is None:
            if self.is_elsewhere or self._workers > 1:
                self.announced.update(dict.fromkeys(tasks))
        elif more:
            self._pool.add_all(self._noted(tasks))
        else:
            self._pool.expect(self._noted(tasks))

    def drive(self, task: Chunk) -> bool:
        """Let a process drive a chunk by itself; return False if none can."""
        if self._pool is None and not self._failure:
            self._start()
        if not isinstance(self._pool, WorkerPool) or self._pool.failure:
            return False
        self._pool.follow(task)
        self._drives = True
        return True

    def hear(self, *, waits: bool) -> tuple[Chunk, Any] | None:
        """Return what one of the processes says next that drive chunks, as :meth:`WorkerPool.hear` does."""
        return self._pool.hear(waits=waits) if isinstance(self._pool, WorkerPool) else None

    def end(self) -> None:
        """End the pool, so that processes with another task can be started."""
        if self._pool is not None:
            self.recovered += self._pool.recovered
            self._pool.close()
            self._pool = None

    @property
    def _retried(self) -> list[str]:
        """Notes on processes that died in runs that later succeeded."""
        return [lost.recovery for lost in (*self.recovered, *([] if self._pool is None else self._pool.recovered))]

    def _noted(self, tasks: Iterable[Scenario | Whole]) -> Iterator[Scenario | Whole]:
        for task in tasks:
            self.announced[task] = None
            yield task

    def _collect(self, task: Scenario | Whole, *, announced: bool) -> Any:
        """Return what became of an announced run; None if it must be made in this process.

        Each run can be collected once. Without ``announced`` the result is always None.
        """
        __tracebackhide__ = True
        if not announced or task not in self.announced:
            return None
        if self.is_elsewhere and self._pool is None:
            self._begin()
        del self.announced[task]
        self._is_measured = self._pool is None
        if self._pool is None:
            return None
        answer = self._pool.fetch(task)
        if isinstance(answer, tuple) and not self.is_elsewhere:
            self._learn(answer[2])
        return made_from(answer)

    def count(self, runs: int, seconds: float) -> None:
        """Count runs and the time that they took [s]."""
        self._warm_seconds += seconds if self._runs else 0.0
        self._runs += runs

    def _learn(self, seconds: float) -> None:
        self.count(1, seconds)
        is_dear = self._warm_seconds >= DEAR * (self._runs - 1) if self._runs > WARM_RUNS else seconds >= DEAR
        if self._pool is not None and self._runs == WARM_RUNS + 1 and not is_dear and not self._drives:
            self._pool.close(at_once=True)
            self._pool, self._runs_before = None, 0
        elif self._pool is None and is_dear and self._workers > 1 and not self._failure:
            self._start()

    def _start(self) -> None:
        self._runs_before = self._runs_before or self._runs
        try:
            self._begin()
        except ExecutionError as error:
            self._failure = str(error)

    def _begin(self) -> ScenarioPool:
        cluster = self._cluster
        pool: ScenarioPool = pool_for(self.job, self._workers) if cluster is None else cluster(self.job)
        self._pool = pool
        pool.expect(self.announced)
        return pool


class Isolated(Runner):
    """A runner that makes all runs in other processes, so that the ADS is never called in this one."""

    @property
    def notes(self) -> list[str]:
        """Notes on processes that died in runs that later succeeded, and on a cluster that made all runs."""
        return super().notes if self.is_elsewhere else self._retried

    def _collect(self, task: Scenario | Whole, *, announced: bool) -> Any:
        """Return what a different process sends of a run, and raise the exceptions of that process.

        No run is repeated in this process. So if a worker on another machine raises, for example because it
        lacks a package, the result is an ``ExecutionError``.
        """
        __tracebackhide__ = True
        answer = self._fetched(task)
        if isinstance(answer, tuple):
            self.count(1, answer[2])
        return made_apart(answer)

    def in_gym(self, scenario: Scenario) -> Trace:
        """Return the run of a scenario with ``env.step`` of highway-env's own environment, from a different process.

        It is one of the processes that make the other runs, so that no more policies drive at once than there are
        workers.
        """
        __tracebackhide__ = True
        return cast("Trace", made_apart(self._fetched(Whole(scenario, "rollout_in_gym"))))

    def _fetched(self, task: Any) -> Answer:
        __tracebackhide__ = True
        pool = self._begun()
        answer = pool.fetch(task)
        if pool.failure:
            raise ExecutionError(f"{flag('isolate')}: expected processes to run the ADS in, received: {pool.failure}")
        if self.is_elsewhere and isinstance(answer, Exception) and not isinstance(answer, ProcessLostError):
            raise ExecutionError(
                f"{flag('isolate')}: expected workers that can make every run, received from one of them "
                f"{type(answer).__name__}: {answer}; install what the run needs on the workers, or search without "
                f"{flag('isolate')}, so that this process makes such runs"
            )
        return answer

    def _begun(self) -> ScenarioPool:
        try:
            return self._pool or self._begin()
        except ExecutionError as error:
            raise ExecutionError(f"{flag('isolate')}: {error}") from None


# Runs in a separate process, for scenarios in which the run or its evaluation may end this process.


Drive = Callable[[Scenario, Callable[..., Any]], Any]
"""A function that drives a scenario with the policies of a factory."""


@dataclass(frozen=True, slots=True)
class _OtherRuns(BaseWorld):
    """A stand-in for a world, with a different ``rollout``, which guards the ADS. It can do nothing else."""

    world: BaseWorld
    drive: Drive

    @property
    def hang_limit(self) -> float:
        """The limit of the world [s]."""
        return self.world.hang_limit

    @property
    def speed_limit(self) -> float:
        """The limit of the world [m/s]."""
        return self.world.speed_limit

    @property
    def longest_run(self) -> float:
        """The longest duration of a run in the world [s]."""
        return self.world.longest_run

    def to_dict(self) -> dict[str, Any]:
        """Return the world as plain data."""
        return self.world.to_dict()

    def rollout(self, scenario: Scenario, ads_factory: Callable[..., Any]) -> Any:
        """Call the function in the place of the world's ``rollout``."""
        __tracebackhide__ = True
        return self.drive(scenario, ads_factory)


def once_apart(job: Job, scenario: Scenario, drive: Drive | None = None) -> Any:
    """Return what a function makes of a scenario in a process of its own, by default the trace of its run.

    Args:
        job: everything that a run needs.
        scenario: the scenario.
        drive: is called there with the scenario and the policy's factory. Only a forked process has it.

    Raises:
        ProcessLostError: if the process died or hung, even if a second one did not.
        ExecutionError: if no other process can be started.
        Exception: any exception of the process.
    """
    __tracebackhide__ = True
    with pool_for(job if drive is None else replace(job, world=_OtherRuns(job.world, drive)), 1) as pool:
        answer = pool.fetch(scenario)
    if pool.failure:
        raise ExecutionError(f"{flag('isolate')}: expected processes to run the ADS in, received: {pool.failure}")
    return made_apart(pool.recovered[0] if pool.recovered else answer)


def judged_apart(job: Job, scenario: Scenario, judge: Callable[[Trace], object]) -> Trace:
    """Return the trace of a run that is made in a process of its own, and evaluated there as well if it is forked.

    The evaluation may end the process, too, and needs the fixtures of the test function, which only forked processes
    have. Its output and its exceptions are ignored, because the session evaluates the run again.

    Raises:
        Exception: as for :func:`once_apart`.
    """
    __tracebackhide__ = True

    def drive(scenario: Scenario, ads: Callable[..., Any]) -> Trace:
        trace: Trace = rollout_of(job.world)(scenario, ads)
        with capture_output(), suppress(BaseException):
            judge(trace)
        return trace

    return cast("Trace", once_apart(job, scenario, drive if forks() else None))


def drive_once(world: Any, scenario: Scenario, ads: Callable[..., Any]) -> Run:
    """Drive a scenario and return its run, for a test.

    If policies are isolated, a forked process drives the scenario first, and ends in place of this one. This process
    then drives it as well, because a test may read what a policy has noted, and a policy that works only in the process
    of the test must work.

    Raises:
        ProcessLostError: if the forked process died or hung.
    """
    __tracebackhide__ = True
    base = base_world(world)
    if forks() and isolates():
        with tempfile.TemporaryDirectory(prefix="pafot-") as records:
            job = Job(world=base, policy=Policy(ads), records=Path(records, "records"), owner="test")
            try:
                once_apart(job, scenario)
            except ProcessLostError:
                raise
            except Exception:  # noqa: BLE001, S110  (this process raises it)
                pass
    return base.run_of(rollout_of(base)(scenario, ads))
