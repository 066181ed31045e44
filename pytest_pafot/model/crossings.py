"""The paths of crossing traffic and their zones."""
# A position is the distance of a vehicle's centre along its path [m]. A stretch `(enters, leaves)` of a path is the
# part on which the vehicle's box can touch the box of a vehicle on the other path. A vehicle that waits before `enters`
# therefore blocks no other vehicle.

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

# The ways in which an NPC's path and the ego's path meet. Crossing: one path leads across the other. Oncoming: the NPC
# comes from ahead, and either vehicle turns across the other's path. Merging: both paths continue in the same lane.
Kind = Literal["crossing", "oncoming", "merging"]
# The direction from which a vehicle comes, as seen by the ego when it approaches the zone.
Origin = Literal["left", "right", "ahead", "behind"]
# the vehicle that has priority in a zone: the ego, the NPC or neither
Holder = Literal["ego", "npc", "none"]

EGOS = ""  # the name of the ego's path; the names of other paths contain ``>``
NOT_ON_WAY = 0.5  # the angle to the ego's path above which a vehicle is not on it [rad]
STEP = 0.5  # distance between the points of a path [m]
APART = 0.7  # the shortest time between two NPCs that drive through the same position [s]
LENGTH = 5.0  # length of a vehicle [m]
BEFORE_LINE = 2.0  # the distance between a waiting NPC and its zone [m]
STOPPING = 6.0  # the hardest braking with which it stops there [m/s^2]
WAITING = ("hold", "late")  # the acts of NPCs that stop at the line before the zone
EASY_BRAKING = 2.5  # the planned braking of an NPC for its line [m/s^2]
CREEPING = 2.0  # the time that creeping up to the line adds to the braking time [s]
EARLIER = 1.0  # the time for which an NPC that starts late waits at the line before it sets off [s]
SETTING_OFF = 2.0  # the acceleration with which a waiting vehicle is expected to set off [m/s^2]


def longer(stretch: Stretch, by: float) -> Stretch:
    """Return a stretch of a path, lengthened for a vehicle that is ``by`` [m] longer than a car."""
    return stretch[0] - by / 2, stretch[1] + by / 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Zone:
    """The zone where an NPC's path first meets the ego's path.

    Attributes:
        way: entry and exit of the NPC's path, such as ``"o1>o3"``.
        kind: how the two paths meet: ``"crossing"``, ``"oncoming"`` or ``"merging"``.
        origin: where the NPC comes from: ``"left"``, ``"right"``, ``"ahead"`` or ``"behind"``.
        ego, npc: start and end [m] of the zone along each of the two paths.
        priority: the vehicle that has priority: ``"ego"``, ``"npc"`` or ``"none"``.
        line: points (x, y) [m] of the NPC's path, for pictures; empty if unknown.
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
        if self.origin in ("left", "right"):
            return f"from the {self.origin}"
        return f"from {self.origin}"


class CrossingVehicle(NamedTuple):
    """A vehicle on a path that meets the ego's path, as measured by an observer with a map.

    Distances are measured from a vehicle's centre along its path. They are negative inside the zone.

    Attributes:
        id: index of the NPC in ``run.npcs``.
        zone: area in which the two paths first meet, with its priority.
        distance: distance [m] from the NPC to the start of the zone.
        ego_distance: distance [m] from the ego to the start of the zone.
        ahead, right: position [m] of the NPC's centre relative to the ego's centre and heading.
        heading: heading [rad] relative to the ego, positive to the right.
        speed: speed [m/s].
        length, width: size [m].
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
        # Negative after the zone.
        return self.distance + self.zone.npc[1] - self.zone.npc[0]

    @property
    def ego_to_leave(self) -> float:
        # Negative after the zone.
        return self.ego_distance + self.zone.ego[1] - self.zone.ego[0]

    @property
    def is_inside(self) -> bool:
        return self.distance <= 0 <= self.to_leave


