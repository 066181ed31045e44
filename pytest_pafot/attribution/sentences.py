"""The sentences that explain a verdict to a user, and the facts that they state. No other module has such sentences.

Each text is at most 97 characters long, so that it fits on one line of an explanation.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from itertools import pairwise
from typing import NamedTuple, Protocol

from pytest_pafot.attribution.avoidance import HARDEST
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
    SPED_UP_INTO = "{who} sped up to {it.speed_m_per_s:.1f} m/s from {at} on, towards {whom}."
    LET_BRAKES_GO = "{who} should have kept braking but released the brakes at {at}."
    BRAKED_LESS = "{who} already braked and should have kept braking, but braked less from {at} on."
    ANSWERED = "answered"
    SHOULD_HAVE_BRAKED = "should have braked"
    SHOULD_HAVE_KEPT_BRAKING = "should have kept braking"
    SHOULD_HAVE_BRAKED_ON = "should have braked on"
    SHOULD_HAVE_WAITED = "should have waited"
    SHOULD_NOT_HAVE_SPED_UP = "should not have sped up"
    DROVE = "drove"


ANSWERS = (
    What.SHOULD_HAVE_BRAKED,
    What.SHOULD_HAVE_KEPT_BRAKING,
    What.SHOULD_HAVE_BRAKED_ON,
    What.SHOULD_HAVE_WAITED,
    What.SHOULD_NOT_HAVE_SPED_UP,
    What.DROVE,
)
"""The facts on what a vehicle should have done in a danger, and what it did. Their sentences depend on its phases."""
LONGEST = 97
"""The largest number of characters in a line, so that it fits on one line of an explanation."""


class Doing(Enum):
    """The deeds of a vehicle in one phase of its response, each with its words."""

    BRAKED = "braked with up to {figure:.1f} m/s^2 from {at} on"
    BRAKED_HARDER = "braked harder, with up to {figure:.1f} m/s^2, from {at} on"
    BRAKED_INCREASINGLY = "braked more and more, with up to {figure:.1f} m/s^2, from {at} on"
    BRAKED_REPEATEDLY = "braked again and again, with up to {figure:.1f} m/s^2, from {at} on"
    EASED_OFF = "eased off from {at} on, to {figure:.1f} m/s^2"
    RELEASED = "released the brakes at {at}"
    STOOD = "stood from {at} on"
    SPED_UP = "sped up from {at} on, to {figure:.1f} m/s"
    SPED_UP_REPEATEDLY = "sped up again and again from {at} on, to {figure:.1f} m/s"
    SPED_UP_FURTHER = "sped up further, to {figure:.1f} m/s"
    SET_OFF = "set off at {at} and sped up to {figure:.1f} m/s"


RISING = (Doing.SPED_UP, Doing.SPED_UP_REPEATEDLY, Doing.SPED_UP_FURTHER, Doing.SET_OFF)
"""The phases in which a vehicle sped up."""
BEGUN = (Doing.BRAKED, Doing.BRAKED_HARDER, Doing.BRAKED_INCREASINGLY, Doing.BRAKED_REPEATEDLY)
"""The phases that begin when a vehicle begins to brake, or to brake harder."""
BRAKING = (*BEGUN, Doing.EASED_OFF)
"""The phases in which a vehicle braked."""


REPEATED = (Doing.BRAKED_REPEATEDLY, Doing.SPED_UP_REPEATEDLY)
"""The phases in which a vehicle braked, and sped up, more than once."""


class Phase(NamedTuple):
    """One phase of a vehicle's response.

    Attributes:
        doing: what the vehicle did.
        time_s: time at which the phase began [s]; for a vehicle that sped up further, the time from which on it had to
            respond.
        until_s: time at which the phase was over [s].
        figure: hardest braking [m/s^2], weakest if it eased off, or highest speed [m/s], in the phase; 0 if the vehicle
            did none of these.
        is_again: whether the vehicle braked and had already braked before, since it had to respond.
        peak_s: time at which the vehicle first braked so hard, if that was late in the phase [s].
    """

    doing: Doing
    time_s: float
    until_s: float
    figure: float
    is_again: bool = False
    peak_s: float | None = None


class Fact(NamedTuple):
    """One fact that explains a verdict. Figures that the sentence of the fact does not use are 0.

    Attributes:
        what: kind of the fact.
        vehicle: index of the vehicle that the fact is about; 0 is the ego, ``i + 1`` is NPC ``i``.
        other: index of the other vehicle that the fact mentions.
        time_s: time at which the event happened or began [s].
        later_s: time at which the other vehicle did the same, if both crossed a line or both entered a zone [s].
        due_s: time from which on the vehicle should have braked [s]; None if it did not have to before the impact, or
            if its mistake was to speed up. For a vehicle that had too little time, the time from which on braking would
            have been the proper response.
        gap_m: gap between the boxes along the road [m]; positive if the vehicle is ahead of the other, negative if it
            is behind, 0 side by side.
        asked_m: gap that the rules require [m].
        speed_m_per_s: speed that the vehicle reached when it sped up [m/s].
        faster_m_per_s: speed of the other minus speed of the vehicle [m/s]. The sentence does not mention it if
            ``leader_m_per_s2`` is not 0.
        leader_m_per_s2: hardest braking of the NPC, if it was ahead and braked visibly [m/s^2].
        braking_m_per_s2: hardest braking of the vehicle [m/s^2]; if it should have kept braking, its braking at that
            time; if it had too little time, the required braking unless there is an emergency.
        lasting_s: time for which the vehicle stood before the impact [s].
        lane: lane that the vehicle moved into; None if it has no number.
        zone: zone that the vehicle entered.
        unread: the rest of the fact; None if there is none. It is worked out when somebody reads the fact, because a
            search needs many verdicts and displays few.
        phases: what the vehicle did from the beginning of the danger on, in its order.
        mistake: index of the phase that was the mistake, if the vehicle should have kept braking, should have waited,
            or should not have sped up. If it braked on, but for less, the number of phases that had begun by then.
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
    phases: tuple[Phase, ...] = ()
    mistake: int = 0

    @property
    def in_full(self) -> Fact:
        """The fact with all that its sentences state."""
        return self if self.unread is None else self.unread.in_full()

    @property
    def is_unanswered(self) -> bool:
        """True if the vehicle had to respond to a danger and did not brake."""
        full = self.in_full
        if full.what in (What.SHOULD_HAVE_KEPT_BRAKING, What.SHOULD_HAVE_BRAKED_ON) or full.what not in ANSWERS:
            return False
        later = [each for each in full.phases[full.mistake :] if each.until_s > full.time_s]
        return not any(each.doing in BRAKING for each in later)


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
        if fact.vehicle or fact.what not in ANSWERS or fact.due_s is None or fact.due_s <= latest:
            return fact
        if latest < fact.time_s:
            return fact._replace(what=What.DROVE, due_s=None, mistake=0)
        return fact._replace(what=What.SHOULD_HAVE_BRAKED, due_s=latest, braking_m_per_s2=0.0, mistake=0)

    return tuple(changed(fact.in_full) for fact in reason)


