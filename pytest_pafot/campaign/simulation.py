"""The runs of one search, each with its scenario on disk until its verdict is known."""

from __future__ import annotations

from dataclasses import dataclass

from pytest_pafot.campaign.harness import Harness, refusals
from pytest_pafot.campaign.request import RequestError
from pytest_pafot.campaign.verdict import Verdict
from pytest_pafot.execution.crash_records import CrashRecord, Leftover
from pytest_pafot.execution.runner import Runner
from pytest_pafot.execution.scenario_pool import ExecutionError
from pytest_pafot.execution.separate_runs import replay_in_gym_apart
from pytest_pafot.run import Run
from pytest_pafot.scenario import Scenario
from pytest_pafot.world import protocol


@dataclass(frozen=True, slots=True)
class Simulation:
    """Runs scenarios in the world of a search, and judges them; ``record`` is of what this process runs."""

    harness: Harness
    runner: Runner
    record: CrashRecord

    @property
    def is_alone(self) -> bool:
        """Whether the last run was made by itself, and not in lock step with others."""
        return self.runner.is_alone

    def run(self, scenario: Scenario, *, afresh: bool = False) -> Run:
        """One run, whose verdict follows; ``afresh`` as in :meth:`pytest_pafot.execution.runner.Runner.run`.

        Raises:
            ProcessLostError: where another process made it, and did not come back.
            RequestError: for a world, factory or scenario that does not fit.
        """
        __tracebackhide__ = True
        try:
            with refusals():
                trace = self.runner.run(scenario, afresh=afresh)
        except ExecutionError as error:
            raise RequestError(str(error)) from None
        return self.harness.seen(trace)

    def judge(self, run: Run) -> Verdict:
        """The verdict on the last run."""
        __tracebackhide__ = True
        verdict = self.harness.judge(run)
        self.record.clear()
        return verdict

    def rerun(self, scenario: Scenario) -> Run:
        """One run without a verdict, with the ADS asked for every decision."""
        __tracebackhide__ = True
        run = self.run(scenario, afresh=True)
        self.record.clear()
        return run

    def rerun_one_by_one(self, leftover: Leftover) -> None:
        """Run by itself what was in lock step when a process died, so that a second death has one name."""
        __tracebackhide__ = True
        leftover.discard()  # before another death, of which it would otherwise be the cause for ever
        for scenario in leftover.scenarios:
            self.rerun(scenario)

    def rerun_in_gym(self, scenario: Scenario) -> Run | None:
        """One run by ``env.step`` of highway-env's own environment; None in a world that has none."""
        __tracebackhide__ = True
        world = protocol.gym_replaying(self.harness.world)
        if world is None:
            return None
        self.record.write(scenario)
        with refusals():
            if self.harness.request.settings.isolate:
                trace = replay_in_gym_apart(self.harness.job(), self.record, scenario)
            else:
                trace = world.rollout_in_gym(scenario, self.harness.ads)
        self.record.clear()
        return Run(trace, decision_limit=self.harness.request.decision_limit)