@dataclass(frozen=True, kw_only=True, eq=False)
class Way:
    """A path for NPCs that meets the ego's path."""

    zone: Zone  # the first zone in which the two paths meet
    # the highest speeds that limits and curves allow, every half metre from the entry [m/s]
    speeds: FloatArray
    sharpest: float = 0.0  # largest curvature [1/m]

    @property
    def length(self) -> float:
        return (len(self.speeds) - 1) * STEP

    @lru_cache(maxsize=2048)  # noqa: B019  (called hundreds of times per scenario; a world keeps its ways anyway)
    def times(self, speed: float) -> FloatArray:
        # The time [s] from the entry to each point at a target speed [m/s].
        driven = np.minimum(self.speeds, speed)
        steps = 2 * STEP / np.maximum(driven[1:] + driven[:-1], 1e-3)
        times: FloatArray = np.concatenate(([0.0], np.cumsum(steps)))
        times.flags.writeable = False
        return times

    def time_at(self, along: float, speed: float) -> float:
        times = self.times(speed)
        point = min(max(along / STEP, 0.0), len(self.speeds) - 1.0)
        before = min(int(point), len(times) - 2)
        step = times[before + 1] - times[before]
        return float(times[before] + step * (point - before))

    def speed_at(self, along: float) -> float:
        places = np.arange(len(self.speeds)) * STEP
        return float(np.interp(along, places, self.speeds))

    def place_at(self, time: float, speed: float) -> float:
        # Before the entry, the NPC drives at the speed itself.
        if time < 0:
            return time * speed
        times = self.times(speed)
        places = np.arange(len(times)) * STEP
        return float(np.interp(time, times, places))


