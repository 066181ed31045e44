"""The sentences of attribution, and the facts that verdicts give as their reason. No other file words them."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple


class What(Enum):
    """What a fact says, and its words; "; " goes before those that begin with no sign of their own."""

    CROSSED_LINE = (
        "at {at} {who} crossed the lane line towards {whom} ({it.sideways_m_per_s:.1f} m/s sideways), {place}"
    )
    CAME_CLOSE = ", and came into its track only {it.gap_m:.1f} m ahead at {at}"
    LEFT_TOO_LITTLE = ", where giving way takes {it.asked_m:.1f} m"
    SLOWED_DOWN = ", as it slowed down to {it.speed_m_per_s:z.1f} m/s"
    GAVE_WAY = ", more than the {it.asked_m:.1f} m that giving way takes"
    KEPT_LANE = "from {at} on {who} kept the lane ahead"
    CAME_SIDEWAYS = "at {at} {who} came sideways into {whom}, side by side"
    CAME_TOO_CLOSE = (
        "from {at} on {who} was {it.gap_m:.1f} m behind {whom}, closer than the {it.asked_m:.1f} m that RSS demands"
    )
    AS_THE_RUN_BEGAN = " as the run began"
    STOOD = "{who} was standing ({it.speed_m_per_s:.1f} m/s) at the impact"
    BRAKED_FOR_NOTHING = "from {at} {who} braked with up to {it.braking_m_per_s2:.1f} m/s^2 with nothing in its way"
    STOPPED_FOR_NOTHING = (
        "from {at} {who} braked to a standstill with nothing in its way and stood for {it.lasting_s:.1f} s"
    )
    MOVED_IN_BEHIND = ", and {who} moved in behind it"
    BRAKED_HARD = ", and braked with up to {it.braking_m_per_s2:.1f} m/s^2"
    BRAKING_HELPS = "{whose}braking with {it.braking_m_per_s2:.0f} m/s^2 from {at} on would have avoided it"
    CALM_BRAKING_HELPS = (
        "braking with {it.calm_m_per_s2:.0f} to {it.braking_m_per_s2:.0f} m/s^2 from {at} on would have avoided it"
    )
    WAS_NO_FASTER = "; but until {at} {who} was no faster"
    LET_BRAKES_GO = (
        "; but {who} let the brakes go at {at}, "
        "where braking on with {it.braking_m_per_s2:.0f} m/s^2 would have avoided it"
    )
    CUT_IN_TOO_LATE = ", too late to avoid it"
    NOTHING_HELPS = ", and no response could avoid it"
    NOTHING_HELPS_BEHIND = ", and {who} behind could not avoid it"
    NOTHING_HELPS_ANY_MORE = ", and {who} could not avoid it any more when the ego kept the lane"
    SPED_UP_INTO = "; from {at} on {who} sped up to {it.speed_m_per_s:.1f} m/s towards {whom}"
    BRAKED = "{who} braked from {at} on with up to {it.braking_m_per_s2:.1f} m/s^2"
    SPED_UP = "{who} sped up to {it.speed_m_per_s:.1f} m/s"
    DID_NOT_BRAKE = "{who} did not brake"


class Fact(NamedTuple):
    """A fact of a reason; figures that its words do not tell are 0.

    Attributes:
        vehicle, other: whose it is, and towards or behind whom; 0 is the ego, ``i + 1`` NPC ``i``.
        time_s: when it was so, or began to be.
        gap_m: between the boxes along the road. Of who crossed a line negative behind the other, 0 side by side.
        asked_m: what the gap should be.
        braking_m_per_s2, calm_m_per_s2: the hardest, and what is enough where it is no emergency.
    """

    what: What
    vehicle: int
    time_s: float
    other: int = 0
    gap_m: float = 0.0
    asked_m: float = 0.0
    speed_m_per_s: float = 0.0
    sideways_m_per_s: float = 0.0
    faster_m_per_s: float = 0.0
    braking_m_per_s2: float = 0.0
    calm_m_per_s2: float = 0.0
    lasting_s: float = 0.0


Reason = tuple[Fact, ...]
"""Facts in the order in which they are told; none without a collision."""


def sentence(reason: Reason) -> str:
    """The end of a sentence that begins with "because"."""
    if len(reason) > 1 and reason[1].what is What.CROSSED_LINE:
        when = " and ".join(f"at {fact.time_s:.1f} s {_name(fact.vehicle)}" for fact in reason)
        sideways = " and ".join(f"{fact.sideways_m_per_s:.1f}" for fact in reason)
        return f"{when} crossed a lane line towards each other ({sideways} m/s sideways)"
    text, before = "", None
    for fact in reason:
        who, whom, place = _name(fact.vehicle), _name(fact.other), _place(fact) if fact.gap_m else "side by side"
        whose, at = f"{who}'s " if fact.vehicle else "", f"{fact.time_s:.1f} s"
        words = fact.what.value.format(it=fact, at=at, who=who, whose=whose, whom=whom, place=place)
        if before and words[0] not in ",; ":
            has_and = before.what is What.WAS_NO_FASTER or (before.what, before.vehicle) == (What.KEPT_LANE, 0)
            text += ", and " if has_and else "; "
        text, before = text + words, fact
    return text or "there was no collision"


def _name(vehicle: int) -> str:
    return f"NPC {vehicle - 1}" if vehicle else "the ego"


def _place(crossed: Fact) -> str:
    """Where one that crossed a line was, and how much faster, as seen from the other."""
    faster = crossed.faster_m_per_s
    pace = f"{abs(faster):.1f} m/s {'faster' if faster >= 0 else 'slower'}" if abs(faster) >= 0.05 else "as fast"
    return f"{abs(crossed.gap_m):.1f} m {'ahead' if crossed.gap_m > 0 else 'behind'}, {pace}"


def last_chance_sentence(time: float, driver: str, acceleration: float, of_ego: float) -> str:
    """When a reference driver still had a chance [s], and what it and the ego did then [m/s^2]."""
    return f"last chance {time:.1f} s: {driver} {_doing(acceleration)}, this policy {_doing(of_ego)}"


def _doing(acceleration: float) -> str:
    if abs(acceleration) < 0.05:
        return "keeps its speed"
    return f"{'brakes' if acceleration < 0 else 'accelerates'} with {abs(acceleration):.1f} m/s^2"
