"""The sentences that explain a verdict."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from types import MappingProxyType
from typing import Literal

import numpy as np

from pytest_pafot.attribution import takeovers
from pytest_pafot.criticality import RoadFrame
from pytest_pafot.criticality.measures import last_stretch
from pytest_pafot.model.crossings import Zone
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
# BRAKES: the smallest deceleration that sentences call braking [m/s^2]. TOLD: the sentences cover at least this time
# before the impact [s]. PHASES: the sentences list at most this many phases of a vehicle's speed, the last ones.
BRAKES, TOLD, PHASES = 0.5, 2.0, 3
# LOST: smaller changes of speed are ignored as control noise [m/s]. In 776 runs on straight roads, NPCs that kept their
# lane and speed never braked. In 700 runs on curved roads, they lost either less than 0.16 m/s or, in a bend, more than
# 0.2 m/s. SAME: up to this change, a vehicle counts as keeping its speed [m/s].
LOST, SAME = 0.2, 0.05


def responsible_sentence(
    responsibility: str, npc: int | None, takeover: float | None = None
) -> str:
    """Return a sentence about the responsible side, and one about the takeover [s before the impact] if it is known."""
    if npc is None:
        return "The ego is responsible, because a fixed object does not move."
    who = {"ego": "The ego", "npc": f"NPC {npc}", "none": f"Neither the ego nor NPC {npc}"}
    told = (
        f"{who[responsibility]} is" if responsibility in who else f"The ego and NPC {npc} are both"
    )
    avoids = "" if takeover is None else f" {takeovers.sentence(takeover)}"
    return f"{told} responsible.{avoids}"


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
    when = f"after {time:.1f} s" + ("" if closing is None else f", closing at {closing:.1f} m/s")
    if npc is None:
        return f"the ego hit a fixed object {when}"
    if side == "rear" and way == "backwards":
        return f"the ego drove backwards into NPC {npc} {when}"
    if side == "rear":
        return (
            f"NPC {npc} hit the {'ego from behind' if way == 'along' else 'rear of the ego'} {when}"
        )
    if whence and side is not None:
        crossing = f"NPC {npc}, which came {whence},"
        return (
            f"the ego hit {crossing} {when}"
            if side == "front"
            else f"{crossing} hit the ego's {side} side {when}"
        )
    if side == "front" and cell is Cell.FRONT and way in ("along", "towards"):
        return f"the ego hit NPC {npc} {'from behind' if way == 'along' else 'head-on'} {when}"
    if side == "front":
        return f"the ego's front hit NPC {npc}{'' if cell in (None, Cell.FRONT) else f' ({cell.label})'} {when}"
    where = "touched" if side is None else f"touched on the ego's {side} side"
    return f"the ego and NPC {npc} {where} {when}"


def sentences_on(
    trace: Trace, frame: RoadFrame, npc: int, happened: Happened, vehicle: int, tick: int
) -> tuple[str, ...]:
    """Return the sentences about a collision: the decisive event, then one each about the NPC and the ego."""
    # The decisive event comes first. It is omitted if the vehicles only came too close, which the other sentences show.
    other, hz, end = npc + 1 - vehicle, trace.physics_hz, trace.ticks
    (who, whom), at = (vehicle_name(vehicle), vehicle_name(other)), f"{tick / hz:.1f} s"
    ahead, half, name = frame.ahead[npc], frame.half_lengths(npc), vehicle_name(npc + 1)

    def place(of: float, whom: str, tick: int) -> str:
        gap = abs(of) - float(half[tick])
        return (
            f"next to {whom}"
            if gap <= 0
            else f"{gap:.1f} m {'ahead of' if of > 0 else 'behind'} {whom}"
        )

    told = []
    match happened:
        case "moved":
            lane = int(trace.road.numbers(other)[tick])
            into = f"the lane of {whom}" if lane < 0 else f"lane {lane}"
            spot = place(float(ahead[tick]) * (1 if vehicle else -1), whom, tick)
            told = [f"{who} moved into {into} at {at}, {spot}."]
        case "sideways":
            told = [f"{who} moved sideways at {at} into {whom}, which was next to it."]
        case "braked":
            told = [f"{who} started to brake at {at} with nothing in its way."]
        case "stopped":
            stood = (
                end - int(np.flatnonzero(np.append(-1.0, trace.ego[:, SPEED])[: end + 2] > 0.1)[-1])
            ) / hz
            told = [
                f"{who} started to slow down at {at} with nothing in its way, and stood still for {stood:.1f} s."
            ]
        case "entered":
            told = _entered(trace, npc, trace.zones[npc])
        case "elsewhere":
            told = [f"{who} touched {whom} at {at}, outside the zone where their paths cross."]
    since = max(min(tick, end - round(TOLD * hz)), 0)
    # Then the NPC. Its position relative to the ego is omitted if the paths cross, if the first sentence states it, or
    # if the NPC is not on the ego's path.
    crosses = bool(trace.zones and trace.zones[npc])
    is_told = crosses or (happened, since) == ("moved", tick) or bool(np.isnan(ahead[since]))
    towards = (
        " and coming towards it" if frame.speed[npc + 1, since] < -SAME and ahead[since] > 0 else ""
    )
    # The NPC's lane is named if the ego was in another lane. The lane at the impact is named if the NPC changed lanes.
    then, last = (int(each) for each in trace.road.numbers(npc + 1)[[since, end]])
    in_lane = f"in lane {then}, " if then not in (-1, int(trace.road.numbers(0)[since])) else ""
    has_left = happened != "moved" and -1 not in (then, last) and then != last
    left = f", and was in lane {last} at the impact" if has_left else ""
    spot = f"{in_lane}{place(float(ahead[since]), 'the ego', since)}{towards}"
    subject = name if is_told else f"at {since / hz:.1f} s, {name} was {spot}. It"
    # Only an NPC behind the ego could have braked for it.
    is_ahead = crosses or bool(ahead[since] > 0)
    deed = _deed(trace.states[:, npc + 1, SPEED], hz, since, is_ahead=is_ahead, is_told=not is_told)
    told.append(f"{subject} {deed}{left}.")
    # Then the ego. The distance to a vehicle ahead in its track shows how late the ego braked.
    gaps = np.where((frame.gap_across[:, npc] <= 0) & (ahead > half), ahead - half, np.nan)
    told.append(f"The ego {_deed(trace.states[:, 0, SPEED], hz, since, gaps, name)}.")
    return tuple(capitalised(sentence) for sentence in told)


def _entered(trace: Trace, npc: int, zone: Zone | None) -> list[str]:
    if zone is None:
        return []
    times = []
    for places, (begins, _) in (
        (trace.track_of(0)[:, ALONG], zone.ego),
        (trace.way_of(npc), zone.npc),
    ):
        times.append(last_stretch(places >= begins) / trace.physics_hz)
    where, whom = "merge" if zone.kind == "merging" else "crossing", vehicle_name(npc + 1)
    holder = capitalised({"none": "neither", "ego": "the ego", "npc": whom}[zone.priority])
    told = [
        f"entered the {where} at {times[0]:.1f} s",
        f"{whom} entered it {zone.whence} at {times[1]:.1f} s",
    ]
    return [f"the ego {', and '.join(told)}. {holder} had priority."]


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
    part, told, has_braked = np.maximum(speeds[since:], 0.0), list[tuple[str, str]](), False
    for begin, end in pairwise([*_turns(part), len(part) - 1]):
        change = float(part[end] - part[begin])
        if not abs(change) >= LOST:  # also if the change is NaN
            continue
        # A constant speed at the start of the phase is mentioned if it lasted long enough.
        way = 1 if change > 0 else -1
        first = begin + int(np.flatnonzero(way * (part[begin : end + 1] - part[begin]) <= SAME)[-1])
        first = first if first - begin >= TOLD / 4 * hz else begin
        when, rate = f"from {(since + first) / hz:.1f} s on" if first else "", ""
        told += [("", _kept(part[0]))] if first and not told else []
        hardest = -float(np.diff(part[begin : end + 1]).min()) * hz
        is_braking = change < 0 and hardest >= BRAKES
        if is_braking and gaps is not None:
            rate = f" at up to {hardest:.1f} m/s^2"
            if not has_braked and not np.isnan(gaps[since + first]):
                when = f"{when} ({gaps[since + first]:.1f} m behind {leader})".lstrip()
        has_braked |= is_braking
        how = "braked" if is_braking else "slowed" if change < 0 else "sped up"
        told.append(
            (
                when,
                f"{how}{'' if told else f' from {part[begin]:.1f}'} to {part[end]:.1f} m/s{rate}",
            )
        )
    then = f" from {since / hz:.1f} s on" if since and (gaps is not None or not is_told) else ""
    # The time stands after the first phase that is shown, and before the others.
    texts = [
        f"{when} {how}" if number and when else f"{how} {when}".rstrip()
        for number, (when, how) in enumerate(told[-PHASES:])
    ]
    if speeds[-1] < -SAME:
        return listed([*texts, f"drove backwards at {-speeds[-1]:.1f} m/s"])
    if not told and _kept(part[-1]) == STOOD:
        return STOOD if is_ahead else f"{STOOD}{then}"
    texts = texts or [_kept(part[-1])]
    return listed([*texts, *([] if has_braked or is_ahead else [f"did not brake{then}"])])


def _kept(speed: float) -> str:
    return STOOD if speed < SAME else f"drove at {speed:.1f} m/s"


def _turns(speeds: FloatArray) -> list[int]:
    # Tick 0, and the ticks at which the speed starts to rise or fall by at least LOST.
    turns, low, high, way = [0], 0, 0, 0
    # Single values are read from a list, because reading them from an array is slow.
    for tick, speed in enumerate(values := speeds.tolist()):
        low, high = (tick if speed < values[low] else low), (tick if speed > values[high] else high)
        if way >= 0 and values[high] - speed >= LOST:
            turns, way, low = [*turns, high], -1, tick
        elif way <= 0 and speed - values[low] >= LOST:
            turns, way, high = [*turns, low], 1, tick
    return turns
