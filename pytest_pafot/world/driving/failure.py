"""What is recorded of an ADS that raised, hung, or returned something that is no action."""

from __future__ import annotations

import bdb
import sys
import traceback
from types import TracebackType

from pytest_pafot.trace import AdsError
from pytest_pafot.world.driving import hang_guard
from pytest_pafot.world.driving.hang_guard import AdsHang, HangGuard
from pytest_pafot.world.kernel.action import BadAction, one_line

UNFIT = BaseException
"""Whatever comes out of the user's code, to be caught where :func:`let_through` sorts out what is not its own doing."""

OWN = ("pytest_pafot.world.", "pytest_pafot.policies.")
"""Modules between the ADS and a run, in whose frames nobody looks for a mistake of the ADS."""

TIMEOUT_PLUGINS = ("pytest_timeout",)
"""Their failure says that the time of a test is over, and nothing of the code that ran just then."""


def is_interruption(error: BaseException) -> bool:
    """Whether an exception ends a session, a debugger's or the time of a test, and says nothing of who raised it.

    Everything else that comes out of the user's code is its own doing, whatever it derives from: a panic of a native
    library, a cancelled task, or ``pytest.skip()``, which nobody would hear of.
    """
    if isinstance(error, BaseExceptionGroup):
        return any(is_interruption(each) for each in error.exceptions)
    # What `pytest.exit()` raises: whoever calls it has imported pytest, which this room does not know.
    exits = (sys.modules["pytest"].exit.Exception,) if "pytest" in sys.modules else ()
    if isinstance(error, (KeyboardInterrupt, bdb.BdbQuit, *exits)):
        return True
    modules = [str(frame.f_globals.get("__name__", "")) for frame, _ in traceback.walk_tb(error.__traceback__)]
    return any(module.partition(".")[0] in TIMEOUT_PLUGINS for module in modules)


def let_through(error: BaseException) -> None:
    """Raise again what is an interruption; called where any exception is caught."""
    if is_interruption(error):
        raise error


def error_of(error: BaseException, tick: int, guard: HangGuard) -> AdsError:
    """What went wrong in a decision that has ended, told; an interruption is raised again."""
    let_through(error)
    if isinstance(error, BadAction):
        return AdsError(kind="BadAction", message=str(error), traceback="", tick=tick)
    if isinstance(error, AdsHang):
        guard.decision_ends()
        message = "one decision took longer than the hang limit of the world and was interrupted"
        return AdsError(kind="Hang", message=message, traceback=_where(error), tick=tick, interrupted=True)
    report = traceback.TracebackException(type(error), error, _users_part(error))
    return AdsError(
        kind=type(error).__name__, message=one_line(str(report)), traceback="".join(report.format()), tick=tick
    )


def _where(hang: AdsHang) -> str:
    """The stack at which a decision was interrupted, without the frames of the interruption."""
    frames = traceback.extract_tb(_users_part(hang))
    kept = [frame for frame in frames if frame.filename != hang_guard.__file__]
    return "".join(["Traceback (most recent call last):\n", *traceback.StackSummary.from_list(kept).format()])


def _users_part(error: BaseException) -> TracebackType | None:
    """The traceback without this package's own frames at its top."""
    frames = error.__traceback__
    while frames is not None and frames.tb_next is not None:
        if not str(frames.tb_frame.f_globals.get("__name__")).startswith(OWN):
            break
        frames = frames.tb_next
    return frames
