"""A wall-clock limit for decisions, so that a hanging policy ends only its run and not the session."""

from __future__ import annotations

import bdb
import ctypes
import faulthandler
import math
import mmap
import os
import signal
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from os import getpid  # bound here, since a test may replace os.getpid
from types import FrameType, TracebackType
from typing import Any, Self

from pytest_pafot.model.trace import WORLD_HANG, AdsError
from pytest_pafot.support import monotonic
from pytest_pafot.support.errors import AdsFactoryError, BadAction, OutOfTime
from pytest_pafot.support.text import one_line

# The longest time between two checks of the running decisions [s].
LONGEST_PAUSE = 1.0
# The watching thread ends after this number of checks without a run.
IDLE_LOOKS = 5
# The extra time for a forked copy of this process to reach the end of the policy's code [s].
COPY_LATE = 0.05
# The time for which a decision, or the creation of a policy, may continue after the end of its search before it is
# interrupted [s]. Between decisions, a run ends immediately. An interruption of a decision may leave the user's code in
# an inconsistent state.
LATE = 5.0
# The longest timer [s]. Operating systems reject much longer timers, and no session takes that long.
LONGEST_TIMER = 1e6
# Python calls functions of these modules when an object is deleted. Their exceptions are printed and reach no caller.
SWALLOWING = frozenset({"weakref", "_weakrefset"})
# A call of a simulator's or an environment's code may take this multiple of the world's `hang_limit`, and at least this
# time [s]. A simulator may start slowly, but rarely takes as long as ten decisions at the limit.
WORLD_SHARE = 10.0
LEAST_FOR_WORLD = 60.0
# One of these modules is on the stack while pdb, or an editor's debugger, waits for its user.
DEBUGGERS = frozenset({"bdb", "pydevd"})


@dataclass(frozen=True, slots=True, kw_only=True)
class LastResort:
    """The reaction to a decision that cannot be interrupted."""

    # Ends the process. The watching thread calls it.
    end: Callable[[], None]
    # A decision may ignore interruptions for this time before `end` is called [s].
    grace: float
    # The file descriptor for a traceback. If it is set, the process also ends if no Python thread has run for the same
    # time, because native code holds the interpreter's lock. None if other code handles that case.
    file: int | None = None
    # Ends the process if an environment hangs. None if the process must continue, because a world may be slow.
    end_world: Callable[[], None] | None = None


def patience_with_world(hang_limit: float) -> float:
    """Return the longest time [s] that a call of a world's code may take, given the hang limit [s] of decisions."""
    return max(WORLD_SHARE * hang_limit, LEAST_FOR_WORLD)


@contextmanager
def last_resort(resort: LastResort) -> Iterator[None]:
    """Apply a :class:`LastResort` to this process's decisions within a ``with`` block."""
    before = _WATCHDOG.set_resort(resort)
    try:
        yield
    finally:
        _WATCHDOG.set_resort(before)


@contextmanager
def runs_end_in(seconds: float) -> Iterator[None]:
    """End the runs in a ``with`` block after ``seconds``, with :class:`~pytest_pafot.support.errors.OutOfTime`.

    The exception is raised before the next decision. If blocks are nested, the limit of the inner block applies.
    """
    before = _WATCHDOG.until
    _WATCHDOG.until = monotonic() + seconds
    try:
        yield
    finally:
        _WATCHDOG.until = before


def check_time() -> None:
    """Raise OutOfTime if the time limit of :func:`runs_end_in` has passed."""
    if monotonic() >= _WATCHDOG.until:
        raise OutOfTime


@contextmanager
def unending() -> Iterator[None]:
    """Guard a policy's code outside its decisions, such as its factory, with the limit of :func:`runs_end_in`."""
    if _WATCHDOG.until == math.inf:
        yield
        return
    with HangGuard(math.inf) as guard, guard.decision():
        yield


def note_interrupt(interrupt: KeyboardInterrupt) -> None:
    """Make the main thread's running decision end with an interrupt, even if the policy catches it."""
    for guard in _WATCHDOG.guards.copy():
        guard.note(interrupt)


