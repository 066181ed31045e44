"""The user's test function as an oracle: what it says of one run."""

from __future__ import annotations

import bdb
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal

import pytest

from pytest_pafot.plugin.marks import Rejected
from pytest_pafot.plugin.request import RequestError

if TYPE_CHECKING:
    from pytest_pafot.findings.run import Run
    from pytest_pafot.findings.signature import Failure

Kind = Literal["passed", "failed", "rejected", "skipped", "npc", "invalid"]

Test = Callable[["Run"], None]
"""The user's function with everything but the run filled in."""

TIMEOUT_PLUGINS = ("pytest_timeout",)
"""Their failure says that the time of the item is over, and nothing of the run that was judged just then."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """What the oracle says of a run.

    Attributes:
        kind: ``failed`` is a find; ``rejected`` and ``skipped`` are no judgement; ``npc`` is a collision that an NPC
            is responsible for, under ``blame="ego"``; ``invalid`` a crash between NPCs.
        exception: that the function raised, where it failed or skipped.
        failure: what identifies the failure.
        is_timed: whether it depends on wall-clock time.
        is_ads: whether the ADS itself failed, whatever the function asserts.
    """

    kind: Kind
    exception: BaseException | None = None
    failure: Failure | None = None
    is_timed: bool = False
    is_ads: bool = False

    @property
    def failed(self) -> bool:
        """Whether this is a find."""
        return self.kind == "failed"

    @property
    def discarded(self) -> bool:
        """Whether the function declined to judge."""
        return self.kind in ("rejected", "skipped")


def judge(run: Run, test: Test, *, blame: str, test_file: str) -> Verdict:
    """Judge a run: by the function, except where the ADS or the NPCs themselves failed.

    Raises:
        BaseException: what says nothing of the run: an interrupt, the end of the session, a timeout of the item,
            the end of a debugging session, or a function that cannot be an oracle.
    """
    from pytest_pafot.findings.finding import ads_failure  # noqa: PLC0415
    from pytest_pafot.trace import Outcome  # noqa: PLC0415

    if run.outcome is Outcome.INVALID:
        return Verdict(kind="invalid")
    broken = ads_failure(run)
    if run.ads_error is not None and broken is not None:
        return _ads_verdict(broken, is_timed=run.outcome is Outcome.HANG)
    is_excused = blame == "ego" and run.responsibility == "npc"
    verdict = Verdict(kind="npc") if is_excused else _asked(run, test, test_file)
    if broken is not None and not verdict.failed:
        return _ads_verdict(broken, is_timed=True)
    return verdict


def bound_test(item: pytest.Function, arg: str) -> Test:
    """The test function with its fixtures, called as pytest calls it, with a run in the place of its argument."""
    names = inspect.signature(item.obj).parameters
    fixed = {name: item.funcargs[name] for name in names if name in item.funcargs}

    def test(run: Run) -> None:
        # pytest's own traceback filter cuts everything up to the user's function.
        result = item.obj(**{**fixed, arg: run})
        if result is not None:
            raise RequestError(
                f"{item.name}: expected the test function to assert and to return None, received the return value "
                f"{result!r:.60}; write `assert ...` in place of `return ...`"
            )

    return test


def _asked(run: Run, test: Test, test_file: str) -> Verdict:
    from pytest_pafot.findings.finding import raised_failure  # noqa: PLC0415

    try:
        test(run)
    except Rejected:
        return Verdict(kind="rejected")
    except (pytest.skip.Exception, pytest.xfail.Exception) as skipped:
        return Verdict(kind="skipped", exception=skipped)
    except (KeyboardInterrupt, GeneratorExit, pytest.exit.Exception, bdb.BdbQuit, RequestError):
        raise
    except BaseException as error:
        if _is_timeout(error):
            raise
        return Verdict(kind="failed", exception=error, failure=raised_failure(error, test_file))
    return Verdict(kind="passed")


def _ads_verdict(failure: Failure, *, is_timed: bool) -> Verdict:
    timing = " (depends on wall-clock time)" if is_timed else ""
    text = f"the ADS failed: {failure.kind}: {failure.message}{timing}"
    if failure.traceback:
        text = f"{text}\n\n{failure.traceback.rstrip()}"
    return Verdict(kind="failed", exception=plain_failure(text), failure=failure, is_timed=is_timed, is_ads=True)


def _is_timeout(error: BaseException) -> bool:
    return any(module.partition(".")[0] in TIMEOUT_PLUGINS for module in _modules(error.__traceback__))


def _modules(traceback: TracebackType | None) -> list[str]:
    modules: list[str] = []
    while traceback is not None:
        modules.append(str(traceback.tb_frame.f_globals.get("__name__", "")))
        traceback = traceback.tb_next
    return modules


def plain_failure(text: str) -> BaseException:
    """A failure of the item that is shown as this text, without a traceback of the plugin's own code."""
    failure: BaseException = pytest.fail.Exception(text, pytrace=False)
    return failure


def is_asynchronous(function: Any) -> bool:
    """Whether calling a function only makes a coroutine or an asynchronous generator."""
    return inspect.iscoroutinefunction(function) or inspect.isasyncgenfunction(function)
