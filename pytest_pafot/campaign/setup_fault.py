"""A fault of the set-up: every run of the first generation ends in the same exception, whatever happens in it.

A misspelt name in the test function, or an ADS that fails before it has seen anything, says nothing of any scenario.
Actions in other units than a planner's are no such fault, but a doubt that is told.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pytest_pafot.campaign.verdict import PlainFailure, Verdict, assertions
from pytest_pafot.findings.finding import Cause, first_decision_cause
from pytest_pafot.model.trace import Trace
from pytest_pafot.oracle.run import Run
from pytest_pafot.world.driving.ads import is_vehicle_class
from pytest_pafot.world.kernel.action import Drive, possible_acceleration, possible_steering
from pytest_pafot.world.limits import TOP_SPEED
from pytest_pafot.world.protocol import first_decision

NO_STEERING = math.pi / 2
"""No car steers so far, and no planner asks for it [rad]."""
NO_ACCELERATION = 30.0
"""No car accelerates so fast [m/s^2]. Full braking is often asked for by a large number, full throttle is not."""


class SetupFaultError(Exception):
    """What all runs of the first generation ended in."""

    def __init__(self, run: Run, verdict: Verdict, runs: str) -> None:
        super().__init__(f"{runs} ended in {verdict.exception!r}")
        self.run, self.verdict, self.runs = run, verdict, runs

    def shown(self, world: Any, ads: Callable[..., Any]) -> BaseException:
        """The exception for the item: what was raised and where, why it is no finding, and what to do."""
        verdict = self.verdict
        if verdict.is_ads or verdict.exception is None:
            asked = None if is_vehicle_class(ads) else first_decision(world, self.run.trace.scenario)
            others = (
                "A policy needs the config= and the wrappers= that it was trained with; a planner in SI units needs "
                "pafot.Highway, which is there without world=, or pafot.World(..., planner_hz=5)."
            )
            if asked is not None and asked.is_si:
                others = 'A policy of a highway-env environment needs world=pafot.World("highway-v0", config=...).'
            told = "" if asked is None else f"\n\n{asked.text} {others}"
            return PlainFailure(
                f"{verdict.exception}\n\n"
                f"So it was in {self.runs}, before anything had happened in them: an error of the set-up and no "
                "finding, so that nothing was saved. Correct the ADS, its factory, or the world= that it drives in, "
                f"and search again.{told}"
            )
        verdict.exception.add_note(
            f"So it was in {self.runs}, whatever happened in them: an error of the test function and no finding, so "
            "that nothing was saved. Correct the line, and search again; what shall be a finding is asserted."
        )
        return verdict.exception


@dataclass(slots=True)
class FirstGeneration:
    """What the runs so far have in common."""

    is_alike: bool = True  # whether all of them ended in the same exception; once they did not, that is settled
    last: tuple[Run, Verdict] | None = None  # of them, with its verdict; None before the first
    runs: int = 0  # their number
    unjudged: int = 0  # the number of other runs, which the test function was not asked about
    _cause: Cause | None = None

    def see(self, run: Run, verdict: Verdict) -> None:
        """Learn how a run ended."""
        if verdict.kind in ("npc", "invalid"):  # The test function was not asked about it.
            self.unjudged += 1
            return
        cause = cause_of(run, verdict)
        self.is_alike &= cause is not None and self._cause in (None, cause)
        self._cause, self.last, self.runs = cause, (run, verdict), self.runs + 1

    def end(self) -> None:
        """The generation is over.

        Raises:
            SetupFaultError: where all of its runs were alike.
        """
        if self.is_alike and self.last is not None:
            judged = " that were judged" if self.unjudged else ""
            raise SetupFaultError(*self.last, f"all {self.runs} runs of the first generation{judged}")
        self.is_alike = False


def cause_of(run: Run, verdict: Verdict) -> Cause | None:
    """What a failure comes from, where it can be a fault of the set-up; None else.

    It never is where something was asserted, nor where an ADS failed after its first decision or hung in it: that can
    be the doing of a scenario, or of the machine.
    """
    failure = verdict.failure
    if failure is None or failure.kind == AssertionError.__name__ or isinstance(verdict.exception, assertions()):
        return None
    return first_decision_cause(run.ads_error) if verdict.is_ads else (failure.kind, failure.assertion)


def unit_doubt(trace: Trace) -> str:
    """What to check in a planner whose actions cannot be meant as they are; empty for others, and for policies."""
    return trace.reading("unit doubt", _unit_doubt)


def _unit_doubt(trace: Trace) -> str:
    pairs = [action for action in trace.actions if type(action) is tuple and len(action) == 2]
    steering = max((abs(pair[1]) for pair in pairs), default=0.0)
    if steering > NO_STEERING:
        return (
            f"the ADS asked for a steering angle of {steering:.3g}, in rad, of which {possible_steering(steering):.2f} "
            "have an effect: convert degrees with math.radians(...); an action is (acceleration, steering), in this "
            "order"
        )
    drives = [action for action in trace.actions if isinstance(action, Drive)]
    speed = max((drive.speed or 0.0 for drive in drives), default=0.0)
    if speed > TOP_SPEED:
        return (
            f"the ADS asked for a speed of {speed:.3g}, in m/s, and no vehicle drives more than {TOP_SPEED:g}: divide "
            "km/h by 3.6"
        )
    acceleration = max([*[pair[0] for pair in pairs], *[drive.acceleration or 0.0 for drive in drives]], default=0.0)
    if acceleration > NO_ACCELERATION:
        return (
            f"the ADS asked for an acceleration of {acceleration:.3g}, in m/s^2, of which "
            f"{possible_acceleration(acceleration):g} have an effect: an action is (acceleration, steering), and holds "
            "no speed"
        )
    return ""
