"""The distances and responses that the rules of attribution require of a driver, and the driver's actual response.

docs/explanation/verdicts.md has the sources of the numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from pytest_pafot.attribution.avoidance import HARDEST, Braking, Emergency
from pytest_pafot.attribution.manoeuvres import STANDING_SPEED, stretches
from pytest_pafot.attribution.sentences import BRAKES, Doing, Fact, Phase, What
from pytest_pafot.criticality import RssRules
from pytest_pafot.model.trace import SPEED, FloatArray, Trace

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
LOST = 0.2
"""The least loss of speed without a pause that counts as braking [m/s]; less is a twitch of a controller. In 776 runs
on straight roads, NPCs that kept lane and speed never braked. In 700 on bent roads, they lost less than 0.16 m/s, or
more than 0.2 m/s for a bend, and hardly ever anything between."""
BEFORE = 2.0
"""The time before a danger from which on the sentences tell what a vehicle did [s]."""
NEAR, AT_REST = 0.3, 0.1
"""The largest difference between the recorded speed and the speed that the sentences tell [m/s], and that of a vehicle
that stands, if at most :data:`MOST` phases can tell it."""
MOST = 7
"""The largest number of phases in the sentences."""
EDGE = 0.15
"""The time at both ends of a phase whose braking does not decide whether the phase is told as braking [s], because it
may still be that of the phase before or after."""
MOVES = 2
"""The largest number of changes of lane in the sentences, from the last back."""
LEAST = 0.2
"""The least time for which braking hard has to avoid a collision at each tick, so that the sentences tell its end [s].
Shorter times are those in which two boxes only just miss each other."""
SET_OFF = 2.0
"""The time after setting off within which a vehicle that should have braked should rather have waited [s]."""
FINEST = 400
"""The largest number of points of a speed from which its phases are found."""


def room_to_leave(follower: float, mover: float) -> float:
    """Return the gap that a vehicle has to leave to the vehicle behind when it enters a lane [m].

    ``follower`` is the speed of the vehicle behind and ``mover`` the speed of the vehicle that enters [m/s].
    """
    faster = max(follower - mover, 0.0)
    slowing_down = faster * GIVING_WAY.delay + faster**2 / (2 * GIVING_WAY.deceleration)
    return max(slowing_down + mover * HEADWAY, 0.0)


def brakings(speeds: FloatArray, hz: int) -> list[tuple[int, int]]:
    """Return the tick at which each braking in a vehicle's speeds [m/s] begins, and the tick until which it lasts."""
    found = stretches(-np.diff(speeds) * hz >= BRAKES)
    return [(begin, end) for begin, end in found if speeds[begin] - speeds[end] >= LOST]


def answer(
    trace: Trace,
    vehicle: int,
    since: int,
    avoids: Callable[[int, float], bool] | None,
    response: Braking = FOLLOWING,
    entry: int | None = None,
    danger: int | None = None,
) -> Fact:
    """Return the fact that tells what a vehicle should have done, and what it did instead.

    Args:
        trace: trace of the run.
        vehicle: index of the vehicle; 0 is the ego.
        since: tick from which on the vehicle had to respond to a danger.
        avoids: returns whether braking at a rate [m/s^2] from a tick on, with the recorded speed at that tick, avoids
            the collision; None if only what the vehicle did is to be told.
        response: proper response, whose time of perception counts from that tick.
        entry: tick at which the vehicle entered a zone; None if no zone matters.
        danger: tick at which the danger began, if the vehicle could respond later, too.
    """
    conduct = Conduct(
        trace=trace,
        vehicle=vehicle,
        since=since,
        danger=since if danger is None else min(danger, since),
        perceived=since + round(response.perception * trace.physics_hz),
        deed=trace.ticks if entry is None or entry <= since else entry - math.ceil(trace.physics_hz / 10),
        avoids=avoids,
    )
    return Fact(What.ANSWERED, vehicle, since / trace.physics_hz, unread=conduct)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Conduct:
    """The duty and the deeds of a vehicle in a danger, which are worked out only if somebody reads them.

    Attributes:
        trace: trace of the run, or of the part of it that was judged.
        vehicle: index of the vehicle; 0 is the ego.
        since: tick from which on the vehicle had to respond.
        danger: tick at which the danger began; what the vehicle did is told from a little earlier on.
        perceived: first tick at which the vehicle could have braked.
        deed: tick of the impact, or just before the vehicle entered a zone that it should not have entered.
        avoids: returns whether braking at a rate [m/s^2] from a tick on avoids the collision; None if braking
            was not the duty.
        before: number of ticks of the run before this part.
        whole: trace of the whole run; None if it is the same.
    """

    trace: Trace
    vehicle: int
    since: int
    danger: int
    perceived: int
    deed: int
    avoids: Callable[[int, float], bool] | None
    before: int = 0
    whole: Trace | None = None

    def later(self, trace: Trace, ticks: int) -> Conduct:
        """Return the same conduct in a whole run, of which it knew only the part from a tick on."""
        return replace(self, whole=trace, before=self.before + ticks)

    def in_full(self) -> Fact:
        """Return the fact that tells what the vehicle should have done, and what it did.

        It should have braked by the last tick at which hard braking avoids the collision. If it had set off just
        before, it should have waited. If braking does not help any more, the fact says only what it did.
        """
        hz, before = self.trace.physics_hz, self.before
        whole = self.trace if self.whole is None else self.whole
        speeds = whole.states[: before + self.trace.ticks + 1, self.vehicle, SPEED]
        begin = max(before + self.danger - round(BEFORE * hz), 0)
        phases = phases_of(speeds, hz, begin)
        lanes = whole.road.numbers(self.vehicle)[begin : len(speeds)]
        changes = np.flatnonzero((np.diff(lanes) != 0) & (lanes[1:] >= 0))
        moves = tuple(((begin + int(tick) + 1) / hz, int(lanes[tick + 1])) for tick in changes[-MOVES:])
        has_braked = bool(brakings(speeds[begin:], hz))
        fact = Fact(What.DROVE, self.vehicle, (before + self.since) / hz, has_braked=has_braked)
        fact = fact._replace(phases=phases, moves=moves)
        if self.avoids is None:
            return fact
        tick, lasting = self.deed, 0  # from the end, since each tick takes long, and the last that helps is near it
        while lasting < LEAST * hz and tick > self.perceived:
            tick -= 1
            lasting = lasting + 1 if self.avoids(tick, HARDEST) else 0
        helps = lasting >= LEAST * hz
        due = before + (tick + lasting if helps else self.deed) - 1
        recent = speeds[max(due - round(SET_OFF * hz), 0) : due + 1]
        stood = np.flatnonzero(recent <= min(recent.min(), STANDING_SPEED))
        if stood.size and speeds[due + 1] > recent[stood[-1]]:
            set_off = due - len(recent) + 1 + int(stood[-1])
            return fact._replace(what=What.SHOULD_HAVE_WAITED, due_s=due / hz, later_s=set_off / hz)
        if not helps:
            return fact
        braking = float(speeds[due] - speeds[due + 1]) * hz
        return fact._replace(what=What.SHOULD_HAVE_BRAKED, due_s=due / hz, braking_m_per_s2=max(0.0, braking))


