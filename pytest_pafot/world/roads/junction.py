"""Paths of crossing traffic through a network, and their zones of conflict with the ego's path and with each other.

A path leads from a section without a predecessor, through consecutive sections, to a section without a successor. Paths
that start in a section of the ego's path are excluded, because vehicles that start there are controlled relative to the
ego.
"""

from __future__ import annotations

import math
from array import array
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import combinations, product, starmap
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pytest_pafot.model.crossings import (
    EGOS,
    NOT_ON_WAY,
    Crossings,
    Holder,
    Kind,
    Origin,
    Stretch,
    Way,
    Zone,
    longer,
)
from pytest_pafot.model.instructions import Cell
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import FloatArray
from pytest_pafot.model.vehicle_type import CAR, TIGHTEST, VehicleType
from pytest_pafot.world.kernel.crossing import CrossingNpc, JunctionDirector
from pytest_pafot.world.kernel.director import Director, NetworkDirector
from pytest_pafot.world.kernel.lanes import Body, Track
from pytest_pafot.world.limits import NpcLimits
from pytest_pafot.world.roads.network import (
    SPEED_LAG,
    STEP,
    Column,
    LaneIndex,
    Line,
    NetworkRoad,
    Piece,
    Shaped,
    is_drivable,
    line_of,
    wrap_angle,
)
from pytest_pafot.world.roads.network import way as way_of
from pytest_pafot.world.roads.road import Pose
from pytest_pafot.world.roads.survey import curvature_of, lone_column

IntArray = npt.NDArray[np.intp]
Flags = npt.NDArray[np.bool_]
Section = tuple[str, str]

# additional width of both boxes in a zone [m], because an ego that cuts corners is up to 0.74 m off its path
WIDER = 1.0
# distance below which boxes count as touching [m]; otherwise, rounding would decide when roads cross at right angles
TOUCHING = 1e-6
# largest distance and angle between two paths in the same lane [m, rad]
ONE_LANE = 0.5
ONE_DIRECTION = 0.1
# largest distance from a path and angle to it at which a vehicle obstructs vehicles on that path [m, rad]
BESIDE = 1.0
ALIGNED = 0.3
# distance of both vehicles before the zone at which the direction of approach is determined [m]
APPROACH = 20.0
# Limits for the angle between two directions of approach [rad]. Above the first limit, vehicles come from opposite
# directions. Below the second, they come side by side. In a roundabout, the angle is three quarters of pi, and a
# circulating vehicle comes from the left.
OPPOSITE = 0.85 * math.pi
ALONGSIDE = 0.25 * math.pi
# of two merging paths, the one that turns less is the main lane if the difference is larger [rad]
STRAIGHTER = 0.2
# time from the ego's start to its first zone at constant speed, if the ego's lane is long enough [s]
LEAD = 6.0
# largest number of paths that are used, the shortest first; city blocks have very many paths
MOST_WAYS = 64
# number of points per group; to save time, two paths are first compared by groups of points
COARSE = 4
DRAWN = 4  # step between the points of a path that are stored for pictures


class Course(NamedTuple):
    """The centre [m] and heading [rad] of a vehicle at each point of a path."""

    x: FloatArray
    y: FloatArray
    heading: FloatArray
    cos: FloatArray
    sin: FloatArray


