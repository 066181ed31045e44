"""The distances and responses that the rules of attribution require of a driver, and the driver's actual response.

docs/explanation/verdicts.md has the sources of the numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pytest_pafot.attribution.avoidance import HARDEST, SPED_UP, Braking, Emergency
from pytest_pafot.attribution.lane_changes import stretches
from pytest_pafot.attribution.needless_braking import STANDING_SPEED
from pytest_pafot.attribution.sentences import BEGUN, BRAKING, RISING, Doing, Fact, Phase, What
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
BRAKES = 0.5
"""The least deceleration that counts as braking in the sentences of a verdict [m/s^2]."""
PAUSE = 0.4
"""Brakings with a shorter pause between them are one in the sentences of a verdict [s]."""
COASTED = 1.0
"""The time without braking that is told even if the vehicle then sped up; the time before a danger in which a clear
braking may end that belongs to it; and the least duration of a gentle end of a braking that is told although the
vehicle then released the brakes [s]."""
LOST = 0.2
"""The least loss of speed that counts as braking in the sentences of a verdict [m/s]."""
HARDLY = 0.05
"""The difference from the hardest required braking that rounding hides [m/s^2]."""
HARD, EASED = 0.5, 0.75
"""The shares of the hardest deceleration of a braking at which its hard part begins, and below which it ends."""
STEADY = 0.3
"""The least duration of a gentle part of a braking that is told apart from its hard part [s]."""
ROSE = 0.1
"""The gain from which on a speed has begun to rise [m/s]."""
LULL, CLEARLY = 0.5, 0.7
"""The least time of a lull between two hard parts of a braking [s], and the share of the braking before and after it
below which it lies; and the share of the hardest braking of a phase below which the first half second of the phase
lies, on average, if the time of the hardest braking is told."""
CREEPING = 2.0
"""The speed up to which a vehicle only creeps, so that its mistake may be to speed up [m/s]."""
CLEAR = 1.0
"""The least change of speed in between that separates two brakings, however short the pause, and for which a vehicle
braked, or sped up, again and again [m/s]."""
MOST = 3
EARLIER = 2
"""The largest number of phases that are told of a vehicle's response, and of those before braking was due besides."""


def room_to_leave(follower: float, mover: float) -> float:
    """Return the gap that a vehicle has to leave to the vehicle behind when it enters a lane [m].

    ``follower`` is the speed of the vehicle behind and ``mover`` the speed of the vehicle that enters [m/s].
    """
    faster = max(follower - mover, 0.0)
    slowing_down = faster * GIVING_WAY.delay + faster**2 / (2 * GIVING_WAY.deceleration)
    return max(slowing_down + mover * HEADWAY, 0.0)


def answer(
    trace: Trace,
    vehicle: int,
    speeds: FloatArray,
    since: int,
    avoids: Callable[[int, float], bool],
    response: Braking = FOLLOWING,
    entry: int | None = None,
    danger: int | None = None,
) -> Fact:
    """Return the fact that tells what a vehicle should have done, and what it did instead.

    It should have braked from the last tick, until the response begins to brake, at which hard braking at once avoids
    the collision.

    Args:
        trace: trace of the run.
        vehicle: index of the vehicle; 0 is the ego.
        speeds: speeds of the vehicle at every tick, as the rules read them [m/s].
        since: tick from which on the vehicle had to respond to a danger.
        avoids: returns whether braking at a rate [m/s^2] from a tick on, with the recorded speed at that tick, avoids
            the collision.
        response: proper response, whose delay counts from that tick.
        entry: tick at which the vehicle entered a zone; None if no zone matters.
        danger: tick at which the danger began, if the vehicle's last chance came later.
    """
    hz, end = trace.physics_hz, trace.ticks
    deed = end if entry is None or entry <= since else entry
    due, perceived = since + round(response.delay * hz) - 1, since + round(response.perception * hz)
    is_due, until = due + 1 < deed, None if due + 1 >= end else min(due, deed - 1)
    if until is not None and not (is_due and (np.diff(speeds[perceived : until + 1]) <= 0).all()):
        # it did not drive like the response that avoids the collision
        until = _last_avoiding(perceived, until, lambda tick: avoids(tick, HARDEST))
    slowed, held = -np.diff(speeds) * hz, None
    if until is not None:
        recent = range(until, max(until - math.ceil(PAUSE * hz), -1), -1)
        held = next((tick for tick in recent if slowed[tick] >= BRAKES), None)
        if held is not None and slowed[held] < HARDEST - HARDLY and not avoids(held, float(slowed[held])):
            held = None
    conduct = Conduct(
        vehicle=vehicle,
        speeds=trace.states[:, vehicle, SPEED],
        hz=hz,
        since=since,
        danger=since if danger is None else min(danger, since),
        due=until,
        held=held,
        entry=entry,
        is_in_time=is_due and until is not None and (entry is None or entry > since),
    )
    return Fact(What.ANSWERED, vehicle, since / hz, unread=conduct)


