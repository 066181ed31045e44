"""The runners of scenarios: :class:`Here` uses this process, :class:`Apart` uses others.

The choice affects how long a search takes, but not its results.
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
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass, field, fields, replace
from functools import partial
from itertools import filterfalse, islice
from logging.handlers import QueueHandler
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Protocol, Self, TypeAlias, assert_never

from pytest_pafot.execution.crash_records import CrashRecord, left_by
from pytest_pafot.execution.pool import (
    FAREWELL,
    GRACE,
    IGNORED,
    START_METHOD,
    Answer,
    Done,
    Lost,
    ProcessLostError,
    RunItHere,
    Said,
    WorkerPool,
)
from pytest_pafot.findings.finding import Expect
from pytest_pafot.findings.verdict import PROCESS_CRASH
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Outcome, Trace
from pytest_pafot.oracle.run import Run
from pytest_pafot.support import isolates, monotonic
from pytest_pafot.support.errors import flag
from pytest_pafot.support.text import plural
from pytest_pafot.world.base_world import BaseWorld
from pytest_pafot.world.codec import checked_world
from pytest_pafot.world.driving.policy import Policy, end_after
from pytest_pafot.world.engines.simulation import CLOSING, Simulators
from pytest_pafot.world.guard.chance import GENERATORS
from pytest_pafot.world.simulator_world import SimulatorWorld

# The output of code in another process consists of printed text, log records and warnings. The process of the test
# repeats it, because pytest captures only the output of that process.


@dataclass(slots=True, kw_only=True)
class CapturedOutput:
    """The captured output of code, which another process can repeat."""

    out: str = ""
    err: str = ""
    records: list[logging.LogRecord] = field(default_factory=list)
    warned: list[tuple[str, type[Warning], str, int]] = field(default_factory=list)
    # names and tracebacks of threads that raised
    threads: list[tuple[str, str]] = field(default_factory=list)

    def __bool__(self) -> bool:
        return bool(self.out or self.err or self.records or self.warned or self.threads)

    def followed_by(self, other: CapturedOutput) -> CapturedOutput:
        names = [each.name for each in fields(self)]
        return CapturedOutput(
            **{name: getattr(self, name) + getattr(other, name) for name in names}
        )

    def repeat(self) -> None:
        for stream, text in ((sys.stdout, self.out), (sys.stderr, self.err)):
            if text:
                stream.write(text)
        for record in self.records:
            logging.getLogger().callHandlers(record)
        with warnings.catch_warnings():
            # They passed the filters of the process in which they were raised.
            warnings.simplefilter("always")
            for each in self.warned:
                warnings.warn_explicit(*each)
        # The hook of the session is pytest's, which warns, or fails the test.
        for name, text in self.threads:
            error = RuntimeError(f"in another process:\n{text}")
            threading.excepthook(
                threading.ExceptHookArgs((type(error), error, None, threading.Thread(name=name)))
            )


@contextmanager
def capture_output() -> Iterator[CapturedOutput]:
    """Capture the output of the ``with`` block. The output is complete when the block ends."""
    captured, out, err = CapturedOutput(), _Stream(), _Stream()
    root, queue = logging.getLogger(), SimpleQueue[logging.LogRecord]()
    # The handlers are replaced, because pytest's would otherwise report each record here and when it is repeated.
    handlers, root.handlers = root.handlers, [QueueHandler(queue)]

    def note(ended: threading.ExceptHookArgs) -> None:
        text = "".join(
            traceback.format_exception(ended.exc_type, ended.exc_value, ended.exc_traceback)
        )
        captured.threads.append((ended.thread.name if ended.thread else "", text))

    # An error in a thread never reaches the caller of this block, so only the hook can keep it.
    hook, threading.excepthook = threading.excepthook, note
    try:
        with (
            redirect_stdout(out),
            redirect_stderr(err),
            warnings.catch_warnings(record=True) as warned,
        ):
            yield captured
    finally:
        root.handlers = handlers
        threading.excepthook = hook
    captured.out, captured.err = out.text, err.text
    captured.records = [queue.get() for _ in range(queue.qsize())]
    captured.warned = [
        (str(each.message), each.category, each.filename, each.lineno) for each in warned
    ]


class _Stream(io.TextIOWrapper):
    def __init__(self) -> None:
        self._bytes = io.BytesIO()
        super().__init__(
            self._bytes, encoding="utf-8", errors="replace", newline="", write_through=True
        )

    def close(self) -> None:
        """Ignore the call, because the captured code can close its standard streams."""

    @property
    def text(self) -> str:
        return self._bytes.getvalue().decode("utf-8", "replace")


# The processes.

METHOD = START_METHOD


def forks() -> bool:
    """Return whether processes are forked, so that they have all objects of this process."""
    return METHOD == "fork"


NOT_TRIED_HERE = (
    "The ADS must run in a separate process, which raised this error, so the session does not run it again. Does the "
    "ADS use something that another process cannot share, such as CUDA, a thread or a connection? Open it inside the "
    "factory, not before."
)

LostRun: TypeAlias = ProcessLostError[Scenario]

Factory: TypeAlias = Callable[..., Any]  # creates a policy for a run
RunScenario: TypeAlias = Callable[[Scenario, Factory], Any]  # runs a scenario


@dataclass(frozen=True, slots=True)
class Timed:
    """The result of runs in a process, the output that they printed, and their duration [s]."""

    value: Any
    output: CapturedOutput
    seconds: float


@dataclass(frozen=True, slots=True)
class Chunk:
    """A task for a process that draws and runs consecutive scenarios of a random search."""

    first: int
    end: int
    known: frozenset[Any] = field(compare=False)
    fatal: frozenset[Scenario] = field(compare=False)

    def __repr__(self) -> str:
        return f"scenarios {self.first} to {self.end - 1} of the search"


def in_world(world: BaseWorld) -> RunScenario:
    """Return the method with which runs of a search are simulated."""
    return world.rollout


def in_gym(world: BaseWorld) -> RunScenario:
    """Return the method that simulates a run in highway-env's own environment."""
    return world.rollout_in_gym


