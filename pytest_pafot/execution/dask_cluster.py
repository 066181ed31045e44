"""Runs of scenarios on Dask workers, which can be on other machines.

Each worker runs scenarios in a child process, because only the main thread of a process can interrupt a decision that
hangs, and Dask runs tasks in other threads. The child also protects the worker from an ADS that ends its process.
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
from typing import Any, assert_never

from pytest_pafot.execution.pool import Answer, Lost, ProcessLostError, RunItHere, WorkerPool
from pytest_pafot.execution.runner import (
    Cluster,
    ExecutionError,
    Job,
    LostRun,
    Task,
    Timed,
    Whole,
    in_world,
    run_timed,
)
from pytest_pafot.support.errors import flag, install
from pytest_pafot.support.process import installed_versions
from pytest_pafot.world.guard.hang_guard import check_time

OPTION = flag("dask")
INSTALL = install("dask")

POLL = 0.5  # interval for checks of the search's time limit [s]
SOON = 5.0  # time to wait for a first worker before the user is informed [s]
IDLE = 60.0  # time after which an idle child process ends [s]


@dataclass(frozen=True, slots=True)
class Answered:
    """The answer of a worker to a task, and the processes that it lost before a second attempt succeeded."""

    answer: Answer
    recovered: tuple[LostRun, ...]


@dataclass(frozen=True, slots=True)
class Unfit:
    """The answer of a worker that cannot run any scenario."""

    why: str


@dataclass(frozen=True, slots=True)
class NeedsContent:
    """The answer of a worker that does not have the content of the parcel yet."""


@contextmanager
def connect(
    address: str, tell: Callable[[str], object], *, timeout: float = 10.0
) -> Iterator[Cluster]:
    """Connect to a Dask scheduler and yield a function that creates pools of its workers.

    ``tell`` receives a message if the scheduler has no worker yet.

    Raises:
        ExecutionError: if Dask is missing, or if the scheduler does not respond within ``timeout`` [s].
    """
    try:
        from distributed import Client  # noqa: PLC0415  (an optional dependency)
    except ImportError:
        raise ExecutionError(
            f"{OPTION}: expected the package distributed, which is missing. Run `{INSTALL}`"
        ) from None
    with ExitStack() as stack:
        try:
            client = stack.enter_context(Client(address, timeout=timeout, set_as_default=False))
            try:
                # A scheduler may have no worker yet, and start some only when there is work.
                client.wait_for_workers(1, timeout=SOON)
            except TimeoutError:
                tell(
                    f"{flag('dask', address)}: the scheduler has no worker, so no scenario runs until one joins. Start "
                    f"one with `dask worker {address}`, or end this session with Ctrl-C"
                )
                client.wait_for_workers(1)
        except Exception as error:  # noqa: BLE001  (any network error)
            problem = "expected a running scheduler with the same packages as this session, received the error"
            raise ExecutionError(f"{flag('dask', address)}: {problem} {_named(error)}") from None
        yield partial(DaskPool, client.get_executor())


class DaskPool:
    """A pool that runs scenarios on the workers of a cluster, as :class:`WorkerPool` does in local processes.

    Raises:
        ExecutionError: if the world or the ADS cannot be pickled, or if a worker has different package versions.
    """

    def __init__(self, executor: Executor, job: Job) -> None:
        self.recovered: list[LostRun] = []  # process deaths in runs whose second attempt succeeded
        self.failure = ""  # why the cluster cannot be used any more, or empty
        # exceptions of workers in runs that this process has to repeat
        self.unable: list[Exception] = []
        self._executor = executor
        self._parcel = packed(job)
        self._is_known = False  # True if some worker has the content of the parcel
        self._under_way: dict[Task, Future[Any]] = {}
        self._numbers = count()

    @property
    def notes(self) -> list[str]:
        note = f"{OPTION}: the workers of the cluster executed the runs"
        if self.unable:
            first = f"{type(self.unable[0]).__name__}: {self.unable[0]}"
            note = f"{OPTION}: a worker raised {first}, so this process executed {len(self.unable)} of the runs"
        if self.failure:
            note = f"{OPTION}: this process ran the scenarios, because the cluster failed: {self.failure}"
        return [note, *(lost.recovery for lost in self.recovered)]

    def expect(self, tasks: Iterable[Task]) -> None:
        self.close()
        self.add_all(tasks)

    def add_all(self, tasks: Iterable[Task]) -> None:
        for task in tasks:
            # A task that is announced twice runs once.
            if task in self._under_way or self.failure:
                continue
            # The content is large, so it is sent only until a worker has it. A worker without it answers
            # `NeedsContent`.
            parcel = self._parcel if not self._is_known else replace(self._parcel, content=None)
            named: Any = {
                "key": f"pafot-{next(self._numbers)}-{self._parcel.digest}",
                "pure": False,
            }
            try:
                # The scheduler sees only bytes and pickle.loads, so it does not need this package.
                call = pickle.dumps(_Call(_run_task, parcel, task))
                self._under_way[task] = self._executor.submit(pickle.loads, call, **named)
            except Exception as error:  # noqa: BLE001  (the client is closed; Dask's errors have no base)
                self.failure = _named(error)

    def fetch(self, task: Task) -> Answer:
        """Wait for the answer to a scenario. An answer can be fetched only once."""
        errors: list[Exception] = []
        while not self.failure:
            self.add_all([task])
            if task not in self._under_way:
                break
            try:
                done = _result(self._under_way.pop(task))
            except Exception as error:  # noqa: BLE001  (Dask's errors have no base)
                # A task that fails is tried once more. Only the second error counts, because Dask may raise any error
                # if a worker dies while its answer is read.
                errors.append(error)
                if len(errors) == 1:
                    pass
                elif type(error).__name__ == "KilledWorker":
                    return Lost(_lost(task, error))
                elif isinstance(error, (OSError, CancelledError)):
                    self.failure = _named(error)
                else:
                    raise ExecutionError(
                        f"{OPTION}: expected workers that can run scenarios, received the error {_named(error)}. Do "
                        "the workers have the same packages as this session?"
                    ) from None
                continue
            match done:
                case Unfit(why):
                    raise ExecutionError(why)
                case NeedsContent():  # the worker is new
                    self._is_known = False
                case Answered(answer, recovered):
                    self._is_known = True
                    self.recovered += [*recovered, *(_lost(task, error) for error in errors[:1])]
                    if isinstance(answer, RunItHere):
                        self.unable.append(answer.error)
                    return answer
                case other:
                    assert_never(other)
        return RunItHere(RuntimeError(self.failure))

    def close(self, *, at_once: bool = False) -> None:
        for future in self._under_way.values():
            future.cancel()
        self._under_way = {}


def _result(future: Future[Any]) -> Answered | Unfit | NeedsContent:
    while True:
        # Waiting must end with the search's time limit, which no signal of the cluster reports.
        check_time()
        try:
            done: Answered | Unfit | NeedsContent = future.result(POLL)
            return done
        except TimeoutError:
            if future.done():  # the task itself raised the error
                raise


def _named(error: Exception) -> str:
    text = str(error) or (
        "the scheduler dropped the tasks, or has ended" * isinstance(error, CancelledError)
    )
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def _lost(task: Task, error: Exception) -> LostRun:
    scenario = task.scenario if isinstance(task, Whole) else task
    return ProcessLostError(scenario, pid=0, how=f"was lost ({type(error).__name__})")


# The data that is sent to workers.


@dataclass(frozen=True, slots=True)
class Parcel:
    """A job in the form that is sent to workers. Parcels with the same digest are equal, even without content."""

    digest: str
    content: bytes | None = field(compare=False)  # the pickled world and ADS factory
    patience: float = field(compare=False)  # the patience of the workers' pools, see WorkerPool [s]
    versions: dict[str, str] = field(compare=False)  # versions of packages in the session
    closing: dict[str, Any] = field(compare=False)  # see Job.closing


def versions_here() -> dict[str, str]:
    """Return the versions of Python and of the packages on which a run depends."""
    return {"python": platform.python_version(), **installed_versions()}


def packed(job: Job) -> Parcel:
    """Pickle a job for other machines, together with the modules of the user's project."""
    try:
        import cloudpickle  # noqa: PLC0415  (an optional dependency)
    except ImportError:
        raise ExecutionError(
            f"{OPTION}: expected the package cloudpickle, which is missing. Run `{INSTALL}`"
        ) from None
    with ExitStack() as stack:
        # The loaded modules of the project are sent, too, because other machines need not have them installed.
        for module in [each for each in list(sys.modules.values()) if _is_below(job.root, each)]:
            cloudpickle.register_pickle_by_value(module)
            stack.callback(cloudpickle.unregister_pickle_by_value, module)
        try:
            content = cloudpickle.dumps(
                Job(world=job.world, policy=job.policy, records=Path(), owner="")
            )
        except Exception as error:  # noqa: BLE001  (pickling the user's objects may raise anything)
            raise ExecutionError(
                f"{OPTION}: expected a world and an ADS factory that can be sent to other machines, received the "
                f"error {type(error).__name__}: {error}. Open files and connections inside the factory, not before"
            ) from None
    # Part of the task's key, so that Dask never answers with a result of another policy.
    digest = hashlib.sha256(content).hexdigest()[:16]
    return Parcel(digest, content, job.patience, versions_here(), job.closing)


