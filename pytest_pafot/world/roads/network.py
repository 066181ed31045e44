"""Roads of any shape in the grid's coordinates: positions along the ego's way and across its lanes.

The way (:mod:`pytest_pafot.world.roads.network`) is the line for measurements along the road. At every half metre, the
lanes of the same road section are next to it, found by projection like highway-env's ``side_lanes``. Lanes are numbered
from the left. The ego's way has the same number from beginning to end; other lanes need not exist everywhere.

Nominal positions across the road are in lane widths: the centre of lane ``k`` is always at ``k`` times the lane width,
wherever the lane really is.
"""

from __future__ import annotations

import math
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
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.crossing import JunctionDirector
from pytest_pafot.world.kernel.director import Director, NetworkDirector
from pytest_pafot.world.kernel.lanes import Bends, Track
from pytest_pafot.world.kernel.observation import RoadSensor, Sensor
from pytest_pafot.world.kernel.places import Places
from pytest_pafot.world.limits import BEND_SHARE, NpcLimits
from pytest_pafot.world.roads.road import Meeting, Pose, Road

SLOWING = 2.0
"""The deceleration of an NPC before a bend or a lane's end [m/s^2]; at most a third of its braking limit is used."""
SPEED_LAG = 1 / 1.5
"""The time by which the speed control lags behind a steadily falling target speed: the inverse of its gain [s]."""


def allowed_speeds(
    curvature: FloatArray, limit: FloatArray, stops: float | None, lengths: FloatArray, limits: NpcLimits
) -> FloatArray:
    """Return the highest speed of an NPC at each point of a lane [m/s].

    It is at most the speed limit times ``limits.overspeed``, and at most sqrt(share * a / curvature) in a bend. It is
    also so low that gentle braking suffices for all following points. Arrays have an entry per point: curvature [1/m],
    speed limit [m/s], length along the lane [m]. ``stops`` is the length at which the lane ends [m], None if it does
    not.
    """
    with np.errstate(divide="ignore"):
        bend = np.sqrt(BEND_SHARE * limits.lateral_acceleration / np.abs(curvature))
    speed = np.minimum(bend, limits.overspeed * limit)
    slowing = min(SLOWING, limits.braking / 3)
    if stops is not None:
        speed = np.where(lengths >= stops, 0.0, speed)
    squares, places = (speed**2).tolist(), lengths.tolist()
    for index in range(len(squares) - 2, -1, -1):
        reach = squares[index + 1] + 2 * slowing * (places[index + 1] - places[index])
        squares[index] = min(squares[index], reach)
    speed = np.sqrt(squares)
    reached = np.searchsorted(lengths, lengths + speed * SPEED_LAG, side="right")  # the lag of the speed control
    return _of_windows(np.minimum, speed, np.minimum(reached + 1, len(speed)))


def _of_windows(extreme: np.ufunc, values: FloatArray, ends: npt.NDArray[np.intp]) -> FloatArray:
    """Return the least or the largest of the values from each point on, up to the end that it has."""
    bounds = np.stack([np.arange(len(values)), ends], axis=-1).ravel()
    windows: FloatArray = extreme.reduceat(np.append(values, values[-1]), bounds)[::2]  # an end may be after the last
    return windows


def leans(direction: FloatArray, lengths: FloatArray, vehicle_length: float) -> FloatArray:
    """Return the angle to a lane of a vehicle whose centre follows it exactly, by highway-env's bicycle model [rad].

    The rear axle is half a length behind the centre and moves in the direction of the heading. The heading therefore
    turns by sin(direction - heading) / (length / 2) per metre.
    """
    lean = [0.0]
    for step, turn in zip(np.diff(lengths).tolist(), np.diff(direction).tolist(), strict=True):
        settled = math.asin(max(-0.99, min(0.99, turn / step * vehicle_length / 2))) if step > 0 else 0.0
        share = 1 - math.exp(-2 * step / vehicle_length)
        lean.append(lean[-1] + share * (-settled - lean[-1]))
    return np.array(lean)