Simulate: TypeAlias = Callable[[BaseWorld], RunScenario]  # one of the two functions above


@dataclass(frozen=True, slots=True)
class Whole:
    """A task for a process that runs a scenario and sends the complete trace."""

    scenario: Scenario
    simulate: Simulate = in_world

    def __str__(self) -> str:
        return str(self.scenario)


Task: TypeAlias = Scenario | Whole  # a process answers a Scenario with the result of `Job.read`


class ClusterPool(Protocol):
    """Workers on other machines that run the scenarios of a job. After :meth:`close`, they can be used again."""

    failure: str  # why no worker can be used any more, or empty
    recovered: list[LostRun]  # deaths of workers in runs whose second attempt succeeded

    @property
    def notes(self) -> list[str]:
        """Sentences for the summary of the session."""

    def expect(self, tasks: Iterable[Task]) -> None:
        """Forget all tasks, and announce these."""

    def add_all(self, tasks: Iterable[Task]) -> None:
        """Announce more tasks."""

    def fetch(self, task: Task) -> Answer:
        """Wait for the answer to a task, whether it was announced or not."""

    def close(self, *, at_once: bool = False) -> None:
        """Forget all tasks. ``at_once`` also ends those that run, where this is possible."""


# A pool for tasks, which get one answer each. The processes of this machine also run Chunks, and send several Timed
# results for each.
ScenarioPool: TypeAlias = WorkerPool[Any] | ClusterPool


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """A world, a policy and the settings for running scenarios with them, in any process.

    Crash records are written to the folder ``records``, together with ``owner``, the node id of the test, and
    ``world_data``, the world as JSON-compatible data.
    """

    world: BaseWorld
    policy: Policy
    records: Path
    owner: str
    world_data: Mapping[str, Any] | None = None
    root: Path = Path()  # the folder of the project, whose modules are sent to other machines
    # returns the value that a process sends instead of a trace
    read: Callable[[Trace], Any] | None = None
    # Runs a chunk in a process, and passes each Timed result, or a RunItHere, to the last argument.
    drive: (
        Callable[[Chunk, Job, CrashRecord, Callable[[Timed | RunItHere], object]], None] | None
    ) = None
    simulate: Simulate = in_world
    remark: str = ""  # an addition to the note on the use of processes
    # the name of the policy if it is the reference of a search; empty for the tested one
    reference: str = ""

    @property
    def patience(self) -> float:
        """The time [s] within which a process must answer during a run."""
        return self.world.hang_limit + GRACE

    @property
    def closing(self) -> dict[str, Any]:
        if not isinstance(self.world, SimulatorWorld):
            return {}
        return {
            "leave": _close_simulators,
            "left": CapturedOutput.repeat,
            "farewell": FAREWELL + CLOSING,
        }

    def crash_record(self, *, is_watched: bool = False) -> CrashRecord:
        return CrashRecord(self.records, self.owner, world=self.world_data, is_watched=is_watched)


