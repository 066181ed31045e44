"""Roads of any shape in the grid's coordinates: positions along the ego's way and across its lanes.

The way (:mod:`pytest_pafot.world.roads.route`) is the line for measurements along the road. At every half metre, the
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
from typing import Any

import numpy as np
import numpy.typing as npt

from pytest_pafot.model.grid import Cell
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
from pytest_pafot.world.roads.route import STEP, LaneIndex, Line

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
        x, y, heading = self.bends.reference(longitudinal)
        across, direction, lean = self.bends_of(vehicle).lane_at(lane, longitudinal)
        return x - math.sin(heading) * across, y + math.cos(heading) * across, direction + lean

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

    def stretch(self, lane: int, along: float) -> float:
        """Return how many metres a vehicle drives in a lane per metre of the way."""
        return self.bends.stretch(along, self.bends.across_at(lane, along))

    @property
    def prescribed(self) -> tuple[int, float]:
        """The lane and the speed of the ego that the environment's reset has made."""
        return self.ego_lane, self.ego_speed

    def ego_start(self, headway: float, clearance: float) -> float:
        """Return the ego's place along the road at the start [m], whatever headway and clearance NPCs have."""
        return self.start

    @property
    def said_of_start_lanes(self) -> tuple[str, str]:
        """What an error says of the ego's lane."""
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
        rates: tuple[int, int],
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
