"""The user's test function as an oracle: what it says of one run."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import pytest

from pytest_pafot.campaign.request import RequestError
from pytest_pafot.rejection import Rejected

if TYPE_CHECKING:
    from pytest_pafot.findings.signature import Failure
    from pytest_pafot.run import Run

Kind = Literal["passed", "failed", "rejected", "skipped", "npc", "invalid"]

Test = Callable[["Run"], None]
"""The user's function with everything but the run filled in."""


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
    """The test function with its fixtures, called as pytest calls it, with a run in the place of its argument.

    Raises:
        RequestError: for a fixture that keeps failures from leaving the function; when it is called, for a function
            that returns something, or that has collected failures with pytest-check.
    """
    for name, value in item.funcargs.items():
        if isinstance(value, pytest.Subtests) or type(value).__module__.partition(".")[0] == "pytest_subtests":
            raise RequestError(_no_collecting(f"the fixture {name!r}"))
    names = inspect.signature(item.obj).parameters
    fixed = {name: item.funcargs[name] for name in names if name in item.funcargs}

    def test(run: Run) -> None:
        # pytest's own traceback filter cuts everything up to the user's function.
        result = item.obj(**{**fixed, arg: run})
        if result is not None:
            raise RequestError(
                "expected the test function to assert and to return None, received the return value "
                f"{result!r:.60}; write `assert ...` in place of `return ...`"
            )
        check = sys.modules.get("pytest_check")
        if check is not None and check.any_failures():
            raise RequestError(_no_collecting("pytest-check"))

    return test


def _no_collecting(what: str) -> str:
    return (
        f"expected a test function that raises at its first failure, which is the finding, received one with {what}, "
        "which collects failures, so that the function ends as if it had passed; write `assert ...`, and a test of its "
        "own for each property"
    )


def _asked(run: Run, test: Test, test_file: str) -> Verdict:
    from pytest_pafot.findings.finding import raised_failure  # noqa: PLC0415
    from pytest_pafot.world.driving.failure import UNFIT, let_through  # noqa: PLC0415

    try:
        test(run)
    except Rejected:
        return Verdict(kind="rejected")
    except skips() as skipped:
        return Verdict(kind="skipped", exception=skipped)
    except RequestError:
        raise
    except UNFIT as error:
        let_through(error)
        return Verdict(kind="failed", exception=error, failure=raised_failure(error, test_file))
    return Verdict(kind="passed")


def _ads_verdict(failure: Failure, *, is_timed: bool) -> Verdict:
    timing = " (depends on wall-clock time)" if is_timed else ""
    exception = plain_failure(ads_text(failure, timing))
    return Verdict(kind="failed", exception=exception, failure=failure, is_timed=is_timed, is_ads=True)


def ads_text(failure: Failure, timing: str = "") -> str:
    """What the ADS did in place of a decision, with the traceback where it raised."""
    text = f"the ADS failed: {failure.kind}: {failure.message}{timing}"
    return f"{text}\n\n{failure.traceback.rstrip()}" if failure.traceback else text


def skips() -> tuple[type[BaseException], ...]:
    """What pytest reports as a skip or an expected failure, which only the test function may decide."""
    unittest = sys.modules.get("unittest")  # pytest looks there as well; who raises its SkipTest has imported it
    own = (pytest.skip.Exception, pytest.xfail.Exception)
    return own if unittest is None else (*own, unittest.SkipTest)


def no_skip(who: str, error: BaseException) -> str:
    """Why a skip cannot be heeded that comes from somewhere in the middle of a search."""
    return (
        f"expected {who} to raise no skip, which would hide that nothing was tested, received "
        f"{type(error).__name__}: {error}; call pytest.skip() in the fixture or in the test function, or mark the test "
        "with @pytest.mark.skipif"
    )


def plain_failure(text: str) -> BaseException:
    """A failure of the item that is shown as this text, without a traceback of the plugin's own code."""
    failure: BaseException = pytest.fail.Exception(text, pytrace=False)
    return failure


def is_asynchronous(function: Any) -> bool:
    """Whether calling a function only makes a coroutine or an asynchronous generator."""
    return inspect.iscoroutinefunction(function) or inspect.isasyncgenfunction(function)
