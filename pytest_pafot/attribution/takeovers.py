"""What a careful driver would have done: the latest takeover before an impact that avoids the collision.

The world simulates a run again, and the careful driver of UN R157 takes over the ego shortly before the impact. It
decides whether an ego that ran into a vehicle shares the responsibility, if the rules leave that open.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from pytest_pafot.model.trace import Outcome, Trace

CAREFUL = "careful-human"
"""The driver that takes over: it keeps its lane, and its distance to vehicles ahead (UN R157, annex 4, appendix 3)."""

STEP, WINDOW = 0.25, 3.0
"""The time between two takeovers that are tried, and the longest time before the impact at which one is tried [s]."""
IN_SUCCESSION = 3
"""The number of takeovers in succession that must avoid a collision, so that none avoids it by luck."""
AFTER = 4.0
"""The time after the recorded impact in which the careful driver must touch no vehicle [s]."""

LEEWAY = 2
"""The ticks for which a run lasts longer than it must, because a world may end it a tick earlier than asked."""
ROUNDING = 1e-6
"""The largest difference between the states of a run and of its repetition. They may differ because some environments
compute sines in a different way."""


class TakeOver(Protocol):
    """A function that simulates a run again, with the careful driver in the ego's place from a tick on."""

    def __call__(self, trace: Trace, tick: int, /) -> Trace:
        """Simulate a run again, with the careful driver in the ego's place from a tick on."""

    def lasting(self, seconds: float, /) -> TakeOver:
        """Return the same function for runs that last some seconds."""


def latest(trace: Trace, take_over: TakeOver) -> float | None:
    """Return the latest takeover by the careful driver that avoids the collision of a run [s before the impact].

    The two takeovers before it, a quarter and half a second earlier, avoid it as well. 0 if there is no such takeover.
    None if nothing can be said: without a collision with an NPC, if a repetition of the run differs from the trace, or
    if a drive ends early for another reason and there is no such takeover among the others.
    """
    if trace.collision is None or trace.collision.npc is None:
        return None
    streak, is_known = 0, True
    for number in range(1, round(WINDOW / STEP) + 1):
        avoids: bool | None = True
        if _tick(trace, number * STEP) >= 0:  # nothing had happened before the run
            taken = drive(trace, number * STEP, take_over)
            if taken is None:
                return None
            avoids = _avoids(taken, trace)
        is_known &= avoids is not None
        streak = streak + 1 if avoids else 0
        first = (number + 1 - IN_SUCCESSION) * STEP
        if streak >= IN_SUCCESSION and _tick(trace, first) >= 0:
            return first
    return 0.0 if is_known else None


def drive(trace: Trace, seconds: float, take_over: TakeOver) -> Trace | None:
    """Return the run in which the careful driver takes over some seconds before the impact; None if it is another run.

    It lasts until 4 s after the time of the impact, unless the road ends before.
    """
    tick = _tick(trace, seconds)
    taken = take_over.lasting((_until(trace) + LEEWAY) / trace.physics_hz)(trace, tick)
    repeated, recorded = taken.states[: tick + 1], trace.states[: tick + 1]
    return taken if repeated.shape == recorded.shape and (np.abs(repeated - recorded) <= ROUNDING).all() else None


def sentence(seconds: float) -> str:
    """Return the sentence on a number that :func:`latest` has returned."""
    if not seconds:
        return f"No careful driver who takes over in the last {WINDOW:g} s avoids it reliably."
    return f"A careful driver who takes over {seconds:g} s before the impact at the latest avoids it."


def _tick(trace: Trace, seconds: float) -> int:
    """Return the tick of a takeover; it need not be one of a decision, because the driver decides at every tick."""
    return _impact(trace) - round(seconds * trace.physics_hz)


def _impact(trace: Trace) -> int:
    return trace.ticks if trace.collision is None else trace.collision.tick


def _until(trace: Trace) -> int:
    return _impact(trace) + round(AFTER * trace.physics_hz)


def _avoids(taken: Trace, trace: Trace) -> bool | None:
    """Return whether a drive avoids the collision of a run; None if it ends before that is known.

    The collision of a third vehicle with the rear of the ego ends the drive, but is no failure of its driver.
    """
    hit, then = taken.collision, trace.collision
    is_hit = hit is not None and hit.tick <= _until(trace)
    if hit is not None and is_hit and (then is None or hit.npc == then.npc or hit.side != "rear"):
        return False
    is_cut = taken.outcome in (Outcome.INVALID, Outcome.ADS_ERROR, Outcome.HANG) and taken.ticks < _until(trace)
    return None if is_cut or taken.ticks < _impact(trace) else True