def _last_avoiding(first: int, last: int, avoids: Callable[[int], bool]) -> int | None:
    """Return the last tick between two ticks at which hard braking at once avoids a collision; None if none does.

    Earlier braking is assumed to avoid whatever later braking avoids.
    """
    if last < first:
        return None
    if avoids(last):
        return last
    if not avoids(first):
        return None
    while last - first > 1:
        middle = (first + last) // 2
        first, last = (middle, last) if avoids(middle) else (first, middle)
    return first


class _Stretch(NamedTuple):
    """A phase by the ticks at which it begins and is over, with its change of speed [m/s].

    ``then`` is what followed until the next phase if the vehicle neither braked nor sped up: it stood, had released the
    brakes, or went on to ease them off.
    """

    doing: Doing
    begin: int
    over: int
    figure: float
    change: float
    is_again: bool = False
    then: Doing | None = None

    @property
    def is_rise(self) -> bool:
        return self.doing in RISING

    def joined(self, later: _Stretch) -> _Stretch:
        """Return this phase and a later one of the same kind as one phase."""
        figure, change = max(self.figure, later.figure), self.change + later.change
        is_harder = self.doing is Doing.BRAKED and self.figure <= HARD * later.figure
        doing = Doing.BRAKED_INCREASINGLY if is_harder else Doing.BRAKED_REPEATEDLY if self.then else self.doing
        return self._replace(doing=doing, over=later.over, figure=figure, change=change, then=later.then)


def rising_since(speed: FloatArray, hz: int, first: int, tick: int) -> int:
    """Return the tick, not before ``first``, at which the rise of a speed that goes on at a tick began.

    The rise goes back as far as the speed gained 0.5 m/s in each second, or half of what it gains after the tick if
    that is less.
    """
    ahead = speed[tick + 1 : tick + 1 + hz]
    least = min(BRAKES, float(ahead.max(initial=0.0) - speed[tick]) / 2)
    begin = tick
    while begin > first and speed[begin] - speed[max(begin - hz, first)] > least:
        begin -= 1
    recent = speed[max(begin - hz, first) : tick + 1]
    lowest = begin - max(begin - hz, first) + 1
    return max(begin - hz, first) + int(np.flatnonzero(recent <= recent[:lowest].min() + ROSE)[-1])


def _rise(speed: FloatArray, first: int, last: int, since: int, hz: int) -> _Stretch | None:
    """Return the largest gain in speed between two ticks that goes on after the tick ``since``; None if it is small."""
    part = speed[first : last + 1]
    lowest = np.minimum.accumulate(part)
    gain = np.where(np.arange(first, last + 1) > since, part - lowest, 0.0)
    top = int(gain.argmax()) if gain.size else 0
    if not gain.size or gain[top] <= SPED_UP:
        return None
    begin = first + int(np.flatnonzero(part[: top + 1] <= lowest[top] + ROSE)[-1])
    if begin < since:
        rest = part[since - first : top + 1]
        if rest[-1] - rest.min() <= SPED_UP:
            return _rise(speed, since, last, since, hz)  # it had ended by then
        goes_on = since + int(np.flatnonzero(rest <= rest.min() + ROSE)[-1])
        begin = rising_since(speed, hz, begin, goes_on)
    doing = Doing.SET_OFF if speed[begin] <= STANDING_SPEED + ROSE else Doing.SPED_UP
    return _Stretch(doing, begin, first + top, float(part[top]), float(part[top] - speed[begin]))


