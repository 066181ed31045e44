"""A pool of processes that identifies the task in which a process dies or hangs.

The answer to a task is one of three values: `Done` with its result, `Lost` if its process died or hung, or `RunItHere`
if no process could run it. A process has one of the states of `WorkerState`::

              task               answer
    STARTED --------->  BUSY  ----------->  IDLE
                         | ^                 |
       dies in its task  | |      task       |
      .------------------+ '-----------------+
      |                  | silent or stuck   | ends between two tasks, so no task is the cause
      v                  v                   v
    DEAD               HUNG               (removed)

`DEAD` and `HUNG` are final: the process is removed, and its task is lost or tried a second time. If the process died
before it was ready, no process can run the task, and the answer is `RunItHere`. A task that nobody waits for any more
has no answer.
"""

from __future__ import annotations

import faulthandler
import gc
import math
import multiprocessing
import os
import pickle
import select
import signal
import sys
import threading
import time
import traceback
import warnings
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import KW_ONLY, dataclass
from enum import Enum, IntEnum
from functools import partial
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Generic, Self, TypeAlias, TypeVar, assert_never

from pytest_pafot.support import monotonic
from pytest_pafot.support.errors import OutOfTime
from pytest_pafot.support.process import bound_to
from pytest_pafot.world.guard.hang_guard import LastResort, check_time, last_resort

TaskT = TypeVar("TaskT", bound=Hashable)
ResultT = TypeVar("ResultT")

# Forked processes have the factory and its fixtures. System libraries of platforms other than Linux do not survive a
# fork, so the factory must be picklable there.
START_METHOD = "fork" if sys.platform == "linux" else "spawn"

# additional time for a decision after its limit, or for a process that does not respond [s]
GRACE = 5.0
# additional time for a decision that ignores its interrupt; only the process ends, not the session [s]
IGNORED = 0.5
# time in which a process can end normally, together with its own child processes [s]
FAREWELL = 2.0

# How a process ended. These words must not change, because findings store them.
KILLED = "was ended by SIGKILL"  # by something else, such as Linux when memory runs out
OUT_OF_MEMORY = "ran out of the memory that it may use"
WORLD_HANGS = "was ended, because its world neither asked the ADS nor ended the run for very long"

POLL = 0.5  # longest time between two checks that busy processes are alive [s]

# A message starts with its length. If an ADS prints into the pipe, because it happens to use the descriptor, four
# characters are read as a length. The session would wait for as many bytes. The smallest such length is four spaces.
LARGEST = 0x2020_2020 - 1  # largest size of an answer [bytes]

# A function that runs a task. Its second argument is a function that sends messages before the answer.
Work: TypeAlias = Callable[..., Any]


class ProcessLostError(Exception, Generic[TaskT]):
    """An error for a task that has no result, because its process died or hung.

    Args:
        task: the task.
        pid: the id of the process, or 0 for a worker on another machine.
        how: a description of how the process ended, or the exit code.
        is_hang: True if the process hung.
    """

    def __init__(
        self, task: TaskT, *, pid: int, how: str | int | None, is_hang: bool = False
    ) -> None:
        self.who = f"process (pid {pid})" if pid else "worker"
        self.end = how if isinstance(how, str) else ending(how)
        super().__init__(f"the {self.who} that ran {task} {self.end}")
        self.task = task
        self.pid = pid
        self.is_hang = is_hang

    @property
    def advice(self) -> str:
        return (
            f"expected a policy that drives to the end of the run, received one whose process {self.end}. Does it call "
            'sys.exit or os._exit, or does its compiled code crash? See the page "Test your own planner"'
        )

    @property
    def recovery(self) -> str:
        return (
            f"a {self.who} {self.end} while it ran {self.task}, which succeeded when it was run again. There may be "
            "too little memory for so many workers, or something else killed the process"
        )

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(
            ProcessLostError, self.task, pid=self.pid, how=self.end, is_hang=self.is_hang
        ), ()


@dataclass(frozen=True, slots=True)
class Done(Generic[ResultT]):
    """The answer of a process that finished its task."""

    value: ResultT


