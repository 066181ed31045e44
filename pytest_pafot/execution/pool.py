"""A pool of processes that run tasks, one each at a time, and name the task in which a process dies or falls silent.

Tried in its place: with loky 3.7.0 every task under way fails when one process dies, and nothing says which one it was.
pebble 5.2.3 says it, but forks the next process in a thread of its own, while another may hold a lock, and can limit
nothing but the duration of a task, so that a slow one ends like one that never comes back to Python. Here each process
has a pipe of its own, and the thread that asks serves them all.
"""

from __future__ import annotations

import gc
import math
import multiprocessing
import os
import pickle
import signal
import sys
import time
import traceback
import warnings
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Iterator
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass
from functools import partial
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Generic, Self, TypeAlias, TypeVar

from pytest_pafot.world.guard.hang_guard import LastResort, last_resort

TaskT = TypeVar("TaskT", bound=Hashable)
ResultT = TypeVar("ResultT")

GRACE = 5.0
"""How much longer than its limit one decision may take, or a process be silent, before it is ended [s]."""

IGNORED = 0.5
"""How long a decision in a process of its own may ignore its interruption: less, since only that process ends [s]."""

FAREWELL = 2.0
"""How long a process may take to end by itself [s]; what its libraries started ends with it then."""

OUT_OF_MEMORY = "ran out of the memory that it may take (--pafot-memory)"
"""How a process ended whose allocations failed where nobody could say so but itself."""

STUCK, EXHAUSTED = 1, 2
"""Why a process ended itself: a decision would not end, or it had no more memory."""

POLL = 0.5
"""How long to wait for answers at most before looking whether those who owe one still live [s]."""

LARGEST = 0x2020_2020 - 1
"""Bytes of an answer. A message begins with its length, and what an ADS prints into the pipe, whose descriptor it found
by chance, reads as more: the session would wait for so many bytes for ever."""

Work: TypeAlias = Callable[..., ResultT]
"""Runs a task in a process of the pool: it is called with the task, and with a function that can be told the share of
it that is done."""


class ProcessLostError(Exception, Generic[TaskT]):
    """What came of a task cannot be told: its process did not come back.

    ``how`` says in a few words how the process ended, ``is_hang`` whether it fell silent and was killed. A ``pid`` of 0
    stands for a worker of an executor, of which nobody knows more.
    """

    def __init__(self, task: TaskT, *, pid: int, how: str, is_hang: bool = False) -> None:
        self.who = f"process (pid {pid})" if pid else "worker"
        super().__init__(f"the {self.who} that ran {task!r} {how}")
        self.task = task
        self.pid = pid
        self.how = how
        self.is_hang = is_hang

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(ProcessLostError, self.task, pid=self.pid, how=self.how, is_hang=self.is_hang), ()


