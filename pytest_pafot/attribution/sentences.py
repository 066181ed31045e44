"""The sentences that explain a verdict to a user, and the facts that they state. No other module has such sentences.

Each text is at most 97 characters long, so that it fits on one line of an explanation.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from types import MappingProxyType
from typing import NamedTuple, Protocol

from pytest_pafot.model.crossings import Zone
from pytest_pafot.model.trace import Trace
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
