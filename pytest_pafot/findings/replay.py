"""What the replay of a saved finding means."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np

from pytest_pafot.findings.finding import Expect, Finding, event_of
from pytest_pafot.findings.signature import Failure
from pytest_pafot.findings.situation import BEFORE, missed, seconds_after
from pytest_pafot.model.trace import Outcome, Y
from pytest_pafot.oracle.run import Run

Label = Literal["fixed", "still failing", "drifted"]

SAME_PLACE = 0.5
"""Two runs without contact are the same while no vehicle is further from itself than this [m]."""

SAME_TIME = 0.2
"""Two events are the same when they are no further apart than this [s]."""

HAS_EVENT = frozenset({Outcome.COLLISION, Outcome.ADS_ERROR, Outcome.HANG, Outcome.OFF_ROAD})
"""Outcomes that happen at the time of a run's event. That of any other is its most critical moment, not its end."""


def replay_label(finding: Finding, run: Run, failure: Failure | None, versions: Mapping[str, str]) -> Label:
    """What to call a replay, beside its passing or failing.

    ``still failing``: it fails with the saved event. ``drifted``: what happens is another event than the saved
    one, or it passes under other versions, or without that the situation came up from which the failure arose, so that
    the file may no longer test what it was saved for. ``fixed``: it passes under the same versions, and the situation
    came up. Where a collision that is no failure ends the run, that must be later after the situation than the failure
    was then, and than 2 s, and, of a file of a collision, not with the same NPC; of a file that knows no situation,
    nothing else may have happened instead. A check is told by its name and, where it says one, its time, whatever else
    happened; it is fixed where the run went on past that time. The run is the one of now, with its failure, if any, and
    the versions of today's packages; these are compared where the file names them.
    """
    expect, is_same = finding.expect, is_same_event(finding.expect, run, failure)
    if failure is not None:
        return "still failing" if is_same and failure.kind == expect.failure else "drifted"
    if any(versions.get(name) != version for name, version in finding.found.versions.items()):
        return "drifted"
    # One that was cut short did not drive the rest of the scenario.
    is_whole = run.collision is None and run.ads_error is None and run.outcome not in ("invalid", "off_road")
    is_whole = is_whole or (expect.check is not None and run.duration > expect.time)
    if expect.situation is not None and run.collision is not None:
        after = seconds_after(expect.situation, run)
        is_whole = is_whole or (after is not None and after > max(expect.time - expect.situation.time, BEFORE))
    # Where the same event has another party responsible, the policy has changed and not the test.
    is_same = is_same and (expect.situation is None or run.responsibility == expect.responsibility)
    return "fixed" if is_same or (is_whole and not unhandled(finding, run)) else "drifted"


def unhandled(finding: Finding, run: Run) -> str:
    """Return why a run that passes did not handle the situation of a file; empty where it did, or nobody knows.

    The situation did not come up, or the ego and the NPC of the file collide all the same, which the test lets pass.
    """
    expect, hit = finding.expect, run.collision
    why = missed(expect.situation, run)
    is_about_it = expect.outcome is Outcome.COLLISION and expect.check is None and not finding.signature.is_property
    if why or expect.situation is None or not is_about_it or hit is None or hit.npc != expect.situation.npc:
        return why
    return f"the ego and NPC {hit.npc} collide all the same, after {hit.time:.1f} s, which is no failure of the test"


def is_same_event(expect: Expect, run: Run, failure: Failure | None = None) -> bool:
    """Whether a run shows the event that a file expects: to 0.2 s, and the same contact; or that check failing."""
    now, side = event_of(run, failure), None if run.collision is None else run.collision.side
    is_then = abs(now.time - expect.time) <= SAME_TIME + 1e-9
    if expect.check is None:
        then = (expect.outcome, expect.npc, expect.cell, expect.side)
        return is_then and (run.outcome, now.npc, now.cell, side) == then
    check = None if failure is None else failure.check
    return check is not None and check.name == expect.assertion and (is_then or check.time is None)


def ending(run: Run) -> str:
    """How a run ended: with an event at a time, or after a while in which there was none."""
    if run.outcome in HAS_EVENT:
        return f"{run.outcome} at {run.event_time:.1f} s"
    return f"{run.outcome} {'for' if run.outcome is Outcome.SAFE else 'after'} {run.duration:.1f} s"


def disagreement(first: Run, again: Run) -> str:
    """What differs between two runs of one scenario that were made by different means; empty where they agree.

    They agree when they end in the same way: a collision with the same NPC in the same cell against the same side,
    or none; and at the same time, to 0.2 s, since numpy rounds some functions otherwise than the C library does on
    some processors. Where nobody touched, every vehicle must be within half a metre of the other run's, always.
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
