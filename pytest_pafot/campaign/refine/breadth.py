"""The neighbours of a finding: how many of them fail in the same way."""

from __future__ import annotations

from dataclasses import replace

from pytest_pafot.campaign.bench import Bench
from pytest_pafot.campaign.events import Phase, Refining
from pytest_pafot.campaign.harness import begins_alike, limits_of
from pytest_pafot.campaign.refine.runs import announce, check_time, number_ahead, showing
from pytest_pafot.campaign.state import State
from pytest_pafot.campaign.store import Store
from pytest_pafot.findings.neighbours import Breadth, breadth_of
from pytest_pafot.findings.sighting import Sighting


def with_breadth(sighting: Sighting, state: State, bench: Bench, store: Store) -> Refining[Sighting]:
    """Run neighbours of a finding; return it with how broad its failure is, also in its file, unless it has none."""
    limits, number = limits_of(bench.harness.world), bench.harness.request.settings.neighbours
    asking, fails = breadth_of(sighting.finding.scenario, number, limits, number_ahead(bench)), None
    own, driven = sighting.run, 0
    try:
        while True:
            neighbour, ahead = asking.send(fails)
            announce(ahead, state, bench)
            check_time(bench)
            driven += 1
            yield Phase(f"running neighbour {driven} of {sighting.id}", sighting.id)
            state.neighbour_runs += 1
            run = yield from showing(sighting, neighbour, state, bench, store)
            is_own = run is not None and own is not None and begins_alike(own, run)  # then it is no neighbour
            fails = None if is_own else run is not None
    except StopIteration as done:
        breadth: Breadth | None = done.value
    if breadth is None:
        return sighting
    sighting = store.rewritten(replace(sighting, finding=replace(sighting.finding, neighbours=breadth)))
    return replace(sighting, breadth=breadth)
