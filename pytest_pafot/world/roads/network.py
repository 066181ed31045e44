"""Roads of any shape, as the grid sees them: positions along the ego's way and across its lanes.

The way (:mod:`pytest_pafot.world.roads.route`) is the line to measure along. Beside it, at every half metre, are the
lanes of the same road section, found by projecting as highway-env's own ``side_lanes`` are used. A lane is known by its
number from the left, the ego's way having the same number from the beginning to the end; it need not exist everywhere.

Across the road positions are given in lanes: lane ``k`` has its centre at ``k`` lane widths, whatever the road does.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np

from pytest_pafot.model.grid import Cell
from pytest_pafot.model.trace import FloatArray, Lane, Outcome
from pytest_pafot.world.kernel.bends import Bends
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.limits import NpcLimits
from pytest_pafot.world.roads.route import STEP, LaneIndex, Line
from pytest_pafot.world.roads.straight import StraightRoad

Meeting = Literal["crosses", "joins", "oncoming"]
"""How another road meets the ego's way; one that only leaves it does not count."""

# How fast an NPC may be at each place of a lane, and how a vehicle lies in its bends. Pure functions of arrays.

BEND_SHARE = 0.8
"""Share of the lateral acceleration that following a bend may take; the rest is left for control."""
SLOWING = 2.0
"""Deceleration by which an NPC gets slower for a bend or an end [m/s^2], at most a third of what it can."""
SPEED_LAG = 1 / 1.5
"""How long the speed control lags behind a speed that falls steadily: the inverse of its gain [s]."""


def allowed_speeds(
    curvature: FloatArray, limit: FloatArray, stops: float | None, lengths: FloatArray, limits: NpcLimits
) -> FloatArray:
    """The highest speed at each point of a lane [m/s].

    At most the speed limit times the NPCs' excess of it, at most what the bend allows, sqrt(share * a / curvature),
    and at every point so slow that gentle braking suffices for all points that follow, begun early enough. Arrays have
    an entry per point: curvature [1/m], speed limit [m/s], length along the lane [m]. ``stops`` is the length at which
    the lane ends [m], None if it does not.
    """
    with np.errstate(divide="ignore"):
        bend = np.sqrt(BEND_SHARE * limits.lateral_acceleration / np.abs(curvature))
    speed = np.minimum(bend, limits.overspeed * limit)
    slowing = min(SLOWING, limits.braking / 3)
    if stops is not None:
        speed = np.where(lengths >= stops, 0.0, speed)
    squares = speed**2
    for index in range(len(squares) - 2, -1, -1):
        reach = squares[index + 1] + 2 * slowing * (lengths[index + 1] - lengths[index])
        squares[index] = min(squares[index], reach)
    speed = np.sqrt(squares)
    reached = np.searchsorted(lengths, lengths + speed * SPEED_LAG, side="right")  # while the speed control lags behind
    return np.array([speed[index : last + 1].min() for index, last in enumerate(reached)])


def leans(direction: FloatArray, lengths: FloatArray, vehicle_length: float) -> FloatArray:
    """The angle to a lane of a vehicle whose centre follows it exactly [rad], by highway-env's bicycle model.

    Its rear axle is half a length behind its centre and moves where it points: per metre the heading turns by
    sin(direction - heading) / (length / 2).
    """
    lean = np.zeros(len(direction))
    for index in range(1, len(direction)):
        step = float(lengths[index] - lengths[index - 1])
        turn = float(direction[index] - direction[index - 1])
        settled = math.asin(max(-0.99, min(0.99, turn / step * vehicle_length / 2))) if step > 0 else 0.0
        share = 1 - math.exp(-2 * step / vehicle_length)
        lean[index] = lean[index - 1] + share * (-settled - lean[index - 1])
    return lean


def sharpest_ahead(curvature: FloatArray, lengths: FloatArray, reach: float) -> FloatArray:
    """The largest curvature from each point of a lane to so far ahead [1/m]."""
    last = np.searchsorted(lengths, lengths + reach, side="right")
    bend = np.abs(curvature)
    return np.array([bend[index:end].max() for index, end in enumerate(last)])


class Spot(NamedTuple):
    """A vehicle on the road.

    Attributes:
        along, across: of its centre, on the ego's way and to its right [m].
        angle: of its heading to the way [rad].
        lane: the nearest one that exists there.
        offset: to the centre of that lane, to the right [m].
    """

    along: float
    across: float
    angle: float
    lane: int
    offset: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """One lane along the whole way; lists have an entry per point of the line.

    Attributes:
        exists: whether there is such a lane here.
        across: of its centre from the line [m].
        direction: of its centre line [rad].
        lean: angle to it of a vehicle that follows it without error [rad]; a car in a bend points inwards less than
            it moves.
        speed: highest speed that bends, limits and the lane's end leave to an NPC [m/s].
        sharpest: largest curvature of the lane from here on, as far as a lane change takes [1/m].
        part: index of the lane in ``Trace.lanes``, -1 where there is none.
    """

    exists: list[bool]
    across: list[float]
    direction: list[float]
    lean: list[float]
    speed: list[float]
    sharpest: list[float]
    part: list[int]


