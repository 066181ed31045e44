"""The ways of other traffic and the zones in which they meet the ego's way.

A world provides these ways and zones, a search samples from them, and the rules of attribution read them. The place of
a vehicle is the distance of its centre along its way [m]. A stretch ``(enters, leaves)`` of a way is the part on which
the vehicle's box can touch the box of a vehicle on the other way, so a vehicle that waits before ``enters`` blocks no
vehicle.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from pytest_pafot.model.instructions import CrossingInstruction

FloatArray = npt.NDArray[np.float64]
Stretch = tuple[float, float]

Kind = Literal["crossing", "oncoming", "merging"]
"""How an NPC's way meets the ego's way. Crossing: it leads across the ego's. Oncoming: the NPC comes from ahead, and it
or the ego turns across the other's way. Merging: both ways continue in the same lane."""
Origin = Literal["left", "right", "ahead", "behind"]
"""The direction that a vehicle comes from, as seen by the ego when the ego drives up to the zone."""
Holder = Literal["ego", "npc", "none"]
"""The vehicle that has priority in a zone: the ego, the NPC or neither."""

EGOS = ""
"""The name of the ego's way; the names of other ways contain ``>``."""
NOT_ON_WAY = 0.5
"""The angle to the ego's way above which a vehicle is not on it [rad]."""
STEP = 0.5
"""Distance between the points of a way [m]."""
APART = 0.7
"""The least time between two NPCs that drive through the same place [s]."""
LENGTH = 5.0
"""Length of a vehicle [m]."""
BEFORE_LINE, STOPPING = 2.0, 6.0
"""The distance between a waiting NPC and its zone [m], and the hardest braking with which it stops there [m/s^2]."""
WAITING = ("hold", "late")
"""The acts of NPCs that stop at the line before the zone."""
EASY_BRAKING, CREEPING = 2.5, 2.0
"""The planned braking of an NPC for its line [m/s^2], and the time that creeping up to the line adds to the braking
time [s]."""
EARLIER = 1.0
"""The time for which an NPC that starts late stands at the line before it sets off [s]."""
SETTING_OFF = 2.0
"""The acceleration with which a waiting vehicle is expected to set off [m/s^2]."""


def longer(stretch: Stretch, by: float) -> Stretch:
    """Return the stretch of a way in which a vehicle is that is longer than a car [m], as measured at its centre."""
    return stretch[0] - by / 2, stretch[1] + by / 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Zone:
    """The zone where an NPC's way first meets the ego's.

    Attributes:
        way: entry and exit of the NPC's way, such as ``"o1>o3"``.
        kind: how the two ways meet: ``"crossing"``, ``"oncoming"`` or ``"merging"``.
        origin: where the NPC comes from: ``"left"``, ``"right"``, ``"ahead"`` or ``"behind"``.
        ego, npc: the stretches of both ways in the zone [m].
        priority: who has it: ``"ego"``, ``"npc"`` or ``"none"``.
        line: points of the NPC's way, x and y [m], for pictures; empty if unknown.
    """

    way: str
    kind: Kind
    origin: Origin
    ego: Stretch
    npc: Stretch
    priority: Holder
    line: tuple[tuple[float, float], ...] = field(default=(), compare=False, repr=False)

    @property
    def whence(self) -> str:
        """The direction that the NPC comes from, in words: ``from the left``."""
        return f"from {'the ' if self.origin in ('left', 'right') else ''}{self.origin}"


class CrossingVehicle(NamedTuple):
    """A vehicle on a way that meets the ego's, as an observer with a map could measure it.

    Distances are measured from the centre of a vehicle along its own way. They are negative inside the zone.

    Attributes:
        id: the NPC's index in ``run.npcs``.
        zone: where the two ways first meet, and who has priority.
        distance: from the vehicle to the beginning of the zone [m].
        ego_distance: from the ego to it [m].
        ahead, right: its centre relative to the ego's, in the ego's frame [m].
        heading: relative to the ego's, positive to the right [rad].
        speed: its speed [m/s].
        length, width: its size [m].
    """

    id: int
    zone: Zone
    distance: float
    ego_distance: float
    ahead: float
    right: float
    heading: float
    speed: float
    length: float
    width: float

    @property
    def to_leave(self) -> float:
        """The distance that the vehicle has to drive to leave the zone [m]; negative after it has left."""
        return self.distance + self.zone.npc[1] - self.zone.npc[0]

    @property
    def ego_to_leave(self) -> float:
        """The distance that the ego has to drive to leave the zone [m]; negative after it has left."""
        return self.ego_distance + self.zone.ego[1] - self.zone.ego[0]

    @property
    def is_inside(self) -> bool:
        """True if the vehicle is in the zone."""
        return self.distance <= 0 <= self.to_leave


