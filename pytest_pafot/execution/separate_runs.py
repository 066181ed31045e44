"""Single runs in a separate process, for scenarios in which the run or its evaluation may end this process."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from pytest_pafot.execution import scenario_pool
from pytest_pafot.execution.captured_output import capture_output
from pytest_pafot.execution.crash_records import CrashRecord, Leftover
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.runner import runner_for
from pytest_pafot.execution.scenario_pool import (
    NOT_REPEATED,
    Answer,
    ExecutionError,
    Job,
    LostRun,
    pool_for,
    trace_apart,
)
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Outcome, Trace
from pytest_pafot.support.ways_out import flag
from pytest_pafot.world import protocol
from pytest_pafot.world.guard.own_worlds import rollout_of


@dataclass(frozen=True, slots=True)
class _OtherRuns:
    """A stand-in for a world, with a different ``rollout``, which guards the ADS."""

    guards_ads = True

    hang_limit: float
    rollout: Callable[[Scenario, Callable[..., Any]], Trace]


def answers_apart(
    job: Job, scenarios: Sequence[Scenario], judge: Callable[[Trace], object], *, isolate: bool
) -> dict[Scenario, Answer] | None:
    """Run and evaluate each scenario by itself in a separate process; return the answers, or None if impossible.

    If a process dies, the answer is a ``ProcessLostError`` even if a second attempt succeeds, because a process has
    already died in this scenario before.

    Args:
        job: everything that a run needs.
        scenarios: the scenarios, run one after the other.
        judge: evaluates a trace. It needs the fixtures of the test function, which only forked processes have. Its
            output and its exceptions are ignored, because the session evaluates the run again.
        isolate: True if the run must be in a separate process, without the evaluation if processes cannot be forked.

    Raises:
        ExecutionError: with ``isolate``, if no other process can be started.
    """
    world = job.world

    def judged(scenario: Scenario, ads: Callable[..., Any]) -> Trace:
        trace = rollout_of(world)(scenario, ads)
        with capture_output(), suppress(BaseException):
            judge(trace)
        return trace

    if scenario_pool.METHOD == "fork":
        job = replace(job, world=_OtherRuns(protocol.hang_limit(world), judged))
    elif not isolate:
        return None
    with pool_for(job, 1) as pool:
        pool.expect(scenarios)
        answers = {scenario: pool.fetch(scenario) for scenario in scenarios}
    if pool.failure and isolate:
        raise ExecutionError(f"{flag('isolate')}: expected processes to run the ADS in, received: {pool.failure}")
    return None if pool.failure else answers | {lost.task: lost for lost in pool.recovered}


def run_apart(
    job: Job,
    scenario: Scenario,
    judge: Callable[[Trace], object],
    *,
    isolate: bool,
    in_own_session: Callable[[], object],
) -> Trace | None:
    """Return the trace of a scenario that was run and evaluated in a separate process.

    The session then evaluates the trace again. Return None if the scenario must be run in this process, because no
    other process can be started. In that case, ``in_own_session`` has first replayed the scenario in a separate
    session, which has survived. For the other arguments see :func:`answers_apart`.

    Raises:
        ProcessLostError: if the separate process died or hung.
        ExecutionError: with ``isolate``, if no other process can be started; without, if the ADS does not work in one.
        Exception: with ``isolate``, any exception of the separate process.
    """
    __tracebackhide__ = True
    answers = answers_apart(job, [scenario], judge, isolate=isolate)
    if answers is None:
        in_own_session()
        return None
    try:
        return trace_apart(answers[scenario])
    except ProcessLostError:
        raise
    except Exception as error:
        if isolate:
            raise
        raise ExecutionError(
            "expected a scenario that has ended a process to run in a separate process, received from there "
            f"{type(error).__name__}: {error}. {NOT_REPEATED} Or delete the file; a search may then find it again"
        ) from None


def replay_in_gym_apart(job: Job, record: CrashRecord, scenario: Scenario) -> Trace:
    """Run a scenario with ``env.step`` of highway-env's own environment in a separate process.

    Raises:
        ProcessLostError: if the separate process died or hung.
        ExecutionError: if no other process can be started.
        Exception: any exception of the separate process.
    """
    __tracebackhide__ = True
    in_gym = replace(job, world=_OtherRuns(protocol.hang_limit(job.world), job.world.rollout_in_gym))
    with runner_for(in_gym, record, isolate=True) as runner:
        return runner.run(scenario)


# A scenario in which a process died runs again in a separate process before it is called a finding.
#
# A process may also be killed from outside: a job is cancelled, or the system is short of memory. Then the scenario
# says nothing about the ADS, however many sessions are killed in a row. But if two processes died in the same scenario,
# the cause is probably something that builds up from run to run, such as memory of the test function. Then the scenario
# is called a finding after all, or this would never be reported.


@dataclass(frozen=True, slots=True, kw_only=True)
class Retried:
    """The result of a second attempt to run the scenarios of a process that died."""

    notes: tuple[str, ...] = ()
    """Notes for the user on scenarios that did not cause the death of the process."""
    pending: Leftover | None = None
    """The crash record to remove at the end of the search, or None. If this session dies, the next one reads it."""


def retry(
    leftover: Leftover,
    job: Job,
    judge: Callable[[Trace], object],
    *,
    isolate: bool,
    has_died_twice: bool,
    keep: Callable[[Leftover, Scenario, LostRun | None], object],
    run_here: Callable[[Leftover], object],
) -> Retried:
    """Try the scenarios of a process that died a second time, and save the scenarios that caused its death.

    If a reference was driving when the process died, the reference is the cause, and nothing is run again. A scenario
    that ran by itself is saved although a second attempt survives, or is impossible, in two cases: two processes died
    in it, or no separate process can be started.

    Args:
        leftover: the crash record of the process; it is removed unless the result contains it as ``pending``.
        job: everything that a run of the scenarios needs.
        judge, isolate: see :func:`answers_apart`.
        has_died_twice: whether another process died in the same scenarios.
        keep: saves a scenario in which a process died; its last argument is the second death, or None if unknown.
        run_here: runs the scenarios of a batch in this process, one by one, each with a crash record on disk. If this
            process dies, the next session reads that record.
    """
    if leftover.reference:
        note = (
            f"a process (pid {leftover.pid}) died while the reference {leftover.reference} drove in "
            f"{leftover.scenario!r}, which says nothing about the ADS: correct the reference, or search with "
            f"{flag('isolate')}, so that it can die without harm"
        )
        return Retried(notes=(note,), pending=leftover)
    answers: dict[Scenario, Answer] | None = None
    with suppress(ExecutionError):  # The first run of the search reports it.
        answers = answers_apart(job, leftover.scenarios, judge, isolate=isolate)
    if answers is None and leftover.is_lock_step:
        run_here(leftover)
        return Retried()
    is_build_up = has_died_twice and not leftover.is_lock_step
    guilty = [
        each for each in leftover.scenarios if answers is None or is_build_up or not _came_to_its_end(answers[each])
    ]
    for scenario in guilty:
        answer = None if answers is None else answers[scenario]
        lost = answer if isinstance(answer, ProcessLostError) else None
        if lost is not None or not leftover.is_lock_step:
            keep(leftover, scenario, lost)
    if guilty:
        leftover.discard()
        return Retried()
    ran = f"{leftover.scenario!r},"
    if leftover.is_lock_step:
        ran = f"{len(leftover.scenarios)} scenarios in lock step, each of"
    note = (
        f"a process (pid {leftover.pid}) died while it ran {ran} which ran to its end when it was tried again: the "
        "process was killed from outside, or there was too little memory"
    )
    return Retried(notes=(note,), pending=leftover)


def _came_to_its_end(answer: Answer) -> bool:
    """Return whether a run succeeded, without an error of the ADS, which may occur only in the separate process."""
    return not isinstance(answer, Exception) and answer[0].outcome not in (Outcome.ADS_ERROR, Outcome.HANG)