def _is_below(root: Path, module: ModuleType) -> bool:
    name, file = getattr(module, "__name__", ""), getattr(module, "__file__", None)
    if (
        not file
        or sys.modules.get(name) is not module
        or name.partition(".")[0] in ("pytest_pafot", "__main__")
    ):
        return False
    # Installed packages must be installed on the workers, too, in the same versions.
    path = Path(file)
    return path.suffix == ".py" and path.is_relative_to(root) and "site-packages" not in path.parts


class _Call:
    """An object that unpickling replaces with the result of a call."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self._call = function, arguments

    def __reduce__(self) -> tuple[Any, ...]:
        return self._call


# The code that a worker runs.


def _run_task(parcel: Parcel, task: Task) -> Answered | Unfit | NeedsContent:
    """Run a scenario in a worker."""
    # The same scenario must give the same result on any worker, so the versions must be equal.
    here, place = versions_here(), f"{socket.gethostname()} ({sys.executable})"
    other = [f"{name} {version} in this session, {here.get(name)} there" for name, version in parcel.versions.items()
             if here.get(name) != version]  # fmt: skip
    if other:
        expected = f"{OPTION}: expected workers with the same versions as this session"
        differ = f"those at {place} differ: {'; '.join(other)}"
        return Unfit(f"{expected}, but {differ}. Install the same versions there")
    try:
        whole, idle = _kept(parcel)
    except LookupError:
        return NeedsContent()
    try:
        # There is an idle child for each task that has run at the same time. A child is put back after its task.
        pool = idle.get_nowait()
    except Empty:
        # Dask's workers are daemons, which cannot have children.
        multiprocessing.current_process().daemon = False
        work = partial(_run, whole)
        pool = WorkerPool(
            work, 1, method="spawn", patience=whole.patience, idle=IDLE, **whole.closing
        )
    answer = pool.fetch(task)
    recovered = tuple(pool.recovered)
    pool.recovered = []
    problem = pool.failure
    if isinstance(answer, RunItHere) and isinstance(answer.error, ExecutionError):
        problem = problem or str(answer.error)
    if problem:
        return Unfit(f"{OPTION}: a worker at {place} cannot run the ADS: {problem}")
    # Only a pool that works is kept for the next task.
    idle.put(pool)
    return Answered(answer, recovered)


@lru_cache(maxsize=4)
def _kept(parcel: Parcel) -> tuple[Parcel, SimpleQueue[WorkerPool[Any]]]:
    # A parcel with its content, and its idle child processes.
    if parcel.content is None:
        raise LookupError
    return parcel, SimpleQueue()


def _run(parcel: Parcel, task: Task, tell: object) -> Timed:
    whole = task if isinstance(task, Whole) else Whole(task, in_world)
    return run_timed(partial(_unpacked, parcel), whole.scenario, whole.simulate)


@lru_cache(maxsize=1)
def _unpacked(parcel: Parcel) -> Job:
    try:
        job: Job = pickle.loads(parcel.content or b"")  # noqa: S301  (packed by the session)
    except Exception as error:  # noqa: BLE001  (importing a user's module may raise anything)
        raise ExecutionError(
            f"expected all packages of the ADS, received {type(error).__name__}: {error}"
        ) from None
    return job