@dataclass(frozen=True, kw_only=True, eq=False)
class Way:
    """The path of an NPC through a junction or along a road, which meets the ego's way.

    Attributes:
        zone: the zone where this way first meets the ego's way.
        speeds: the highest speed that speed limits and bends allow, at every half metre from the entry on [m/s].
        sharpest: the largest curvature of the way [1/m].
    """

    zone: Zone
    speeds: FloatArray
    sharpest: float = 0.0

    @property
    def length(self) -> float:
        """The distance from the entry to the exit [m]."""
        return (len(self.speeds) - 1) * STEP

    @lru_cache(maxsize=2048)  # noqa: B019  (called hundreds of times a scenario; a world retains its ways anyway)
    def times(self, speed: float) -> FloatArray:
        """Return the time [s] from the entry to each point of the way at a speed [m/s], or slower in bends."""
        driven = np.minimum(self.speeds, speed)
        steps = 2 * STEP / np.maximum(driven[1:] + driven[:-1], 1e-3)
        times: FloatArray = np.concatenate(([0.0], np.cumsum(steps)))
        times.flags.writeable = False
        return times

    def time_at(self, along: float, speed: float) -> float:
        """Return the time [s] from the entry to the place ``along`` [m] at a speed [m/s], or slower in bends."""
        times, point = self.times(speed), min(max(along / STEP, 0.0), len(self.speeds) - 1.0)
        before = min(int(point), len(times) - 2)
        return float(times[before] + (times[before + 1] - times[before]) * (point - before))

    def speed_at(self, along: float) -> float:
        """Return the highest speed [m/s] that limits and bends allow at the place ``along`` [m]."""
        return float(np.interp(along, np.arange(len(self.speeds)) * STEP, self.speeds))

    def place_at(self, time: float, speed: float) -> float:
        """Return the place [m] that a vehicle with a speed [m/s] has reached at a time [s] after the entry."""
        times = self.times(speed)
        return time * speed if time < 0 else float(np.interp(time, times, np.arange(len(times)) * STEP))


