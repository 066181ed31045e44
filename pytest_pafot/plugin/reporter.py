"""The controller's output: the terminal, the JSON file, the page, and the summary of a CI job."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Generator, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from pytest_pafot.corpus.layout import link_below, refusal, relative
from pytest_pafot.plugin.collection import SAVED_MARK, SEARCH_MARK
from pytest_pafot.plugin.session import (
    AS_SAVED,
    INVENTORY,
    PHASE,
    SESSION,
    SHARED,
    base_line,
    exit_code,
    report_on,
    terminal_width,
    uncaptured,
    value_if_right,
)
from pytest_pafot.report.session import RESULTS, Session
from pytest_pafot.searches.options import BY_NAME
from pytest_pafot.support import monotonic
from pytest_pafot.support.compiled import PACKAGE
from pytest_pafot.support.errors import flag, rerun
from pytest_pafot.support.text import ascii_text

SUMMARY = "GITHUB_STEP_SUMMARY"
"""The environment variable with the path of the summary file in GitHub Actions."""
QUICK, REST = 0.1, 10
"""A write of the JSON file is slow above ``QUICK`` [s]. The pause after it lasts ``REST`` times as long."""


class Files:
    """The writer of the JSON file, the page and the job summary."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config
        self._session = config.stash[SESSION]
        self._next = -math.inf  # when the JSON file may be written again [s]
        self._is_listed = config.getoption("collectonly", False)
        self._json: str | None = None
        if not self._is_listed:
            self._json = config.getoption(BY_NAME["json"].key)

    @pytest.hookimpl(trylast=True)
    def pytest_sessionstart(self) -> None:
        """Replace the JSON file of an earlier session."""
        self.write_json()

    @pytest.hookimpl(trylast=True)  # after the new findings are reported
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Write all files, even if the session was interrupted."""
        record = self._session
        record.exit = exit_code(session)
        target = value_if_right(self._config, "report")
        asked = self._config.getoption(BY_NAME["report"].key)
        if target is not None and (record.seen or record.ended):
            with record.faults(f"{flag('report', target)}: the page was not written"):
                self._write_page(target)
        elif asked and not self._is_listed:
            problem = "the page was not written, because neither a search nor a replay ran"
            record.problems.append(f"{flag('report', asked)}: {problem}")
        self.write_json()
        path = os.environ.get(SUMMARY)
        is_driven = record.searches or record.seen or record.unread or record.left
        has_content = is_driven or record.warnings or record.problems
        if not path or self._is_listed or not has_content:
            return  # No modules are imported for an empty summary.
        with record.faults(f"{SUMMARY}: the summary was not written"):
            from pytest_pafot.report.session_record import markdown  # noqa: PLC0415
            from pytest_pafot.support.files import append  # noqa: PLC0415

            file = self._config.invocation_params.dir / path
            problem = self._write(path, file, markdown(record, page=asked or ""), append)
            if problem:
                record.problems.append(f"{SUMMARY}={path}: the summary was not written: {problem}")

    def _write_page(self, target: str) -> None:
        from pytest_pafot.report.page import render_page  # noqa: PLC0415
        from pytest_pafot.support.files import write_whole  # noqa: PLC0415

        command = rerun(["pytest", *map(str, self._config.invocation_params.args)], os.environ)
        page, told = render_page(self._session, title=self._config.rootpath.name, command=command)
        problem = self._write(target, self._path_of(target), page, write_whole)
        if problem:
            name = flag("report", target)
            self._session.problems.append(f"{name}: the page was not written: {problem}")
        else:
            self._session.written.append(f"report: {target} ({told})")

    def write_json(self) -> None:
        """Write the JSON file, except shortly after a slow write during the session."""
        began, is_over = monotonic(), self._session.exit is not None
        if self._json is None or (not is_over and began < self._next):
            return
        from pytest_pafot.report.session_record import to_text  # noqa: PLC0415
        from pytest_pafot.support.files import is_stream, write_whole  # noqa: PLC0415

        if not is_over and is_stream(self._path_of(self._json)):
            return  # A stream keeps everything, so it receives only the final record.
        day = self._config.getoption(BY_NAME["today"].key)
        text = to_text(self._session, root=str(self._config.rootpath), day=day)
        problem = self._write(self._json, self._path_of(self._json), text, write_whole)
        # A session with a thousand findings would spend most of its time here, so the file is written less often. If
        # the session is killed, the last findings may be missing from the file, but they are in the corpus.
        took = monotonic() - began
        if took > QUICK:
            self._next = began + REST * took
        if is_over and problem:  # Report it only once, at the end.
            name = flag("json", self._json)
            self._session.problems.append(f"{name}: the file was not written: {problem}")
        elif is_over:
            self._session.written.append(f"json: {self._json}")

    def _path_of(self, name: str) -> Path:
        return Path(os.path.normpath(self._config.invocation_params.dir / name))

    def _write(self, name: str, path: Path, text: str, write: Callable[[Path, str], object]) -> str:
        """Write a file. Return an empty string or, if that fails, the reason and a solution."""
        link = link_below(self._config.rootpath, path.parent)
        # A link below the rootdir may come from a repository, and lead anywhere.
        if link is not None and not os.path.isabs(name):  # noqa: PTH117  (a text of the user)
            return refusal(link)
        try:
            write(path, text)
        except OSError as error:
            from pytest_pafot.support.files import way_out  # noqa: PLC0415

            return f"{error.strerror or error}. {way_out(error, 'or name another file')}"
        return ""


TERMINAL_SECONDS = 0.25  # the interval between reports of a search's progress on a terminal [s]


class LiveTerminal:
    """The output while tests run: permanent lines and, on a terminal, a progress line."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config
        self._has_line = False

    @property
    def is_parallel(self) -> bool:
        return self._config.pluginmanager.has_plugin("dsession")

    @property
    def rewrites(self) -> bool:
        """True if the progress line can be overwritten."""
        if self.writer is None or self.is_parallel:
            return False
        # an attribute in earlier versions of pytest, a method in later versions
        is_terminal = self.writer.isatty
        if callable(is_terminal):
            is_terminal = is_terminal()
        return bool(is_terminal)

    def show_progress(self, line: Callable[[int], str]) -> None:
        """Write the progress line that ``line`` returns for a width in columns."""
        if self._config.get_verbosity() < 0:
            return
        if not self.rewrites:
            self.write([line(terminal_width())])
            return
        with uncaptured(self._config):
            self.writer.ensure_newline()
            self.writer.rewrite(line(terminal_width() - 1), erase=True)
            self.writer.flush()
        self._has_line = True

    def erase_progress(self) -> None:
        if self._has_line:
            with uncaptured(self._config):
                self.writer.rewrite("", erase=True)
                self.writer.rewrite("")
                self.writer.flush()
        self._has_line = False

    def write(self, lines: Iterable[str]) -> None:
        if self.writer is None:
            return
        with uncaptured(self._config):
            self.writer.ensure_newline()
            # pytest-xdist leaves the line of dots open
            if self._config.get_terminal_writer().width_of_current_line:
                self.writer.line("")
            for line in lines:
                self.writer.write_line(ascii_text(line))
            self.writer.flush()

    @property
    def writer(self) -> Any:
        """The terminal reporter of pytest, or None."""
        return self._config.pluginmanager.get_plugin("terminalreporter")


