"""The sentences of attribution, and the facts that they are made of. No other file words them.

Each is at most 97 characters long, so that it needs no break in an explanation.
"""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

from pytest_pafot.attribution.avoidance import HARDEST
from pytest_pafot.model.crossings import Zone


class What(Enum):
    """What a fact says, and the words of its sentence."""

    CROSSED_LINE = "At {at} {who} crossed {into}, {place}."
    CAME_IN = "At {at} {who} came in {place}."
    BOTH_CROSSED = "At {at} {who} and at {later} {whom} crossed a lane line towards each other."
    KEPT_LANE = "From {at} on {who} kept its lane, {place}."
    CAME_SIDEWAYS = "At {at} {who} came sideways into {whom} beside it."
    CAME_TOO_CLOSE = "At {at} {who} was {place}."
    STOOD = "At {at} {who} was standing when {whom} touched it."
    BRAKED_FOR_NOTHING = (
        "At {at} {who} began to brake with up to {it.braking_m_per_s2:.1f} m/s^2 with nothing in its way."
    )
    STOPPED_FOR_NOTHING = "At {at} {who} began to stop with nothing in its way, and it stood for {it.lasting_s:.1f} s."
    LEFT_TOO_LITTLE = "{who} was due to leave {whom} a gap of {it.asked_m:.1f} m."
    GAVE_WAY = "{who} left {whom} more than the {it.asked_m:.1f} m that giving way takes."
    MOVED_IN_BEHIND = "At {at} {who} moved in behind {whom}."
    ENTERED = "{entered}."
    NONE_FORESAW = "Neither could have foreseen the other in time, by the rules."
    TOUCHED_ELSEWHERE = "At {at} {who} touched {whom} outside of the zone in which their ways meet."
    HAD_NO_TIME = "{who} had too little time to answer, by the rules."
    SPED_UP_INTO = "From {at} on {who} sped up to {it.speed_m_per_s:.1f} m/s towards {whom}."
    LET_BRAKES_GO = "{who} was due to keep braking and let the brakes go at {at}."
    DID_NOT_BRAKE = "{who} {due} and did not."
    BRAKED = "{who} {due}, but braked {how} (up to {it.braking_m_per_s2:.1f} m/s^2 from {at} on)."
    SPED_UP = "{who} {due}, but sped up to {it.speed_m_per_s:.1f} m/s from {at} on."


_WITHOUT_DUE = {
    What.DID_NOT_BRAKE: "From {at} on {who} did not brake.",
    What.BRAKED: "From {at} on {who} braked with up to {it.braking_m_per_s2:.1f} m/s^2.",
    What.SPED_UP: "From {at} on {who} sped up to {it.speed_m_per_s:.1f} m/s.",
}
"""Where no braking was due before the impact."""


