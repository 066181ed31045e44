"""Single runs in another process, since this one may die of them, or of the verdict."""

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
from pytest_pafot.world import protocol


@dataclass(frozen=True, slots=True)
class _OtherRuns:
    """In the place of a world: its scenarios run in another way."""

    hang_limit: float
    rollout: Callable[[Scenario, Callable[..., Any]], Trace]


def answers_apart(
    job: Job, scenarios: Sequence[Scenario], judge: Callable[[Trace], object], *, isolate: bool
) -> dict[Scenario, Answer] | None:
    """What running and judging each scenario by itself in another process shows.

    A death counts, also where the process that tries it again lives: it is not the first of this scenario.

    Args:
        job: what is run.
        scenarios: one after the other.
        judge: of a trace; only forked processes have it, since it needs the fixtures of the test function. What it
            prints and raises is seen where the verdict counts.
        isolate: whether another process without the judge will do where none can be forked; else there is None.

    Raises:
        ExecutionError: with ``isolate``, where there can be no other process.
    """
    world = job.world

    def judged(scenario: Scenario, ads: Callable[..., Any]) -> Trace:
        trace: Trace = world.rollout(scenario, ads)
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
        raise ExecutionError(f"--pafot-isolate: expected processes to run the ADS in, received: {pool.failure}")
    return None if pool.failure else answers | {lost.task: lost for lost in pool.recovered}


def run_apart(
    job: Job,
    scenario: Scenario,
    judge: Callable[[Trace], object],
    *,
    isolate: bool,
    in_own_session: Callable[[], object],
) -> Trace | None:
    """The trace of a scenario that was run and judged in another process, to be judged again in this one.

    None where it is to be run in this process: there can be no other one, and it came through ``in_own_session``, which
    replays it in a session of its own. :func:`answers_apart` has the other arguments.

    Raises:
        ProcessLostError: where that process did not come back.
        ExecutionError: with ``isolate`` where there can be no other process; without where it works in no other one.
        Exception: with ``isolate``, what was raised there.
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
            "expected a scenario that has ended a process to run in another process, received from there "
            f"{type(error).__name__}: {error}. {NOT_REPEATED} Or delete the file, which a search may then find again"
        ) from None


def replay_in_gym_apart(job: Job, record: CrashRecord, scenario: Scenario) -> Trace:
    """One run by ``env.step`` of the environment of a world that has one, in another process, or what it raised there.

    Raises:
        ProcessLostError: where that process did not come back.
        ExecutionError: where there can be no other process.
    """
    __tracebackhide__ = True
    in_gym = replace(job, world=_OtherRuns(protocol.hang_limit(job.world), job.world.rollout_in_gym))
    with runner_for(in_gym, record, isolate=True) as runner:
        return runner.run(scenario)


# What was in flight when a process died runs again, in a process of its own, before it is called a finding.
#
# A process also dies because somebody ends it: a job that is cancelled, a system that is short of memory. The
# scenario that it ran then says nothing of the ADS. Where the next session dies as well, it is no accident: something
# that builds up from run to run, such as memory. That scenario is then called a finding after all, or nobody would
# hear of it.


@dataclass(frozen=True, slots=True, kw_only=True)
class Retried:
    """What came of the record of a process that died."""

    notes: tuple[str, ...] = ()
    """On what is not to blame."""
    pending: Leftover | None = None
    """To discard once the search is through; until then this session may die as well."""


def retry(
    leftover: Leftover,
    job: Job,
    judge: Callable[[Trace], object],
    *,
    isolate: bool,
    keep: Callable[[Leftover, Scenario, LostRun | None], object],
    run_here: Callable[[Leftover], object],
) -> Retried:
    """Keep what is to blame for the death of a process.

    A reference that drove when the process died is to blame itself, and what it drove in is not run again. Where no
    process can be made to try it in, one death is enough for a scenario that was alone in flight; and where
    the session that tried it died as well, that is enough too.

    Args:
        leftover: of the process; removed once all is said, unless it is pending.
        job: what the process ran.
        judge, isolate: see :func:`answers_apart`.
        keep: saves a scenario in which a process died, and another one when it ran again, as far as that is known.
        run_here: runs what was in lock step in this process, with the scenario on disk, for the next session to retry.
    """
    if leftover.reference:
        note = (
            f"a process (pid {leftover.pid}) died while {leftover.reference} ran {leftover.scenario!r}, which is held "
            "against it and not against the ADS: mend it, or search with --pafot-isolate, where it may die"
        )
        return Retried(notes=(note,), pending=leftover)
    answers: dict[Scenario, Answer] | None = None
    if not leftover.is_tried:
        with suppress(ExecutionError):  # The first run of the search says so.
            answers = answers_apart(job, leftover.scenarios, judge, isolate=isolate)
    if answers is None and leftover.is_lock_step:
        run_here(leftover)
        return Retried()
    guilty = [each for each in leftover.scenarios if answers is None or not _came_to_its_end(answers[each])]
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
    return Retried(notes=(note,), pending=leftover.tried())


def _came_to_its_end(answer: Answer) -> bool:
    """Whether a run did. One in which the ADS failed may have failed since it was another process."""
    return not isinstance(answer, Exception) and answer[0].outcome not in (Outcome.ADS_ERROR, Outcome.HANG)
