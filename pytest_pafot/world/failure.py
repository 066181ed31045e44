"""What is recorded of an ADS that raised, hung, or returned something that is no action."""

from __future__ import annotations

import traceback
from typing import Any

from pytest_pafot.trace import AdsError
from pytest_pafot.world import guard as guard_module
from pytest_pafot.world.guard import AdsHang, HangGuard
from pytest_pafot.world.kernel.action import BadAction, one_line

UNFIT = (AdsHang, Exception, SystemExit)
"""Whatever the user's code raises is a finding."""


def error_of(error: BaseException, tick: int, guard: HangGuard) -> AdsError:
    """What went wrong in a decision, told.

    Args:
        error: one of :data:`UNFIT`.
        tick: of the decision.
        guard: of the decision, which has ended.
    """
    if isinstance(error, BadAction):
        return AdsError(kind="BadAction", message=str(error), traceback="", tick=tick)
    if isinstance(error, AdsHang):
        guard.decision_ends()
        message = "one decision took longer than the hang limit of the world and was interrupted"
        return AdsError(kind="Hang", message=message, traceback=_where(error), tick=tick, interrupted=True)
    report = traceback.TracebackException(type(error), error, _users_part(error))
    return AdsError(
        kind=type(error).__name__,
        message=one_line(str(report)),
        traceback="".join(report.format()),
        tick=tick,
    )


def _where(hang: AdsHang) -> str:
    """The stack at which a decision was interrupted, without the frames of the interruption."""
    frames = traceback.extract_tb(_users_part(hang))
    kept = [frame for frame in frames if frame.filename != guard_module.__file__]
    return "".join(["Traceback (most recent call last):\n", *traceback.StackSummary.from_list(kept).format()])


def _users_part(error: BaseException) -> Any:
    """The traceback without this package's own frames at its top."""
    frames = error.__traceback__
    while frames is not None and frames.tb_next is not None and _is_own(frames.tb_frame.f_globals):
        frames = frames.tb_next
    return frames


def _is_own(module: dict[str, Any]) -> bool:
    return str(module.get("__name__")).startswith(f"{__package__}.")
