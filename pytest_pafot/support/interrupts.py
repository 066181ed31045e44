"""Signals that end a process in order, as Ctrl-C does: all that it has begun is ended and removed."""

from __future__ import annotations

import atexit
import ctypes
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from os import getpid
from types import FrameType

from pytest_pafot.support import monotonic

ENDS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))
"""The signals that end a process without giving it time, unless it handles them."""
AGAIN_SECONDS = 0.05
"""The time after which an interrupt that Python could not raise comes again [s]."""
PATIENCE = 2.0
"""The time for which :func:`postponed` lets its context go on after an interrupt, unless there is another, and
:func:`exit_soon` the threads and exit functions of others [s]."""


class Ended(KeyboardInterrupt):
    """One of :data:`ENDS`, as an interrupt. ``code`` is the exit code that a shell reports for its ``number``."""

    def __init__(self, number: int) -> None:
        super().__init__(f"received {signal.Signals(number).name}")
        self.number, self.code = number, 128 + number


@contextmanager
def interrupted_by_signals(note: Callable[[KeyboardInterrupt], None] = lambda interrupt: None) -> Iterator[None]:
    """Let the first of :data:`ENDS` raise :class:`Ended` in the main thread; further ones have no effect.

    ``note`` receives each interrupt, also one by Ctrl-C, before it is raised, because the user's code may catch it.

    A signal that the user's code handles, or that is ignored as by ``nohup``, is left alone. Python drops what
    a handler raises while a finalizer or the callback of a weak reference runs; such an interrupt comes again shortly.
    """
    owner, ended, told = getpid(), False, sys.unraisablehook

    def received(number: int, _: object) -> None:
        nonlocal ended
        if not ended:
            ended = True
            note(error := Ended(number))
            raise error

    def pressed(number: int, frame: FrameType | None) -> None:
        if getpid() == owner:
            note(error := KeyboardInterrupt())
            raise error
        signal.default_int_handler(number, frame)

    def unraisable(lost: sys.UnraisableHookArgs) -> None:
        nonlocal ended
        if not isinstance(lost.exc_value, KeyboardInterrupt) or getpid() != owner:
            told(lost)
            return
        ended, number = False, lost.exc_value.number if isinstance(lost.exc_value, Ended) else signal.SIGINT
        threading.Timer(AGAIN_SECONDS, os.kill, (owner, number)).start()

    is_main = threading.current_thread() is threading.main_thread()
    mine = [number for number in ENDS if is_main and signal.getsignal(number) == signal.SIG_DFL]
    handlers: dict[int, Callable[[int, FrameType | None], None]] = dict.fromkeys(mine, received)
    if is_main and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        handlers[signal.SIGINT] = pressed
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    if is_main:
        sys.unraisablehook = unraisable
    try:
        yield
    finally:
        if sys.unraisablehook is unraisable:
            sys.unraisablehook = told
        for number, handler in handlers.items():
            if signal.getsignal(number) is handler:  # The user's code may handle it since.
                signal.signal(number, before[number])


@contextmanager
def postponed() -> Iterator[None]:
    """Let an interrupt that comes in this context be raised at its end, so that what it does is not left half done.

    Another interrupt after :data:`PATIENCE` is raised at once, as what the context waits for may never come.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, *ENDS)}
    came: list[tuple[int, float]] = []

    def received(number: int, frame: FrameType | None) -> None:
        handler = before[number]
        if came and monotonic() - came[0][1] > PATIENCE and callable(handler):
            handler(number, frame)
        came.append((number, monotonic()))

    mine = [number for number, handler in before.items() if callable(handler) or handler == signal.SIG_DFL]
    for number in mine:  # those that are ignored, as by ``nohup``, stay so
        signal.signal(number, received)
    try:
        yield
    finally:
        for number in mine:
            signal.signal(number, before[number])
        for number, _ in came[:1]:
            signal.raise_signal(number)


def _let_forks_end() -> None:
    """Let a process that Python forks end by :data:`ENDS` as it would without a handler of this module.

    Python drops a signal that has a handler and comes before the fork is complete. ``multiprocessing.Pool``, which ends
    its processes by SIGTERM, would now and then wait for one forever. So the signal is blocked until then.
    """
    masks: dict[int, set[int]] = {}  # by thread

    def before() -> None:
        masks[threading.get_ident()] = signal.pthread_sigmask(signal.SIG_BLOCK, ENDS)

    def after() -> None:
        signal.pthread_sigmask(signal.SIG_SETMASK, masks.pop(threading.get_ident()))

    def in_child() -> None:
        for number in ENDS:
            if getattr(signal.getsignal(number), "__module__", "") == __name__:
                signal.signal(number, signal.SIG_DFL)
        after()

    os.register_at_fork(before=before, after_in_parent=after, after_in_child=in_child)


if hasattr(os, "register_at_fork"):
    _let_forks_end()


def bound_to(parent: int, number: int) -> bool:
    """Let Linux send this process a signal as soon as its parent has ended, however it ends; return False elsewhere.

    Linux sends it when the *thread* ends that has started this process, so call this only if that was a main thread.
    """
    if sys.platform != "linux" or ctypes.pythonapi.prctl(1, number) != 0:  # PR_SET_PDEATHSIG
        return False
    if os.getppid() != parent:  # it has ended before that
        os.kill(getpid(), number)
    return True


def exit_soon(code: int) -> None:
    """Let this process end soon after Python has begun to exit, although threads or exit functions would keep it."""

    def end() -> None:
        last = threading.Timer(PATIENCE, os._exit, (code,))
        last.daemon = True
        last.start()
        print(end="", flush=True)
        atexit._run_exitfuncs()  # Python would wait for threads before

    # Python calls it before it waits for threads; there is no public function for that.
    threading._register_atexit(end)  # type: ignore[attr-defined]


@contextmanager
def undisturbed() -> Iterator[None]:
    """Ignore Ctrl-C and :data:`ENDS` in this context, which cleans up; so do the programs that it starts."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, signal.SIG_IGN) for number in (signal.SIGINT, *ENDS)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