@dataclass(frozen=True, kw_only=True, eq=False)
class NetworkRoad:
    """The lanes along the ego's way through a network.

    Attributes:
        lanes: all lanes, as a trace has them: first those of the way from the left, then the others of the network.
        columns: the lanes of the way, from the left.
        sections: of the way, as pairs of highway-env's nodes.
        route: the lanes of the way in driving order, by the numbers that ``line.piece`` has.
        others: highway-env's indices of the lanes that are in no section of the way, the last of ``lanes``.
        lane_width: of the ego's lane at the start [m].
        speed_limit: of the fastest lane of the way, or the ego's first speed where that is more [m/s].
        start, ego_lane, ego_speed: where along the road [m], in which lane and at which speed [m/s] the ego starts.
    """

    lanes: tuple[Lane, ...]
    columns: tuple[Column, ...]
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
        """Itself, as nothing in it changes: highway-env copies vehicles with all that hangs on them to predict them."""
        return self

    @cached_property
    def end(self) -> float:
        """Of the road [m]."""
        return (len(self.line.x) - 1) * STEP

    @property
    def lane_count(self) -> int:
        """How many lanes there are along the way, each of them somewhere."""
        return len(self.columns)

    @property
    def start_lanes(self) -> tuple[int, ...]:
        """The lanes that exist where the ego starts."""
        return tuple(lane for lane in range(len(self.columns)) if self.exists(lane, self.start))

    @cached_property
    def bends(self) -> Bends:
        """The same in plain numbers."""
        line, columns = self.line, self.columns
        exists = [flag for each in columns for flag in each.exists]
        part = [number for each in columns for number in each.part]
        across = [place for each in columns for place in each.across]
        direction = [angle for each in columns for angle in each.direction]
        lean = [angle for each in columns for angle in each.lean]
        speed = [most for each in columns for most in each.speed]
        points, widths = (line.x.tolist(), line.y.tolist(), line.heading.tolist()), [lane.width for lane in self.lanes]
        return Bends(points, (exists, part), (across, direction, lean, speed), widths, self.lane_width)

    def exists(self, lane: int, along: float) -> bool:
        """Whether there is such a lane at a place of the road."""
        return self.bends.exists(lane, along)

    def continues(self, lane: int, since: float, until: float) -> bool:
        """Whether a lane exists from one place to another, or to the end of the road."""
        return self.bends.continues(lane, since, until)

    def cells(self, along: float, ego_lane: int, rows: float) -> frozenset[Cell]:
        """The cells whose centre is on a lane, for rows that are so far apart [m]."""
        return frozenset(cell for cell in Cell if self.exists(ego_lane + cell.column, along + cell.row * rows))

    def position(self, longitudinal: float, lane: int) -> tuple[float, float, float]:
        """World x [m], y [m] and heading [rad] of a vehicle on the centre of a lane."""
        x, y, heading = self.reference(longitudinal)
        across, direction, lean = self.lane_at(lane, longitudinal)
        return x - math.sin(heading) * across, y + math.cos(heading) * across, direction + lean

    def centre(self, lane: int) -> float:
        """How far across the road the centre of a lane is, in the measure of lanes [m]."""
        return lane * self.lane_width

    def nearest_lane(self, lateral: float) -> int:
        """The lane whose centre is nearest, in the measure of lanes."""
        return self.bends.nearest_lane(lateral)

    def lane_at(self, lane: int, along: float) -> tuple[float, float, float]:
        """Of a lane: across [m], direction [rad], lean [rad]."""
        return self.bends.lane_at(lane, along)

    def speed_at(self, lane: int, along: float) -> float:
        """The highest speed of an NPC in a lane [m/s]."""
        return self.bends.speed_at(lane, along)

    def stretch(self, along: float, across: float) -> float:
        """Metres driven there per metre of the road: more outside of a bend, less inside."""
        return self.bends.stretch(along, across)

    def spot(self, x: float, y: float, heading: float, near: float) -> Spot:
        """A vehicle on the road, looked for near a place along it, since roads may cross themselves."""
        bends = self.bends
        bends.locate(x, y, heading, near)
        return Spot(bends.along, bends.across, bends.angle, bends.lane, bends.offset)

    def in_lanes(self, spot: Spot) -> float:
        """Where across the road a vehicle is, in the measure of lanes [m]."""
        return self.bends.in_lanes(spot.lane, spot.along, spot.offset)

    def part(self, spot: Spot) -> int:
        """Index in ``lanes`` of the lane of the way that a vehicle's centre is on, -1 beside them."""
        return self.bends.part(spot.lane, spot.along, spot.offset)

    def reference(self, along: float) -> tuple[float, float, float]:
        """World x, y and heading of the line; straight on beyond its ends."""
        return self.bends.reference(along)

    def point(self, along: float) -> int:
        """The point of the line that is nearest to a place."""
        return self.bends.point(along)

    @cached_property
    def unused(self) -> frozenset[Meeting]:
        """Return how lanes meet the ego's way on which no NPC ever drives, as all of them drive along that way."""
        own_lanes = len(self.lanes) - len(self.others)
        ways = zip(self.others, self.lanes[own_lanes:], strict=True)
        return frozenset(filter(None, (self._meeting(index[:2], lane) for index, lane in ways)))

    def _meeting(self, section: tuple[str, str], lane: Lane) -> Meeting | None:
        """Return how a lane of no section of the way meets it; None where it leaves the way, or is far from it."""
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
        # Two halves of a ring have the same two nodes as the two directions of a road, but lead on where they meet.
        here, there = np.unravel_index(int(apart[:-1].argmin()), apart[:-1].shape)
        x, y = points[here + 1] - points[here]
        heading = self.line.heading[there]
        return "oncoming" if x * math.cos(heading) + y * math.sin(heading) < 0 else None


