"""Runs that are made before a search asks for them: in lock step, or in other processes."""

from __future__ import annotations

from collections.abc import Sequence

from pytest_pafot.execution.crash_records import CrashRecord
from pytest_pafot.execution.job import Job
from pytest_pafot.execution.scenario_pool import (
    ExecutionError,
    LostRun,
    ScenarioPool,
    pool_for,
    recovery_note,
    trace_from,
)
from pytest_pafot.scenario import Scenario
from pytest_pafot.trace import Trace

DEAR = 0.010
"""From this mean duration of a run on, processes are worth their cost [s]: a run that is made in another one costs half
a millisecond more, and starting a process as much as some runs."""

WARM_RUNS = 2
"""Runs that must have been measured before. The first run of a search is not: it loads what the others use."""


class Prefetching:
    """Makes no run ahead: the base of those that do."""

    def __init__(self) -> None:
        self.announced: list[Scenario] = []
        """What will be asked for, as far as nobody has begun with it."""

    @property
    def notes(self) -> list[str]:
        """What was used, or why not, where that is worth telling; complete once the processes have ended."""
        return []

    def announce(self, scenarios: Sequence[Scenario]) -> None:
        """Know what will be asked for; of what was made before, nothing is kept."""
        self.announced = list(scenarios)

    def take(self, scenario: Scenario, *, afresh: bool) -> Trace | None:
        """The trace of a run, once; None where the run is to be made in this process and by itself.

        Raises:
            ProcessLostError: where the process that made it did not come back.
            ExecutionError: where it must be made in another process, and none can be started.
            Exception: what the world, the factory or the ADS's ``batch`` raises.
        """

    def ran_here(self, seconds: float) -> None:
        """Learn how long the last run took that was to be made in this process."""

    def close(self, *, at_once: bool) -> None:
        """Forget what was announced, and end processes, where ``at_once`` without waiting for any."""
        self.announce(())


class LockStep(Prefetching):
    """Makes announced runs at once, in one batch, when the first of them is asked for.

    Args:
        job: what is run, in a world with ``rollout_batch``.
        record: of this process.
        workers: processes that could have been used.
    """

    def __init__(self, job: Job, record: CrashRecord, *, workers: int) -> None:
        super().__init__()
        self._job = job
        self._record = record
        self._workers = workers
        self._made: dict[Scenario, Trace] = {}

    @property
    def notes(self) -> list[str]:
        """Why processes were not used, where they were asked for."""
        why = "since the ADS decides for many runs at once, by its `batch`"
        return [] if self._workers == 1 else [f"--pafot-workers={self._workers}: not in use, {why}"]

    def announce(self, scenarios: Sequence[Scenario]) -> None:
        """Know what will be asked for; of what was made before, nothing is kept."""
        self.announced, self._made = list(scenarios), {}

    def take(self, scenario: Scenario, *, afresh: bool) -> Trace | None:
        """The trace of an announced run, once; None where the run is to be made by itself."""
        __tracebackhide__ = True
        if afresh:
            return None
        if scenario in self.announced and len(self.announced) > 1:
            together, self.announced = self.announced, []
            self._record.write(*together)
            traces = self._job.world.rollout_batch(together, self._job.ads)
            self._made = dict(zip(together, traces, strict=True))
        elif scenario in self.announced:
            self.announced.remove(scenario)
        return self._made.pop(scenario, None)


class Processes(Prefetching):
    """Makes announced runs in other processes, from the moment on that runs of this one turn out to be dear.

    Args:
        job: what is run.
        workers: processes at most; with 1, none is ever started.
    """

    def __init__(self, job: Job, *, workers: int) -> None:
        super().__init__()
        self._job = job
        self._workers = workers
        self._pool: ScenarioPool | None = None
        self._failure = ""
        self._is_measured = False
        self._runs = 0
        self._warm_seconds = 0.0

    @property
    def notes(self) -> list[str]:
        """What was used, or why not, where that was asked for."""
        if self._failure:
            return [f"--pafot-workers is 1: {self._failure}"]
        option = f"--pafot-workers={self._workers}"
        if self._pool is not None:
            used = f"{option}: in use after {self._runs} runs of this process"
            if self._pool.failure:
                used = f"--pafot-workers: one process ran the scenarios, since no other could: {self._pool.failure}"
            return [used, *map(recovery_note, self._pool.recovered)]
        if self._workers == 1 or self._runs <= WARM_RUNS:
            return []
        mean, dear = 1000 * self._warm_seconds / (self._runs - 1), 1000 * DEAR
        return [f"{option}: not in use, since a run took {mean:.1f} ms, and it pays from {dear:g} ms on"]

    def announce(self, scenarios: Sequence[Scenario]) -> None:
        """Know what will be asked for, and begin with it where processes are in use."""
        self.announced = list(scenarios)
        if self._pool is not None:
            self._pool.expect(scenarios)

    def take(self, scenario: Scenario, *, afresh: bool) -> Trace | None:
        """The trace of an announced run, once; None where the run is to be made in this process."""
        __tracebackhide__ = True
        self._is_measured = False
        if afresh or scenario not in self.announced:
            return None
        self.announced.remove(scenario)
        self._is_measured = self._pool is None
        return None if self._pool is None else trace_from(self._pool.fetch(scenario))

    def ran_here(self, seconds: float) -> None:
        """Learn how long the last run took; what was not announced is not measured."""
        if not self._is_measured:
            return
        self._runs += 1
        self._warm_seconds += seconds if self._runs > 1 else 0.0
        is_dear = self._runs > WARM_RUNS and self._warm_seconds >= DEAR * (self._runs - 1)
        if is_dear and self._workers > 1 and not self._failure:
            try:
                self._pool = pool_for(self._job, self._workers)
            except ExecutionError as error:
                self._failure = str(error)
            else:
                self.announce(self.announced)

    def close(self, *, at_once: bool) -> None:
        """Forget what was announced, and end the processes."""
        self.announced = []
        if self._pool is not None:
            self._pool.close(at_once=at_once)


class Isolated(Prefetching):
    """Makes all runs in other processes, announced or not: the ADS is never called in this one.

    Args:
        job: what is run.
        workers: processes at most.
    """

    def __init__(self, job: Job, *, workers: int) -> None:
        super().__init__()
        self._job = job
        self._workers = workers
        self._pool: ScenarioPool | None = None
        self._recovered: list[LostRun] = []

    @property
    def notes(self) -> list[str]:
        """Which processes died in runs that were made after all."""
        return [recovery_note(each) for each in (*self._recovered, *(self._pool.recovered if self._pool else ()))]

    def announce(self, scenarios: Sequence[Scenario]) -> None:
        """Begin with these, in this order."""
        self._started().expect(scenarios)

    def take(self, scenario: Scenario, *, afresh: bool) -> Trace | None:
        """The trace of a run; None where only this process can show what was raised beside the ADS."""
        __tracebackhide__ = True
        pool = self._started()
        answer = pool.fetch(scenario)
        if pool.failure:
            raise ExecutionError(f"--pafot-isolate: expected processes to run the ADS in, received: {pool.failure}")
        return trace_from(answer)

    def close(self, *, at_once: bool) -> None:
        """Forget what was announced, and end the processes; what is asked for later has others."""
        pool, self._pool = self._pool, None
        if pool is not None:
            pool.close(at_once=at_once)
            self._recovered += pool.recovered

    def _started(self) -> ScenarioPool:
        if self._pool is None:
            try:
                self._pool = pool_for(self._job, self._workers)
            except ExecutionError as error:
                raise ExecutionError(f"--pafot-isolate: {error}") from None
        return self._pool
