"""The user's test function as an oracle: its verdict on one run, and the verdict as a line of text."""

from __future__ import annotations

import inspect
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

from pytest_pafot.attribution.sentences import AT_FAULT
from pytest_pafot.findings.finding import Expect, ads_failure, raised_failure
from pytest_pafot.findings.severity import severity_of
from pytest_pafot.findings.signature import Failure, Signature
from pytest_pafot.findings.verdict import Verdict
from pytest_pafot.model.grid import Cell
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import WORLD_HANG, Outcome
from pytest_pafot.oracle.checks import Recording, Rejected, recorded
from pytest_pafot.oracle.run import ReferenceOutcome, Run, preventing, reference_outcome
from pytest_pafot.searching.evaluation import Evaluation
from pytest_pafot.support.errors import DriverError, RequestError
from pytest_pafot.world.guard.hang_guard import UNFIT, is_interruption

Test = Callable[[Run], Any]
"""The user's test function with all arguments except the run filled in. It asserts, and returns None."""


class PlainFailure(Exception):  # noqa: N818  (its name is printed as the failure)
    """A failure that is reported without a traceback, which would only show code of this package."""


def source_file(function: Callable[..., Any], default: str = "") -> str:
    """Return the source file of a function, not of decorators around it; ``default`` if it is unknown."""
    code = getattr(inspect.unwrap(function), "__code__", None)
    return default if code is None else str(code.co_filename)


def judge(run: Run, test: Test, *, blame: str, test_file: str | None = None) -> Verdict:
    """Judge a run by the test function, unless the ADS itself failed or NPCs touched.

    Unless ``blame`` is ``any``, the function is not called for collisions for which only an NPC is responsible; with
    ``avoidable``, it is called for those of them that braking late, but hard, would have avoided. With ``preventable``,
    a failing assertion counts only if a reference driver would have prevented the failure. Any other exception is an
    error of the function. A failure is identified by the line in ``test_file`` that failed,
    by default in the file of the function.

    Raises:
        BaseException: any exception that says nothing about the run, such as an interrupt, the end of the session, a
            timeout of the item, the end of a debugging session, or a function that cannot be an oracle.
        NoReferenceDriversError: with ``preventable``, for a failing run in a world without reference drivers.
        RequestError: with ``preventable``, if the world cannot simulate a reference driver.
    """
    if run.outcome is Outcome.INVALID:
        return Verdict(kind="invalid")
    test_file = source_file(test) if test_file is None else test_file
    if (broken := ads_failure(run)) is not None:
        is_timed = run.outcome is Outcome.HANG
        exception = PlainFailure(ads_text(broken, " (depends on wall-clock time)" if is_timed else ""))
        return Verdict(kind="failed", exception=exception, failure=broken, is_timed=is_timed, is_ads=True)
    is_excused, avoidable = blame != "any" and run.responsibility == "npc", run.attribution.avoidable
    if is_excused and avoidable and blame != "avoidable":
        verdict = Verdict(kind="avoidable", excused=" ".join(run.attribution.sentences[:1]))
    elif is_excused and not avoidable:
        verdict = Verdict(kind="npc")
    else:
        verdict = _verdict_of_test(run, test, test_file)
    if blame == "preventable" and isinstance(verdict.exception, assertions()):
        outcomes = reference_outcomes(run, test, blame=blame, test_file=test_file)
        try:
            is_preventable = next(preventing(outcomes, run.responsibility), None) is not None
        except DriverError as error:  # Without the driver nobody knows whether the failure counts.
            raise RequestError(f"blame='preventable': {error}; correct the world, or use blame='ego'") from error
        if not is_preventable:
            verdict = Verdict(kind="unpreventable")
    return verdict


def reference_outcomes(
    run: Run, test: Test, *, blame: str, test_file: str | None = None, names: Sequence[str] | None = None
) -> Iterator[tuple[str, ReferenceOutcome]]:
    """Yield the outcome of each reference driver in the ego's place. Its run is judged like the run of the ego.

    The drivers are simulated one after the other; ``names`` are some of them. A driver is left out if two NPCs touched
    in its run, or if the test function declined to judge the run.

    Raises:
        DriverError: if the world cannot simulate a driver.
    """
    blame = "any" if blame == "any" else "ego"
    for name, other in run.by_reference_drivers(names):
        verdict = judge(other, test, blame=blame, test_file=test_file)
        if verdict.kind in ("passed", "failed", "npc", "avoidable"):
            yield name, reference_outcome(other, fails=verdict.kind != "passed")


def _verdict_of_test(run: Run, test: Test, test_file: str) -> Verdict:
    recording = Recording(hz=run.trace.physics_hz, ticks=run.trace.ticks, npcs=len(run.scenario.npcs))
    try:
        with recorded(recording):
            result = test(run)
    except Rejected:
        return Verdict(kind="rejected")
    except xfails() as error:
        raise RequestError(
            f"expected the test function to call no pytest.xfail(), which would hide a failure, received {error}; "
            "accept a failure by the line `xfail:` in the file of its saved scenario, and leave out runs by "
            "pafot.reject()"
        ) from None
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
            "`assert ...` instead of `return ...`"
        )
    return Verdict(kind="passed", checks=tuple(recording.checks))


def ads_text(failure: Failure, timing: str = "") -> str:
    """Return how the ADS itself, or the environment, failed, with the traceback if it raised."""
    who = "environment" if failure.kind == WORLD_HANG else "ADS"
    text = f"the {who} failed: {failure.kind}: {failure.message}{timing}"
    return f"{text}\n\n{failure.traceback.rstrip()}" if failure.traceback else text


def headline(run: Run, verdict: Verdict) -> str:
    """Return one line on a finding: what happened in the run, and the test function's message if it says more."""
    if verdict.is_ads and verdict.failure is not None:
        return f"{verdict.failure.kind}: {verdict.failure.message}"
    if verdict.failure is not None and verdict.failure.check is not None:
        return str(verdict.failure.check)
    line = collision_in_short(run) or run.explain().splitlines()[0]
    first = verdict.failure.message.partition("\n")[0].strip() if verdict.failure is not None else ""
    is_bare = run.collision is not None and first.startswith("assert ")
    if is_bare or not first or re.split(r":|, | at ", line)[0] in first:
        return line
    kind = "" if isinstance(verdict.exception, AssertionError) else f"{type(verdict.exception).__name__}: "
    return f"{kind}{first[:120]} ({line})"


def collision_in_short(run: Run) -> str:
    """Return one line on a run's collision: time, closing speed, NPC and fault; empty if there was no collision."""
    hit = run.collision
    if hit is None:
        return ""
    zone = run.zone_of(hit)
    if zone is None and hit.cell is not None:
        place = hit.cell.label.replace("front", "ahead").replace("rear", "behind").replace("-", " ")
        place = f" on the {place}" if hit.cell in (Cell.LEFT, Cell.RIGHT) else f" {place}"
    else:
        place = "" if zone is None else f" {zone.whence}"
    what = "a fixed object" if hit.npc is None else f"NPC {hit.npc}"
    who = AT_FAULT[run.attribution.responsibility]
    return f"collision after {hit.time:.1f} s, closing at {hit.closing_speed:.1f} m/s: {what}{place}, {who}"


@dataclass(slots=True)
class Counts:
    """Numbers of runs by kind of verdict, by outcome, and by who was responsible; each adds up to all runs."""

    kinds: Counter[str] = field(default_factory=Counter)
    outcomes: Counter[str] = field(default_factory=Counter)
    responsibilities: Counter[str] = field(default_factory=Counter)

    def add(self, kind: str, outcome: str, responsible: str | None = None) -> None:
        """Count a run; its outcome is ``lost`` if its process died or hung."""
        self.kinds[kind] += 1
        self.outcomes[str(outcome)] += 1
        self.responsibilities[responsible or "none"] += 1

    def __iadd__(self, other: Counts) -> Self:
        """Count the runs of another process."""
        self.kinds.update(other.kinds)
        self.outcomes.update(other.outcomes)
        self.responsibilities.update(other.responsibilities)
        return self


FAILING = ("failed", "unpreventable", "common")
"""The kinds of verdicts on runs that failed, including failures that do not count for some reason."""


def fails_by_ego(verdict: Verdict, responsible: str | None) -> bool:
    """Return whether a run failed by a collision for which the ego is ``responsible``, alone or with the NPC.

    An ADS that raised or hung has failed by itself, even if a collision followed.
    """
    return verdict.kind in FAILING and not verdict.is_ads and responsible in ("ego", "both")


def caught_in(verdict: Verdict) -> tuple[str, ...]:
    """Return the names of the checks that failed in a run that passed, because the test function caught the error."""
    return tuple({check.name for check in verdict.checks if not check.holds}) if verdict.kind == "passed" else ()


def evaluated(
    run: Run,
    verdict: Verdict,
    signature: Signature | None,
    fitness: Callable[[Run], float],
) -> Evaluation:
    """Return what the algorithm sees of a judged run: how bad it was and how it failed, to look for other failures.

    ``signature`` is None if the run is no failure that counts.
    """
    facts = run.facts
    return Evaluation.of(
        run.trace,
        fitness=fitness(run) if facts is None or facts.fitness is None else facts.fitness,
        failing=verdict.failed,
        discarded=verdict.discarded,
        kind=signature,
        margins=verdict.margins,
        interaction=None if facts is None else facts.interaction,
    )


def unknown(scenario: Scenario, expect: Expect | None = None) -> Evaluation:
    """Return the evaluation of a scenario in which a process died: the algorithm learns nothing from it.

    ``expect`` is the failure, None if it does not count or if the scenario was not run again.
    """
    return Evaluation(
        scenario=scenario,
        executed=scenario,
        fitness=0.0,
        failing=expect is not None,
        kind=None if expect is None else expect.signature,
        outcome=Outcome.ADS_ERROR if expect is None else expect.outcome,
        duration=0.0,
        genes_started=0,
        genes_reached=0,
        interaction=False,
        discarded=True,
    )


def skips() -> tuple[type[BaseException], ...]:
    """Return the exception classes that pytest reports as a skip or an xfail. Only the test function may raise a skip.

    They are looked up in ``sys.modules``, because this package does not import pytest. Code that raises such an
    exception has imported its module.
    """
    pytest, unittest = sys.modules.get("pytest"), sys.modules.get("unittest")
    of_pytest = () if pytest is None else (pytest.skip.Exception, *xfails())
    return of_pytest if unittest is None else (*of_pytest, unittest.SkipTest)


def xfails() -> tuple[type[BaseException], ...]:
    """Return the exception class of ``pytest.xfail()`` in a tuple, which is empty if pytest has not been imported."""
    return (sys.modules["pytest"].xfail.Exception,) if "pytest" in sys.modules else ()


def assertions() -> tuple[type[BaseException], ...]:
    """Return the exception classes with which a test function states that a property does not hold."""
    pytest = sys.modules.get("pytest")
    return (AssertionError,) if pytest is None else (AssertionError, pytest.fail.Exception)


def no_skip(who: str, error: BaseException) -> str:
    """Return the error message for a skip from code in which a skip is not allowed."""
    return (
        f"expected {who} to raise no skip, which would hide that nothing was tested, received "
        f"{type(error).__name__}: {error}; call pytest.skip() in the fixture or in the test function, or mark the test "
        "with @pytest.mark.skipif"
    )
