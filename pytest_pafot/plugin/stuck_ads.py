"""The end of a session whose ADS ignores interrupts: the findings so far are reported, and the process ends.

The scenario is already on disk, and the next session runs it. Under pytest-xdist only the worker ends, and pytest-xdist
replaces it like a worker that crashed.
"""

from __future__ import annotations

import os
import sys
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import pytest

from pytest_pafot.execution.pool import GRACE
from pytest_pafot.plugin.session import is_worker
from pytest_pafot.plugin.terminal_reporter import uncaptured
from pytest_pafot.support.errors import flag
from pytest_pafot.world.guard.hang_guard import LastResort, last_resort

STATUS = pytest.ExitCode.INTERRUPTED
"""The exit status of a session that ended because its ADS hung.

If no Python thread gets to run, faulthandler ends the process with status 1 instead.
"""

FLUSH = 120.0  # the longest time for the summary, since plugins may wait for something that the ADS holds [s]
SHOWN = 6  # the number of innermost frames that are printed


@contextmanager
def session_ends_if_stuck(item: pytest.Item) -> Iterator[None]:
    """End the session if the ADS, or its environment, hangs inside this context and ignores interrupts."""
    main, file = threading.get_ident(), _real_stderr(item.config)
    try:
        with last_resort(LastResort(end=lambda: _end(item, main), grace=GRACE, file=file)):
            yield
    finally:
        if file is not None:
            os.close(file)


def _end(item: pytest.Item, thread: int) -> None:
    limit = threading.Timer(FLUSH, os._exit, (STATUS,))
    limit.daemon = True
    limit.start()
    try:
        if not is_worker(item.config):
            with uncaptured(item.config):
                _flush(item, "".join(traceback.format_stack(sys._current_frames()[thread])[-SHOWN:]))
    finally:
        with suppress(Exception):
            sys.stdout.flush()
        os._exit(STATUS)


def _flush(item: pytest.Item, stack: str) -> None:
    """Report a stuck item and end the session as an interrupt would, but from another thread than the item's."""
    reason = (
        f"{item.nodeid}: code of the ADS, or of its environment, exceeds its limit and ignores every interrupt, so "
        "this session has to end. The scenario is on disk: the next session runs it again in a separate process and "
        f"saves it. With {flag('isolate')}, the search continues after such a hang"
    )
    item.ihook.pytest_runtest_logreport(
        report=pytest.TestReport(
            nodeid=item.nodeid,
            location=item.location,
            keywords={},
            outcome="failed",
            longrepr=f"{reason}.\n\nWhat it calls, innermost call last:\n{stack}",
            when="call",
        )
    )
    try:
        pytest.exit(f"the ADS or its environment hangs in {item.nodeid}, as its failure says", returncode=STATUS)
    except pytest.exit.Exception:
        item.config.hook.pytest_keyboard_interrupt(excinfo=pytest.ExceptionInfo.from_current())
    item.session.exitstatus = STATUS
    item.config.hook.pytest_sessionfinish(session=item.session, exitstatus=STATUS)


def _real_stderr(config: pytest.Config) -> int | None:
    """Return the descriptor of the real stderr for faulthandler.

    It is None if pytest already uses faulthandler's only timer (``faulthandler_timeout``).
    """
    if config.pluginmanager.has_plugin("faulthandler") and float(config.getini("faulthandler_timeout") or 0.0) > 0.0:
        return None
    with suppress(OSError), uncaptured(config):
        return os.dup(2)
    return None
