"""The latest takeover by a careful driver that avoids a collision."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from pytest_pafot.model.trace import Outcome, Trace

# The name of the careful driver, who keeps the lane and the distance to vehicles ahead (UN R157, annex 4, appendix 3).
CAREFUL = "careful-human"

# The time between two attempted takeovers, and the largest time from a takeover to the impact [s].
STEP = 0.25
WINDOW = 3.0
# This many takeovers in a row must avoid the collision, so that a single success by chance does not count.
IN_SUCCESSION = 3
# The careful driver must not touch any vehicle for this time after the recorded impact [s].
AFTER = 4.0

# A world may end a run one tick earlier than requested, so runs are longer by this many ticks.
LEEWAY = 2
# The largest difference between the states of a run and its repetition. Some environments compute sines differently.
ROUNDING = 1e-6


class TakeOver(Protocol):
    """A function that repeats a run with a careful driver who takes over at a tick."""

    def __call__(self, trace: Trace, tick: int, /) -> Trace:
        """Simulate the run with a careful driver who takes over at this tick."""

    def lasting(self, seconds: float, /) -> TakeOver:
        """Return the same function for runs with this duration [s]."""


def latest(trace: Trace, take_over: TakeOver) -> float | None:
    """Return the latest takeover that avoids a collision [s before the impact].

    Return 0 if no takeover avoids it, and None if this is unknown.
    """
    if trace.collision is None or trace.collision.npc is None:
        return None
    # Try later takeovers first, until IN_SUCCESSION of them, each a STEP earlier than the last, avoid the collision.
    streak = 0
    is_known = True
    for number in range(1, round(WINDOW / STEP) + 1):
        avoids: bool | None = True
        # before the start of the run, a takeover needs no simulation
        if _tick(trace, number * STEP) >= 0:
            taken = drive(trace, number * STEP, take_over)
            if taken is None:
                return None
            avoids = _avoids(taken, trace)
        is_known &= avoids is not None
        streak += 1
        if not avoids:
            streak = 0
        first = (number + 1 - IN_SUCCESSION) * STEP
        if streak >= IN_SUCCESSION and _tick(trace, first) >= 0:
            return first
    if is_known:
        return 0.0
    return None


def drive(trace: Trace, seconds: float, take_over: TakeOver) -> Trace | None:
    """Return the run in which the careful driver takes over, or None if it starts differently from the recorded run."""
    tick = _tick(trace, seconds)
    # The run must not end before it is known that the driver touches no vehicle.
    duration = (_until(trace) + LEEWAY) / trace.physics_hz
    taken = take_over.lasting(duration)(trace, tick)
    repeated = taken.states[: tick + 1]
    recorded = trace.states[: tick + 1]
    if repeated.shape != recorded.shape:
        return None
    if (np.abs(repeated - recorded) <= ROUNDING).all():
        return taken
    return None


def sentence(seconds: float) -> str:
    """Return the sentence that states a result of :func:`latest`."""
    if not seconds:
        return (
            f"A careful driver who took control in the last {WINDOW:g} s could not reliably "
            "have avoided the collision."
        )
    return (
        f"A careful driver who took control {seconds:g} s before the impact would have avoided it."
    )


def _tick(trace: Trace, seconds: float) -> int:
    return _impact(trace) - round(seconds * trace.physics_hz)


def _impact(trace: Trace) -> int:
    if trace.collision is None:
        return trace.ticks
    return trace.collision.tick


def _until(trace: Trace) -> int:
    return _impact(trace) + round(AFTER * trace.physics_hz)


def _avoids(taken: Trace, trace: Trace) -> bool | None:
    # None if the run ended too early. If a third vehicle hits the ego's rear, the careful driver is not at fault.
    hit = taken.collision
    recorded = trace.collision
    if hit is not None and hit.tick > _until(trace):
        hit = None
    if hit and (recorded is None or hit.npc == recorded.npc or hit.side != "rear"):
        return False
    is_cut = taken.outcome in (Outcome.INVALID, Outcome.ADS_ERROR, Outcome.HANG)
    if taken.ticks < _impact(trace) or (is_cut and taken.ticks < _until(trace)):
        return None
    return True
