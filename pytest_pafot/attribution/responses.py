"""The responses that rules of attribution require of a driver, the actual ones, and what braking would have avoided.

Braking is the proper response to a vehicle ahead (Shalev-Shwartz et al. 2017). The vehicle behind is the *responder*,
the vehicle ahead is the *other*. The other moves as recorded. The responder stays on its recorded path and brakes there
like a *reference*, a driver that responds properly. In each step it moves with the speed at the beginning of the step,
as in the simulation. docs/explanation/verdicts.md has the sources of the numbers.

The sentences that explain a verdict to a user, and the facts that they state, come first. No other module has such
sentences.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property
from itertools import pairwise
from types import MappingProxyType
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from pytest_pafot.attribution.manoeuvres import DRIFTING, STANDING_SPEED, stretches
from pytest_pafot.criticality import RssRules
from pytest_pafot.criticality.measures import Boxes, overlaps, relate
from pytest_pafot.model.crossings import Zone
from pytest_pafot.model.trace import SPEED, FloatArray, Trace
from pytest_pafot.support.text import capitalised


class What(Enum):
    """The kinds of facts, each with the template of its sentence."""

    CROSSED_LINE = "{who} crossed {into} at {at}, {place}."
    MOVED_FURTHER = "{who} moved on {over} at {at}, {place}."
    CAME_IN = "{who} moved in at {at}, {place}."
    BOTH_CROSSED = "{who} (at {at}) and {whom} (at {later}) moved towards each other and crossed their lane lines."
    KEPT_LANE = "{who} kept its lane from {at} on, {place}."
    CAME_SIDEWAYS = "{who} moved sideways at {at} into {whom}, which was next to it."
    CAME_TOO_CLOSE = "{who} was only {place}."
    STOOD = "{who} was standing when {whom} touched it at {at}."
    BRAKED_FOR_NOTHING = "{who} braked at up to {it.braking_m_per_s2:.1f} m/s^2 from {at} on, with nothing in its way."
    BRAKED_ON = (
        "{who} kept braking at up to {it.braking_m_per_s2:.1f} m/s^2 from {at} on, with nothing in its way any more."
    )
    STOPPED_FOR_NOTHING = (
        "{who} began to stop at {at} with nothing in its way. It stood for {it.lasting_s:.1f} s before the impact."
    )
    LEFT_TOO_LITTLE = "{who} should have left {whom} a gap of {it.asked_m:.1f} m."
    GAVE_WAY = "{who} gave way: it left {whom} more than the required {it.asked_m:.1f} m."
    MOVED_IN_BEHIND = "{who} moved in behind {whom} at {at}."
    ENTERED = "{entered}"
    NONE_FORESAW = "Neither could have foreseen the other in time, by the rules."
    TOUCHED_ELSEWHERE = "{who} touched {whom} at {at}, outside the zone where their ways meet."
    HAD_NO_TIME = "{who} had too little time to respond, by the rules."
    IGNORED = "{who} {braked}. By the rules, 6 m/s^2 from {due} on avoids it."
    HARDLY_BRAKED = "{who} {braked}."
    SPED_UP = "{who} sped up to {it.speed_m_per_s:.1f} m/s after {at}."
    LET_BRAKES_GO = "{who} should have kept braking but released the brakes at {at}."
    BRAKED_LESS = "{who} already braked and should have kept braking, but braked less from {at} on."
    ANSWERED = "answered"
    SHOULD_HAVE_BRAKED = "should have braked"
    SHOULD_HAVE_WAITED = "should have waited"
    DROVE = "drove"


ANSWERS = (What.SHOULD_HAVE_BRAKED, What.SHOULD_HAVE_WAITED, What.DROVE)
"""The facts on what a vehicle should have done in a danger, and what it did. Their sentences depend on its phases."""
ADVICE: Mapping[What, str] = MappingProxyType(
    {
        What.CROSSED_LINE: "do not change lanes at {at}",
        What.MOVED_FURTHER: "do not change lanes at {at}",
        What.CAME_IN: "do not change lanes at {at}",
        What.BOTH_CROSSED: "do not change lanes at {at}",
        What.CAME_SIDEWAYS: "do not move sideways at {at}",
        What.BRAKED_FOR_NOTHING: "do not brake at {at}",
        What.BRAKED_ON: "stop braking by {at}",
        What.STOPPED_FOR_NOTHING: "do not stop at {at}",
        What.ENTERED: "do not drive in at {at}",
        What.IGNORED: "brake by {due}",
        What.LET_BRAKES_GO: "keep braking at {at}",
        What.BRAKED_LESS: "keep braking at {at}",
        What.SHOULD_HAVE_BRAKED: "brake by {due}",
        What.SHOULD_HAVE_WAITED: "do not set off at {later}",
    }
)
"""What the ego should have done by when, in a few words for a headline, by the fact that says it."""
DRIFT_ADVICE = "ego drifts from {at}, over the line at {later}: keep the lane"
"""The same for a motion over the line that is too slow for a change of lanes."""
CHANGE_ADVICE: Mapping[What, str] = MappingProxyType(
    {
        What.CROSSED_LINE: "do not change lanes: begun at {at}, {over} at {later}",
        What.MOVED_FURTHER: "do not change lanes: begun at {at}, {over} at {later}",
        What.CAME_IN: "do not change lanes: begun at {at}, over at {later}",
        What.BOTH_CROSSED: "do not change lanes: begun at {at}, over the line at {later}",
        What.CAME_SIDEWAYS: "do not move sideways: begun at {at}, into {whom} at {later}",
    }
)
"""The same for a motion that begins visibly earlier than the time that the fact says."""
BRAKES = 0.5
"""The least deceleration that counts as braking in the sentences of a verdict [m/s^2]."""
APART = 0.05
"""The least difference between two times that a text tells apart [s]."""
LONGEST = 97
"""The largest number of characters in a line, so that it fits on one line of an explanation."""


class Doing(Enum):
    """The deeds of a vehicle in one phase, each with its words."""

    BRAKED = "braked at up to {it.braking_m_per_s2:.1f} m/s^2, to {it.last_m_per_s:.1f} m/s"
    SLOWED = "slowed to {it.last_m_per_s:.1f} m/s"
    KEPT = "kept {it.last_m_per_s:.1f} m/s"
    SPED_UP = "sped up to {it.last_m_per_s:.1f} m/s"
    STOOD = "stood"


class Phase(NamedTuple):
    """One phase of a vehicle's speed.

    Attributes:
        doing: what the vehicle did.
        time_s: time at which the phase began [s].
        until_s: time at which the phase was over [s].
        first_m_per_s: speed at its beginning [m/s].
        last_m_per_s: speed at its end [m/s].
        braking_m_per_s2: hardest braking in it [m/s^2].
    """

    doing: Doing
    time_s: float
    until_s: float
    first_m_per_s: float
    last_m_per_s: float
    braking_m_per_s2: float


class Fact(NamedTuple):
    """One fact that explains a verdict. Figures that the sentence of the fact does not use are 0.

    Attributes:
        what: kind of the fact.
        vehicle: index of the vehicle that the fact is about; 0 is the ego, ``i + 1`` is NPC ``i``.
        other: index of the other vehicle that the fact mentions.
        time_s: time at which the event happened or began [s].
        later_s: time at which the other vehicle did the same, if both crossed a line or both entered a zone; time at
            which a vehicle that should have waited set off [s].
        due_s: latest time at which the vehicle should have begun to brake hard [s]; None if that does not help.
        gap_m: gap between the boxes along the road [m]; positive if the vehicle is ahead of the other, negative if it
            is behind, 0 side by side.
        asked_m: gap that the rules require [m].
        speed_m_per_s: speed that the vehicle reached when it sped up [m/s].
        faster_m_per_s: speed of the other minus speed of the vehicle [m/s]. The sentence does not mention it if
            ``leader_m_per_s2`` is not 0.
        leader_m_per_s2: hardest braking of the NPC, if it was ahead and braked visibly [m/s^2].
        braking_m_per_s2: hardest braking of the vehicle [m/s^2]; if it should have braked, its braking at that time.
        lasting_s: time for which the vehicle stood before the impact [s].
        lane: lane that the vehicle moved into; None if it has no number.
        zone: zone that the vehicle entered.
        unread: the rest of the fact; None if there is none. It is worked out when somebody reads the fact, because a
            search needs many verdicts and displays few.
        has_braked: whether it braked in the time of the phases.
        phases: what the vehicle did from shortly before the danger on, in its order.
        moves: times [s] at which its centre came into another lane meanwhile, each with the number of the lane.
    """

    what: What
    vehicle: int
    time_s: float
    other: int = 0
    later_s: float = 0.0
    due_s: float | None = None
    gap_m: float = 0.0
    asked_m: float = 0.0
    speed_m_per_s: float = 0.0
    faster_m_per_s: float = 0.0
    leader_m_per_s2: float = 0.0
    braking_m_per_s2: float = 0.0
    lasting_s: float = 0.0
    lane: int | None = None
    zone: Zone | None = None
    unread: Unread | None = None
    has_braked: bool = False
    phases: tuple[Phase, ...] = ()
    moves: tuple[tuple[float, int], ...] = ()

    @property
    def in_full(self) -> Fact:
        """The fact with all that its sentences state."""
        return self if self.unread is None else self.unread.in_full()

    @property
    def is_unanswered(self) -> bool:
        """True if the vehicle had to respond to a danger and did not brake."""
        full = self.in_full
        later = [each for each in full.phases if each.until_s > full.time_s]
        return full.what in ANSWERS and all(each.doing is not Doing.BRAKED for each in later)


class Unread(Protocol):
    """A fact that is worked out when it is read."""

    def in_full(self) -> Fact:
        """Return the fact with all that its sentences state."""

    def later(self, trace: Trace, ticks: int) -> Unread:
        """Return the same in a whole run, of which it knew only the part from a tick on."""


Reason = tuple[Fact, ...]
"""The facts that explain a verdict: first what happened, then what should have happened. Empty without a collision."""


def due_by(reason: Reason, latest: float) -> Reason:
    """Return facts that require no braking of the ego after the latest time at which it avoids the collision [s].

    If that time is before the danger, the facts say only what the vehicle did.
    """

    def changed(fact: Fact) -> Fact:
        if fact.what is What.IGNORED and fact.due_s is not None and fact.due_s > latest:
            return fact._replace(what=What.HARDLY_BRAKED)  # the rules foresee no reactions of others
        if fact.vehicle or fact.what not in ANSWERS or fact.due_s is None or fact.due_s <= latest:
            return fact
        if latest < fact.time_s:
            return fact._replace(what=What.DROVE, due_s=None)
        return fact._replace(what=What.SHOULD_HAVE_BRAKED, due_s=latest)

    return tuple(changed(fact.in_full) for fact in reason)


def sentences(reason: Reason) -> tuple[str, ...]:
    """Return the sentences of the facts, in lines of at most 97 characters; a new line for each fact."""
    return tuple(line for fact in reason for line in _lines(fact.in_full))


def _lines(fact: Fact) -> list[str]:
    lines: list[str] = []
    for sentence in _answer(fact) if fact.what in ANSWERS else [capitalised(_filled(fact.what.value, fact))]:
        if lines and len(lines[-1]) + len(sentence) < LONGEST:
            lines[-1] += f" {sentence}"
        else:
            lines.append(sentence)
    return lines


def drift_advice(fact: Fact) -> str:
    """Return what an ego should have done that drifted over a line.

    The fact has the time when the drift began, and, as the later one, the time when the ego was over the line.
    """
    return _filled(DRIFT_ADVICE, fact)


def change_advice(fact: Fact) -> str:
    """Return what an ego should have done that changed lanes; the fact has both times, as for a drift."""
    is_later = fact.later_s - fact.time_s >= APART
    return _filled(CHANGE_ADVICE.get(fact.what, "") if is_later else ADVICE.get(fact.what, ""), fact)


def advice(reason: Reason) -> str:
    """Return in a few words what the ego should have done by when; empty if the facts on the ego do not say it.

    It is what the last of these facts says: the first says what happened, the last what should have happened instead.
    """
    facts = [fact.in_full for fact in reversed(reason) if not fact.vehicle]
    return next((_filled(ADVICE[fact.what], fact) for fact in facts if fact.what in ADVICE), "")


AT_FAULT: Mapping[str, str] = MappingProxyType(
    {"ego": "ego at fault", "npc": "NPC at fault", "both": "both at fault", "none": "nobody at fault"}
)
"""Who is responsible for a collision, in the words of headlines and of the report page."""


def responsible_sentence(responsibility: str, npc: int | None) -> str:
    """Return the sentence that says who is responsible for a collision with an NPC, or with a fixed object (None)."""
    if npc is None:
        return "The ego is responsible, because a fixed object does not move."
    if responsibility == "both":
        return f"Both are responsible: the ego and NPC {npc}."
    who = {"ego": "The ego", "npc": f"NPC {npc}", "none": f"Neither the ego nor NPC {npc}"}[responsibility]
    return f"{who} is responsible."


def _filled(template: str, fact: Fact) -> str:
    return template.format(
        it=fact,
        at=f"{fact.time_s:.1f} s",
        later=f"{fact.later_s:.1f} s",
        who=_name(fact.vehicle),
        whom=_name(fact.other),
        into="a lane line" if fact.lane is None else f"into lane {fact.lane}",
        over="over a lane line" if fact.lane is None else f"into lane {fact.lane}",
        due=f"{fact.due_s or 0.0:.1f} s",
        braked=f"braked with a mean of {max(fact.braking_m_per_s2, 0.0):.1f} m/s^2"
        if fact.has_braked
        else "did not brake",
        place=_place(fact),
        entered=_entered(fact),
    )


def _answer(fact: Fact) -> list[str]:
    """Return the sentences that say what a vehicle should have done, and what it did."""
    who, at = capitalised(_name(fact.vehicle)), f"{fact.due_s or 0.0:.1f} s"
    made: list[str] = []
    if fact.what is What.SHOULD_HAVE_WAITED:
        made = [f"{who} should have waited but set off at {fact.later_s:.1f} s."]
    elif fact.what is What.SHOULD_HAVE_BRAKED:
        instead = "" if fact.has_braked else " but did not"
        how = "harder" if fact.braking_m_per_s2 >= BRAKES else "hard"
        made = [f"{who} should have braked {how} by {at}{instead}."]
    told = []
    for index, each in enumerate(fact.phases):
        deed = each.doing.value.format(it=each)
        if index:
            told.append(f"from {each.time_s:.1f} s it {deed}")
            continue
        begun = "stood" if each.doing is Doing.STOOD else f"drove {each.first_m_per_s:.1f} m/s"
        rest = "" if each.doing in (Doing.KEPT, Doing.STOOD) else f" and {deed}"
        told.append(f"{'It' if made else who} {begun} at {each.time_s:.1f} s{rest}")
    if len(told) == 1 and fact.phases[0].doing is Doing.KEPT:
        kept = f"kept {fact.phases[0].last_m_per_s:.1f} m/s from {fact.phases[0].time_s:.1f} s on"
        told = [] if made else [f"{who} {kept}"]  # the duty says enough
    # two phases in a sentence, if they are short enough
    while told:
        both = "; ".join(told[:2])
        count = 2 if len(both) < LONGEST else 1
        made.append(f"{capitalised('; '.join(told[:count]))}.")
        told = told[count:]
    made += [f"Its centre came into lane {lane} at {time:.1f} s." for time, lane in fact.moves]
    return made


def _name(vehicle: int) -> str:
    return f"NPC {vehicle - 1}" if vehicle else "the ego"


def _place(fact: Fact) -> str:
    """Return the place of a vehicle relative to the other vehicle, and a sentence on the other's speed or braking."""
    whom, faster = _name(fact.other), fact.faster_m_per_s
    if not fact.gap_m:
        return f"next to {whom}"
    gap, safe = f"{abs(fact.gap_m):.1f}", f"{fact.asked_m:.1f}"
    if fact.asked_m and gap == safe:  # "only 1.7 m (safe: 1.7 m)" would read as a mistake
        gap, safe = f"{abs(fact.gap_m):.2f}", f"{fact.asked_m:.2f}"
    place = f"{gap} m {'ahead of' if fact.gap_m > 0 else 'behind'} {whom}"
    if fact.what is What.CAME_TOO_CLOSE:
        place += f" at {fact.time_s:.1f} s" + (f" (safe: {safe} m)" if fact.asked_m else "")
    if fact.leader_m_per_s2:
        leader = capitalised(_name(fact.vehicle or fact.other))
        return f"{place}. {leader} braked at up to {fact.leader_m_per_s2:.1f} m/s^2"
    if abs(faster) < 0.05:
        return f"{place}. Both drove equally fast"
    return f"{place}. {capitalised(whom)} drove {abs(faster):.1f} m/s {'faster' if faster > 0 else 'slower'}"