def _presses(slowed: FloatArray, begin: int, over: int, hz: int) -> list[tuple[int, int, int]]:
    """Return the parts of one braking, each of which became clearly harder again after a lull.

    Each part is the ticks at which it begins, is weakest in the lull at its end, and is over.
    """
    found: list[tuple[int, int, int]] = []
    while True:
        part = slowed[begin:over]
        weak = stretches(part < CLEARLY * np.maximum.accumulate(part))
        low = next((first for first, last in weak if last - first >= LULL * hz), len(part))
        rest = part[low:]
        lowest = np.minimum.accumulate(rest)
        strong = stretches((CLEARLY * rest > lowest) & (rest - lowest >= BRAKES))
        lasting = (at for at, last in strong if last - at >= round(STEADY * hz) or last == len(rest))
        up = next(lasting, None)
        if up is None:
            return [*found, (begin, over, over)]
        found.append((begin, begin + low + int(rest[:up].argmin()), begin + low + up))
        begin += low + up


def _braked(slowed: FloatArray, begin: int, over: int, hz: int) -> list[_Stretch]:
    """Return the phases of one braking: its hard parts, and gentler parts before, between and after if they last."""
    steady = round(STEADY * hz)
    found: list[tuple[Doing, int, int]] = []
    for start, weakest, end in _presses(slowed, begin, over, hz):
        share = slowed[start:weakest] / slowed[start:weakest].max()
        first = start + int(np.flatnonzero(share >= HARD)[0])
        last = start + int(np.flatnonzero(share >= EASED)[-1]) + 1
        last = end if end == over and end - last < steady else last
        if found:
            parts = [(Doing.BRAKED_HARDER, start, last)]
        elif first - start < steady:
            parts = [(Doing.BRAKED, start, last)]
        else:
            parts = [(Doing.BRAKED, start, first), (Doing.BRAKED_HARDER, first, last)]
        found += [*parts, (Doing.EASED_OFF, last, end)]
    return [
        _Stretch(doing, begin, over, _extreme(doing, slowed[begin:over]), float(slowed[begin:over].sum()) / hz)
        for doing, begin, over in found
        if begin < over
    ]


def _extreme(doing: Doing, slowed: FloatArray) -> float:
    """Return the hardest braking of a phase, or its weakest if the vehicle eased off [m/s^2]."""
    return max(float(slowed.min() if doing is Doing.EASED_OFF else slowed.max()), 0.0)


