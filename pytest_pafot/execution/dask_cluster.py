"""Runs on the workers of a Dask scheduler, on any number of machines.

A worker runs its scenarios in a child process, which it reuses. There are two reasons. A hanging decision can be
interrupted only in a main thread, in which workers do not run tasks. And an ADS that ends its process must not end the
worker. World and ADS are sent as bytes, only until the workers have them; code that workers cannot import is part of
the bytes. A task is an object that runs when it is unpickled. So a scheduler, which only passes tasks on, does not need
this package.
"""

from __future__ import annotations

import hashlib
import multiprocessing
import pickle
import platform
import socket
import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, Executor, Future
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from itertools import count
from pathlib import Path
from queue import Empty, SimpleQueue
from types import ModuleType
from typing import Any

from pytest_pafot.execution.pool import ProcessLostError, WorkerPool
from pytest_pafot.execution.runner import Answer, Cluster, ExecutionError, Job, LostRun, Timed, Whole
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.support.errors import flag, install
from pytest_pafot.support.process import installed_versions
from pytest_pafot.world.guard.hang_guard import check_time

OPTION = flag("dask")
INSTALL = install("dask")

POLL = 0.5
"""The longest time to wait for an answer before the time of the search is checked [s]."""
SOON = 5.0
"""The time after which a session says that it waits for the first worker of a scheduler [s]."""
IDLE = 60.0
"""The time without a task after which the child process of a worker ends [s]."""

Task = Scenario | Whole


@contextmanager
def connected(address: str, tell: Callable[[str], object], *, timeout: float = 10.0) -> Iterator[Cluster]:
    """Provide a function that makes pools of the workers of a scheduler, which must answer within ``timeout`` [s].

    A scheduler may begin without workers, and start some when there is work. ``tell`` receives what is waited for if
    none is there soon.

    Raises:
        ExecutionError: if Dask is not installed, or the scheduler does not answer.
    """
    try:
        from distributed import Client  # noqa: PLC0415  (an optional dependency)
    except ImportError:
        raise ExecutionError(f"{OPTION}: expected the package distributed, received none; {INSTALL}") from None
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
        except Exception as error:  # noqa: BLE001  (any network error)
            expected = "a scheduler that answers, with the packages of this session"
            received = f"{type(error).__name__}: {error}"
            raise ExecutionError(f"{flag('dask', address)}: expected {expected}, received {received}") from None
        yield partial(DaskPool, client.get_executor())


