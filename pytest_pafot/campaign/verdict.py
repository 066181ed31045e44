"""The user's test function as an oracle: what it says of one run, in a verdict and in one line."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

from pytest_pafot.campaign.request import RequestError
from pytest_pafot.findings.finding import ads_failure, raised_failure
from pytest_pafot.findings.severity import Severity, severity_of
from pytest_pafot.findings.signature import Failure
from pytest_pafot.model.grid import Cell
from pytest_pafot.model.trace import Outcome
from pytest_pafot.oracle.checks import Check, Recording, Rejected, recorded
from pytest_pafot.oracle.run import ReferenceOutcome, Run, preventing, reference_outcome
from pytest_pafot.world.guard.failure import UNFIT, is_interruption

Test = Callable[[Run], Any]
"""The user's function with everything but the run filled in; it asserts, and returns None."""


class PlainFailure(Exception):  # noqa: N818  (it is shown as what failed)
    """A failure that is told by its text alone: a traceback would show code of this package."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """What the oracle says of a run."""

    # ``failed`` is a find; ``rejected`` and ``skipped`` are no judgement; ``npc`` is a collision that an NPC is
    # responsible for, unless ``blame="any"``; ``unpreventable`` a failure that no reference driver would have
    # prevented, under ``blame="preventable"``; ``common`` one that the reference does not pass either, where there is
    # one; ``invalid`` a crash between NPCs
    kind: Literal["passed", "failed", "rejected", "skipped", "npc", "unpreventable", "common", "invalid"]
    exception: BaseException | None = None  # that the function raised, where it failed or skipped
    failure: Failure | None = None
    checks: tuple[Check, ...] = ()  # those that the function made, in its order, up to one that failed
    is_timed: bool = False  # whether it depends on wall-clock time
    is_ads: bool = False  # whether the ADS itself failed, whatever the function asserts
    severity: Severity | None = None  # of the failure; None where there is none, or nothing measures it
    reference: Verdict | None = None  # on the run of the reference in the same scenario; None where it was not run

    @property
    def failed(self) -> bool:
        """Whether this is a find."""
        return self.kind == "failed"

    @property
    def passes(self) -> bool:
        """Whether a test passes in which this happens, by its blame."""
        return self.kind in ("passed", "npc", "unpreventable")

    @property
    def discarded(self) -> bool:
        """Whether the function declined to judge."""
        return self.kind in ("rejected", "skipped")

    def beside(self, reference: Verdict) -> Self:
        """A failure beside the verdict on the reference in the same scenario, which must pass for it to count."""
        return replace(self, kind="failed" if reference.passes else "common", reference=reference)


def judge(run: Run, test: Test, *, blame: str, test_file: str) -> Verdict:
    """Judge a run: by the function, except where the ADS or the NPCs themselves failed.

    Unless blame is ``any`` the function is not asked about collisions that an NPC is responsible for. With
    ``preventable`` what it asserts counts only where a reference driver would have prevented the failure; what it
    raises else is an error of its own. A failure is identified by the line of the ``test_file`` that failed.

    Raises:
        BaseException: what says nothing of the run: an interrupt, the end of the session, a timeout of the item,
            the end of a debugging session, or a function that cannot be an oracle.
        NoReferenceDriversError: with ``preventable``, for a failing run whose world has no reference drivers.
    """
    if run.outcome is Outcome.INVALID:
        return Verdict(kind="invalid")
    broken = ads_failure(run)
    if broken is None or run.ads_error is None:
        is_excused = blame != "any" and run.responsibility == "npc"
        verdict = Verdict(kind="npc") if is_excused else _asked(run, test, test_file)
        if blame == "preventable" and isinstance(verdict.exception, assertions()):
            outcomes = reference_outcomes(run, test, blame=blame, test_file=test_file)
            if next(preventing(outcomes, run.responsibility), None) is None:
                verdict = Verdict(kind="unpreventable")
        if broken is None or verdict.failed:
            return verdict
    is_timed = run.ads_error is None or run.outcome is Outcome.HANG
    exception = PlainFailure(ads_text(broken, " (depends on wall-clock time)" if is_timed else ""))
    return Verdict(kind="failed", exception=exception, failure=broken, is_timed=is_timed, is_ads=True)


def reference_outcomes(run: Run, test: Test, *, blame: str, test_file: str) -> Iterator[tuple[str, ReferenceOutcome]]:
    """What becomes of each reference driver in the ego's place, simulated one after the other, judged as the ego is.

    Left out are drivers whose run says nothing: two NPCs touched in it, or the function declined to judge.
    """
    blame = "any" if blame == "any" else "ego"
    for name, other in run.by_reference_drivers():
        verdict = judge(other, test, blame=blame, test_file=test_file)
        if verdict.kind in ("passed", "failed", "npc"):
            yield name, reference_outcome(other, fails=verdict.kind != "passed")


def worst_margins(verdict: Verdict) -> tuple[tuple[str, float], ...]:
    """The worst margin of each check by its name, in the order of the names."""
    worst: dict[str, float] = {}
    for each in verdict.checks:
        worst[each.name] = min(each.margin, worst.get(each.name, math.inf))
    return tuple(sorted(worst.items()))


def _asked(run: Run, test: Test, test_file: str) -> Verdict:
    recording = Recording(hz=run.trace.physics_hz, ticks=run.trace.ticks, npcs=len(run.scenario.npcs))
    try:
        with recorded(recording):
            result = test(run)
    except Rejected:
        return Verdict(kind="rejected")
    except skips() as skipped:
        return Verdict(kind="skipped", exception=skipped)
    except RequestError:
        raise
    except UNFIT as error:
        if is_interruption(error):
            raise
        failure = raised_failure(error, test_file)
        return Verdict(
            kind="failed",
            exception=error,
            failure=failure,
            checks=tuple(recording.checks),
            severity=severity_of(run, failure),
        )
    if result is not None:
        raise RequestError(
            f"expected the test function to assert and to return None, received the return value {result!r:.60}; write "
            "`assert ...` in place of `return ...`"
        )
    return Verdict(kind="passed", checks=tuple(recording.checks))


def ads_text(failure: Failure, timing: str = "") -> str:
    """What the ADS did in place of a decision, with the traceback where it raised."""
    text = f"the ADS failed: {failure.kind}: {failure.message}{timing}"
    return f"{text}\n\n{failure.traceback.rstrip()}" if failure.traceback else text


def headline(run: Run, verdict: Verdict) -> str:
    """One line on a find: what happened in the run, and what the function said where that is not the same."""
    if verdict.is_ads and verdict.failure is not None:
        return f"{verdict.failure.kind}: {verdict.failure.message}"
    if verdict.failure is not None and verdict.failure.check is not None:
        return str(verdict.failure.check)
    line = collision_in_short(run) or run.explain().splitlines()[0]
    first = verdict.failure.message.partition("\n")[0].strip() if verdict.failure is not None else ""
    is_bare = run.collision is not None and first.startswith("assert ")
    if is_bare or not first or line.partition(":")[0].partition(" at ")[0] in first:
        return line
    kind = "" if isinstance(verdict.exception, AssertionError) else f"{type(verdict.exception).__name__}: "
    return f"{kind}{first[:120]} ({line})"


def collision_in_short(run: Run) -> str:
    """One line on the collision of a run: when, how fast they closed in, with whom, whose fault; empty without one."""
    hit = run.collision
    if hit is None:
        return ""
    zone = run.zone_of(hit)
    if zone is None and hit.cell is not None:
        place = hit.cell.label.replace("front", "ahead").replace("rear", "behind").replace("-", " ")
        place = f" on the {place}" if hit.cell in (Cell.LEFT, Cell.RIGHT) else f" {place}"
    else:
        place = "" if zone is None else f" {zone.whence}"
    who = {"ego": "ego", "npc": "NPC", "both": "both"}.get(run.responsibility or "", "nobody")
    return f"collision after {hit.time:.1f} s at {hit.closing_speed:.1f} m/s: NPC {hit.npc}{place}, {who} at fault"


def skips() -> tuple[type[BaseException], ...]:
    """What pytest reports as a skip or an expected failure, which only the test function may decide.

    Whoever raises one of these has imported its module, which this room does not know.
    """
    pytest, unittest = sys.modules.get("pytest"), sys.modules.get("unittest")
    of_pytest = () if pytest is None else (pytest.skip.Exception, pytest.xfail.Exception)
    return of_pytest if unittest is None else (*of_pytest, unittest.SkipTest)


def assertions() -> tuple[type[BaseException], ...]:
    """What a test function says that a property does not hold with, rather than that something went wrong in it."""
    pytest = sys.modules.get("pytest")
    return (AssertionError,) if pytest is None else (AssertionError, pytest.fail.Exception)


def no_skip(who: str, error: BaseException) -> str:
    """Why a skip cannot be heeded that comes from somewhere in the middle of a search."""
    return (
        f"expected {who} to raise no skip, which would hide that nothing was tested, received "
        f"{type(error).__name__}: {error}; call pytest.skip() in the fixture or in the test function, or mark the test "
        "with @pytest.mark.skipif"
    )
