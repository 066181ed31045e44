"""Single runs in another process, since this one may die of them, or of the verdict."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from pytest_pafot.execution import scenario_pool
from pytest_pafot.execution.captured_output import capture_output
from pytest_pafot.execution.crash_records import CrashRecord
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.runner import runner_for
from pytest_pafot.execution.scenario_pool import NOT_REPEATED, Answer, ExecutionError, Job, pool_for, trace_apart
from pytest_pafot.scenario import Scenario
from pytest_pafot.trace import Trace
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
