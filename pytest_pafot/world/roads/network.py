"""Roads of any shape, in grid coordinates: along the ego's path and across its lanes.

At every half metre of the path, the other lanes of the same road section count as next to the path, as in highway-env's
``side_lanes``. Lanes are numbered from the left. The ego's path has the same number from start to end, and other lanes
can be shorter. The nominal lateral position of the centre of lane ``k`` is always ``k`` times the lane width,
regardless of the lane's real position.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from pytest_pafot.model.instructions import Cell
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.sight import Sight
from pytest_pafot.model.trace import FloatArray, Lane, Outcome
from pytest_pafot.model.vehicle_type import CAR, VehicleType
from pytest_pafot.world.kernel.crossing import JunctionDirector
from pytest_pafot.world.kernel.director import Director, NetworkDirector
from pytest_pafot.world.kernel.lanes import Bends, Body, Places, Track
from pytest_pafot.world.kernel.observation import RoadSensor, Sensor
from pytest_pafot.world.limits import BEND_SHARE, NpcLimits
from pytest_pafot.world.roads.road import Meeting, Pose, Road

# deceleration of an NPC before a bend or the end of a lane [m/s^2]; at most a third of its limit
SLOWING = 2.0
# lag of the speed control behind a steadily falling target speed, the inverse of its gain [s]
SPEED_LAG = 1 / 1.5


def allowed_speeds(
    curvature: FloatArray,
    limit: FloatArray,
    stops: float | None,
    lengths: FloatArray,
    limits: NpcLimits,
) -> FloatArray:
    """Return the highest speed [m/s] of an NPC at each point of a lane.

    ``curvature`` is in 1/m, ``limit`` in m/s and ``lengths``, the positions along the lane, in m. NPCs must stop at the
    position ``stops`` [m], unless it is None.
    """
    with np.errstate(divide="ignore"):
        bend = np.sqrt(BEND_SHARE * limits.lateral_acceleration / np.abs(curvature))
    speed = np.minimum(bend, limits.overspeed * limit)
    slowing = min(SLOWING, limits.braking / 3)
    if stops is not None:
        speed = np.where(lengths >= stops, 0.0, speed)
    squares = (speed**2).tolist()
    places = lengths.tolist()
    # backwards, so that gentle braking suffices for all following points
    for index in range(len(squares) - 2, -1, -1):
        reach = squares[index + 1] + 2 * slowing * (places[index + 1] - places[index])
        squares[index] = min(squares[index], reach)
    speed = np.sqrt(squares)
    # the lag of the speed control
    reached = np.searchsorted(lengths, lengths + speed * SPEED_LAG, side="right")
    return _of_windows(np.minimum, speed, np.minimum(reached + 1, len(speed)))


def _of_windows(extreme: np.ufunc, values: FloatArray, ends: npt.NDArray[np.intp]) -> FloatArray:
    # The smallest or largest value between each point and the end of its window.
    bounds = np.stack([np.arange(len(values)), ends], axis=-1).ravel()
    # windows may end after the last
    windows: FloatArray = extreme.reduceat(np.append(values, values[-1]), bounds)[::2]
    return windows


def leans(direction: FloatArray, lengths: FloatArray, vehicle_length: float) -> FloatArray:
    """Return the angle [rad] between a lane and a vehicle that follows it exactly, by highway-env's bicycle model."""
    # The rear axle is half a length behind the centre and moves in the direction of the heading. So the heading turns
    # by sin(direction - heading) / (length / 2) per metre.
    lean = [0.0]
    steps = np.diff(lengths).tolist()
    turns = np.diff(direction).tolist()
    for step, turn in zip(steps, turns, strict=True):
        settled = 0.0
        if step > 0:
            settled = math.asin(max(-0.99, min(0.99, turn / step * vehicle_length / 2)))
        share = 1 - math.exp(-2 * step / vehicle_length)
        lean.append(lean[-1] + share * (-settled - lean[-1]))
    return np.array(lean)


def sharpest_ahead(curvature: FloatArray, lengths: FloatArray, reach: float) -> FloatArray:
    """Return the largest curvature [1/m] within a given distance ahead of each point of a lane."""
    ends = np.searchsorted(lengths, lengths + reach, side="right")
    return _of_windows(np.maximum, np.abs(curvature), ends)


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """A lane along the complete path, with one list entry per point of the line."""

    exists: list[bool]
    across: list[float]  # distance of its centre to the right of the line [m]
    direction: list[float]  # direction of its centre line [rad]
    # Angle between the direction and a vehicle that follows the lane [rad]. In a bend, a car's heading is turned
    # inwards less than its course.
    lean: list[float]
    # highest speed of an NPC with respect to bends, speed limits and the end of the lane [m/s]
    speed: list[float]
    # largest curvature within the length of a lane change ahead of the point [1/m]
    sharpest: list[float]
    part: list[int]  # index in Trace.lanes; -1 where the lane does not exist