Cluster: TypeAlias = Callable[[Job], ClusterPool]


def run_timed(make_job: Callable[[], Job], scenario: Scenario, simulate: Simulate) -> Timed:
    """Run a scenario of the job that ``make_job`` returns, and capture the output of both."""
    with capture_output() as output:
        job = make_job()
        started = monotonic()
        trace = GENERATORS.run(simulate(job.world), scenario, job.policy.factory)
        seconds = monotonic() - started
    return Timed(trace, output, seconds)


class ExecutionError(Exception):
    """An error for a run that needs another process, if no process can be started or used."""


def pool_for(job: Job, size: int) -> WorkerPool[Any]:
    """Return a pool of up to ``size`` processes that run the scenarios of a job.

    Raises:
        ExecutionError: if processes cannot be forked, and the world or the ADS cannot be pickled.
    """
    work = partial(_run_task, job, job.crash_record(is_watched=True))
    if not forks():
        try:
            # multiprocessing would raise the same error, but only in the first run and with no advice.
            pickle.dumps(work)
        except Exception as error:  # noqa: BLE001  (pickling the user's objects may raise anything)
            raise ExecutionError(
                "expected an ADS factory that can be pickled, because processes cannot be forked here, received the "
                f"error {type(error).__name__}: {error}. Use a class or a function from an importable module"
            ) from None
    return WorkerPool(
        work,
        size,
        method=METHOD,
        patience=job.patience,
        grace=min(IGNORED, GRACE),
        ended=partial(_forget, job),
        **job.closing,
    )


def _close_simulators() -> CapturedOutput:
    with capture_output() as output:
        Simulators.close_all()
    return output


def _run_task(
    job: Job, record: CrashRecord, task: Task | Chunk, say: Callable[[Timed | RunItHere], object]
) -> Timed:
    # The record is closed after each task, because nothing would remove it after the session.
    with record, GENERATORS.held():
        match task:
            case Whole(scenario, simulate):
                return run_recorded(job, record, scenario, simulate=simulate)
            case Chunk():
                assert job.drive is not None  # noqa: S101  (otherwise, there are no chunks)
                job.drive(task, job, record, say)
                return Timed(None, CapturedOutput(), 0.0)
            case Scenario():
                return run_recorded(job, record, task, read=job.read)
            case _:
                assert_never(task)


def run_recorded(
    job: Job,
    record: CrashRecord,
    scenario: Scenario,
    *,
    simulate: Simulate | None = None,
    read: Callable[[Trace], Any] | None = None,
) -> Timed:
    """Run a scenario while its crash record is on disk, and return the trace or what ``read`` makes of it."""
    # Only the record tells the next session in which scenario this process died, so it is on disk before the run.
    record.write(scenario, reference=job.reference)
    ran = run_timed(lambda: job, scenario, simulate or job.simulate)
    if read is None:
        return ran
    with capture_output() as said:
        try:
            value = read(ran.value)
        except Exception:  # noqa: BLE001  (it is raised again in the session, which reads the trace)
            return ran
    return Timed(value, ran.output.followed_by(said), ran.seconds)


def _forget(job: Job, pid: int) -> None:
    # This session knows how the process ended, so the next session must not report it again.
    for leftover in left_by(job.owner, job.records):
        if leftover.pid == pid:
            leftover.discard()


def expectation(lost: LostRun) -> Expect:
    """Return the expected failure for a saved scenario in which the process died or hung."""
    # The ADS is assumed to be the cause. The message must not change, because findings store it.
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
) -> Here:
    """Return the runner of a job.

    Args:
        job: the world, the policy and the settings.
        record: the open crash record of this process. The caller clears it after each verdict, and closes it.
        workers: the largest number of worker processes. 1 means that the job runs only in this process.
        isolate: True if the ADS must never run in this process.
        cluster: workers on other machines, or None.
        clock: a monotonic clock [s].
    """
    if workers == 1 and not isolate and cluster is None:
        return Here(job, record)
    return Apart(job, record, workers=workers, is_only=isolate, cluster=cluster, clock=clock)