def _entered(fact: Fact) -> str:
    """Return which vehicle entered a zone when, its time from the other vehicle, and which vehicle had priority."""
    if fact.zone is None:
        return ""
    zone, later = fact.zone, fact.later_s - fact.time_s
    apart = f"{abs(later):.1f} s {'before' if later > 0 else 'after'}" if abs(later) >= 0.05 else "together with"
    holders = {"none": "neither", "ego": "the ego", "npc": _name(fact.vehicle or fact.other)}
    where, whom = f"the {'merge' if zone.kind == 'merging' else 'crossing'}", _name(fact.other)
    if fact.vehicle:
        where += f" {zone.whence}"
    else:
        whom += f" {zone.whence}"
    entered = f"{_name(fact.vehicle)} entered {where} at {fact.time_s:.1f} s, {apart} {whom}"
    return f"{entered}. {capitalised(holders[zone.priority])} had priority."


def avoidance_sentence(time: float, braking: float | None) -> str:
    """Return the sentence that braking at a rate [m/s^2] from a time [s] on avoids the collision.

    Without a rate, it is that a careful driver does who keeps the lane.
    """
    if braking is None:
        return f"A careful driver who keeps the lane from {time:.1f} s on avoids the collision."
    return f"Braking at {braking:.0f} m/s^2 from {time:.1f} s on avoids the collision."


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