@dataclass(eq=False)
class WorkerPool(Generic[TaskT, ResultT]):
    """Up to so many processes, started as they are needed. To be used in a ``with`` statement.

    The answer to a task is its result, or an exception: what was raised, why the result cannot be sent, why there is no
    process to run it, or ``ProcessLostError``.

    Args:
        work: what every process does with each of its tasks. It must be possible to pickle tasks and results, and the
            work itself where processes are not forked.
        method: by which processes are started, see :mod:`multiprocessing`.
        patience: how long a process may run without answering a signal, as Python does between two instructions [s].
        grace: how much longer than its limit one decision of an ADS may take that ignores its interruption [s].
        memory: how many bytes more than it begins with a process may take, or None for any number. Beyond, allocations
            fail, in it and in what it starts, which has the same limit. It is held on Linux alone.
        idle: how long a process may wait for a task before it ends by itself [s], or None for ever.
        ended: told the id of each process of the pool when it has ended.
        clock: monotonic [s].
    """

    work: Work[ResultT]
    size: int
    _: KW_ONLY
    method: str
    patience: float
    grace: float = IGNORED
    memory: int | None = None
    idle: float | None = None
    ended: Callable[[int], None] = lambda pid: None
    clock: Callable[[], float] = time.monotonic

    def __post_init__(self) -> None:
        self.recovered: list[ProcessLostError[TaskT]] = []
        """Processes that died in tasks that were done when they were tried alone."""
        self.failure = ""
        """Why no process could be started, from which moment on no task has a result; or empty."""
        self._context: Any = multiprocessing.get_context(self.method)
        self._workers: list[_Worker[TaskT]] = []
        self._looked_at = -math.inf  # when all processes were looked at, those that say nothing included
        self._pending: deque[TaskT] = deque()
        self._wanted: set[TaskT] = set()
        self._answers: dict[TaskT, ResultT | Exception] = {}
        self._suspects: dict[TaskT, ProcessLostError[TaskT]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        self.close(at_once=kind is not None)

    def expect(self, tasks: Iterable[TaskT]) -> None:
        """Begin with these, in this order; what was expected before and not fetched is of no interest any more.

        Tasks that are made as they are read take no time from those before them.
        """
        self._pending, self._wanted = deque(), set()
        self._answers, self._suspects = {}, {}
        for task in tasks:
            self._wanted.add(task)
            self._pending.append(task)
            self._send()

    def fetch(self, task: TaskT) -> ResultT | Exception:
        """The answer to a task, once; waits for it. One that was not expected is run next.

        A task in which a process died is tried once more while nothing else runs: there may have been too little
        memory for all of them, or somebody killed the process.
        """
        if task not in self._wanted:
            self._wanted.add(task)
            self._pending.appendleft(task)
        self._send()
        while task not in self._answers:
            if task in self._suspects:
                self._answers[task] = self._alone(task)
            else:
                self._receive()
            self._send()
        self._wanted.discard(task)
        return self._answers.pop(task)

    def completed(self, tick: Callable[[float], None]) -> Iterator[tuple[TaskT, ResultT | Exception]]:
        """Each expected task with its answer, as soon as that is there; none is tried twice.

        Every now and then, ``tick`` is told the sum of the shares that are done of the tasks under way.
        """
        while self._wanted:
            self._receive()
            self._send()
            tick(sum(worker.share for worker in self._busy))
            answers = self._answers | self._suspects
            self._answers, self._suspects = {}, {}
            for task, answer in answers.items():
                self._wanted.discard(task)
                yield task, answer

    def close(self, *, at_once: bool = False) -> None:
        """End all processes; those that are at work are killed, and ``at_once`` all of them."""
        idle = [] if at_once else [worker for worker in self._workers if worker.task is None]
        deadline = self.clock() + FAREWELL
        for worker in [worker for worker in idle if worker.send(None)]:
            worker.process.join(max(0.0, deadline - self.clock()))
        for worker in list(self._workers):
            self._remove(worker)
        self._pending, self._wanted = deque(), set()

    @property
    def _busy(self) -> list[_Worker[TaskT]]:
        return [worker for worker in self._workers if worker.task is not None]

    def _alone(self, task: TaskT) -> ResultT | Exception:
        while self._busy:
            self._receive()
        first = self._suspects.pop(task)
        self._give(task)
        while task not in self._answers and task not in self._suspects:
            self._receive()
        second = self._suspects.pop(task, None) or self._answers[task]
        if not isinstance(second, ProcessLostError):
            self.recovered.append(first)
        return second

    def _send(self) -> None:
        while self._pending and (self.failure or len(self._busy) < self.size):
            self._give(self._pending.popleft())

    def _give(self, task: TaskT) -> None:
        if self.failure:
            self._fail(task, self.failure)
            return
        idle = next((worker for worker in self._workers if worker.task is None), None)
        try:
            while idle is None or not idle.take(task, self.clock()):
                if idle is not None:  # It ended between two tasks: nobody's doing.
                    self._remove(idle)
                others = [worker.connection for worker in self._workers]
                idle = _Worker(self._context, self.work, others, self.grace, self.memory, self.idle)
                self._workers.append(idle)
        except OSError as error:
            self._fail(task, str(error))

    def _fail(self, task: TaskT, reason: str) -> None:
        """Without processes, whoever asks must see to the tasks."""
        self.failure = reason
        self._answers[task] = RuntimeError(reason)

    def _receive(self) -> None:
        """Take what is there, after a while at most; those that say nothing are looked at every now and then."""
        busy, now_and_then = self._busy, min(POLL, self.patience / 4)
        ready = wait([worker.connection for worker in busy], timeout=now_and_then)
        is_time = not ready or self.clock() - self._looked_at >= now_and_then
        if is_time:
            self._looked_at = self.clock()
        for worker in busy:
            is_heard = worker.connection in ready
            if is_heard or is_time:
                self._look_at(worker, is_heard=is_heard)

    def _look_at(self, worker: _Worker[TaskT], *, is_heard: bool) -> None:
        task, is_gone = worker.task, not worker.process.is_alive()  # In this order: what it sent last is there now.
        if task is None:
            return
        if is_heard or worker.connection.poll():
            heard = worker.hear()
            if heard is not None:
                is_done, said = heard
                if is_done and task in self._wanted:
                    self._answers[task] = said
                return
            is_gone = True
        if worker.gave_up.value == EXHAUSTED:
            self._lose(task, worker, OUT_OF_MEMORY)
        elif worker.gave_up.value == STUCK:
            how = f"ignored the interruption of a decision for {self.grace:.1f} s and was ended"
            self._lose(task, worker, how, is_hang=True)
        elif is_gone:
            is_garbled = not worker.connection.readable  # since what it said is longer than any answer
            how = "wrote into the pipe to the session, by a descriptor that it did not open, and was ended"
            self._lose(task, worker, how if is_garbled else "")
        elif worker.silence(self.clock()) > self.patience:
            self._lose(task, worker, f"did not answer for {self.patience:.1f} s and was killed", is_hang=True)

    def _lose(self, task: TaskT, worker: _Worker[TaskT], how: str = "", *, is_hang: bool = False) -> None:
        self._remove(worker)
        lost = ProcessLostError(task, pid=worker.pid, how=how or ending(worker.process.exitcode), is_hang=is_hang)
        if not worker.has_begun:
            self._fail(task, self.failure or f"a process {lost.how} before it had begun")
        elif task in self._wanted:
            (self._answers if is_hang else self._suspects)[task] = lost

    def _remove(self, worker: _Worker[TaskT]) -> None:
        """End a process and let nothing of it remain, nor, on Linux, of what it has started."""
        _end_children(worker.pid)
        worker.process.kill()
        worker.process.join()
        worker.connection.close()
        self._workers.remove(worker)
        self.ended(worker.pid)


class _Worker(Generic[TaskT]):
    """One process, as the pool sees it: ``share`` is what it says is done of its task, where it has one."""

    def __init__(
        self,
        context: Any,
        work: Work[Any],
        others: list[Connection],
        grace: float,
        memory: int | None,
        idle: float | None,
    ) -> None:
        self.task: TaskT | None = None
        self.share = 0.0
        self.gave_up = context.RawValue("b", 0)  # why it ended itself, where it did
        self._beats = context.RawValue("Q", 0)
        self.connection, end = context.Pipe()
        self._heard = 0
        self._asked_at: float | None = None
        inherited = [*others, self.connection] if context.get_start_method() == "fork" else []
        arguments = (work, end, inherited, self._beats, self.gave_up, grace, memory, idle)
        # As a daemon it is ended, and not waited for, where a worker of an executor ends that has it.
        self.process = context.Process(target=_serve, args=arguments, name="pafot-worker", daemon=True)
        with warnings.catch_warnings():
            # Python warns of any thread; those of numerical libraries are documented, and this module has none.
            warnings.filterwarnings("ignore", message=".*multi-threaded.*fork", category=DeprecationWarning)
            self.process.start()
        self.pid = int(self.process.pid)
        end.close()

    @property
    def has_begun(self) -> bool:
        """Whether it came so far as to wait for tasks."""
        return bool(self._beats.value)

    def take(self, task: TaskT, now: float) -> bool:
        """Run a task; False where the process has ended."""
        self.share, self._asked_at = 0.0, None if self.has_begun else now
        self.task = task if self.send(task) else None
        return self.task is not None

    def send(self, task: TaskT | None) -> bool:
        """Give it a task, or None for its end; False where the process has ended."""
        try:
            self.connection.send_bytes(pickle.dumps(task))
        except OSError:
            return False
        return True

    def hear(self) -> tuple[bool, Any] | None:
        """Whether its task is done, and the result, or else the share that is; None where it ended before."""
        try:
            is_done, said = pickle.loads(self.connection.recv_bytes(LARGEST))  # noqa: S301  (of a process of this one)
        except (EOFError, OSError):
            return None
        except Exception as error:  # noqa: BLE001  (made of what cannot be had here)
            expected = "expected a result that can be read in the session, received one that raises there"
            is_done, said = True, RuntimeError(f"{expected} {type(error).__name__}: {error}")
        if is_done:
            self.task = None
        else:
            self.share = said
        return is_done, said

    def silence(self, now: float) -> float:
        """Since when it owes an answer to a signal [s]; sends one where it owes none."""
        if self._beats.value != self._heard:
            self._heard, self._asked_at = self._beats.value, None
        if self._asked_at is not None:
            return now - self._asked_at
        if hasattr(signal, "SIGUSR2"):
            self._asked_at = now
            with suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGUSR2)
        return 0.0


