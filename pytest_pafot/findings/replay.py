"""The meaning of a replay: whether a saved finding is fixed, still fails or has drifted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np

from pytest_pafot.findings.finding import Expect, Finding, event_of, of_failure
from pytest_pafot.findings.signature import Failure
from pytest_pafot.findings.situation import BEFORE, missed, seconds_after
from pytest_pafot.model.trace import Outcome, Y
from pytest_pafot.oracle.run import Run

Label = Literal["fixed", "still failing", "drifted"]

SAME_PLACE = 0.5
"""Largest distance [m] between the positions of a vehicle in two runs without contact that count as the same run."""

SAME_TIME = 0.2
"""Largest difference between the times of two events that count as the same event [s]."""

DRIVEN_ON = 10.0
"""The time for which a replay that passes is driven on after the end of its file's run [s].

A file ends shortly after its failure, so a policy that only drives more slowly passes before it makes the same mistake.
"""

HAS_EVENT = frozenset({Outcome.COLLISION, Outcome.ADS_ERROR, Outcome.HANG, Outcome.OFF_ROAD})
"""Outcomes that have a time, which is the run's event. For any other outcome the event is the most critical moment."""


def replay_label(finding: Finding, run: Run, failure: Failure | None, versions: Mapping[str, str]) -> Label:
    """Return the label of a replay, which says more than that the replay passes or fails.

    ``still failing``: the run fails with the saved event.

    ``drifted``: something other than the saved event happens, or the run passes under different versions, or it passes
    without the situation from which the failure arose. The file may then no longer test what it was saved for.

    ``fixed``: the run passes under the same versions, and the situation came up. If a collision that is no failure ends
    the run, it must occur more than 2 s after the situation, and later after it than the saved failure did. For a file
    about a collision, it must also be with a different NPC. For a file without a situation, no other event may end the
    run.

    A failed check is identified by its name and by its time if it has a time, whatever else happened. It is fixed if
    the run continued beyond that time.

    Args:
        finding: the saved finding.
        run: the run of the replay.
        failure: the failure of this run; None if it passes.
        versions: versions of the installed packages, which are compared with the versions in the file.
    """
    expect, is_same = finding.expect, is_same_event(finding.expect, run, failure)
    if failure is not None:
        return "still failing" if is_same and failure.kind == expect.failure else "drifted"
    if any(versions.get(name) != version for name, version in finding.found.versions.items()):
        return "drifted"
    # A run that was cut short did not drive the rest of the scenario.
    is_whole = run.collision is None and run.ads_error is None and run.outcome not in ("invalid", "off_road")
    is_whole = is_whole or (expect.check is not None and run.duration > expect.time)
    if expect.situation is not None and run.collision is not None:
        after = seconds_after(expect.situation, run)
        is_whole = is_whole or (after is not None and after > max(expect.time - expect.situation.time, BEFORE))
    # If a different party is responsible for the same event, the policy has changed and not the test.
    is_same = is_same and (expect.situation is None or run.responsibility == expect.responsibility)
    return "fixed" if is_same or (is_whole and not unhandled(finding, run)) else "drifted"


def unhandled(finding: Finding, run: Run) -> str:
    """Return why a passing run did not handle the situation of a file; empty if it handled it, or if that is unknown.

    Either the situation did not come up, or the ego still collides with the file's NPC and the test accepts that.
    """
    expect, hit = finding.expect, run.collision
    why = missed(expect.situation, run)
    is_about_it = expect.outcome is Outcome.COLLISION and expect.check is None and not finding.signature.is_property
    if why or expect.situation is None or not is_about_it or hit is None or hit.npc != expect.situation.npc:
        return why
    return f"the ego and NPC {hit.npc} still collide, after {hit.time:.1f} s, but the test accepts that"


def is_same_event(expect: Expect, run: Run, failure: Failure | None = None) -> bool:
    """Return whether a run shows the event that a file expects, within 0.2 s: the same contact or failed check."""
    now, side = event_of(run, failure), None if run.collision is None else run.collision.side
    is_then = abs(now.time - expect.time) <= SAME_TIME + 1e-9
    if expect.check is None:
        then = (expect.outcome, expect.npc, expect.cell, expect.side)
        return is_then and (run.outcome, now.npc, now.cell, side) == then
    check = None if failure is None else failure.check
    return check is not None and check.name == expect.assertion and (is_then or check.time is None)


def is_same_failure(finding: Finding, run: Run, failure: Failure) -> bool:
    """Return whether a run fails as a file says, at whatever time: by the same mistake, or in the same check."""
    then, now = finding.signature, of_failure(run, failure)
    if then.fault is not None and then.mistake is None:  # an older file, which does not store it
        return now.fault == then.fault and now == replace(then, mistake=now.mistake)
    return now == then


def has_time(run: Run, failure: Failure) -> bool:
    """Return whether a failure occurs at a time, so that it can be judged in a run that is driven on.

    A check without a time and an assertion on a measure may be about the whole run, such as a distance, which grows
    with the run.
    """
    check = failure.check
    return not of_failure(run, failure).is_property if check is None else check.time is not None


def ending(run: Run) -> str:
    """Describe how a run ended: with an event at a time, or without an event after a duration."""
    if run.outcome in HAS_EVENT:
        return f"{run.outcome} at {run.event_time:.1f} s"
    return f"{run.outcome} {'for' if run.outcome is Outcome.SAFE else 'after'} {run.duration:.1f} s"


def disagreement(first: Run, again: Run) -> str:
    """Describe how two runs of one scenario differ, such as from two simulators; empty if they agree.

    Two runs agree if both end with a collision with the same NPC in the same cell against the same side, or both
    without a collision. The times of their ends may differ by 0.2 s, because numpy and the C library round some
    functions differently on some processors. Without contact, no vehicle's positions in the two runs may ever be more
    than half a metre apart along x or y.
    """
    if first.outcome != again.outcome:
        return f"{ending(first)}, then {ending(again)}"
    if first.collision is not None and again.collision is not None:
        one, other = first.collision, again.collision
        is_same = (one.npc, one.side, one.cell) == (other.npc, other.side, other.cell)
        return "" if is_same and abs(one.time - other.time) <= SAME_TIME + 1e-9 else f"{one!r}, then {other!r}"
    if abs(first.duration - again.duration) > SAME_TIME + 1e-9:
        return f"{first.outcome} after {first.duration:.1f} s, then after {again.duration:.1f} s"
    ticks = min(len(first.trace.states), len(again.trace.states))
    apart = np.abs(first.trace.states[:ticks, :, : Y + 1] - again.trace.states[:ticks, :, : Y + 1]).max(axis=(1, 2))
    if apart.max() <= SAME_PLACE:
        return ""
    tick = int(np.argmax(apart > SAME_PLACE))
    return f"positions differ by more than {SAME_PLACE:g} m from {tick / first.trace.physics_hz:.1f} s on"
