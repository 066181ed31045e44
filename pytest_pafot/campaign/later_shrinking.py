"""Refining a saved finding in a later session, as a search does after its last run."""

from __future__ import annotations

import math
from collections.abc import Generator
from dataclasses import dataclass, replace

from pytest_pafot.campaign.events import Note, Phase
from pytest_pafot.campaign.refine.steps import refine
from pytest_pafot.campaign.search_session import Prepared
from pytest_pafot.campaign.store import UNCONFIRMED
from pytest_pafot.campaign.verdict import headline
from pytest_pafot.corpus.saved import Saved
from pytest_pafot.findings.finding import Finding, ending, of_failure
from pytest_pafot.findings.shrink import Shrunk, size_of, sort_key
from pytest_pafot.findings.sighting import Sighting
from pytest_pafot.support.text import plural


@dataclass(frozen=True, slots=True, kw_only=True)
class Later:
    """The result of shrinking a saved finding.

    Attributes:
        finding: the finding with a simpler scenario; None if the file stays as it is.
        result: what was done, or why nothing was, without the name of the file.
        is_refused: True if the finding does not show its failure now, or does not repeat, so that nothing was tried.
        notes: remarks on what could not be found out.
    """

    finding: Finding | None = None
    result: str
    is_refused: bool = False
    notes: tuple[str, ...] = ()


def shrink_saved(
    parts: Prepared, saved: Saved, *, path: str, until: float = math.inf
) -> Generator[Phase | Later, None, None]:
    """Shrink the scenario of a file further, from what it is now, and try drivers in the result.

    Yield the work that goes on, often, and at last the result.

    Args:
        parts: the parts of a search in the world of the file.
        saved: the file, with a finding that is expected to give the same run each time.
        path: the path of the file, for reports.
        until: the time at which it must end [s], or infinity.
    """
    __tracebackhide__ = True
    state, bench, store, before = parts.state, parts.bench, parts.store, saved.finding
    harness = bench.harness
    if before is None:
        raise ValueError(f"saved: expected a file that can be read, received {saved!r:.100}")
    # The file has to fail as it says, or everything that is simpler would be compared with something else.
    run = bench.run(before.scenario)
    verdict = bench.finish(run)
    failure = verdict.failure if verdict.failed else None
    if failure is None or verdict.exception is None or of_failure(run, failure) != before.signature:
        now = headline(run, verdict) if verdict.failed else ending(run)
        yield Later(result=f"it does not fail as the file says: {now}", is_refused=True)
        return
    # What was measured in the file's scenario says nothing of a simpler one.
    start = replace(
        before,
        found=replace(before.found, versions=harness.versions),
        perception=harness.policy.sight,
        original=None,
        shrunk=None,
    )
    # What a search knows of a finding that it has just confirmed. Without a file, nothing is written on the way.
    store.is_holding = False
    store.findings[saved.id] = Sighting(
        finding=start,
        node_id=harness.saved_node_id(saved.id),
        path=path,
        unshrunk=UNCONFIRMED,
        severity=verdict.severity,
        exception=verdict.exception,
        run=run,
        is_first=False,
    )
    # A candidate counts if it shows this failure; another one is a finding of its own, and only noted.
    state.finds[of_failure(run, failure)] = saved.id
    notes = list[str]()
    for event in refine(state, bench, store, until=until):
        if isinstance(event, Phase):
            yield event
        elif isinstance(event, Note) and event.text not in notes:
            notes.append(event.text)
    sighting = store.findings[saved.id]
    notes += (f"found saved-{id_}: {each.headline}" for id_, each in store.findings.items() if each is not sighting)
    later = _compared(before, sighting, state.shrink_runs)
    if sighting.is_flaky:
        later = Later(result=f"it is flaky: {sighting.difference}", is_refused=True)
    yield replace(later, notes=tuple(notes))


def _compared(before: Finding, sighting: Sighting, runs: int) -> Later:
    """Return the simpler version of a finding with the words for it, or that there is none after so many runs."""
    now, more = sighting.finding, f" ({sighting.unshrunk.partition(': ')[2]})" if sighting.unshrunk else ""
    if not sort_key(now.scenario) < sort_key(before.scenario):
        return Later(result=f"nothing simpler was found in {plural(runs, 'run')}{more}")
    sizes = [size_of(each.scenario, each.longest_run) for each in (before, now)]
    how = f"from {sizes[0]} to {sizes[1]}" if sizes[0] != sizes[1] else "to a simpler scenario of the same size"
    earlier, shrunk = before.shrunk or Shrunk(rollouts=0), now.shrunk or Shrunk(rollouts=0, is_minimal=False)
    more = more or ("" if shrunk.is_minimal else "; it could be simpler, so the command may go on")
    whole = replace(
        now,
        original=before.original or before.scenario,
        shrunk=replace(shrunk, rollouts=earlier.rollouts + shrunk.rollouts),
    )
    return Later(finding=whole, result=f"shrunk {how} in {plural(runs, 'run')}{more}")
