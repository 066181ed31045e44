"""Runs of one item in another process, which may die of them; the verdict is found in this one.

Forked processes have the fixtures of the test function. Where processes cannot be forked, a session of its own tries
the file first: ``python -m pytest <file>``, which needs nothing that can be pickled.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import pytest

from pytest_pafot.campaign.request import RequestError
from pytest_pafot.execution.captured_output import listening
from pytest_pafot.execution.prefetch import METHOD, crew_for, hired
from pytest_pafot.execution.worker_pool import Answer, Lost, ProcessLostError, ending, trace_from
from pytest_pafot.plugin.crash_folder import left_behind
from pytest_pafot.world.codec import described

if TYPE_CHECKING:
    from pathlib import Path

    from pytest_pafot.campaign.harness import Bench
    from pytest_pafot.campaign.verdict import Verdict
    from pytest_pafot.run import Run
    from pytest_pafot.scenario import Scenario
    from pytest_pafot.trace import Trace

HERE = "PAFOT_REPLAY_HERE"
"""Set in the environment of a session that was started to replay a file in its own process."""


@dataclass(frozen=True, slots=True)
class Whole:
    """A run with its verdict as one thing: a process may also die in the user's function."""

    bench: Bench
    world: Any

    @property
    def hang_limit(self) -> float:
        """Of a decision [s]."""
        return float(getattr(self.world, "hang_limit", 30.0))

    def rollout(self, scenario: Scenario, ads: Callable[..., Any]) -> Trace:
        """The run of it that was judged; what the function prints is said where the verdict counts."""
        trace = self.bench.rolled_out(scenario, self.world, ads)
        with listening():
            self.bench.judge(self.bench.seen(trace, self.world))
        return trace


def answers_of(
    bench: Bench, scenarios: Sequence[Scenario], world: Any, owner: str = ""
) -> tuple[dict[Scenario, Answer | Lost], list[Lost]] | None:
    """What running each by itself in another process shows, and the deaths that did not come again.

    None where there can be no process with the fixtures of the test function. With the option ``isolate`` one that has
    the factory will do.

    Args:
        bench: of the item.
        scenarios: one after the other.
        world: that they run in.
        owner: of the records of what is in flight; without it the item.
    """
    if METHOD != "fork" and not bench.request.settings.isolate:
        return None
    errand = bench.errand
    errand = replace(
        errand,
        world=Whole(bench, world) if METHOD == "fork" else world,
        owner=owner or errand.owner,
        plain_world=described(world),
    )
    crew = hired(errand, 1, METHOD, [])
    if crew is None:
        return None
    with crew:
        crew.expect(scenarios)
        answers = {scenario: crew.fetch(scenario) for scenario in scenarios}
    return None if crew.failure else (answers, crew.recovered)


def tried_apart(bench: Bench, file: Path, scenario: Scenario, world: Any, owner: str) -> tuple[Run, Verdict]:
    """One run of a saved scenario in another process, and its verdict.

    Args:
        bench: of the item.
        file: of the scenario.
        scenario: to run.
        world: that it runs in.
        owner: of the record of what is in flight.

    Raises:
        ProcessLostError: where that process did not come back.
    """
    __tracebackhide__ = True
    told = answers_of(bench, [scenario], world, owner)
    if told is None:
        _try_in_session(bench, file, scenario, owner)
        return bench.tried(scenario, world, owner)
    answers, recovered = told
    trace = trace_from(recovered[0] if recovered else answers[scenario])
    if trace is None:  # It raised, or cannot be sent: that is to be seen here.
        return bench.tried(scenario, world, owner)
    with bench.in_flight(world, owner) as flight:
        flight.record(scenario)
        run = bench.seen(trace, world)
        return run, bench.judge(run)


@dataclass(frozen=True, slots=True)
class InGym:
    """The plain environment of a world, in the place of that world."""

    world: Any

    @property
    def hang_limit(self) -> float:
        """Of a decision [s]."""
        return float(self.world.hang_limit)

    def rollout(self, scenario: Scenario, ads: Callable[..., Any]) -> Trace:
        """The run by ``env.step``."""
        from pytest_pafot.world.engines.gym_replay import replay_in_gym  # noqa: PLC0415

        return replay_in_gym(self.world, scenario, ads)


def replay_in_gym_apart(bench: Bench, world: Any, scenario: Scenario, ads: Callable[..., Any]) -> Trace:
    """One run in the plain environment of a world, in another process.

    Raises:
        ProcessLostError: where that process did not come back.
        Exception: what it raised.
    """
    __tracebackhide__ = True
    with crew_for(replace(bench.errand, world=InGym(world)), 1) as crew:
        crew.expect([scenario])
        answer = crew.fetch(scenario)
    trace = trace_from(answer)
    # It raised, or cannot be sent, where there is none: that is to be seen here.
    return InGym(world).rollout(scenario, ads) if trace is None else trace


def _try_in_session(bench: Bench, file: Path, scenario: Scenario, owner: str) -> None:
    """Replay a file in a session of its own, where this is not that one.

    Raises:
        ProcessLostError: where that session died.
        RequestError: where it did not come to the file.
    """
    __tracebackhide__ = True
    if os.environ.get(HERE):
        return
    config = bench.item.config
    given = [str(arg) for arg in getattr(config, "workerinput", {}).get("mainargv", ("",))[1:]]
    given = given or [str(arg) for arg in config.invocation_params.args]
    places = set(map(str, config.getoption("file_or_dir", None) or ()))
    command = [sys.executable, "-m", "pytest", *(arg for arg in given if arg not in places), str(file)]
    command += [f"--rootdir={config.rootpath}", *(["-n0"] if config.pluginmanager.has_plugin("xdist") else [])]
    session = subprocess.Popen(  # noqa: S603  (this session's own command)
        command,
        cwd=config.invocation_params.dir,
        env={**os.environ, HERE: "1"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    with session:
        try:
            code = session.wait()
        finally:
            session.kill()  # after an interrupt; it has ended by itself otherwise
    died = any(leftover.pid == session.pid for leftover in left_behind(bench.item, bench.request, owner))
    if died or code < 0:
        is_hang = code == pytest.ExitCode.INTERRUPTED  # see stuck.py
        raise ProcessLostError(Lost(scenario=scenario, pid=session.pid, how=ending(code), is_hang=is_hang))
    if code not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):
        raise RequestError(
            f"{file}: expected a session of its own to replay what a process died in, received {ending(code)} of: "
            f"{shlex.join(command)}; run that to see why"
        )
