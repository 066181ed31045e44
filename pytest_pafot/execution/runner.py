"""One way to run a scenario: a search announces which ones come, and asks for one run after the other.

Where a run is made depends on the ADS and on what a run costs: in this process, in lock step with others, or in
another process. Nothing but the time depends on it. :func:`runner_for` puts together who does what.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any, Protocol, Self

from pytest_pafot.execution.crash_records import CrashRecord
from pytest_pafot.execution.job import Job
from pytest_pafot.execution.known_decisions import KnownDecisions
from pytest_pafot.execution.prefetching import LockStep, Processes
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
from pytest_pafot.world.driving.ads import is_vehicle_class


class Runner(Protocol):
    """Gives the runs of one search.

    As a context manager it ends the processes that it has started, at once where an exception passes, and forgets what
    was announced. It can be used after that and entered again: what is asked for then is made as if it had not been
    announced.

    Attributes:
        is_alone: whether the last trace was made by itself, and not in lock step with others.
    """

    is_alone: bool

    @property
    def notes(self) -> list[str]:
        """How the runs were made, where that is worth telling; complete once the processes have ended."""

    def announce(self, scenarios: Sequence[Scenario]) -> None:
        """Say what will be asked for next, in this order; what was announced before is forgotten."""

    def run(self, scenario: Scenario, *, afresh: bool = False) -> Trace:
        """One run. It leaves the crash record written, for a verdict that may end the process too.

        Args:
            scenario: to run, announced or not.
            afresh: whether the ADS is asked for every decision, and for this run alone.

        Raises:
            ProcessLostError: where another process made it, and did not come back.
            ExecutionError: where it must be made in another process, and none can be started.
            Exception: what the world or the factory raises.
        """

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None: ...


def runner_for(
    job: Job,
    record: CrashRecord,
    *,
    workers: int = 1,
    isolate: bool = False,
    can_lock_step: bool = False,
    can_resume: bool = False,
    clock: Callable[[], float] = time.perf_counter,
) -> Runner:
    """Who makes the runs of a job.

    Args:
        job: what is run.
        record: of this process, open; the caller clears it after each verdict, and closes it.
        workers: processes at most beside this one; with 1, all runs are made in this one unless ``isolate`` is set.
        isolate: whether the ADS shall never run in this process.
        can_lock_step: whether an ADS with a method ``batch`` may decide for many runs at once.
        can_resume: whether decisions of an ADS that is declared ``pure`` may be taken from earlier runs.
        clock: seconds, monotonic.
    """
    if isolate:
        return Isolated(job, record, workers=workers)
    # This process makes the first runs. They show what the ADS can do and what a run costs. From then on the runs that
    # were announced are made in lock step where the ADS decides for many at once, else in processes where a run is
    # dear; what was not announced, or cannot be made elsewhere, is always made in this process.
    return InProcess(
        job,
        record,
        processes=Processes(job, workers=workers),
        lock_step=LockStep(job, record) if can_lock_step else None,
        known=KnownDecisions() if can_resume else None,
        clock=clock,
    )


class InProcess:
    """Makes runs in this process, unless they were made ahead of being asked for.

    Args:
        job: what is run.
        record: of this process.
        processes: make announced runs ahead, once runs turn out to be dear.
        lock_step: makes announced runs ahead in the place of processes, once the ADS shows that it can.
        known: decisions of earlier runs, once the ADS shows that it is pure.
        clock: seconds, monotonic.
    """

    def __init__(
        self,
        job: Job,
        record: CrashRecord,
        *,
        processes: Processes,
        lock_step: LockStep | None,
        known: KnownDecisions | None,
        clock: Callable[[], float],
    ) -> None:
        self.is_alone = True
        self._job = job
        self._record = record
        self._processes = processes
        self._lock_step = lock_step
        self._known = known
        self._clock = clock
        self._ahead: Processes | LockStep = processes
        is_of_interest = (lock_step is not None or known is not None) and not is_vehicle_class(job.ads)
        self._factory = self._showing(job.ads) if is_of_interest else job.ads

    @property
    def notes(self) -> list[str]:
        """How the runs were made; complete once the processes have ended."""
        if self._ahead is self._processes or self._processes.size == 1:
            return self._processes.notes
        why = "since the ADS decides for many runs at once, by its `batch`"
        return [f"--pafot-workers={self._processes.size}: not in use, {why}"]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._ahead.announce(())
        self._processes.close(at_once=kind is not None)

    def announce(self, scenarios: Sequence[Scenario]) -> None:
        """Say what will be asked for next, in this order."""
        self._ahead.announce(scenarios)

    def run(self, scenario: Scenario, *, afresh: bool = False) -> Trace:
        """One run, made ahead where that was possible, else here and now."""
        __tracebackhide__ = True
        trace = None if afresh else self._ahead.take(scenario)
        self.is_alone = trace is None or self._ahead is not self._lock_step
        self._record.write(scenario)
        if trace is None:
            decisions = () if afresh or self._known is None else self._known.decisions(scenario)
            started = self._clock()
            trace = self._job.rollout(scenario, self._factory, decisions)
            self._processes.ran_here(self._clock() - started)
        if self._known is not None and self.is_alone:  # what is decided for many at once is not relied on
            self._known.remember(trace)
        return trace

    def _showing(self, factory: Callable[..., Any]) -> Callable[..., Any]:
        """The factory, whose first ADS is looked at: a factory is called for runs and for nothing else."""

        def make(*arguments: Any, **named: Any) -> Any:
            __tracebackhide__ = True
            ads = factory(*arguments, **named)
            self._look_at(ads)
            return ads

        make.__wrapped__ = factory  # type: ignore[attr-defined]  # signatures are looked up there
        return make

    def _look_at(self, ads: Any) -> None:
        self._factory = self._job.ads
        if self._known is not None:
            self._known.saw(ads)
        if self._lock_step is not None and callable(getattr(ads, "batch", None)):
            self._lock_step.announce(self._processes.announced)
            self._processes.announce(())
            self._ahead = self._lock_step


class Isolated:
    """Has all runs made in other processes: the ADS is never called in this one.

    Args:
        job: what is run.
        record: of this process.
        workers: processes at most.
    """

    def __init__(self, job: Job, record: CrashRecord, *, workers: int) -> None:
        self.is_alone = True
        self._job = job
        self._record = record
        self._workers = workers
        self._pool: ScenarioPool | None = None
        self._recovered: list[LostRun] = []

    @property
    def notes(self) -> list[str]:
        """Which processes died in runs that were made after all."""
        return [recovery_note(each) for each in (*self._recovered, *(self._pool.recovered if self._pool else ()))]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        pool, self._pool = self._pool, None
        if pool is not None:
            pool.close(at_once=kind is not None)
            self._recovered += pool.recovered

    def announce(self, scenarios: Sequence[Scenario]) -> None:
        """Begin with these, in this order."""
        self._started().expect(scenarios)

    def run(self, scenario: Scenario, *, afresh: bool = False) -> Trace:
        """One run; in this process only to raise what it raised in another one beside the ADS."""
        __tracebackhide__ = True
        pool = self._started()
        answer = pool.fetch(scenario)
        if pool.failure:
            raise ExecutionError(f"--pafot-isolate: expected processes to run the ADS in, received: {pool.failure}")
        trace = trace_from(answer)
        self._record.write(scenario)
        return self._job.rollout(scenario) if trace is None else trace

    def _started(self) -> ScenarioPool:
        if self._pool is None:
            try:
                self._pool = pool_for(self._job, self._workers)
            except ExecutionError as error:
                raise ExecutionError(f"--pafot-isolate: {error}") from None
        return self._pool