class Fact(NamedTuple):
    """A fact of a reason; figures that its words do not tell are 0.

    Attributes:
        vehicle, other: whose it is, and towards, behind or ahead of whom; 0 is the ego, ``i + 1`` NPC ``i``.
        time_s: when it was so, or began to be; of two that crossed a line, or entered a zone, ``later_s`` is that of
            the other.
        due_s: from when on the vehicle was due to brake; None where it was not, or not before the impact.
        gap_m: between the boxes along the road: ahead of the other, negative behind it, 0 side by side.
        asked_m: what the gap should be.
        faster_m_per_s: by how much the other was faster; told where the one ahead, an NPC, did not brake with
            ``leader_m_per_s2``, which is then of more interest.
        lane: that was crossed into; None where it has no number.
        zone: that was entered.
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


Reason = tuple[Fact, ...]
"""What happened, then what was due; none without a collision."""


def sentences(reason: Reason) -> tuple[str, ...]:
    """One sentence a fact."""
    return tuple(map(_sentence, reason))


def responsible_sentence(responsibility: str, npc: int) -> str:
    """Who is responsible for a collision with an NPC."""
    who = {"ego": "the ego", "npc": f"NPC {npc}", "both": f"the ego and NPC {npc}", "none": "nobody"}[responsibility]
    return f"Responsible: {who}."


def _sentence(fact: Fact) -> str:
    words = fact.what.value if fact.due_s is not None else _WITHOUT_DUE.get(fact.what, fact.what.value)
    short = "too little" if fact.braking_m_per_s2 < HARDEST else "too briefly"
    text = words.format(
        it=fact,
        at=f"{fact.time_s:.1f} s",
        later=f"{fact.later_s:.1f} s",
        how="too late" if fact.time_s > (fact.due_s or 0.0) else short,
        due=f"was due to brake from {fact.due_s or 0.0:.1f} s on",
        who=_name(fact.vehicle),
        whom=_name(fact.other),
        into="a lane line" if fact.lane is None else f"into lane {fact.lane}",
        place=_place(fact),
        entered=_entered(fact),
    )
    return text[0].upper() + text[1:]


def _name(vehicle: int) -> str:
    return f"NPC {vehicle - 1}" if vehicle else "the ego"


def _place(fact: Fact) -> str:
    """Where a vehicle was as seen from the other, and how much faster that one was."""
    whom, faster = _name(fact.other), fact.faster_m_per_s
    if not fact.gap_m:
        return f"beside {whom}"
    safe = f" (safe: {fact.asked_m:.1f} m)" if fact.asked_m else ""
    place = f"{abs(fact.gap_m):.1f} m{safe} {'ahead of' if fact.gap_m > 0 else 'behind'} {whom}"
    if fact.leader_m_per_s2:
        return f"{place}, {'and' if fact.vehicle else 'which'} braked with up to {fact.leader_m_per_s2:.1f} m/s^2"
    pace = f"{abs(faster):.1f} m/s {'faster' if faster >= 0 else 'slower'}" if abs(faster) >= 0.05 else "as fast"
    return f"{place}, which was {pace}"


def _entered(fact: Fact) -> str:
    """Who entered a zone when, how long before or after the other, from where the NPC came, and who had priority."""
    if fact.zone is None:
        return ""
    zone, later = fact.zone, fact.later_s - fact.time_s
    apart = f"{abs(later):.1f} s {'before' if later > 0 else 'after'}" if abs(later) >= 0.05 else "together with"
    holder = None if zone.priority == "none" else 0 if zone.priority == "ego" else fact.vehicle or fact.other
    told = {each: ", which had priority" if each == holder else "" for each in (fact.vehicle, fact.other)}
    who, whom = (f"{_name(each)}{told[each]}" for each in (fact.vehicle, fact.other))
    who += "," if told[fact.vehicle] else ""
    entered = f"{who} entered the {'merge' if zone.kind == 'merging' else 'crossing'}"
    at = f"at {fact.time_s:.1f} s, {apart}"
    if holder is None:
        whom += "; neither had priority" if fact.vehicle else f" {zone.whence}; neither had priority"
    elif not fact.vehicle:
        whom += f", {zone.whence}"
    return f"{entered} {zone.whence} {at} {whom}" if fact.vehicle else f"{entered} {at} {whom}"


def avoidance_sentence(time: float, braking: float) -> str:
    """From when on [s] which braking [m/s^2] avoids a collision, as it was driven."""
    return f"Braking with {braking:.0f} m/s^2 from {time:.1f} s on avoids it."


def last_chance_sentence(time: float, driver: str, acceleration: float, of_ego: float) -> str:
    """When a reference driver still had a chance [s], and what it and the ego did then [m/s^2]."""
    return f"last chance {time:.1f} s: {driver} {_doing(acceleration)}, the ego {_doing(of_ego)}"


def _doing(acceleration: float) -> str:
    if abs(acceleration) < 0.05:
        return "keeps its speed"
    return f"{'brakes' if acceleration < 0 else 'accelerates'} with {abs(acceleration):.1f} m/s^2"
