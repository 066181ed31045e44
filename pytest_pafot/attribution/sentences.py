"""The sentences that explain a verdict."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import pairwise
from types import MappingProxyType
from typing import Literal

import numpy as np

from pytest_pafot.attribution import takeovers
from pytest_pafot.criticality import RoadFrame
from pytest_pafot.criticality.measures import last_stretch
from pytest_pafot.model.instructions import Cell
from pytest_pafot.model.trace import ALONG, SPEED, FloatArray, Side, Trace, vehicle_name
from pytest_pafot.support.text import capitalised, listed

# What happened at the decisive tick: a vehicle moved into the other's lane, came too close, moved sideways into the
# other, braked or stopped without a reason, entered a conflict zone, or touched the other outside the zone.
Happened = Literal["moved", "close", "sideways", "braked", "stopped", "entered", "elsewhere"]

# The responsible side, as named in headlines and on the report page.
AT_FAULT: Mapping[str, str] = MappingProxyType(
    {
        "ego": "ego at fault",
        "npc": "NPC at fault",
        "both": "both at fault",
        "none": "neither at fault",
    }
)
ALSO = "There was also a collision in this run."
"""The sentence before the headline of a collision, if the run failed for another reason."""
STOOD = "stood still"
BRAKES = 0.5  # the smallest deceleration that sentences call braking [m/s^2]
TOLD = 2.0  # the sentences cover at least this time before the impact [s]
PHASES = 3  # the sentences list at most this many phases of a vehicle's speed, the last ones
# Smaller changes of speed are ignored as control noise [m/s]. In 776 runs on straight roads, NPCs that kept their lane
# and speed never braked. In 700 runs on curved roads, they lost either less than 0.16 m/s or, in a bend, more than 0.2
# m/s.
LOST = 0.2
SAME = 0.05  # up to this change, a vehicle counts as keeping its speed [m/s]


WHO: Mapping[str, str] = MappingProxyType(
    {
        "ego": "The ego is",
        "npc": "NPC {npc} is",
        "both": "The ego and NPC {npc} are both",
        "none": "Neither the ego nor NPC {npc} is",
    }
)
"""The subject of a sentence about the responsible side."""


def responsible_sentence(
    responsibility: str,
    npc: int | None,
    takeover: float | None = None,
) -> str:
    """Return a sentence about the responsible side, and one about the takeover [s before the impact] if it is known."""
    if npc is None:
        return "The ego is responsible, because a fixed object does not move."
    told = f"{WHO[responsibility].format(npc=npc)} responsible."
    if takeover is None:
        return told
    return f"{told} {takeovers.sentence(takeover)}"


def impact(
    time: float,
    npc: int | None,
    side: Side | None,
    cell: Cell | None,
    whence: str = "",
    closing: float | None = None,
    way: str = "",
) -> str:
    """Return the headline of a collision: who hit whom, when and how fast.

    Args:
        time: time [s] of the impact.
        npc: the NPC; None for a fixed object.
        side: side of the ego that was hit.
        cell: cell of the NPC at the impact; None if it crossed the ego's path.
        whence: side from which a crossing NPC came, such as ``from the left``.
        closing: closing speed [m/s].
        way: direction of the NPC, ``along`` or ``towards``; ``backwards`` if the ego reversed.
    """
    when = f"after {time:.1f} s"
    if closing is not None:
        when = f"{when}, closing at {closing:.1f} m/s"
    return f"{_who_hit_whom(npc, side, cell, whence, way)} {when}"


def _who_hit_whom(
    npc: int | None,
    side: Side | None,
    cell: Cell | None,
    whence: str,
    way: str,
) -> str:
    if npc is None:
        return "the ego hit a fixed object"
    other = f"NPC {npc}"
    if side == "rear":
        if way == "backwards":
            return f"the ego drove backwards into {other}"
        if way == "along":
            return f"{other} hit the ego from behind"
        return f"{other} hit the rear of the ego"
    if whence and side is not None:
        if side == "front":
            return f"the ego hit {other}, which came {whence},"
        return f"{other}, which came {whence}, hit the ego's {side} side"
    if side == "front":
        if cell is Cell.FRONT and way == "along":
            return f"the ego hit {other} from behind"
        if cell is Cell.FRONT and way == "towards":
            return f"the ego hit {other} head-on"
        if cell is None or cell is Cell.FRONT:
            return f"the ego's front hit {other}"
        return f"the ego's front hit {other} ({cell.label})"
    if side is None:
        return f"the ego and {other} touched"
    return f"the ego and {other} touched on the ego's {side} side"


def sentences_on(
    trace: Trace,
    frame: RoadFrame,
    npc: int,
    happened: Happened,
    vehicle: int,
    tick: int,
) -> tuple[str, ...]:
    """Return the sentences about a collision: the decisive event, then one each about the NPC and the ego."""
    ahead = frame.ahead[npc]
    half = frame.half_lengths(npc)
    hz = trace.physics_hz
    end = trace.ticks
    since = max(min(tick, end - round(TOLD * hz)), 0)
    # The distance to a vehicle ahead in its track shows how late the ego braked.
    is_leader = (frame.gap_across[:, npc] <= 0) & (ahead > half)
    gaps = np.where(is_leader, ahead - half, np.nan)
    told = [
        *_decisive(trace, frame, npc, happened, vehicle, tick),
        _about_npc(
            trace,
            frame,
            npc,
            since,
            is_told=(happened, since) == ("moved", tick),
            has_moved=happened == "moved",
        ),
        f"The ego {_deed(trace.states[:, 0, SPEED], hz, since, gaps, vehicle_name(npc + 1))}.",
    ]
    return tuple(capitalised(sentence) for sentence in told)


def _decisive(
    trace: Trace,
    frame: RoadFrame,
    npc: int,
    happened: Happened,
    vehicle: int,
    tick: int,
) -> list[str]:
    # The decisive event. If the vehicles only came too close, the other sentences show it.
    other = npc + 1 - vehicle
    who = vehicle_name(vehicle)
    whom = vehicle_name(other)
    at = f"{tick / trace.physics_hz:.1f} s"
    match happened:
        case "moved":
            lane = int(trace.road.numbers(other)[tick])
            into = f"the lane of {whom}" if lane < 0 else f"lane {lane}"
            ahead = float(frame.ahead[npc, tick])
            if not vehicle:
                ahead = -ahead
            spot = _place(ahead, float(frame.half_lengths(npc)[tick]), whom)
            return [f"{who} moved into {into} at {at}, {spot}."]
        case "sideways":
            return [f"{who} moved sideways at {at} into {whom}, which was next to it."]
        case "braked":
            return [f"{who} started to brake at {at} with nothing in its way."]
        case "stopped":
            moving = np.append(-1.0, trace.ego[:, SPEED]) > 0.1
            stood = (trace.ticks - int(np.flatnonzero(moving)[-1])) / trace.physics_hz
            return [
                f"{who} started to slow down at {at} with nothing in its way, and stood still for {stood:.1f} s."
            ]
        case "entered":
            return _entered(trace, npc)
        case "elsewhere":
            return [f"{who} touched {whom} at {at}, outside the zone where their paths cross."]
    return []


def _place(ahead: float, half: float, whom: str) -> str:
    # The place of a vehicle, from its distance ahead of another and half of both lengths [m].
    gap = abs(ahead) - half
    if gap <= 0:
        return f"next to {whom}"
    return f"{gap:.1f} m {'ahead of' if ahead > 0 else 'behind'} {whom}"


def _about_npc(
    trace: Trace,
    frame: RoadFrame,
    npc: int,
    since: int,
    *,
    is_told: bool,
    has_moved: bool,
) -> str:
    # `is_told`: the first sentence states the position of the NPC. `has_moved`: it is about a lane change.
    name = vehicle_name(npc + 1)
    ahead = float(frame.ahead[npc, since])
    crosses = trace.zone_of(npc) is not None
    # The NPC's lane is named if the ego was in another lane. The lane at the impact is named if the NPC changed lanes.
    numbers = trace.road.numbers(npc + 1)
    then = int(numbers[since])
    last = int(numbers[-1])
    subject = name
    # The position relative to the ego is omitted if the paths cross, or if the NPC is not on the ego's path.
    is_told = is_told or crosses or math.isnan(ahead)
    if not is_told:
        spot = _place(ahead, float(frame.half_lengths(npc)[since]), "the ego")
        if then not in (-1, int(trace.road.numbers(0)[since])):
            spot = f"in lane {then}, {spot}"
        if frame.speed[npc + 1, since] < -SAME and ahead > 0:
            spot = f"{spot} and coming towards it"
        subject = f"at {since / trace.physics_hz:.1f} s, {name} was {spot}. It"
    left = ""
    if not has_moved and -1 not in (then, last) and then != last:
        left = f", and was in lane {last} at the impact"
    # Only an NPC behind the ego could have braked for it.
    deed = _deed(
        trace.states[:, npc + 1, SPEED],
        trace.physics_hz,
        since,
        is_ahead=crosses or ahead > 0,
        is_told=not is_told,
    )
    return f"{subject} {deed}{left}."


def _entered(trace: Trace, npc: int) -> list[str]:
    zone = trace.zone_of(npc)
    if zone is None:
        return []
    where = "merge" if zone.kind == "merging" else "crossing"
    whom = vehicle_name(npc + 1)
    ego_is_past = trace.track_of(0)[:, ALONG] >= zone.ego[0]
    npc_is_past = trace.way_of(npc) >= zone.npc[0]
    own = last_stretch(ego_is_past) / trace.physics_hz
    its = last_stretch(npc_is_past) / trace.physics_hz
    holders = {"none": "neither", "ego": "the ego", "npc": whom}
    holder = capitalised(holders[zone.priority])
    return [
        f"the ego entered the {where} at {own:.1f} s, and {whom} entered it {zone.whence} at {its:.1f} s. "
        f"{holder} had priority."
    ]


def _deed(
    speeds: FloatArray,
    hz: float,
    since: int,
    gaps: FloatArray | None = None,
    leader: str = "",
    *,
    is_ahead: bool = False,
    is_told: bool = False,
) -> str:
    # The changes of speed up to the impact, phase by phase. With `gaps` to a leader [m], braking is stated in numbers.
    # Each phase has its time, if it is known, and its description.
    part = np.maximum(speeds[since:], 0.0)
    told: list[tuple[str, str]] = []
    has_braked = False
    for begin, end in pairwise([*_turns(part), len(part) - 1]):
        change = float(part[end] - part[begin])
        if not abs(change) >= LOST:  # also if the change is NaN
            continue
        # A constant speed at the start of the phase is mentioned if it lasted long enough.
        gained = part[begin : end + 1] - part[begin]
        if change < 0:
            gained = -gained
        steady = int(np.flatnonzero(gained <= SAME)[-1])
        first = begin + steady if steady >= TOLD / 4 * hz else begin
        when = ""
        if first:
            when = f"from {(since + first) / hz:.1f} s on"
        if first and not told:
            told.append(("", _kept(part[0])))
        steps = np.diff(part[begin : end + 1])
        hardest = -float(steps.min()) * hz
        how = "sped up"
        rate = ""
        if change < 0 and hardest >= BRAKES:
            how = "braked"
            if gaps is not None:
                rate = f" at up to {hardest:.1f} m/s^2"
                if not has_braked and not np.isnan(gaps[since + first]):
                    when = f"{when} ({gaps[since + first]:.1f} m behind {leader})".lstrip()
            has_braked = True
        elif change < 0:
            how = "slowed"
        if not told:
            how = f"{how} from {part[begin]:.1f}"
        told.append((when, f"{how} to {part[end]:.1f} m/s{rate}"))
    texts = [f"{when} {how}".lstrip() for when, how in told[-PHASES:]]
    if told:
        # The time stands after the first phase that is shown, and before the others.
        when, how = told[-PHASES:][0]
        texts[0] = f"{how} {when}".rstrip()
    if speeds[-1] < -SAME:
        return listed([*texts, f"drove backwards at {-speeds[-1]:.1f} m/s"])
    then = ""
    if since and (gaps is not None or not is_told):
        then = f" from {since / hz:.1f} s on"
    kept = _kept(part[-1])
    if not told and kept == STOOD:
        if is_ahead:
            return STOOD
        return f"{STOOD}{then}"
    if not told:
        texts = [kept]
    if not has_braked and not is_ahead:
        texts.append(f"did not brake{then}")
    return listed(texts)


def _kept(speed: float) -> str:
    if speed < SAME:
        return STOOD
    return f"drove at {speed:.1f} m/s"


def _turns(speeds: FloatArray) -> list[int]:
    # Tick 0, and the ticks at which the speed starts to rise or fall by at least LOST.
    turns = [0]
    low = 0
    high = 0
    way = 0
    # Single values are read from a list, because reading them from an array is slow.
    values = speeds.tolist()
    for tick, speed in enumerate(values):
        if speed < values[low]:
            low = tick
        if speed > values[high]:
            high = tick
        if way >= 0 and values[high] - speed >= LOST:
            turns.append(high)
            way = -1
            low = tick
        elif way <= 0 and speed - values[low] >= LOST:
            turns.append(low)
            way = 1
            high = tick
    return turns
