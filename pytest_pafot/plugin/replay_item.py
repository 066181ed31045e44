"""The item for a saved scenario, which runs one replay."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, assert_never

import pytest

from pytest_pafot.corpus.layout import relative
from pytest_pafot.corpus.reader import Saved
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.findings.decisions import deciding, seen_of, vehicle_of
from pytest_pafot.findings.finding import SAME_TIME, Finding, is_same_failure, unhandled
from pytest_pafot.findings.sighting import Beyond, Died, Finished, Replay, Seen, label
from pytest_pafot.findings.verdict import Verdict, worsening
from pytest_pafot.oracle.run import Run
from pytest_pafot.plugin.collection import base_id
from pytest_pafot.plugin.item import (
    NOT_ACCEPTED,
    OF_ONE_RUN,
    REPLAYED,
    exception_for_pytest,
    harness_of,
    send,
    send_seen,
    set_properties,
    watch_again,
)
from pytest_pafot.plugin.session import SHARED, is_worker
from pytest_pafot.searches.events import Note
from pytest_pafot.searches.harness import Cause, Harness, SetupFaultError, cause_of, headline
from pytest_pafot.searches.replays import (
    Replays,
    changes,
    check_set_up,
    describe_result,
    event_change,
    note_on,
    setting_changes,
)
from pytest_pafot.searches.request import Request
from pytest_pafot.searches.results import cause_of_death
from pytest_pafot.support.errors import RequestError, flag
from pytest_pafot.support.text import ascii_text, fitted_lines, visible
from pytest_pafot.world.driving.policy import wrap_ads
from pytest_pafot.world.guard.chance import GENERATORS
from pytest_pafot.world.guard.hang_guard import Around

SET_UP_FAULTS = pytest.StashKey[dict[tuple[str, Cause], str]]()
"""The node ids of items that have explained an error in the set-up, by test and cause."""


def run_replay(item: pytest.Function, request: Request, saved: Saved) -> None:
    """Run the item for a saved scenario. An exception from the test function reaches pytest unchanged."""
    __tracebackhide__ = True
    finding = saved.finding
    if finding is None:
        pytest.fail(saved.error, pytrace=False)
    harness = harness_of(item, request, writes=False)
    replays = Replays(harness=harness, today=item.config.stash[SHARED].day)
    watch_again(item, is_elsewhere=replays.is_apart(saved, item.nodeid))
    if request.settings.debug:
        stop_in_replay(item, replays, saved)
    if NOT_ACCEPTED in item.stash:  # left by an earlier attempt, if another plugin reruns the item
        del item.stash[NOT_ACCEPTED]
    # Run the scenario, and evaluate the run with the test function.
    now = replays.observed(saved, item.nodeid)
    if not now.keeps_record:
        for leftover in harness.left_behind(item.nodeid):
            leftover.discard()  # The item reports its result now.
    match now.ran:
        case Died(end=end, pid=pid):
            happening = f"the process {end}"
            line = f"the process (pid {pid}) that ran this scenario {end}"
        case Finished(run=run, verdict=verdict):
            if why := run.trace.users_error_text:
                text = f"the replay cannot show whether the policy drives well: {visible(why)}"
                pytest.fail(text, pytrace=False)
            _check_set_up(item, replays, saved, run, verdict)
            happening = describe_result(finding, run, verdict.failure)
            line = ""
            if verdict.failed:
                line = headline(run, verdict)
        case _:
            assert_never(now.ran)
    # The mark xfail of the item accepts every exception, so the report must know that this one is not accepted.
    if isinstance(now.acceptance, Beyond):
        item.stash[NOT_ACCEPTED] = now.acceptance.why
    detail = _detail(harness, finding, now, happening)
    item.stash[REPLAYED] = True
    # The controller is informed before the item can end with an exception.
    sighting = Seen(
        finding=finding,
        node_id=item.nodeid,
        test=base_id(item),
        observed=now,
        headline=line,
        path=relative(saved.path, harness.root),
        detail=detail,
    )
    _send(item, harness, sighting)
    item.stash[OF_ONE_RUN].show(sighting.run)  # the last call may have evaluated the reference
    if finding.xfail is not None and not now.fails:
        # A flaky scenario stays accepted, because it may have passed by chance.
        if not now.is_unsteady:
            advice = f"Remove the line `xfail:` from {sighting.path}"
            text = f"It did not fail ({sighting.label}). {advice}"
            lines = fitted_lines([text], item.config.stash[SHARED].width)
            item.add_report_section("call", "pafot", "\n".join(lines))
        elif now.acceptance == "accepted":
            pytest.xfail(f"{visible(finding.xfail)}; flaky: it passed this time")
    match now.ran:
        case Died() as died:
            pytest.fail(f"{line}: {cause_of_death(died, 'delete the file')}", pytrace=False)
        case Finished(verdict=Verdict(exception=BaseException() as raised)) if now.fails:
            raise exception_for_pytest(raised)
        case Finished(run=run, verdict=verdict):
            is_strict = request.settings.strict_drift
            _conclude_pass(run, verdict, sighting.label, detail, is_strict=is_strict)


def _detail(harness: Harness, finding: Finding, now: Replay, happening: str) -> str:
    """Describe the differences between a replay and the file, and the reference's result."""
    notes: list[str] = []
    if now.reference_passes is not None:
        how = "passes" if now.reference_passes else "fails"
        notes.append(f"the reference {now.against} {how}")
    elif now.against:
        notes.append(f"compared with {now.against}")
    note = note_on(finding, now)
    if now.is_unsteady or (now.fails and not now.is_same) or label(now) == "drifted":
        notes = [changes(harness, finding, happening), *notes, note]
        # A pass shows a fix only if the saved situation occurred.
        if isinstance(now.ran, Finished) and not now.fails and not now.is_unsteady:
            notes.insert(0, unhandled(finding, now.ran.run))
        return "; ".join(filter(None, notes))
    worse = worsening(now.shown.severity, now.before)
    if worse and now.fails and now.reference_passes is False:
        notes.append(f"it became worse: it {worse}")
    # A collision with the same vehicle is the same failure at any time, so the note states the new time.
    is_first = now.fails and not now.is_later and now.rate is None
    match now.ran:
        case Finished(run=run) if (
            is_first and abs(run.event_time - finding.expect.time) > SAME_TIME
        ):
            notes.append(event_change(finding, happening))
    return "; ".join(filter(None, [note, *notes, *setting_changes(harness, finding)]))


