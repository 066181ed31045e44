"""Runs by any executor, on any number of machines; each task is a few scenarios.

A worker runs its scenarios in a child process, which it reuses for later tasks. There are two reasons. A hanging
decision can be interrupted only in a main thread, in which workers do not run tasks. And an ADS that ends its process
must not end the worker. World and ADS are sent as bytes, only until the workers have them; code that workers cannot
import is part of the bytes. A task is an object that runs when it is unpickled. So a scheduler, which only passes tasks
on, does not need this package.
"""

from __future__ import annotations

import hashlib
import multiprocessing
import pickle
import platform
import socket
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from itertools import count, islice
from pathlib import Path
from queue import Empty, SimpleQueue
from types import ModuleType
from typing import Any

from pytest_pafot import Scenario
from pytest_pafot.extending import ExecutionError, Job, ProcessLostError, WorkerPool, check_time
from pytest_pafot.support.errors import flag, install
from pytest_pafot.support.versions import installed_versions

POLL = 0.5
"""The longest time to wait for an answer before the time of the search is checked [s]."""
INSTALL = install("dask")
TASK_SECONDS = 2.0
"""The longest duration of a task with several scenarios [s]. The overhead of a task is some milliseconds."""
TASKS = 2
"""The number of tasks for each worker that the announced scenarios are divided into, at least."""
WORKERS = 64
"""The assumed number of workers of an executor that does not say how many it has."""

SOON = 5.0
"""The time after which a session says that it waits for the first worker of a Dask scheduler [s]."""

IDLE = 60.0
"""The time without a task after which the child process of a worker ends [s]."""


LostRun = ProcessLostError[Scenario]
Timed = tuple[Any, Any, float]
"""What :meth:`Job.run` returns: a run, its output, and its duration [s]."""
Answer = Timed | Exception


@dataclass(frozen=True, slots=True)
class Parcel:
    """Everything that workers need to run scenarios; parcels with the same digest are equal, even without content."""

    digest: str
    content: bytes | None = field(compare=False)  # world, ADS factory and the function that reads from runs
    patience: float = field(compare=False)  # the patience of the workers' pools, see WorkerPool [s]
    versions: dict[str, str] = field(compare=False)  # versions of packages in the session
    closing: dict[str, Any] = field(compare=False)  # see Job.closing


Done = tuple[list[Timed | Exception], list[LostRun]]
"""The answers to the scenarios of a task, and the deaths of processes in runs that succeeded in a second attempt."""


