"""The controller's side: messages from running items become progress, reports of finds, and the summary."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from pytest_pafot.campaign.options import BY_NAME
from pytest_pafot.corpus import layout
from pytest_pafot.plugin import messages, orphans
from pytest_pafot.plugin.orphans import UNRUN
from pytest_pafot.plugin.report_pages import LINES
from pytest_pafot.plugin.session import SHARED, base_line, terminal_width

if TYPE_CHECKING:
    from pytest_pafot.campaign.summary import Progress, SearchSummary
    from pytest_pafot.report import terminal

TERMINAL_SECONDS = 0.25
"""How often a search reports its progress on a terminal [s]."""


class Reporter:
    """Gathers what items tell, on the controller alone."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config
        self._session: pytest.Session | None = None
        self._pending: dict[str, dict[str, tuple[dict[str, Any], Any]]] = {}
        self._expanded: set[str] = set()
        self._running: dict[str, None] = {}
        self._searches: list[SearchSummary] = []
        self._replays: list[terminal.ReplaySummary] = []
        self._removed: list[Path] = []
        self._problems: list[str] = []
        self._notes: dict[str, None] = {}
        self._has_line = False

    @pytest.hookimpl(trylast=True)
    def pytest_sessionstart(self, session: pytest.Session) -> None:
        """Know the session, and how often progress can be told."""
        self._session = session
        if self._rewrites():
            self._config.stash[SHARED].progress_seconds = TERMINAL_SECONDS

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_logreport(self, report: Any) -> Any:
        """Take messages; report the finds of a search after its teardown."""
        message = messages.received(report)
        if message is None:
            self._erase_line()
        result = yield
        if message is not None:
            self._take(report, message)
        elif report.when == "teardown":
            self._expand(report.nodeid)
        return result

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self) -> None:
        """Report what is left, prune orphans when asked."""
        self._erase_line()
        # An interrupt or a dead worker leaves finds whose search never came to its teardown.
        for node_id in list(self._pending):
            with self._told(f"report of what {node_id} found"):
                self._expand(node_id)
        with self._told("records of processes that died"):
            self._note_unclaimed()
        if self._config.stash[UNRUN].orphans and self._config.getoption(BY_NAME["prune"].key):
            with self._told("--pafot-prune"):
                self._prune()

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        """One section for searches, replays, orphans and problems."""
        with messages.faults_told(terminalreporter.line, "summary of pytest-pafot"):
            self._summarise(terminalreporter)

    def _summarise(self, terminalreporter: Any) -> None:
        written = self._config.stash[LINES]
        unrun = self._config.stash[UNRUN]
        if not (self._searches or self._replays or self._running or any(unrun) or self._problems or written):
            return
        from pytest_pafot.report import terminal  # noqa: PLC0415

        root = self._config.rootpath
        session = terminal.SessionSummary(
            searches=self._searches,
            replays=self._replays,
            orphans=self._left(unrun.orphans),
            removed=list(Counter(layout.relative(file.parent, root) for file in self._removed).items()),
            strays=sorted(unrun.strays.items()),
            pruned=bool(self._config.getoption(BY_NAME["prune"].key)),
            problems=[*self._problems, *(line for line, is_problem in written if is_problem)],
            written=[line for line, is_problem in written if not is_problem],
            interrupted=list(self._running),
            notes=list(self._notes),
        )
        width = self._config.stash[SHARED].width
        lines = terminal.session_lines(session, verbose=self._config.get_verbosity() > 0, width=width)
        if not lines:
            return
        terminalreporter.section("pafot")
        for line in lines:
            terminalreporter.line(line)

    @pytest.hookimpl(tryfirst=True)
    def pytest_report_teststatus(self, report: Any) -> tuple[str, str, str] | None:
        """The label of a replay that passes is shown by ``-v``."""
        label = dict(getattr(report, "user_properties", ())).get("pafot")
        if label is None or report.when != "call" or hasattr(report, "wasxfail"):
            return None
        return ("passed", ".", f"PASSED ({label})") if report.passed else None

    def _take(self, report: Any, message: dict[str, Any]) -> None:
        from pytest_pafot.campaign.summary import Progress, SearchSummary  # noqa: PLC0415
        from pytest_pafot.report import terminal  # noqa: PLC0415

        kind = message["kind"]
        if kind == "start":
            self._tell_base_seed()
            self._running[report.nodeid] = None
        elif kind == "progress":
            self._show_progress(Progress(**_without_kind(message)))
        elif kind == "find":
            self._take_find(report, message)
        elif kind == "search":
            self._running.pop(report.nodeid, None)
            self._searches.append(SearchSummary.from_plain(_without_kind(message)))
        elif kind == "note":
            self._notes[message["text"]] = None
        elif kind == "replay":
            self._replays.append(
                terminal.ReplaySummary(node_id=report.nodeid, label=message["label"], detail=message["detail"])
            )

    def _tell_base_seed(self) -> None:
        """Under pytest-xdist nobody reports a collection here, and a fresh seed must be known should this end early."""
        if self._is_parallel() and not self._running and not self._searches and self._config.get_verbosity() >= 0:
            base = base_line(self._config)
            self._write_lines([f"pafot: {base}"] if base else [])

    def _take_find(self, report: Any, message: dict[str, Any]) -> None:
        node_id = message["node_id"]
        if node_id not in self._expanded:
            finds = self._pending.setdefault(report.nodeid, {})
            finds[node_id] = (message["report"], getattr(report, "node", None))
        self._erase_line()
        if self._config.get_verbosity() >= 0:
            self._write_lines(message["lines"])

    def _expand(self, search_id: str) -> None:
        """Report the finds of a search as the items that they will be in the next session."""
        for node_id, (data, node) in self._pending.pop(search_id, {}).items():
            self._expanded.add(node_id)
            report = self._config.hook.pytest_report_from_serializable(config=self._config, data=data)
            if self._session is not None:
                self._session.testscollected += 1
            for phase in (_phase(report, "setup"), report, _phase(report, "teardown")):
                if node is not None:
                    phase.__dict__["node"] = node  # As pytest-xdist marks reports of its workers.
                self._config.hook.pytest_runtest_logreport(report=phase)

    def _show_progress(self, progress: Progress) -> None:
        from pytest_pafot.report import terminal  # noqa: PLC0415

        writer = self._terminal()
        if writer is None or self._config.get_verbosity() < 0:
            return
        width = terminal_width()
        if not self._rewrites():
            self._write_lines([terminal.progress_line(progress, width)])
            return
        with uncaptured(self._config):
            writer.ensure_newline()
            writer.rewrite(terminal.progress_line(progress, width - 1), erase=True)
            writer.flush()
        self._has_line = True

    def _erase_line(self) -> None:
        writer = self._terminal()
        if self._has_line and writer is not None:
            with uncaptured(self._config):
                writer.rewrite("", erase=True)
                writer.rewrite("")
                writer.flush()
        self._has_line = False

    def _write_lines(self, lines: Iterable[str]) -> None:
        writer = self._terminal()
        if writer is None:
            return
        with uncaptured(self._config):
            for line in lines:
                writer.write_line(line)
            writer.flush()

    def _rewrites(self) -> bool:
        """Whether one line can be written again and again: a terminal, and one item at a time."""
        writer = self._terminal()
        if writer is None or self._is_parallel():
            return False
        is_terminal = writer.isatty  # A value in earlier versions of pytest, a method in later ones.
        return bool(is_terminal() if callable(is_terminal) else is_terminal)

    def _is_parallel(self) -> bool:
        return self._config.pluginmanager.has_plugin("dsession")

    def _terminal(self) -> Any:
        return self._config.pluginmanager.get_plugin("terminalreporter")

    def _told(self, work: str) -> AbstractContextManager[None]:
        """A fault inside is a problem of the summary."""
        return messages.faults_told(self._problems.append, work)

    def _note_unclaimed(self) -> None:
        if self._searches or self._replays or self._running:
            from pytest_pafot.plugin.crash_folder import unclaimed  # noqa: PLC0415

            self._problems += unclaimed(self._config)

    def _prune(self) -> None:
        """Remove the saved scenarios of tests that are gone, once they are listed."""
        files = [file for own in self._config.stash[UNRUN].orphans.values() for file in own]
        names = [f"  {layout.relative(file, self._config.rootpath)}" for file in files]
        self._write_lines(["", "pafot: --pafot-prune removes", *names] if names else [])
        self._removed, failures = orphans.prune(files)
        self._problems += failures

    def _left(self, folders: Iterable[Path]) -> list[tuple[str, int]]:
        """Folders of saved scenarios of no test, with the number of those that are there."""
        counts = ((layout.relative(folder, self._config.rootpath), len(layout.files_in(folder))) for folder in folders)
        return [(name, number) for name, number in counts if number]


def uncaptured(config: pytest.Config) -> AbstractContextManager[None]:
    """For messages of this process that come from inside a running test, whose output pytest captures."""
    manager = config.pluginmanager.get_plugin("capturemanager")
    silent: AbstractContextManager[None] = nullcontext() if manager is None else manager.global_and_fixture_disabled()
    return silent


def _phase(report: pytest.TestReport, when: Any) -> pytest.TestReport:
    return pytest.TestReport(
        nodeid=report.nodeid,
        location=report.location,
        keywords=report.keywords,
        outcome="passed",
        longrepr=None,
        when=when,
        user_properties=report.user_properties,
    )


def _without_kind(message: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in message.items() if key != "kind"}