def _check_set_up(
    item: pytest.Function, replays: Replays, saved: Saved, run: Run, verdict: Verdict
) -> None:
    """Fail the item if an error in the set-up causes its failure. Only a test's first such item explains the error."""
    __tracebackhide__ = True
    cause, finding = cause_of(run, verdict), saved.finding
    if cause is None or verdict.failure is None or finding is None:
        return
    if is_same_failure(finding, run, verdict.failure):  # this is the saved failure
        return
    faults = item.session.stash.setdefault(SET_UP_FAULTS, {})
    key = (base_id(item), cause)
    if key in faults:
        line = ascii_text(headline(run, verdict))
        text = f"{line}\nThe cause is an error in the set-up. See the failure of {faults[key]}."
        pytest.fail(text, pytrace=False)
    error: BaseException | None = None
    try:
        isolate = replays.is_apart(saved, item.nodeid)
        check_set_up(replays.harness, run, verdict, owner=item.nodeid, isolate=isolate)
    except SetupFaultError as fault:
        faults[key] = item.nodeid
        error = exception_for_pytest(fault.shown(replays.harness.world, replays.harness.policy))
    if error is not None:  # outside of the handler, so that it has no context
        raise error


def _send(item: pytest.Function, harness: Harness, sighting: Seen) -> None:
    """Send a replay to the controller, and add its facts to the item's properties."""
    finding, now = sighting.finding, sighting.replay
    if sighting.headline:
        set_properties(item.user_properties, severity=sighting.severity or "none")
    # After the last day, the item fails again. The warning reminds the user of the reason.
    if finding.xfail is not None and now.acceptance == "not accepted":
        over = (
            f"{sighting.path}: the failure is no longer accepted ({finding.accepted}). Correct the policy, "
            "write a later day, or remove the line `xfail:`"
        )
        send(item, Note(over, "warning"))
    check = None
    if isinstance(now.ran, Finished) and now.ran.verdict.failure is not None:
        check = now.ran.verdict.failure.check
    settings, note = harness.request.settings, note_on(finding, now)
    send_seen(item, settings, sighting, check=check, note=note)
    item.user_properties.append(("pafot", sighting.label))
    set_properties(item.user_properties, detail=sighting.detail)