@dataclass(frozen=True, slots=True)
class Lost(Generic[TaskT]):
    """The answer to a task whose process died or hung. The task must not run in the session's process."""

    death: ProcessLostError[TaskT]


@dataclass(frozen=True, slots=True)
class RunItHere:
    """The answer to a task that raised an error, or that no process could run. The caller may run it itself."""

    error: Exception


Answer: TypeAlias = Done[Any] | Lost[Any] | RunItHere


@dataclass(frozen=True, slots=True)
class Said:
    """A message that the process of a followed task sent before its answer."""

    value: Any


class _ReasonToEnd(IntEnum):
    # Why a process ended itself. The number is in memory that it shares with the session.

    NONE = 0
    STUCK = 1
    EXHAUSTED = 2
    WORLD_STUCK = 3


class WorkerState(Enum):
    """The states of a process. Only `_Worker` sets the first three, and only `WorkerPool._lose` the others."""

    STARTED = "started, without a task so far"
    IDLE = "waits for a task"
    BUSY = "runs a task"
    DEAD = "died in a task"
    HUNG = "did not return from a task"


@dataclass(eq=False)
class WorkerPool(Generic[TaskT]):
    """A pool of up to ``size`` processes, which start on demand. Use the pool in a ``with`` statement.

    Args:
        work: the function that runs a task. Tasks and results must be picklable. If processes are not forked, ``work``
            must be picklable, too.
        size: the largest number of processes.
        method: the start method of the processes, as in :mod:`multiprocessing`.
        patience: the time [s] after which a process that does not answer a signal is killed.
        grace: the additional time [s] for a decision that ignores its interrupt.
        idle: the time [s] after which an idle process ends, or None.
        ended: a function to call with the id of each process that has ended.
        leave: a function, or None. Each process calls it before it ends, unless it is killed.
        left: a function to call with the result of ``leave``.
        farewell: the time [s] in which a process can end normally.
        clock: a monotonic clock [s].
    """

    work: Work
    size: int
    _: KW_ONLY
    method: str = START_METHOD
    patience: float
    grace: float = IGNORED
    idle: float | None = None
    ended: Callable[[int], None] = lambda pid: None
    leave: Callable[[], Any] | None = None
    left: Callable[[Any], None] = lambda said: None
    farewell: float = FAREWELL
    clock: Callable[[], float] = monotonic

    def __post_init__(self) -> None:
        # The process deaths in tasks whose second attempt succeeded.
        self.recovered: list[ProcessLostError[TaskT]] = []
        self.failure = ""  # why no process can be started, or empty
        self._has_lost = False  # whether a process has died
        self._context: Any = multiprocessing.get_context(self.method)
        self._workers: list[_Worker[TaskT]] = []
        self._looked_at = -math.inf  # when all processes, including silent ones, were last checked
        self._pending: deque[TaskT] = deque()
        self._wanted: set[TaskT] = set()
        self._followed: set[TaskT] = set()
        self._said: list[tuple[TaskT, Said | Answer]] = []
        self._answers: dict[TaskT, Answer] = {}
        # The first deaths in tasks that are tried a second time.
        self._suspects: dict[TaskT, Lost[TaskT]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        self.close(at_once=kind is not None)

    def expect(self, tasks: Iterable[TaskT]) -> None:
        """Start these tasks in order, and drop earlier tasks whose answers were not fetched."""
        self._forget()
        # An answer to an earlier announcement must not serve a new one with the same task.
        self._answers, self._suspects = {}, {}
        self.add_all(tasks)

    def _forget(self) -> None:
        self._pending = deque()
        self._wanted = set()
        self._followed = set()
        self._said = []

    def add_all(self, tasks: Iterable[TaskT]) -> None:
        for task in tasks:
            # A task that runs already is not sent again, so its answer serves all who ask.
            if task not in self._wanted:
                self._wanted.add(task)
                self._pending.append(task)
            self._send()

    def add_first(self, tasks: Iterable[TaskT]) -> None:
        new = [task for task in tasks if task not in self._wanted]
        # Someone waits for them, so they overtake tasks that were only announced.
        self._wanted.update(new)
        self._pending.extendleft(reversed(new))
        self._send()

    def follow(self, task: TaskT) -> None:
        """Add a task, so that :meth:`messages` returns what its process says, and then its answer."""
        self._followed.add(task)
        self.add_all([task])

    def messages(self, *, waits: bool) -> list[tuple[TaskT, Said | Answer]]:
        """Return the messages and answers of followed tasks, in the order of arrival.

        If ``waits`` is true, wait for at least one. Otherwise, the list may be empty.

        Raises:
            OutOfTime: if the search has run out of time. By then, all processes have ended.
        """
        while waits and not self._said:
            self._receive()
            self._send()
        said = self._said
        self._said = []
        return said

    def fetch(self, task: TaskT) -> Answer:
        """Wait for the answer to a task. An answer can be fetched only once.

        Raises:
            OutOfTime: if the search has run out of time. By then, all processes have ended.
        """
        # A process may be killed because all processes together use too much memory, so its task is tried again while
        # no other task runs. Any other death counts only if a second process dies as well.
        self.add_first([task])
        first: list[Lost[TaskT]] = []
        while task not in self._answers:
            if task not in self._suspects:
                self._receive()
            elif self._suspects[task].death.end == KILLED:
                self._answers[task] = self._alone(task)
            elif first:
                self._answers[task] = self._suspects.pop(task)
            else:
                first.append(self._suspects.pop(task))
                self._pending.appendleft(task)
            self._send()
        self._wanted.discard(task)
        answer = self._answers.pop(task)
        if not isinstance(answer, Lost):
            self.recovered += [each.death for each in first]
        return answer

    def completed(self) -> Iterator[tuple[TaskT, Answer]]:
        """Yield each task with its answer as soon as the answer is available. No task is tried twice."""
        # Tasks whose process died are among the answers, so the loop ends even if all die.
        while self._wanted:
            self._receive()
            self._send()
            answers = self._answers | self._suspects
            self._answers, self._suspects = {}, {}
            for task, answer in answers.items():
                self._wanted.discard(task)
                yield task, answer

    def close(self, *, at_once: bool = False) -> None:
        """End all processes. Idle processes are killed only if ``at_once`` is set."""
        has_leave = self.leave is not None
        ending = [
            each
            for each in self._workers
            if (has_leave or not at_once) and each.leaves(interrupted=has_leave)
        ]
        # All processes share one deadline, so the end of the pool does not take longer with more processes.
        deadline = self.clock() + self.farewell
        try:
            for worker in ending:
                if has_leave:
                    for left in worker.farewell(deadline, self.clock):
                        self.left(left.said)
                worker.process.join(max(0.0, deadline - self.clock()))
        finally:  # also after another interrupt
            for worker in list(self._workers):
                self._remove(worker)
            self._pending, self._wanted = deque(), set()

    @property
    def _busy(self) -> list[_Worker[TaskT]]:
        return [worker for worker in self._workers if worker.state is WorkerState.BUSY]

    def _alone(self, task: TaskT) -> Answer:
        while self._busy:
            self._receive()
        first = self._suspects.pop(task)
        self._give(task)
        while task not in self._answers and task not in self._suspects:
            self._receive()
        if task in self._suspects:
            return self._suspects.pop(task)
        answer = self._answers[task]
        if not isinstance(answer, Lost):
            self.recovered.append(first.death)
        return answer

    def _send(self) -> None:
        while self._pending and (self.failure or len(self._busy) < self.size):
            self._give(self._pending.popleft())

    def _give(self, task: TaskT) -> None:
        if self.failure:
            self._fail(task, self.failure)
            return
        try:
            free = (WorkerState.STARTED, WorkerState.IDLE)
            for idle in [each for each in self._workers if each.state in free][:1]:
                if idle.take(task, self.clock()):
                    return
                self._remove(idle)  # It ended between two tasks, so no task is the cause.
            # Processes start here, on demand.
            while not self._start().take(task, self.clock()):
                self._remove(self._workers[-1])
        except OSError as error:
            self._fail(task, str(error))

    def _start(self) -> _Worker[TaskT]:
        others = [worker.connection for worker in self._workers]
        work = self.work
        if self._has_lost:  # after a death, faulthandler is off in new processes
            work = partial(_quietly, work)
        worker = _Worker[TaskT](
            self._context, work, others, self.grace, self.idle, self.leave, self.farewell
        )
        self._workers.append(worker)
        return worker

    def _fail(self, task: TaskT, reason: str) -> None:
        self.failure = reason
        self._answer(task, RunItHere(RuntimeError(reason)))

    def _answer(self, task: TaskT, answer: Answer) -> None:
        if task in self._followed:
            # Its answer is its last message.
            self._followed.discard(task)
            self._wanted.discard(task)
            self._said.append((task, answer))
        else:
            self._answers[task] = answer

    def _receive(self) -> None:
        try:
            check_time()
        except OutOfTime:
            self.close(at_once=True)
            raise
        # Several checks must fit into the patience.
        busy, now_and_then = self._busy, min(POLL, self.patience / 4)
        ready = wait([worker.connection for worker in busy], timeout=now_and_then)
        # Processes that talk all the time must not keep this one from noticing a silent one.
        is_time = not ready or self.clock() - self._looked_at >= now_and_then
        if is_time:
            self._looked_at = self.clock()
        for worker in busy:
            is_heard = worker.connection in ready
            if is_heard or is_time:
                self._look_at(worker, is_heard=is_heard)

    def _look_at(self, worker: _Worker[TaskT], *, is_heard: bool) -> None:
        # The process is checked before the pipe is read. If it has ended, its last answer is in the pipe by then.
        if worker.state is not WorkerState.BUSY:
            return
        # A process that is found alive here may die before the pipe is read. The next check then finds it.
        is_gone = not worker.process.is_alive()
        task = worker.task
        if is_heard or worker.connection.poll():
            match worker.hear():
                case _Gone():
                    is_gone = True
                case _Left() as left:
                    self._has_left(task, worker, left)
                    return
                case Said() as said:
                    if task in self._followed:
                        self._said.append((task, said))
                    return
                case Done() | Lost() | RunItHere() as answer:
                    if task in self._wanted:
                        self._answer(task, answer)
                    return
                case other:
                    assert_never(other)
        # The process sent nothing, so find out why. If it gave a reason itself, that counts, even if it is dead by now.
        match worker.gave_up.value:
            case _ReasonToEnd.EXHAUSTED:
                self._lose(worker, WorkerState.DEAD, OUT_OF_MEMORY)
            case _ReasonToEnd.WORLD_STUCK:
                self._lose(worker, WorkerState.HUNG, WORLD_HANGS)
            case _ReasonToEnd.STUCK:
                how = f"ignored the interrupt of a decision for {self.grace:.1f} s and was ended"
                self._lose(worker, WorkerState.HUNG, how)
            case _ if is_gone and worker.connection.readable:
                self._lose(worker, WorkerState.DEAD)
            case _ if is_gone:
                # the pipe was closed by a message above the largest size
                how = "wrote into the pipe to the session, by a descriptor that it did not open, and was ended"
                self._lose(worker, WorkerState.DEAD, how)
            case _ if worker.silence(self.clock()) > self.patience:
                how = f"did not answer for {self.patience:.1f} s and was killed"
                self._lose(worker, WorkerState.HUNG, how)

    def _has_left(self, task: TaskT, worker: _Worker[TaskT], left: _Left) -> None:
        self.left(left.said)
        # The pool interrupts tasks only in `close`, which reads the last messages itself. Somebody else ended this
        # process.
        if left.in_task:
            self._lose(worker, WorkerState.DEAD, ending(-signal.SIGTERM))
            return
        self._remove(worker)
        # The process ended between two tasks, while this one was on its way.
        if task in self._wanted:
            self._give(task)

    def _lose(self, worker: _Worker[TaskT], state: WorkerState, how: str = "") -> None:
        # Without ``how``, the exit code describes the end, which is known once the process is removed.
        task = worker.task
        worker.state = state
        self._remove(worker)
        self._has_lost = True
        is_hang = state is WorkerState.HUNG
        death = ProcessLostError(
            task, pid=worker.pid, how=how or worker.process.exitcode, is_hang=is_hang
        )
        # A process that dies before its first task was not killed by a task, and the next process would die, too.
        if not worker.has_begun:
            self._fail(task, self.failure or f"a process {death.end} before its first task")
        elif task in self._wanted and (is_hang or task in self._followed):
            self._answer(task, Lost(death))
        elif task in self._wanted:
            self._suspects[task] = Lost(death)

    def _remove(self, worker: _Worker[TaskT]) -> None:
        # End the children first, because their ids cannot be reused as long as their parent exists.
        children = _end_children(worker.pid)
        worker.process.kill()
        worker.process.join()
        worker.connection.close()
        self._workers.remove(worker)
        # The children may be processes of the worker's own pool.
        for pid in (*children, worker.pid):
            self.ended(pid)


class _Worker(Generic[TaskT]):
    def __init__(
        self,
        context: Any,
        work: Work,
        others: list[Connection],
        grace: float,
        idle: float | None,
        leave: Callable[[], Any] | None,
        farewell: float,
    ) -> None:
        self.state = WorkerState.STARTED
        self._task: TaskT
        self.gave_up = context.RawValue("b", _ReasonToEnd.NONE)  # why it ended itself
        self._beats = context.RawValue("Q", 0)
        self.connection, end = context.Pipe()
        self._heard = 0
        self._asked_at: float | None = None
        # A forked process inherits these pipes, and has to close them.
        inherited = [*others, self.connection] if context.get_start_method() == "fork" else []
        # A process with `leave` needs time before its end. One that another thread started would end with the thread.
        is_bound = leave is None and threading.current_thread() is threading.main_thread()
        patience: float | None = None
        if not is_bound:
            patience = farewell if leave else 0.0
        arguments = (work, end, inherited, self._beats, self.gave_up, grace, idle, leave, patience)
        # The process is a daemon, so that a cluster's worker that ends kills the process instead of waiting for it.
        self.process = context.Process(
            target=_serve, args=arguments, name="pafot-worker", daemon=True
        )
        with warnings.catch_warnings(), _blocked({signal.SIGINT}, context.get_start_method()):
            # Python warns about any thread. This module starts none, and the threads of libraries are documented.
            warnings.filterwarnings(
                "ignore", message=".*multi-threaded.*fork", category=DeprecationWarning
            )
            self.process.start()
        self.pid = int(self.process.pid)
        end.close()

    @property
    def has_begun(self) -> bool:
        return bool(self._beats.value)

    @property
    def task(self) -> TaskT:
        """The task that a busy process runs."""
        assert self.state is WorkerState.BUSY, self.state  # noqa: S101
        return self._task

    def take(self, task: TaskT, now: float) -> bool:
        # The result is False if the process has ended.
        # A process that has not begun cannot answer a signal, so the time for its start counts as silence.
        self._asked_at = None
        if not self.has_begun:
            self._asked_at = now
        if not self.send(task):
            return False
        self._task = task
        self.state = WorkerState.BUSY
        return True

    def send(self, task: TaskT | None) -> bool:
        try:
            self.connection.send_bytes(pickle.dumps(task))
        except OSError:
            return False
        return True

    def leaves(self, *, interrupted: bool) -> bool:
        # Ask the process to end. The result is False if it must not be interrupted or has already ended.
        is_busy = self.state is WorkerState.BUSY
        if is_busy and not interrupted:
            return False
        # None is no task, and asks the process to end by itself.
        is_asked = self.send(None)
        if is_busy and sys.platform != "win32" and self.process.is_alive():
            os.kill(self.pid, signal.SIGTERM)
        return is_asked

    def farewell(self, deadline: float, clock: Callable[[], float]) -> Iterator[_Left]:
        # Yield the last message of the process, if it arrives before the deadline.
        while self.connection.readable and self.connection.poll(max(0.0, deadline - clock())):
            match self.hear():
                case _Gone():
                    return
                case _Left() as left:
                    yield left
                    return

    def hear(self) -> Answer | Said | _Left | _Gone:
        try:
            heard: Answer | Said | _Left = pickle.loads(self.connection.recv_bytes(LARGEST))  # noqa: S301  (from a child process)
            # The user's code may have written into the pipe.
            if not isinstance(heard, Done | Lost | RunItHere | Said | _Left):
                raise TypeError(f"expected an answer, received {heard!r:.100}")
        except (EOFError, OSError):
            return _Gone()
        except Exception as error:  # noqa: BLE001  (unpickling the user's objects may raise anything)
            expected = (
                "expected a result that can be unpickled in the session, received one that raises"
            )
            heard = RunItHere(RuntimeError(f"{expected} {type(error).__name__}: {error}"))
        if isinstance(heard, (Done, RunItHere)):
            self.state = WorkerState.IDLE
        return heard

    def silence(self, now: float) -> float:
        # The time [s] for which the process has not answered a signal.
        # Each signal that the process answers adds one to the beats.
        if self._beats.value != self._heard:
            self._heard, self._asked_at = self._beats.value, None
        if self._asked_at is not None:
            return now - self._asked_at
        if hasattr(signal, "SIGUSR2"):
            self._asked_at = now
            # If the process has ended, the next check of the pool finds it.
            with suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGUSR2)
        return 0.0