class OneProcess:
    """A context manager for a policy's code that ends any forked copy of this process."""

    def __init__(self) -> None:
        self.pid = getpid()
        self.forked_at: float | None = None
        self._noticed = mmap.mmap(-1, 1)  # one byte that is shared with all copies

    def __enter__(self) -> OneProcess:
        self.forked_at = None
        return self

    def __exit__(self, kind: type[BaseException] | None = None, *rest: object) -> None:
        # Otherwise, a forked copy would run the rest of the session, and write and print everything twice.
        if getpid() != self.pid:
            self._noticed[0] = 1
            os._exit(1)  # without flushing: the original process has the same data in its buffers
        if self.forked_at is not None:
            # While there is a child process, wait for it as long as this process has taken since the fork.
            now = monotonic()
            until = now + (now - self.forked_at) + COPY_LATE
            self.forked_at = None
            with suppress(ChildProcessError, AttributeError):  # not every system has WNOWAIT
                while not self._noticed[0] and monotonic() < until:
                    os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
                    time.sleep(0.001)
        if self._noticed[0] and kind is None:
            self._noticed[0] = 0
            raise AdsFactoryError(
                "ads: expected an ADS that ends each child process that it forks, received an ADS whose child "
                "process returned to the plugin's code. The plugin ended the child before it could write anything. "
                "Call os._exit() in the child, where os.fork() returns 0, or use multiprocessing or subprocess"
            )


class AdsHang(BaseException):
    """The exception that interrupts a decision. A policy's ``except Exception`` does not catch it."""


class WorldHang(AdsHang):
    """The exception that interrupts a user's environment, with a message that names the class and the method."""


