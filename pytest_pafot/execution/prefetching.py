"""Simulation of runs before a search requests them: many at once in lock step, or in other processes.

:meth:`pytest_pafot.execution.runner.Runner.run` documents the exceptions of ``take``.
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
from pytest_pafot.support.ways_out import flag
from pytest_pafot.world import Highway
from pytest_pafot.world.guard.own_worlds import simulate_batch

DEAR = 0.010
"""The mean duration of a run from which on a search is faster with other processes [s].

A run in a different process takes half a millisecond longer, and starting a process takes as long as several runs.
"""

WARM_RUNS = 2
"""The number of runs, after the first run of a search, that decide whether other processes are used.

The first run is slower, because it loads libraries. If it was slow, processes are started after it. If the next runs
turn out to be fast, the processes are ended.
"""


class LockStep:
    """A maker of runs in lock step: it runs all announced scenarios in one batch when the first of them is requested.

    On a Highway, all scenarios of a batch have the same number of NPCs. Otherwise the observations would have rows of
    NaN for missing NPCs, and a network would decide on NaN without an error. The world of the job must have
    ``rollout_batch``. ``workers`` is the number of processes that the user requested.
    """

    def __init__(self, job: Job, record: CrashRecord, *, workers: int) -> None:
        self._job = job
        self._record = record
        self._workers = workers
        self._announced: list[Scenario] = []
        self._made: dict[Scenario, Trace] = {}

    @property
    def notes(self) -> list[str]:
        """The note on why processes were not used although the user requested them; empty if not requested."""
        why = "since the ADS decides for many runs at once, by its `batch`"
        return [] if self._workers == 1 else [f"{flag('workers', self._workers)}: not in use, {why}"]

    def announce(self, scenarios: Iterable[Scenario]) -> None:
        """Announce the next scenarios; runs of earlier announcements that were not taken are dropped."""
        self._announced, self._made = list(scenarios), {}

    def take(self, scenario: Scenario, *, afresh: bool) -> Trace | None:
        """Return the trace of an announced scenario; None if the scenario must be run by itself.

        Each trace can be taken once. With ``afresh`` the result is always None.
        """
        __tracebackhide__ = True
        if afresh:
            return None
        if scenario in self._announced:
            are_alike = not isinstance(self._job.world, Highway)
            together = [each for each in self._announced if are_alike or len(each.npcs) == len(scenario.npcs)]
            self._announced = [each for each in self._announced if each not in together]
            if len(together) > 1:
                self._record.write(*together)
                traces = simulate_batch(self._job.world, together, self._job.ads)
                self._made |= dict(zip(together, traces, strict=True))
        return self._made.pop(scenario, None)


class Processes:
    """A maker of announced runs in other processes, which are started if runs turn out to be slow.

    With one worker, no process is ever started. If there is an executor, it makes all announced runs.
    """

    def __init__(self, job: Job, *, workers: int, executor: Executor | None = None) -> None:
        self.announced: list[Scenario] = []
        """The announced scenarios that were not requested yet."""
        self._job = job
        self._workers = workers
        self._executor = executor
        self._pool: ScenarioPool | ExecutorPool | None = None
        self._failure = ""
        self._is_measured = False
        self._runs = self._runs_before = 0  # all runs, and the runs before processes were started
        self._warm_seconds = 0.0

    @property
    def notes(self) -> list[str]:
        """Notes on the use of processes if the user requested them; complete after the processes have ended."""
        if self._failure:
            return [f"{flag('workers')} is 1: {self._failure}"]
        if isinstance(self._pool, ExecutorPool):
            return self._pool.notes
        option = flag("workers", self._workers)
        if self._pool is not None:
            used = f"{option}: in use after {plural(self._runs_before, 'run')} of this process"
            if self._pool.failure:
                used = f"{flag('workers')}: this process ran the scenarios; no other one could: {self._pool.failure}"
            return [used, *map(recovery_note, self._pool.recovered)]
        if self._workers == 1 or self._runs <= WARM_RUNS:
            return []
        mean, dear = 1000 * self._warm_seconds / (self._runs - 1), 1000 * DEAR
        return [f"{option}: not in use, since a run took {mean:.1f} ms, and it pays off from {dear:g} ms on"]

    def announce(self, scenarios: Iterable[Scenario]) -> None:
        """Announce the next scenarios, and start to run them if processes are in use."""
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
        """Return the trace of an announced scenario; None if the scenario must be run in this process.

        Each trace can be taken once. With ``afresh`` the result is always None.
        """
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
        """Record the duration of the last run in this process [s]; only announced runs are used."""
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
        """End the processes; with ``at_once`` kill all of them without waiting."""
        if self._pool is not None:
            self._pool.close(at_once=at_once)

    def _begin(self) -> ScenarioPool | ExecutorPool:
        job, executor = self._job, self._executor
        self._pool = pool = pool_for(job, self._workers) if executor is None else ExecutorPool(job, executor)
        pool.expect(self.announced)
        return pool


class Isolated(Processes):
    """A maker of all runs, announced or not, in other processes, so that the ADS is never called in this process."""

    @property
    def notes(self) -> list[str]:
        """Notes on processes that died in runs that later succeeded, and on an executor that made all runs."""
        if isinstance(self._pool, ExecutorPool):
            return [] if self._pool.failure or self._pool.unable else self._pool.notes
        return [] if self._pool is None else [recovery_note(each) for each in self._pool.recovered]

    def take(self, scenario: Scenario, *, afresh: bool) -> Trace:
        """Return the trace of a scenario from a different process, and raise the exceptions of that process.

        No run is repeated in this process. So if a worker of an executor raises, for example because it lacks a
        package, the result is an ``ExecutionError``.
        """
        __tracebackhide__ = True
        try:
            pool = self._pool or self._begin()
        except ExecutionError as error:
            raise ExecutionError(f"{flag('isolate')}: {error}") from None
        answer = pool.fetch(scenario)
        if pool.failure:
            raise ExecutionError(f"{flag('isolate')}: expected processes to run the ADS in, received: {pool.failure}")
        if isinstance(pool, ExecutorPool) and pool.unable:
            first = pool.unable[0]
            raise ExecutionError(
                f"{flag('isolate')}: expected workers that can make every run, received from one of them "
                f"{type(first).__name__}: {first}; install what the run needs on the workers, or search without "
                f"{flag('isolate')}, so that this process makes such runs"
            )
        return trace_apart(answer)