class DaskPool:
    """A pool that runs scenarios on the workers of a cluster, as :class:`WorkerPool` does in processes.

    A task that fails is tried once more. If a worker dies in it then, its answer is a ``ProcessLostError``. If the
    connection to the workers fails then, or the scheduler drops the task, the cluster is not used any more.

    Raises:
        ExecutionError: if world and ADS cannot be packed; :meth:`fetch` raises it if workers cannot run scenarios as
            this process does, for example with other versions.
    """

    def __init__(self, executor: Executor, job: Job) -> None:
        self.recovered: list[LostRun] = []
        """The deaths of processes and workers in runs that succeeded in a second attempt."""
        self.failure = ""
        """The reason why the cluster cannot be used any more, so that tasks have no results; else empty."""
        self.unable: list[Exception] = []
        """The exceptions of workers for scenarios that this process has to run, such as an error of the factory."""
        self._executor = executor
        self._parcel = packed(job)
        self._is_known = False  # True if some worker has the content of the parcel
        self._under_way: dict[Task, Future[Any]] = {}
        self._numbers = count()

    @property
    def notes(self) -> list[str]:
        """Notes for the user on the workers, and on runs that they could not make."""
        note = f"{OPTION}: workers made the runs"
        if self.unable:
            first = f"{type(self.unable[0]).__name__}: {self.unable[0]}"
            note = f"{OPTION}: {len(self.unable)} runs were made in this process; a worker answered: {first}"
        if self.failure:
            note = f"{OPTION}: this process ran the scenarios; the cluster failed: {self.failure}"
        return [note, *(lost.recovery for lost in self.recovered)]

    def expect(self, tasks: Iterable[Task]) -> None:
        """Start to run some scenarios; earlier scenarios that were not fetched are dropped."""
        self.close()
        self.add_all(tasks)

    def add_all(self, tasks: Iterable[Task]) -> None:
        """Start to run some more scenarios."""
        for task in tasks:
            if task in self._under_way or self.failure:
                continue
            parcel = self._parcel if not self._is_known else replace(self._parcel, content=None)
            named: Any = {"key": f"pafot-{next(self._numbers)}-{self._parcel.digest}", "pure": False}
            try:
                call = pickle.dumps(_Call(_run_task, parcel, task))
                self._under_way[task] = self._executor.submit(pickle.loads, call, **named)
            except Exception as error:  # noqa: BLE001  (the client is closed; Dask's errors have no base)
                self.failure = _named(error)

    def fetch(self, task: Task) -> Answer:
        """Wait for the answer to a scenario and return it; each answer can be fetched once."""
        first: Exception | None = None
        while not self.failure:
            self.add_all([task])
            if task not in self._under_way:
                break
            try:
                done = _result(self._under_way.pop(task))
            except Exception as error:  # noqa: BLE001  (Dask's errors have no base)
                # Only the second error counts: Dask may raise any if a worker dies while its answer is read.
                if first is None:
                    first = error
                elif type(error).__name__ == "KilledWorker":
                    return _lost(task, error)
                elif isinstance(error, (OSError, CancelledError)):
                    self.failure = _named(error)
                else:
                    received = f"{type(error).__name__}: {error}"
                    raise ExecutionError(
                        f"{OPTION}: expected workers that can run scenarios, with the same packages as this session, "
                        f"received {received}"
                    ) from None
                continue
            if isinstance(done, str):
                raise ExecutionError(done)
            self._is_known = done is not None
            if done is None:  # the worker is new
                continue
            answer: Answer = done[0]
            self.recovered += [*done[1], *([] if first is None else [_lost(task, first)])]
            self.unable += [] if isinstance(answer, (tuple, ProcessLostError)) else [answer]
            return answer
        return RuntimeError(self.failure)

    def close(self, *, at_once: bool = False) -> None:
        """Cancel the current tasks."""
        for future in self._under_way.values():
            future.cancel()
        self._under_way = {}


def _result(future: Future[Any]) -> Any:
    """Wait for the result of a task; raise its exception, or ``OutOfTime`` if the time of the search is over."""
    while True:
        check_time()
        try:
            return future.result(POLL)
        except TimeoutError:
            if future.done():  # the error is that of the task
                raise


def _named(error: Exception) -> str:
    text = str(error) or ("the tasks were dropped, as by a scheduler that ended" * isinstance(error, CancelledError))
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def _lost(task: Task, error: Exception) -> LostRun:
    scenario = task.scenario if isinstance(task, Whole) else task
    return ProcessLostError(scenario, pid=0, how=f"was lost ({type(error).__name__})")


# What is sent.


@dataclass(frozen=True, slots=True)
class Parcel:
    """Everything that workers need to run scenarios; parcels with the same digest are equal, even without content."""

    digest: str
    content: bytes | None = field(compare=False)  # world, ADS factory and the function that reads from runs
    patience: float = field(compare=False)  # the patience of the workers' pools, see WorkerPool [s]
    versions: dict[str, str] = field(compare=False)  # versions of packages in the session
    closing: dict[str, Any] = field(compare=False)  # see Job.closing


def versions_here() -> dict[str, str]:
    """Return the versions of Python and of the packages on which a run depends."""
    return {"python": platform.python_version(), **installed_versions()}