def phases_of(speeds: FloatArray, hz: int, begin: int) -> tuple[Phase, ...]:
    """Return the phases of a vehicle's speed from a tick on: the fewest straight lines that come near to it.

    Of all lines from a recorded speed to a later one, the phases are those with the least sum of squared errors; their
    number is the least with which no speed [m/s] is further than :data:`NEAR` from them, but at most :data:`MOST`.
    """
    last = len(speeds) - 1
    step = max(math.ceil((last - begin) / FINEST), 1)
    ticks = np.append(np.arange(begin, last, step), last)
    speed, at = speeds[ticks], np.arange(len(ticks), dtype=float)
    if len(ticks) < 2:
        return ()
    # the error of a line between any two points, from the sums of the values before each point
    sums = [
        np.concatenate(([0.0], np.cumsum(part))) for part in (np.ones_like(at), at, at**2, speed, at * speed, speed**2)
    ]
    n, t, tt, v, tv, vv = (part[None, 1:] - part[:-1, None] for part in sums)
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = (speed[None, :] - speed[:, None]) / (at[None, :] - at[:, None])
    offset = speed[:, None] - slope * at[:, None]
    error = vv - 2 * slope * tv - 2 * offset * v + slope**2 * tt + 2 * slope * offset * t + offset**2 * n
    error[np.tril_indices(len(at))] = np.inf
    # the best corners for one line more, until they are near enough
    least, corners = error[0], [np.zeros(len(at), dtype=int)]
    for number in range(1, MOST + 1):
        found = [len(at) - 1]
        for back in reversed(corners):
            found.append(int(back[found[-1]]))
        found.reverse()
        far = np.abs(np.interp(at, found, speed[found]) - speed)
        if number == MOST or (far <= np.where(speed <= STANDING_SPEED, AT_REST, NEAR)).all():
            break
        through = least[:, None] + error
        corners.append(through.argmin(axis=0))
        least = through.min(axis=0)
    phases: list[Phase] = []
    for first, last in pairwise(ticks[sorted({*found})]):
        phase = _phase(speeds, hz, int(first), int(last), step)
        if phases and phase.doing is phases[-1].doing is Doing.STOOD:
            phase = phase._replace(time_s=phases.pop().time_s)
        phases.append(phase)
    return tuple(phases)


def _phase(speeds: FloatArray, hz: int, first: int, last: int, step: int) -> Phase:
    """Return the phase between two ticks, which are exact to a number of ticks."""
    lost, seconds = float(speeds[first] - speeds[last]), (last - first) / hz
    slowed = -np.diff(speeds[first : last + 1]) * hz
    edge = max(step if step > 1 else 0, math.ceil(EDGE * hz) if seconds > 5 * EDGE else 0)
    inner = slowed[edge : len(slowed) - edge] if len(slowed) > 2 * edge else slowed
    doing = Doing.KEPT
    if max(speeds[first], speeds[last]) <= STANDING_SPEED:
        doing = Doing.STOOD
    elif lost >= NEAR or lost / seconds >= BRAKES:
        doing = Doing.BRAKED if inner.max() >= BRAKES else Doing.SLOWED
    elif -lost >= NEAR or -lost / seconds >= BRAKES:
        doing = Doing.SPED_UP
    hardest = max(0.0, float(slowed.max()))  # also at the edges: it is told as what happened in this time
    before, after = (max(0.0, float(speeds[tick])) for tick in (first, last))  # some vehicles roll back a little
    return Phase(doing, first / hz, last / hz, before, after, hardest)
