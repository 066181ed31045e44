"""The plugin of the session that ``python -m pytest_pafot bisect`` starts for a commit; it writes a result as JSON."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from pytest_pafot import Trace
from pytest_pafot.extending import ACCELERATION, SPEED, STEERING, replay_of
from pytest_pafot.extras.revisions.bisect_command import ALIVE, TOLD
from pytest_pafot.support.text import one_line, visible


@pytest.hookimpl(tryfirst=True)
def pytest_load_initial_conftests() -> None:
    """Let this session, which has a group of its own, end with the command, also if the command is killed."""
    alive = os.environ.pop(ALIVE, "")
    if alive:
        os.set_inheritable(int(alive), False)
        threading.Thread(target=_end_with_command, args=(int(alive),), daemon=True).start()


def _end_with_command(alive: int) -> None:
    os.read(alive, 1)  # It returns when the pipe has no writer any more.
    os.killpg(0, signal.SIGKILL)


def pytest_itemcollected(item: pytest.Item) -> None:
    """Put the world that the command names in the place of that of the test's mark."""
    world = json.loads(os.environ[TOLD])["world"]
    if world is not None:
        item.add_marker(pytest.mark.pafot_search(world=world), append=False)


def pytest_runtest_teardown(item: pytest.Item) -> None:
    """Write the result of the replay of a saved scenario to the file that the command reads."""
    replay = replay_of(item)
    if replay is None:
        return
    passes, why = replay.judged
    # The sentence is cut to a line, and names a failure already.
    why = "; ".join(filter(None, [why, replay.note.partition(":")[0] if passes is False else replay.note]))
    is_other = passes is None and replay.passes_otherwise
    elsewhere = _imported_from_elsewhere()
    if elsewhere:
        passes, is_other, why = None, False, f"the policy was imported from {elsewhere}, which is not the commit's"
    _tell(passes=passes, why=why, is_other=is_other, **({} if replay.run is None else decided(replay.run.trace)))


def pytest_exception_interact(
    node: pytest.Item | pytest.Collector, call: pytest.CallInfo[Any], report: pytest.TestReport | pytest.CollectReport
) -> None:
    """Write the first error of the session, in case it prevents the replay."""
    if call.excinfo is not None and not Path(json.loads(os.environ[TOLD])["file"]).exists():
        error = call.excinfo.value.__cause__ or call.excinfo.value  # pytest wraps what an import raises
        text = "; ".join(line.strip() for line in str(error).splitlines() if line.strip())
        # The report of an item has the line that the summary of its session has.
        crash = getattr(report.longrepr, "reprcrash", None) if isinstance(node, pytest.Item) else None
        _tell(passes=None, why=f"{type(error).__name__}: {text}" if crash is None else crash.message)


def decided(trace: Trace) -> dict[str, Any]:
    """Return the decisions of the ego in a run, their ticks, and the ego's speeds [m/s].

    An ego of a vehicle class of highway-env makes no decisions. Its accelerations and steering angles at each tick are
    returned instead.
    """
    actions: list[Any] = [list(action) if _is_pair(action) else repr(action) for action in trace.actions]
    ticks = list(trace.decision_ticks)
    if not actions:  # an ego of one of highway-env's vehicle classes
        actions, ticks = trace.ego[1:, [ACCELERATION, STEERING]].tolist(), list(range(trace.ticks))
    return {"decisions": actions, "speeds": trace.ego[ticks, SPEED].tolist(), "ticks": ticks, "hz": trace.physics_hz}


def _is_pair(action: Any) -> bool:
    return type(action) is tuple and len(action) == 2 and all(type(each) is float for each in action)


def _imported_from_elsewhere() -> str:
    """Return the file of a policy module that was imported from outside the commit's worktree, or an empty text."""
    policy = json.loads(os.environ[TOLD])["policy"]
    files = {
        os.path.realpath(file) for module in [*sys.modules.values()] if (file := getattr(module, "__file__", None))
    }
    return next((file for file in sorted(files) if any(Path(file).is_relative_to(path) for path in policy)), "")


def _tell(**told: Any) -> None:
    told["why"] = one_line(visible(told["why"]))
    Path(json.loads(os.environ[TOLD])["file"]).write_text(json.dumps(told), encoding="utf-8")
