"""Values of the whole session, which the controller and all workers of pytest-xdist share."""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from datetime import date, timedelta
from pathlib import Path
from queue import Queue
from typing import Any

import pytest

from pytest_pafot.corpus.layout import SEARCH_PART, around, link_below
from pytest_pafot.corpus.saved import refusal
from pytest_pafot.plugin.node_ids import SAVED_PART
from pytest_pafot.plugin.option_sources import resolve
from pytest_pafot.plugin.unrun import DRIVEN, UNRUN, Orphan
from pytest_pafot.support.errors import RequestError, flag
from pytest_pafot.support.text import day_of

LOG_SECONDS = 10.0  # the interval between reports of a search's progress in a log [s]


def terminal_width() -> int:
    """Return the width of the terminal in columns, as pytest determines it."""
    columns = shutil.get_terminal_size((80, 24)).columns
    return columns if columns >= 40 else 80


@dataclass(slots=True, kw_only=True, repr=False, eq=False)  # each method that is made costs every session some time
class Shared:
    """Values that the controller chooses and every worker uses. The defaults are for a session that begins now."""

    progress_seconds: float = field(default_factory=lambda: LOG_SECONDS)  # interval between reports of progress [s]
    width: int = field(default_factory=terminal_width)  # of the terminal, which a worker cannot query [columns]
    # the day with which the last days of accepted failures are compared, as a text that can be sent to workers
    today: str = field(default_factory=lambda: date.today().isoformat())
    # node ids of the saved scenarios that the first workers collected, or None before. A worker that replaces a crashed
    # one collects only these, and no file written since: pytest-xdist needs the same items in all workers
    frozen: frozenset[str] | None = None


class SummaryLines:
    """Lines for the summary of the session, which the controller collects."""

    def __init__(self) -> None:
        self.problems: list[str] = []  # anything that went wrong outside of the tests
        self.reports: list[str] = []  # the files that were written
        self.warnings: list[str] = []  # warnings about saved scenarios

    @contextmanager
    def faults(self, work: str) -> Iterator[None]:
        """Report an error in this context as a problem; at the end of a session, pytest would lose all failures by it.

        ``work`` names in a few words what is done in the context. An interrupt ends only that, since the session is
        ending anyway.
        """
        try:
            yield
        except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001  (whatever it is, the summary says so)
            self.problems.append(f"{work}: {type(error).__name__}: {error}")


SHARED = pytest.StashKey[Shared]()
SUMMARY_LINES = pytest.StashKey[SummaryLines]()


def base_line(config: pytest.Config) -> str:
    """Return a line with the base seed of searches without arguments; empty if no search runs."""
    try:
        settings = resolve(config, {})
    except RequestError as error:
        return str(error)
    if not settings.is_search:
        return ""
    return f"base seed {settings.seed} (for other scenarios: {flag('seed', settings.seed + 1)})"


def stale_day(asked: str, today: date) -> list[str]:
    """Return a warning about a day of ``--pafot-today`` that is over everywhere; empty for any other."""
    day = day_of(asked)
    if day is None or day >= today - timedelta(days=1):
        return []
    return [
        f"{flag('today', asked)}: that day is over, so failures that were accepted up to a day since then count as "
        "accepted; leave the option out, or give the day of this session"
    ]


def unclaimed(config: pytest.Config) -> list[str]:
    """Return warnings about the records of processes that died, if no test of this session has processed them."""
    from pytest_pafot.execution.crash_records import CrashRecordError, leftovers, records_of  # noqa: PLC0415

    try:
        found = leftovers(records_of(config.rootpath))
    except CrashRecordError as error:
        return [str(error)]
    return [
        f"a process (pid {each.pid}) died while {each.owner or 'an unknown test'} ran {each.scenario or 'a scenario'}; "
        f"that test runs it again, or delete {each.path}"
        for each in found
    ]


def end_in_order(config: pytest.Config) -> None:
    """Let SIGTERM and SIGHUP interrupt the session, which would otherwise leave processes and no results behind."""
    from pytest_pafot.support.interrupts import interrupted_by_signals  # noqa: PLC0415
    from pytest_pafot.world.guard.hang_guard import note_interrupt  # noqa: PLC0415

    stack = ExitStack()
    config.add_cleanup(stack.close)
    stack.enter_context(interrupted_by_signals(note_interrupt))


def exit_code(session: pytest.Session) -> int:
    """Return the exit code of a session that ends. A second Ctrl-C may come before pytest has noted the first one."""
    is_interrupted = isinstance(sys.exc_info()[1], KeyboardInterrupt)
    return int(pytest.ExitCode.INTERRUPTED if is_interrupted else session.exitstatus)


