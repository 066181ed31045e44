"""Runs that are made before a search asks for them: in lock step, or in other processes."""

from __future__ import annotations

from collections.abc import Sequence

from pytest_pafot.execution.crash_records import CrashRecord
from pytest_pafot.execution.job import Job
from pytest_pafot.execution.scenario_pool import ExecutionError, ScenarioPool, pool_for, recovery_note, trace_from
from pytest_pafot.scenario import Scenario
from pytest_pafot.trace import Trace

DEAR = 0.010
"""From this mean duration of a run on, processes are worth their cost [s]: a run that is made in another one costs half
a millisecond more, and starting a process as much as some runs."""

WARM_RUNS = 2
"""Runs that must have been measured before. The first run of a search is not: it loads what the others use."""


class LockStep:
    """Makes announced runs at once, in one batch, when the first of them is asked for.

    Args:
        job: what is run, in a world with ``rollout_batch``.
        record: of this process.
    """

    def __init__(self, job: Job, record: CrashRecord) -> None:
        self._job = job
        self._record = record
        self._announced: list[Scenario] = []
        self._made: dict[Scenario, Trace] = {}

    def announce(self, scenarios: Sequence[Scenario]) -> None:
        """Know what will be asked for; of what was made before, nothing is kept."""
        self._announced, self._made = list(scenarios), {}

    def take(self, scenario: Scenario) -> Trace | None:
        """The trace of an announced run, once; None where the run is to be made by itself.

        Raises:
            Exception: what the world, the factory or the ADS's ``batch`` raises.
        """
        __tracebackhide__ = True
        if scenario in self._announced and len(self._announced) > 1:
            together, self._announced = self._announced, []
            self._record.write(*together)
            traces = self._job.world.rollout_batch(together, self._job.ads)
            self._made = dict(zip(together, traces, strict=True))
        elif scenario in self._announced:
            self._announced.remove(scenario)
        return self._made.pop(scenario, None)


class Processes:
    """Makes announced runs in other processes, from the moment on that runs of this one turn out to be dear.

    Args:
        job: what is run.
        workers: processes at most; with 1, none is ever started.
        dear: mean duration of a run from which on processes are worth their cost [s].
    """

    def __init__(self, job: Job, *, workers: int, dear: float = DEAR) -> None:
        self.size = workers
        self.announced: list[Scenario] = []
        """What this process will be asked for."""
        self._job = job
        self._dear = dear
        self._pool: ScenarioPool | None = None
        self._is_over = False
        self._is_announced = False
        self._runs = 0
        self._warm_seconds = 0.0
        self._failure = ""

    @property
    def notes(self) -> list[str]:
        """What was used, or why not, where that was asked for; complete once the processes have ended."""
        pool = self._pool
        if self._failure:
            return [f"--pafot-workers is 1: {self._failure}"]
        if pool is None:
            return self._idle()
        used = f"--pafot-workers={self.size}: in use after {self._runs} runs of this process"
        if pool.failure:
            used = f"--pafot-workers: one process ran the scenarios, since no other could: {pool.failure}"
        return [used, *map(recovery_note, pool.recovered)]

    def announce(self, scenarios: Sequence[Scenario]) -> None:
        """Know what will be asked for, and begin with it where processes are in use."""
        if self._is_over:
            return
        if self._pool is None:
            self.announced = list(scenarios)
        else:
            self._pool.expect(scenarios)

    def take(self, scenario: Scenario) -> Trace | None:
        """The trace of an announced run, once; None where the run is to be made in this process.

        Raises:
            ProcessLostError: where the process that made it did not come back.
        """
        __tracebackhide__ = True
        if self._pool is not None and self._pool.expects(scenario):
            return trace_from(self._pool.fetch(scenario))
        self._is_announced = scenario in self.announced
        if self._is_announced:
            self.announced.remove(scenario)
        return None

    def ran_here(self, seconds: float) -> None:
        """Learn what the run took that was to be made in this process; what was not announced is not measured."""
        if not self._is_announced:
            return
        self._is_announced = False
        self._runs += 1
        if self._runs > 1:
            self._warm_seconds += seconds
        if self.size > 1 and self._runs > WARM_RUNS and self._warm_seconds >= self._dear * (self._runs - 1):
            self._begin()

    def close(self, *, at_once: bool) -> None:
        """End the processes; what comes later is made in this one."""
        self.announced, self._is_over = [], True
        if self._pool is not None:
            self._pool.close(at_once=at_once)

    def _begin(self) -> None:
        """Have the rest of what was announced made elsewhere, and what will be."""
        try:
            self._pool = pool_for(self._job, self.size)
        except ExecutionError as error:
            self.size, self._failure = 1, str(error)
        else:
            self._pool.expect(self.announced)
            self.announced = []

    def _idle(self) -> list[str]:
        """Why one process ran all scenarios, where that can be said and is not what was asked for."""
        if self.size == 1 or self._runs <= WARM_RUNS:
            return []
        mean, dear = 1000 * self._warm_seconds / (self._runs - 1), 1000 * self._dear
        return [
            f"--pafot-workers={self.size}: not in use, since a run took {mean:.1f} ms, and it pays from {dear:g} ms on"
        ]
