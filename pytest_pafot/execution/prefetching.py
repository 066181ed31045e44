"""Runs that are made before a search asks for them: in lock step, or in other processes.

What taking a run may raise is said where it is taken, in :meth:`pytest_pafot.execution.runner.Runner.run`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import Executor

from pytest_pafot.execution.crash_records import CrashRecord
from pytest_pafot.execution.executors import ExecutorPool
from pytest_pafot.execution.scenario_pool import (
    ExecutionError,
    Job,
    ScenarioPool,
    pool_for,
    recovery_note,
    trace_apart,
    trace_from,
)
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Trace
from pytest_pafot.support.text import plural
from pytest_pafot.world import Highway

DEAR = 0.010
"""From this mean duration of a run on, processes are worth their cost [s]: a run that is made in another one costs half
a millisecond more, and starting a process as much as some runs."""

WARM_RUNS = 2
"""Runs that tell for good. The first run of a search does not, since it loads what the others use: processes begin
after it where it was dear, and end again where those are not."""


class LockStep:
    """Makes announced runs at once, in one batch, when the first of them is asked for.

    On a Highway these have as many NPCs each: a planner is shown all of them, and a network that is given rows of NaN
    for those that a run lacks decides on NaN without an error. The world of the job has ``rollout_batch``; ``workers``
    is the number of processes that could have been used.
    """

    def __init__(self, job: Job, record: CrashRecord, *, workers: int) -> None:
        self._job = job
        self._record = record
        self._workers = workers
        self._announced: list[Scenario] = []
        self._made: dict[Scenario, Trace] = {}

    @property
    def notes(self) -> list[str]:
        """Why processes were not used, where they were asked for."""
        why = "since the ADS decides for many runs at once, by its `batch`"
        return [] if self._workers == 1 else [f"--pafot-workers={self._workers}: not in use, {why}"]

    def announce(self, scenarios: Iterable[Scenario]) -> None:
        """Know what will be asked for; of what was made before, nothing is kept."""
        self._announced, self._made = list(scenarios), {}

    def take(self, scenario: Scenario, *, afresh: bool) -> Trace | None:
        """The trace of an announced run, once; None where the run is to be made by itself."""
        __tracebackhide__ = True
        if afresh:
            return None
        if scenario in self._announced:
            are_alike = not isinstance(self._job.world, Highway)
            together = [each for each in self._announced if are_alike or len(each.npcs) == len(scenario.npcs)]
            self._announced = [each for each in self._announced if each not in together]
            if len(together) > 1:
                self._record.write(*together)
                traces = self._job.world.rollout_batch(together, self._job.ads)
                self._made |= dict(zip(together, traces, strict=True))
        return self._made.pop(scenario, None)


class Processes:
    """Makes announced runs in other processes, from the moment on that runs turn out to be dear.

    With one worker, none is ever started. With an executor all announced runs are made by that, from the first on.
    """

    def __init__(self, job: Job, *, workers: int, executor: Executor | None = None) -> None:
        self.announced: list[Scenario] = []
        """What will be asked for, as far as it was not yet."""
        self._job = job
        self._workers = workers
        self._executor = executor
        self._pool: ScenarioPool | ExecutorPool | None = None
        self._failure = ""
        self._is_measured = False
        self._runs = self._runs_before = 0  # altogether, and before there were processes
        self._warm_seconds = 0.0

    @property
    def notes(self) -> list[str]:
        """What was used, or why not, where that was asked for; complete once the processes have ended."""
        if self._failure:
            return [f"--pafot-workers is 1: {self._failure}"]
        if isinstance(self._pool, ExecutorPool):
            return self._pool.notes
        option = f"--pafot-workers={self._workers}"
        if self._pool is not None:
            used = f"{option}: in use after {plural(self._runs_before, 'run')} of this process"
            if self._pool.failure:
                used = f"--pafot-workers: one process ran the scenarios, since no other could: {self._pool.failure}"
            return [used, *map(recovery_note, self._pool.recovered)]
        if self._workers == 1 or self._runs <= WARM_RUNS:
            return []
        mean, dear = 1000 * self._warm_seconds / (self._runs - 1), 1000 * DEAR
        return [f"{option}: not in use, since a run took {mean:.1f} ms, and it pays from {dear:g} ms on"]

    def announce(self, scenarios: Iterable[Scenario]) -> None:
        """Know what will be asked for, and begin with it where processes are in use."""
        self.announced = []
        if self._pool is not None:
            self._pool.expect(self._noted(scenarios))
        else:
            self.announced.extend(scenarios)

    def _noted(self, scenarios: Iterable[Scenario]) -> Iterator[Scenario]:
        for scenario in scenarios:
            self.announced.append(scenario)
            yield scenario

    def take(self, scenario: Scenario, *, afresh: bool) -> Trace | None:
        """The trace of an announced run, once; None where the run is to be made in this process."""
        __tracebackhide__ = True
        if afresh or scenario not in self.announced:
            return None
        if self._executor is not None and self._pool is None:
            self._begin()
        self.announced.remove(scenario)
        self._is_measured = self._pool is None
        if self._pool is None:
            return None
        answer = self._pool.fetch(scenario)
        if isinstance(answer, tuple) and self._executor is None:
            self._learn(answer[2])
        return trace_from(answer)

    def ran_here(self, seconds: float) -> None:
        """Learn how long the last run took; what was not announced is not measured."""
        if self._is_measured:
            self._is_measured = False
            self._learn(seconds)

    def _learn(self, seconds: float) -> None:
        self._runs += 1
        self._warm_seconds += seconds if self._runs > 1 else 0.0
        is_dear = self._warm_seconds >= DEAR * (self._runs - 1) if self._runs > WARM_RUNS else seconds >= DEAR
        if self._pool is not None and self._runs == WARM_RUNS + 1 and not is_dear:
            self._pool.close(at_once=True)
            self._pool = None
        elif self._pool is None and is_dear and self._workers > 1 and not self._failure:
            self._runs_before = self._runs
            try:
                self._begin()
            except ExecutionError as error:
                self._failure = str(error)

    def close(self, *, at_once: bool) -> None:
        """End the processes, where ``at_once`` without waiting for any."""
        if self._pool is not None:
            self._pool.close(at_once=at_once)

    def _begin(self) -> ScenarioPool | ExecutorPool:
        job, executor = self._job, self._executor
        self._pool = pool = pool_for(job, self._workers) if executor is None else ExecutorPool(job, executor)
        pool.expect(self.announced)
        return pool


class Isolated(Processes):
    """Makes all runs in other processes, announced or not: the ADS is never called in this one."""

    @property
    def notes(self) -> list[str]:
        """Which processes died in runs that were made after all; of an executor that made all, also that it did."""
        if isinstance(self._pool, ExecutorPool):
            return [] if self._pool.failure or self._pool.unable else self._pool.notes
        return [] if self._pool is None else [recovery_note(each) for each in self._pool.recovered]

    def take(self, scenario: Scenario, *, afresh: bool) -> Trace:
        """The trace of a run. What was raised in the other process is raised here, and nothing is repeated here.

        Of an executor's workers that may be what they lack, so that such a run is refused.
        """
        __tracebackhide__ = True
        try:
            pool = self._pool or self._begin()
        except ExecutionError as error:
            raise ExecutionError(f"--pafot-isolate: {error}") from None
        answer = pool.fetch(scenario)
        if pool.failure:
            raise ExecutionError(f"--pafot-isolate: expected processes to run the ADS in, received: {pool.failure}")
        if isinstance(pool, ExecutorPool) and pool.unable:
            first = pool.unable[0]
            raise ExecutionError(
                "--pafot-isolate: expected workers that can make every run, received from one "
                f"{type(first).__name__}: {first}; let the workers have what the run needs, or search without "
                "--pafot-isolate, where this process makes such runs"
            )
        return trace_apart(answer)