@dataclass(frozen=True, kw_only=True, eq=False)
class CrossingWay:
    """A path of crossing traffic, with the path's geometry."""

    way: Way
    line: Line  # from the entry to the exit
    column: Column  # lane at each point
    # position nearest to the ego's path; if the paths merge, position of the entry into its lane [m]
    middle: float
    shaped: Shaped  # creates the lane for the limits and the length of an NPC
    # position of each point along the ego's path [m]; NaN if far from it or turned away
    along_ego: list[float]

    def for_vehicle(self, vehicle: VehicleType, limits: NpcLimits) -> CrossingWay:
        """Return this path with the zone and the speeds for a vehicle type."""
        if vehicle == CAR:
            return self
        own = limits.for_vehicle(vehicle)
        key = own, vehicle.length
        if key not in self._of_others:
            ((lane,), _) = self.shaped(*key)
            # a long vehicle, as measured at its centre, enters its zone earlier and leaves it later
            stretch = longer(self.way.zone.npc, vehicle.length - CAR.length)
            way = replace(
                self.way,
                zone=replace(self.way.zone, npc=stretch),
                speeds=_driven(lane.speed, own),
            )
            column = replace(lane, part=self.column.part)
            self._of_others[key] = replace(self, way=way, column=column)
        return self._of_others[key]

    @cached_property
    def _of_others(self) -> dict[tuple[NpcLimits, float], CrossingWay]:
        return {}

    @cached_property
    def track(self) -> Track:
        return Track(
            self.line.x.tolist(),
            self.line.y.tolist(),
            self.column.direction,
            self.column.lean,
            self.column.speed,
            self.column.sharpest,
            self.column.part,
            self.along_ego,
            self.way.zone.npc[0],
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Junction:
    """The paths of a network on which other traffic crosses or joins the ego's path."""

    crossings: Crossings  # the paths from which a search samples
    ways: Mapping[str, CrossingWay]
    # for the names of two paths, the sections of both in which they conflict; EGOS is the name of the ego's path
    meetings: Mapping[tuple[str, str], tuple[tuple[Stretch, Stretch], ...]]
    # for the names of two paths, the position along the first of each point of the second [m], or NaN
    shared: Mapping[tuple[str, str], array[float]]

    def __deepcopy__(self, _: dict[int, object]) -> Junction:
        return self  # immutable, and highway-env deep-copies the road to predict vehicles

    def stretches(self, mine: str, theirs: str) -> list[tuple[Stretch, Stretch]]:
        """Return, for each conflict between two paths, the section of each path."""
        if (theirs, mine) in self.meetings:
            return [(own, its) for its, own in self.meetings[theirs, mine]]
        return list(self.meetings.get((mine, theirs), ()))

    def places(self, mine: str, theirs: str) -> array[float] | None:
        """Return the positions [m] along ``mine`` of the points of ``theirs``, or None if they share no lane."""
        if mine == theirs and mine != EGOS:
            return array("d", [STEP * point for point in range(len(self.ways[mine].line.x))])
        return self.shared.get((mine, theirs))


@dataclass(frozen=True, kw_only=True, eq=False)
class JunctionRoad(NetworkRoad):
    """The ego's path through a network, and the paths of other traffic that cross or join it."""

    junction: Junction

    @property
    def crossings(self) -> Crossings:
        return self.junction.crossings

    def ways(self, scenario: Scenario) -> list[CrossingWay | None]:
        """Return each crossing NPC's path, adapted to the NPC's vehicle type, and None for the other NPCs."""
        ways: list[CrossingWay | None] = [None] * len(scenario.crossings)
        for npc, each in enumerate(scenario.crossings):
            if each is not None:
                way = self.junction.ways[each.zone]
                ways[npc] = way.for_vehicle(scenario.vehicle_of(npc), self.limits)
        return ways

    def zones(self, scenario: Scenario) -> tuple[Zone | None, ...]:
        return tuple(None if way is None else way.way.zone for way in self.ways(scenario))

    def tracks(self, scenario: Scenario) -> list[Track | None]:
        if not scenario.crossings:
            return super().tracks(scenario)
        return [None if way is None else way.track for way in self.ways(scenario)]

    def can_drive(self, vehicle: VehicleType, zone: str | None = None) -> bool:
        if zone is None:
            return super().can_drive(vehicle)
        return vehicle.can_follow(self.crossings.ways[zone].sharpest)

    def director(
        self,
        scenario: Scenario,
        limits: NpcLimits,
        cells: frozenset[Cell],
        **common: Any,
    ) -> Director | JunctionDirector:
        if not scenario.crossings:
            return super().director(scenario, limits, cells, **common)
        grid = None
        around = [npc for npc, crossing in enumerate(scenario.crossings) if crossing is None]
        if around:  # the NPCs around the ego
            others = scenario.of_npcs(around)
            grid = NetworkDirector(others, self, limits, start_cells=cells, **common)
        del common["clearance"], common["ego_length"]
        return JunctionDirector(scenario, self, self.junction, limits, grid=grid, **common)

    def foresight(self, body: Body) -> Callable[[float], Pose] | None:
        if isinstance(body, CrossingNpc):
            return body.track.pose
        return super().foresight(body)


def with_junction(env: Any, road: NetworkRoad, limits: NpcLimits, ego: VehicleType) -> NetworkRoad:
    """Add the crossing and joining paths to a road, or return the road unchanged if there are none.

    If necessary, the ego's start is moved back, so that the ego does not reach its first zone too soon.
    """
    junction = _junction_of(env, road, limits, ego)
    if junction is None:
        return road
    values = {each.name: getattr(road, each.name) for each in fields(road)}
    values["start"] = junction.crossings.ego_start
    return JunctionRoad(**values, junction=junction)


def _junction_of(
    env: Any, road: NetworkRoad, limits: NpcLimits, ego: VehicleType
) -> Junction | None:
    own = _course(road.line, road.columns[road.ego_lane])
    ways = _ways(env.road.network, road, own, limits)
    if not ways:
        return None
    longer_by = ego.length - CAR.length
    if longer_by:  # an ego that is longer than a car enters each zone earlier and leaves it later
        for name, each in ways.items():
            zone = replace(each.way.zone, ego=longer(each.way.zone.ego, longer_by))
            ways[name] = replace(each, way=replace(each.way, zone=zone))
    courses = {name: _course(each.line, each.column) for name, each in sorted(ways.items())}
    shared: dict[tuple[str, str], array[float]] = {}
    meetings: dict[tuple[str, str], tuple[tuple[Stretch, Stretch], ...]] = {}
    for (one, a), (other, b) in combinations([(EGOS, own), *courses.items()], 2):
        pairs = near_pairs(a, b)
        # each vehicle may be ahead of the other in a common lane
        shared[one, other] = array("d", _places(a, b, pairs, BESIDE, ALIGNED))
        shared[other, one] = array("d", _places(b, a, pairs[::-1], BESIDE, ALIGNED))
        if one == EGOS:
            along_ego = _places(a, b, pairs, road.lane_width, NOT_ON_WAY).tolist()
            ways[other] = replace(ways[other], along_ego=along_ego)
        meetings[one, other] = tuple(met.stretches for met in meetings_of(a, b, pairs))
    meetings = {pair: found for pair, found in meetings.items() if found}
    shared = {pair: places for pair, places in shared.items() if not np.isnan(places).all()}
    # the ego starts in the same lane, but far enough before its first zone
    first = min(each.way.zone.ego[0] for each in ways.values())
    owner = road.line.piece[road.bends.point(road.start)]
    lane_begins = float(np.flatnonzero(road.line.piece == owner)[0]) * STEP
    crossings = Crossings(
        ways={name: each.way for name, each in ways.items()},
        meetings={pair: found for pair, found in meetings.items() if EGOS not in pair},
        ego_start=min(road.start, max(first - LEAD * road.ego_speed, lane_begins)),
        ego_speed=road.ego_speed,
    )
    return Junction(crossings=crossings, ways=ways, meetings=meetings, shared=shared)


def _ways(
    network: Any, road: NetworkRoad, own: Course, limits: NpcLimits
) -> dict[str, CrossingWay]:
    """Return, by name, the shortest paths that cross or join the ego's path ahead of the ego's start."""
    ways: dict[str, CrossingWay] = {}
    for path in _paths(network):
        origin, end = path[0]
        name = f"{origin}>{path[-1][1]}"
        if path[0] in road.sections or name in ways:
            continue
        entry = origin, end, len(network.graph[origin][end]) - 1  # the rightmost lane
        route = [(*section, None) for section in path]
        pieces, _ = way_of(network, entry, 0.0, route, ahead=math.inf, behind=0.0)
        line = line_of(pieces)
        if np.abs(curvature_of(line)).max() > TIGHTEST:
            continue  # the path jumps from lane to lane, as at the ramp of merge-v0
        shaped = lone_column(line, pieces, road.ego_speed)
        ((lane,), _) = shaped(limits)
        column = replace(lane, part=_parts(road, pieces, line))
        course = _course(line, column)
        met = next(meetings_of(own, course, near_pairs(own, course)), None)
        # only conflicts ahead of the ego's start matter
        if met is not None and met.stretches[0][0] > road.start:
            ways[name] = CrossingWay(
                way=Way(
                    zone=_zone(name, road, line, [piece.index for piece in pieces], network, met),
                    speeds=_driven(column.speed, limits),
                    sharpest=max(column.sharpest),
                ),
                line=line,
                column=column,
                middle=met.closest[1] * STEP,
                shaped=shaped,
                along_ego=[],
            )
    return ways


def _paths(network: Any) -> Iterator[tuple[Section, ...]]:
    """Yield the paths through a network as tuples of sections, the shortest first. No path visits a node twice."""
    pieces: dict[Section, list[Piece]] = {}
    for index, lane in network.lanes_dict().items():
        pieces.setdefault(index[:2], []).append(Piece(index, lane, 0.0, float(lane.length)))
    # a section follows another one if any of their lanes do
    follow = {
        section: [
            after
            for after in pieces
            if section[1] == after[0] and any(starmap(is_drivable, product(lasts, pieces[after])))
        ]
        for section, lasts in pieces.items()
    }
    led_to = {section for following in follow.values() for section in following}
    # breadth first, from sections without a predecessor
    queue: deque[tuple[Section, ...]] = deque(
        (section,) for section in follow if section not in led_to
    )
    found = 0
    while queue and found < MOST_WAYS and len(queue) < MOST_WAYS**2:
        path = queue.popleft()
        nodes = {path[0][0], *(end for _, end in path)}
        if not follow[path[-1]]:
            found += 1
            yield path
        queue.extend((*path, section) for section in follow[path[-1]] if section[1] not in nodes)


def _parts(road: NetworkRoad, pieces: Sequence[Piece], line: Line) -> list[int]:
    # For each point of a path, the index of its lane in `Trace.lanes`.
    own_lanes = len(road.lanes) - len(road.others)
    parts = np.full(len(line.x), -1)
    for number, piece in enumerate(pieces):
        points = np.flatnonzero(line.piece == number)
        if piece.index in road.others:
            parts[points] = own_lanes + road.others.index(piece.index)
        elif points.size:  # in a lane of the ego's path
            x = line.x[points, None] - road.line.x
            y = line.y[points, None] - road.line.y
            near = (x * x + y * y).argmin(axis=1)
            # the middle of the piece determines its lane
            middle = len(points) // 2
            place = points[middle]
            along = float(near[middle]) * STEP
            road.bends.locate(line.x[place], line.y[place], line.heading[place], along)
            parts[points] = np.array(road.columns[road.bends.lane].part)[near]
    indices: list[int] = parts.tolist()
    return indices


def _course(line: Line, column: Column) -> Course:
    heading = np.array(column.direction) + np.array(column.lean)
    return Course(line.x, line.y, heading, np.cos(heading), np.sin(heading))


def near_pairs(a: Course, b: Course) -> tuple[IntArray, IntArray]:
    """Return all pairs of points of two courses at which widened boxes might touch, ordered by course ``b``."""
    reach = math.hypot(CAR.length, CAR.width + WIDER)
    wide = reach + 2 * STEP * COARSE
    x = a.x[::COARSE, None] - b.x[::COARSE]
    y = a.y[::COARSE, None] - b.y[::COARSE]
    # groups of points are compared first, and then the points of the groups that are near each other
    i, j = np.nonzero(x * x + y * y < wide * wide)
    step = np.arange(COARSE)
    # each pair of groups becomes COARSE * COARSE pairs of points
    i = (i[:, None, None] * COARSE + step[:, None]).repeat(COARSE, axis=2).ravel()
    j = (j[:, None, None] * COARSE + step).repeat(COARSE, axis=1).ravel()
    exists = (i < len(a.x)) & (j < len(b.x))
    i = i[exists]
    j = j[exists]
    x = a.x[i] - b.x[j]
    y = a.y[i] - b.y[j]
    is_near = x * x + y * y < reach * reach
    i = i[is_near]
    j = j[is_near]
    order = np.lexsort((i, j))  # by the second course, then by the first
    return i[order], j[order]


def boxes_touch(a: Course, b: Course, pairs: tuple[IntArray, IntArray], wider: float) -> Flags:
    """Return, for each pair of points, whether vehicles at these points touch if they are widened by ``wider`` [m]."""
    i, j = pairs
    length = CAR.length
    width = CAR.width + wider
    x = b.x[j] - a.x[i]
    y = b.y[j] - a.y[i]
    cos_a = a.cos[i]
    sin_a = a.sin[i]
    cos_b = b.cos[j]
    sin_b = b.sin[j]
    # of the angle between the two boxes
    cos = np.abs(cos_a * cos_b + sin_a * sin_b)
    sin = np.abs(sin_b * cos_a - cos_b * sin_a)
    along = (length + length * cos + width * sin) / 2 + TOUCHING
    across = (width + length * sin + width * cos) / 2 + TOUCHING
    touches: Flags = np.abs(x * cos_a + y * sin_a) < along
    touches &= np.abs(y * cos_a - x * sin_a) < across
    touches &= np.abs(x * cos_b + y * sin_b) < along
    touches &= np.abs(y * cos_b - x * sin_b) < across
    return touches


class Meeting(NamedTuple):
    """A conflict between two paths."""

    stretches: tuple[Stretch, Stretch]
    closest: tuple[int, int]
    merges: bool


def meetings_of(a: Course, b: Course, pairs: tuple[IntArray, IntArray]) -> Iterator[Meeting]:
    """Yield the conflicts between two paths, ordered along the second path."""
    wide = boxes_touch(a, b, pairs, WIDER)
    i = pairs[0][wide]
    j = pairs[1][wide]
    # consecutive points of both paths at which widened boxes touch are one conflict
    for run in np.split(np.arange(len(j)), np.flatnonzero(np.diff(j) > 1) + 1):
        known = np.unique(i[run])
        # parts of the first path
        for own in np.split(known, np.flatnonzero(np.diff(known) > 1) + 1):
            belongs = run[np.isin(i[run], own)]
            if boxes_touch(a, b, (i[belongs], j[belongs]), 0.0).any():
                yield _meeting(a, b, i[belongs], j[belongs])


def _meeting(a: Course, b: Course, i: IntArray, j: IntArray) -> Meeting:
    ahead, aside, turned = _relative(a, b, i, j)
    together = np.flatnonzero(
        (np.abs(ahead) <= STEP / 2 + 1e-9) & (aside < ONE_LANE) & (turned < ONE_DIRECTION)
    )
    x = b.x[j] - a.x[i]
    y = b.y[j] - a.y[i]
    nearest = int(np.argmin(x * x + y * y))
    # points of both paths
    places = np.stack([i, j])
    first = places.min(axis=1)
    last = places.max(axis=1)
    length = round(CAR.length / STEP)
    merges = False
    if together.size:
        # If the paths merge, the conflict ends a vehicle's length after their first point in the same lane. If they
        # part, the conflict starts a vehicle's length before their last point in the same lane.
        begins = together[0]
        merges = bool((places[:, begins] - first).min() > 2)
        if merges:
            nearest = int(begins)
            last = places[:, begins] + length
        else:
            first = places[:, together[-1]] - length
    since = np.maximum(first - 1, 0) * STEP
    until = np.minimum(last + 1, [len(a.x) - 1, len(b.x) - 1]) * STEP
    own, its = zip(since.tolist(), until.tolist(), strict=True)
    return Meeting((own, its), (int(i[nearest]), int(j[nearest])), merges)


def _relative(
    a: Course, b: Course, i: IntArray, j: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    # For each pair of points: how far the second is ahead [m] and aside [m] of the first, and the angle [rad].
    x = b.x[j] - a.x[i]
    y = b.y[j] - a.y[i]
    cos = a.cos[i]
    sin = a.sin[i]
    turned = np.abs(wrap_angle(b.heading[j] - a.heading[i]))
    return x * cos + y * sin, np.abs(y * cos - x * sin), turned


def _places(
    a: Course,
    b: Course,
    pairs: tuple[IntArray, IntArray],
    beside: float,
    turned: float,
) -> FloatArray:
    """Return, for each point of path ``b``, the position [m] along path ``a``, or NaN.

    The result is NaN if the paths are at least ``beside`` [m] apart at that point, or at an angle of at least
    ``turned`` [rad].
    """
    i, j = pairs
    ahead, aside, angle = _relative(a, b, i, j)
    fits = np.flatnonzero((aside < beside) & (angle < turned) & (np.abs(ahead) <= STEP))
    # the nearest position is written last, so it remains
    fits = fits[np.argsort(-np.abs(ahead[fits]), kind="stable")]
    places = np.full(len(b.x), np.nan)
    places[j[fits]] = i[fits] * STEP + ahead[fits]
    return places


def _driven(wanted: list[float], limits: NpcLimits) -> FloatArray:
    """Return an NPC's speeds [m/s] along a path, given the desired speeds and the lag of the speed control."""
    driven = wanted[:1]
    for speed in wanted[1:]:
        gained = (speed - driven[-1]) / SPEED_LAG
        gained = min(max(gained, -limits.braking), limits.acceleration)
        driven.append(math.sqrt(max(driven[-1] ** 2 + 2 * gained * STEP, 0.0)))
    return np.array(driven)


def _zone(
    name: str,
    road: NetworkRoad,
    line: Line,
    lanes: Sequence[LaneIndex],
    network: Any,
    met: Meeting,
) -> Zone:
    here, there = (max(int((enters - APPROACH) / STEP), 0) for enters, _ in met.stretches)
    origin = _origin(wrap_angle(float(line.heading[there] - road.line.heading[here])))
    kind: Kind = "crossing"
    if met.merges:
        kind = "merging"
    elif origin == "ahead":
        kind = "oncoming"
    x = line.x[::DRAWN].round(2).tolist()
    y = line.y[::DRAWN].round(2).tolist()
    return Zone(
        way=name,
        kind=kind,
        origin=origin,
        ego=met.stretches[0],
        npc=met.stretches[1],
        priority=_holder(network, (road.line, road.route), (line, lanes), met),
        line=tuple(zip(x, y, strict=True)),
    )


def _origin(turned: float) -> Origin:
    # The side from which a vehicle comes, given the angle [rad] from the ego's direction to the vehicle's.
    if abs(turned) > OPPOSITE:
        return "ahead"
    if abs(turned) < ALONGSIDE:
        return "behind"
    if turned > 0:
        return "left"
    return "right"


def _holder(
    network: Any,
    ego: tuple[Line, Sequence[LaneIndex]],
    npc: tuple[Line, Sequence[LaneIndex]],
    met: Meeting,
) -> Holder:
    # Which vehicle has priority in a conflict.
    own = _lane_before(*ego, met.closest[0], npc[1])
    other = _lane_before(*npc, met.closest[1], ego[1])
    priorities = {
        index: getattr(network.get_lane(index), "priority", 0) for index in network.lanes_dict()
    }
    if (
        len(set(priorities.values())) > 1
    ):  # if the network has highway-env's priorities, they decide
        mine = priorities[own]
        theirs = priorities[other]
    else:
        # otherwise, a circulating vehicle has priority over an entering one
        mine = _circulates(network, own)
        theirs = _circulates(network, other)
        # where lanes merge, the main lane has priority, which turns less
        if mine == theirs and met.merges:
            own_bend = _bend(ego[0], met.stretches[0])
            other_bend = _bend(npc[0], met.stretches[1])
            mine = own_bend + STRAIGHTER < other_bend
            theirs = other_bend + STRAIGHTER < own_bend
    if mine == theirs:
        return "none"
    if mine > theirs:
        return "ego"
    return "npc"


def _bend(line: Line, stretch: Stretch) -> float:
    # The angle [rad] by which a path turns in a stretch.
    since, until = (int(place / STEP) for place in stretch)
    return float(abs(line.heading[until] - line.heading[since]))


def _lane_before(
    line: Line, lanes: Sequence[LaneIndex], point: int, others: Sequence[LaneIndex]
) -> LaneIndex:
    # The lane of a path at a point, or the last lane before that point that the other path does not share.
    sections = {index[:2] for index in others}
    number = int(line.piece[point])
    while number > 0 and lanes[number][:2] in sections:
        number -= 1
    return lanes[number]


def _circulates(network: Any, lane: LaneIndex) -> bool:
    # Whether the road from the end of a lane leads back to the lane's start.
    start, end, _ = lane
    seen = {end}
    queue = [end]
    for node in queue:
        ahead = set(network.graph.get(node, {})) - seen
        seen |= ahead
        queue.extend(ahead)
    return start in seen