class Reporter:
    """Hooks that write to the terminal and fill the session's record."""

    def __init__(self, config: pytest.Config, files: Files) -> None:
        self._config = config
        self._files = files
        self._record = config.stash[SESSION]
        self._live = LiveTerminal(config)
        self._session: pytest.Session | None = None
        # for each search, the reports of its new findings and the workers that sent them
        self._pending: dict[str, dict[str, tuple[dict[str, Any], Any]]] = {}
        self._expanded: set[str] = set()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_logreport(
        self, report: pytest.TestReport
    ) -> Generator[None, object, object]:
        """Record the reports on items, and print a search's findings after its teardown."""
        message = getattr(report, "pafot") if report.when == PHASE else None  # noqa: B009
        if message is None:
            self._take_phase(report)
            self._live.erase_progress()
            if report.failed and report.when == "call":
                with self._record.faults(f"{report.nodeid}: the failure was not described"):
                    self._show_block(report)
        result = yield
        if message is not None:
            self._take(report, *message)
            # pytest stores every report until the session ends, and reports without a result under the empty name.
            stats = getattr(self._live.writer, "stats", {})
            stored = stats.get("", [])
            if stored and stored[-1] is report:
                stored.pop()
        elif report.when == "teardown":
            self._expand(report.nodeid)
        return result

    def _show_block(self, report: pytest.TestReport) -> None:
        """Replace pytest's text about a failure with a block about the finding."""
        from pytest_pafot.report import terminal  # noqa: PLC0415
        from pytest_pafot.searches.events import Ending  # noqa: PLC0415

        # Three cases: pytest's text and the block, only the block, or no text for a search whose findings have blocks.
        record, option = self._record, self._config.option
        search = record.searches.get(report.nodeid)
        seen = record.seen.get(report.nodeid)
        is_whole = self._config.get_verbosity() > 0
        has_finds = search is not None and search.finds and search.reason != Ending.ERROR
        if has_finds and not is_whole:
            # pytest's mark for a failure that needs no text at the end
            report.__dict__["_pdbshown"] = True
        if seen is None or not seen.headline:
            return
        crash: Any = getattr(report.longrepr, "reprcrash", None)
        place, text = "", report.longreprtext
        if crash is not None:
            text = crash.message
            file = Path(crash.path)
            # An exception from another process or another run has no position in the test.
            if PACKAGE not in file.parents:
                place = f"{relative(file, self._config.rootpath)}:{crash.lineno}"
        again = ""
        if seen.path:
            again = terminal.command_for(record, seen, "pytest")
        lines = terminal.block_lines(
            seen,
            again,
            search=record.searches.get(record.items.get(report.nodeid, "")),
            place=place,
            text=text,
            width=self._config.stash[SHARED].width,
            is_whole=is_whole,
        )
        longrepr: Any = report.longrepr
        traceback = getattr(longrepr, "reprtraceback", None)
        is_asked_for = getattr(option, "showlocals", False) or is_whole
        if is_asked_for or getattr(option, "tbstyle", "auto") != "auto":
            report.sections.append(("pafot", "\n".join(lines)))
        elif traceback is None or not traceback.reprentries:
            report.longrepr = "\n".join(lines)
        else:
            entry = traceback.reprentries[-1]
            entry.lines, entry.style = lines, "value"
            entry.reprfuncargs = entry.reprlocals = entry.reprfileloc = None
            traceback.reprentries, traceback.extraline = [entry], None
            longrepr.chain = [(traceback, crash, None)]

    def _take_phase(self, report: pytest.TestReport) -> None:
        node_id, record, when = report.nodeid, self._record, str(report.when)
        # pytest-xdist: the worker died, so the item has no result and sends no events
        if when == "???":
            record.reasons.setdefault(node_id, str(report.longrepr))
            return
        if SEARCH_MARK not in report.keywords:
            return
        if when == "call" or not report.passed:  # A passed set-up is not a result yet.
            result = "passed"
            if report.failed:
                result = "failed" if when == "call" else "error"
            elif report.skipped:
                result = "xfailed" if hasattr(report, "wasxfail") else "skipped"
            known = record.results.get(node_id, "")
            record.results[node_id] = max(known, result, key=RESULTS.index)
        if report.failed:
            from pytest_pafot.report.terminal import add_failure  # noqa: PLC0415

            text = report.longreprtext
            crash = getattr(report.longrepr, "reprcrash", None)
            if crash is not None:
                text = str(crash.message).removeprefix("Failed: ")
            lines = filter(None, map(str.strip, text.splitlines()))
            reason = next(lines, "")
            saved = None
            if SAVED_MARK in report.keywords:
                saved = json.loads(getattr(report, AS_SAVED, "{}"))
            add_failure(record, node_id, when, report.longreprtext, reason, saved)

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> Generator[None, object, object]:
        """Set the interval of progress reports, and fail the session if a reference cannot be compared."""
        self._session = session
        if self._live.rewrites:
            self._config.stash[SHARED].progress_seconds = TERMINAL_SECONDS
        result = yield
        if self._record.incomparable:
            named = ", ".join(self._record.incomparable)
            raise pytest.UsageError(
                f"the policy cannot be compared with its reference. See {named}"
            )
        return result

    @pytest.hookimpl(tryfirst=True)
    def pytest_report_teststatus(
        self, report: pytest.TestReport | pytest.CollectReport
    ) -> tuple[str, str, str] | None:
        """Return the status that pytest shows for a passing replay."""
        if report.when != "call" or hasattr(report, "wasxfail"):
            return None
        shown = dict(report.user_properties).get("pafot")
        if shown is None or not report.passed:
            return None
        return "passed", ".", f"PASSED ({shown})"

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self) -> None:
        self._live.erase_progress()
        # If an interrupt or a dead worker prevented the teardown of a search, its findings are still to be reported.
        for node_id in list(self._pending):
            with self._record.faults(f"{node_id}: the findings were not reported"):
                self._expand(node_id)
        with self._record.faults("the records of processes that died were not read"):
            if self._record.is_driven:
                self._record.problems.extend(unclaimed(self._config))

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        """Write the plugin's section of the summary."""
        own, record = Session(), self._record
        record.unnamed = sorted(self._config.stash[INVENTORY].unnamed)
        has_remarks = record.notes or record.warnings or record.problems
        if not (record.is_driven or record.unnamed or record.left or record.written or has_remarks):
            return
        with own.faults("pafot: the summary was not printed"):
            from pytest_pafot.report import terminal  # noqa: PLC0415

            terminalreporter.section("pafot")
            width = self._config.stash[SHARED].width
            is_whole = self._config.get_verbosity() > 0
            for line in terminal.session_lines(record, width=width, is_whole=is_whole):
                terminalreporter.line(line)
            if os.environ.get("GITHUB_ACTIONS") == "true":
                page = self._config.getoption(BY_NAME["report"].key) or ""
                for line in terminal.annotation_lines(terminal.failures_of(record), page):
                    terminalreporter.line(line)
        for line in own.problems:
            terminalreporter.line(ascii_text(line))

    def _take(self, report: pytest.TestReport, kind: str, text: str, more: dict[str, Any]) -> None:
        from pytest_pafot.findings.sighting import Discovery, Seen  # noqa: PLC0415
        from pytest_pafot.report import messages, terminal  # noqa: PLC0415
        from pytest_pafot.searches.events import Progress, Search  # noqa: PLC0415

        record, event = self._record, messages.event_of(kind, text)
        is_known = isinstance(event, Seen) and event.node_id in record.seen
        terminal.add_event(record, event, report.nodeid, more.get("view", ""))
        match event:
            case Search() if not event.reason:
                # Under pytest-xdist, no line about the collection is printed, but the user needs the seed even if the
                # session ends early.
                is_first = len(record.searches) == 1 and self._config.get_verbosity() >= 0
                base = base_line(self._config)
                if self._live.is_parallel and is_first and base:
                    self._live.write([f"pafot: {base}"])
            case Search():
                self._files.write_json()
            case Progress():
                # A log keeps every line, and simplifying a finding takes hundreds of runs.
                if self._live.rewrites or not event.phase:
                    self._live.show_progress(partial(terminal.progress_line, event))
            case Seen(observed=Discovery(label="new")):
                self._files.write_json()
                if event.node_id not in self._expanded:
                    node = getattr(report, "node", None)
                    pending = self._pending.setdefault(report.nodeid, {})
                    pending[event.node_id] = more["report"], node
                self._live.erase_progress()
                if not is_known and self._config.get_verbosity() >= 0:
                    self._live.write([terminal.found_line(event)])
            case Seen(observed=Discovery(label="no worse")):
                self._pending.get(report.nodeid, {}).pop(event.node_id, None)

    def _expand(self, search_id: str) -> None:
        """Report a search's findings to pytest, the worst first, with the node ids of their future replays."""
        from pytest_pafot.report import terminal  # noqa: PLC0415

        # pytest counts each new finding like an item, with the node id of its future replay.
        pending = self._pending.pop(search_id, {})
        found = [self._record.seen[node_id] for node_id in pending]
        for seen in terminal.ranked(found):
            data, node = pending[seen.node_id]
            self._expanded.add(seen.node_id)
            report = self._config.hook.pytest_report_from_serializable(
                config=self._config, data=data
            )
            if self._session is not None:
                self._session.testscollected += 1
            given = {"keywords": report.keywords, "user_properties": report.user_properties}
            begin, end = (report_on(report, when, **given) for when in ("setup", "teardown"))
            for phase in (begin, report, end):
                if node is not None:
                    phase.__dict__["node"] = node  # as pytest-xdist does for reports of its workers
                self._config.hook.pytest_runtest_logreport(report=phase)


def unclaimed(config: pytest.Config) -> list[str]:
    """Return warnings about dead processes that no test in this session has handled."""
    from pytest_pafot.execution.crash_records import CrashRecordError, leftovers, records_of  # noqa: PLC0415

    try:
        found = leftovers(records_of(config.rootpath))
    except CrashRecordError as error:
        return [str(error)]
    return [
        f"a process (pid {each.pid}) died while {each.owner or 'an unknown test'} ran {each.scenario or 'a scenario'}. "
        f"Run that test again, or delete {each.path}"
        for each in found
    ]