def sentences(reason: Reason) -> tuple[str, ...]:
    """Return the sentences of the facts, in lines of at most 97 characters; a new line for each fact."""
    return tuple(line for fact in reason for line in _lines(fact.in_full))


def _lines(fact: Fact) -> list[str]:
    first, *others = _answer(fact) if fact.what in ANSWERS else [_sentence(fact)]
    lines = [first]
    for sentence in others:
        if len(lines[-1]) + len(sentence) < LONGEST:
            lines[-1] += f" {sentence}"
        else:
            lines.append(sentence)
    return lines


def responsible_sentence(responsibility: str, npc: int) -> str:
    """Return the sentence that says who is responsible for a collision with an NPC."""
    if responsibility == "both":
        return f"Both are responsible: the ego and NPC {npc}."
    who = {"ego": "The ego", "npc": f"NPC {npc}", "none": f"Neither the ego nor NPC {npc}"}[responsibility]
    return f"{who} is responsible."


def _sentence(fact: Fact) -> str:
    text = fact.what.value.format(
        it=fact,
        at=f"{fact.time_s:.1f} s",
        later=f"{fact.later_s:.1f} s",
        who=_name(fact.vehicle),
        whom=_name(fact.other),
        into="a lane line" if fact.lane is None else f"into lane {fact.lane}",
        over="over a lane line" if fact.lane is None else f"into lane {fact.lane}",
        place=_place(fact),
        entered=_entered(fact),
    )
    return capitalised(text)


def _answer(fact: Fact) -> list[str]:
    """Return the sentences that say what a vehicle should have done, and what it did before and instead."""
    who, phases, due = capitalised(_name(fact.vehicle)), fact.phases, fact.due_s
    at, is_braking = _begun(fact)
    asked = due if due is not None else phases[at].time_s if at else fact.time_s
    late = next((each for each in phases[at:] if each.doing in BEGUN and each.time_s > asked), None)
    is_repeated = any(each.doing in REPEATED for each in phases)
    if late is not None and late.is_again and (is_repeated or not at):
        late = None  # an earlier braking may have been left out
    if any(left.doing is Doing.EASED_OFF and right is late for left, right in pairwise(phases)):
        late = None  # it may have braked so hard before it eased off
    told = [_clause(each, is_late=each is late) for each in phases]
    if fact.what is What.DROVE:
        return _deeds(who, phases, told or [f"did not brake from {fact.time_s:.1f} s on"])
    before, instead = _deeds(who, phases[:at], told[:at]), "It"
    if fact.what is What.SHOULD_HAVE_BRAKED and due is not None:
        duty = f"should have braked {'harder ' if is_braking else 'again ' if at else ''}from {due:.1f} s"
        if not phases[at:]:
            duty += "" if is_repeated else " but did not"
        elif phases[at].doing in RISING and phases[at].until_s > due:
            instead = "Instead it" if phases[at].time_s <= due else "It did not, but"
    elif fact.what is What.SHOULD_HAVE_BRAKED_ON:
        rate = "hard" if fact.braking_m_per_s2 > HARDEST - 0.05 else f"with {fact.braking_m_per_s2:.1f} m/s^2"
        duty = f"should have kept braking {rate} from {due:.1f} s on"
    else:
        duty, at = _mistake(fact.what, phases[at], told[at]), at + 1
    return [*before, f"{'It' if before else who} {duty}.", *_deeds(instead, phases[at:], told[at:])]


