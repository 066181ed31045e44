"""What the rules ask of a driver: distances and responses with their numbers, and what it did instead.

docs/explanation/verdicts.md has the sources.
"""

from __future__ import annotations

import numpy as np

from pytest_pafot.attribution.avoidance import HARDEST, SPED_UP, Braking, Emergency, last_slowest
from pytest_pafot.attribution.needless_braking import braking
from pytest_pafot.attribution.sentences import Fact, What
from pytest_pafot.criticality import RssRules
from pytest_pafot.model.trace import FloatArray, Trace

DISTANCES = RssRules(ego_response=1.0, npc_response=1.0, acceleration=0.0, least_braking=6.0, hardest_braking=8.0)
"""The safe distances of attribution. The usual two seconds behind a leader of equal speed must never be a fault: with
these values they are safe up to 48 m/s (v + v^2 / 48 <= 2 v). Speeding up during the response time, which RSS counts
with, would ask for more than that; a follower that does so has to answer for it through the distance itself. A leader
brakes with at most 8 m/s^2, the hardest that NPCs can; a follower with at least 6 m/s^2, what UN R157 5.2.5.2 takes for
granted of a system that must avoid. Lateral values are the defaults of :class:`~pytest_pafot.criticality.RssRules`."""

FOLLOWING = Braking(delay=1.0, deceleration=HARDEST)
"""The proper response of the one behind in a lane: that of RSS, with the numbers of :data:`DISTANCES`."""

CUT_OFF = Braking(delay=1.4, deceleration=3.0, perception=0.4, headway=1.0)
"""The proper response of one that was cut off, unless it is an emergency: no harsh braking (UN R157, 5.2.3.3), but
what a lane change may ask of others (UN R79, 5.6.4.7: 3 m/s^2, and a second behind). The delay is the careful and
competent driver's (UN R157, annex 4, appendix 3): 0.4 s to perceive the risk, 0.75 s until the brakes act, and half the
time in which they build up."""

EMERGENCY = Emergency(
    time_to_contact=2.0, leader_braking=5.0, perception=0.4, braking=Braking(delay=1.4, deceleration=HARDEST)
)
"""When the one that was cut off has to brake hard: the careful and competent driver's criteria."""

HELD = Braking(delay=0.0, deceleration=HARDEST)
"""What is left to one that brakes already: to go on."""

GIVING_WAY = Braking(delay=0.4, deceleration=3.0)
"""What a lane change may ask of the one behind in the other lane (UN R79, 5.6.4.7)."""
HEADWAY = 1.0
"""What is to be left between the two when the one behind has slowed down, in seconds of the mover's driving [s]."""
BRAKES = 0.5
"""What reasons call braking, at least [m/s^2]."""


def room_to_leave(follower: float, mover: float) -> float:
    """Return the gap that who comes into a lane has to leave to the one behind, by the speeds of both [m]."""
    faster = max(follower - mover, 0.0)
    slowing_down = faster * GIVING_WAY.delay + faster**2 / (2 * GIVING_WAY.deceleration)
    return max(slowing_down + mover * HEADWAY, 0.0)


def answer(trace: Trace, vehicle: int, speeds: FloatArray, since: int, response: Braking = FOLLOWING) -> Fact:
    """Return when a vehicle was due to brake, of what there was to answer since a tick, and what it did.

    Args:
        speeds: of the vehicle at every tick [m/s].
    """
    hz, end = trace.physics_hz, trace.ticks
    due = since + round(response.delay * hz)
    due_s = due / hz if due < end else None
    speed = speeds[since : end + 1]
    lowest = last_slowest(speed)
    low, high, last = float(speed[lowest]), float(speed[lowest:].max()), float(speed[-1])
    if last > low + SPED_UP and last >= high - SPED_UP:  # that came last, whatever it had done before
        return Fact(What.SPED_UP, vehicle, (since + lowest) / hz, due_s=due_s, speed_m_per_s=high)
    slowed = braking(trace, vehicle)[since + 1 : end + 1]
    braked = np.flatnonzero(slowed >= BRAKES)
    if braked.size:
        at, peak = (since + int(braked[0])) / hz, float(slowed.max())
        return Fact(What.BRAKED, vehicle, at, due_s=due_s, braking_m_per_s2=peak)
    return Fact(What.DID_NOT_BRAKE, vehicle, since / hz, due_s=due_s)