class HangGuard:
    """A guard that interrupts its thread when a decision takes longer than a limit.

    In the main thread, the guard also interrupts blocking system calls if the platform has ``signal.pthread_kill``.
    Otherwise, the exception is raised at the thread's next Python instruction. The :class:`LastResort` handles code
    that never returns to the interpreter, and a policy that catches every interruption.
    """

    def __init__(
        self, limit: float, clock: Callable[[], float] = monotonic, *, is_limited: bool = True
    ) -> None:
        self.limit = limit
        self.clock = clock
        # No decision starts from this time by the clock [s].
        self.until = math.inf
        if is_limited:
            self.until = _WATCHDOG.until
        # The start of the running decision by the clock [s]. A decision is guarded while it is set. A caller may end a
        # decision without a lock: it clears `started` first and then reads the clock. If the decision was within the
        # limit by that clock, and ended before `until`, no thread has found it overdue, because the watching thread
        # reads the clock before `started`. Otherwise the caller must call `settle`.
        self.started: float | None = None
        # The exception that was raised in the running decision, or its class.
        self.interruption: BaseException | type[BaseException] | None = None
        # the time for which native code may keep all Python threads from running [s]
        self.silence = limit
        self._sent = False
        self._ignored: tuple[float, float] | None = None
        self._lock = threading.Lock()
        self._target = threading.get_ident()
        self._by_signal = (
            hasattr(signal, "pthread_kill")
            and threading.current_thread() is threading.main_thread()
        )
        self._previous: Any = None
        self._process = one_process()

    def __enter__(self) -> Self:
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
        return min(self.limit / 4, LONGEST_PAUSE)

    def decision_starts(self) -> None:
        """Start guarding a decision.

        Raises:
            OutOfTime: if the search has run out of time.
        """
        now = self.clock()
        if now >= self.until:
            raise OutOfTime
        self.interruption = None
        self.started = now

    def decision_ends(self) -> None:
        """Stop guarding the decision. Nothing is interrupted after this method returns.

        The interruption can still arrive during this call. The caller must then call the method again.
        """
        self.started = None
        self.settle()

    def raise_swallowed(self) -> None:
        """Raise the interruption that a policy caught, if a decision has ended without an exception.

        Raises:
            AdsHang: if the decision exceeded the limit.
            OutOfTime: if the decision continued after the search had run out of time.
            KeyboardInterrupt: if the user ended the session during the decision.
        """
        # Called after `decision_ends`, outside of its `finally`, so that an exception that ends the decision is kept.
        interruption = self.interruption
        self.interruption = None
        if interruption is not None:
            raise interruption

    @contextmanager
    def decision(self) -> Iterator[None]:
        try:
            self.decision_starts()
            yield
        finally:
            self.decision_ends()
        self.raise_swallowed()

    def note(self, interrupt: KeyboardInterrupt) -> None:
        """Store an interrupt of the main thread for :meth:`raise_swallowed` if this thread is running a decision."""
        if self._target == threading.get_ident() and self.started is not None:
            self.interruption = interrupt

    def settle(self) -> None:
        """Wait for an interruption that has been sent. The caller must have set ``started`` to None."""
        with self._lock:
            sent = self._sent
            self._sent = False
        if sent:
            # The exception must arrive here. If it is cancelled, CPython 3.11 checks for an exception forever, and
            # hangs as soon as a debugger or a coverage tool traces the thread.
            try:
                # an exception for this thread is raised between two instructions of it
                for _ in range(100):
                    pass
            except (AdsHang, OutOfTime):
                return

    def look(self) -> float:
        # Interrupts an overdue decision, and returns how long it has ignored interruptions [s]. Only the watching
        # thread calls this method.
        with self._lock:
            # in this order; see `started`
            now = self.clock()
            started = self.started
            why = self._interruption(now, started)
            if why is None or started is None:
                return 0.0
            if self._by_signal:
                signal.pthread_kill(self._target, signal.SIGUSR1)
            else:
                self._sent = True
                self.interruption = self.interruption or why
                ctypes.pythonapi.PyThreadState_SetAsyncExc(
                    ctypes.c_ulong(self._target), ctypes.py_object(why)
                )
            # If an ADS ignores it, the process need not end, because the limit still applies.
            if why is OutOfTime:
                return 0.0
            if self._ignored is None or self._ignored[0] != started:
                self._ignored = started, now
            return now - self._ignored[1]

    def is_stuck(self) -> bool:
        # Only the guard of an environment overrides this.
        return False

    def _interruption(self, now: float, started: float | None) -> type[BaseException] | None:
        if started is None:
            return None
        if now - started > self.limit:
            return AdsHang
        if now > self.until + LATE:
            return OutOfTime
        return None

    def _received(self, number: int, frame: FrameType | None) -> None:
        now = self.clock()  # before started is read; see `started`
        why = self._interruption(now, self.started)
        if why is None:  # a signal that arrives late interrupts nothing
            outer = getattr(self._previous, "__self__", None)
            if isinstance(outer, HangGuard):  # the guard of an environment in which a decision runs
                outer._received(number, frame)
            return
        # the next check comes soon
        if frame is not None and frame.f_globals.get("__name__") in SWALLOWING:
            return
        if _waits_in_a_debugger(sys._getframe()):
            self.started = self.clock()  # the user's time in the debugger does not count
            return
        error = why()
        # the instance, whose traceback leads into the ADS
        self.interruption = self.interruption or error
        raise error