@dataclass(frozen=True, slots=True)
class _Left:
    # The last message of a process: the result of its `leave`, and whether it was interrupted in a task.

    said: Any
    in_task: bool


@dataclass(frozen=True, slots=True)
class _Gone:
    # Nothing more can be heard from a process, because its end of the pipe is closed.
    pass


def ending(code: int | None) -> str:
    """Describe how a process with this exit code ended, for example ``was ended by SIGKILL``."""
    if code is not None and code < 0:
        # A number that is no signal of this platform is described as an exit code.
        with suppress(ValueError):
            return f"was ended by {signal.Signals(-code).name}"
    return f"ended with exit code {code}"


def _end_children(pid: int) -> list[int]:
    # Kill all descendants of a process, which must still exist, and return their ids.
    ended: list[int] = []
    # On systems without /proc, only the process itself is ended.
    for listed in Path(f"/proc/{pid}/task").glob("*/children"):
        with suppress(OSError):
            for child in map(int, listed.read_text("utf-8").split()):
                ended += [*_end_children(child), child]
                with suppress(OSError):
                    # A child that leads a process group, such as a shell, is killed together with its group.
                    if os.getpgid(child) == child:
                        os.killpg(child, signal.SIGKILL)
                    else:
                        os.kill(child, signal.SIGKILL)
                    descriptor = os.pidfd_open(child)
                    select.select([descriptor], [], [], POLL)  # until its files are closed
                    os.close(descriptor)
    return ended


