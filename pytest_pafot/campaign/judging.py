"""The user's test function as an oracle: its verdict on one run, and the verdict as a line of text."""

from __future__ import annotations

import inspect
import math
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from pytest_pafot.attribution.sentences import AT_FAULT
from pytest_pafot.findings.finding import ads_failure, raised_failure
from pytest_pafot.findings.severity import severity_of
from pytest_pafot.findings.signature import Failure
from pytest_pafot.findings.verdict import Verdict
from pytest_pafot.model.grid import Cell
from pytest_pafot.model.trace import WORLD_HANG, Outcome, Trace
from pytest_pafot.oracle.checks import Recording, Rejected, recorded
from pytest_pafot.oracle.run import ReferenceOutcome, Run, preventing, reference_outcome
from pytest_pafot.support.errors import DriverError, RequestError
from pytest_pafot.world.base_world import BaseWorld
from pytest_pafot.world.driving.policy import Policy
from pytest_pafot.world.guard.hang_guard import UNFIT, is_interruption
from pytest_pafot.world.guard.own_worlds import base_world
from pytest_pafot.world.kernel.action import Drive, possible_acceleration, possible_steering
from pytest_pafot.world.limits import TOP_SPEED

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


Cause = tuple[str, str]
"""The class of an exception, and where it was raised."""

NO_STEERING = math.pi / 2
"""A steering angle beyond which the units of an action are doubtful [rad]: no car reaches it."""
NO_ACCELERATION = 30.0
"""An acceleration above which the units of an action are doubtful [m/s^2]: no car reaches it.

Large negative accelerations are allowed, because planners use them to brake as hard as possible.
"""


class SetupFaultError(Exception):
    """An error of the set-up: all runs of the first generation ended in the same exception.

    For a replay, these are its own run and those of some random scenarios.
    """

    def __init__(self, run: Run, verdict: Verdict, runs: str, *, is_replay: bool = False) -> None:
        super().__init__(f"{runs} ended in {verdict.exception!r}")
        self.run, self.verdict, self.runs, self.is_replay = run, verdict, runs, is_replay

    @property
    def received(self) -> str:
        """The class and the message of what was raised in all runs."""
        failure = self.verdict.failure
        return "" if failure is None else f"{failure.kind}: {failure.message}"

    def first_decision(self, world: Any, policy: Policy, *, of_si: str, of_env: str) -> str:
        """Return a paragraph on the first decision that the world asks an ADS for; empty if no world can say it.

        It ends with ``of_si`` if the decision is in SI units, and with ``of_env`` if it is the environment's.
        """
        asked = None if policy.drives_itself else base_world(world).first_decision(self.run.trace.scenario)
        return "" if asked is None else f"\n\n{asked.text} {of_si if asked.is_si else of_env}"

    def shown(self, world: BaseWorld, policy: Policy) -> BaseException:
        """Return the exception for the user: what was raised and where, why it is no finding, and what to do."""
        verdict = self.verdict
        nothing = "so nothing was saved" if not self.is_replay else "so it says nothing about any saved scenario"
        again = "replay" if self.is_replay else "search"
        if verdict.is_ads or verdict.exception is None:
            asked = self.first_decision(
                world,
                policy,
                of_si='A policy of a highway-env environment needs world=pafot.World("highway-v0", config=...).',
                of_env="A policy needs the config= and the wrappers= with which it was trained; a planner in SI units "
                "needs pafot.Highway, which is the default world, or pafot.World(..., planner_hz=5).",
            )
            return PlainFailure(
                f"{verdict.exception}\n\n"
                f"This happened in {self.runs}, at the first decision: it is an error of the set-up and no finding, "
                f"{nothing}. Correct the ADS, its factory, or the world= in which it drives, and {again} again.{asked}"
            )
        verdict.exception.add_note(
            f"This happened in {self.runs}, whatever the ego did: it is an error of the test function and no finding, "
            f"{nothing}. Correct the line and {again} again; if it is meant as a finding, use assert."
        )
        return verdict.exception


def cause_of(run: Run, verdict: Verdict) -> Cause | None:
    """Return the cause of a failure if it can be a fault of the set-up; otherwise None.

    An assertion is never such a fault. Neither is an ADS that fails after its first decision, or that hangs: the cause
    can be the scenario or the machine.
    """
    failure = verdict.failure
    if failure is None or failure.kind == AssertionError.__name__ or isinstance(verdict.exception, assertions()):
        return None
    if not verdict.is_ads:
        return failure.kind, failure.assertion
    error = run.ads_error
    if error is None or error.tick > 0 or error.interrupted:
        return None
    return error.kind, next((line for line in reversed(error.traceback.splitlines()) if "File " in line), "")


def unit_doubt(trace: Trace) -> str:
    """Return what to check if the actions of a planner seem to have wrong units; empty if they do not.

    It is always empty for policies of an environment, whose actions are not in SI units.
    """
    steering = speed = acceleration = 0.0
    for action in trace.actions:  # one loop without calls, because each run is looked at
        if type(action) is tuple and len(action) == 2:
            wanted, angle = action
            steering = abs(angle) if not -steering <= angle <= steering else steering
        elif isinstance(action, Drive):
            wanted = action.acceleration or 0.0
            speed = max(speed, action.speed or 0.0)
        else:
            continue
        acceleration = wanted if wanted > acceleration else acceleration
    if steering > NO_STEERING:
        return (
            f"the ADS requested a steering angle of {steering:.3g} rad, of which {possible_steering(steering):.2f} rad "
            "take effect: convert degrees with math.radians(...); an action is (acceleration, steering), in this order"
        )
    if speed > TOP_SPEED:
        return (
            f"the ADS requested a speed of {speed:.3g} m/s, but no vehicle drives faster than {TOP_SPEED:g} m/s: "
            "divide km/h by 3.6"
        )
    if acceleration > NO_ACCELERATION:
        return (
            f"the ADS requested an acceleration of {acceleration:.3g} m/s^2, of which "
            f"{possible_acceleration(acceleration):g} m/s^2 take effect: an action is (acceleration, steering), not a "
            "speed"
        )
    return ""
