"""The output of runs, findings and searches in notebooks, which :mod:`pytest_pafot.support.shown` requests.

Each output is a separate page inside a frame, so that no name, style or script of one output affects another. The page
needs nothing from the network.
"""

from __future__ import annotations

import shlex
from dataclasses import replace

from pytest_pafot.campaign.explore import Exploration
from pytest_pafot.campaign.saved_scenario import SavedScenario
from pytest_pafot.findings.finding import Finding
from pytest_pafot.findings.sighting import Sighting
from pytest_pafot.model.trace import Trace
from pytest_pafot.oracle.checks import CheckFailed
from pytest_pafot.oracle.run import Run
from pytest_pafot.report.page import render_frame
from pytest_pafot.report.page_data import Report, RunView
from pytest_pafot.report.views import finding_view, run_view
from pytest_pafot.support.text import plural
from pytest_pafot.world.limits import CLEARANCE


def html(value: object) -> str:
    """Return an HTML frame that shows a run, a finding or a search as a report page."""
    return render_frame(report_of(value))


def report_of(value: object) -> Report:
    """Return the report on a run, a finding or a search that its page in a notebook shows."""
    if isinstance(value, Exploration):
        views = tuple(_sighting_view(each, value) for each in value.sightings)
        title = f"{plural(len(views), 'finding')} in {plural(value.summary.runs, 'run')}"
        return Report(title=title, findings=views, searches=(value.summary,))
    if isinstance(value, SavedScenario):
        path = str(value.path)
        view = replace(_finding_view(value.finding, path), command=f"pytest {shlex.quote(path)}")
    elif isinstance(value, Finding):
        view = _finding_view(value)
    else:
        view = _run_view(value)
    return Report.of(view)


def _finding_view(finding: Finding, path: str = "") -> RunView:
    """Return the view of a single finding, without the number of runs that failed like it and without a command."""
    headline, run = (finding.expect.event, None) if finding.trace is None else ("", Run(finding.trace))
    seen = Sighting(finding=finding, node_id=finding.test, headline=headline, path=path, run=run)
    return replace(finding_view(seen), runs=0, command="")


def _sighting_view(sighting: Sighting, value: Exploration) -> RunView:
    """Return the view of a finding from a search outside pytest. It has no command, since no test replays it."""
    check = sighting.exception.check if isinstance(sighting.exception, CheckFailed) else None
    view = finding_view(replace(sighting, node_id=sighting.path or sighting.node_id), check=check)
    runs = next((1 + each.repeats for each in value.summary.finds if each.id == sighting.id), 1)
    return replace(view, runs=runs, label=sighting.remark, command="")


def _run_view(value: object) -> RunView:
    if isinstance(value, Run):
        return run_view(value.trace, float(getattr(value.world, "clearance", CLEARANCE)))
    if isinstance(value, Trace):
        return run_view(value)
    raise TypeError(f"expected a run, a trace, a finding or an exploration, received {value!r:.60}")
