"""The responses that rules of attribution require of a driver, the actual ones, and what braking would have avoided.

Braking is the proper response to a vehicle ahead (Shalev-Shwartz et al. 2017). The vehicle behind is the *responder*,
the vehicle ahead is the *other*. The other moves as recorded. The responder stays on its recorded path and brakes there
like a *reference*, a driver that responds properly. In each step it moves with the speed at the beginning of the step,
as in the simulation. docs/explanation/verdicts.md has the sources of the numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from pytest_pafot.attribution.manoeuvres import DRIFTING, STANDING_SPEED, stretches
from pytest_pafot.attribution.sentences import BRAKES, Doing, Fact, Phase, What
from pytest_pafot.criticality import RssRules
from pytest_pafot.criticality.measures import Boxes, overlaps, relate
from pytest_pafot.model.trace import SPEED, FloatArray, Trace

Direction = tuple[FloatArray, FloatArray]
"""The cosine and sine of an angle, tick by tick."""

ALONGSIDE = 0.01
"""The speed sideways below which two vehicles stay as far beside each other as they are [m/s]."""
DRAWS_AWAY = 2.0
"""If the vehicle ahead is at least this much faster, no braking is needed to restore the headway [m/s]."""

HORIZON = 12.0
"""The longest time after the impact for which both vehicles are simulated [s]; the calmest braking to a standstill
takes less."""

ALIKE = 0.1
"""A vehicle that was at most this much faster than the reference has responded like the reference [m/s]."""
SPED_UP = 0.3
"""The least gain in speed that counts as speeding up [m/s]."""
HARDEST = 6.0
"""The hardest braking that the rules require of any vehicle [m/s^2], from UN R157, 5.2.5.2."""
MARGIN = 0.2
"""The time at its own speed [s] by which a vehicle that has responded may be ahead of the reference at the impact, if
the vehicle is no faster than the reference."""
NEARLY = 0.5
"""A vehicle has responded to a cut-in if it is at most this much faster than the reference at the impact [m/s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Braking:
    """A driver's response by braking.

    Attributes:
        delay: time from the moment that requires a response until the brakes have acted for one tick [s]. The tick is
            included because time passes in steps here; otherwise braking at the safe distance of RSS could come too
            late.
        deceleration: deceleration after the delay, while the driver is faster than the vehicle ahead or nearer to it
            than the headway [m/s^2].
        perception: first part of the delay, in which the driver may continue to speed up [s].
        headway: headway to the vehicle ahead that the driver restores [s].
        delay_deceleration: that of a driver who already brakes and keeps that braking during the delay [m/s^2].
    """

    delay: float
    deceleration: float
    perception: float = 0.0
    headway: float = 0.0
    delay_deceleration: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Emergency:
    """An emergency, in which calm braking is no longer the proper response.

    Attributes:
        time_to_contact: time to contact at constant speeds below which there is an emergency [s].
        leader_braking: braking of the vehicle ahead above which there is an emergency [m/s^2].
        perception: time for which one of these two criteria must hold before the driver perceives the emergency [s].
        braking: response of the driver until it is no faster than the vehicle ahead.
    """

    time_to_contact: float
    leader_braking: float
    perception: float
    braking: Braking


@dataclass(frozen=True, kw_only=True, eq=False)
class Pursuit:
    """A vehicle, the responder, and the vehicle ahead of it, the other, up to their contact at the end of a run.

    All arrays have the shape [ticks + 1].

    Attributes:
        ahead, right: offset of the other's centre from the responder's, along and across the road [m].
        directions: cosine and sine of the angle to the road, for the responder and for the other.
        speeds: speeds along the road of the responder and of the other [m/s].
        sizes: lengths and widths of the responder and of the other [m].
        hz: ticks per second.
        goes_on: whether the other would continue to brake after the last tick if it brakes at that tick.
    """

    ahead: FloatArray
    right: FloatArray
    directions: tuple[Direction, Direction]
    speeds: tuple[FloatArray, FloatArray]
    sizes: tuple[tuple[float, float], tuple[float, float]]
    hz: int
    goes_on: bool = False

    def avoided_from(
        self, since: int, response: Braking, emergency: Emergency | None = None, spare: float = 0.0
    ) -> int | None:
        """Return the tick from which on a response would have avoided the contact; None if none would have.

        The tick is ``since``, except if the response restores a headway and the responder did respond for a while: then
        it is the last tick, after the response was due, at which the responder was no faster than the other and had
        never been faster than the reference.

        Until the impact, the other moves and the boxes are turned as recorded. After the impact, the other is ahead in
        the same lane and keeps its speed or its braking. The simulation ends when the responder is no faster than the
        other, at most 12 s later. The result is also None if the responder has responded: if it was never faster than
        the reference, or if it was no faster at the impact and hardly further ahead.

        Args:
            since: tick from which on the responder has to respond.
            response: proper response.
            emergency: emergency in which the proper response is harder; None for no such case.
            spare: additional delay with which the response must still avoid the contact [s].
        """
        end = len(self.ahead) - 1
        if since >= end:
            return None
        speeds, lost = self._driven(since, response, emergency)
        recorded = end - since + 1
        is_alike = self.speeds[0][since:] <= speeds[:recorded] + ALIKE
        hardly_faster = self.speeds[0][-1] <= speeds[recorded - 1] + (ALIKE if emergency is None else NEARLY)
        if is_alike.all() or (hardly_faster and lost[recorded - 1] <= MARGIN * self.speeds[0][-1]):
            return None
        answered = slice(since + round(response.delay * self.hz), since + int(is_alike.argmin()))
        no_faster = np.flatnonzero(self.speeds[0][answered] <= self.speeds[1][answered])
        if response.headway > 0 and no_faster.size:
            return self.avoided_from(answered.start + int(no_faster[-1]), response, emergency, spare)
        is_hit = self._is_hit(since, lost)
        if spare > 0 and not is_hit:
            is_hit = self._is_hit(since, self._driven(since, *_later(spare, response, emergency))[1])
        return None if is_hit else since

    def is_avoided_by_braking(self, since: int, rate: float = HARDEST) -> bool:
        """Return whether braking at a rate [m/s^2] to a standstill from a tick on avoids a hit.

        The braking begins with the recorded speed at that tick. If the two move apart sideways at the impact, they go
        on to do so as far as the other drives on, and do not touch any more when the other has left the way.
        """
        hz, end = self.hz, len(self.ahead) - 1
        steps = end - since + math.ceil(max(HORIZON, float(self.speeds[0][since]) / rate) * hz)
        speeds = np.maximum(self.speeds[0][since] - np.arange(steps) * (rate / hz), 0.0)
        until, after = speeds[: end - since], speeds[end - since :]
        lost = np.concatenate(([0.0], np.cumsum(self.speeds[0][since:end] - until) / hz))
        if self._touches(slice(since, end + 1), lost):
            return False
        slowing = max(float(self.speeds[1][end - 1] - self.speeds[1][end]), 0.0) if self.goes_on else 0.0
        other = np.maximum(self.speeds[1][end] - np.arange(len(after)) * slowing, 0.0)
        further = lost[-1] + np.cumsum(other - after) / hz
        is_clear, aside = self._gaps[end] + further > 0, self.right[end] - self.right[end - 1]
        if aside * self.right[end] <= 0 or abs(aside) * hz < DRIFTING:
            # Who would touch with a corner alone may stop alongside the other, just before that.
            stays = abs(aside) * hz < ALONGSIDE
            return bool(is_clear.all()) or (stays and not self._touches(np.full(len(after), end), further))
        beside = np.abs(self.right[end] + aside * np.cumsum(other) / max(other[0], abs(aside) * hz))
        widths = sum(
            length * abs(float(sin[end])) + width * abs(float(cos[end]))
            for (cos, sin), (length, width) in zip(self.directions, self.sizes, strict=True)
        )
        return bool((is_clear | (beside > widths / 2)).all())

    def is_no_further(self, since: int, response: Braking, emergency: Emergency) -> bool:
        """Return whether the responder is no further ahead at the impact than a reference that responds to a tick."""
        end = len(self.ahead) - 1
        return since < end and bool(self._driven(since, response, emergency)[1][end - since] <= 0)

    def gain(self, since: int) -> tuple[int, int] | None:
        """Return the ticks at which the responder's largest gain in speed began and was complete; None without a gain.

        Only speeds since the tick ``since`` count. The gain began at the last tick at which the responder was as slow
        as it had been so far.
        """
        recorded = self.speeds[0][since:]
        if len(recorded) < 2:
            return None
        gained = recorded - np.minimum.accumulate(recorded)
        most = int(gained.argmax())
        return (since + last_slowest(recorded[: most + 1]), since + most) if gained[most] > SPED_UP else None

    def stays_off_unless_faster(self, since: int, nearer: float = math.inf) -> bool:
        """Return whether the responder would not have hit the other if it had not sped up after the tick ``since``.

        Afterwards, the gap must also have sufficed to slow down to the speed of the other; or the gain in speed must
        have brought the responder at least ``nearer`` to it [m]. Otherwise, it only made the impact a little earlier.
        """
        end = len(self.ahead) - 1
        recorded = self.speeds[0][since:]
        held = np.minimum.accumulate(recorded)
        lost = np.concatenate(([0.0], np.cumsum(recorded - held)[:-1] / self.hz))
        if self._touches(slice(since, end + 1), lost):
            return False
        closing = max(float(held[-1] - self.speeds[1][end]), 0.0)
        return bool(lost[-1] >= nearer or self._gaps[-1] + lost[-1] > closing**2 / (2 * HARDEST))

    def last_at_ease(self, since: int, headway: float) -> int:
        """Return the last tick at which the responder was no faster than the other and had a headway [s] to it.

        The tick ``since`` if there is none after it.
        """
        own, other = (speeds[since:] for speeds in self.speeds)
        at_ease = np.flatnonzero((own <= other) & (np.array(self._gaps[since:]) >= headway * own))
        return since + int(at_ease[-1]) if at_ease.size else since

    def _driven(self, since: int, response: Braking, emergency: Emergency | None) -> tuple[FloatArray, FloatArray]:
        """Return the speeds of the reference [m/s], and its distances behind the responder's recorded places [m].

        The reference drives as recorded until its response is due, but does not speed up after it has perceived the
        danger. After the impact, the distances are relative to the other.
        """
        hz, gaps, recorded, other = self.hz, self._gaps[since:], self._lists[0][since:], self._lists[1][since:]
        end, perceives, due = len(recorded) - 1, round(response.perception * hz), round(response.delay * hz)
        alarm = None if emergency is None else Alarm(self, since, emergency)
        slowing = max(other[-2] - other[-1], 0.0) if self.goes_on else 0.0
        speed, leader, back, speeds, lost = recorded[0], other[0], 0.0, [recorded[0]], [0.0]
        for tick in range(end + math.ceil(HORIZON * hz)):
            is_recorded = tick < end
            leader = other[tick] if tick <= end else max(leader - slowing, 0.0)
            if tick >= end and speed <= leader and not (slowing and leader):
                break
            deceleration = response.deceleration if tick + 1 >= due else response.delay_deceleration
            gap = gaps[min(tick, end)] + back
            if alarm is not None and alarm.acts(tick, speed - leader, gap):
                deceleration = alarm.deceleration
            is_near = response.headway > 0 and gap < response.headway * speed and leader < speed + DRAWS_AWAY
            back += ((recorded[tick] if is_recorded else leader) - speed) / hz
            wanted = max(speed - deceleration / hz, 0.0) if speed > leader or is_near else speed
            if is_recorded and tick + 1 < due:
                wanted = recorded[tick + 1] if tick < perceives else min(wanted, recorded[tick + 1])
            speed = wanted
            speeds.append(speed)
            lost.append(back)
        return np.array(speeds), np.array(lost)

    @cached_property
    def _gaps(self) -> list[float]:
        """The gap between the boxes at each tick, as if both pointed along the road [m]."""
        gaps: list[float] = (self.ahead - (self.sizes[0][0] + self.sizes[1][0]) / 2).tolist()
        return gaps

    @cached_property
    def _lists(self) -> tuple[list[float], list[float]]:
        """The speeds as lists, because reading single values of an array is slow."""
        return self.speeds[0].tolist(), self.speeds[1].tolist()

    def _is_hit(self, since: int, lost: FloatArray) -> bool:
        """Return whether the responder touches the other if it is ``lost`` behind its recorded places [m]."""
        recorded = len(self.ahead) - since
        is_hit = self._touches(slice(since, len(self.ahead)), lost[:recorded])
        # After the impact, lost is relative to the other.
        return is_hit or bool((self._gaps[-1] + lost[recorded:] <= 0).any())

    def _touches(self, ticks: slice | npt.NDArray[np.intp], lost: FloatArray) -> bool:
        """Return whether the boxes touch at one of the ticks if the responder is ``lost`` further back [m]."""
        responder, other = self.sizes
        ahead, right = self.ahead[ticks] + lost, self.right[ticks]
        reach = (math.hypot(*responder) + math.hypot(*other)) / 2
        near = (np.abs(ahead) <= reach) & (np.abs(right) <= reach)
        if not near.any():
            return False
        still = np.zeros(int(near.sum()))
        places = (still, still), (ahead[near], right[near])
        boxes = (
            Boxes(
                x=x, y=y, cos=cos[ticks][near], sin=sin[ticks][near], vx=still, vy=still,
                half_length=still + length / 2, half_width=still + width / 2,
            )
            for (x, y), (cos, sin), (length, width) in zip(places, self.directions, self.sizes, strict=True)
        )  # fmt: skip
        return bool(overlaps(relate(*boxes)).any())


def last_slowest(speeds: FloatArray) -> int:
    """Return the last index at which a speed is the lowest so far."""
    return int(np.flatnonzero(speeds == np.minimum.accumulate(speeds))[-1])


def _later(seconds: float, response: Braking, emergency: Emergency | None) -> tuple[Braking, Emergency | None]:
    """Return responses whose brakes act by some seconds later, with the same time of perception."""
    late = None if emergency is None else replace(emergency, braking=_later(seconds, emergency.braking, None)[0])
    return replace(response, delay=response.delay + seconds), late


class Alarm:
    """An alarm that decides at each tick whether a responder brakes for an emergency."""

    def __init__(self, pursuit: Pursuit, since: int, emergency: Emergency) -> None:
        hz = pursuit.hz
        self.deceleration = emergency.braking.deceleration
        self._emergency = emergency
        self._lasting, self._delay = math.ceil(emergency.perception * hz), round(emergency.braking.delay * hz)
        other = pursuit.speeds[1]
        self._brakings = (-np.diff(other, prepend=other[:1])[since:] * hz).tolist()
        self._later = self._brakings[-1] if pursuit.goes_on else 0.0
        self._held, self._from = 0, math.inf

    def acts(self, tick: int, closing: float, gap: float) -> bool:
        """Return whether emergency braking acts in the step after a tick, given closing speed [m/s] and gap [m]."""
        emergency = self._emergency
        is_near = closing > 0 and gap < emergency.time_to_contact * closing
        braking = self._brakings[tick] if tick < len(self._brakings) else self._later
        is_critical = is_near or braking > emergency.leader_braking
        self._held = self._held + 1 if is_critical else 0
        if self._held >= self._lasting:
            self._from = min(self._from, tick - self._held + 1 + self._delay)
        if tick >= self._from and closing <= 0:
            self._from, self._held = math.inf, 0
        return tick + 1 >= self._from


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