Shaped = Callable[..., tuple[tuple[Column, ...], list[Lane]]]
"""A function that creates the lanes for driving and for a trace, given the limits and the length [m] of an NPC."""


@dataclass(frozen=True, kw_only=True, eq=False)
class NetworkRoad(Road):
    """The lanes along the ego's path through a network."""

    lanes: tuple[Lane, ...]  # the path's lanes from the left, then the network's other lanes
    columns: tuple[Column, ...]  # the path's lanes from the left, for cars
    shaped: Shaped
    limits: NpcLimits  # limits of every NPC, which `columns` respect
    sections: frozenset[tuple[str, str]]  # sections of the path, as pairs of highway-env's nodes
    # lanes of the path in driving order; `line.piece` contains indices of this tuple
    route: tuple[LaneIndex, ...]
    others: tuple[LaneIndex, ...]  # lanes in no section of the path, which are the last of `lanes`
    line: Line
    lane_width: float  # width of the ego's lane at the start [m]
    # limit of the path's fastest lane, or the ego's initial speed if that is higher [m/s]
    speed_limit: float
    start: float  # start position of the ego along the road [m]
    ego_lane: int
    ego_speed: float

    def __deepcopy__(self, _: dict[int, object]) -> NetworkRoad:
        return self  # immutable, and highway-env deep-copies the road to predict vehicles

    @cached_property
    def end(self) -> float:
        """The length [m] of the road, and thus the position at which it ends."""
        return (len(self.line.x) - 1) * STEP

    @property
    def lane_count(self) -> int:
        return len(self.columns)

    @property
    def start_lanes(self) -> tuple[int, ...]:
        return tuple(lane for lane in range(len(self.columns)) if self.has_lane(lane, self.start))

    @cached_property
    def bends(self) -> Bends:
        return self._bends(self.columns)

    @cached_property
    def _of_others(self) -> dict[tuple[NpcLimits, float], Bends]:
        return {}

    def bends_of(self, vehicle: VehicleType) -> Bends:
        """Return the lanes along the ego's path, with the speeds and leans of a vehicle type."""
        if vehicle == CAR:
            return self.bends
        key = self.limits.for_vehicle(vehicle), vehicle.length
        if key not in self._of_others:
            self._of_others[key] = self._bends(self.shaped(*key)[0])
        return self._of_others[key]

    def _bends(self, columns: Sequence[Column]) -> Bends:
        def joined(name: str) -> list[Any]:
            return [value for each in columns for value in getattr(each, name)]

        line = self.line
        return Bends(
            (line.x.tolist(), line.y.tolist(), line.heading.tolist()),
            (joined("exists"), joined("part")),
            (
                joined("across"),
                joined("direction"),
                joined("lean"),
                joined("speed"),
                joined("sharpest"),
            ),
            [lane.width for lane in self.lanes],
            self.lane_width,
        )

    def cells(self, along: float, ego_lane: int, rows: float) -> frozenset[Cell]:
        """Return the cells around an ego that have their centres on lanes, given the distance [m] between rows."""
        return frozenset(
            cell for cell in Cell if self.has_lane(ego_lane + cell.column, along + cell.row * rows)
        )

    def position(self, longitudinal: float, lane: int, vehicle: VehicleType = CAR) -> Pose:
        return self.bends_of(vehicle).pose(lane, longitudinal)

    def beside(
        self,
        network: Any,
        x: float,
        y: float,
        lane: int,
        along: float,
    ) -> tuple[int, Outcome | None]:
        """Return the index of the lane of an ego that is on no lane of its path, and the outcome of the run.

        If the run continues, the outcome is None. ``lane`` is the nearest lane of the path, and ``along`` [m] is the
        position along the path.
        """
        point = np.array([x, y])
        on = [index for index, each in network.lanes_dict().items() if each.on_lane(point)]
        # if the ego is next to its lanes, but in a section of its path, the run continues
        if any(index[:2] in self.sections for index in on):
            return self.columns[lane].part[self.bends.point(along)], None
        if on:
            return len(self.lanes) - len(self.others) + self.others.index(on[0]), Outcome.LEFT_ROUTE
        return -1, Outcome.OFF_ROAD

    def has_lane(self, lane: int, along: float) -> bool:
        return self.bends.exists(lane, along)

    @property
    def prescribed(self) -> tuple[int, float]:
        return self.ego_lane, self.ego_speed  # set by the environment's reset

    def ego_start(self, headway: float, clearance: float) -> float:
        return self.start

    @property
    def said_of_start_lanes(self) -> tuple[str, str]:
        lanes = " or ".join(map(str, self.start_lanes))
        fix = "lanes are counted from 0 at the left, including lanes that do not exist at the start"
        return f"a lane that exists at the ego's start ({lanes})", fix

    def start_cells(self, lane: int, distance: float) -> frozenset[Cell]:
        return self.cells(self.start, lane, distance)

    def can_drive(self, vehicle: VehicleType, zone: str | None = None) -> bool:
        return all(vehicle.can_follow(max(column.sharpest)) for column in self.columns)

    def start_speed(
        self,
        wanted: float,
        lane: int,
        along: float,
        vehicle: VehicleType,
    ) -> float:
        bends = self.bends_of(vehicle)
        # Just after a bend, an NPC's heading still differs from its course, so the NPC turns, and the faster it drives,
        # the faster it turns.
        limits = self.limits.for_vehicle(vehicle)
        most = BEND_SHARE * limits.lateral_acceleration * vehicle.length / 2
        fastest = math.sqrt(most / max(math.sin(abs(bends.lean_at(lane, along))), 1e-9))
        return min(wanted, bends.speed_at(lane, along), fastest)

    def director(
        self,
        scenario: Scenario,
        limits: NpcLimits,
        cells: frozenset[Cell],
        **common: Any,
    ) -> Director | JunctionDirector:
        return NetworkDirector(scenario, self, limits, start_cells=cells, **common)

    def places(
        self,
        vehicles: list[Body],
        bodies: list[Body],
        scenario: Scenario,
        *,
        starts: Sequence[float],
        ticks: int,
        stock_road: Callable[[], Any],
    ) -> Places:
        return Places(
            vehicles,
            bodies,
            bends=self.bends,
            starts=starts,
            ways=[None, *self.tracks(scenario)],
            end=self.end,
            beside=lambda x, y, lane, along: self.beside(stock_road().network, x, y, lane, along),
            ticks=ticks,
        )

    def tracks(self, scenario: Scenario) -> list[Track | None]:
        return [None] * len(scenario.npcs)

    def sensor(
        self,
        places: Places,
        record: Any,
        scenario: Scenario,
        rates: tuple[float, int],
        sight: Sight | None,
        ego: VehicleType,
    ) -> Sensor:
        return RoadSensor(
            places,
            record,
            self.bends,
            [self.bends_of(each) for each in (ego, *scenario.all_vehicles)],
            self.zones(scenario),
            (self.lane_count, self.lane_width, self.speed_limit, self.end),
            *rates,
            sight,
            scenario.seed,
        )

    def foresight(self, body: Body) -> Callable[[float], Pose] | None:
        # highway-env predicts vehicles along their routes. NPCs have none, so it would assume constant steering.
        return lambda along: self.position(along, body.lane)

    @cached_property
    def unused(self) -> frozenset[Meeting]:
        # NPCs on the grid drive only on the path's own lanes
        own_lanes = len(self.lanes) - len(self.others)
        ways = zip(self.others, self.lanes[own_lanes:], strict=True)
        meetings = (self._meeting(index[:2], lane) for index, lane in ways)
        return frozenset(meeting for meeting in meetings if meeting is not None)

    def _meeting(self, section: tuple[str, str], lane: Lane) -> Meeting | None:
        is_turned = section[::-1] in self.sections
        starts, ends = map(set, zip(*self.sections, strict=True))
        if section[1] in ends:
            return "joins"
        if not is_turned and not (starts | ends).isdisjoint(section):
            return None
        points = np.array(lane.points)
        if not lane.points:  # the lane is straight
            places = np.linspace(0.0, lane.length, max(2, math.ceil(lane.length)))
            x = lane.x + math.cos(lane.heading) * places
            y = lane.y + math.sin(lane.heading) * places
            points = np.stack([x, y], axis=-1)
        apart = np.hypot(points[:, :1] - self.line.x, points[:, 1:] - self.line.y)
        if not is_turned:
            is_near = apart.min() < self.lane_width / 2
            if is_near:
                return "crosses"
            return None
        # The two halves of a roundabout connect the same two nodes, as do the two directions of a road. But where the
        # two halves meet, they have the same direction.
        here, there = np.unravel_index(int(apart[:-1].argmin()), apart[:-1].shape)
        x, y = points[here + 1] - points[here]
        heading = self.line.heading[there]
        ahead = x * math.cos(heading) + y * math.sin(heading)
        if ahead < 0:
            return "oncoming"
        return None


