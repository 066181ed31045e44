"""The record of an ADS that raised an exception, hung, or returned an invalid action; and the call of its ``close``."""

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

from pytest_pafot.model.trace import WORLD_HANG, AdsError
from pytest_pafot.support.errors import BadAction, OutOfTime
from pytest_pafot.support.text import one_line
from pytest_pafot.world.guard import hang_guard
from pytest_pafot.world.guard.hang_guard import AdsHang, HangGuard, WorldHang

UNFIT = BaseException
"""The class to catch around the user's code. Call :func:`let_through` afterwards: it raises again every exception that
the code did not cause."""

OWN = ("pytest_pafot.world.", "pytest_pafot.policies.", "pytest_pafot.testing.", "contextlib")
"""The prefixes of modules between the ADS and a run, whose frames are left out of tracebacks."""

TIMEOUT_PLUGINS = ("pytest_timeout",)
"""The plugins whose exceptions report that a test's time is over, and not an error in the code that was running."""

DEBUGGER = "_pytest.debugging"
"""The module in which pytest ends the session when the user quits the debugger."""


class Around:
    """An ADS around another one, which may get the method ``close`` that a run calls only when it has driven."""

    def __init__(self, ads: Any) -> None:
        self._ads = ads

    def close(self) -> None:
        """Close the other ADS, if it has a method for that."""
        close = getattr(self._ads, "close", None)
        if callable(close):
            close()


def exits() -> tuple[type[BaseException], ...]:
    """Return the exception class of ``pytest.exit()`` in a tuple, which is empty if pytest has not been imported."""
    return (sys.modules["pytest"].exit.Exception,) if "pytest" in sys.modules else ()


def is_interruption(error: BaseException, *, is_of_ads: bool = False) -> bool:
    """Return whether an exception ends the session, leaves a debugger, or reports that a time limit is over.

    Every other exception is a failure of the user's code, whatever its class: a panic of a native library, a cancelled
    task, or ``pytest.skip()``, which would otherwise go unnoticed. A test function may call ``pytest.exit()``, but an
    ADS (``is_of_ads``) may not, because with a status of 0 the session would pass.
    """
    if isinstance(error, BaseExceptionGroup):
        return any(is_interruption(each, is_of_ads=is_of_ads) for each in error.exceptions)
    if isinstance(error, (KeyboardInterrupt, bdb.BdbQuit, OutOfTime)):
        return True
    if isinstance(error, exits()):
        return not is_of_ads or (getattr(error, "returncode", None) != 0 and _is_from_outside(error))
    modules = [str(frame.f_globals.get("__name__", "")) for frame, _ in traceback.walk_tb(error.__traceback__)]
    return any(module.partition(".")[0] in TIMEOUT_PLUGINS for module in modules)


def let_through(error: BaseException) -> None:
    """Raise an exception again if it is an interruption; call this wherever all exceptions of an ADS are caught."""
    if is_interruption(error, is_of_ads=True):
        raise error


def _is_from_outside(error: BaseException) -> bool:
    """Return whether a debugger or a signal handler, such as one for SIGTERM, raised an exception."""
    handlers = [getattr(signal.getsignal(number), "__code__", None) for number in signal.valid_signals()]
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    return any(frame.f_globals.get("__name__") == DEBUGGER or frame.f_code in handlers for frame in frames)


def error_of(error: BaseException, tick: int, guard: HangGuard) -> AdsError:
    """Return the record of an exception in a decision; an interruption is raised again."""
    let_through(error)
    if isinstance(error, BadAction):
        return AdsError(kind="BadAction", message=str(error), traceback="", tick=tick)
    if isinstance(error, AdsHang):
        guard.decision_ends()
        frames = traceback.extract_tb(_users_part(error))
        kept = [frame for frame in frames if frame.filename != hang_guard.__file__]  # without the guard's own frames
        where = "".join(["Traceback (most recent call last):\n", *traceback.StackSummary.from_list(kept).format()])
        kind, message = "Hang", "one decision took longer than the hang limit of the world and was interrupted"
        if isinstance(error, WorldHang):
            kind, message = WORLD_HANG, str(error)
        return AdsError(kind=kind, message=message, traceback=where, tick=tick, interrupted=True)
    report = traceback.TracebackException(type(error), error, _users_part(error))
    return AdsError(
        kind=type(error).__name__, message=one_line(str(report)), traceback="".join(report.format()), tick=tick
    )


def _users_part(error: BaseException) -> TracebackType | None:
    """Return the traceback without this package's own frames at its top."""
    frames = error.__traceback__
    while frames is not None and frames.tb_next is not None:
        if not str(frames.tb_frame.f_globals.get("__name__")).startswith(OWN):
            break
        frames = frames.tb_next
    return frames


@contextmanager
def closing(ads: Any, hang_limit: float) -> Iterator[None]:
    """Call the ``close`` method of an ADS, if it has one, when a ``with`` block ends, also after an exception.

    A failure of ``close`` does not change the result of the run. If it raises, or takes longer than ``hang_limit`` [s],
    there is a ``RuntimeWarning``, also where warnings are errors.
    """
    try:
        yield
    finally:
        close = None if isinstance(ads, type) else getattr(ads, "close", None)
        if callable(close):
            call_close(close, "ads.close", hang_limit)


def call_close(close: Callable[[], Any], name: str, limit: float) -> None:
    """Call a method ``close`` of the user's; warn if it raises, or takes longer than ``limit`` [s].

    The warning is never an error, unlike others where the user makes errors of warnings, as ``-W error`` does.
    """
    guard = HangGuard(limit, is_limited=False)
    try:
        with guard:
            guard.decision_starts()
            try:
                close()
            finally:
                guard.decision_ends()
            guard.raise_swallowed()
    except UNFIT as error:
        failed = error_of(error, 0, guard)
        what = f"a return within {guard.limit:g} s" if failed.interrupted else "no exception"
        received = "no return, so it was interrupted" if failed.interrupted else f"{failed.kind}: {failed.message}"
        text = f"{name}: expected {what}, received {received}; this does not change the result of the run"
        try:
            warnings.warn(text, RuntimeWarning, stacklevel=2)
        except RuntimeWarning:  # of a filter for errors: it would hide the error of the run, or end pytest's summary
            with warnings.catch_warnings():
                warnings.simplefilter("always")
                warnings.warn(text, RuntimeWarning, stacklevel=2)
