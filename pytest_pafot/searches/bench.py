"""The runs of one search, each evaluated, and the second runs that confirm its failures."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import chain, islice
from typing import TypeAlias, assert_never

from pytest_pafot.execution.crash_records import CrashRecord
from pytest_pafot.execution.pool import Done, Lost, ProcessLostError
from pytest_pafot.execution.runner import Here, LostRun, in_gym
from pytest_pafot.findings.finding import disagreement, message_of
from pytest_pafot.findings.shrink import OutOfBudget
from pytest_pafot.findings.sighting import NOT_REPEATED
from pytest_pafot.findings.verdict import Verdict
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Trace, first_difference
from pytest_pafot.oracle.run import Run
from pytest_pafot.searches.harness import Harness, refusals
from pytest_pafot.searches.results import (
    Driver,
    Examiner,
    Failed,
    Result,
    State,
    common_death,
    result_of_death,
)
from pytest_pafot.support import monotonic
from pytest_pafot.support.errors import OutOfTime
from pytest_pafot.support.process import REPLACED
from pytest_pafot.world.base_world import BaseWorld
from pytest_pafot.world.guard.hang_guard import UNFIT, let_through, runs_end_in

# The difference between two identical runs if the test function decides differently.
JUDGED_OTHERWISE = "the same run got a different verdict when it was repeated"


@dataclass(frozen=True, slots=True)
class Repeated:
    """A second run of a scenario that shows the failure again, and its verdict."""

    run: Run
    verdict: Verdict


# The results of a second run. Each class has that run if it shows the failure, even if the runs differ.


@dataclass(frozen=True, slots=True, kw_only=True)
class Same:
    """The second run does not differ from the first one."""

    again: tuple[Repeated, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Differs:
    """The second run differs from the first one, so the failure is flaky."""

    why: str
    again: tuple[Repeated, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class NoTime:
    """The time ran out before the runs were compared."""

    again: tuple[Repeated, ...] = ()


Confirmation: TypeAlias = Same | Differs | NoTime


@dataclass(slots=True, kw_only=True)
class Budget:
    """The limits of the work on findings."""

    clock: Callable[[], float] = monotonic  # returns the time [s]
    end: float = math.inf  # the time at which the work must end [s]
    most: float = math.inf  # the largest number of decisions that the work can request
    # the number of decisions that it has requested; the same for any number of processes
    asked: int = 0
    is_at_limit: bool = False  # True if this number has reached its limit

    def check(self) -> None:
        """Raise OutOfTime if no time is left, or OutOfBudget if no decision is left."""
        if self.clock() >= self.end:
            raise OutOfTime
        if self.asked >= self.most:
            self.is_at_limit = True
            raise OutOfBudget


@dataclass(slots=True, kw_only=True)
class Bench:
    """The part of a search that runs scenarios and evaluates the runs."""

    harness: Harness
    runner: Here
    record: CrashRecord  # contains the scenario of a run until the run is evaluated
    reference: Here | None = None  # the runner of the reference, if there is one
    driver: Driver | None = None  # runs chunks in other processes; None if that is impossible
    examiner: Examiner  # evaluates the runs that no other process has evaluated
    budget: Budget = field(default_factory=Budget)
    decisions_beside: int = 0  # number of decisions of the ADS that did not affect a run
    confirm_decisions: int = 0  # the number of decisions of the ADS to confirm findings
    confirm_seconds: float = 0.0  # the time to confirm findings [s]
    pace: float = 0.0  # the longest time so far to confirm one second of a run [s]

    @property
    def clock(self) -> Callable[[], float]:
        """Returns the time [s]."""
        return self.budget.clock

    @property
    def decisions(self) -> int:
        """The number of ADS decisions in additional runs, excluding those that confirm findings."""
        return self.decisions_beside + self.runner.decisions - self.confirm_decisions

    def results(
        self, scenarios: Iterable[Scenario], state: State, skips: Callable[[Scenario], bool]
    ) -> Iterator[Result]:
        """Yield the result of each scenario. The death of its process is a result, too."""
        __tracebackhide__ = True
        # The runner may already have sent several of the scenarios to other processes.
        runs = self.runner.results(scenarios, skips)
        while True:
            with self._recorded():
                with refusals():
                    answers = list(islice(runs, 1))
                if not answers:  # there is no scenario left
                    return
                result = self._evaluated(answers[0], state)
            # Only now: the evaluation can end this process, too, and the next session must know in which scenario.
            self.record.clear()
            yield result

    def _evaluated(self, answer: Done[Result | Trace] | Lost[Scenario], state: State) -> Result:
        __tracebackhide__ = True
        match answer:
            case Lost(death):
                return self.died(death)
            case Done(Result() as result):
                pass
            case Done(trace):
                # No other process has evaluated the run, or it could not, so this one does.
                assert isinstance(trace, Trace)  # noqa: S101
                result = self.examiner(trace, state.known)
            case _:
                assert_never(answer)
        if result.kind == "failed" and self.reference is not None:
            # A failure counts only if the reference passes the same scenario.
            beside = self.harness.judge_reference(self.reference, result.evaluation.scenario)
            result = result.beside(beside)
        return result

    def died(self, death: LostRun) -> Result:
        """Return the result for a scenario in which a process died or hung."""
        __tracebackhide__ = True
        try:
            is_common = self.is_common(death.task)
        except OutOfTime:
            # The reference had no time to finish its run. The death counts, because nothing that was found may be lost.
            self.record.clear()
            is_common = False
        if is_common:
            return common_death(death.task)
        return result_of_death(death, self.harness, self.examiner.seed)

    def is_common(self, scenario: Scenario) -> bool:
        """Return whether the reference fails the scenario, too."""
        __tracebackhide__ = True
        if self.reference is None:
            return False
        # If the reference dies, too, the scenario is too hard for both policies.
        verdict = self.harness.judge_reference(self.reference, scenario)
        self.record.clear()
        return not verdict.passes

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
        # Another process may have run on after the limit, which must not count.
        self.budget.asked += min(len(trace.actions), most or sys.maxsize)
        return self.harness.run_of(trace)

    def finish(self, run: Run, scenario: Scenario | None = None) -> Verdict:
        """Evaluate the last run, and clear its crash record."""
        __tracebackhide__ = True
        with self._recorded():
            verdict = self.harness.judge(run)
            if verdict.failed and self.reference is not None:  # run the reference, too
                # The caller can give the scenario without the instructions that the run did not
                # reach. It is the one that will be saved, so the reference must pass it.
                driven = scenario or run.scenario
                beside = self.harness.judge_reference(self.reference, driven)
                verdict = verdict.beside(beside)
        self.record.clear()
        return verdict

    def rerun(self, scenario: Scenario) -> Run:
        """Run a scenario without an evaluation."""
        __tracebackhide__ = True
        run = self.run(scenario)
        self.record.clear()
        return run

    def confirm(self, failed: Failed) -> Confirmation:
        """Run the scenario of a failure again, also in highway-env's own environment.

        The run must repeat to the last bit, unless it depends on wall-clock time.
        """
        scenario = failed.finding.scenario

        def compare(again: Run) -> Confirmation:
            with self._recorded():
                verdict = self.harness.judge(again)
            self.record.clear()
            # A verdict can be the same in a different run, so both are compared.
            shown: tuple[Repeated, ...] = ()
            if self.examiner.signature_of(again, verdict) == failed.signature:
                shown = (Repeated(again, verdict),)
            if failed.trace is None:  # it depends on wall-clock time, so it need not repeat
                return Same(again=shown)
            changed = first_difference(failed.trace, again.trace)
            if changed:
                return Differs(why=f"{NOT_REPEATED}: {changed}", again=shown)
            if not shown:
                return Differs(why=JUDGED_OTHERWISE)
            return self._compared_in_gym(again, shown)

        return self._confirmed(scenario, compare)

    def repeat(self, scenario: Scenario, expected: Trace) -> Confirmation:
        """Run a scenario again as :meth:`confirm` does, but without a verdict."""

        def compare(again: Run) -> Confirmation:
            self.record.clear()
            changed = first_difference(expected, again.trace)
            if changed:
                return Differs(why=f"{NOT_REPEATED}: {changed}")
            return self._compared_in_gym(again, ())

        return self._confirmed(scenario, compare)

    def _confirmed(
        self, scenario: Scenario, compare: Callable[[Run], Confirmation]
    ) -> Confirmation:
        began = self.clock()
        before = self.runner.decisions
        seconds_of_run = 1.0
        try:
            with runs_end_in(self.budget.end - began):
                again = self.run(scenario)
                # Very short runs consist mostly of set-up, so their pace says nothing about longer
                # ones.
                seconds_of_run = max(again.duration, seconds_of_run)
                confirmation = compare(again)
        except ProcessLostError as error:
            confirmation = Differs(why=f"the process that ran it again {error.end}")
        except OutOfTime:
            confirmation = NoTime()
        seconds = self.clock() - began
        self.confirm_seconds += seconds
        # The summary counts these decisions separately, and shrinking has its own limit.
        self.confirm_decisions += self.runner.decisions - before
        self.pace = max(self.pace, seconds / seconds_of_run)
        return confirmation

    def _compared_in_gym(self, run: Run, shown: tuple[Repeated, ...]) -> Confirmation:
        # If the world has an environment of highway-env, the run must end in the same way there.
        try:
            difference = _difference_in_gym(run, self)
        except OutOfTime:  # The second run has shown the failure all the same.
            return NoTime(again=shown)
        except ProcessLostError as error:
            return Differs(why=f"the process that ran it again {error.end}", again=shown)
        if not difference:
            return Same(again=shown)
        # The environment's own methods, which runs do not call, are the likely cause.
        cause = ""
        if not self.harness.policy.drives_itself:
            cause = left_out_text(self.harness.world)
        told = "; ".join(filter(None, [difference, cause]))
        return Differs(why=f"in highway-env's own environment: {told}", again=shown)

    @REPLACED.shown(False)
    def rerun_in_gym(self, scenario: Scenario) -> Run:
        """Run a scenario in highway-env's own environment, which the world must have."""
        __tracebackhide__ = True
        # Import highway-env before the run, because functions that a test has replaced are in effect during the run.
        from pytest_pafot.world.engines import gym_replay  # noqa: F401, PLC0415  (slow to import)

        with self._recorded(), refusals():
            trace = self.runner.once(scenario, in_gym)
        self.budget.asked += len(trace.actions)
        self.record.clear()
        return Run(trace)

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
    if not bench.harness.world.replays_in_gym:
        return ""
    try:
        return disagreement(run, bench.rerun_in_gym(run.scenario))
    except (ProcessLostError, OutOfTime):
        raise
    except UNFIT as error:  # any exception of the environment or the ADS is a difference
        let_through(error)
        return f"{type(error).__name__}: {message_of(error)}"[:165]
