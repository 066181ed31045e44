"""Passages of the zones where NPCs' ways meet the ego's: when each vehicle is in the zone, and how narrowly they pass.

The beginning and end of a zone are those of :class:`~pytest_pafot.Zone`. A vehicle is in a zone as long as its box
could touch the box of a vehicle on the other way.

Sources: Allen, Shin, Cooper, "Analysis of traffic conflicts and collisions", Transportation Research Record 667, 1978,
for post-encroachment time; Laureshyn, Svensson, Hyden, "Evaluation of traffic safety, based on micro-level behavioural
data", Accident Analysis and Prevention 42, 2010, for time advantage, which is the predicted post-encroachment time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from pytest_pafot.model.crossings import Stretch, Zone
from pytest_pafot.model.trace import ALONG, SPEED, FloatArray, Trace

ROUNDING = 1e-6
"""The tolerance for the rounding of a time in ticks."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Passage:
    """The times at which the ego and an NPC were in the zone where their ways meet.

    Attributes:
        npc: its index.
        zone: zone where the two ways meet.
        ego_enters, npc_enters: time of its first tick in the zone [s]; inf if it never was there.
        ego_leaves, npc_leaves: time of its first tick after it [s]; inf if it did not leave.
    """

    npc: int
    zone: Zone
    ego_enters: float
    ego_leaves: float
    npc_enters: float
    npc_leaves: float

    @property
    def post_encroachment_time(self) -> float:
        """The time between the first vehicle's exit from the zone and the second one's entry [s]; lower is worse.

        0 if both were in the zone at the same time, inf if one of them never arrived.
        """
        if math.inf in (self.ego_enters, self.npc_enters):
            return math.inf
        return max(self.npc_enters - self.ego_leaves, self.ego_enters - self.npc_leaves, 0.0)


def passages(trace: Trace) -> tuple[Passage | None, ...]:
    """Return for each NPC the passage of the zone where its way meets the ego's; None if it does not cross.

    None, too, if a user's world records zones but not the vehicles' positions on their ways.
    """
    zones = trace.zones if _has_places(trace) else ()
    return tuple(_passage(trace, npc, zone) for npc, zone in enumerate(zones or (None,) * len(trace.npcs[0])))


def time_advantage(trace: Trace) -> FloatArray:
    """Return the post-encroachment time that would result if ego and NPC kept their speeds [s]; lower is worse.

    Shape [ticks + 1, NPCs]. 0 if both would be in the zone at the same time. Infinite if one of them would never reach
    the zone, and for an NPC that does not cross. After a vehicle has entered or left the zone, the actual time is used.
    """
    advantage = np.full((trace.ticks + 1, trace.states.shape[1] - 1), np.inf)
    for npc, zone in enumerate(trace.zones):
        if zone is None:
            continue
        if not _has_places(trace):
            advantage[:, npc] = np.nan
            continue
        ego, other = (
            [_seconds_to(place, along, trace.states[:, vehicle, SPEED], trace.physics_hz) for place in stretch]
            for vehicle, along, stretch in _ways(trace, npc, zone)
        )
        with np.errstate(invalid="ignore"):  # inf - inf, if both never arrive
            gap = np.maximum(other[0] - ego[1], ego[0] - other[1])
        is_alone = np.isposinf(ego[0]) | np.isposinf(other[0])
        advantage[:, npc] = np.where(is_alone, np.inf, np.maximum(gap, 0.0))
    return advantage


def times_expected(trace: Trace, npc: int, tick: int) -> tuple[Stretch, Stretch]:
    """Return when the ego would have been in the zone of an NPC at its speed of a tick, and when the NPC was [s].

    Both are the times of entering and leaving. What the NPC had not reached at the end of the run is at its speed then.
    """
    zone: Any = trace.zones[npc]
    hz = trace.physics_hz
    ego_enters, ego_leaves, enters, leaves = (
        at / hz + float(_seconds_to(place, along, trace.states[:, vehicle, SPEED], hz)[at])
        for at, (vehicle, along, stretch) in zip((tick, trace.ticks), _ways(trace, npc, zone), strict=True)
        for place in stretch
    )
    return (ego_enters, ego_leaves), (enters, leaves)


def _has_places(trace: Trace) -> bool:
    """Return whether a run has the places of all vehicles on the ways for which its zones are."""
    return trace.on_way is not None and not trace.road.is_straight


def _passage(trace: Trace, npc: int, zone: Zone | None) -> Passage | None:
    if zone is None:
        return None
    enters_and_leaves = [
        [_first_at(place, along) / trace.physics_hz for place in stretch]
        for _, along, stretch in _ways(trace, npc, zone)
    ]
    (ego_enters, ego_leaves), (npc_enters, npc_leaves) = enters_and_leaves
    return Passage(
        npc=npc, zone=zone, ego_enters=ego_enters, ego_leaves=ego_leaves, npc_enters=npc_enters, npc_leaves=npc_leaves
    )


def _ways(trace: Trace, npc: int, zone: Zone) -> tuple[tuple[int, FloatArray, Stretch], ...]:
    """Return for the ego and for an NPC: vehicle index, positions along its way [m], and its stretch of the zone."""
    on_way: Any = trace.on_way
    return (0, trace.track_of(0)[:, ALONG], zone.ego), (npc + 1, on_way[:, npc], zone.npc)


def _first_at(place: float, along: FloatArray) -> float:
    """Return the first tick at which a vehicle had reached a place [m]; inf if never, NaN if a position is unknown."""
    if np.isnan(along).any():
        return math.nan
    ticks = np.flatnonzero(along >= place)
    return float(ticks[0]) if ticks.size else math.inf


def _seconds_to(place: float, along: FloatArray, speed: FloatArray, hz: int) -> FloatArray:
    """Return, for each tick, the seconds until a vehicle reaches a place at its present speed.

    From the tick at which the vehicle reaches the place on, they are 0 or negative and count the time since then.
    """
    ticks = np.arange(len(along))
    is_moving = speed > 0
    ahead: FloatArray = np.where(is_moving, (place - along) / np.where(is_moving, speed, 1.0), np.inf)
    first = _first_at(place, along)
    return np.where(ticks >= first, (min(first, len(along)) - ticks) / hz, ahead)