class ExecutorPool:
    """A pool that runs scenarios by an executor, as :class:`pytest_pafot.execution.pool.WorkerPool` does by processes.

    If a worker dies in a task, any of the task's scenarios may be the cause, so each scenario is run again by itself.
    If a worker dies again, the answer to that scenario is a ``ProcessLostError``. If the connection to the workers
    fails twice, or what distributes the tasks drops one twice, the executor is not used any more.

    Raises:
        ExecutionError: if world and ADS cannot be packed; :meth:`fetch` raises it if workers cannot unpack them.
    """

    def __init__(self, job: Job, executor: Executor) -> None:
        self.recovered: list[LostRun] = []
        """The deaths of processes and workers in runs that succeeded in a second attempt."""
        self.failure = ""
        """The reason why the executor cannot be used any more, so that tasks have no results; else empty."""
        self.unable: list[Exception] = []
        """The exceptions of workers for scenarios that this process has to run, such as an error of the factory."""
        self._executor = executor
        self._parcel = packed(job)
        self._is_known = False  # True if some worker has the content of the parcel
        self._workers = _workers(executor)
        self._waiting: dict[Scenario, None] = {}  # announced, but in no task yet
        self._under_way: dict[Scenario, tuple[Sequence[Scenario], Future[Any]]] = {}
        self._answers: dict[Scenario, Answer] = {}
        self._numbers = count()
        self._runs, self._seconds = 0, 0.0

    @property
    def notes(self) -> list[str]:
        """Notes for the user on the executor, and on runs that it could not make."""
        notes = [f"pafot_executor: {type(self._executor).__name__} made the runs of the generations"]
        if self.unable:
            first = f"{type(self.unable[0]).__name__}: {self.unable[0]}"
            notes = [f"pafot_executor: {len(self.unable)} runs were made in this process; a worker answered: {first}"]
        if self.failure:
            notes = [f"pafot_executor: this process ran the scenarios; the executor failed: {self.failure}"]
        return notes + [lost.recovery for lost in self.recovered]

    def expect(self, scenarios: Iterable[Scenario]) -> None:
        """Start to run some scenarios; earlier scenarios that were not fetched are dropped."""
        self.close()
        self.add_all(scenarios)
        self._submit_rest()

    def add_all(self, scenarios: Iterable[Scenario]) -> None:
        """Start to run some more scenarios. Those that do not fill a task wait for more, or until one is requested."""
        known = (self._waiting, self._under_way, self._answers)
        self._waiting |= dict.fromkeys(each for each in scenarios if not any(each in group for group in known))
        share = (len(self._waiting) + len(self._under_way)) // (TASKS * self._workers)
        size = max(1, min(share, round(self._runs * TASK_SECONDS / self._seconds))) if self._runs else 1
        while len(self._waiting) >= size:
            self._submit(list(islice(self._waiting, size)))

    def fetch(self, scenario: Scenario) -> Answer:
        """Wait for the answer to a scenario and return it; each answer can be fetched once.

        Raises:
            ExecutionError: if workers cannot run scenarios as this process does, for example with other versions.
        """
        if scenario in self._waiting:
            self._submit_rest()
        elif scenario not in self._under_way and scenario not in self._answers:
            self._submit([scenario])
        error = self._gather(scenario)
        if error is not None and not self.failure:
            self._submit([scenario])
            again = self._gather(scenario)
            # These errors say that a worker or the connection was lost; KilledWorker is Dask's, and its tasks are
            # cancelled where the scheduler is gone. After a first failure of any other kind there is a second try as
            # well, because Dask's executor raises a ValueError if a worker dies while its answer is read.
            is_lost = isinstance(again, BrokenExecutor)
            if isinstance(again, (OSError, CancelledError)):
                self.failure = _named(again)
            elif again is not None and not is_lost and type(again).__name__ != "KilledWorker":
                expected = "workers that can run scenarios, with the same packages as this session"
                received = f"received {type(again).__name__}: {again}"
                raise ExecutionError(f"pafot_executor: expected {expected}, {received}") from None
            elif again is not None and not self.failure:
                return _lost(scenario, again)
            else:
                self.recovered.append(_lost(scenario, error))
        return RuntimeError(self.failure) if self.failure else self._answers.pop(scenario)

    def arrived(self, scenario: Scenario) -> Answer | None:
        """Return the answer to a scenario, which can still be fetched; None if there is none yet."""
        future = self._under_way[scenario][1] if scenario in self._under_way else None
        if future is not None and future.done() and not future.cancelled() and future.exception() is None:
            self._gather(scenario)
        return self._answers.get(scenario)

    def close(self, *, at_once: bool = False) -> None:
        """Cancel the current tasks, but do not shut down the executor, because it belongs to the user."""
        for _, future in self._under_way.values():
            future.cancel()
        self._waiting, self._under_way, self._answers = {}, {}, {}

    def _submit_rest(self) -> None:
        """Submit the scenarios that wait, in a task for each worker if there are as many."""
        size = max(1, len(self._waiting) // self._workers)
        while self._waiting:
            self._submit(list(islice(self._waiting, size)))

    def _submit(self, scenarios: Sequence[Scenario]) -> None:
        for scenario in scenarios:
            self._waiting.pop(scenario, None)
        if self.failure:
            return
        parcel = replace(self._parcel, content=None) if self._is_known else self._parcel
        named: dict[str, Any] = {}
        if type(self._executor).__module__.partition(".")[0] == "distributed":
            ids = "+".join(scenario.id for scenario in scenarios)
            named = {"key": f"pafot-{ids}-{self._parcel.digest}-{next(self._numbers)}", "pure": False}
        try:
            future = self._executor.submit(pickle.loads, pickle.dumps(_Call(_run_task, parcel, scenarios)), **named)
        except Exception as error:  # noqa: BLE001  (the executor is broken, or was shut down; Dask's errors have no base)
            self.failure = _named(error)
        else:
            self._under_way |= dict.fromkeys(scenarios, (scenarios, future))

    def _gather(self, scenario: Scenario) -> Exception | None:
        """Wait for the answers to the task of a scenario; return the error if there are none because of it, or None."""
        while scenario in self._under_way:
            scenarios, future = self._under_way[scenario]
            try:
                done: Done | str | None = _result(future)
            except Exception as error:  # noqa: BLE001  (any executor may raise anything)
                del self._under_way[scenario]  # The other scenarios are tried by themselves when they are fetched.
                return error
            if isinstance(done, str):
                raise ExecutionError(done)
            self._is_known = done is not None
            if done is None:
                self._submit(scenarios)
            else:
                self._take(scenarios, *done)
        return None

    def _take(self, scenarios: Sequence[Scenario], answers: list[Timed | Exception], recovered: list[LostRun]) -> None:
        self.recovered += recovered
        for scenario, answer in zip(scenarios, answers, strict=True):
            del self._under_way[scenario]
            if isinstance(answer, tuple):
                self._runs, self._seconds = self._runs + 1, self._seconds + answer[2]
            elif not isinstance(answer, ProcessLostError):
                self.unable.append(answer)
            self._answers[scenario] = answer


def _workers(executor: Executor) -> int:
    """Return how many tasks an executor runs at once."""
    client: Any = getattr(executor, "_client", None)
    if hasattr(client, "nthreads"):  # Dask's
        try:
            return sum(client.nthreads().values()) or WORKERS
        except Exception:  # noqa: BLE001  (it is closed, or does not answer, as the first task will report)
            return WORKERS
    # The executors of the standard library and of loky have the first attribute, mpi4py's the second.
    return getattr(executor, "_max_workers", None) or getattr(executor, "num_workers", None) or WORKERS


def _result(future: Future[Any]) -> Any:
    """Wait for the result of a task.

    Raises:
        OutOfTime: if the time of the search is over.
        Exception: any exception of the task or of the executor.
    """
    while True:
        check_time()
        try:
            return future.result(POLL)
        except TimeoutError:
            if future.done():  # the error is that of the task
                raise


@contextmanager
def dask_executor(address: str, tell: Callable[[str], object], *, timeout: float = 10.0) -> Iterator[Executor]:
    """Provide an executor for the workers of a Dask scheduler, which must answer within ``timeout`` [s].

    A scheduler may begin without workers, and start some when there is work. ``tell`` receives what is waited for if
    none is there soon.

    Raises:
        ExecutionError: if Dask is not installed, the scheduler does not answer, or a worker has different versions.
    """
    try:
        from distributed import Client  # noqa: PLC0415  (an optional dependency)
    except ImportError:
        raise ExecutionError(f"{flag('dask')}: expected the package distributed, received none; {INSTALL}") from None
    with ExitStack() as stack:
        try:
            client = stack.enter_context(Client(address, timeout=timeout, set_as_default=False))
            try:
                client.wait_for_workers(1, timeout=SOON)
            except TimeoutError:
                tell(
                    f"{flag('dask', address)}: the scheduler has no worker, so no scenario runs until one joins; start "
                    f"one by `dask worker {address}`, or end this session by Ctrl-C"
                )
                client.wait_for_workers(1)
            workers = client.run(pickle.loads, pickle.dumps(_Call(_difference, versions_here())))
        except Exception as error:  # noqa: BLE001  (any network error, or a worker without a package)
            raise ExecutionError(
                f"{flag('dask', address)}: expected a scheduler that answers, with workers that have the "
                f"packages of this session, received {type(error).__name__}: {error}"
            ) from None
        for difference in filter(None, workers.values()):
            raise ExecutionError(difference)
        yield client.get_executor()


def versions_here() -> dict[str, str]:
    """Return the versions of Python and of the packages on which a run depends."""
    return {"python": platform.python_version(), **installed_versions()}


def packed(job: Job) -> Parcel:
    """Pack world and ADS of a job for workers on other machines, together with the modules of the user's project."""
    try:
        import cloudpickle  # noqa: PLC0415  (an optional dependency)
    except ImportError:
        raise ExecutionError(f"pafot_executor: expected the package cloudpickle, received none; {INSTALL}") from None
    with ExitStack() as stack:
        # The loaded modules of the project, because other machines need not have them installed.
        for module in [each for each in list(sys.modules.values()) if _is_below(job.root, each)]:
            cloudpickle.register_pickle_by_value(module)
            stack.callback(cloudpickle.unregister_pickle_by_value, module)
        try:
            content = cloudpickle.dumps(
                Job(world=job.world, policy=job.policy, read=job.read, records=Path(), owner="")
            )
        except Exception as error:  # noqa: BLE001  (pickling the user's objects may raise anything)
            raise ExecutionError(
                "pafot_executor: expected a world and an ADS factory that can be sent to other machines, received one "
                f"that raises {type(error).__name__}: {error}; open what the ADS needs in the factory, not before"
            ) from None
    digest = hashlib.sha256(content).hexdigest()[:16]
    return Parcel(digest, content, job.patience, versions_here(), job.closing)


class _Call:
    """A call that is made when this object is unpickled; the result of the unpickling is the result of the call."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self._call = function, arguments

    def __reduce__(self) -> tuple[Any, ...]:
        return self._call


class _Bench:
    """The child processes of a worker for one parcel; there is one for each simultaneous task."""

    def __init__(self, parcel: Parcel) -> None:
        self.parcel = parcel
        self._idle: SimpleQueue[WorkerPool[Scenario, Timed]] = SimpleQueue()

    def run(self, scenarios: Sequence[Scenario]) -> Done | str:
        try:
            pool = self._idle.get_nowait()
        except Empty:
            multiprocessing.current_process().daemon = False  # Dask's workers are daemons, which may have no children.
            parcel, work = self.parcel, partial(_run, self.parcel)
            pool = WorkerPool(work, 1, method="spawn", patience=parcel.patience, idle=IDLE, **parcel.closing)
        pool.expect(scenarios)
        answers = [pool.fetch(scenario) for scenario in scenarios]
        recovered, pool.recovered = pool.recovered, []
        unable = next((each for each in answers if isinstance(each, ExecutionError)), None)
        if pool.failure or unable is not None:
            return f"pafot_executor: a worker at {_place()} cannot run the ADS: {pool.failure or unable}"
        self._idle.put(pool)
        return answers, recovered


def _run_task(parcel: Parcel, scenarios: Sequence[Scenario]) -> Done | str | None:
    """Run scenarios in a worker and return the answers.

    Return a text with the reason if the worker cannot run any scenario, or None if it needs the content of the parcel.
    """
    difference = _difference(parcel.versions)
    if difference:
        return difference
    try:
        bench = _bench(parcel)
    except LookupError:
        return None
    return bench.run(scenarios)


@lru_cache(maxsize=4)
def _bench(parcel: Parcel) -> _Bench:
    if parcel.content is None:
        raise LookupError
    return _Bench(parcel)


def _run(parcel: Parcel, scenario: Scenario, tell: object) -> Timed:
    """Run a scenario in the child process of a worker."""
    trace, output, seconds = Job.run(partial(_unpacked, parcel), scenario)
    with suppress(Exception):  # it is raised again in the session, which reads the trace
        return _unpacked(parcel).read(trace) or trace, output, seconds
    return trace, output, seconds


@lru_cache(maxsize=1)
def _unpacked(parcel: Parcel) -> Job:
    try:
        job: Job = pickle.loads(parcel.content or b"")  # noqa: S301  (packed by the session)
    except Exception as error:  # noqa: BLE001  (importing a user's module may raise anything)
        raise ExecutionError(f"expected the packages that it needs, received {type(error).__name__}: {error}") from None
    return job


def _difference(session: dict[str, str]) -> str:
    """Return a message with the packages whose versions in this worker differ from the session's; empty if none do."""
    here = versions_here()
    other = [f"{name} {version} in this session, {here.get(name)} there" for name, version in session.items()
             if here.get(name) != version]  # fmt: skip
    expected = "pafot_executor: expected workers with the versions of this session"
    return f"{expected}, received at {_place()}: {'; '.join(other)}; install the same there" if other else ""


def _place() -> str:
    return f"{socket.gethostname()} ({sys.executable})"


def _is_below(root: Path, module: ModuleType) -> bool:
    name, file = getattr(module, "__name__", ""), getattr(module, "__file__", None)
    if not file or sys.modules.get(name) is not module or name.partition(".")[0] in ("pytest_pafot", "__main__"):
        return False
    path = Path(file)
    return path.suffix == ".py" and path.is_relative_to(root) and "site-packages" not in path.parts


def _named(error: Exception) -> str:
    text = str(error) or ("the tasks were dropped, as by a scheduler that ended" * isinstance(error, CancelledError))
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def _lost(scenario: Scenario, error: Exception) -> LostRun:
    return ProcessLostError(scenario, pid=0, how=f"was lost ({type(error).__name__})")
