"""The replay of a saved scenario: in the file's own world, against the test's own ADS."""

from __future__ import annotations

import contextlib
from typing import Any

import pytest

from pytest_pafot.findings.finding import Finding
from pytest_pafot.findings.replay import Replayed, replay_label
from pytest_pafot.findings.run import Run
from pytest_pafot.plugin import messages, places
from pytest_pafot.plugin.bench import Bench, is_same_run
from pytest_pafot.plugin.flights import left_behind
from pytest_pafot.plugin.oracle import Verdict
from pytest_pafot.plugin.paging import showing_of
from pytest_pafot.plugin.places import Saved
from pytest_pafot.plugin.request import Request, RequestError
from pytest_pafot.plugin.session import EXPLICIT

FLAKY = "flaky"
MAX_DEATHS = 2
"""Processes that a saved scenario may kill before it is run only when it is asked for by its file."""


def replay(item: pytest.Function, request: Request, saved: Saved) -> None:
    """Run the item of a saved scenario; what the test function raises reaches pytest as it is."""
    __tracebackhide__ = True
    if saved.finding is None:
        pytest.fail(saved.error, pytrace=False)
    bench = Bench.of(item, request)
    _refuse_deadly(bench, saved)
    finding = saved.finding
    world = world_of(finding, saved)
    run, verdict = bench.tried(finding.scenario, world, item.nodeid)
    label, run, verdict = _labelled(bench, finding, world, (run, verdict))
    for leftover in left_behind(item, request):
        leftover.discard()  # It has run to its end now.
    detail = _detail(finding, run, bench.versions) if label in ("drifted", FLAKY) else ""
    messages.send(item, "replay", {"label": label, "detail": detail})
    item.user_properties.append(("pafot", label))
    showing = showing_of(item, request.settings)
    if showing is not None:
        showing.replayed(finding, run, verdict, label=label, path=bench.relative(saved.path))
    if finding.xfail is not None and not verdict.failed:
        item.add_report_section("call", "pafot", f"{label}: remove the line `xfail:` from {bench.relative(saved.path)}")
    _conclude(bench, run, verdict, label, detail)


def world_of(finding: Finding, saved: Saved) -> Any:
    """The world that a file describes.

    Raises:
        RequestError: naming the file and the field.
    """
    from pytest_pafot.world import WorldError, from_dict  # noqa: PLC0415

    try:
        return from_dict(dict(finding.world))
    except (WorldError, TypeError, ValueError) as error:
        raise RequestError(f"{saved.path}: {error}; restore the file from version control, or delete it") from None


def replay_for_search(bench: Bench, saved: Saved) -> Replayed | None:
    """What a saved scenario shows now, for a search that must know which failures are known.

    None for a file that cannot be used, whose own item says so, and for one whose scenario kills the process.
    """
    finding = saved.finding
    if finding is None:
        return None
    owner = places.saved_node_id(bench.item, saved.id)
    if saved.is_crash or len(left_behind(bench.item, bench.request, owner)) >= MAX_DEATHS:
        return Replayed(id=saved.id, signature=finding.signature, observed=finding.signature, xfailed=True)
    with contextlib.suppress(RequestError):
        run, verdict = bench.tried(finding.scenario, world_of(finding, saved), owner)
        return Replayed.of(finding, run, verdict.failure if verdict.failed else None)
    return None


def _refuse_deadly(bench: Bench, saved: Saved) -> None:
    __tracebackhide__ = True
    deaths = len(left_behind(bench.item, bench.request)) + saved.is_crash
    explicit = bench.item.config.stash.get(EXPLICIT, None)
    is_asked_for = explicit is not None and saved.path in explicit.files
    if deaths >= MAX_DEATHS and not is_asked_for:
        pytest.fail(
            f"not run: {deaths} processes have died in this scenario, so that running it would end the session; "
            f"run it alone with: pytest {bench.relative(saved.path)}",
            pytrace=False,
        )


def _labelled(bench: Bench, finding: Finding, world: Any, first: tuple[Run, Verdict]) -> tuple[str, Run, Verdict]:
    """The label of a replay. One that passes is tried twice, since chance must not be called a fix."""
    run, verdict = first
    label: str = replay_label(finding, run, verdict.failure if verdict.failed else None, bench.versions)
    if finding.expect.failure == places.CRASH:
        label = "drifted" if verdict.failed else "fixed"  # The process lives, whatever the run shows.
    if verdict.failed or verdict.discarded:
        return label, run, verdict
    again, second = bench.tried(finding.scenario, world, bench.item.nodeid)
    if second.failed:
        return FLAKY, again, second
    is_firm = finding.flaky is None and is_same_run(run, again)
    return (label if is_firm else FLAKY), run, verdict


def _conclude(bench: Bench, run: Run, verdict: Verdict, label: str, detail: str) -> None:
    __tracebackhide__ = True
    if verdict.failed and verdict.exception is not None:
        bench.item.add_report_section("call", "pafot", f"replay: {label}{f', {detail}' if detail else ''}")
        raise verdict.exception
    if verdict.kind == "skipped" and verdict.exception is not None:
        raise verdict.exception
    if label == "drifted" and bench.request.settings.strict_drift:
        pytest.fail(f"the saved scenario passes, but drifted: {detail} (--pafot-strict-drift)", pytrace=False)
    if verdict.kind == "rejected":
        pytest.skip("the test function rejected the saved scenario with pafot.reject()")
    if verdict.kind == "invalid":
        pytest.skip(f"drifted: two NPCs touched after {run.duration:.1f} s, which says nothing of the ADS")


def _detail(finding: Finding, run: Run, versions: dict[str, str]) -> str:
    """What differs from the file."""
    changed = [
        f"{name} {version} then, {versions.get(name, 'none')} now"
        for name, version in sorted(finding.found.versions.items())
        if versions.get(name) != version
    ]
    then = f"{finding.expect.outcome} at {finding.expect.time:.1f} s"
    now = f"{run.outcome} at {run.event_time:.1f} s"
    if finding.expect.failure == places.CRASH:
        then = "the process died"
    event = [] if then == now else [f"{then} in the file, {now} now"]
    return "; ".join([*event, *changed]) or "another run than before"
