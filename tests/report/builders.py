"""Reports for tests: real runs, and runs made by hand."""

import json
import math
from collections import Counter
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

from highway_env.vehicle.controller import ControlledVehicle

import pytest_pafot as pafot
from pytest_pafot.findings.finding import Finding, Found
from pytest_pafot.findings.sighting import Discovery, Finished, Judged, Seen
from pytest_pafot.findings.verdict import Failure, Verdict
from pytest_pafot.oracle.run import Run
from pytest_pafot.report.page import Shown, render_page
from pytest_pafot.report.session import Session
from pytest_pafot.report.terminal import add_event
from pytest_pafot.report.views import finding_view
from pytest_pafot.searches.events import Ending, Search

TEST = "tests/test_safety.py::test_never_at_fault_in_a_collision"

HOSTILE = (
    "</script><script>window.hacked = 1</script>",
    "<!--<script>",
    "<img src=x onerror='window.hacked=1'>",
    "\"'><svg onload=window.hacked=1>",
    "]]>",
    "line\u2028separator\u2029",
    "$title ${script} $$",
    "nul\x00 bell\x07 escape\x1b[31m",
    "lone \ud800 surrogate",
    "&lt;b&gt; &amp;",
    "na\u00efve \U0001f697 \u202egnirts",
)


def constant_speed():
    return lambda observation: (0.0, 0.0)


def scenario(*chains, **more):
    genes = [[pafot.PositionInstruction(cell, speed) for cell, speed in chain] for chain in chains]
    return pafot.Scenario(npcs=genes, **more)


CUT_IN = scenario([(1, 25.0), (2, 8.0)], [(4, 20.0), (4, 20.0)], seed=7)
"""A scenario in which NPC 0 comes from the front left, cuts in and brakes; NPC 1 stays at the right."""


def finding_of(trace, **more):
    failure = Failure(kind="AssertionError", assertion="assert not run.collision")
    found = Found(seed=1, generation=3, algorithm="pafot", versions={"pytest-pafot": "0.1.0"})
    return Finding.from_run(
        Run(trace), failure, test=TEST, world=more.pop("world", {"kind": "highway"}), found=found
    )


def seen_of(trace, finding=None, **more):
    """Return what a session saw of a finding; by default of that of the run. The run is None if no run is known."""
    finding = finding or finding_of(trace)
    verdict = Verdict(kind="failed")
    ended = Judged(verdict=verdict)
    if trace is not None:
        ended = Finished(run=Run(trace), verdict=verdict)
    observed = Discovery(ended=ended)
    return Seen(
        finding=finding, observed=observed, **{"node_id": f"{TEST}[saved-{finding.id}]"} | more
    )


class Viewed(Shown):
    """A finding on a page, whose view has attributes."""

    def __getattr__(self, name):
        return attributes(self.view[name])

    def changed(self, **more):
        """Return the finding with changes of its view."""
        return replace(self, view=self.view | more)


def attributes(value):
    """Return plain data with attributes in place of keys."""
    if isinstance(value, (tuple, list)):
        return tuple(map(attributes, value))
    return (
        SimpleNamespace(**{k: attributes(v) for k, v in value.items()})
        if isinstance(value, dict)
        else value
    )


def view_of(trace, finding=None, check=None, **more):
    seen = seen_of(trace, finding, **more)
    return Viewed(seen=seen, view=finding_view(seen, check=check))


def as_seen(shown, *, finding=None, **more):
    """Return a finding on a page with changes of what the session saw of it, and of the finding itself."""
    changed = replace(shown.seen.finding, **finding or {})
    more = {"node_id": f"{TEST}[saved-{changed.id}]"} | more
    return replace(shown, seen=replace(shown.seen, finding=changed, **more))


@cache
def cut_in_trace():
    return pafot.Highway().rollout(CUT_IN, constant_speed)


@cache
def rear_trace():
    """Return a run in which an NPC drives into the ego from behind; a second NPC falls far behind."""
    return pafot.Highway().rollout(
        scenario([(6, 26.8)] * 3, [(7, 2.0)] * 3, ego_speed=15.0), constant_speed
    )


@cache
def bend_trace():
    """Return a run in which an NPC cuts in at a bend of the racetrack, and brakes."""
    world = pafot.World("racetrack-v1", duration=20.0)
    chains = scenario(
        [(1, 4.0), (2, 0.0)], [(6, 10.0), (6, 10.0)], gene_seconds=4.0, ego_speed=10.0
    )
    return world.rollout(chains, lambda: ControlledVehicle)


def session_of(*views, searches=(), seen=(), **more):
    """Return the record of a session with these views of findings, other findings, and searches."""
    session = Session(**more)
    for view in views:
        add_event(session, view.seen, f"{TEST}[search]", json.dumps(view.view))
    for each in (*seen, *searches):
        add_event(session, each, searches[0].node_id if searches else "")
    return session


@cache
def real_views():
    """Return the views of two findings, in the order of a page."""
    return view_of(cut_in_trace()), view_of(rear_trace())


REAL_SEARCH = Search(
    node_id=f"{TEST}[search]", algorithm="pafot", seed=5, base_seed=5, generations=8, asked={"generations": 8},
    reason=Ending.GENERATIONS, kinds=Counter(failed=5, passed=45), more_runs=Counter(known=2),
    outcomes=Counter(safe=45, collision=5), responsibilities=Counter(none=45, ego=3, npc=2),
    warnings=("few NPCs reached their cell",),
)  # fmt: skip


def page_of(*views, title="t", **more):
    """Return the page of a session with these views."""
    return render_page(
        session_of(*views, **more), title=title, command="pytest --pafot-generations=8"
    )[0]


def real_page():
    return page_of(*real_views(), searches=(REAL_SEARCH,))


def is_close(a, b, tolerance=0.006):
    return (a is None and b is None) or math.isclose(a, b, abs_tol=tolerance)
