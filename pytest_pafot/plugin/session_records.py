"""``--pafot-json`` and the summary of a CI job, which the controller writes from the record of the session.

The JSON file is written at the beginning of the session and again with each new finding. So a killed session leaves
its own findings, never the file of an earlier session. If writing takes long, because there are a thousand findings,
the file is written less often, so a killed session may leave it without its last findings; their files are on disk.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from pytest_pafot.campaign.options import BY_NAME
from pytest_pafot.plugin.guard import ADVICE
from pytest_pafot.plugin.messages import received
from pytest_pafot.plugin.record import Record
from pytest_pafot.plugin.session import LEFT, SUMMARY_LINES, exit_code, not_written
from pytest_pafot.support import monotonic
from pytest_pafot.support.errors import flag

if TYPE_CHECKING:
    from pytest_pafot.findings.sighting import Sighting
    from pytest_pafot.report.session_record import OrphanRecord, SessionRecord

JSON = BY_NAME["json"]
SUMMARY = "GITHUB_STEP_SUMMARY"
"""The environment variable in which GitHub Actions names the file for the summary of a step."""
QUICK, REST = 0.1, 10
"""Writing the JSON file takes long if it takes more than the first number [s]. While the session runs, the file is then
written again only after this time multiplied by the second number."""


def is_asked_for(config: pytest.Config, environ: Mapping[str, str]) -> bool:
    """Return whether ``--pafot-json`` or a CI job wants a record."""
    is_wanted = bool(config.getoption(JSON.key) or environ.get(SUMMARY))
    return is_wanted and not config.getoption("collectonly", False)


class Records:
    """The writer of the record of the session as JSON and as the summary of a CI job."""

    def __init__(self, config: pytest.Config, record: Record, clock: Callable[[], float] = monotonic) -> None:
        self._config = config
        self._record = record
        self._clock = clock
        self._next = -math.inf  # when the JSON file may be written again [s]
        self._file: str | None = config.getoption(JSON.key)
        self._lines = config.stash[SUMMARY_LINES]

    @pytest.hookimpl(trylast=True)
    def pytest_sessionstart(self) -> None:
        """Replace the JSON file of an earlier session by the record of this session, which has not ended."""
        self._write_json(None)

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Write the JSON file again if a message says something new."""
        message, sighting = received(report), self._record.latest
        if message is None:
            return
        if message.kind == "search" or (sighting is not None and sighting.label == "new"):
            self._write_json(None)

    @pytest.hookimpl(trylast=True)  # after the pages are written and the new findings are reported
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Write the JSON file and the summary, even if the session was interrupted."""
        code = exit_code(session)
        self._write_json(code)
        path, record = os.environ.get(SUMMARY), self._record
        left, searches = self._config.stash[LEFT].files, (record.searches, record.running, record.unbegun)
        findings, problems = (record.sightings, record.unread), (record.warnings, self._lines.problems)
        if not path or not any((*searches, *findings, *problems, *left)):
            return  # A session without anything to report imports nothing for it.
        with self._lines.faults(f"the summary in {SUMMARY}"):
            from pytest_pafot.report.session_record import markdown  # noqa: PLC0415
            from pytest_pafot.support.files import append  # noqa: PLC0415

            file = self._config.invocation_params.dir / path
            text = markdown(self._made(code), page=self._config.getoption(BY_NAME["report"].key) or "")
            problem = not_written(self._config, path, file.parent, lambda: append(file, text))
            if problem:
                self._lines.problems.append(f"{SUMMARY}={path}: not written: {problem}")

    def _made(self, code: int | None) -> SessionRecord:
        """Make the record of the session so far; ``code`` is its exit code, None before its end."""
        from pytest_pafot.findings.finding import portable  # noqa: PLC0415
        from pytest_pafot.report.session_record import (  # noqa: PLC0415
            SessionRecord,
            finding_entry,
            worst,
        )
        from pytest_pafot.support.process import installed_versions  # noqa: PLC0415

        record, same = self._record, partial(portable, root=str(self._config.rootpath))

        def result(node_id: str) -> str:
            return worst(record.results.get(node_id, ()))

        def message(node_id: str) -> str:
            return same(record.reasons.get(node_id, ""))

        # A file that could not be read has an entry without a sighting. Replays come last: by now the searches of their
        # tests may have found their failures elsewhere.
        sightings: dict[str, Sighting | None] = {**dict.fromkeys(record.unread), **record.sightings}
        sightings |= {each.node_id: each for each in record.replays}
        findings = []
        for node_id, seen in sorted(sightings.items()):
            if seen is None:
                known: dict[str, Any] = {**record.unread[node_id], "node_id": node_id, "detail": message(node_id)}
            else:
                # Only a search that has ended has counted the runs that fail like its findings.
                runs = 1 + record.new[node_id].repeats if node_id in record.new else 0
                known = {"headline": same(seen.headline), "detail": same(seen.detail), "runs": runs}
            findings.append(finding_entry(seen, **known, result=result(node_id)))
        # A search that runs now has an empty record, which is what a session that is killed leaves of it.
        searches = {**record.unbegun, **record.searches, **record.running}
        return SessionRecord(
            exit=code,
            commit=self._config.getoption(BY_NAME["commit"].key),
            day=self._config.getoption(BY_NAME["today"].key),
            versions=installed_versions(),
            searches=[
                replace(search, message=message(node_id), result=result(node_id))
                for node_id, search in sorted(searches.items())
            ],
            findings=findings,
            orphans=self._orphans() if code is not None else [],
            warnings=sorted([*record.warnings, *self._lines.warnings]),
            problems=list(self._lines.problems),
        )

    def _orphans(self) -> list[OrphanRecord]:
        """Return records of the folders with saved scenarios that the session left out."""
        from pytest_pafot.report.session_record import OrphanRecord  # noqa: PLC0415

        left = self._config.stash[LEFT]
        expected, _, advice = ADVICE.partition("; ")
        counts = Counter(file.rpartition("/")[0] for file in left.files)
        failing = {file.rpartition("/")[0] for file in left.fails}
        return [
            OrphanRecord(folder=folder, files=count, expected=expected, way_out=advice, is_gone=folder in failing)
            for folder, count in sorted(counts.items())
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
        text = to_text(self._made(code))
        problem = not_written(self._config, self._file, path.parent, lambda: write_whole(path, text))
        took = self._clock() - began
        self._next = began + (REST * took if took > QUICK else 0.0)
        if code is not None:  # A problem is reported once, at the end.
            lines = self._lines.problems if problem else self._lines.reports
            lines.append(f"{flag('json', self._file)}: not written: {problem}" if problem else f"json: {self._file}")
