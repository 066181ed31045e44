"""Running and evaluating the scenarios of one search."""
# Processes, limits, and records of crashes are here.

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from typing import Any

from pytest_pafot.campaign.harness import Harness, refusals
from pytest_pafot.campaign.results import Driver, Examiner, Result, State
from pytest_pafot.execution.crash_records import CrashRecord
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.runner import Here, LostRun
from pytest_pafot.findings.finding import disagreement, message_of
from pytest_pafot.findings.sighting import NOT_REPEATED
from pytest_pafot.findings.verdict import Signature, Verdict
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Trace, first_difference
from pytest_pafot.oracle.run import Run
from pytest_pafot.support import monotonic
from pytest_pafot.support.errors import OutOfTime
from pytest_pafot.support.process import REPLACED
from pytest_pafot.world.base_world import BaseWorld
from pytest_pafot.world.guard.hang_guard import UNFIT, let_through, runs_end_in

# What differs if the runs are the same, and only the test function decides differently.
JUDGED_OTHERWISE = "the same run got a different verdict when it was repeated"


@dataclass(slots=True, kw_only=True)
class Bench:
    """The runner and the evaluation of the scenarios of one search."""

    # Until a run is evaluated, its scenario is on disk in the crash record of this process.

    harness: Harness
    runner: Here
    record: CrashRecord
    reference: Here | None = None  # the runner of the reference
    driver: Driver | None = None  # how other processes drive chunks; None if they cannot
    examiner: Examiner  # examines the runs of the search that no other process has examined
    clock: Callable[[], float] = monotonic  # returns the seconds since some fixed moment
    decisions_beside: int = 0  # number of decisions of the ADS next to runs
    refining_end: float = math.inf  # the time at which the work on findings ends [s]
    refining_most: float = math.inf  # the most decisions of the ADS for which the work on findings may ask
    asked: int = 0  # the number of decisions that it has requested; the same for any number of processes
    is_at_limit: bool = False  # True if that work would have requested more
    confirm_decisions: int = 0  # the number of decisions of the ADS that confirmed findings
    confirm_seconds: float = 0.0  # the time that this took [s]
    pace: float = 0.0  # the longest time to confirm one second of a run so far [s]

    @property
    def decisions(self) -> int:
        """The decisions of the ADS in further runs, except to confirm findings."""
        return self.decisions_beside + self.runner.decisions - self.confirm_decisions

    def results(
        self, scenarios: Iterable[Scenario], state: State, skips: Callable[[Scenario], bool]
    ) -> Iterator[Result | LostRun]:
        """Yield the results of scenarios in order."""
        # Other processes may make the runs.
        # If a run fails in a way that is not yet known, the reference is run in the scenario, too.
        __tracebackhide__ = True
        runs = self.runner.results(scenarios, skips)
        while (result := self._next(runs, state)) is not None:
            yield result

    def _next(self, runs: Iterator[Any], state: State) -> Result | LostRun | None:
        __tracebackhide__ = True
        with self._recorded():
            with refusals():
                made = next(runs, None)
            if made is None or isinstance(made, ProcessLostError):
                return made
            result: Result = made if isinstance(made, Result) else self.examiner(made, state.known)
            if result.kind == "failed" and self.reference is not None:
                result = result.beside(self.harness.judge_reference(self.reference, result.evaluation.scenario))
        self.record.clear()
        return result

    def run(self, scenario: Scenario, *, most: int | None = None) -> Run:
        """Run a scenario, after which the caller must call :meth:`finish`.

        Raises:
            ProcessLostError: if the run was in another process, and that process died or hung.
            RequestError: if the world, the factory or the scenario cannot be used.
            OutOfTime: if the time of the search has run out.
        """
        # `finish` also clears the crash record.
        __tracebackhide__ = True
        with self._recorded(), refusals():
            trace = self.runner.once(scenario, most=most)
        self.asked += min(len(trace.actions), most or sys.maxsize)
        return self.harness.run_of(trace)

    def finish(self, run: Run, scenario: Scenario | None = None) -> Verdict:
        """Evaluate the last run, and clear its crash record."""
        # If it fails, the reference is run in `scenario`, by default in the run's scenario.
        __tracebackhide__ = True
        with self._recorded():
            verdict = self.harness.judge(run)
            if verdict.failed and self.reference is not None:
                verdict = verdict.beside(self.harness.judge_reference(self.reference, scenario or run.scenario))
        self.record.clear()
        return verdict

    def is_common(self, scenario: Scenario) -> bool:
        """Return whether the reference does not pass the scenario either."""
        __tracebackhide__ = True
        if self.reference is None:
            return False
        verdict = self.harness.judge_reference(self.reference, scenario)
        self.record.clear()
        return not verdict.passes

    def rerun(self, scenario: Scenario) -> Run:
        __tracebackhide__ = True
        run = self.run(scenario)
        self.record.clear()
        return run

    @REPLACED.shown(False)
    def rerun_in_gym(self, scenario: Scenario) -> Run | None:
        """Run a scenario in highway-env's own environment, if there is one."""
        __tracebackhide__ = True
        world = self.harness.world
        if not world.replays_in_gym:
            return None
        # Highway-env is imported before the run, in which a test's own functions are in the place of Python's.
        from pytest_pafot.world.engines import gym_replay  # noqa: F401, PLC0415  (slow to import)

        with self._recorded(), refusals():
            trace = self.runner.once(scenario, "rollout_in_gym")
        self.asked += len(trace.actions)
        self.record.clear()
        return Run(trace)

    def confirm(
        self, scenario: Scenario, expected: Trace | None, found: Signature | None = None
    ) -> tuple[Run | None, Verdict | None, str | None]:
        """Run the scenario of a failure again, also in highway-env's own environment.

        Args:
            scenario: the scenario as executed.
            expected: the failing run, which repeats to the last bit; None if wall-clock time decides.
            found: the signature of the failure; None to omit the verdict.

        Return the run, its verdict, and what differs from the first run.
        """
        # The run is None if it does not show the failure. The difference is empty if there is none, and None if no time
        # was left to check. The time of this run is measured, too.
        began, before, seconds_of_run = self.clock(), self.runner.decisions, 1.0
        run = verdict = None
        differs: str | None = ""
        try:
            with runs_end_in(self.refining_end - began):
                again = self.run(scenario)
                seconds_of_run = max(again.duration, seconds_of_run)
                if found is not None:
                    with self._recorded():
                        verdict = self.harness.judge(again)
                self.record.clear()
                if verdict is None or self.examiner.signature_of(again, verdict) == found:
                    run = again
                if expected is not None and (changed := first_difference(expected, again.trace)):
                    differs = f"{NOT_REPEATED}: {changed}"
                elif expected is not None:
                    differs = JUDGED_OTHERWISE if run is None else self._in_words(_difference_in_gym(again, self))
        except ProcessLostError as error:
            differs = f"the process that ran it again {error.end}"
        except OutOfTime:
            differs = None
        seconds = self.clock() - began
        self.confirm_seconds += seconds
        self.confirm_decisions += self.runner.decisions - before
        self.pace = max(self.pace, seconds / seconds_of_run)
        return run, verdict, differs

    def _in_words(self, difference: str) -> str:
        # What differs in highway-env's own environment, with the likely cause.
        cause = "" if self.harness.policy.drives_itself else left_out_text(self.harness.world)
        told = "; ".join(filter(None, [difference, cause]))
        return f"in highway-env's own environment: {told}" if difference else ""

    @contextmanager
    def _recorded(self) -> Iterator[None]:
        """Clear the crash record if the time limit ends the run."""
        # No process died in it.
        __tracebackhide__ = True
        try:
            yield
        except OutOfTime:
            self.record.clear()
            raise


def left_out_text(world: BaseWorld) -> str:
    """Return a sentence on relevant methods of the environment that runs skip."""
    methods = world.left_out
    if not methods:
        return ""
    names = " and ".join(f"`{name}`" for name in methods)
    changed = ", ".join(f"`{each}`" for each in dict.fromkeys(chain.from_iterable(methods.values())))
    return (
        f"runs do not call the environment's own {names}, which may change {changed}: write wrappers=[] in its "
        "pafot.World"
    )


def _difference_in_gym(run: Run, bench: Bench) -> str:
    # If the world has an environment of highway-env, the run must end there in the same way.
    try:
        other = bench.rerun_in_gym(run.scenario)
        return "" if other is None else disagreement(run, other)
    except (ProcessLostError, OutOfTime):
        raise
    except UNFIT as error:  # any exception of the environment or the ADS is the difference
        let_through(error)
        return f"{type(error).__name__}: {message_of(error)}"[:165]