@dataclass(frozen=True, kw_only=True, eq=False)
class Crossings:
    """All paths of other traffic that meet the ego's path."""

    ways: Mapping[str, Way]
    # For each pair of names in alphabetical order, the pairs of stretches on which the two paths meet, sorted along the
    # second path. In a circle there may be several.
    meetings: Mapping[tuple[str, str], tuple[tuple[Stretch, Stretch], ...]]
    ego_start: float  # first position along the ego's path [m]
    ego_speed: float  # [m/s]

    @cached_property
    def zones(self) -> tuple[Zone, ...]:
        # In the order in which the ego reaches them.
        zones = [way.zone for way in self.ways.values()]
        return tuple(sorted(zones, key=lambda zone: (zone.ego, zone.way)))

    def entry(self, instruction: CrossingInstruction, ego: Stretch) -> float:
        # The time [s] at which an NPC should enter its zone if the ego is there from ego[0] to ego[1].
        way = self.ways[instruction.zone]
        enters, leaves = way.zone.npc
        crossing = way.time_at(leaves, instruction.speed) - way.time_at(enters, instruction.speed)
        if instruction.slot > 0:
            return ego[1] + instruction.slot
        if instruction.slot < 0:
            return ego[0] + instruction.slot - crossing
        return (sum(ego) - crossing) / 2

    def planned_entry(self, instruction: CrossingInstruction) -> float:
        # The time [s] at which an NPC should enter its zone if the ego keeps its initial speed.
        # A negative time is before the start of the run, so the NPC cannot keep its slot.
        enters, leaves = self.ways[instruction.zone].zone.ego
        speed = max(self.ego_speed, 0.1)
        ego = (enters - self.ego_start) / speed, (leaves - self.ego_start) / speed
        return self.entry(instruction, ego)

    def start(self, instruction: CrossingInstruction) -> float:
        # The position [m] at which an NPC must start to keep its slot. An NPC with the act "hold" reaches its line when
        # it would otherwise enter the zone. With "late", it reaches the line earlier if there is enough time.
        way = self.ways[instruction.zone]
        if instruction.act not in WAITING:
            return self._start_of_passing(instruction)
        line = way.zone.npc[0] - BEFORE_LINE
        speed = min(instruction.speed, way.speed_at(line))
        brakes = line - speed**2 / (2 * EASY_BRAKING)
        needed = speed / EASY_BRAKING + CREEPING
        if instruction.act == "late":
            needed += EARLIER
        left = max(self.planned_entry(instruction) - needed, 0.0)
        if brakes < 0:
            return brakes - left * speed
        return way.place_at(way.time_at(brakes, instruction.speed) - left, instruction.speed)

    def _start_of_passing(self, instruction: CrossingInstruction) -> float:
        way = self.ways[instruction.zone]
        arrives = way.time_at(way.zone.npc[0], instruction.speed)
        return way.place_at(arrives - self.planned_entry(instruction), instruction.speed)

    def fits(self, instruction: CrossingInstruction) -> bool:
        way = self.ways.get(instruction.zone)
        if way is None:
            return False
        # The start must be on the path and before the zone. An NPC that waits at the line needs room to stop there.
        latest = way.zone.npc[0]
        if instruction.act in WAITING:
            latest -= BEFORE_LINE + instruction.speed**2 / (2 * STOPPING)
        return self.start(instruction) >= 0 and self._start_of_passing(instruction) < latest

    def windows(self, instruction: CrossingInstruction, stretch: Stretch) -> Stretch:
        # The times [s] between which an NPC is planned to be in the stretch of its path.
        way = self.ways[instruction.zone]
        waits = instruction.act in WAITING
        line = way.zone.npc[0]
        if waits:
            line -= BEFORE_LINE
        starts = way.time_at(self.start(instruction), instruction.speed)
        entry = self.planned_entry(instruction)
        enters = way.time_at(way.zone.npc[0], instruction.speed)
        times = []
        for place in stretch:
            time = way.time_at(place, instruction.speed)
            if waits and place <= line:
                times.append(time - starts)
            else:
                times.append(entry + time - enters)
        first, last = times
        if instruction.act == "pass" or stretch[1] <= line:
            return first, last
        return first, math.inf  # it waits at the line, or stops in the zone, for an unknown time

    def clash(self, first: CrossingInstruction, second: CrossingInstruction) -> bool:
        # Two NPCs clash if they would meet, or overtake each other in one lane.
        meetings = self._meetings(first.zone, second.zone)
        if not meetings:
            return False
        if first.zone.split(">")[0] == second.zone.split(">")[0]:
            # both start in one lane, which ends where the two paths part
            lanes: list[tuple[Stretch, float] | None] = [((0.0, meetings[0][0][0]), 0.0)]
        else:
            lanes = [
                self._common_lane(first.zone, second.zone, *stretches) for stretches in meetings
            ]
        for lane in lanes:
            if lane is not None and self._crowd(first, second, *lane):
                return True
        for mine, theirs in meetings:
            enters, leaves = self.windows(first, mine)
            its_enters, its_leaves = self.windows(second, theirs)
            if enters < its_leaves + APART and its_enters < leaves + APART:
                return True
        return False

    def _meetings(self, first: str, second: str) -> tuple[tuple[Stretch, Stretch], ...]:
        if first == second:
            zone = self.ways[first].zone.npc
            return ((zone, zone),)
        if (first, second) in self.meetings:
            return self.meetings[first, second]
        return tuple((b, a) for a, b in self.meetings.get((second, first), ()))

    def _common_lane(
        self,
        first: str,
        second: str,
        mine: Stretch,
        theirs: Stretch,
    ) -> tuple[Stretch, float] | None:
        # The stretch of the first path on which both paths share a lane up to their zones, and an offset [m], or None.
        # `mine` and `theirs` are the stretches on which the two paths meet. The offset is the position of a point along
        # the second path minus its position along the first path.
        zone = self.ways[first].zone.npc
        its_zone = self.ways[second].zone.npc
        farther = theirs[1] - mine[1]
        for one, other in zip(zone, its_zone, strict=True):
            if abs(other - one - farther) > 2 * STEP:
                return None
        if mine[1] <= zone[0]:
            return ((mine[1], zone[0]), farther)
        return None

    def _crowd(
        self,
        first: CrossingInstruction,
        second: CrossingInstruction,
        lane: Stretch,
        farther: float,
    ) -> bool:
        # Two NPCs in a shared lane must not start too close together, and neither may overtake the other.
        # `farther` is the offset from `_common_lane`. Only the two ends of the lane are checked: the slower NPC takes
        # longer for each part of the lane, so the gap in time is smallest at one of the ends.
        start = self.start(first)
        its_start = self.start(second) - farther
        if min(start, its_start) >= lane[0] and abs(start - its_start) < LENGTH:
            # the times do not show this if an NPC waits at its line and the other starts after the line
            return True
        since = max(lane[0], start, its_start)
        order = set()
        for place in (since, max(since, lane[1])):
            its_place = place + farther
            time, _ = self.windows(first, (place, place))
            its_time, _ = self.windows(second, (its_place, its_place))
            is_behind = time > its_time
            behind, at = (first, place) if is_behind else (second, its_place)
            speed = min(behind.speed, self.ways[behind.zone].speed_at(at))
            if abs(time - its_time) < APART + LENGTH / max(speed, 0.1):
                return True
            order.add(is_behind)
        return len(order) > 1