def sharpest_ahead(curvature: FloatArray, lengths: FloatArray, reach: float) -> FloatArray:
    """Return the largest curvature within a distance ahead of each point of a lane [1/m]."""
    return _of_windows(np.maximum, np.abs(curvature), np.searchsorted(lengths, lengths + reach, side="right"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """One lane along the whole way; lists have an entry per point of the line.

    Attributes:
        exists: True if the lane exists at the point.
        across: the distance of its centre from the line, to the right [m].
        direction: the direction of its centre line [rad].
        lean: the angle between the direction and a vehicle that follows the lane exactly [rad]. In a bend, a car's
            heading is turned inwards less than its course.
        speed: the highest speed that bends, speed limits and the lane's end allow to an NPC [m/s].
        sharpest: the largest curvature of the lane within the length of a lane change ahead of the point [1/m].
        part: the index of the lane in ``Trace.lanes``, -1 if it does not exist.
    """

    exists: list[bool]
    across: list[float]
    direction: list[float]
    lean: list[float]
    speed: list[float]
    sharpest: list[float]
    part: list[int]


Shaped = Callable[..., tuple[tuple[Column, ...], list[Lane]]]
"""A function that returns lanes for driving and for a trace, by the limits of an NPC and its length [m]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class NetworkRoad(Road):
    """The lanes along the ego's way through a network.

    Attributes:
        lanes: all lanes in the form of a trace: first the lanes of the way from the left, then the network's others.
        columns: the lanes of the way, from the left, for cars.
        shaped: returns the lanes for NPCs with given limits and a given length [m].
        limits: the limits of every NPC, with which ``columns`` were made.
        sections: the way's sections, as pairs of highway-env's nodes.
        route: the lanes of the way in driving order; ``line.piece`` has indices of this tuple.
        line: the line of the way.
        others: highway-env's indices of the lanes that are in no section of the way; they are the last of ``lanes``.
        lane_width: the width of the ego's lane at the start [m].
        speed_limit: the speed limit of the way's fastest lane, or the ego's first speed if that is higher [m/s].
        start, ego_lane, ego_speed: the ego's place along the road [m], lane and speed [m/s] at the start.
    """

    lanes: tuple[Lane, ...]
    columns: tuple[Column, ...]
    shaped: Shaped
    limits: NpcLimits
    sections: frozenset[tuple[str, str]]
    route: tuple[LaneIndex, ...]
    others: tuple[LaneIndex, ...]
    line: Line
    lane_width: float
    speed_limit: float
    start: float
    ego_lane: int
    ego_speed: float

    def __deepcopy__(self, _: dict[int, object]) -> NetworkRoad:
        """Return itself, because it is immutable and highway-env deep-copies the road to predict vehicles."""
        return self

    @cached_property
    def end(self) -> float:
        """The place along the road at which it ends [m]."""
        return (len(self.line.x) - 1) * STEP

    @property
    def lane_count(self) -> int:
        """The number of lanes along the way; some may exist only in places."""
        return len(self.columns)

    @property
    def start_lanes(self) -> tuple[int, ...]:
        """The lanes that exist at the ego's start."""
        return tuple(lane for lane in range(len(self.columns)) if self.has_lane(lane, self.start))

    @cached_property
    def bends(self) -> Bends:
        """The same road in plain numbers, for the kernel."""
        return self._bends(self.columns)

    @cached_property
    def _of_others(self) -> dict[tuple[NpcLimits, float], Bends]:
        return {}

    def bends_of(self, vehicle: VehicleType) -> Bends:
        """Return the road with the speeds and the leans of an NPC that is a given vehicle; of a car, :attr:`bends`."""
        if vehicle == CAR:
            return self.bends
        key = self.limits.of(vehicle), vehicle.length
        if key not in self._of_others:
            self._of_others[key] = self._bends(self.shaped(*key)[0])
        return self._of_others[key]

    def _bends(self, columns: Sequence[Column]) -> Bends:
        line = self.line
        exists = [flag for each in columns for flag in each.exists]
        part = [number for each in columns for number in each.part]
        across = [place for each in columns for place in each.across]
        direction = [angle for each in columns for angle in each.direction]
        lean = [angle for each in columns for angle in each.lean]
        speed = [most for each in columns for most in each.speed]
        sharpest = [most for each in columns for most in each.sharpest]
        points, widths = (line.x.tolist(), line.y.tolist(), line.heading.tolist()), [lane.width for lane in self.lanes]
        return Bends(points, (exists, part), (across, direction, lean, speed, sharpest), widths, self.lane_width)

    def cells(self, along: float, ego_lane: int, rows: float) -> frozenset[Cell]:
        """Return the cells around an ego whose centres are on lanes; ``rows`` is the distance between rows [m]."""
        return frozenset(cell for cell in Cell if self.has_lane(ego_lane + cell.column, along + cell.row * rows))

    def position(self, longitudinal: float, lane: int, vehicle: VehicleType = CAR) -> Pose:
        """Return the pose of a vehicle on the centre of a lane."""
        return self.bends_of(vehicle).pose(lane, longitudinal)

    def beside(self, network: Any, x: float, y: float, lane: int, along: float) -> tuple[int, Outcome | None]:
        """Return the lane of an ego that is on no lane of its way, and the outcome of the run.

        Args:
            network: the road network of highway-env.
            x, y: the ego's centre [m].
            lane, along: the nearest lane of the way, and the ego's place along the way [m].
        """
        on = [index for index, each in network.lanes_dict().items() if each.on_lane(np.array([x, y]))]
        if any(index[:2] in self.sections for index in on):
            return self.columns[lane].part[self.bends.point(along)], None
        if on:
            return len(self.lanes) - len(self.others) + self.others.index(on[0]), Outcome.LEFT_ROUTE
        return -1, Outcome.OFF_ROAD

    def has_lane(self, lane: int, along: float) -> bool:
        """Return whether a lane exists at a place along the road [m]."""
        return self.bends.exists(lane, along)

    @property
    def prescribed(self) -> tuple[int, float]:
        """The lane and the speed of the ego that the environment's reset has made."""
        return self.ego_lane, self.ego_speed

    def ego_start(self, headway: float, clearance: float) -> float:
        """Return the ego's place along the road at the start [m], whatever headway and clearance NPCs have."""
        return self.start

    @property
    def said_of_start_lanes(self) -> tuple[str, str]:
        """The words of an error on the ego's lane: see the base class."""
        lanes = " or ".join(map(str, self.start_lanes))
        fix = "lanes are counted from 0 at the left, over all lanes along the ego's way"
        return f"a lane that exists where the ego starts, {lanes}", fix

    def start_cells(self, lane: int, distance: float) -> frozenset[Cell]:
        """Return the cells around the ego's start whose centres are on lanes."""
        return self.cells(self.start, lane, distance)

    def can_drive(self, vehicle: VehicleType, zone: str | None = None) -> bool:
        """Return whether a vehicle can follow all bends along the ego's way, the only one here."""
        return all(vehicle.can_follow(max(column.sharpest)) for column in self.columns)

    def start_speed(self, wanted: float, lane: int, along: float, vehicle: VehicleType) -> float:
        """Return ``wanted``, or less in and just after a bend.

        Just after a bend, an NPC's heading still differs from its course, so the NPC turns, and at a higher speed
        faster.
        """
        bends = self.bends_of(vehicle)
        most = BEND_SHARE * self.limits.of(vehicle).lateral_acceleration * vehicle.length / 2
        fastest = math.sqrt(most / max(math.sin(abs(bends.lean_at(lane, along))), 1e-9))
        return min(wanted, bends.speed_at(lane, along), fastest)

    def director(
        self, scenario: Scenario, limits: NpcLimits, cells: frozenset[Cell], **common: Any
    ) -> Director | JunctionDirector:
        """Make the director of the NPCs."""
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
        """Make the places of the vehicles of a run, which are tracked from tick to tick."""
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
        """Return the own way of each NPC that crosses, None for each other NPC."""
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
        """Make the maker of a planner's observations, in which the road is straight."""
        common = self.lane_count, self.lane_width, self.speed_limit, self.end
        zones, leaning = list(self.zones(scenario)), [*map(self.bends_of, (ego, *scenario.all_vehicles))]
        seen = None if sight is None else (sight, scenario.seed)
        return RoadSensor(places, record, self.bends, leaning, zones, common, *rates, seen)

    def foresight(self, body: Body) -> Callable[[float], Pose] | None:
        """Return where an NPC goes along its lane.

        highway-env predicts its own vehicles along their routes. An NPC has no such route, so highway-env would assume
        that it keeps its steering angle.
        """
        return lambda along: self.position(along, body.lane)

    @cached_property
    def unused(self) -> frozenset[Meeting]:
        """The kinds of meetings of the way with lanes outside the way, on which NPCs on the grid never drive."""
        own_lanes = len(self.lanes) - len(self.others)
        ways = zip(self.others, self.lanes[own_lanes:], strict=True)
        return frozenset(filter(None, (self._meeting(index[:2], lane) for index, lane in ways)))

    def _meeting(self, section: tuple[str, str], lane: Lane) -> Meeting | None:
        """Return how a lane outside the way's sections meets the way; None if the lane leaves it or is far away."""
        nodes, ends = {node for each in self.sections for node in each}, {end for _, end in self.sections}
        is_turned = section[::-1] in self.sections
        if section[1] in ends:
            return "joins"
        if not is_turned and not nodes.isdisjoint(section):
            return None
        places = np.linspace(0.0, lane.length, max(2, math.ceil(lane.length)))
        straight = np.stack(
            [lane.x + math.cos(lane.heading) * places, lane.y + math.sin(lane.heading) * places], axis=-1
        )
        points = np.array(lane.points) if lane.points else straight
        apart = np.hypot(points[:, :1] - self.line.x, points[:, 1:] - self.line.y)
        if not is_turned:
            return "crosses" if apart.min() < self.lane_width / 2 else None
        # Two halves of a roundabout have the same two nodes as the two directions of a road, but go on where they meet.
        here, there = np.unravel_index(int(apart[:-1].argmin()), apart[:-1].shape)
        x, y = points[here + 1] - points[here]
        heading = self.line.heading[there]
        return "oncoming" if x * math.cos(heading) + y * math.sin(heading) < 0 else None


LaneIndex = tuple[str, str, int]
"""The index of a lane in highway-env: its road section's start and end node, and its number there from the left."""
Angle = TypeVar("Angle", float, FloatArray)

STEP = 0.5
"""The distance between neighbouring points of a line [m]."""
WIDEST_GAP = 10.0
"""The largest gap over which a vehicle drives on from a lane's end to the next lane [m]; in highway-env's roundabouts
it is 6 m."""
SHARPEST_BEND = 1.3
"""The largest angle between the directions of two consecutive lanes [rad]; no vehicle can follow a larger angle."""
DECIDED_BEFORE = 2.5
"""The distance before a lane's end at which highway-env's vehicles choose the next lane [m]."""
ROUGH = 0.06
"""The angle between neighbouring points of a line above which a joint of two lanes is rounded off [rad], because no
vehicle can follow it."""
BLEND = 3.0
"""The length scale over which a joint of two lanes is rounded off, to either side [m]."""


@dataclass(frozen=True, slots=True)
class Piece:
    """The part of a lane that belongs to a way, from ``begin`` to ``end`` in the lane's longitudinal coordinate [m]."""

    index: LaneIndex
    lane: Any
    begin: float
    end: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """A line for measurements along the road, with a point every 0.5 m.

    Attributes:
        x, y: world coordinates [m], shape [points].
        heading: the direction at each point [rad], without jumps of 2 pi.
        piece: the index of the piece to which each point belongs.
    """

    x: FloatArray
    y: FloatArray
    heading: FloatArray
    piece: np.ndarray[Any, np.dtype[np.intp]]


def way(
    network: Any, start: LaneIndex, at: float, planned: Sequence[Any] | None, *, ahead: float, behind: float
) -> tuple[tuple[Piece, ...], int]:
    """Return the pieces of the ego's way in driving order, and the number of the piece in which the ego starts.

    The ego starts in lane ``start`` at the longitudinal coordinate ``at`` [m]. The way covers the distances ``ahead``
    and ``behind`` [m] if the network continues that far. ``planned`` is the ego's ``route`` in highway-env.
    """
    first = Piece(start, network.get_lane(start), 0.0, float(network.get_lane(start).length))
    before: list[Piece] = []
    piece, wanted = first, behind - at
    while wanted > 0 and (leading := _predecessor(network, piece)) is not None:
        before.insert(0, leading)
        piece, wanted = leading, wanted - leading.end
    after: list[Piece] = []
    route = [step for step in planned or () if tuple(step[:2]) != start[:2]]
    piece, wanted = first, ahead - (first.end - at)
    while wanted > 0 and (following := _successor(network, piece, route)) is not None:
        after.append(following)
        piece, wanted = following, wanted - (following.end - following.begin)
        if route and tuple(route[0][:2]) == following.index[:2]:
            route.pop(0)
    return (*before, first, *after), len(before)


def _successor(network: Any, last: Piece, route: Sequence[Any]) -> Piece | None:
    """Return the next piece on the route, or without a route the nearest piece on which a vehicle can drive on."""
    origin, node, number = last.index
    point = last.lane.position(last.end, 0)
    deciding = last.lane.position(max(last.end - DECIDED_BEFORE, last.begin), 0)
    is_planned = bool(route) and route[0][0] == node
    ends = [route[0][1]] if is_planned else list(network.graph.get(node, {}))
    found: list[tuple[float, Piece]] = []
    for end in ends:
        wanted = route[0][2] if is_planned else None
        chosen, distance = network.next_lane_given_next_road(origin, node, number, end, wanted, deciding)
        lane = network.get_lane((node, end, chosen))
        begin = min(max(float(lane.local_coordinates(point)[0]), 0.0), float(lane.length))
        piece = Piece((node, end, chosen), lane, begin, float(lane.length))
        if piece.end - piece.begin > STEP and is_drivable(last, piece):
            found.append((float(distance), piece))
    return min(found, key=lambda each: each[0])[1] if found else None


def is_dead_end(network: Any, last: Piece) -> bool:
    """Return whether a lane ends where the road goes on in others, such as next to it."""
    return bool(network.graph.get(last.index[1])) and _successor(network, last, ()) is None


def _predecessor(network: Any, piece: Piece) -> Piece | None:
    """Return the nearest piece that leads to a piece; highway-env's networks do not store predecessors."""
    point = np.asarray(piece.lane.position(0, 0))
    lanes = network.lanes_dict().items()
    leading = (Piece(index, lane, 0.0, float(lane.length)) for index, lane in lanes if index[1] == piece.index[0])
    found = [each for each in leading if each.end > STEP and is_drivable(each, piece)]
    return min(found, key=lambda each: np.linalg.norm(each.lane.position(each.end, 0) - point), default=None)


def is_drivable(last: Piece, piece: Piece) -> bool:
    """Return whether a vehicle can drive from the end of one piece to the beginning of the next.

    It cannot if the next lane is beside the end, as where a ramp's lane ends: a vehicle changes lanes before.
    """
    step = np.asarray(piece.lane.position(piece.begin, 0)) - np.asarray(last.lane.position(last.end, 0))
    heading = float(last.lane.heading_at(last.end))
    turn = wrapped(float(piece.lane.heading_at(piece.begin)) - heading)
    sideways = abs(step[1] * math.cos(heading + turn / 2) - step[0] * math.sin(heading + turn / 2))
    is_beside = sideways > 0.6 * float(last.lane.width_at(last.end))
    return float(np.hypot(*step)) <= WIDEST_GAP and abs(turn) <= SHARPEST_BEND and not is_beside


def line_of(pieces: Sequence[Piece]) -> Line:
    """Join the centre lines of the pieces to one line, with gaps and bends between them rounded off."""
    points, owners = _spaced(*_sampled(pieces))
    joints = []
    for joint in (np.flatnonzero(np.diff(owners)) + 1).tolist():
        near = points[max(joint - 4, 0) : joint + 6]
        heading = np.unwrap(np.arctan2(*np.diff(near, axis=0).T[::-1]))
        if len(heading) > 1 and np.abs(np.diff(heading)).max() > ROUGH:
            joints.append(joint)
    if joints:
        points, owners = _spaced(_rounded(points, joints), owners)
    dx, dy = np.gradient(points[:, 0]), np.gradient(points[:, 1])
    return Line(x=points[:, 0], y=points[:, 1], heading=np.unwrap(np.arctan2(dy, dx)), piece=owners)


def _sampled(pieces: Sequence[Piece]) -> tuple[FloatArray, FloatArray]:
    rows: list[tuple[float, float]] = []
    owners: list[int] = []
    for number, piece in enumerate(pieces):
        count = max(2, math.ceil((piece.end - piece.begin) / STEP) + 1)
        for longitudinal in np.linspace(piece.begin, piece.end, count).tolist():
            x, y = map(float, piece.lane.position(longitudinal, 0))
            if rows and math.dist((x, y), rows[-1]) < STEP / 10:  # the last piece ends where this one begins
                owners[-1] = number
            else:
                rows.append((x, y))
                owners.append(number)
    return np.array(rows), np.array(owners)


def _spaced(points: FloatArray, owners: Any) -> tuple[FloatArray, Any]:
    """Resample a line at equal distances, and return its points and the piece of each."""
    length = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))))
    places = np.arange(0.0, length[-1] + STEP / 2, STEP)
    spaced = np.stack([np.interp(places, length, points[:, axis]) for axis in (0, 1)], axis=-1)
    return spaced, owners[np.clip(np.searchsorted(length, places - 1e-9), 0, len(owners) - 1)]


def _rounded(points: FloatArray, joints: Sequence[int]) -> FloatArray:
    reach = round(3 * BLEND / STEP)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) * STEP / BLEND) ** 2)
    kernel /= kernel.sum()
    ends = points[0] - (points[1] - points[0]) * np.arange(reach, 0, -1)[:, None]
    beyond = points[-1] + (points[-1] - points[-2]) * np.arange(1, reach + 1)[:, None]
    padded = np.concatenate([ends, points, beyond])
    smooth = np.stack([np.convolve(padded[:, axis], kernel, mode="valid") for axis in (0, 1)], axis=-1)
    places = np.arange(len(points))
    share = np.zeros(len(points))
    for joint in joints:
        distance = np.abs(places - joint) * STEP
        share = np.maximum(share, np.clip(2 - distance / (2 * BLEND), 0.0, 1.0))
    share = (share * share * (3 - 2 * share))[:, None]
    return points * (1 - share) + smooth * share


def wrapped(angle: Angle) -> Angle:
    """Return an angle or an array of angles wrapped to [-pi, pi) [rad]."""
    return (angle + math.pi) % (2 * math.pi) - math.pi