def packed(job: Job) -> Parcel:
    """Pack world and ADS of a job for workers on other machines, together with the modules of the user's project."""
    try:
        import cloudpickle  # noqa: PLC0415  (an optional dependency)
    except ImportError:
        raise ExecutionError(f"{OPTION}: expected the package cloudpickle, received none; {INSTALL}") from None
    with ExitStack() as stack:
        # The loaded modules of the project, because other machines need not have them installed.
        for module in [each for each in list(sys.modules.values()) if _is_below(job.root, each)]:
            cloudpickle.register_pickle_by_value(module)
            stack.callback(cloudpickle.unregister_pickle_by_value, module)
        try:
            content = cloudpickle.dumps(Job(world=job.world, policy=job.policy, records=Path(), owner=""))
        except Exception as error:  # noqa: BLE001  (pickling the user's objects may raise anything)
            raise ExecutionError(
                f"{OPTION}: expected a world and an ADS factory that can be sent to other machines, received one "
                f"that raises {type(error).__name__}: {error}; open what the ADS needs in the factory, not before"
            ) from None
    digest = hashlib.sha256(content).hexdigest()[:16]
    return Parcel(digest, content, job.patience, versions_here(), job.closing)


def _is_below(root: Path, module: ModuleType) -> bool:
    name, file = getattr(module, "__name__", ""), getattr(module, "__file__", None)
    if not file or sys.modules.get(name) is not module or name.partition(".")[0] in ("pytest_pafot", "__main__"):
        return False
    path = Path(file)
    return path.suffix == ".py" and path.is_relative_to(root) and "site-packages" not in path.parts


class _Call:
    """A call that is made when this object is unpickled; the result of the unpickling is the result of the call."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self._call = function, arguments

    def __reduce__(self) -> tuple[Any, ...]:
        return self._call


# What a worker does.


def _run_task(parcel: Parcel, task: Task) -> tuple[Answer, list[LostRun]] | str | None:
    """Run a scenario in a worker; return the answer, and the deaths of processes before a second attempt succeeded.

    Return a text with the reason if the worker cannot run any scenario, or None if it needs the content of the parcel.
    """
    here, place = versions_here(), f"{socket.gethostname()} ({sys.executable})"
    other = [f"{name} {version} in this session, {here.get(name)} there" for name, version in parcel.versions.items()
             if here.get(name) != version]  # fmt: skip
    if other:
        expected = f"{OPTION}: expected workers with the versions of this session"
        return f"{expected}, received at {place}: {'; '.join(other)}; install the same there"
    try:
        whole, idle = _kept(parcel)
    except LookupError:
        return None
    try:
        pool = idle.get_nowait()
    except Empty:
        multiprocessing.current_process().daemon = False  # Dask's workers are daemons, which may have no children.
        work = partial(_run, whole)
        pool = WorkerPool(work, 1, method="spawn", patience=whole.patience, idle=IDLE, **whole.closing)
    answer = pool.fetch(task)
    recovered, pool.recovered = pool.recovered, []
    if pool.failure or isinstance(answer, ExecutionError):
        return f"{OPTION}: a worker at {place} cannot run the ADS: {pool.failure or answer}"
    idle.put(pool)
    return answer, recovered


@lru_cache(maxsize=4)
def _kept(parcel: Parcel) -> tuple[Parcel, SimpleQueue[WorkerPool[Any, Any]]]:
    """Return a parcel with its content, and the idle child processes for it; there is one for each simultaneous task.

    Raises:
        LookupError: if this worker does not have the content.
    """
    if parcel.content is None:
        raise LookupError
    return parcel, SimpleQueue()


def _run(parcel: Parcel, task: Task, tell: object) -> Timed:
    """Run a scenario in the child process of a worker."""
    scenario, method = (task.scenario, task.method) if isinstance(task, Whole) else (task, "rollout")
    return Job.run(partial(_unpacked, parcel), scenario, method)


@lru_cache(maxsize=1)
def _unpacked(parcel: Parcel) -> Job:
    try:
        job: Job = pickle.loads(parcel.content or b"")  # noqa: S301  (packed by the session)
    except Exception as error:  # noqa: BLE001  (importing a user's module may raise anything)
        raise ExecutionError(f"expected the packages that it needs, received {type(error).__name__}: {error}") from None
    return job
