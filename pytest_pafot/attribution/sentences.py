"""The sentences that explain a verdict: measured facts about the last seconds, which decide nothing.

No other module has such sentences.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal

import numpy as np

from pytest_pafot.criticality import RoadFrame, RssRules
from pytest_pafot.criticality.measures import last_stretch, stretches
from pytest_pafot.model.crossings import Zone
from pytest_pafot.model.trace import ALONG, SPEED, FloatArray, Trace
from pytest_pafot.support.text import capitalised

Happened = Literal["moved", "close", "sideways", "braked", "stopped", "entered", "elsewhere"]
"""What happened at the tick that decides: a vehicle moved into the other's lane, came too close, or moved sideways into
the other, braked or stopped for nothing, entered a zone where the ways meet, or touched the other elsewhere."""

AT_FAULT: Mapping[str, str] = MappingProxyType(
    {"ego": "ego at fault", "npc": "NPC at fault", "both": "both at fault", "none": "nobody at fault"}
)
"""Who is responsible for a collision, in the words of headlines and of the report page."""
BRAKES, TOLD = 0.5, 2.0
"""The least deceleration that counts as braking in the sentences [m/s^2], and the least time
before the impact that they tell [s]."""
LOST = 0.2
"""The least loss of speed that counts as braking, and the least gain that counts as speeding up [m/s]; less is a twitch
of a controller. In 776 runs on straight roads, NPCs that kept lane and speed never braked. In 700 on bent roads, they
lost less than 0.16 m/s, or more than 0.2 m/s for a bend, and hardly ever anything between."""


def responsible_sentence(responsibility: str, npc: int | None) -> str:
    """Return the sentence that says who is responsible for a collision with an NPC, or with a fixed object (None)."""
    if npc is None:
        return "The ego is responsible, because a fixed object does not move."
    if responsibility == "both":
        return f"Both are responsible: the ego and NPC {npc}."
    who = {"ego": "The ego", "npc": f"NPC {npc}", "none": f"Neither the ego nor NPC {npc}"}[responsibility]
    return f"{who} is responsible."


def sentences_on(
    trace: Trace, frame: RoadFrame, rules: RssRules, npc: int, happened: Happened, vehicle: int, tick: int
) -> tuple[str, ...]:
    """Return the sentences on a collision with an NPC: what happened at a tick, by a vehicle, and what both did.

    The last two are on the ego and on the NPC, one each: what it did since the tick, or in the last two seconds.
    ``rules`` are those of the safe distance.
    """
    other, hz, end = npc + 1 - vehicle, trace.physics_hz, trace.ticks
    (who, whom), at = (_name(vehicle), _name(other)), f"{tick / hz:.1f} s"
    ahead = -float(frame.ahead[npc, tick]) if vehicle == 0 else float(frame.ahead[npc, tick])
    gap = abs(ahead) - float(frame.half_along[vehicle, tick] + frame.half_along[other, tick])
    place = f"next to {whom}" if gap <= 0 else f"{gap:.1f} m {'ahead of' if ahead > 0 else 'behind'} {whom}"
    match happened:
        case "moved":
            lane = int(trace.road.numbers(other)[tick])
            into = f"the lane of {whom}" if lane < 0 else f"lane {lane}"
            told = [f"{who} moved into {into} at {at}, {place}."]
        case "close":
            safe = float(frame.safe_along(rules)[tick, npc])
            told = [f"{who} was {place} at {at}" + (f"; {safe:.1f} m are safe." if 0 < gap < safe else ".")]
        case "sideways":
            told = [f"{who} moved sideways at {at} into {whom}, which was next to it."]
        case "braked":
            told = [f"{who} braked from {at} on with nothing in its way."]
        case "stopped":
            stood = end - int(np.flatnonzero(np.append(-1.0, trace.ego[:, SPEED])[: end + 2] > 0.1)[-1])
            told = [f"{who} stopped from {at} on with nothing in its way, and stood for {stood / hz:.1f} s."]
        case "entered":
            told = _entered(trace, npc, trace.zones[npc])
        case "elsewhere":
            told = [f"{who} touched {whom} at {at}, outside the zone where their ways meet."]
    since = max(min(tick, end - round(TOLD * hz)), 0)
    told += [_deed(trace.states[:, each, SPEED], hz, since, _name(each)) for each in (0, npc + 1)]
    return tuple(capitalised(sentence) for sentence in told)


def _name(vehicle: int) -> str:
    return f"NPC {vehicle - 1}" if vehicle else "the ego"


def _entered(trace: Trace, npc: int, zone: Zone | None) -> list[str]:
    """Return when the two entered the zone where their ways meet, and which of them had priority."""
    if zone is None:
        return []
    times = []
    for places, (begins, _) in ((trace.track_of(0)[:, ALONG], zone.ego), (trace.way_of(npc), zone.npc)):
        times.append(last_stretch(places >= begins) / trace.physics_hz)
    where, whom = "merge" if zone.kind == "merging" else "crossing", _name(npc + 1)
    holder = capitalised({"none": "neither", "ego": "the ego", "npc": whom}[zone.priority])
    entered = f"the ego entered the {where} at {times[0]:.1f} s, {whom} {zone.whence} at {times[1]:.1f} s"
    return [f"{entered}. {holder} had priority."]


def brakings(speeds: FloatArray, hz: int) -> list[tuple[int, int]]:
    """Return the tick at which each braking in a vehicle's speeds [m/s] begins, and the tick until which it lasts."""
    found = stretches(-np.diff(speeds) * hz >= BRAKES)
    return [(begin, end) for begin, end in found if speeds[begin] - speeds[end] >= LOST]


def _deed(speeds: FloatArray, hz: int, tick: int, who: str) -> str:
    """Return how a vehicle braked, and how its speed changed, from a tick up to the impact."""
    part, seconds = np.maximum(speeds[tick:], 0.0), (len(speeds) - 1 - tick) / hz
    after, slowest = part[-1], len(part) - 1 - int(part[::-1].argmin())
    braked, since = brakings(part, hz), (tick + slowest) / hz
    hardest = max((-float(np.diff(part[begin : until + 1]).min()) * hz for begin, until in braked), default=0.0)
    if part[-1] - part[slowest] >= LOST:
        before = (
            f"braked at up to {hardest:.1f} m/s^2 to {part[slowest]:.1f} m/s, and" if braked else "did not brake, but"
        )
        return f"{who} {before} sped up to {after:.1f} m/s from {since:.1f} s on."
    if braked:
        late = braked[0][0] / hz
        waited = f"did not brake for {late:.1f} s after {tick / hz:.1f} s, then " if late else ""
        return f"{who} {waited}braked at up to {hardest:.1f} m/s^2, to {after:.1f} m/s."
    speed = "kept" if part[0] - after < LOST else "slowed to"
    return f"{who} {speed} {after:.1f} m/s and did not brake in the {seconds:.1f} s before the impact."