def _conclude_pass(run: Run, verdict: Verdict, label: str, detail: str, *, is_strict: bool) -> None:
    """End a replay that did not fail, possibly with an exception such as a skip."""
    __tracebackhide__ = True
    if verdict.kind == "skipped" and verdict.exception is not None:
        raise verdict.exception
    if verdict.kind == "rejected":
        pytest.skip("the test function rejected the saved scenario with pafot.reject()")
    if label == "drifted" and is_strict:
        text = f"the saved scenario passes, but its run drifted, and {flag('strict_drift')} is set: {visible(detail)}"
        pytest.fail(text, pytrace=False)
    if verdict.kind == "invalid":
        end = f"two NPCs collided after {run.duration:.1f} s"
        pytest.skip(f"drifted: {end}, so the policy was not tested")


# The debugger in the decision of a policy that could have avoided a failure, for ``--pafot-debug``.

ANY_TIME = 86_400.0
"""The time limit [s] for a decision in a debugger: the longest that a world allows."""


class Stopping(Around):
    """A wrapper that stops in a debugger before one of the policy's decisions."""

    def __init__(self, ads: Any, number: int, header: str) -> None:
        super().__init__(ads)
        self._left, self._header = number, header

    def __call__(self, observation: Any) -> Any:
        self._left -= 1
        if self._left == -1:
            pytest.set_trace(header=self._header)
        return self._ads(observation)


def stop_in_replay(item: pytest.Function, replays: Replays, saved: Saved) -> None:
    """Run a saved scenario twice, and start the debugger in the decision that could have avoided the failure.

    If the scenario passes, no debugger starts, and the summary has a note.

    Raises:
        RequestError: if there is no such decision, or no terminal for a debugger.
    """
    __tracebackhide__ = True
    name, finding = flag("debug"), saved.finding
    if is_worker(item.config):
        raise RequestError(
            f"{name}: expected a session in one process, received a worker of pytest-xdist. Remove -n"
        )
    if finding is None or replays.harness.policy.drives_itself:
        raise RequestError(
            f"{name}: expected a policy that decides, received a vehicle class without decisions"
        )
    if finding.expect.is_crash:
        raise RequestError(
            f"{name}: expected a policy that survives this scenario, but its process dies. See its output"
        )
    world = replace(replays.world_of(saved), hang_limit=ANY_TIME)  # type: ignore[type-var]
    # The first run finds the decision. The second one stops there, without a time limit.
    ended = replays.tried(saved, world, item.nodeid)
    if isinstance(ended, Died):
        raise ProcessLostError(
            finding.scenario, pid=ended.pid, how=ended.end, is_hang=ended.is_hang
        )
    if not ended.verdict.failed:
        why = f"because the saved scenario {saved.id} passes"
        send(item, Note(f"{name} did not start a debugger, {why}"))
        return
    run = ended.run
    number = deciding(run, finding.expect)
    if number is None:
        first, _, _ = run.explain().partition("\n")
        raise RequestError(
            f"{name}: no decision in this run could have avoided the failure: {first}. "
            "Set a breakpoint in the policy instead, and run pytest with --pdb"
        )
    time = run.trace.decision_ticks[number] / run.trace.physics_hz
    header = f"pafot: decision {number} at {time:.1f} s"
    npc = vehicle_of(run, finding.expect)
    if npc is not None:
        header += f": NPC {npc} is {seen_of(run.trace, npc, number)}"
    header += ". Type s to step into the policy"
    factory = replays.harness.policy.factory
    ads = wrap_ads(factory, lambda ads: Stopping(ads, number, header))
    GENERATORS.run(world.rollout, finding.scenario, ads)
