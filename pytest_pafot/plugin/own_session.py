"""The session of its own that replays one file, where a process that may die cannot be forked from this one.

``python -m pytest <file>`` needs nothing that can be pickled: it sets up the fixtures of the test by itself.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from pytest_pafot.campaign.request import RequestError
from pytest_pafot.execution.crash_records import left_by
from pytest_pafot.execution.pool import ProcessLostError, ending
from pytest_pafot.execution.scenario_pool import Job
from pytest_pafot.plugin.session import HERE
from pytest_pafot.plugin.stuck_ads import STATUS
from pytest_pafot.scenario import Scenario


def replay_in_own_session(item: pytest.Function, file: Path, job: Job, scenario: Scenario) -> None:
    """Replay the scenario of a file in a session of its own, which runs the same job, where this is not that one.

    Raises:
        ProcessLostError: where that session died.
        RequestError: where it did not come to the file.
    """
    __tracebackhide__ = True
    if os.environ.get(HERE):
        return
    config = item.config
    given = [str(arg) for arg in getattr(config, "workerinput", {}).get("mainargv", ("",))[1:]]
    given = given or [str(arg) for arg in config.invocation_params.args]
    others = set(map(str, config.getoption("file_or_dir", None) or ()))
    command = [sys.executable, "-m", "pytest", *(arg for arg in given if arg not in others), str(file)]
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
    if code < 0 or any(leftover.pid == session.pid for leftover in left_by(job.owner, job.records)):
        raise ProcessLostError(scenario, pid=session.pid, how=ending(code), is_hang=code == STATUS)
    if code not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):
        raise RequestError(
            f"{file}: expected a session of its own to replay what a process died in, received {ending(code)} of: "
            f"{shlex.join(command)}; run that to see why"
        )