# A run in another process takes half a millisecond longer, and starting a process takes as long as several runs.
DEAR = 0.010  # mean duration of a run from which other processes make a search faster [s]

# The first run loads libraries. If it is slow, processes are started after it. They end again if the next runs turn out
# to be fast.
WARM_RUNS = 2  # number of runs after the first one that decide whether other processes are used

# scenarios that are sent in advance to each process, and to all workers of a cluster
AHEAD, AHEAD_ELSEWHERE = 4, 128


@dataclass(frozen=True, slots=True)
class NotStarted(RunItHere):
    """The answer while no process has started. The duration of the run decides whether processes start."""


NOT_SENT = LookupError("no process has this task")


class Here:
    """A runner that simulates all scenarios in this process."""

    is_elsewhere = False  # True if `results` uses workers on other machines

    def __init__(self, job: Job, record: CrashRecord) -> None:
        self.job = job
        self.decisions = 0  # the number of decisions in runs of `once`
        self._record = record
        self._held = ExitStack()

    def __enter__(self) -> Self:
        # clients have threads
        self._held.enter_context(GENERATORS.held(may_share=not self.is_elsewhere))
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        self._held.close()

    def once(
        self, scenario: Scenario, simulate: Simulate = in_world, *, most: int | None = None
    ) -> Trace:
        """Run a scenario, and return the trace.

        Args:
            scenario: the scenario to run.
            simulate: :func:`in_world` or :func:`in_gym`.
            most: the number of decisions after which the run can end with an error.

        Raises:
            ProcessLostError: if another process ran the scenario, and died or hung.
            ExecutionError: if the run needs another process, but none can be started.
            Exception: any exception of the world or the factory.
        """
        __tracebackhide__ = True
        trace: Trace = self._run(scenario, simulate, most)
        # A run in another process can have more decisions than ``most``, so their number is limited here. It is the
        # same for any number of processes.
        self.decisions += min(len(trace.actions), most or sys.maxsize)
        return trace

    def once_by(self, scenario: Scenario, drive: RunScenario) -> Any:
        """Run a scenario by a function, and return its result. Exceptions are as for :meth:`once`."""
        __tracebackhide__ = True
        return Here._run(self, scenario, lambda world: drive)

    def results(
        self, scenarios: Iterable[Scenario], skips: Callable[[Scenario], bool]
    ) -> Iterator[Done[Any] | Lost[Any]]:
        """Yield the answer for each scenario in order: the value of ``Job.read`` or a trace, or a lost process.

        ``skips`` is called just before each scenario runs. If it returns True, the scenario is skipped.
        """
        __tracebackhide__ = True
        for scenario in filterfalse(skips, scenarios):
            yield Done(self._run(scenario))

    def expect(self, scenarios: Iterable[Scenario], *, more: bool = False) -> None:
        """Announce scenarios for :meth:`once`, which other processes can run in advance.

        Scenarios that were announced earlier but not requested are dropped, unless ``more`` is set.
        """

    @property
    def notes(self) -> list[str]:
        """Notes on the use of processes, complete after the processes have ended."""
        return []

    @property
    def in_use(self) -> int:
        return 0

    @property
    def run_seconds(self) -> float:
        """The mean duration [s] of the runs so far, excluding the first run, or 0 if it is unknown."""
        return 0.0

    def _run(
        self, scenario: Scenario, simulate: Simulate = in_world, most: int | None = None
    ) -> Any:
        __tracebackhide__ = True
        # Before the run, because the run may end this process.
        self._record.write(scenario, reference=self.job.reference)
        factory = self.job.policy.factory
        if most is not None:
            # The run ends with an error of the policy, which the caller must not take for one.
            factory = end_after(factory, most)
        return GENERATORS.run(simulate(self.job.world), scenario, factory)


