"""The files that the controller writes from the record of the session: ``--pafot-json``, the page, a CI job's summary.

The JSON file is written at the beginning of the session and again with each new finding. So a killed session leaves
its own findings, never the file of an earlier session. If writing takes long, because there are a thousand findings,
the file is written less often, so a killed session may leave it without its last findings; their files are on disk.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from pytest_pafot.campaign.options import BY_NAME
from pytest_pafot.plugin.session import SESSION, exit_code, not_written, value_if_right
from pytest_pafot.support import monotonic
from pytest_pafot.support.errors import flag, rerun

SUMMARY = "GITHUB_STEP_SUMMARY"
"""The environment variable in which GitHub Actions names the file for the summary of a step."""
QUICK, REST = 0.1, 10
"""Writing the JSON file takes long if it takes more than the first number [s]. While the session runs, the file is then
written again only after this time multiplied by the second number."""


class Files:
    """The writer of the files. What makes them is imported only when there is one to write."""

    def __init__(self, config: pytest.Config, clock: Callable[[], float] = monotonic) -> None:
        self._config = config
        self._session = config.stash[SESSION]
        self._clock = clock
        self._next = -math.inf  # when the JSON file may be written again [s]
        self._is_listed = config.getoption("collectonly", False)
        self._json: str | None = None if self._is_listed else config.getoption(BY_NAME["json"].key)

    @pytest.hookimpl(trylast=True)
    def pytest_sessionstart(self) -> None:
        """Replace the JSON file of an earlier session by the record of this session, which has not ended."""
        self.write_json()

    @pytest.hookimpl(trylast=True)  # after the new findings are reported
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Write the page, the JSON file and the summary, even if the session was interrupted."""
        self._session.exit = exit_code(session)
        target, asked = value_if_right(self._config, "report"), self._config.getoption(BY_NAME["report"].key)
        if target is not None and (self._session.seen or self._session.ended):
            with self._session.faults(f"{flag('report', target)}: not written"):
                self._write_page(target)
        elif asked and not self._is_listed:
            problem = f"{flag('report', asked)}: nothing was written, since no search and no replay ran"
            self._session.problems.append(problem)
        self.write_json()
        path, of = os.environ.get(SUMMARY), self._session
        if not path or self._is_listed or not any((of.searches, of.seen, of.unread, of.warnings, of.problems, of.left)):
            return  # A session without anything to report imports nothing for it.
        with of.faults(f"the summary in {SUMMARY}"):
            from pytest_pafot.report.session_record import markdown  # noqa: PLC0415
            from pytest_pafot.support.files import append  # noqa: PLC0415

            file = self._config.invocation_params.dir / path
            text = markdown(of, page=asked or "")
            problem = not_written(self._config, path, file.parent, lambda: append(file, text))
            of.problems += [f"{SUMMARY}={path}: not written: {problem}"] if problem else []

    def _write_page(self, target: str) -> None:
        from pytest_pafot.report.page import render_page  # noqa: PLC0415
        from pytest_pafot.support.files import write_whole  # noqa: PLC0415

        path = Path(os.path.normpath(self._config.invocation_params.dir / target))
        command = rerun(["pytest", *map(str, self._config.invocation_params.args)], os.environ)
        page, told = render_page(self._session, title=self._config.rootpath.name, command=command)
        problem = not_written(self._config, target, path.parent, lambda: write_whole(path, page.encode()))
        lines = self._session.problems if problem else self._session.written
        lines.append(f"{flag('report', target)}: not written: {problem}" if problem else f"report: {target} ({told})")

    def write_json(self) -> None:
        """Write the JSON file, unless the session runs and writing takes long."""
        began, is_over = self._clock(), self._session.exit is not None
        if self._json is None or (not is_over and began < self._next):
            return
        from pytest_pafot.report.session_record import to_text  # noqa: PLC0415
        from pytest_pafot.support.files import is_stream, write_whole  # noqa: PLC0415

        path = Path(os.path.normpath(self._config.invocation_params.dir / self._json))
        if not is_over and is_stream(path):
            return  # It keeps all that it receives, so it receives only the last record.
        commit, day = (self._config.getoption(BY_NAME[name].key) for name in ("commit", "today"))
        text = to_text(self._session, root=str(self._config.rootpath), commit=commit, day=day)
        problem = not_written(self._config, self._json, path.parent, lambda: write_whole(path, text))
        took = self._clock() - began
        self._next = began + (REST * took if took > QUICK else 0.0)
        if is_over:  # A problem is reported once, at the end.
            lines = self._session.problems if problem else self._session.written
            lines.append(f"{flag('json', self._json)}: not written: {problem}" if problem else f"json: {self._json}")