def _end_with_session(patience: float | None) -> None:
    """Make this process end when the session ends, regardless of policies and their threads.

    If ``patience`` is None, Linux kills the process immediately. Otherwise, the process is interrupted, and ended after
    ``patience`` [s].
    """
    session: Any = multiprocessing.parent_process()
    main, pid = threading.get_ident(), os.getpid()

    # This applies only to children of the main thread, because the signal is sent when the thread of a child ends.
    def bind_child() -> None:
        if threading.get_ident() == main and os.getppid() == pid:
            bound_to(pid, signal.SIGKILL)

    def watch() -> None:
        # a process of a policy may keep the pipe open
        while session.is_alive() and os.getppid() == session.pid:
            session.join(POLL)
        if patience:
            if sys.platform != "win32":  # on Windows, the signal would kill the process
                os.kill(pid, signal.SIGTERM)
            time.sleep(patience)
        _end_children(pid)
        os._exit(1)

    if patience is None and bound_to(session.pid, signal.SIGKILL):
        os.register_at_fork(after_in_child=bind_child)
    else:
        # If this thread received a signal, the signal would not wake the main thread from waiting or sleeping.
        with _blocked(signal.valid_signals()):
            threading.Thread(target=watch, name="pafot-session-guard", daemon=True).start()


def _quietly(work: Work, task: Any, tell: Callable[[Any], object]) -> Any:
    # The first process that died has printed its stack, in about a hundred lines, which need not be repeated.
    faulthandler.disable()
    return work(task, tell)