class Apart(Here):
    """A runner that simulates scenarios in other processes: local workers, isolated processes, or a cluster.

    Args:
        job, record: as for :class:`Here`.
        workers: the largest number of processes.
        is_only: True if the ADS must never run in this process.
        cluster: workers on other machines, or None.
        clock: a monotonic clock [s].
    """

    def __init__(
        self,
        job: Job,
        record: CrashRecord,
        *,
        workers: int = 1,
        is_only: bool = True,
        cluster: Cluster | None = None,
        clock: Callable[[], float] = monotonic,
    ) -> None:
        super().__init__(job, record)
        self.is_elsewhere = cluster is not None
        self._workers = workers
        self._is_only = is_only
        self._cluster = cluster
        self._clock = clock
        # announced runs that were not yet requested, in order
        self._expected: dict[Task, None] = {}
        # process deaths in earlier pools, in scenarios that succeeded later
        self.recovered: list[LostRun] = []
        # Processes start only when a run turns out to be slow, see _learn.
        self._pool: ScenarioPool | None = None
        self._failure = ""
        self._drives = False  # True if processes run chunks
        # all runs, and the runs before processes were started
        self._runs = 0
        self._runs_before = 0
        self._warm_seconds = 0.0

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        super().__exit__(kind, *rest)
        self.expect(())
        if self._pool is not None:
            self._pool.close(at_once=kind is not None)

    def results(
        self, scenarios: Iterable[Scenario], skips: Callable[[Scenario], bool]
    ) -> Iterator[Done[Any] | Lost[Any]]:
        __tracebackhide__ = True
        # Scenarios are drawn one by one, because there may be millions.
        coming = iter(scenarios)
        most = AHEAD_ELSEWHERE if self.is_elsewhere else AHEAD * self._workers
        ahead = deque[Scenario]()
        while True:
            # New scenarios are sent while half of the old ones are still to be run, so that no process waits.
            if len(ahead) <= most // 2:
                more = list(islice(coming, most - len(ahead)))
                self._give(each for each in more if not skips(each))
                ahead += more
            if not ahead:
                return
            scenario = ahead.popleft()
            # The search may have learnt meanwhile that a process dies in it.
            if skips(scenario):
                # Its process may still run it, and the answer is dropped with the next tasks.
                self._expected.pop(scenario, None)
                continue
            match self._answer(scenario):
                case Done() | Lost() as answer:
                    yield answer
                case RunItHere() as why:
                    yield Done(self._run_instead(why, scenario))
                case other:
                    assert_never(other)

    def expect(self, scenarios: Iterable[Scenario], *, more: bool = False) -> None:
        if not more:
            self._expected = {}
            if self._pool is not None:
                self._pool.expect(())
        self._give(map(Whole, scenarios))

    def once_by(self, scenario: Scenario, drive: RunScenario) -> Any:
        __tracebackhide__ = True
        # Without isolation, the policy may run in this process, which has the function already.
        if not self._is_only:
            return super().once_by(scenario, drive)
        # Only a process that is forked now has the function. Its death counts even if a second process survives.
        with pool_for(replace(self.job, simulate=lambda world: drive, read=None), 1) as pool:
            answer = self._fetched(scenario, pool)
        for death in pool.recovered:
            answer = Lost(death)
        match self._checked(answer):
            case Done(value):
                return value
            case Lost(death):
                raise death

    def _run(
        self, scenario: Scenario, simulate: Simulate = in_world, most: int | None = None
    ) -> Any:
        __tracebackhide__ = True
        # The environment's own loop is slow to import in each process, and is needed only for failures.
        if simulate is not in_world and not self._is_only:
            return super()._run(scenario, simulate, most)
        match self._answer(Whole(scenario, simulate)):
            case Done(trace):
                return trace
            case Lost(death):
                raise death
            case RunItHere() as why:
                return self._run_instead(why, scenario, most)
            case other:
                assert_never(other)

    def _give(self, tasks: Iterable[Task]) -> None:
        if self._pool is None:
            if self.is_elsewhere or self._workers > 1:
                self._expected.update(dict.fromkeys(tasks))
            return
        for task in tasks:  # each task starts as soon as the search has drawn it
            self._expected[task] = None
            self._pool.add_all([task])

    def _answer(self, task: Task) -> Answer:
        # The answer of the process that ran a task. Its duration is taken into account, and its output is repeated.
        __tracebackhide__ = True
        if self._is_only:
            # It may have been announced. Fetching it below takes the announced answer.
            self._expected.pop(task, None)
            answer = self._fetched(task)
            # Only runs in the world have the duration of the runs that are still to come.
            is_usual = not isinstance(task, Whole) or task.simulate is in_world
            if isinstance(answer, Done) and is_usual:
                self.count(1, answer.value.seconds)
        elif task not in self._expected:
            return RunItHere(NOT_SENT)
        else:
            # A cluster is used from the first run on, because the user asked for it.
            if self.is_elsewhere and self._pool is None:
                self._begin()
            del self._expected[task]
            if self._pool is None:
                return NotStarted(NOT_SENT)
            answer = self._pool.fetch(task)
            if isinstance(answer, Done) and not self.is_elsewhere:
                self._learn(answer.value.seconds)
        answer = self._checked(answer)
        if isinstance(answer, Done) and isinstance(answer.value, Trace):
            # The evaluation of the run may end this process.
            scenario = task.scenario if isinstance(task, Whole) else task
            self._record.write(scenario, reference=self.job.reference)
        return answer

    def _checked(self, answer: Answer) -> Answer:
        __tracebackhide__ = True
        match answer:
            case Done(timed):
                timed.output.repeat()
                return Done(timed.value)
            case Lost(death):
                # Whoever receives it knows scenarios and no tasks.
                death.task = getattr(death.task, "scenario", death.task)
                return Lost(death)
            case RunItHere(error) if self._is_only:
                error.add_note(NOT_TRIED_HERE)
                raise error
            case RunItHere():
                return answer
            case other:
                assert_never(other)

    def _run_instead(self, why: RunItHere, scenario: Scenario, most: int | None = None) -> Any:
        __tracebackhide__ = True
        # The first runs of a search decide whether processes pay off, see _learn.
        started = self._clock()
        trace = super()._run(scenario, most=most)
        # The duration of a run that raised an error in a worker says nothing about the others.
        if isinstance(why, NotStarted):
            self._learn(self._clock() - started)
        return trace

    @property
    def notes(self) -> list[str]:
        if self._failure:
            # No process could be started, so the search ran here, although other processes were asked for.
            return [f"{flag('workers')} is 1: {self._failure}"]
        if self.is_elsewhere and self._pool is not None:
            assert not isinstance(self._pool, WorkerPool)  # noqa: S101  (it is the pool of the cluster)
            return self._pool.notes
        # A death that a second process did not repeat is no finding, but may be a sign of too little memory.
        recoveries = [lost.recovery for lost in self.deaths]
        if self._is_only:
            return recoveries
        option = flag("workers", self._workers)
        if self._runs_before and self._pool is not None and self._pool.failure:
            used = f"{flag('workers')}: this process ran everything, because workers failed: {self._pool.failure}"
            return [used, *recoveries]
        if self._runs_before:
            used = f"{option}: after {plural(self._runs_before, 'run')} in this process, the rest ran in workers"
            return [used + self.job.remark, *recoveries]
        # Too few runs to say anything about their duration.
        if self._workers == 1 or self._runs <= WARM_RUNS:
            return []
        mean, dear = 1000 * self.run_seconds, 1000 * DEAR
        return [
            f"{option} was not used, because runs took only {mean:.1f} ms. Workers help from {dear:g} ms per run"
        ]

    @property
    def in_use(self) -> int:
        is_unused = self.is_elsewhere or self._pool is None or self._pool.failure
        return 0 if is_unused else self._workers

    @property
    def run_seconds(self) -> float:
        if self._runs <= 1:
            return 0.0
        return self._warm_seconds / (self._runs - 1)

    def drive(self, task: Chunk) -> bool:
        """Start a chunk in another process. Return False if no process can run it."""
        if self._pool is None and not self._failure:
            self._start()
        # A cluster's workers cannot report single runs of a chunk.
        if not isinstance(self._pool, WorkerPool) or self._pool.failure:
            return False
        # The results of a chunk arrive one by one, as messages before the answer.
        self._pool.follow(task)
        self._drives = True
        return True

    def messages(self, *, waits: bool) -> list[tuple[Chunk, Said | Answer]]:
        """Return the messages of processes that run chunks, as :meth:`WorkerPool.messages` does."""
        if not isinstance(self._pool, WorkerPool):
            return []
        return self._pool.messages(waits=waits)

    def end(self) -> None:
        if self._pool is not None:
            # The notes at the end mention the deaths of all pools.
            self.recovered += self._pool.recovered
            self._pool.close()
            self._pool = None

    @property
    def deaths(self) -> list[LostRun]:
        if self._pool is None:
            return [*self.recovered]
        return [*self.recovered, *self._pool.recovered]

    def _fetched(self, task: Task, own: ScenarioPool | None = None) -> Answer:
        __tracebackhide__ = True
        try:
            pool = own or self._pool or self._begin()
        except ExecutionError as error:
            raise ExecutionError(f"{flag('isolate')}: {error}") from None
        answer: Answer = pool.fetch(task)
        if pool.failure:
            raise ExecutionError(
                f"{flag('isolate')}: expected a process for the ADS, but none works: {pool.failure}"
            )
        # A package may be missing on another machine. This must not be taken for an error of the ADS.
        if isinstance(answer, RunItHere) and self.is_elsewhere and own is None:
            raised = answer.error
            raise ExecutionError(
                f"{flag('isolate')}: expected workers that can run every scenario, but one of them raised "
                f"{type(raised).__name__}: {raised}. Install the missing packages on the workers, or search without "
                f"{flag('isolate')}, so that this process can run such scenarios"
            )
        return answer

    def count(self, runs: int, seconds: float) -> None:
        if self._runs:  # The first run is not in the mean, because it loads libraries.
            self._warm_seconds += seconds
        self._runs += runs

    def _learn(self, seconds: float) -> None:
        self.count(1, seconds)
        is_dear = seconds >= DEAR
        if self._runs > WARM_RUNS:
            is_dear = self._warm_seconds >= DEAR * (self._runs - 1)
        if (
            self._pool is not None
            and self._runs == WARM_RUNS + 1
            and not is_dear
            and not self._drives
        ):
            # Only the first run was slow, so other processes do not pay off.
            self._pool.close(at_once=True)
            self._pool = None
            self._runs_before = 0
        elif self._pool is None and is_dear and self._workers > 1 and not self._failure:
            self._start()

    def _start(self) -> None:
        # A second start, after a death or an end, does not change when the first one was.
        self._runs_before = self._runs_before or self._runs
        try:
            self._begin()
        except ExecutionError as error:
            self._failure = str(error)

    def _begin(self) -> ScenarioPool:
        # Looked up at each start, so that tests can replace it.
        make_pool = self._cluster or partial(pool_for, size=self._workers)
        pool: ScenarioPool = make_pool(self.job)
        self._pool = pool
        pool.expect(self._expected)
        return pool


