"""The runs of one search: processes, limits, evaluation and crash records."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from typing import Any

from pytest_pafot.execution.crash_records import CrashRecord
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.runner import Here, LostRun
from pytest_pafot.findings.finding import disagreement, message_of
from pytest_pafot.findings.sighting import NOT_REPEATED
from pytest_pafot.findings.verdict import Signature, Verdict
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Trace, first_difference
from pytest_pafot.oracle.run import Run
from pytest_pafot.searches.harness import Harness, refusals
from pytest_pafot.searches.results import Driver, Examiner, Result, State
from pytest_pafot.support import monotonic
from pytest_pafot.support.errors import OutOfTime
from pytest_pafot.support.process import REPLACED
from pytest_pafot.world.base_world import BaseWorld
from pytest_pafot.world.guard.hang_guard import UNFIT, let_through, runs_end_in

# The difference between two identical runs if the test function decides differently.
JUDGED_OTHERWISE = "the same run got a different verdict when it was repeated"


@dataclass(slots=True, kw_only=True)
class Bench:
    """The parts of a search that run scenarios and evaluate the runs."""

    harness: Harness
    runner: Here
    record: CrashRecord  # contains the scenario of a run until the run is evaluated
    reference: Here | None = None  # the runner of the reference, if there is one
    driver: Driver | None = None  # runs chunks in other processes; None if that is impossible
    examiner: Examiner  # evaluates the runs that no other process has evaluated
    clock: Callable[[], float] = monotonic  # returns the time [s]
    decisions_beside: int = 0  # number of decisions of the ADS that did not affect a run
    refining_end: float = math.inf  # the time at which work on findings must end [s]
    # the largest number of decisions that work on findings can request
    refining_most: float = math.inf
    # the number of decisions that it has requested; the same for any number of processes
    asked: int = 0
    is_at_limit: bool = False  # True if this number has reached its limit
    confirm_decisions: int = 0  # the number of decisions of the ADS to confirm findings
    confirm_seconds: float = 0.0  # the time to confirm findings [s]
    pace: float = 0.0  # the longest time so far to confirm one second of a run [s]

    @property
    def decisions(self) -> int:
        """The number of ADS decisions in additional runs, excluding those that confirm findings."""
        return self.decisions_beside + self.runner.decisions - self.confirm_decisions

    def results(
        self, scenarios: Iterable[Scenario], state: State, skips: Callable[[Scenario], bool]
    ) -> Iterator[Result | LostRun]:
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
            # count only what the reference passes
            if result.kind == "failed" and self.reference is not None:
                result = result.beside(
                    self.harness.judge_reference(self.reference, result.evaluation.scenario)
                )
        self.record.clear()
        return result

    def run(self, scenario: Scenario, *, most: int | None = None) -> Run:
        """Run a scenario. The caller must then evaluate the run with :meth:`finish`.

        Raises:
            ProcessLostError: if the run was in another process, which died or hung.
            RequestError: if the world, the factory or the scenario cannot be used.
            OutOfTime: if the search runs out of time.
        """
        __tracebackhide__ = True
        with self._recorded(), refusals():
            trace = self.runner.once(scenario, most=most)
        self.asked += min(len(trace.actions), most or sys.maxsize)
        return self.harness.run_of(trace)

    def finish(self, run: Run, scenario: Scenario | None = None) -> Verdict:
        """Evaluate the last run, and clear its crash record."""
        __tracebackhide__ = True
        with self._recorded():
            verdict = self.harness.judge(run)
            if verdict.failed and self.reference is not None:  # run the reference, too
                verdict = verdict.beside(
                    self.harness.judge_reference(self.reference, scenario or run.scenario)
                )
        self.record.clear()
        return verdict

    def is_common(self, scenario: Scenario) -> bool:
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
        """Run a scenario in highway-env's own environment, if the world has one."""
        __tracebackhide__ = True
        world = self.harness.world
        if not world.replays_in_gym:
            return None
        # Import highway-env before the run, because functions that a test has replaced are in effect during the run.
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
            expected: the failing run, which must repeat to the last bit; None if it depends on wall-clock time.
            found: the failure's signature; None to omit the verdict.

        Returns:
            The run if it reproduces the failure, its verdict, and the difference from the first run: empty if there is
            no difference, None if there was no time to check.
        """
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
                    differs = (
                        JUDGED_OTHERWISE
                        if run is None
                        else self._in_words(_difference_in_gym(again, self))
                    )
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
        # Describe a difference in highway-env's own environment, with the likely cause.
        cause = "" if self.harness.policy.drives_itself else left_out_text(self.harness.world)
        told = "; ".join(filter(None, [difference, cause]))
        return f"in highway-env's own environment: {told}" if difference else ""

    @contextmanager
    def _recorded(self) -> Iterator[None]:
        # Clear the crash record if the time limit ends the run, because no process died.
        __tracebackhide__ = True
        try:
            yield
        except OutOfTime:
            self.record.clear()
            raise


def left_out_text(world: BaseWorld) -> str:
    """Return a note about the environment's own methods that runs do not call, or an empty string."""
    methods = world.left_out
    if not methods:
        return ""
    names = " and ".join(f"`{name}`" for name in methods)
    changed = ", ".join(
        f"`{each}`" for each in dict.fromkeys(chain.from_iterable(methods.values()))
    )
    return (
        f"runs do not call the environment's own {names}, which may change {changed}. If runs need this, write "
        "wrappers=[] in the pafot.World"
    )


def _difference_in_gym(run: Run, bench: Bench) -> str:
    # If the world has an environment of highway-env, the run must end in the same way there.
    try:
        other = bench.rerun_in_gym(run.scenario)
        return "" if other is None else disagreement(run, other)
    except (ProcessLostError, OutOfTime):
        raise
    except UNFIT as error:  # any exception of the environment or the ADS is a difference
        let_through(error)
        return f"{type(error).__name__}: {message_of(error)}"[:165]
