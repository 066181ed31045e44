"""Signals that end a process in order, as Ctrl-C does: all that it has begun is ended and removed."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

ENDS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))
"""The signals that end a process without giving it time, unless it handles them."""


class Ended(KeyboardInterrupt):
    """One of :data:`ENDS`, as an interrupt. ``code`` is the exit code that a shell reports for it."""

    def __init__(self, number: int) -> None:
        super().__init__(f"received {signal.Signals(number).name}")
        self.code = 128 + number


@contextmanager
def interrupted_by_signals() -> Iterator[None]:
    """Let the first of :data:`ENDS` raise :class:`Ended` in the main thread; further ones have no effect.

    A signal that the user's code handles, or that is ignored as by ``nohup``, is left alone.
    """
    owner, ended = os.getpid(), False

    def received(number: int, _: object) -> None:
        nonlocal ended
        if os.getpid() != owner:  # a fork, which ends as a process does without a handler
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
        elif not ended:
            ended = True
            raise Ended(number)

    is_main = threading.current_thread() is threading.main_thread()
    mine = [number for number in ENDS if is_main and signal.getsignal(number) == signal.SIG_DFL]
    for number in mine:
        signal.signal(number, received)
    try:
        yield
    finally:
        for number in mine:
            if signal.getsignal(number) is received:  # The user's code may handle it since.
                signal.signal(number, signal.SIG_DFL)


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
