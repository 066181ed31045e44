"""``--pafot-json`` and the summary of a CI job, which the controller writes from the messages of items.

The JSON file is written at the beginning of the session and again with each new finding. So a killed session leaves
its own findings, never the file of an earlier session. If writing takes long, because there are a thousand findings,
the file is written less often, so a killed session may leave it without its last findings; their files are on disk.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from pytest_pafot.campaign.options import BY_NAME
from pytest_pafot.corpus.layout import files_in, relative
from pytest_pafot.plugin import messages
from pytest_pafot.plugin.marks import SAVED_MARK, SEARCH_MARK
from pytest_pafot.plugin.messages import AS_SAVED
from pytest_pafot.plugin.orphans import advice
from pytest_pafot.plugin.session import HERE, SUMMARY_LINES, exit_code, not_written
from pytest_pafot.plugin.unrun import UNRUN
from pytest_pafot.support.errors import flag, rerun
from pytest_pafot.support.traced import Traced

if TYPE_CHECKING:
    from pytest_pafot.campaign.events import SearchSummary
    from pytest_pafot.findings.sighting import Sighting
    from pytest_pafot.report.session_record import OrphanRecord, SessionRecord

JSON = BY_NAME["json"]
EVENTS = ("start", "progress", "finding", "search", "note", "warning", "compared")
"""The kinds of messages that hooks of other plugins receive."""
SUMMARY = "GITHUB_STEP_SUMMARY"
"""The environment variable in which GitHub Actions names the file for the summary of a step."""
QUICK, REST = 0.1, 10
"""Writing the JSON file takes long if it takes more than the first number [s]. While the session runs, the file is then
written again only after this time multiplied by the second number."""


def is_asked_for(config: pytest.Config, environ: Mapping[str, str]) -> bool:
    """Return whether ``--pafot-json``, a CI job or a plugin wants a record; False if it replays for another session."""
    hooks = (config.hook.pytest_pafot_event, config.hook.pytest_pafot_record)
    is_wanted = bool(config.getoption(JSON.key) or environ.get(SUMMARY) or any(map(_is_implemented, hooks)))
    return is_wanted and not environ.get(HERE) and not config.getoption("collectonly", False)


class Records:
    """Hooks that collect the messages and results of items, and write the record of the session."""

    def __init__(self, config: pytest.Config, clock: Callable[[], float] = time.monotonic) -> None:
        self._config = config
        self._clock = clock
        self._is_refused = False  # whether a hook of another plugin has raised
        self._next = -math.inf  # when the JSON file may be written again [s]
        self._file: str | None = config.getoption(JSON.key)
        self._lines = config.stash[SUMMARY_LINES]
        self._searches: dict[str, SearchSummary] = {}  # by node id, like the findings
        self._findings: dict[str, Sighting] = {}
        self._errors: dict[str, dict[str, Any]] = {}  # what is known of saved scenarios that could not be read or run
        self._runs: dict[str, int] = {}
        self._results: dict[str, list[str]] = {}
        self._reasons: dict[str, str] = {}
        self._traced: dict[str, Traced] = {}
        self._texts: dict[str, list[str]] = {"warning": [], "compared": []}

    @pytest.hookimpl(trylast=True)
    def pytest_sessionstart(self) -> None:
        """Replace the JSON file of an earlier session by the record of this session, which has not ended."""
        self._write_json(None)

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Store the messages of items, and the result of each of their phases."""
        message = messages.received(report)
        is_event = message is not None and message.kind in EVENTS
        if message is not None and is_event and _is_implemented(self._config.hook.pytest_pafot_event):
            self._call("pytest_pafot_event", node_id=report.nodeid, kind=message.kind, data=_for_hooks(message))
        if message is None:
            self._take_phase(report)
        elif message.kind in ("finding", "start", "search", *self._texts):
            self._take(report.nodeid, message)

    @pytest.hookimpl(trylast=True)  # after the pages are written and the new findings are reported
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Write the JSON file and the summary, even if the session was interrupted."""
        if _is_implemented(self._config.hook.pytest_pafot_record):
            from pytest_pafot.report.session_record import to_text  # noqa: PLC0415

            self._call("pytest_pafot_record", record=json.loads(to_text(self._record(exit_code(session)))))
        if self._is_refused and session.exitstatus == pytest.ExitCode.OK:  # a hook may be somebody's gate
            session.exitstatus = pytest.ExitCode.TESTS_FAILED
        code = exit_code(session)
        self._write_json(code)
        path = os.environ.get(SUMMARY)
        orphans = self._config.stash[UNRUN].orphans
        if not path or not any((self._searches, self._findings, *self._texts.values(), orphans, self._lines.problems)):
            return  # A session without anything to report imports nothing for it.
        with self._lines.faults(f"the summary in {SUMMARY}"):
            from pytest_pafot.report.session_record import markdown  # noqa: PLC0415
            from pytest_pafot.support.files import append  # noqa: PLC0415

            file = self._config.invocation_params.dir / path
            text = markdown(self._record(code))
            problem = not_written(self._config, path, file.parent, lambda: append(file, text))
            if problem:
                self._lines.problems.append(f"{SUMMARY}={path}: not written: {problem}")

    def _call(self, hook: str, **given: Any) -> None:
        """Call a hook of other plugins; what it raises costs nothing else, but the session does not pass."""
        problems = len(self._lines.problems)
        with self._lines.faults(f"a hook {hook}"):
            getattr(self._config.hook, hook)(config=self._config, **given)
        self._is_refused |= len(self._lines.problems) > problems

    def _take(self, node_id: str, message: messages.Message) -> None:
        from pytest_pafot.campaign.events import SearchSummary  # noqa: PLC0415
        from pytest_pafot.findings.sighting import NEW, Sighting  # noqa: PLC0415

        data = message.data
        match message.kind:
            case "start":
                self._searches[node_id] = SearchSummary(node_id=node_id, **data)
            case "finding":
                sighting = messages.unpacked(Sighting, data["sighting"])
                earlier = self._findings.get(sighting.node_id)
                if earlier is not None and earlier.unshrunk:  # from a search whose new file this session replays
                    sighting = replace(sighting, unshrunk=earlier.unshrunk)
                self._findings[sighting.node_id] = sighting
                if sighting.label == NEW:
                    self._write_json(None)
            case "search":
                summary = self._searches[node_id] = messages.unpacked(SearchSummary, data["summary"])
                self._runs.update((find.node_id, 1 + find.repeats) for find in summary.finds)
                self._write_json(None)
            case kind:
                self._texts[kind].append(f"{data['text']}")

    def _take_phase(self, report: pytest.TestReport) -> None:
        """Store the result of a phase. A saved scenario that failed without a message could not be read or run."""
        told = Traced.of_properties(report.user_properties)
        when: str = report.when
        if when == "???":  # pytest-xdist: the worker died, so the item has no result and says nothing of itself
            self._reasons.setdefault(report.nodeid, str(report.longrepr))
            self._traced.setdefault(report.nodeid, told)
            return
        if told:
            self._traced[report.nodeid] = told
        elif SEARCH_MARK not in report.keywords:
            return
        if report.when == "call" or not report.passed:  # A setup that passed is not yet a result.
            self._results.setdefault(report.nodeid, []).append(_result(report))
        if report.failed:  # the reason is the line of the short summary, or the first line of the text
            crash = getattr(report.longrepr, "reprcrash", None)
            text = report.longreprtext if crash is None else str(crash.message)
            reason = next((line.strip() for line in text.splitlines() if line.strip()), "")
            self._reasons.setdefault(report.nodeid, reason)
        if report.nodeid in self._findings or report.nodeid in self._errors or SEARCH_MARK not in report.keywords:
            return
        if report.failed and SAVED_MARK in report.keywords:
            saved = json.loads(getattr(report, AS_SAVED))
            again = rerun(["python", "-m", "pytest", saved["file"]], os.environ, saved=saved["id"])
            self._errors[report.nodeid] = {**saved, "replay": again}
        elif report.failed:
            from pytest_pafot.campaign.events import SearchSummary  # noqa: PLC0415

            self._searches.setdefault(report.nodeid, SearchSummary(node_id=report.nodeid))

    def _record(self, code: int | None) -> SessionRecord:
        from pytest_pafot.campaign.events import by_test, concluded  # noqa: PLC0415
        from pytest_pafot.report.session_record import (  # noqa: PLC0415
            ItemRecord,
            SessionRecord,
            finding_entry,
            same_everywhere,
            worst,
        )
        from pytest_pafot.support.versions import installed_versions  # noqa: PLC0415

        results = {node_id: worst(results) for node_id, results in self._results.items()}
        same = partial(same_everywhere, root=str(self._config.rootpath))
        traced = {
            node_id: {**asdict(told), "requirements": list(told.requirements)} for node_id, told in self._traced.items()
        }
        others = sorted(self._traced.keys() - self._searches.keys() - self._findings.keys() - self._errors.keys())
        by_name, entries = by_test(self._searches.values()), dict[str, dict[str, Any]]()
        for node_id in sorted({*self._findings, *self._errors}):
            sighting = self._findings.get(node_id)
            known = self._errors.get(node_id, {}) | {"node_id": node_id, "result": results.get(node_id, "")}
            if sighting is None:
                detail = self._reasons[node_id]
            else:
                sighting = concluded(sighting, by_name)
                detail, known["headline"] = sighting.detail, same(sighting.headline)
            known |= {"detail": same(detail), "runs": self._runs.get(node_id, 0), **traced.get(node_id, {})}
            entries[node_id] = finding_entry(sighting, **known)
        return SessionRecord(
            exit=code,
            commit=self._config.getoption(BY_NAME["commit"].key),
            day=self._config.getoption(BY_NAME["today"].key),
            versions=installed_versions(),
            searches=[
                replace(
                    search,
                    result=results.get(node_id, ""),
                    message=same(self._reasons.get(node_id, "")),
                    **traced.get(node_id, {}),
                )
                for node_id, search in sorted(self._searches.items())
            ],
            findings=[*entries.values()],
            tests=[
                ItemRecord(
                    node_id=each,
                    result=results.get(each, ""),
                    message=same(self._reasons.get(each, "")),
                    **traced[each],
                )
                for each in others
            ],
            compared=list(dict.fromkeys(self._texts["compared"])),
            orphans=self._orphans() if code is not None else [],
            warnings=sorted([*self._texts["warning"], *self._lines.warnings]),
            problems=list(self._lines.problems),
        )

    def _orphans(self) -> list[OrphanRecord]:
        """Return records of the folders whose test is gone, except folders that another process has emptied."""
        from pytest_pafot.report.session_record import OrphanRecord  # noqa: PLC0415

        left = ((folder, each, len(files_in(folder))) for folder, each in self._config.stash[UNRUN].orphans.items())
        return [
            OrphanRecord(
                folder=relative(folder, self._config.rootpath),
                files=count,
                expected=orphan.expected,
                way_out=advice(self._config),
                is_gone=orphan.is_gone,
            )
            for folder, orphan, count in sorted(left)
            if count
        ]

    def _write_json(self, code: int | None) -> None:
        began = self._clock()
        if self._file is None or (code is None and began < self._next):
            return
        from pytest_pafot.report.session_record import to_text  # noqa: PLC0415
        from pytest_pafot.support.files import is_stream, write_whole  # noqa: PLC0415

        path = Path(os.path.normpath(self._config.invocation_params.dir / self._file))
        if code is None and is_stream(path):
            return  # It keeps all that it receives, so it receives only the last record.
        text = to_text(self._record(code))
        problem = not_written(self._config, self._file, path.parent, lambda: write_whole(path, text))
        took = self._clock() - began
        self._next = began + (REST * took if took > QUICK else 0.0)
        if code is not None:  # A problem is reported once, at the end.
            lines = self._lines.problems if problem else self._lines.reports
            lines.append(f"{flag('json', self._file)}: not written: {problem}" if problem else f"json: {self._file}")


def _for_hooks(message: messages.Message) -> dict[str, Any]:
    """Return what hooks of other plugins receive of a message: not what is meant for the page and the terminal."""
    if message.kind != "finding":
        return {} if message.kind == "search" else message.data
    from pytest_pafot.findings.sighting import Sighting  # noqa: PLC0415
    from pytest_pafot.report.session_record import finding_entry  # noqa: PLC0415

    sighting = messages.unpacked(Sighting, message.data["sighting"])
    return {"record": finding_entry(sighting), "is_new": sighting.is_first}


def _is_implemented(hook: Any) -> bool:
    return bool(hook.get_hookimpls())


def _result(report: pytest.TestReport) -> str:
    """Return the result of a phase from its report: ``passed``, ``skipped``, ``xfailed``, ``failed`` or ``error``."""
    if report.failed:
        return "failed" if report.when == "call" else "error"
    if report.skipped:
        return "xfailed" if hasattr(report, "wasxfail") else "skipped"
    return "passed"
