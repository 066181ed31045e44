"""The session of its own that replays one file, where a process that may die cannot be forked from this one.

``python -m pytest <file>`` needs nothing that can be pickled: it sets up the fixtures of the test by itself.
"""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from pytest_pafot.execution.separate_runs import Session


def own_session(item: pytest.Function, file: Path) -> Session:
    """The command of this session for one file alone.

    Args:
        item: of this session.
        file: to replay.
    """
    config = item.config
    given = [str(arg) for arg in getattr(config, "workerinput", {}).get("mainargv", ("",))[1:]]
    given = given or [str(arg) for arg in config.invocation_params.args]
    others = set(map(str, config.getoption("file_or_dir", None) or ()))
    command = [sys.executable, "-m", "pytest", *(arg for arg in given if arg not in others), str(file)]
    command += [f"--rootdir={config.rootpath}", *(["-n0"] if config.pluginmanager.has_plugin("xdist") else [])]
    return Session(file=file, command=command, folder=config.invocation_params.dir)
