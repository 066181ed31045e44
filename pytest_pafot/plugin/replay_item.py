"""The item of a saved scenario: it runs one replay, and passes an exception of the test function on to pytest."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import fields, is_dataclass, replace
from datetime import date
from typing import Any, NoReturn

import pytest

from pytest_pafot.campaign.replays import Replayed, Replays, happened, was_lost
from pytest_pafot.campaign.request import Request
from pytest_pafot.campaign.setup_fault import Cause, SetupFaultError, cause_of
from pytest_pafot.campaign.store import cause
from pytest_pafot.campaign.verdict import headline
from pytest_pafot.corpus.layout import relative
from pytest_pafot.corpus.saved import Saved
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.scenario_pool import LostRun
from pytest_pafot.findings.decisions import deciding, seen_of, vehicle_of
from pytest_pafot.findings.finding import Finding, of_failure, unhandled
from pytest_pafot.findings.labels import Label, Observed, RunLabel
from pytest_pafot.findings.sighting import Sighting
from pytest_pafot.findings.verdict import Verdict
from pytest_pafot.oracle.checks import CheckFailed
from pytest_pafot.oracle.run import Run
from pytest_pafot.plugin import marks, messages
from pytest_pafot.plugin.failure_reports import NOT_ACCEPTED, REPLAYED, explained
from pytest_pafot.plugin.finding_message import send_sighting
from pytest_pafot.plugin.messages import OF_ONE_RUN, set_properties, severity_text
from pytest_pafot.plugin.search_item import harness_of, shown, watch_again
from pytest_pafot.plugin.session import SHARED, is_worker
from pytest_pafot.support.errors import RequestError, flag
from pytest_pafot.support.text import ascii_text, fitted_lines, visible
from pytest_pafot.world.driving.policy import wrapped
from pytest_pafot.world.guard.hang_guard import Around
from pytest_pafot.world.guard.own_worlds import base_world, rollout_of

SET_UP_FAULTS = pytest.StashKey[dict[tuple[str, Cause], str]]()
"""The node id of the item that has explained an error of the set-up, by test and cause."""


def run_replay(item: pytest.Function, request: Request, saved: Saved) -> None:
    """Run the item of a saved scenario; an exception of the test function reaches pytest unchanged."""
    __tracebackhide__ = True
    finding = saved.finding
    if finding is None:
        pytest.fail(saved.error, pytrace=False)
    harness = harness_of(item, request, writes=False)
    today = date.fromisoformat(item.config.stash[SHARED].today)
    replays = Replays(harness=harness, today=today)
    watch_again(item, is_elsewhere=replays.is_apart(saved, item.nodeid))
    if request.settings.debug:
        stop_in_replay(item, replays, saved)
    path, lost = relative(saved.path, harness.root), None
    if NOT_ACCEPTED in item.stash:  # left by the first try of an item that is tried again
        del item.stash[NOT_ACCEPTED]
    try:
        now = replays.labelled(saved, item.nodeid)
    except ProcessLostError as error:
        lost = error
    facts = Observed()
    if lost is not None:  # Outside of the handler, so that pytest does not print the error twice, once as a cause.
        passes = replays.passes_reference(saved, replays.world_of(saved), item.nodeid)
        shows: RunLabel = Label.STILL_FAILING if was_lost(finding, lost) else Label.DRIFTED
        facts = Observed(shows=shows, fails=True, reference_passes=passes)
    for leftover in harness.left_behind(item.nodeid) if lost is not None or not now.is_lost else ():
        leftover.discard()  # The item reports its result now.
    if lost is not None:
        _conclude_lost(item, replays, saved, finding, lost, facts)
    label, run, verdict, note = now.label, now.run, now.verdict, now.note
    _check_set_up(item, replays, saved, run, verdict)
    worse = verdict.worsening if label is Label.COMMON else ""
    # The marker xfail of the item accepts every exception, so the report needs to know which one it must not accept.
    beyond = "" if verdict.failure is None else replays.beyond_acceptance(finding, run, verdict.failure)
    if beyond:
        item.stash[NOT_ACCEPTED] = beyond
    notes = [note, _against(replays), f"worse: {worse}" if worse else ""]
    notes += replays.setting_changes(finding)
    detail = "; ".join(filter(None, notes))
    item.stash[REPLAYED] = True
    if label in (Label.DRIFTED, Label.JUDGED_OTHERWISE, Label.FLAKY):
        missed = unhandled(finding, run) if label is Label.DRIFTED and not verdict.failed else ""
        notes = [missed, replays.changes(finding, happened(finding, run, verdict.failure)), note]
        detail = "; ".join(filter(None, notes))
    line = headline(run, verdict) if verdict.failed else ""
    sighting = _send(item, replays, saved, label, now, headline=line, detail=detail)
    item.stash[OF_ONE_RUN].show(run)  # the last call may have been for the reference
    if finding.xfail is not None and not verdict.failed:
        _explain_pass(item, finding, sighting, path, is_accepted=replays.accepts(finding))
    more = [_beyond(finding, path, beyond)] if beyond else []
    _conclude(item, run, verdict, label, detail, more, is_strict=request.settings.strict_drift)


def _beyond(finding: Finding, path: str, how: str) -> str:
    """Name the failure that a file accepts and the one that came, and say what can be done."""
    return (
        f"not accepted: the line `xfail:` of {path} accepts {visible(finding.expect.brief)}, received {visible(how)}; "
        "correct the policy, or delete the file, search again and accept what is found then"
    )


def _check_set_up(item: pytest.Function, replays: Replays, saved: Saved, run: Run, verdict: Verdict) -> None:
    """Fail the item if the cause of its failure is the set-up. Only the first item of a test explains it."""
    __tracebackhide__ = True
    cause, finding = cause_of(run, verdict), saved.finding
    if cause is None or verdict.failure is None or finding is None:
        return
    if of_failure(run, verdict.failure) == finding.signature:  # the file was saved for it
        return
    key, faults = (marks.base_id(item), cause), item.session.stash.setdefault(SET_UP_FAULTS, {})
    line = ascii_text(headline(run, verdict))
    if key in faults:
        text = f"{line}\nIt is the error of the set-up that {faults[key]} explains."
        error: BaseException = pytest.fail.Exception(text, pytrace=False)
    else:
        try:
            replays.check_set_up(saved, run, verdict, item.nodeid)
            return
        except SetupFaultError as fault:
            faults[key] = item.nodeid
            error = shown(fault.shown(replays.harness.world, replays.harness.policy))
    raise error


def _explain_pass(item: pytest.Function, finding: Finding, sighting: Sighting, path: str, *, is_accepted: bool) -> None:
    """Ask to remove the line ``xfail`` of a file that passes. A flaky file stays accepted: it passes by chance."""
    if sighting.label is not Label.FLAKY:
        _add_section(item, [f"{sighting.result}: remove the line `xfail:` from {path}"])
    elif is_accepted:
        pytest.xfail(f"{visible(finding.xfail or '')}; flaky: it passed this time")


def _conclude_lost(
    item: pytest.Function, replays: Replays, saved: Saved, finding: Finding, lost: LostRun, facts: Observed
) -> NoReturn:
    """Report and fail the replay of a saved scenario whose process died or hung."""
    __tracebackhide__ = True
    beyond = "" if facts.shows is Label.STILL_FAILING or not replays.accepts(finding) else f"a process that {lost.end}"
    if beyond:
        item.stash[NOT_ACCEPTED] = beyond
    note = "; ".join(getattr(lost, "__notes__", ()))
    item.stash[REPLAYED] = True
    label = facts.label
    notes = [_against(replays), *replays.setting_changes(finding)]
    if label is Label.DRIFTED:
        notes = [replays.changes(finding, f"the process {lost.end}")]
    detail = "; ".join(filter(None, [note, *notes]))
    line = f"the process (pid {lost.pid}) that ran this scenario {lost.end}"
    _send(item, replays, saved, label, None, headline=line, detail=detail)
    lines = [f"replay: {label}{f', {detail}' if detail else ''}"]
    _add_section(
        item, [*lines, _beyond(finding, relative(saved.path, replays.harness.root), beyond)] if beyond else lines
    )
    item.stash[OF_ONE_RUN].show(None)
    pytest.fail(f"{line}: {cause(lost, 'delete the file')}", pytrace=False)


def _against(replays: Replays) -> str:
    name = replays.harness.against_name
    return f"against {name}" if name else ""


def _send(
    item: pytest.Function,
    replays: Replays,
    saved: Saved,
    label: Label,
    now: Replayed | None,
    *,
    headline: str,
    detail: str,
) -> Sighting:
    """Report a replay to the controller and return it; ``now`` is None if the process of the replay died or hung."""
    finding, path = saved.finding, relative(saved.path, replays.harness.root)
    if finding is None:
        raise ValueError(f"saved: expected a file that can be read, received {saved!r:.100}")
    verdict = None if now is None else now.verdict
    today = date.fromisoformat(item.config.stash[SHARED].today)
    failure = None if verdict is None else verdict.failure
    reference = None if verdict is None else verdict.reference
    # What differs from the accepted failure is not accepted, see the caller.
    is_accepted = finding.is_accepted(today) and NOT_ACCEPTED not in item.stash
    sighting = Sighting(
        finding=finding,
        node_id=item.nodeid,
        test=marks.base_id(item),
        label=label,
        headline=headline,
        path=path,
        detail=detail,
        severity=None if verdict is None else verdict.severity,
        severity_before=None if reference is None else reference.severity,
        against=replays.harness.against_name,
        is_accepted=is_accepted,
        rate_now=None if now is None else now.rate,
        run=None if now is None else now.run,
        is_first=False,
    )
    if headline:
        set_properties(item.user_properties, severity=severity_text(sighting.severity))
    # The item fails again from that day on, and nobody may remember why it did not before.
    if finding.xfail is not None and not finding.is_accepted(today):
        over = (
            f"{path}: accepted ({finding.accepted}), but that day is over: correct the failure, write a later day, "
            "or remove the line"
        )
        messages.send(item, "warning", {"text": over})
    check = None if failure is None else failure.check
    note = "" if now is None else now.note
    send_sighting(item, replays.harness.request.settings, sighting, check=check, note=note)
    item.user_properties.append(("pafot", sighting.heading))
    set_properties(item.user_properties, detail=detail)
    return sighting


def _add_section(item: pytest.Item, lines: Iterable[str]) -> None:
    item.add_report_section("call", "pafot", "\n".join(fitted_lines(lines, item.config.stash[SHARED].width)))


def _conclude(
    item: pytest.Function,
    run: Run,
    verdict: Verdict,
    label: Label,
    detail: str,
    more: Sequence[str],
    *,
    is_strict: bool,
) -> None:
    """Raise what the result of an item is; ``more`` are more lines for its section if it fails."""
    __tracebackhide__ = True
    if verdict.failed and verdict.exception is not None:
        lines = [f"replay: {label}{f', {detail}' if detail else ''}"]
        if isinstance(verdict.exception, CheckFailed):  # any other exception has the test function's own message
            lines += explained(run, verdict.exception).splitlines()
        lines += more
        _add_section(item, lines)
        raise shown(verdict.exception)
    if verdict.kind == "skipped" and verdict.exception is not None:
        raise verdict.exception
    if label in (Label.DRIFTED, Label.JUDGED_OTHERWISE) and is_strict:
        pytest.fail(
            f"the saved scenario passes, but {label}: {visible(detail)} ({flag('strict_drift')})", pytrace=False
        )
    if verdict.kind == "rejected":
        pytest.skip("the test function rejected the saved scenario with pafot.reject()")
    if verdict.kind == "invalid":
        pytest.skip(f"drifted: two NPCs touched after {run.duration:.1f} s, which says nothing about the ADS")


# The debugger in the decision of a policy that could have avoided a failure, for ``--pafot-debug``.

ANY_TIME = 86_400.0
"""The time that a policy has for a decision in a debugger [s], which is the longest that a world accepts."""


class Stopping(Around):
    """An ADS in one of whose decisions the debugger opens."""

    def __init__(self, ads: Any, number: int, header: str) -> None:
        super().__init__(ads)
        self._left, self._header = number, header

    def __call__(self, observation: Any) -> Any:
        """Decide; at the decision, the debugger stops before the policy is called."""
        self._left -= 1
        if self._left == -1:
            pytest.set_trace(header=self._header)
        return self._ads(observation)


def stop_in_replay(item: pytest.Function, replays: Replays, saved: Saved) -> None:
    """Drive a saved scenario, and again with the debugger open in the decision that could have avoided its failure.

    Raises:
        RequestError: if there is no such decision, or no terminal in which a debugger could run.
    """
    __tracebackhide__ = True
    name, finding = flag("debug"), saved.finding
    if is_worker(item.config):
        raise RequestError(
            f"{name}: expected a session in one process, received a worker of pytest-xdist; leave out -n"
        )
    if finding is None or replays.harness.policy.drives_itself:
        raise RequestError(f"{name}: expected a policy that decides, received a vehicle class, which has no decisions")
    if finding.expect.is_crash:
        raise RequestError(
            f"{name}: expected a policy that drives, received a finding whose process dies; see its output"
        )
    world = replays.world_of(saved)
    given = world.given
    if is_dataclass(given) and "hang_limit" in {each.name for each in fields(given)}:
        world = base_world(replace(given, hang_limit=ANY_TIME))  # type: ignore[type-var]
    run, _ = replays.tried(saved, world, item.nodeid)
    number = deciding(run, finding.expect)
    if number is None:
        raise RequestError(
            f"{name}: expected a run with a decision that could have avoided the failure, received one without: "
            f"{run.explain().partition(chr(10))[0]}; set a breakpoint in the policy instead, and run pytest with --pdb"
        )
    npc = vehicle_of(run, finding.expect)
    where = "" if npc is None else f": NPC {npc} is {seen_of(run.trace, npc, number)}"
    time = run.trace.decision_ticks[number] / run.trace.physics_hz
    header = f"pafot: decision {number} at {time:.1f} s{where}; type s to step into the policy"
    ads = wrapped(replays.harness.policy.factory, lambda ads: Stopping(ads, number, header))
    rollout_of(world)(finding.scenario, ads)