# Where the vehicles of one run are on the road, tick by tick, and whether the run leaves it.

State = tuple[float, float, float, float]
"""x [m], y [m], heading [rad], speed [m/s]."""


class StraightFrame:
    """Shows vehicles on a straight road to the director."""

    def __init__(self, road: StraightRoad) -> None:
        self._road = road

    def see(self, states: Sequence[State], bodies: Sequence[Body]) -> tuple[list[int], Outcome | None]:
        """Put bodies where the vehicles are on the road; the lane of each, and how the run leaves the road: not at all.

        A run on a straight road goes on where the ego is beside it.
        """
        road, lanes = self._road, []
        for body, (x, y, heading, speed) in zip(bodies, states, strict=True):
            body.place(*road.project(x, y, heading), speed)
            lanes.append(road.grid.locate(body))
        return lanes, None


class NetworkFrame:
    """Follows the vehicles along the road: a road may cross itself, and a circuit comes back to where it began."""

    def __init__(self, road: NetworkRoad, network: Any, starts: Sequence[float]) -> None:
        """``starts`` is where along the road each vehicle starts [m], the ego first."""
        self._road = road
        self._network = network  # highway-env's, to see on which lane an ego is that has left the road
        self._along = list(starts)
        self._rows: list[float] = []

    def see(self, states: Sequence[State], bodies: Sequence[Body]) -> tuple[list[int], Outcome | None]:
        """Put bodies where the vehicles are on the road; the lane of each, and how the run leaves the road, if it does.

        Across the road bodies are in the measure of lanes, their heading is to the ego's way; see :class:`Trace`.
        """
        road, bends, lanes, has_ended = self._road, self._road.bends, [], False
        for number, ((x, y, heading, speed), body) in enumerate(zip(states, bodies, strict=True)):
            bends.locate(x, y, heading, self._along[number])
            along, across, offset, lane = bends.along, bends.across, bends.offset, bends.lane
            self._along[number] = along
            body.place(along, bends.in_lanes(lane, along, offset), bends.angle, speed)
            body.lane = bends.nearest_lane(body.y)
            self._rows += (along, across, bends.angle, offset, bends.stretch(along, across))
            lanes.append(bends.part(lane, along, offset))
            has_ended |= along + body.length / 2 >= road.end
        if has_ended:
            return lanes, Outcome.END_OF_ROAD
        if lanes[0] >= 0:
            return lanes, None
        own, ended = self._beside(np.array(states[0][:2]), road.spot(*states[0][:3], self._along[0]))
        return [own, *lanes[1:]], ended

    def track(self) -> FloatArray:
        """Where all were at every tick, with the columns of :attr:`pytest_pafot.Trace.track`."""
        return np.array(self._rows).reshape(-1, len(self._along), 5)

    def _beside(self, position: FloatArray, spot: Spot) -> tuple[int, Outcome | None]:
        """Of an ego that is on no lane of its way: the lane that it is on, and what that means."""
        on = [index for index, lane in self._network.lanes_dict().items() if lane.on_lane(position)]
        if any(index[:2] in self._road.sections for index in on):
            return self._road.columns[spot.lane].part[self._road.point(spot.along)], None
        if on:
            first = len(self._road.lanes) - len(self._road.others)
            return first + self._road.others.index(on[0]), Outcome.LEFT_ROUTE
        return -1, Outcome.OFF_ROAD
