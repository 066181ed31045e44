"""The message of a finding, new or replayed: one for terminal, page, JSON file and summary.

An item sends it to the controller. What only a page needs is made, and imported, only if one is requested.
"""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any

import pytest

from pytest_pafot.campaign.options import Settings
from pytest_pafot.findings.sighting import Sighting
from pytest_pafot.oracle.checks import Check
from pytest_pafot.plugin import messages
from pytest_pafot.support.errors import rerun


def label_of(sighting: Sighting) -> str:
    """Return the label of a new finding on a page."""
    return f"new ({sighting.remark})" if sighting.remark else "new"


def send_sighting(
    item: pytest.Item,
    settings: Settings,
    sighting: Sighting,
    *,
    check: Check | None = None,
    note: str = "",
    **more: Any,
) -> Sighting:
    """Send a finding to the controller; return it with what it has become for that.

    Args:
        item: the item that found or replayed it.
        settings: the item's settings: whether there is a page, and how to repeat a search whose finding has no file.
        sighting: the finding, and what this session saw of it.
        check: the check that failed; None if no check failed.
        note: what the page adds to the headline.
        more: further data for the terminal.
    """
    # A finding without a file can only be reproduced by its search.
    options, saved = ((), sighting.id) if sighting.path else (settings.repeated, "")
    run, shown = sighting.run, sighting.path or item.nodeid
    sighting = replace(
        sighting,
        sentences=sighting.finding.expect.sentences_on(run) if sighting.headline and run is not None else (),
        command=rerun(["python", "-m", "pytest", shown], os.environ, *options, saved=saved),
    )
    data = {"sighting": messages.packed(sighting), **more}
    if settings.report is not None and sighting.headline:
        from pytest_pafot.report.views import finding_view  # noqa: PLC0415

        shown = sighting.node_id if sighting.path else item.nodeid
        parts: list[str] = [sighting.label] if sighting.label != "accepted" else []
        parts += [f"accepted: {sighting.finding.accepted}"] if sighting.finding.accepted else []
        view = replace(
            finding_view(sighting, note=note, check=check),
            label=label_of(sighting) if sighting.label == "new" else ", ".join(parts),
            command=rerun(["pytest", shown], os.environ, *options, saved=saved),
        )
        data["view"] = messages.packed(view)
    messages.send(item, "finding", data)
    return sighting