def _begun(fact: Fact) -> tuple[int, bool]:
    """Return how many phases are told before what the vehicle should have done, and whether it braked at that time.

    If it had braked before braking was due, and no longer did, that is told first.
    """
    if fact.what is not What.SHOULD_HAVE_BRAKED or fact.due_s is None:
        return fact.mistake, False
    begun = [each for each in fact.phases if each.time_s <= fact.due_s]
    if begun and begun[-1].doing in BRAKING and fact.due_s < begun[-1].until_s:
        return 0, True
    return len(begun) if any(each.doing in BRAKING for each in begun) else 0, False


def _mistake(what: What, phase: Phase, told: str) -> str:
    """Return the words for what a vehicle should have done, if one phase was its mistake."""
    if what is What.SHOULD_HAVE_KEPT_BRAKING:
        return f"should have kept braking but {told}"
    if what is What.SHOULD_HAVE_WAITED:
        return f"should have waited but set off at {phase.time_s:.1f} s"
    if phase.doing is Doing.SPED_UP_FURTHER:
        return f"should not have sped up further after {phase.time_s:.1f} s, to {phase.figure:.1f} m/s"
    return f"should not have sped up from {phase.time_s:.1f} s on, to {phase.figure:.1f} m/s"


def _clause(phase: Phase, *, is_late: bool) -> str:
    """Return the words for one phase; ``is_late`` is whether the vehicle then began to brake after it was due."""
    words = phase.doing.value.format(at=f"{phase.time_s:.1f} s", figure=phase.figure)
    if phase.doing is Doing.BRAKED and phase.is_again:
        words = words.replace("braked", "braked again")
    if phase.peak_s is not None:
        what, figure = words.removesuffix(begun := f" from {phase.time_s:.1f} s on").rstrip(",").split(" with up to ")
        words = f"{what.rstrip(',')}{begun}, with up to {figure} at {phase.peak_s:.1f} s"
    return words.replace("from", "only from") if is_late else words


def _deeds(who: str, phases: Sequence[Phase], told: Sequence[str]) -> list[str]:
    """Return sentences on one or two phases each, as far as they are short enough."""
    made: list[str] = []
    at = 0
    while at < len(told):
        begin, end = f"{'Then it' if made else who} {told[at]}", ""
        if at + 1 < len(told):
            end = f", {'and' if phases[at + 1].doing in (*BEGUN, Doing.STOOD) else 'but'} {told[at + 1]}"
        end = end if len(begin + end) < LONGEST else ""
        made.append(f"{begin}{end}.")
        at += 2 if end else 1
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
        return f"{place}. Both were equally fast"
    return f"{place}. {capitalised(whom)} was {abs(faster):.1f} m/s {'faster' if faster > 0 else 'slower'}"


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


def avoidance_sentence(time: float, braking: float) -> str:
    """Return the sentence that braking at a rate [m/s^2] from a time [s] on avoids the collision."""
    return f"Braking at {braking:.0f} m/s^2 from {time:.1f} s on avoids the collision."


def escape_sentences(
    time: float, driver: str, braking: float, braking_from: float, due: float, required: float
) -> tuple[str, ...]:
    """Return the sentences on a driver that takes over from an excused ego and avoids the collision.

    The driver takes over at a time [s], and brakes at up to a rate [m/s^2] from another time on. The rules require
    braking at the rate ``required`` from the time ``due`` on, and harder braking only in an emergency.
    """
    avoids = f"{driver}, taking over at {time:.1f} s, avoids it"
    if not braking:
        return (f"{avoids} without braking.",)
    limits = [f"only from {due:.1f} s on"] if braking_from < due - 0.05 else []
    if braking > HARDEST + 0.05:
        limits.append(f"no harder than {HARDEST:.1f} m/s^2")
    elif braking > required + 0.05:
        limits.append(f"no harder than {required:.1f} m/s^2 unless in an emergency")
    needed = (
        f"The rules require braking {', and '.join(limits)}." if limits else "It needs no more than the rules require."
    )
    return f"{avoids}: it brakes at up to {braking:.1f} m/s^2 from {braking_from:.1f} s on.", needed


def last_chance_sentence(time: float, driver: str, acceleration: float, of_ego: float) -> str:
    """Return the line with the time of the last chance [s] and the accelerations of driver and ego then [m/s^2]."""
    return f"Last chance at {time:.1f} s: {driver} {_doing(acceleration)}, the ego {_doing(of_ego)}"


def _doing(acceleration: float) -> str:
    if abs(acceleration) < 0.05:
        return "keeps its speed"
    return f"{'brakes' if acceleration < 0 else 'accelerates'} at {abs(acceleration):.1f} m/s^2"