class _Watchdog:
    """The thread that serves all guards of the process, because starting a thread takes as long as a run."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self.guards: list[HangGuard] = []
        self._thread: threading.Thread | None = None
        self._pause = LONGEST_PAUSE
        self._resort: LastResort | None = None
        # No decision of a run starts from this time by `monotonic` [s].
        self.until = math.inf
        self.process = OneProcess()
        # The time after which the running timer fires [s].
        self._timed: float | None = None

    def watch(self, guard: HangGuard) -> None:
        with self._lock:
            self.guards.append(guard)
            if self._timed is None or guard.silence > self._timed:
                self._start_timer()
            if self._thread is None:
                self._pause = guard.pause
                self._thread = threading.Thread(
                    target=self._run,
                    name="pafot-hang-guard",
                    daemon=True,
                )
                self._thread.start()
            elif guard.pause < self._pause:
                self._wake.set()

    def leave(self, guard: HangGuard) -> None:
        with self._lock:
            if guard in self.guards:  # a process that was forked during a run does not have it
                self.guards.remove(guard)

    def set_resort(self, resort: LastResort | None) -> LastResort | None:
        with self._lock:
            before = self._resort
            self._resort = resort
            self._stop_timer()
            return before

    def before_fork(self) -> None:
        # The forked process does not have the timer's thread, and would wait for it forever.
        with self._lock:
            self._stop_timer()

    def after_fork(self) -> None:
        self.process.forked_at = monotonic()

    def _run(self) -> None:
        idle = 0
        while True:
            with self._lock:
                guards = self.guards.copy()
                idle = 0 if guards else idle + 1
                if idle > IDLE_LOOKS:
                    self._thread = None
                    return
                self._pause = min([guard.pause for guard in guards], default=LONGEST_PAUSE)
            self._wake.wait(self._pause)
            self._wake.clear()
            with self._lock:
                guards = self.guards.copy()
                resort = self._resort
                self._start_timer()
            ignored = max([guard.look() for guard in guards], default=0.0)
            if (
                resort is not None
                and resort.end_world is not None
                and any(guard.is_stuck() for guard in guards)
            ):
                resort.end_world()
            if resort is not None and ignored > resort.grace:
                resort.end()

    def _start_timer(self) -> None:
        # Restarted at each check and not for each run, because a timer is a thread, and there may be a thousand runs a
        # second.
        resort = self._resort
        if not self.guards:
            self._stop_timer()
        elif resort is not None and resort.file is not None and not _is_debugged():
            self._timed = max([guard.silence for guard in self.guards])
            seconds = min(self._timed + resort.grace + LONGEST_PAUSE, LONGEST_TIMER)
            faulthandler.dump_traceback_later(seconds, exit=True, file=resort.file)

    def _stop_timer(self) -> None:
        if self._timed is not None:
            faulthandler.cancel_dump_traceback_later()
            self._timed = None


def _is_debugged() -> bool:
    monitoring = getattr(sys, "monitoring", None)  # since Python 3.12
    is_monitored = (
        monitoring is not None and monitoring.get_tool(monitoring.DEBUGGER_ID) is not None
    )
    return is_monitored or sys.gettrace() is not None


def _waits_in_a_debugger(frame: FrameType | None) -> bool:
    while frame is not None and frame.f_globals.get("__name__") not in DEBUGGERS:
        frame = frame.f_back
    return frame is not None


def one_process() -> OneProcess:
    """Return the object, shared by all runs, that detects copies of this process."""
    return _WATCHDOG.process


_WATCHDOG = _Watchdog()
# a forked process has one thread, and locks of other threads stay locked
if hasattr(os, "register_at_fork"):
    os.register_at_fork(
        before=_WATCHDOG.before_fork,
        after_in_parent=_WATCHDOG.after_fork,
        after_in_child=_WATCHDOG.__init__,  # type: ignore[misc]
    )


# The class to catch around the user's code. Call `let_through` afterwards, which re-raises every exception that the
# code did not cause.
UNFIT = BaseException

# Tracebacks omit the frames of these modules, which are between a run and the policy.
OWN = ("pytest_pafot.world.", "pytest_pafot.policies.", "pytest_pafot.testing.", "contextlib")

# Exceptions of these plugins report that a test's time has run out, not an error in the running code.
TIMEOUT_PLUGINS = ("pytest_timeout",)

# pytest ends the session in this module when the user quits the debugger.
DEBUGGER = "_pytest.debugging"


class Around:
    """The base class of wrappers around a policy.

    A run calls ``close`` only if the policy has been called.
    """

    def __init__(self, ads: Any) -> None:
        self._ads = ads

    def close(self) -> None:
        close = getattr(self._ads, "close", None)
        if callable(close):
            close()


def exits() -> tuple[type[BaseException], ...]:
    """Return a tuple with the exception class of ``pytest.exit()``, or an empty tuple if pytest is not imported."""
    if "pytest" in sys.modules:
        return (sys.modules["pytest"].exit.Exception,)
    return ()


def is_interruption(error: BaseException, *, is_of_ads: bool = False) -> bool:
    """Return whether an exception ends the session, leaves a debugger, or reports that a time limit has passed."""
    # Every other exception is a failure of the user's code: a panic of a native library, a cancelled task, or
    # pytest.skip(), which would otherwise go unnoticed. A test function may call pytest.exit(). A policy may not,
    # because the session would then pass with exit status 0.
    if isinstance(error, BaseExceptionGroup):
        return any(is_interruption(each, is_of_ads=is_of_ads) for each in error.exceptions)
    if isinstance(error, (KeyboardInterrupt, bdb.BdbQuit, OutOfTime)):
        return True
    if isinstance(error, exits()):
        return not is_of_ads or (
            getattr(error, "returncode", None) != 0 and _is_from_outside(error)
        )
    modules = [
        str(frame.f_globals.get("__name__", ""))
        for frame, _ in traceback.walk_tb(error.__traceback__)
    ]
    return any(module.partition(".")[0] in TIMEOUT_PLUGINS for module in modules)


def let_through(error: BaseException) -> None:
    """Re-raise an exception if it is an interruption. Call this wherever a policy's exceptions are caught."""
    if is_interruption(error, is_of_ads=True):
        raise error