def ending(code: int | None) -> str:
    """How a process ended by itself, by its exit code."""
    if code is not None and code < 0:
        with suppress(ValueError):
            return f"was ended by {signal.Signals(-code).name}"
    return f"ended with exit code {code}"


def _end_children(pid: int) -> None:
    """End what a process has started, in groups of its own too. While it lives, their ids are nobody else's."""
    for listed in Path(f"/proc/{pid}/task").glob("*/children"):
        with suppress(OSError):
            for child in map(int, listed.read_text("utf-8").split()):
                _end_children(child)
                with suppress(OSError):
                    os.kill(child, signal.SIGKILL) if os.getpgid(child) != child else os.killpg(child, signal.SIGKILL)


def _serve(
    work: Work[Any],
    connection: Connection,
    inherited: list[Connection],
    beats: Any,
    gave_up: Any,
    grace: float,
    memory: int | None,
    idle: float | None,
) -> None:
    """In a process of the pool: run tasks until there are no more, or nobody waits for them.

    ``beats`` counts that it has begun, and the signals that it answers.
    """

    def tell(share: float) -> None:
        connection.send((False, share))

    def beat(*signalled: object) -> None:
        beats.value += 1

    def end(why: int = STUCK) -> None:
        gave_up.value = why
        time.sleep(2 * POLL)  # The pool ends it meanwhile, and what it has started, which it would leave behind.
        os._exit(1)

    gc.freeze()  # Else it would look for garbage in its copy of all that is in the session, and so make that copy.
    for other in inherited:
        other.close()  # Else nobody would see the end of the session, or of another process, while this one lives.
    multiprocessing.current_process().daemon = False  # An ADS may have processes of its own.
    # The session ends its processes itself. What they start is interrupted: it would inherit SIG_IGN, but no function.
    signal.signal(signal.SIGINT, lambda number, frame: None)
    if hasattr(signal, "SIGUSR2"):
        signal.signal(signal.SIGUSR2, beat)
    beat()
    if memory is not None:
        _limit_memory(memory)
    with last_resort(LastResort(end=end, grace=grace)), suppress(EOFError, OSError):
        while connection.poll(idle) and (task := connection.recv()) is not None:
            try:
                said = _sendable(work(task, tell))
            except MemoryError:  # To repeat it in the session would take the memory of the session.
                end(EXHAUSTED)
                return
            except BaseException as error:  # noqa: BLE001  (nothing is lost: it is raised again where that can be seen)
                said = pickle.dumps((True, _portable(error)))
            connection.send_bytes(said)


