"""The replay of a saved scenario: in the file's own world, against the test's own ADS."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, NoReturn

import pytest

from pytest_pafot.campaign.harness import Bench, is_same_run
from pytest_pafot.campaign.recorder import cause, what_happened
from pytest_pafot.campaign.request import Request, RequestError
from pytest_pafot.campaign.verdict import Verdict
from pytest_pafot.corpus.saved import Saved
from pytest_pafot.execution.separate_process import tried_apart
from pytest_pafot.execution.worker_pool import Lost, ProcessLostError
from pytest_pafot.findings.finding import Finding
from pytest_pafot.findings.replay import HAS_EVENT, Replayed, ending, replay_label
from pytest_pafot.plugin import messages, node_ids
from pytest_pafot.plugin.crash_folder import left_behind
from pytest_pafot.plugin.failure_reports import SUMMARY
from pytest_pafot.plugin.report_pages import showing_of
from pytest_pafot.run import Run
from pytest_pafot.text import ascii_text
from pytest_pafot.trace import Outcome
from pytest_pafot.world import codec as worlds

if TYPE_CHECKING:
    from pytest_pafot.scenario import Scenario

FLAKY = "flaky"

Tried = Callable[["Scenario", Any, str], tuple[Run, Verdict]]
"""Runs a scenario in a world, with a record of an owner on disk, and judges it."""


def replay(item: pytest.Function, request: Request, saved: Saved) -> None:
    """Run the item of a saved scenario; what the test function raises reaches pytest as it is."""
    __tracebackhide__ = True
    if saved.finding is None:
        pytest.fail(saved.error, pytrace=False)
    bench = Bench.of(item, request)
    finding = saved.finding
    world = world_of(bench, finding, saved)
    lost = None
    try:
        label, run, verdict = _labelled(bench, finding, world, _means(bench, saved, item.nodeid))
    except ProcessLostError as error:
        lost = error.lost
    for leftover in left_behind(item, request):
        leftover.discard()  # What came of it is told now.
    if lost is not None:  # Outside of the handler, so that the same is not shown twice.
        _conclude_lost(bench, saved, finding, lost)
    detail = _detail(bench, finding, _now(finding, run))
    _tell(bench, label, detail if label in ("drifted", FLAKY) else "")
    showing = showing_of(item, request.settings)
    if showing is not None:
        showing.replayed(finding, run, verdict, label=label, path=bench.relative(saved.path))
    if finding.xfail is not None and not verdict.failed:
        item.add_report_section("call", "pafot", f"{label}: remove the line `xfail:` from {bench.relative(saved.path)}")
    _conclude(bench, run, verdict, label, detail if label in ("drifted", FLAKY) else "")


def world_of(bench: Bench, finding: Finding, saved: Saved) -> Any:
    """The world that a file describes, made, with its scenario checked against it; or the test's, where it is code.

    Raises:
        RequestError: naming the file, the line and the field.
    """
    from pytest_pafot.corpus.reader import located  # noqa: PLC0415
    from pytest_pafot.scenario import ScenarioError  # noqa: PLC0415
    from pytest_pafot.world import WorldError, from_dict  # noqa: PLC0415
    from pytest_pafot.world.protocol import check_fits  # noqa: PLC0415

    try:
        if worlds.is_code(finding.world):
            return worlds.named(finding.world, bench.world)
        world = from_dict(finding.world)
        check_fits(world, finding.scenario)
    except ScenarioError as error:
        raise RequestError(str(located(saved.path, "scenario", error))) from None
    except (WorldError, TypeError, ValueError) as error:
        raise RequestError(str(located(saved.path, "world", error))) from None
    return world


def replay_for_search(bench: Bench, saved: Saved) -> Replayed | None:
    """What a saved scenario shows now, for a search that must know which failures are known.

    None for a file that cannot be used, whose own item says so.
    """
    finding = saved.finding
    if finding is None:
        return None
    owner = node_ids.saved_node_id(bench.item, saved.id)
    try:
        run, verdict = _means(bench, saved, owner)(finding.scenario, world_of(bench, finding, saved), owner)
    except RequestError:
        return None
    except ProcessLostError as error:
        observed = error.lost.expect.signature
        return Replayed(id=saved.id, signature=finding.signature, observed=observed, xfailed=finding.xfail is not None)
    return Replayed.of(finding, run, verdict.failure if verdict.failed else None)


def _means(bench: Bench, saved: Saved, owner: str) -> Tried:
    """How a scenario is run: in another process where one died in it, or hung, or the ADS shall run in no other way."""
    if bench.request.settings.isolate or saved.needs_own_process or left_behind(bench.item, bench.request, owner):
        return partial(tried_apart, bench, saved.path)
    return bench.tried


def _labelled(bench: Bench, finding: Finding, world: Any, tried: Tried) -> tuple[str, Run, Verdict]:
    """The label of a replay. One that passes is tried twice, since chance must not be called a fix.

    Raises:
        ProcessLostError: where the process that ran it did not come back.
    """
    __tracebackhide__ = True
    run, verdict = tried(finding.scenario, world, bench.item.nodeid)
    label: str = replay_label(finding, run, verdict.failure if verdict.failed else None, bench.versions)
    if finding.expect.is_crash:
        label = "drifted" if verdict.failed else "fixed"  # The process lives, whatever the run shows.
    if label == "fixed" and worlds.changes(finding.world, bench.world):
        label = "drifted"  # It passes elsewhere than where it failed.
    if verdict.failed or verdict.discarded:
        return label, run, verdict
    again, second = tried(finding.scenario, world, bench.item.nodeid)
    if second.failed:
        return FLAKY, again, second
    is_firm = finding.flaky is None and is_same_run(run, again)
    return (label if is_firm else FLAKY), run, verdict


def _conclude_lost(bench: Bench, saved: Saved, finding: Finding, lost: Lost) -> NoReturn:
    """Fail for a scenario whose process did not come back."""
    __tracebackhide__ = True
    was_lost = finding.expect.outcome is Outcome.HANG if lost.is_hang else finding.expect.is_crash
    label = "still failing" if was_lost else "drifted"
    detail = "" if was_lost else _detail(bench, finding, f"the process {lost.how}")
    _tell(bench, label, detail)
    headline = f"the process (pid {lost.pid}) that ran this scenario {lost.how}"
    showing = showing_of(bench.item, bench.request.settings)
    if showing is not None:
        showing.lost(finding, headline, label=label, path=bench.relative(saved.path))
    bench.item.add_report_section("call", "pafot", f"replay: {label}{f', {detail}' if detail else ''}")
    pytest.fail(f"{headline}: {cause(lost, 'delete the file')}", pytrace=False)


def _tell(bench: Bench, label: str, detail: str) -> None:
    messages.send(bench.item, "replay", {"label": label, "detail": detail})
    bench.item.user_properties.append(("pafot", label))


def _conclude(bench: Bench, run: Run, verdict: Verdict, label: str, detail: str) -> None:
    __tracebackhide__ = True
    if verdict.failed and verdict.exception is not None:
        bench.item.stash[SUMMARY] = ascii_text(what_happened(run, verdict))
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


def _now(finding: Finding, run: Run) -> str:
    """What happens now, beside what the file tells of the same outcome."""
    return _event(run.outcome, run.event_time) if run.outcome is finding.expect.outcome else ending(run)


def _event(outcome: Outcome, time: float) -> str:
    return f"{outcome}{'' if outcome in HAS_EVENT else ' and most critical'} at {time:.1f} s"


def _detail(bench: Bench, finding: Finding, now: str) -> str:
    """What differs from the file; ``now`` is what happens."""
    versions = bench.versions
    changed = [
        f"{name} {version} then, {versions.get(name, 'none')} now"
        for name, version in sorted(finding.found.versions.items())
        if versions.get(name) != version
    ]
    changed += worlds.changes(finding.world, bench.world)
    then = _event(finding.expect.outcome, finding.expect.time)
    if finding.expect.is_crash:
        then = "the process died"
    event = [] if then == now else [f"{then} in the file, {now} now"]
    return "; ".join([*event, *changed]) or "another run than before"
