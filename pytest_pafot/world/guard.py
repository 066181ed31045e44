"""A limit on the wall-clock time of one decision, so that an ADS that hangs costs one scenario, not the session."""

from __future__ import annotations

import ctypes
import signal
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any


class AdsHang(BaseException):
    """Raised inside a decision that exceeds the limit; no ``except Exception`` of the ADS catches it."""


class HangGuard:
    """Interrupts the thread that made it when a decision takes longer than a limit.

    On platforms with ``signal.pthread_kill`` and in the main thread, also blocking system calls are interrupted;
    elsewhere the exception is raised at the thread's next Python instruction. An ADS that swallows it is interrupted
    again. Code that never returns to the interpreter cannot be interrupted; the record of the scenario in flight then
    names it in the next session.

    Args:
        limit: longest decision [s].
        clock: seconds, monotonic.
    """

    def __init__(self, limit: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._limit = limit
        self._clock = clock
        self._started: float | None = None
        self._sent = False
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._target = threading.get_ident()
        self._by_signal = hasattr(signal, "pthread_kill") and threading.current_thread() is threading.main_thread()
        self._previous: Any = None
        self._watcher = threading.Thread(target=self._watch, name="pafot-hang-guard", daemon=True)

    def __enter__(self) -> HangGuard:
        if self._by_signal:
            self._previous = signal.signal(signal.SIGUSR1, self._received) or signal.SIG_DFL
        self._watcher.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.decision_ends()
        self._closed.set()
        self._watcher.join()
        if self._by_signal:
            signal.signal(signal.SIGUSR1, self._previous)

    def decision_starts(self) -> None:
        """The ADS is asked now."""
        self._started = self._clock()

    def decision_ends(self) -> None:
        """The ADS has answered; once this returns nothing is interrupted.

        The interruption may still arrive inside this call, which is then to be called again.
        """
        self._started = None
        with self._lock:
            sent, self._sent = self._sent, False
        if sent:
            _let_it_arrive()

    def _overdue(self) -> bool:
        started = self._started
        return started is not None and self._clock() - started > self._limit

    def _watch(self) -> None:
        pause = min(self._limit / 4, 1.0)
        while not self._closed.wait(pause):
            with self._lock:
                if self._overdue():
                    self._interrupt()

    def _interrupt(self) -> None:
        if self._by_signal:
            signal.pthread_kill(self._target, signal.SIGUSR1)
        else:
            self._sent = True
            ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(self._target), ctypes.py_object(AdsHang))

    def _received(self, number: int, frame: object) -> None:
        if self._overdue():  # a signal that arrives late interrupts nothing
            raise AdsHang


def _let_it_arrive() -> None:
    """Take an interruption that is on its way to this thread; without one, nothing happens.

    It cannot be taken back: CPython 3.11 then looks for an exception for ever, and hangs as soon as a debugger or
    a coverage tool traces the thread.
    """
    try:
        for _ in range(100):  # an exception for this thread is raised between two instructions of it
            pass
    except AdsHang:
        return