def _serve(
    work: Work,
    connection: Connection,
    inherited: list[Connection],
    beats: Any,
    gave_up: Any,
    grace: float,
    idle: float | None,
    leave: Callable[[], Any] | None,
    patience: float | None,
) -> None:
    # Run tasks in a process of the pool until the pool or the session ends.
    _end_with_session(patience)
    is_leaving = may_raise = in_task = False

    def tell(said: object) -> None:
        connection.send_bytes(_sendable(Said(said)))

    def beat(*signalled: object) -> None:
        beats.value += 1

    def interrupt(*signalled: object) -> None:
        nonlocal is_leaving
        is_leaving = True
        # the next signal ends a task that ignores the exception
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        if may_raise:  # otherwise, the process first sends its answer completely, and then ends
            raise KeyboardInterrupt  # no run mistakes it for an error of its policy

    def end(why: _ReasonToEnd = _ReasonToEnd.STUCK) -> None:
        gave_up.value = why
        time.sleep(2 * POLL)  # meanwhile, the pool kills this process and its children
        os._exit(1)

    # otherwise, a garbage collection would touch, and so copy, all of the session's memory
    gc.freeze()
    for other in inherited:
        other.close()  # otherwise, the end of the session or of another process would go unnoticed
    # daemons cannot have children, but an ADS may start processes
    multiprocessing.current_process().daemon = False
    # The session ends its processes itself. A function and not SIG_IGN: the processes that they start would inherit
    # SIG_IGN, but must be interrupted.
    signal.signal(signal.SIGINT, lambda number, frame: None)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    if hasattr(signal, "SIGUSR2"):
        signal.signal(signal.SIGUSR2, beat)
    beat()
    if leave is not None:
        signal.signal(signal.SIGTERM, interrupt)
    resort = LastResort(end=end, grace=grace, end_world=partial(end, _ReasonToEnd.WORLD_STUCK))
    with last_resort(resort), suppress(EOFError, OSError, KeyboardInterrupt):
        while True:
            may_raise = True
            # Python continues to wait after a signal that raises nothing
            if is_leaving or not connection.poll(idle):
                break
            may_raise = False
            task = connection.recv()
            if task is None:
                break
            try:
                may_raise = True
                if is_leaving:  # the signal came while the task was read, and raised nothing
                    raise KeyboardInterrupt
                said = _sendable(Done(work(task, tell)))
                may_raise = False
            # not sent: the session would run the task itself and use up its own memory
            except MemoryError:
                end(_ReasonToEnd.EXHAUSTED)
                return
            except BaseException as error:  # noqa: BLE001  (it is raised again in the session)
                may_raise, in_task = False, is_leaving
                if in_task:
                    break
                said = pickle.dumps(RunItHere(_portable(error)))
            # Outside the try block, because an error here means that the session is gone.
            connection.send_bytes(said)
        may_raise = False
    if leave is not None:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        with suppress(OSError):  # the session may have ended
            connection.send_bytes(_sendable(_Left(leave(), in_task)))


@contextmanager
def _blocked(signals: set[signal.Signals], method: str = "") -> Iterator[None]:
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    if method == "spawn":
        resource_tracker.ensure_running()  # It unblocks SIGINT when it starts.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, signals)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _sendable(result: object) -> bytes:
    try:
        return pickle.dumps(result)
    except MemoryError:
        raise
    except Exception as error:
        raise RuntimeError(
            "expected a result that can be sent to the session, received one that cannot be pickled: "
            f"{type(error).__name__}: {error}. Does the ADS return two numbers?"
        ) from error


def _portable(error: BaseException) -> Exception:
    # Convert an error to an error that can be pickled, with the traceback as a note.
    # SystemExit and KeyboardInterrupt would end the session if they were raised there.
    worded = RuntimeError("".join(traceback.format_exception_only(error)).strip())
    told = error if isinstance(error, Exception) else worded
    try:
        pickle.loads(pickle.dumps(told))  # noqa: S301  (made by this process)
    except Exception:  # noqa: BLE001  (pickling the user's exception may raise anything)
        told = worded
    # Tracebacks cannot be pickled.
    told.add_note("In a worker:\n" + "".join(traceback.format_exception(error)))
    return told
