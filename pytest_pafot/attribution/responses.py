"""The distances and responses that the rules of attribution require of a driver, and the driver's actual response.

docs/explanation/verdicts.md has the sources of the numbers.
"""

from __future__ import annotations

import numpy as np

from pytest_pafot.attribution.avoidance import HARDEST, SPED_UP, Braking, Emergency, last_slowest
from pytest_pafot.attribution.needless_braking import braking
from pytest_pafot.attribution.sentences import Fact, What
from pytest_pafot.criticality import RssRules
from pytest_pafot.model.trace import FloatArray, Trace

DISTANCES = RssRules(ego_response=1.0, npc_response=1.0, acceleration=0.0, least_braking=6.0, hardest_braking=8.0)
"""The safe distances of attribution. The usual headway of two seconds to a leader of equal speed must never be a fault:
with these values it is safe up to 48 m/s (v + v^2 / 48 <= 2 v). RSS also assumes that the follower speeds up during the
response time, which would require more than two seconds. Here that acceleration is 0; a follower that speeds up comes
too close by its own action. A leader brakes with at most 8 m/s^2, the hardest that NPCs can; a follower with at least 6
m/s^2, which UN R157 5.2.5.2 expects of a system that must avoid a collision. Lateral values are the defaults of
:class:`~pytest_pafot.criticality.RssRules`."""

FOLLOWING = Braking(delay=1.0, deceleration=HARDEST)
"""The proper response of the follower in a lane: the response of RSS, with the numbers of :data:`DISTANCES`."""

CUT_OFF = Braking(delay=1.4, deceleration=3.0, perception=0.4, headway=1.0)
"""The proper response of a vehicle in front of which another vehicle has cut in, unless there is an emergency. It need
not brake harshly (UN R157, 5.2.3.3). It brakes with 3 m/s^2 and restores a headway of a second, which a lane change may
require of other vehicles (UN R79, 5.6.4.7). The delay is the careful and competent driver's (UN R157, annex 4,
appendix 3): 0.4 s to perceive the risk, 0.75 s until the brakes act, and half the time in which they build up."""

EMERGENCY = Emergency(
    time_to_contact=2.0, leader_braking=5.0, perception=0.4, braking=Braking(delay=1.4, deceleration=HARDEST)
)
"""The emergency in which a vehicle has to brake hard after a cut-in, by the criteria of the careful and competent
driver in UN R157."""

HELD = Braking(delay=0.0, deceleration=HARDEST)
"""The response of a vehicle that is already braking: it continues to brake hard."""

ALREADY_BRAKING = Braking(delay=0.4, deceleration=HARDEST)
"""The response of a vehicle that already brakes when a danger begins: its foot is on the brake, so it only needs the
time to perceive the danger (UN R157, annex 4, appendix 3)."""
VISIBLY = 1.3
"""The deceleration from which on a vehicle visibly brakes [m/s^2]: its driver has the foot on the brake, and others may
assume that it stops. A smaller deceleration does not require a brake light (UN R13-H, 5.2.22.4)."""

GIVING_WAY = Braking(delay=0.4, deceleration=3.0)
"""The response that a lane change may require of the vehicle behind in the new lane (UN R79, 5.6.4.7)."""
HEADWAY = 1.0
"""The gap that must remain ahead of the vehicle behind after it has slowed down for a lane change, as a time at the
speed of the vehicle that changes lanes [s]."""
BRAKES = 0.5
"""The least deceleration that counts as braking in the sentences of a verdict [m/s^2]."""


def room_to_leave(follower: float, mover: float) -> float:
    """Return the gap that a vehicle has to leave to the vehicle behind when it enters a lane [m].

    ``follower`` is the speed of the vehicle behind and ``mover`` the speed of the vehicle that enters [m/s].
    """
    faster = max(follower - mover, 0.0)
    slowing_down = faster * GIVING_WAY.delay + faster**2 / (2 * GIVING_WAY.deceleration)
    return max(slowing_down + mover * HEADWAY, 0.0)


def answer(trace: Trace, vehicle: int, speeds: FloatArray, since: int, response: Braking = FOLLOWING) -> Fact:
    """Return the fact that tells when a vehicle should have braked, and what the vehicle did instead.

    Args:
        trace: trace of the run.
        vehicle: index of the vehicle; 0 is the ego.
        speeds: speeds of the vehicle at every tick [m/s].
        since: tick from which on the vehicle had to respond to a danger.
        response: proper response, whose delay counts from that tick.
    """
    hz, end = trace.physics_hz, trace.ticks
    due = since + round(response.delay * hz)
    due_s = due / hz if due < end else None
    speed = speeds[since : end + 1]
    lowest = last_slowest(speed)
    low, high, last = float(speed[lowest]), float(speed[lowest:].max()), float(speed[-1])
    if last > low + SPED_UP and last >= high - SPED_UP:  # speeding up counts only if it came last
        return Fact(What.SPED_UP, vehicle, (since + lowest) / hz, due_s=due_s, speed_m_per_s=high)
    slowed = braking(trace, vehicle)[since + 1 : end + 1]
    braked = np.flatnonzero(slowed >= BRAKES)
    if braked.size:
        at, peak = (since + int(braked[0])) / hz, float(slowed.max())
        return Fact(What.BRAKED, vehicle, at, due_s=due_s, braking_m_per_s2=peak)
    return Fact(What.DID_NOT_BRAKE, vehicle, since / hz, due_s=due_s)