def _is_from_outside(error: BaseException) -> bool:
    # True if a debugger or a signal handler, for example for SIGTERM, has raised the exception.
    handlers = [
        getattr(signal.getsignal(number), "__code__", None) for number in signal.valid_signals()
    ]
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    return any(
        frame.f_globals.get("__name__") == DEBUGGER or frame.f_code in handlers for frame in frames
    )


def error_of(error: BaseException, tick: int, guard: HangGuard) -> AdsError:
    """Convert an exception in a decision to an AdsError, or re-raise it if it is an interruption."""
    let_through(error)
    if isinstance(error, BadAction):
        return AdsError(kind="BadAction", message=str(error), traceback="", tick=tick)
    if isinstance(error, AdsHang):
        guard.decision_ends()
        frames = traceback.extract_tb(_users_part(error))
        # without the guard's own frames
        kept = [frame for frame in frames if frame.filename != __file__]
        where = "".join(
            [
                "Traceback (most recent call last):\n",
                *traceback.StackSummary.from_list(kept).format(),
            ]
        )
        kind = "Hang"
        message = "one decision took longer than the hang limit of the world and was interrupted"
        if isinstance(error, WorldHang):
            kind = WORLD_HANG
            message = str(error)
        return AdsError(kind=kind, message=message, traceback=where, tick=tick, interrupted=True)
    report = traceback.TracebackException(type(error), error, _users_part(error))
    return AdsError(
        kind=type(error).__name__,
        message=one_line(str(report)),
        traceback="".join(report.format()),
        tick=tick,
    )


def _users_part(error: BaseException) -> TracebackType | None:
    frames = error.__traceback__
    while frames is not None and frames.tb_next is not None:
        if not str(frames.tb_frame.f_globals.get("__name__")).startswith(OWN):
            break
        frames = frames.tb_next
    return frames


@contextmanager
def closing(ads: Any, hang_limit: float) -> Iterator[None]:
    """Call a policy's ``close`` method, if it has one, at the end of a ``with`` block.

    An exception, or a call that takes longer than ``hang_limit`` [s], causes only a ``RuntimeWarning``.
    """
    try:
        yield
    finally:
        close = None
        if not isinstance(ads, type):
            close = getattr(ads, "close", None)
        if callable(close):
            call_close(close, "ads.close", hang_limit)


def call_close(close: Callable[[], Any], name: str, limit: float) -> None:
    """Call a user's ``close`` method, and warn if it raises an exception or takes longer than ``limit`` [s].

    The warning never becomes an error, even with ``-W error``.
    """
    guard = HangGuard(limit, is_limited=False)
    try:
        with guard, guard.decision():
            close()
    except UNFIT as error:
        failed = error_of(error, 0, guard)
        what = "no exception"
        if failed.interrupted:
            what = f"a call that returns within {guard.limit:g} s"
        received = "one that had to be interrupted"
        if not failed.interrupted:
            received = f"{failed.kind}: {failed.message}"
        text = f"{name}: expected {what}, received {received}. This does not change the result of the run"
        try:
            warnings.warn(text, RuntimeWarning, stacklevel=2)
        # with `-W error`, it would hide the error of the run, or end pytest's summary
        except RuntimeWarning:
            with warnings.catch_warnings():
                warnings.simplefilter("always")
                warnings.warn(text, RuntimeWarning, stacklevel=2)