@dataclass(frozen=True, kw_only=True, eq=False)
class Crossings:
    """All ways of a world on which other traffic meets the ego's way.

    Attributes:
        ways: the ways by name.
        meetings: for each pair of way names in alphabetical order, the pairs of stretches, one of each way, on which
            the two ways meet, sorted along the second way. Two ways meet once, or more often in a circle.
        ego_start: where the ego starts along its way [m].
        ego_speed: the ego's speed at the start [m/s].
    """

    ways: Mapping[str, Way]
    meetings: Mapping[tuple[str, str], tuple[tuple[Stretch, Stretch], ...]]
    ego_start: float
    ego_speed: float

    @cached_property
    def zones(self) -> tuple[Zone, ...]:
        """The zones in the order in which the ego reaches them."""
        return tuple(sorted((way.zone for way in self.ways.values()), key=lambda zone: (zone.ego, zone.way)))

    def entry(self, instruction: CrossingInstruction, ego: Stretch) -> float:
        """Return the time [s] at which an NPC should enter its zone, given the ego's times (enters, leaves) [s]."""
        way = self.ways[instruction.zone]
        enters, leaves = way.zone.npc
        crossing = way.time_at(leaves, instruction.speed) - way.time_at(enters, instruction.speed)
        if instruction.slot > 0:
            return ego[1] + instruction.slot
        return ego[0] + instruction.slot - crossing if instruction.slot < 0 else (sum(ego) - crossing) / 2

    def planned_entry(self, instruction: CrossingInstruction) -> float:
        """Return the time [s] at which an NPC should enter its zone if the ego keeps its first speed.

        A negative time is before the start of the run, so the NPC cannot keep its slot.
        """
        first, last = self.ways[instruction.zone].zone.ego
        speed = max(self.ego_speed, 0.1)
        return self.entry(instruction, ((first - self.ego_start) / speed, (last - self.ego_start) / speed))

    def start(self, instruction: CrossingInstruction) -> float:
        """Return the place along its way at which an NPC has to start to keep its slot at a constant speed [m].

        The way is too short if the result is negative. The slot is too early if the result is beyond the beginning of
        the zone. An NPC with the act "hold" reaches its line at the time at which it would otherwise enter the zone. An
        NPC with the act "late" reaches its line some time earlier, if it can brake for the line.
        """
        way = self.ways[instruction.zone]
        if instruction.act not in WAITING:
            return self._start_of_passing(instruction)
        line = way.zone.npc[0] - BEFORE_LINE
        speed = min(instruction.speed, way.speed_at(line))
        brakes = line - speed**2 / (2 * EASY_BRAKING)
        needed = speed / EASY_BRAKING + CREEPING + (EARLIER if instruction.act == "late" else 0.0)
        left = max(self.planned_entry(instruction) - needed, 0.0)
        if brakes < 0:
            return brakes - left * speed
        return way.place_at(way.time_at(brakes, instruction.speed) - left, instruction.speed)

    def _start_of_passing(self, instruction: CrossingInstruction) -> float:
        way = self.ways[instruction.zone]
        arrives = way.time_at(way.zone.npc[0], instruction.speed)
        return way.place_at(arrives - self.planned_entry(instruction), instruction.speed)

    def fits(self, instruction: CrossingInstruction) -> bool:
        """Return whether an NPC can keep its slot: its way exists, and its start is on the way and before the zone.

        An NPC that waits at the line also needs room to stop before it.
        """
        way = self.ways.get(instruction.zone)
        if way is None:
            return False
        room = BEFORE_LINE + instruction.speed**2 / (2 * STOPPING) if instruction.act in WAITING else 0.0
        return self.start(instruction) >= 0 and self._start_of_passing(instruction) < way.zone.npc[0] - room

    def windows(self, instruction: CrossingInstruction, stretch: Stretch) -> Stretch:
        """Return the times between which an NPC is planned to be in a stretch of its way [s]."""
        way = self.ways[instruction.zone]
        waits = instruction.act in WAITING
        line = way.zone.npc[0] - (BEFORE_LINE if waits else 0.0)
        start, entry = self.start(instruction), self.planned_entry(instruction)
        first, last = (
            way.time_at(place, instruction.speed) - way.time_at(start, instruction.speed)
            if waits and place <= line
            else entry + way.time_at(place, instruction.speed) - way.time_at(way.zone.npc[0], instruction.speed)
            for place in stretch
        )
        if instruction.act == "pass" or stretch[1] <= line:
            return first, last
        return first, math.inf  # it stands at the line, or in the zone, for an unknown time

    def clash(self, first: CrossingInstruction, second: CrossingInstruction) -> bool:
        """Return whether two NPCs would be in one place at almost the same time, or would overtake in a lane."""
        if first.zone == second.zone:
            zone = self.ways[first.zone].zone.npc
            meetings: tuple[tuple[Stretch, Stretch], ...] = ((zone, zone),)
        elif (first.zone, second.zone) in self.meetings:
            meetings = self.meetings[first.zone, second.zone]
        else:
            meetings = tuple((b, a) for a, b in self.meetings.get((second.zone, first.zone), ()))
        if not meetings:
            return False
        if first.zone.split(">")[0] == second.zone.split(">")[0]:
            lanes = [((0.0, meetings[0][0][0]), 0.0)]
        else:
            found = (self._common_lane(first.zone, second.zone, *stretches) for stretches in meetings)
            lanes = [lane for lane in found if lane is not None]
        if any(self._crowd(first, second, *lane) for lane in lanes):
            return True
        windows = ((self.windows(first, one), self.windows(second, other)) for one, other in meetings)
        return any(a[0] < b[1] + APART and b[0] < a[1] + APART for a, b in windows)

    def _common_lane(self, first: str, second: str, mine: Stretch, theirs: Stretch) -> tuple[Stretch, float] | None:
        """Return the stretch [m] of the first way on which both ways share a lane up to their zones, and an offset [m].

        The offset is how much larger the same place is along the second way. ``mine`` and ``theirs`` are the stretches
        on which the two ways meet. None if the ways do not share one lane from there to their zones.
        """
        zones, farther = (self.ways[first].zone.npc, self.ways[second].zone.npc), theirs[1] - mine[1]
        is_one = all(abs(other - one - farther) <= 2 * STEP for one, other in zip(*zones, strict=True))
        return ((mine[1], zones[0][0]), farther) if is_one and mine[1] <= zones[0][0] else None

    def _crowd(self, first: CrossingInstruction, second: CrossingInstruction, lane: Stretch, farther: float) -> bool:
        """Return whether two NPCs that share a lane start too close together in it or overtake each other.

        ``lane`` is a stretch of the first NPC's way. The same place is ``farther`` [m] along on the second NPC's way.
        The order of the NPCs and their gap in time are checked only at the two ends of the stretch: the slower NPC
        needs longer for any part of it, so the gap is extreme at an end.
        """
        starts = self.start(first), self.start(second) - farther
        if min(starts) >= lane[0] and abs(starts[0] - starts[1]) < LENGTH:
            return True  # if one waits at its line, the times say nothing about a start beyond it
        since = max(lane[0], *starts)
        order = set()
        for place in (since, max(since, lane[1])):
            places = place, place + farther
            (a, _), (b, _) = (self.windows(each, (at, at)) for each, at in zip((first, second), places, strict=True))
            behind, at = (first, places[0]) if a > b else (second, places[1])
            speed = min(behind.speed, self.ways[behind.zone].speed_at(at))
            if abs(a - b) < APART + LENGTH / max(speed, 0.1):
                return True
            order.add(a > b)
        return len(order) > 1
