"""The bench of one search, on which its scenarios are run and judged: processes, limits, and records of crashes."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import chain
from typing import Any

from pytest_pafot.campaign.harness import Harness, is_same_run, refusals
from pytest_pafot.campaign.judging import evaluated
from pytest_pafot.campaign.tallies import Driver, Tally
from pytest_pafot.execution.crash_records import CrashRecord
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.runner import Isolated, Runner
from pytest_pafot.execution.scenario_pool import trace_of
from pytest_pafot.findings.finding import disagreement, message_of
from pytest_pafot.findings.sighting import NOT_REPEATED
from pytest_pafot.findings.signature import Signature
from pytest_pafot.findings.verdict import Verdict
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Trace
from pytest_pafot.oracle.run import Facts, Run
from pytest_pafot.searching.evaluation import Evaluation
from pytest_pafot.support import monotonic
from pytest_pafot.support.errors import OutOfTime
from pytest_pafot.support.process import REPLACED
from pytest_pafot.world.base_world import BaseWorld
from pytest_pafot.world.guard.chance import GENERATORS
from pytest_pafot.world.guard.hang_guard import UNFIT, let_through, runs_end_in


@dataclass(slots=True, kw_only=True)
class Bench:
    """The bench of one search, which runs and judges its scenarios.

    Until a run is judged, its scenario is on disk in the crash record of this process.
    """

    harness: Harness
    runner: Runner
    record: CrashRecord
    reference: Runner | None = None  # the runner of the reference
    driver: Driver | None = None  # how other processes drive chunks; None if they cannot
    fitness: Callable[[Run], float]  # the fitness of a run; higher is worse for the ego
    clock: Callable[[], float] = monotonic  # returns the seconds since some fixed moment
    counted_decisions: int = 0  # number of decisions of the ADS in runs that others judged, and beside runs
    refining_end: float = math.inf  # the time at which the work on findings ends [s]
    refining_most: float = math.inf  # the most decisions of the ADS for which the work on findings may ask
    asked: int = 0  # the number of decisions for which it has asked; the same for any number of processes
    is_at_limit: bool = False  # True if that work would have asked for more
    confirm_decisions: int = 0  # the number of decisions of the ADS that confirmed findings
    confirm_seconds: float = 0.0  # the time that this took [s]
    pace: float = 0.0  # the longest time to confirm one second of a run so far [s]
    # runs that this process has judged and not counted yet, with their verdicts
    _judged_ahead: dict[Scenario, tuple[Run, Verdict]] = field(default_factory=dict)

    @property
    def decisions(self) -> int:
        """The number of decisions that the ADS has made so far in this session, except to confirm findings."""
        return self.counted_decisions + self.runner.decisions - self.confirm_decisions

    def evaluation(self, run: Run, verdict: Verdict, signature: Signature | None) -> Evaluation:
        """Return what the algorithm sees of a run that this process has judged."""
        return evaluated(run, verdict, signature, self.fitness)

    def make(self, scenario: Scenario) -> Run | Tally:
        """Return the run of the next scenario of a plan, or its tally if another process has made and judged it.

        A run may have been made, and judged by :meth:`judge_ahead`, before. The caller must call :meth:`finish` next.

        Raises:
            ProcessLostError, RequestError, OutOfTime: as for :meth:`run`.
        """
        __tracebackhide__ = True
        with self._recorded(), refusals():
            made: Any = self.runner.made(scenario, announced=True)
        if isinstance(made, Tally):
            return made
        run = self.harness.run_of(made)
        judged, _ = self._judged_ahead.get(scenario, (run, None))
        return judged if judged.trace is run.trace else run

    def judge_ahead(self, made: Trace | Facts) -> tuple[Run, Verdict] | None:
        """Judge a run before its turn, so that :meth:`finish` need not; return it with its verdict.

        Return None if a run of its scenario was judged before.
        """
        scenario = trace_of(made).scenario
        if scenario in self._judged_ahead:
            return None
        self.record.write(scenario)
        run = self.harness.run_of(made)
        self._judged_ahead[scenario] = run, self.finish(run)
        return self._judged_ahead[scenario]

    def run(self, scenario: Scenario, *, announced: bool = False, most: int | None = None) -> Run:
        """Run a scenario. The caller must call :meth:`finish` next, which also clears the crash record.

        For ``announced`` and ``most`` see :meth:`pytest_pafot.execution.runner.Runner.made`.

        Raises:
            ProcessLostError: if the run was in another process, and that process died or hung.
            RequestError: for a world, factory or scenario that does not fit.
            OutOfTime: if the time of the search is over.
        """
        __tracebackhide__ = True
        with self._recorded(), refusals():
            trace = self.runner.run(scenario, announced=announced, most=most)
        self.asked += min(len(trace.actions), most or sys.maxsize)
        return self.harness.run_of(trace)

    def finish(self, run: Run, scenario: Scenario | None = None) -> Verdict:
        """Judge the last run, and clear its crash record.

        If it fails, the reference is run in ``scenario``, by default in the run's scenario.
        """
        __tracebackhide__ = True
        judged, verdict = self._judged_ahead.pop(run.trace.scenario, (None, None))
        # Another run of the scenario may have another verdict.
        if judged is not None and verdict is not None and judged.trace is run.trace:
            self.record.clear()
            return verdict
        with self._recorded():
            verdict = self.harness.judge(run)
            if verdict.failed and self.reference is not None:
                verdict = verdict.beside(self.harness.judge_reference(self.reference, scenario or run.scenario))
        self.record.clear()
        return verdict

    def is_common(self, scenario: Scenario) -> bool:
        """Return whether a failure in a scenario does not count, because the reference does not pass it either."""
        __tracebackhide__ = True
        if self.reference is None:
            return False
        verdict = self.harness.judge_reference(self.reference, scenario)
        self.record.clear()
        return not verdict.passes

    def rerun(self, scenario: Scenario) -> Run:
        """Run a scenario from scratch, without a verdict."""
        __tracebackhide__ = True
        run = self.run(scenario)
        self.record.clear()
        return run

    @REPLACED.shown(False)
    def rerun_in_gym(self, scenario: Scenario) -> Run | None:
        """Run a scenario with ``env.step`` of highway-env's own environment; None if the world has no environment."""
        __tracebackhide__ = True
        world = self.harness.world
        if not world.replays_in_gym:
            return None
        # highway-env is imported before the run, in which a test's own functions are in the place of Python's.
        from pytest_pafot.world.engines import gym_replay  # noqa: F401, PLC0415  (slow to import)

        policy = self.harness.policy
        with self._recorded(), refusals():
            if isinstance(self.runner, Isolated):
                trace = self.runner.in_gym(scenario)
            else:
                self.record.write(scenario)
                trace = GENERATORS.run(world.rollout_in_gym, scenario, policy.factory)
        self.runner.decisions += len(trace.actions)
        self.asked += len(trace.actions)
        self.record.clear()
        return Run(trace)

    def confirm(self, run: Run) -> str:
        """Repeat the run of a finding; return what differs, empty if nothing does. Measure how long that takes.

        Raises:
            OutOfTime: if the time of the search is over.
        """
        began, before = self.clock(), self.runner.decisions
        try:
            with runs_end_in(self.refining_end - began):
                differs = difference(run, self)
        finally:
            seconds = self.clock() - began
            self.confirm_seconds += seconds
            self.confirm_decisions += self.runner.decisions - before
        self.pace = max(self.pace, seconds / max(run.duration, 1.0))
        return differs

    @contextmanager
    def _recorded(self) -> Iterator[None]:
        """Clear the crash record of a run that the time limit ends, because no process died in it."""
        __tracebackhide__ = True
        try:
            yield
        except OutOfTime:
            self.record.clear()
            raise


def difference(run: Run, bench: Bench) -> str:
    """Return what differs when the scenario of a run is run again; empty if the finding is confirmed.

    The same world must give a run that is equal to the last bit. In highway-env's own environment, if the world has
    it, the run must end in the same way.
    """
    try:
        if not is_same_run(run, bench.rerun(run.scenario)):
            return NOT_REPEATED
        differs = _difference_in_gym(run, bench)
    except ProcessLostError as error:
        return f"the process that ran it again {error.end}"
    if not differs:
        return ""
    harness = bench.harness
    likely_cause = "" if harness.policy.drives_itself else left_out_text(harness.world)
    return f"in highway-env's own environment: {differs}" + (f"; {likely_cause}" if likely_cause else "")


def left_out_text(world: BaseWorld) -> str:
    """Return a sentence on the environment's own methods that runs do not call, though they matter; or empty."""
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
    try:
        other = bench.rerun_in_gym(run.scenario)
    except ProcessLostError:
        raise
    except UNFIT as error:  # any exception of the environment or the ADS is the difference
        let_through(error)
        return f"{type(error).__name__}: {message_of(error)}"[:165]
    return "" if other is None else disagreement(run, other)
