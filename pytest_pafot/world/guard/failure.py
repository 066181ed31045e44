"""What is recorded of an ADS that raised, hung, or returned something that is no action."""

from __future__ import annotations

import bdb
import signal
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Any

from pytest_pafot.model.trace import AdsError
from pytest_pafot.support.errors import BadAction
from pytest_pafot.support.text import one_line
from pytest_pafot.world.guard import hang_guard
from pytest_pafot.world.guard.hang_guard import AdsHang, HangGuard

UNFIT = BaseException
"""Whatever comes out of the user's code, to be caught where :func:`let_through` sorts out what is not its own doing."""

OWN = ("pytest_pafot.world.", "pytest_pafot.policies.")
"""Modules between the ADS and a run, in whose frames nobody looks for a mistake of the ADS."""

TIMEOUT_PLUGINS = ("pytest_timeout",)
"""Their failure says that the time of a test is over, and nothing of the code that ran just then."""

DEBUGGER = "_pytest.debugging"
"""The module in which pytest ends the session when the user quits the debugger."""


def exits() -> tuple[type[BaseException], ...]:
    """What ``pytest.exit()`` raises: whoever calls it has imported pytest, which this room does not know."""
    return (sys.modules["pytest"].exit.Exception,) if "pytest" in sys.modules else ()


def is_interruption(error: BaseException, *, is_of_ads: bool = False) -> bool:
    """Whether an exception ends a session, a debugger's or the time of a test, and says nothing of who raised it.

    Everything else that comes out of the user's code is its own doing, whatever it derives from: a panic of a native
    library, a cancelled task, or ``pytest.skip()``, which nobody would hear of. A test function may call
    ``pytest.exit()``, and an ADS may not: with a status of 0 the session would pass.
    """
    if isinstance(error, BaseExceptionGroup):
        return any(is_interruption(each, is_of_ads=is_of_ads) for each in error.exceptions)
    if isinstance(error, (KeyboardInterrupt, bdb.BdbQuit)):
        return True
    if isinstance(error, exits()):
        return not is_of_ads or (getattr(error, "returncode", None) != 0 and _is_from_outside(error))
    modules = [str(frame.f_globals.get("__name__", "")) for frame, _ in traceback.walk_tb(error.__traceback__)]
    return any(module.partition(".")[0] in TIMEOUT_PLUGINS for module in modules)


def let_through(error: BaseException) -> None:
    """Raise again what is an interruption; called where any exception of an ADS is caught."""
    if is_interruption(error, is_of_ads=True):
        raise error


def _is_from_outside(error: BaseException) -> bool:
    """Whether a debugger or the handler of a signal, such as SIGTERM, raised an exception, wherever it arrived."""
    handlers = [getattr(signal.getsignal(number), "__code__", None) for number in signal.valid_signals()]
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    return any(frame.f_globals.get("__name__") == DEBUGGER or frame.f_code in handlers for frame in frames)


def error_of(error: BaseException, tick: int, guard: HangGuard) -> AdsError:
    """What went wrong in a decision that has ended, told; an interruption is raised again."""
    let_through(error)
    if isinstance(error, BadAction):
        return AdsError(kind="BadAction", message=str(error), traceback="", tick=tick)
    if isinstance(error, AdsHang):
        guard.decision_ends()
        frames = traceback.extract_tb(_users_part(error))
        kept = [frame for frame in frames if frame.filename != hang_guard.__file__]  # what interrupted it
        where = "".join(["Traceback (most recent call last):\n", *traceback.StackSummary.from_list(kept).format()])
        message = "one decision took longer than the hang limit of the world and was interrupted"
        return AdsError(kind="Hang", message=message, traceback=where, tick=tick, interrupted=True)
    report = traceback.TracebackException(type(error), error, _users_part(error))
    return AdsError(
        kind=type(error).__name__, message=one_line(str(report)), traceback="".join(report.format()), tick=tick
    )


def _users_part(error: BaseException) -> TracebackType | None:
    """The traceback without this package's own frames at its top."""
    frames = error.__traceback__
    while frames is not None and frames.tb_next is not None:
        if not str(frames.tb_frame.f_globals.get("__name__")).startswith(OWN):
            break
        frames = frames.tb_next
    return frames


# The end of an ADS, when the run that it drives is over.


@contextmanager
def closing(ads: Any, hang_limit: float) -> Iterator[None]:
    """Call the method ``close`` of an ADS, where it has one, when a ``with`` block ends, however that ends.

    What the ADS has driven by then counts as it was: where ``close`` raises, or takes longer than ``hang_limit`` [s], a
    ``RuntimeWarning`` says so.
    """
    try:
        yield
    finally:
        close = None if isinstance(ads, type) else getattr(ads, "close", None)
        if callable(close):
            _close(close, HangGuard(hang_limit))


def _close(close: Callable[[], Any], guard: HangGuard) -> None:
    try:
        with guard:
            guard.decision_starts()
            try:
                close()
            finally:
                guard.decision_ends()
    except UNFIT as error:
        failed = error_of(error, 0, guard)
        what = f"that it takes at most the hang limit, {guard.limit:g} s" if failed.interrupted else "no exception"
        received = "one that was interrupted then" if failed.interrupted else f"{failed.kind}: {failed.message}"
        text = f"ads.close: expected {what}, received {received}; the run before it counts as it was"
        warnings.warn(text, RuntimeWarning, stacklevel=2)
