"""Single runs in another process, since this one may die of them, or of the verdict.

Forked processes have the fixtures of the test function. Where processes cannot be forked, a session of its own tries
a saved scenario first, which needs nothing that can be pickled.
"""

from __future__ import annotations

import os
import shlex
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pytest_pafot.execution import scenario_pool
from pytest_pafot.execution.captured_output import capture_output
from pytest_pafot.execution.crash_records import CrashRecord, left_by
from pytest_pafot.execution.job import Job
from pytest_pafot.execution.pool import Lost, ending
from pytest_pafot.execution.runner import runner_for
from pytest_pafot.execution.scenario_pool import Answer, ExecutionError, ProcessLostError, pool_for, trace_from
from pytest_pafot.scenario import Scenario
from pytest_pafot.trace import Trace
from pytest_pafot.world import protocol

REPLAYED = (0, 1)
"""Exit codes of a session that came to the verdict on a saved scenario: all tests passed, or some failed."""

HUNG = 2
"""Exit code of a session that ended itself since the ADS took no interruption."""

IN_SESSION = "PAFOT_REPLAY_HERE"
"""Set in the environment of a session that was started to replay a file in its own process."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Session:
    """How a session of its own is started that replays a saved scenario.

    Attributes:
        file: of the scenario.
        command: the program and its arguments.
        folder: that it starts in.
    """

    file: Path
    command: Sequence[str]
    folder: Path


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
        judge: of a trace; only forked processes have it. What it prints is said where the verdict counts.
        isolate: whether another process without the judge will do where none can be forked.

    Returns:
        None where there can be no such process.
    """

    def judged(scenario: Scenario, ads: Callable[..., Any]) -> Trace:
        trace: Trace = job.world.rollout(scenario, ads)
        with capture_output():
            judge(trace)
        return trace

    judging = replace(job, world=_OtherRuns(protocol.hang_limit(job.world), judged))
    is_forked = scenario_pool.METHOD == "fork"
    if not is_forked and not isolate:
        return None
    try:
        pool = pool_for(judging if is_forked else job, 1)
    except ExecutionError:
        return None
    with pool:
        pool.expect(scenarios)
        answers = {scenario: pool.fetch(scenario) for scenario in scenarios}
    return None if pool.failure else answers | {lost.task: lost for lost in pool.recovered}


def run_apart(
    job: Job,
    scenario: Scenario,
    judge: Callable[[Trace], object],
    *,
    isolate: bool,
    session: Callable[[], Session],
) -> Trace | None:
    """The trace of a saved scenario that was run and judged in another process, to be judged again in this one.

    Args:
        job: what is run.
        scenario: of the file.
        judge: of a trace.
        isolate: whether another process without the judge will do where none can be forked.
        session: says how a session of its own is started, where there can be no other process.

    Returns:
        None where it must be run in this process: it raised, or cannot be sent, or a session of its own lived.

    Raises:
        ProcessLostError: where that process did not come back.
        ExecutionError: where a session of its own did not come to the file.
    """
    __tracebackhide__ = True
    answers = answers_apart(job, [scenario], judge, isolate=isolate)
    if answers is not None:
        return trace_from(answers[scenario])
    if not os.environ.get(IN_SESSION):
        _try_in_session(job, scenario, session())
    return None


def replay_in_gym_apart(job: Job, record: CrashRecord, scenario: Scenario) -> Trace:
    """One run by ``env.step`` of the environment of a world that has one, in another process.

    Raises:
        ProcessLostError: where that process did not come back.
        ExecutionError: where there can be no other process.
        Exception: what it raised there.
    """
    __tracebackhide__ = True
    in_gym = replace(job, world=_OtherRuns(protocol.hang_limit(job.world), job.world.rollout_in_gym))
    with runner_for(in_gym, record, isolate=True) as runner:
        return runner.run(scenario)


def _try_in_session(job: Job, scenario: Scenario, session: Session) -> None:
    """Replay a file in a session of its own."""
    __tracebackhide__ = True
    process = subprocess.Popen(  # noqa: S603  (this session's own command)
        session.command,
        cwd=session.folder,
        env={**os.environ, IN_SESSION: "1"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    with process:
        try:
            code = process.wait()
        finally:
            process.kill()  # after an interrupt; it has ended by itself otherwise
    if code < 0 or any(each.pid == process.pid for each in left_by(job.owner, job.records)):
        lost = Lost(task=scenario, pid=process.pid, how=ending(code), is_hang=code == HUNG)
        raise ProcessLostError(lost)
    if code not in REPLAYED:
        raise ExecutionError(
            f"{session.file}: expected a session of its own to replay what a process died in, received {ending(code)} "
            f"of: {shlex.join(session.command)}; run that to see why"
        )
