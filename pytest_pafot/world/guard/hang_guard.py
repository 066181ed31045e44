"""A limit on the wall-clock time of one decision, so that an ADS that hangs costs one scenario, not the session."""

from __future__ import annotations

import ctypes
import faulthandler
import mmap
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from types import FrameType
from typing import Any

from pytest_pafot.support.errors import AdsFactoryError

LONGEST_PAUSE = 1.0
"""Between two looks at the decisions under way [s]."""
IDLE_LOOKS = 5
"""After so many looks with no run under way the watching thread ends."""
COPY_LATE = 0.05
"""How much later than this process a copy of it may come to the end of what the ADS does [s]."""
LONGEST_TIMER = 1e6
"""A timer for more than this is as good as none, and systems refuse what is much longer [s]."""
DEBUGGERS = frozenset({"bdb", "pydevd"})
"""Modules with a function under way while pdb and its kin, or the debugger of an editor, wait for their user."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LastResort:
    """What is done about a decision that cannot be interrupted.

    Attributes:
        end: ends the process; called by the watching thread.
        grace: how much longer than its limit a decision may take before that, as interruptions do not end it [s].
        file: descriptor for a traceback, where the process shall also end if no thread of Python's comes to run for so
            long, as when native code holds the interpreter's lock; None where somebody else sees to that.
    """

    end: Callable[[], None]
    grace: float
    file: int | None = None


@contextmanager
def last_resort(resort: LastResort) -> Iterator[None]:
    """Have decisions of this process that cannot be interrupted ended as told, inside of a ``with`` block."""
    before = _WATCHDOG.set_resort(resort)
    try:
        yield
    finally:
        _WATCHDOG.set_resort(before)


class OneProcess:
    """The process that calls an ADS, which can fork it. To be used in a ``with`` statement around the ADS's code.

    A copy that the ADS lets run on would run the rest of the session too, with all that this writes and prints. It is
    noticed by its process id and ends where the statement does. There the process that it is a copy of raises an
    ``AdsFactoryError``.
    """

    def __init__(self) -> None:
        self.pid = os.getpid()
        self.forked_at: float | None = None
        self._noticed = mmap.mmap(-1, 1)  # A byte that is shared with all copies.

    def __enter__(self) -> OneProcess:
        self.forked_at = None
        return self

    def __exit__(self, kind: type[BaseException] | None = None, *rest: object) -> None:
        if os.getpid() != self.pid:
            self._noticed[0] = 1
            os._exit(1)  # Nothing is flushed: what the buffers hold is also in those of the other process.
        if self.forked_at is not None:
            # A copy has as much time as this process has taken since, while there is any child.
            now = time.perf_counter()
            until, self.forked_at = now + (now - self.forked_at) + COPY_LATE, None
            with suppress(ChildProcessError, AttributeError):  # Not every system can look without taking what it sees.
                while not self._noticed[0] and time.perf_counter() < until:
                    os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
                    time.sleep(0.001)
        if self._noticed[0] and kind is None:
            self._noticed[0] = 0
            raise AdsFactoryError(
                "ads: expected an ADS that ends the processes that it forks, received one that lets a copy of this "
                "process run on; the copy was ended and has written nothing. End it by os._exit() where os.fork() "
                "gives 0, or use multiprocessing or subprocess"
            )


class AdsHang(BaseException):
    """Raised inside a decision that exceeds the limit; no ``except Exception`` of the ADS catches it."""


class HangGuard:
    """Interrupts the thread that made it when a decision takes longer than a limit.

    On platforms with ``signal.pthread_kill`` and in the main thread, also blocking system calls are interrupted;
    elsewhere the exception is raised at the thread's next Python instruction. An ADS that swallows it is interrupted
    again. A debugger that waits for its user in the main thread is left alone where there are such signals. Code that
    never returns to the interpreter cannot be interrupted, and an ADS may swallow each interruption: then the
    :class:`LastResort` remains, and the record of the scenario in flight names it in the next session.

    A decision is under guard while ``started`` is set. Whoever ends one cheaply clears ``started`` first and reads the
    clock then: if by that clock the decision was within the limit, nobody has found it overdue, since the watching
    thread reads the clock before it looks at ``started``. Else :meth:`settle` is to be called.

    Attributes:
        limit: longest decision [s].
        clock: seconds, monotonic.
        started: when the decision under way began, by the clock [s]; None between decisions.
    """

    def __init__(self, limit: float, clock: Callable[[], float] = time.perf_counter) -> None:
        self.limit = limit
        self.clock = clock
        self.started: float | None = None
        self._sent = False
        self._ignored: tuple[float, float] | None = None
        self._lock = threading.Lock()
        self._target = threading.get_ident()
        self._by_signal = hasattr(signal, "pthread_kill") and threading.current_thread() is threading.main_thread()
        self._previous: Any = None
        self._process = one_process()

    def __enter__(self) -> HangGuard:
        self._process.__enter__()
        if self._by_signal:
            self._previous = signal.signal(signal.SIGUSR1, self._received) or signal.SIG_DFL
        _WATCHDOG.watch(self)
        return self

    def __exit__(self, kind: type[BaseException] | None = None, *rest: object) -> None:
        try:
            self._process.__exit__(kind)
        finally:
            self.decision_ends()
            _WATCHDOG.leave(self)
            if self._by_signal:
                signal.signal(signal.SIGUSR1, self._previous)

    @property
    def pause(self) -> float:
        """How long a look may be put off [s]."""
        return min(self.limit / 4, LONGEST_PAUSE)

    def decision_starts(self) -> None:
        """The ADS is asked now."""
        self.started = self.clock()

    def decision_ends(self) -> None:
        """The ADS has answered; once this returns nothing is interrupted.

        The interruption may still arrive inside this call, which is then to be called again.
        """
        self.started = None
        self.settle()

    def settle(self) -> None:
        """Wait until an interruption that was sent has arrived, after ``started`` is cleared."""
        with self._lock:
            sent, self._sent = self._sent, False
        if sent:
            # It cannot be taken back: CPython 3.11 then looks for an exception for ever, and hangs as soon as a
            # debugger or a coverage tool traces the thread.
            try:
                for _ in range(100):  # an exception for this thread is raised between two instructions of it
                    pass
            except AdsHang:
                return

    def look(self) -> float:
        """From the watching thread, interrupt a decision that takes too long; for how long it has ignored that [s]."""
        with self._lock:
            now, started = self.clock(), self.started  # in this order, see above
            if started is None or now - started <= self.limit:
                return 0.0
            if self._ignored is None or self._ignored[0] != started:
                self._ignored = started, now
            if self._by_signal:
                signal.pthread_kill(self._target, signal.SIGUSR1)
            else:
                self._sent = True
                ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(self._target), ctypes.py_object(AdsHang))
            return now - self._ignored[1]

    def _overdue(self) -> bool:
        now = self.clock()  # before the look at what is under way, see above
        started = self.started
        return started is not None and now - started > self.limit

    def _received(self, number: int, frame: object) -> None:
        if not self._overdue():  # a signal that arrives late interrupts nothing
            return
        if _waits_in_a_debugger(sys._getframe()):
            self.started = self.clock()  # The time of whoever looks is not that of the decision.
            return
        raise AdsHang


class _Watchdog:
    """The thread that looks after all guards of the process: to start one for each run would cost as much as a run."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._guards: list[HangGuard] = []
        self._thread: threading.Thread | None = None
        self._pause = LONGEST_PAUSE
        self._resort: LastResort | None = None
        self.process = OneProcess()
        self._timed: float | None = None
        """The limit that the timer runs for [s]; None where it does not run."""

    def watch(self, guard: HangGuard) -> None:
        with self._lock:
            self._guards.append(guard)
            if self._timed is None or guard.limit > self._timed:
                self._start_timer()
            if self._thread is None:
                self._pause = guard.pause
                self._thread = threading.Thread(target=self._run, name="pafot-hang-guard", daemon=True)
                self._thread.start()
            elif guard.pause < self._pause:
                self._wake.set()

    def leave(self, guard: HangGuard) -> None:
        with self._lock:
            if guard in self._guards:  # not in a process that was forked inside of a run
                self._guards.remove(guard)

    def set_resort(self, resort: LastResort | None) -> LastResort | None:
        with self._lock:
            before, self._resort = self._resort, resort
            self._stop_timer()
            return before

    def before_fork(self) -> None:
        """The forked process has no thread that runs the timer, and would wait for its end."""
        with self._lock:
            self._stop_timer()

    def after_fork(self) -> None:
        """In the process that was forked."""
        self.process.forked_at = time.perf_counter()

    def _run(self) -> None:
        idle = 0
        while True:
            with self._lock:
                guards = self._guards.copy()
                idle = 0 if guards else idle + 1
                if idle > IDLE_LOOKS:
                    self._thread = None
                    return
                self._pause = min([guard.pause for guard in guards], default=LONGEST_PAUSE)
            self._wake.wait(self._pause)
            self._wake.clear()
            with self._lock:
                guards, resort = self._guards.copy(), self._resort
                self._start_timer()
            ignored = max([guard.look() for guard in guards], default=0.0)
            if resort is not None and ignored > resort.grace:
                resort.end()

    def _start_timer(self) -> None:
        """Put the end of the process off until the next look; once no run is under way, nothing ends it.

        Not from run to run, of which there may be a thousand in a second: a timer is a thread.
        """
        resort = self._resort
        if not self._guards:
            self._stop_timer()
        elif resort is not None and resort.file is not None and not _is_debugged():
            self._timed = max([guard.limit for guard in self._guards])
            seconds = min(self._timed + resort.grace + LONGEST_PAUSE, LONGEST_TIMER)
            faulthandler.dump_traceback_later(seconds, exit=True, file=resort.file)

    def _stop_timer(self) -> None:
        if self._timed is not None:
            faulthandler.cancel_dump_traceback_later()
            self._timed = None


def _is_debugged() -> bool:
    """Whether a debugger may have stopped all threads."""
    monitoring = getattr(sys, "monitoring", None)  # of Python 3.12
    is_monitored = monitoring is not None and monitoring.get_tool(monitoring.DEBUGGER_ID) is not None
    return is_monitored or sys.gettrace() is not None


def _waits_in_a_debugger(frame: FrameType | None) -> bool:
    """Whether a debugger has stopped this thread at a line, or runs it."""
    while frame is not None and frame.f_globals.get("__name__") not in DEBUGGERS:
        frame = frame.f_back
    return frame is not None


def one_process() -> OneProcess:
    """What notices copies of this process; the same object each time, since a run takes a millisecond."""
    return _WATCHDOG.process


_WATCHDOG = _Watchdog()
if hasattr(os, "register_at_fork"):  # a forked process has no other thread, and a lock that one held stays locked
    os.register_at_fork(
        before=_WATCHDOG.before_fork,
        after_in_parent=_WATCHDOG.after_fork,
        after_in_child=_WATCHDOG.__init__,  # type: ignore[misc]
    )