def _sendable(result: object) -> bytes:
    try:
        return pickle.dumps((True, result))
    except MemoryError:
        raise
    except Exception as error:
        raise RuntimeError(
            "expected a result that can be sent to the session, received one that cannot be pickled: "
            f"{type(error).__name__}: {error}; let the ADS return plain numbers"
        ) from error


def _limit_memory(more: int) -> None:
    """Let allocations of this process fail once it has so many bytes more than now.

    What counts is the memory that it could write to and shares with nobody: not the address space that CUDA and
    allocators reserve, nor the code of libraries. Only Linux counts like that.
    """
    if sys.platform != "linux":
        return
    import resource  # noqa: PLC0415  (not there on Windows)

    now = int(Path("/proc/self/statm").read_text("ascii").split()[5]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    most = min(now + more, sys.maxsize if soft == resource.RLIM_INFINITY else soft)
    resource.setrlimit(resource.RLIMIT_DATA, (most, hard))


def _portable(error: BaseException) -> Exception:
    """The error with its traceback as a note; where it cannot be sent to another process, one that says the same."""
    worded = RuntimeError("".join(traceback.format_exception_only(error)).strip())
    told = error if isinstance(error, Exception) else worded
    try:
        pickle.loads(pickle.dumps(told))  # noqa: S301  (what this very process has made)
    except Exception:  # noqa: BLE001  (whatever somebody's error does when it is pickled)
        told = worded
    told.add_note("In a worker:\n" + "".join(traceback.format_exception(error)))  # Its own traceback does not travel.
    return told