LaneIndex = tuple[str, str, int]
"""The index of a lane in highway-env: the start and end nodes of its section, and its number from the left."""
Angle = TypeVar("Angle", float, FloatArray)

STEP = 0.5
"""The distance [m] between neighbouring points of a line."""
# largest gap between consecutive lanes [m]; highway-env's roundabouts have gaps of 6 m
WIDEST_GAP = 10.0
# largest angle between two consecutive lanes [rad]; no vehicle can follow a larger one
SHARPEST_BEND = 1.3
# distance before a lane's end at which highway-env's vehicles choose the next lane [m]
DECIDED_BEFORE = 2.5
# angle between neighbouring points above which the joint of two lanes is rounded off [rad]; no vehicle can follow it
ROUGH = 0.06
BLEND = 3.0  # length scale over which the joint of two lanes is rounded off, on either side [m]


@dataclass(frozen=True, slots=True)
class Piece:
    """The part of a lane that belongs to a path, from ``begin`` [m] to ``end`` [m] along the lane."""

    index: LaneIndex
    lane: Any
    begin: float
    end: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """The line along which positions on a road are measured, with a point every 0.5 m.

    The headings [rad] do not jump by 2 pi. ``piece`` contains the index of the piece to which each point belongs.
    """

    x: FloatArray
    y: FloatArray
    heading: FloatArray
    piece: np.ndarray[Any, np.dtype[np.intp]]