def not_written(config: pytest.Config, name: str, folder: Path, write: Callable[[], object]) -> str:
    """Write an output file to a folder by a function; return why it is not written and what to do, or an empty text.

    A relative path that leads through a linked folder is refused, since the link may be part of a checkout. ``name`` is
    the path as the user has named it.
    """
    link = None if os.path.isabs(name) else link_below(config.rootpath, folder)  # noqa: PTH117  (a text of the user)
    if link is not None:
        return refusal(link)
    try:
        write()
    except OSError as error:
        from pytest_pafot.support.files import way_out  # noqa: PLC0415

        return f"{error.strerror or error}; {way_out(error, 'or name another file')}"
    return ""


# Data that the controller and the workers of pytest-xdist exchange when a worker starts and when it ends.
#
# While items run, they exchange messages, as in a session without workers.

KEY = "pafot"  # the key of this plugin's data in the input and the output of a worker


def is_worker(config: pytest.Config) -> bool:
    """Return whether this process is a worker of pytest-xdist."""
    return hasattr(config, "workerinput")


def shared_by_controller(config: pytest.Config) -> Shared:
    """Return the shared values in a worker, as its controller chose them."""
    return Shared(**config.workerinput[KEY])  # type: ignore[attr-defined]


class _KeptEvents(Queue[Any]):
    """A queue that removes an event when it is asked for the next one, so that an interrupt in between loses none."""

    is_begun = False  # whether the first event has been given out

    def _qsize(self) -> int:
        return len(self.queue) - self.is_begun

    def _get(self) -> Any:
        if self.is_begun:
            self.queue.popleft()
        self.is_begun = True
        return self.queue[0]


class Controller:
    """Hooks of pytest-xdist's controller."""

    _last: pytest.TestReport | None = None  # the last report that all have taken

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionstart(self, session: pytest.Session) -> None:
        """Let pytest-xdist keep each event of a worker until it is handled."""
        if controller := session.config.pluginmanager.get_plugin("dsession"):
            controller.queue = _KeptEvents()

    @pytest.hookimpl(trylast=True)
    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note that a report is taken: an interrupt waits until all have seen it."""
        self._last = report

    @pytest.hookimpl(optionalhook=True)
    def pytest_configure_node(self, node: Any) -> None:
        """Pass the shared values to a new worker, as plain data."""
        node.workerinput[KEY] = asdict(node.config.stash[SHARED])

    @pytest.hookimpl(optionalhook=True)
    def pytest_xdist_node_collection_finished(self, node: Any, ids: list[str]) -> None:
        """Store which saved scenarios the first workers collected, so that later workers collect the same."""
        shared = node.config.stash[SHARED]
        if shared.frozen is None:
            # Under --dist=loadgroup the name of the group is appended.
            names = [node_id[: node_id.rfind("]") + 1] for node_id in ids]
            shared.frozen = frozenset(name for name in names if SAVED_PART in name)
            if shared.frozen or any(around(SEARCH_PART, name) for name in names):
                end_in_order(node.config)

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node: Any, error: object) -> None:
        """Store what an ended worker reports: the items that drive policies, and saved scenarios that no item runs."""
        output = getattr(node, "workeroutput", {}).get(KEY)
        if output is None:  # It died.
            return
        driven, orphans, *others = json.loads(output)
        node.config.stash[DRIVEN].update(driven)
        unrun = node.config.stash[UNRUN]
        unrun.orphans.update((Path(folder), Orphan(*orphan)) for folder, orphan in orphans.items())
        for known, other in zip(unrun[1:], others, strict=True):
            known.update(other)

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Take what the workers have reported and an interrupted controller has not taken; they have ended by now."""
        waiting = getattr(session.config.pluginmanager.get_plugin("dsession"), "queue", None)
        for event, data in () if waiting is None else tuple(waiting.queue):
            if event == "testreport" and data["rep"] is not self._last:
                session.config.hook.pytest_runtest_logreport(report=data["rep"])


class Worker:
    """Hooks of a worker of pytest-xdist."""

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Pass the items that drive policies, and the saved scenarios that no item runs, to the controller.

        They are sent as JSON in ASCII, because file names may contain bytes that are not valid characters. pytest-xdist
        cannot send such a text: it would replace the worker, and the new worker would fail in the same way.
        """
        unrun, driven = session.config.stash[UNRUN], session.config.stash[DRIVEN]
        orphans = {str(folder): orphan for folder, orphan in unrun.orphans.items()}
        output = json.dumps((sorted(driven), orphans, *unrun[1:]))
        session.config.workeroutput[KEY] = output  # type: ignore[attr-defined]


class Header:
    """The hook that adds a line to the header of a verbose session."""

    def pytest_report_header(self) -> str:
        """Return a line that says whether the simulation kernel is compiled; the kernel is not imported for that."""
        from pytest_pafot.support.compiled import why_interpreted  # noqa: PLC0415  (most sessions are not verbose)

        reason = why_interpreted()
        return f"pafot: kernel interpreted ({reason})" if reason else "pafot: kernel compiled"
