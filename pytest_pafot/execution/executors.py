"""Runs by any executor, on as many machines as it has: tasks of a few scenarios, run by a process of a worker's own.

A task does not run in a main thread, where alone a decision that hangs can be interrupted, and an ADS that ends its
process must not end a worker: so a worker gives its scenarios to a process of its own, which it keeps for later tasks.
World and ADS travel as bytes, by value where workers cannot import them, and only until they are known there. A task is
an object that is run when it is unpickled: what only hands it on, as a scheduler does, needs nothing of this package.
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

from pytest_pafot.execution.captured_output import capture_output
from pytest_pafot.execution.pool import GRACE, ProcessLostError, WorkerPool
from pytest_pafot.execution.scenario_pool import Answer, ExecutionError, Job, LostRun, Timed, recovery_note, timed
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.support.versions import installed_versions
from pytest_pafot.world import protocol

INSTALL = "pip install 'pytest-pafot[dask]'"
TASK_SECONDS = 0.02
"""What a task should take, so that what it costs besides, a few milliseconds, is little of it [s]."""
MOST = 20
"""Scenarios of a task; one that takes longer than :data:`TASK_SECONDS` has a task of its own."""

IDLE = 60.0
"""After how long without a task the process of a worker ends [s]."""


@dataclass(frozen=True, slots=True)
class Parcel:
    """What any scenario runs with: two of the same digest are equal, also where one has left its content at home."""

    digest: str
    content: bytes | None = field(compare=False)  # world, ADS factory and what reads from runs
    patience: float = field(compare=False)  # of the processes of workers, see WorkerPool [s]
    versions: dict[str, str] = field(compare=False)  # of the session


Done = tuple[list[Timed | Exception], list[LostRun]]
"""What became of each scenario of a task, and processes that died in runs that came to their end at a second try."""


class ExecutorPool:
    """Runs scenarios by an executor, as :class:`pytest_pafot.execution.pool.WorkerPool` does by processes.

    A task that is lost with its worker says nothing of any of its scenarios: each is run once more by itself, and one
    that is lost again is answered by ``ProcessLostError``. Where it is the way to the workers that fails twice, the
    executor takes no tasks any more.

    Raises:
        ExecutionError: where world and ADS cannot travel; by :meth:`fetch`, where they cannot arrive.
    """

    def __init__(self, job: Job, executor: Executor) -> None:
        self.recovered: list[LostRun] = []
        """Processes and workers that died in runs that were done when they were tried again."""
        self.failure = ""
        """Why the executor takes no tasks any more, from which moment on none has a result; or empty."""
        self.unable: list[Exception] = []
        """What workers answered to scenarios that only the session can run, such as what a factory raised there."""
        self._executor = executor
        self._parcel = packed(job)
        self._is_known = False  # whether some worker has the content of the parcel
        self._under_way: dict[Scenario, tuple[Sequence[Scenario], Future[Any]]] = {}
        self._answers: dict[Scenario, Answer] = {}
        self._numbers = count()
        self._runs, self._seconds = 0, 0.0

    @property
    def notes(self) -> list[str]:
        """What made the runs, and which of them it could not make."""
        notes = [f"pafot_executor: {type(self._executor).__name__} made the runs of the generations"]
        if self.unable:
            first = f"{type(self.unable[0]).__name__}: {self.unable[0]}"
            notes = [f"pafot_executor: {len(self.unable)} runs were made in this process, since there: {first}"]
        if self.failure:
            notes = [f"pafot_executor: this process ran the scenarios, since no other could: {self.failure}"]
        return notes + list(map(recovery_note, self.recovered))

    def expect(self, scenarios: Iterable[Scenario]) -> None:
        """Begin with these; what was expected before and not fetched is of no interest any more."""
        self.close()
        size = max(1, min(MOST, round(self._runs * TASK_SECONDS / self._seconds))) if self._runs else 1
        to_come = iter(scenarios)
        while task := list(islice(to_come, size)):
            self._submit(task)

    def fetch(self, scenario: Scenario) -> Answer:
        """The answer to a scenario, once; waits for it.

        Raises:
            ExecutionError: where no worker can run any scenario as it is run here.
        """
        if scenario not in self._under_way and scenario not in self._answers:
            self._submit([scenario])
        error = self._gather(scenario)
        if error is not None and not self.failure:
            self._submit([scenario])
            again = self._gather(scenario)
            if isinstance(again, OSError):
                self.failure = f"{type(again).__name__}: {again}"
            elif again is not None and not self.failure:
                return _lost(scenario, again)
            else:
                self.recovered.append(_lost(scenario, error))
        return RuntimeError(self.failure) if self.failure else self._answers.pop(scenario)

    def close(self, *, at_once: bool = False) -> None:
        """Forget what is under way; the executor is the user's, and goes on."""
        for _, future in self._under_way.values():
            future.cancel()
        self._under_way, self._answers = {}, {}

    def _submit(self, scenarios: Sequence[Scenario]) -> None:
        if self.failure:
            return
        parcel = replace(self._parcel, content=None) if self._is_known else self._parcel
        named: dict[str, Any] = {}
        if type(self._executor).__module__.partition(".")[0] == "distributed":
            ids = "+".join(scenario.id for scenario in scenarios)
            named = {"key": f"pafot-{ids}-{self._parcel.digest}-{next(self._numbers)}", "pure": False}
        try:
            future = self._executor.submit(pickle.loads, pickle.dumps(_Call(_run_task, parcel, scenarios)), **named)
        except (RuntimeError, OSError) as error:  # it is broken, or was shut down
            self.failure = f"{type(error).__name__}: {error}"
        else:
            self._under_way |= dict.fromkeys(scenarios, (scenarios, future))

    def _gather(self, scenario: Scenario) -> Exception | None:
        """Wait for the answers to a scenario and all others of its task; by what error they are lost, or None."""
        while scenario in self._under_way:
            scenarios, future = self._under_way[scenario]
            try:
                done: Done | str | None = future.result()
            except Exception as error:  # noqa: BLE001  (of the machinery of whatever executor it is)
                # A task that did not come back says nothing of what it would have said. KilledWorker is of Dask.
                is_lost = isinstance(error, (BrokenExecutor, CancelledError, OSError))
                if not is_lost and type(error).__name__ != "KilledWorker":
                    expected = "workers that can run scenarios, with the same packages as this session"
                    received = f"received {type(error).__name__}: {error}"
                    raise ExecutionError(f"pafot_executor: expected {expected}, {received}") from None
                del self._under_way[scenario]  # The others are tried alone as well, once they are asked for.
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


@contextmanager
def dask_executor(address: str, *, timeout: float = 10.0) -> Iterator[Executor]:
    """The workers of a scheduler of Dask, which must answer within a time [s], as an executor.

    Raises:
        ExecutionError: where Dask is not installed, nobody answers at the address, or a worker has other versions.
    """
    try:
        from distributed import Client  # noqa: PLC0415  (not everybody has it)
    except ImportError:
        raise ExecutionError(f"--pafot-dask: expected the package distributed, received none; {INSTALL}") from None
    with ExitStack() as stack:
        try:
            client = stack.enter_context(Client(address, timeout=timeout, set_as_default=False))
            workers = client.run(pickle.loads, pickle.dumps(_Call(_difference, versions_here())))
        except Exception as error:  # noqa: BLE001  (of any network, and of workers that lack anything)
            raise ExecutionError(
                f"--pafot-dask={address}: expected a scheduler whose workers have the packages of this session, "
                f"received {type(error).__name__}: {error}"
            ) from None
        for difference in filter(None, workers.values()):
            raise ExecutionError(difference)
        yield client.get_executor()


def versions_here() -> dict[str, str]:
    """Of what decides how a run goes, and of Python."""
    return {"python": platform.python_version(), **installed_versions()}


def packed(job: Job) -> Parcel:
    """World and ADS of a job for workers elsewhere, with the modules of the user's project by value."""
    try:
        import cloudpickle  # noqa: PLC0415  (not everybody needs it)
    except ImportError:
        raise ExecutionError(f"pafot_executor: expected the package cloudpickle, received none; {INSTALL}") from None
    with ExitStack() as stack:
        # Loaded modules of the project, which no other machine is expected to have installed.
        for module in [each for each in list(sys.modules.values()) if _is_below(job.root, each)]:
            cloudpickle.register_pickle_by_value(module)
            stack.callback(cloudpickle.unregister_pickle_by_value, module)
        try:
            content = cloudpickle.dumps((job.world, job.ads, job.read))
        except Exception as error:  # noqa: BLE001  (whatever the objects of the user raise when they are pickled)
            raise ExecutionError(
                "pafot_executor: expected a world and an ADS factory that can travel to other machines, received one "
                f"that raises {type(error).__name__}: {error}; let the factory open what the ADS needs"
            ) from None
    digest = hashlib.sha256(content).hexdigest()[:16]
    return Parcel(digest, content, protocol.hang_limit(job.world) + GRACE, versions_here())


class _Call:
    """A call that takes place, and gives its result, where this object is unpickled."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self._call = function, arguments

    def __reduce__(self) -> tuple[Any, ...]:
        return self._call


class _Bench:
    """In a worker: the processes that have what a parcel holds, as many as there are tasks at the same time."""

    def __init__(self, parcel: Parcel) -> None:
        self.parcel = parcel
        self._idle: SimpleQueue[WorkerPool[Scenario, Timed]] = SimpleQueue()

    def run(self, scenarios: Sequence[Scenario]) -> Done | str:
        try:
            pool = self._idle.get_nowait()
        except Empty:
            multiprocessing.current_process().daemon = False  # Workers of Dask are daemons, which may have no child.
            work, patience = partial(_run, self.parcel), self.parcel.patience
            pool = WorkerPool(work, 1, method="spawn", patience=patience, idle=IDLE)
        pool.expect(scenarios)
        answers = [pool.fetch(scenario) for scenario in scenarios]
        recovered, pool.recovered = pool.recovered, []
        unable = next((each for each in answers if isinstance(each, ExecutionError)), None)
        if pool.failure or unable is not None:
            return f"pafot_executor: a worker at {_place()} cannot run the ADS: {pool.failure or unable}"
        self._idle.put(pool)
        return answers, recovered


def _run_task(parcel: Parcel, scenarios: Sequence[Scenario]) -> Done | str | None:
    """In a worker: run scenarios; or why it cannot run any, or None where it lacks the content of the parcel."""
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
    """The work of the process of a worker."""
    with capture_output() as output:
        world, ads, read = _unpacked(parcel)
        trace, seconds = timed(world, scenario, ads)
    with suppress(Exception):  # which is raised where somebody asks for it
        read(trace)
    return trace, output, seconds


@lru_cache(maxsize=1)
def _unpacked(parcel: Parcel) -> Any:
    try:
        return pickle.loads(parcel.content or b"")  # noqa: S301  (what the session has made)
    except Exception as error:  # noqa: BLE001  (whatever a user's module raises when it is imported)
        raise ExecutionError(f"expected the packages that it needs, received {type(error).__name__}: {error}") from None


def _difference(session: dict[str, str]) -> str:
    """In a worker: why it would not run a scenario as the session does, or empty."""
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


def _lost(scenario: Scenario, error: Exception) -> LostRun:
    return ProcessLostError(scenario, pid=0, how=f"was lost ({type(error).__name__})")