def way(
    network: Any,
    start: LaneIndex,
    at: float,
    planned: Sequence[Any] | None,
    *,
    ahead: float,
    behind: float,
) -> tuple[tuple[Piece, ...], int]:
    """Return the pieces of the ego's path in driving order, and the index of the piece in which the ego starts.

    The ego starts in lane ``start`` at the position ``at`` [m]. ``planned`` is the ego's ``route`` in highway-env. The
    path extends ``ahead`` [m] and ``behind`` [m] from the start, or less if the network ends before that.
    """
    lane = network.get_lane(start)
    pieces = deque([Piece(start, lane, 0.0, float(lane.length))])
    wanted = behind - at
    while wanted > 0 and (leading := _predecessor(network, pieces[0])) is not None:
        pieces.appendleft(leading)
        wanted -= leading.end
    first = len(pieces) - 1
    route = [step for step in planned or () if tuple(step[:2]) != start[:2]]
    wanted = ahead - (pieces[-1].end - at)
    while wanted > 0 and (following := _successor(network, pieces[-1], route)) is not None:
        pieces.append(following)
        wanted -= following.end - following.begin
        if route and tuple(route[0][:2]) == following.index[:2]:
            route.pop(0)
    return tuple(pieces), first


def _successor(network: Any, last: Piece, route: Sequence[Any]) -> Piece | None:
    # The next piece on the route, or the nearest drivable piece.
    origin, node, number = last.index
    point = last.lane.position(last.end, 0)
    deciding = last.lane.position(max(last.end - DECIDED_BEFORE, last.begin), 0)
    ends = [(end, None) for end in network.graph.get(node, {})]
    if route and route[0][0] == node:
        ends = [route[0][1:]]
    nearest = math.inf
    found = None
    for end, wanted in ends:
        chosen, distance = network.next_lane_given_next_road(
            origin,
            node,
            number,
            end,
            wanted,
            deciding,
        )
        index = node, end, chosen
        lane = network.get_lane(index)
        length = float(lane.length)
        begin = min(max(float(lane.local_coordinates(point)[0]), 0.0), length)
        piece = Piece(index, lane, begin, length)
        if distance < nearest and length - begin > STEP and is_drivable(last, piece):
            nearest = distance
            found = piece
    return found


def is_dead_end(network: Any, last: Piece) -> bool:
    """Return whether a lane ends at a point from which the road continues only in other lanes."""
    return bool(network.graph.get(last.index[1])) and _successor(network, last, ()) is None


