"""Detection of a fault of the set-up: every run of the first generation ends in the same exception.

The cause is an error such as a misspelt name in the test function, or an ADS that fails at its first decision. It says
nothing about any scenario. Actions in wrong units are no such fault, but a doubt about them is reported.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import Any

from pytest_pafot.campaign.judging import PlainFailure, assertions
from pytest_pafot.findings.verdict import Verdict
from pytest_pafot.model.trace import Trace
from pytest_pafot.oracle.run import Run
from pytest_pafot.world.base_world import BaseWorld
from pytest_pafot.world.driving.policy import Policy
from pytest_pafot.world.guard.own_worlds import base_world
from pytest_pafot.world.kernel.action import Drive, possible_acceleration, possible_steering
from pytest_pafot.world.limits import TOP_SPEED

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


@dataclass(slots=True)
class FirstGeneration:
    """The runs of the first generation, and whether all of them so far ended in the same exception."""

    is_alike: bool = True  # False as soon as two runs differ, and for the rest of the search
    last: tuple[Run, Verdict] | None = None  # the last judged run with its verdict; None before the first
    runs: int = 0  # number of judged runs
    unjudged: int = 0  # number of runs for which the test function was not called
    _cause: Cause | None = None

    def see(self, run: Run, verdict: Verdict) -> None:
        """Record how a run of the first generation ended."""
        if verdict.kind in ("npc", "avoidable", "invalid"):  # The test function was not called.
            self.unjudged += 1
            return
        cause = cause_of(run, verdict)
        self.is_alike &= cause is not None and self._cause in (None, cause)
        self._cause, self.last, self.runs = cause, (run, verdict), self.runs + 1

    def see_others(self, verdicts: Counter[str]) -> None:
        """Record the verdicts on runs of the first generation that other processes have judged."""
        unjudged = verdicts["npc"] + verdicts["avoidable"] + verdicts["invalid"]
        self.unjudged += unjudged
        self.is_alike &= verdicts.total() == unjudged

    def end(self, where: str = " of the first generation") -> None:
        """End the first generation.

        Raises:
            SetupFaultError: if all runs of the generation ended in the same exception.
        """
        if self.is_alike and self.last is not None:
            judged = " that were judged" if self.unjudged else ""
            raise SetupFaultError(*self.last, f"all {self.runs} runs{where}{judged}")
        self.is_alike = False


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