def judged_apart(job: Job, scenario: Scenario, judge: Callable[[Trace], object]) -> Trace:
    """Run a scenario in a separate process, which also evaluates the run if it was forked. Return the trace.

    Raises:
        ProcessLostError: if the process died or hung, even if a second process did not.
        Exception: as for :meth:`Here.once`.
    """
    __tracebackhide__ = True

    def drive(scenario: Scenario, ads: Factory) -> Trace:
        trace: Trace = GENERATORS.run(job.world.rollout, scenario, ads)
        # The evaluation can end the process, too. It needs the fixtures of the test, which only a forked process has.
        with capture_output(), suppress(BaseException):
            judge(trace)
        return trace

    with job.crash_record() as record, Apart(job, record) as runner:
        if forks():
            trace: Trace = runner.once_by(scenario, drive)
        else:
            trace = runner.once(scenario)
    # A run that succeeded only in a second process counts as a death, too, because the ADS may have caused the first.
    for death in runner.deaths:
        raise death
    return trace


def drive_once(world: Any, scenario: Scenario, ads: Factory) -> Run:
    """Run a scenario for a test, and return the run.

    If policies are isolated, a forked process runs the scenario first, so that a crash does not end this process.

    Raises:
        ProcessLostError: if the forked process died or hung.
    """
    __tracebackhide__ = True
    # A test can pass any object.
    base = checked_world(world)
    if forks() and isolates():
        # The run is repeated below in this process, because a test may read what its policy has stored.
        with tempfile.TemporaryDirectory(prefix="pafot-") as records:
            job = Job(
                world=base, policy=Policy(ads), records=Path(records, "records"), owner="test"
            )
            with job.crash_record() as record, Apart(job, record) as runner:
                try:
                    runner.once(scenario)
                except ProcessLostError:
                    raise
                except Exception:  # noqa: BLE001, S110  (this process raises it)
                    pass
    return base.run_of(GENERATORS.run(base.rollout, scenario, ads))