def _fewer(phases: list[_Stretch], due: int | None, lasting: int) -> list[_Stretch]:
    """Return the phases that matter: the last, the one at the tick ``due``, and those with the most change of speed.

    ``lasting`` is the number of ticks for which a pause between two brakings is not hidden.
    """
    found = list(phases)
    early = 0 if due is None else sum(each.begin <= due for each in found[1:])
    most = MOST + min(early, EARLIER)
    while len(found) > most:
        is_lull = [each.doing for each in found[-2:]] == [Doing.EASED_OFF, Doing.BRAKED_HARDER]
        kept = 3 if is_lull else 2 if found[-1].doing is Doing.EASED_OFF else 1
        alike = [
            at
            for at in range(len(found) - max(kept, 2))
            if found[at].is_rise == found[at + 1].is_rise
            and found[at].doing is not Doing.EASED_OFF
            and not (found[at].then and due is not None and found[at].over <= due < found[at + 1].begin)
        ]
        if alike:
            place = min(alike, key=lambda at: (found[at].then is not None, min(found[at].change, found[at + 1].change)))
            both = found[place].joined(found[place + 1])
            is_again = found[place + 1].doing is Doing.EASED_OFF and found[place + 2].doing is Doing.BRAKED_HARDER
            found[place : place + 2 + is_again] = [both.joined(found[place + 2]) if is_again else both]
            continue
        ends = range(len(found) - kept)
        inner = [at for at in ends if due is None or not found[at].begin <= due < found[at + 1].begin]
        if not inner:
            return found
        place = min(inner, key=lambda at: found[at].change)
        left, after, before = found[place], found[place + 1], found[place - 1] if place else None
        if before is None or left.is_rise == after.is_rise or before.is_rise != after.is_rise:
            is_part = not left.is_rise and after.doing in (Doing.BRAKED_HARDER, Doing.EASED_OFF)
            found[place : place + 2] = [left.joined(after) if is_part else after]
        else:
            both = before.joined(after)
            if left.change >= CLEAR or after.begin - before.over >= lasting:
                both = both._replace(doing=Doing.SPED_UP_REPEATEDLY if both.is_rise else Doing.BRAKED_REPEATEDLY)
            found[place - 1 : place + 2] = [both]
    return found


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Conduct:
    """The deeds of a vehicle in a danger up to the impact, which are put into words only if somebody reads them.

    Attributes:
        vehicle: index of the vehicle; 0 is the ego.
        speeds: speed of the vehicle along its heading at every tick [m/s].
        hz: ticks per second.
        since: tick from which on the vehicle had to respond.
        danger: tick at which the danger began; what the vehicle did is told from here.
        due: tick from which on it should have braked; None if no braking was due or avoided the collision.
        held: tick, at that time or just before, at which it braked hard enough to avoid the collision if it had kept
            braking; None if it did not.
        entry: tick at which it entered a zone; None if no zone matters.
        is_in_time: whether braking at the tick ``due`` is what the rules require, and not only that it does not speed
            up.
    """

    vehicle: int
    speeds: FloatArray
    hz: int
    since: int
    danger: int
    due: int | None
    held: int | None
    entry: int | None
    is_in_time: bool

    def later(self, trace: Trace, ticks: int) -> Conduct:
        """Return the same conduct in a whole run, of which it knew only the part from a tick on."""
        due, held, entry = (None if each is None else each + ticks for each in (self.due, self.held, self.entry))
        speeds = trace.states[: ticks + len(self.speeds), self.vehicle, SPEED]
        since, danger = self.since + ticks, self.danger + ticks
        return replace(self, speeds=speeds, since=since, danger=danger, due=due, held=held, entry=entry)

    def in_full(self) -> Fact:
        """Return the fact that tells what the vehicle should have done, and what it did.

        If it braked hard enough when braking was due, its mistake was what ended or eased that braking. If the response
        would have braked only after the vehicle's deed, or if the vehicle crept and then sped up when braking was due,
        its mistake was to speed up.
        """
        told, pause = self.phases(), PAUSE * self.hz
        begins = [round(each.time_s * self.hz) for each in told]
        fact = Fact(What.DROVE, self.vehicle, self.since / self.hz, phases=told)
        if self.due is not None:
            fact = fact._replace(what=What.SHOULD_HAVE_BRAKED, due_s=self.due / self.hz)
        at = 0 if self.held is None else sum(begin <= self.held for begin in begins)
        if self.held is not None and at and told[at - 1].doing in BRAKING:
            kept = float(self.speeds[self.held] - self.speeds[self.held + 1]) * self.hz
            is_lapse = at < len(told) and told[at].doing not in BEGUN
            what = What.SHOULD_HAVE_KEPT_BRAKING if is_lapse else What.SHOULD_HAVE_BRAKED_ON
            fact = fact._replace(what=what, mistake=at, braking_m_per_s2=kept)
        deed = len(self.speeds) if self.entry is None or self.entry <= self.since else self.entry
        risen = [
            index
            for index, each in enumerate(told)
            if each.doing in RISING and begins[index] < deed and each.until_s > fact.time_s
        ]
        if not risen:
            return fact
        rise, begin = told[risen[-1]], begins[risen[-1]]
        has_crept = self.due is None or (self.speeds[begin] <= CREEPING and begin >= self.due - pause)
        if self.is_in_time and not has_crept:
            return fact
        is_set_off = rise.doing is Doing.SET_OFF and self.entry is not None
        if begin < self.since - pause and not is_set_off:  # it had no duty when it began to speed up
            rise = rise._replace(doing=Doing.SPED_UP_FURTHER, time_s=self.since / self.hz)
        what = What.SHOULD_HAVE_WAITED if rise.doing is Doing.SET_OFF else What.SHOULD_NOT_HAVE_SPED_UP
        told = (*told[: risen[-1]], rise, *told[risen[-1] + 1 :])
        return fact._replace(what=what, due_s=None, phases=told, mistake=risen[-1])

    def phases(self) -> tuple[Phase, ...]:
        """Return what the vehicle did up to the impact, in its order, in a few phases and how they ended.

        A phase that had begun before the danger counts from its beginning, and a clear braking that ended just before
        the danger belongs to it. Of more phases, those with the least change of speed are left out, but never the last
        one, nor the one at the tick ``due``.
        """
        hz, speed, since, lasting = self.hz, self.speeds, self.danger, round(COASTED * self.hz)
        slowed, end, pause = -np.diff(speed) * hz, len(speed) - 1, math.ceil(PAUSE * hz)
        brakings: list[tuple[int, int]] = []
        for begin, over in stretches(slowed >= BRAKES):
            is_same = brakings and begin - brakings[-1][1] < pause and speed[begin] - speed[brakings[-1][1]] < CLEAR
            brakings.append((brakings.pop()[0] if is_same else begin, over))
        found: list[_Stretch] = []
        told = [
            (begin, over)
            for begin, over in brakings
            if speed[begin] - speed[over] >= (LOST if over > since else CLEAR) and over > since - lasting
        ]
        first = min(told[0][0], since) if told else since
        told = [each for each in brakings if told and each[0] >= told[0][0] and speed[each[0]] - speed[each[1]] >= LOST]
        at = max([0, *(over for begin, over in brakings if over <= first and speed[begin] - speed[over] >= LOST)])
        for begin, over in [*told, (end, end)]:
            rise = _rise(speed, at, begin, since, hz)
            coasts = (begin if rise is None else rise.begin) - at >= (pause if rise is None else lasting)
            if found and found[-1].over == at and coasts and (rise is None or rise.doing is not Doing.SET_OFF):
                stands = (speed[at : begin + 1] <= STANDING_SPEED + ROSE).all()
                is_smooth = not stands and (slowed[at : at + pause] > LOST).all()
                if found[-1].doing is Doing.EASED_OFF and at - found[-1].begin < lasting and not is_smooth:
                    tail = found.pop()
                    found[-1] = found[-1].joined(tail)
                then = Doing.STOOD if stands else Doing.EASED_OFF if is_smooth else Doing.RELEASED
                found[-1] = found[-1]._replace(then=None if then is found[-1].doing else then)
            found += [] if rise is None else [rise]
            if begin < end:
                found += [part._replace(is_again=begin > told[0][0]) for part in _braked(slowed, begin, over, hz)]
            at = over
        phases: list[Phase] = []
        for each in _fewer(found, self.due, lasting):
            part = slowed[each.begin : each.over]
            peak = int((part >= each.figure - HARDLY).argmax()) if each.doing in BEGUN else 0
            is_late = 2 * peak > hz and part[: math.ceil(hz / 2)].mean() < CLEARLY * each.figure
            peak_s = (each.begin + peak) / hz if is_late else None
            phases.append(Phase(each.doing, each.begin / hz, each.over / hz, each.figure, each.is_again, peak_s))
            if each.then is Doing.EASED_OFF:
                weakest = max(float(slowed[each.over : each.over + pause].min()), 0.0)
                phases.append(Phase(each.then, each.over / hz, each.over / hz, weakest))
            elif each.then is not None:
                phases.append(Phase(each.then, each.over / hz, end / hz, 0.0))
        return tuple(phases)
