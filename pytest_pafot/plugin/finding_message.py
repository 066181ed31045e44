"""The message of a finding, new or replayed: one for terminal, page, JSON file and summary.

An item sends it to the controller. What only a page or a JSON file needs is made, and imported, only if one is
requested.
"""

from __future__ import annotations

import os
from dataclasses import asdict, replace
from typing import Any

import pytest

from pytest_pafot.campaign.events import NEW, Find
from pytest_pafot.campaign.options import Settings
from pytest_pafot.findings.finding import Finding
from pytest_pafot.oracle.checks import Check
from pytest_pafot.oracle.run import Run
from pytest_pafot.plugin import messages
from pytest_pafot.plugin.session_records import is_asked_for
from pytest_pafot.plugin.tracing import traced
from pytest_pafot.searching.plain import plain
from pytest_pafot.support.errors import rerun


def is_on_page(config: pytest.Config, settings: Settings) -> bool:
    """Return whether a page shows what an item finds: a page of ``--pafot-report``, or the report of pytest-html."""
    return settings.report is not None or bool(config.getoption("htmlpath", None))


def label_of(find: Find) -> str:
    """Return the label of a new finding on a page."""
    return f"{NEW} ({find.remark})" if find.remark else NEW


def tell_finding(
    item: pytest.Item,
    settings: Settings,
    finding: Finding,
    find: Find,
    *,
    run: Run | None,
    check: Check | None = None,
    note: str = "",
    **more: Any,
) -> None:
    """Send a finding to the controller.

    Args:
        item: the item that found or replayed it.
        settings: the item's settings, which name the page, and repeat the search of a finding without a file.
        finding: the content of its file.
        find: what this session saw of it.
        run: the run that shows it; None if its process died or hung.
        check: the check that failed; None if no check failed.
        note: what the page adds to the headline.
        more: further data for the terminal.
    """
    data = {"find": plain(find), **more}
    # A finding without a file can only be reproduced by its search.
    options, saved = ((), find.id) if find.path else (settings.repeated, "")
    if is_asked_for(item.config, os.environ):
        from pytest_pafot.report.session_record import FindingRecord  # noqa: PLC0415

        again = rerun(["python", "-m", "pytest", find.path or item.nodeid], os.environ, *options, saved=saved)
        sentences = finding.expect.sentences_on(run) if find.headline and run is not None else ()
        data["record"] = asdict(FindingRecord.of(finding, find, replay=again, sentences=sentences))
    if is_on_page(item.config, settings):
        data["target"] = settings.report
        if find.headline:
            from pytest_pafot.report.views import finding_view, with_neighbours  # noqa: PLC0415

            trace, headline = None if run is None else run.trace, "; ".join(filter(None, [find.headline, note]))
            view = finding_view(trace, finding, node_id=find.node_id, headline=headline, check=check)
            command = rerun(["pytest", find.node_id if find.path else item.nodeid], os.environ, *options, saved=saved)
            accepted = f", accepted: {finding.accepted}" if finding.accepted else ""
            label = label_of(find) if find.label == NEW else f"{find.label}{accepted}"
            told = traced(item).described if traced(item).requirements else ""
            view = replace(view, label=label, traced=told, severity=find.severity, path=find.path, command=command)
            data["view"] = plain(with_neighbours(view, find))
    messages.send(item, "finding", data)