def _predecessor(network: Any, piece: Piece) -> Piece | None:
    """Return the nearest piece from which a vehicle can drive to ``piece``."""
    point = np.asarray(piece.lane.position(0, 0))

    def distance(leading: Piece) -> float:
        return float(np.linalg.norm(leading.lane.position(leading.end, 0) - point))

    pieces = (
        Piece(index, lane, 0.0, float(lane.length))
        for index, lane in network.lanes_dict().items()
        if index[1] == piece.index[0]
    )
    found = [each for each in pieces if each.end > STEP and is_drivable(each, piece)]
    return min(found, key=distance, default=None)


def is_drivable(last: Piece, piece: Piece) -> bool:
    """Return whether a vehicle can drive from the end of one piece to the start of the next."""
    here = np.asarray(last.lane.position(last.end, 0))
    x, y = np.asarray(piece.lane.position(piece.begin, 0)) - here
    heading = float(last.lane.heading_at(last.end))
    turn = wrap_angle(float(piece.lane.heading_at(piece.begin)) - heading)
    middle = heading + turn / 2
    sideways = abs(y * math.cos(middle) - x * math.sin(middle))
    if sideways > 0.6 * float(last.lane.width_at(last.end)):  # it is beside the last piece
        return False
    return float(np.hypot(x, y)) <= WIDEST_GAP and abs(turn) <= SHARPEST_BEND


def line_of(pieces: Sequence[Piece]) -> Line:
    """Join the centre lines of pieces into one line, and round off the joints."""
    points, owners = _spaced(*_sampled(pieces))
    joints = []
    for joint in (np.flatnonzero(np.diff(owners)) + 1).tolist():
        near = points[max(joint - 4, 0) : joint + 6]
        dx, dy = np.diff(near, axis=0).T
        heading = np.unwrap(np.arctan2(dy, dx))
        if len(heading) > 1 and np.abs(np.diff(heading)).max() > ROUGH:
            joints.append(joint)
    if joints:
        points, owners = _spaced(_rounded(points, joints), owners)
    x, y = points.T
    heading = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
    return Line(x=x, y=y, heading=heading, piece=owners)


def _sampled(pieces: Sequence[Piece]) -> tuple[FloatArray, FloatArray]:
    rows: list[tuple[float, float]] = []
    owners: list[int] = []
    for number, piece in enumerate(pieces):
        count = max(2, math.ceil((piece.end - piece.begin) / STEP) + 1)
        for longitudinal in np.linspace(piece.begin, piece.end, count).tolist():
            x, y = map(float, piece.lane.position(longitudinal, 0))
            # the last piece ends where this one begins
            if rows and math.dist((x, y), rows[-1]) < STEP / 10:
                owners[-1] = number
            else:
                rows.append((x, y))
                owners.append(number)
    return np.array(rows), np.array(owners)


def _spaced(points: FloatArray, owners: Any) -> tuple[FloatArray, Any]:
    length = distances(points)
    places = np.arange(0.0, length[-1] + STEP / 2, STEP)
    spaced = np.stack([np.interp(places, length, axis) for axis in points.T], axis=-1)
    nearest = np.searchsorted(length, places - 1e-9)
    return spaced, owners[np.minimum(nearest, len(owners) - 1)]


def distances(points: FloatArray) -> FloatArray:
    """Return the distance [m] of each point of a line from its start, along the line."""
    steps = np.hypot(*np.diff(points, axis=0).T)
    return np.concatenate(([0.0], np.cumsum(steps)))


def bell_curve(scale: float) -> tuple[FloatArray, int]:
    """Return weights that round off a line over a length scale [m], and their number on each side of the middle."""
    reach = round(3 * scale / STEP)
    places = np.arange(-reach, reach + 1) * STEP / scale
    weights = np.exp(-0.5 * places**2)
    return weights / weights.sum(), reach


def _rounded(points: FloatArray, joints: Sequence[int]) -> FloatArray:
    weights, reach = bell_curve(BLEND)
    # the line continues straight before its start and after its end
    steps = np.arange(1, reach + 1)[:, None]
    before = points[0] - (points[1] - points[0]) * steps[::-1]
    after = points[-1] + (points[-1] - points[-2]) * steps
    padded = np.concatenate([before, points, after])
    smooth = np.stack([np.convolve(axis, weights, mode="valid") for axis in padded.T], axis=-1)
    places = np.arange(len(points))
    share = np.zeros(len(points))
    for joint in joints:
        distance = np.abs(places - joint) * STEP
        share = np.maximum(share, np.clip(2 - distance / (2 * BLEND), 0.0, 1.0))
    share = (share * share * (3 - 2 * share))[:, None]
    return points * (1 - share) + smooth * share


def wrap_angle(angle: Angle) -> Angle:
    """Wrap an angle [rad], or an array of angles, to [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi
