"""Worlds on the networks of SUMO (``pip install "pytest-pafot[sumo]"``).

The package's own model moves the ego and the NPCs along the lanes of the network.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

from pytest_pafot.support.errors import WorldError, install
from pytest_pafot.support.text import listed
from pytest_pafot.world.engines.simulation import Simulator
from pytest_pafot.world.simulator_world import SimulatorWorld

if TYPE_CHECKING:
    from pytest_pafot.world.simulator_world import WorldArguments

# The width of the lanes of the straight road [m], as in `pafot.Highway`.
LANE_WIDTH = 4.0


def sumo(
    net: str | Path | None = None,
    *,
    route: Sequence[str] | None = None,
    lanes: int = 4,
    speed_limit: float | None = None,
    hz: int = 20,
    start_lane: int = 0,
    start_speed: float | None = None,
    start_at: float | None = None,
    **world: Unpack[WorldArguments],
) -> SimulatorWorld:
    """Return a world on a straight road, or on a route through a SUMO network.

    Args:
        net: network file (``.net.xml``) from SUMO's netconvert or netedit. None for a straight road.
        route: ids of the edges of the ego's route, in order. The shortest path connects two edges that are not
            adjacent, so the first and the last edge suffice. None if the network has only one route.
        lanes: number of lanes of the straight road. Each is 4 m wide.
        speed_limit: speed limit [m/s] of the straight road. None for 26.8 m/s. In a network, the lowest limit along the
            route applies.
        hz: ticks per second.
        start_lane, start_speed, start_at: the ego's lane (from 0 at the left of the first edge), speed [m/s] and
            position [m] along the lane at the start, for a route with bends. The default is 22 m/s or the speed limit,
            at the first position with enough road behind the ego.
        world: other arguments of :class:`pytest_pafot.SimulatorWorld`, such as ``ads_hz``, ``duration`` and ``limits``.

    Raises:
        WorldError: if an argument cannot be used, the network is unsuitable, or sumolib is not installed.
    """
    if net is None:
        make = partial(Sumo, hz=hz, lanes=lanes, speed_limit=speed_limit)
    else:
        if route is not None:
            route = list(route)
        make = partial(
            Sumo,
            hz=hz,
            net=str(net),
            route=route,
            start_lane=start_lane,
            start_speed=start_speed,
            start_at=start_at,
        )
    return SimulatorWorld(make, **world)


@dataclass(eq=False, repr=False, kw_only=True)
class Sumo(Simulator):
    """A SUMO network as a simulator, with the arguments of :func:`sumo`.

    Args:
        digest: digest of the network from a saved scenario. A network with a different digest is rejected.

    Attributes:
        edges: ids of the edges of the route, in order.
    """

    y_is_left = degrees = True
    reference = "front"
    headings = "y to x"
    packages = ("libsumo",)

    net: str | None = None
    route: Sequence[str] | None = None
    lanes: Any = 4
    speed_limit: float | None = None
    hz: float = 20
    start_lane: int = 0
    start_speed: float | None = None
    start_at: float | None = None
    digest: str = ""

    def __post_init__(self) -> None:
        self._data: dict[str, Any] = {"hz": self.hz}
        self._states: list[tuple[float, ...]] = []
        if self.net is None:
            self._data |= {"lanes": self.lanes, "speed_limit": self.speed_limit}
            self.edges = ["road"]
            self.lane_width = LANE_WIDTH
            if self.speed_limit is None:
                self.speed_limit = 26.8
            return
        way = Way(self.net, self.route)
        self.edges = way.edges
        self.lanes = way.lines
        self.lane_width = way.width
        self.speed_limit = way.limit
        if self.start_lane not in way.starts:
            starts = listed([*map(str, way.starts)], "or")
            raise WorldError(
                "start_lane",
                f"lane {starts} of the edge {self.edges[0]!r}, from which the route can be followed",
                repr(self.start_lane),
                "to use another lane, start the route at a later edge",
            )
        content = Path(self.net).read_bytes()
        now = hashlib.sha256(content).hexdigest()[:16]
        if self.digest not in ("", now):
            fix = "use the network from the commit of the saved scenario, or search again"
            raise WorldError("net", f"{self.net} as it was saved", "a changed file", fix)
        self._data |= {
            "start_lane": self.start_lane,
            "start_speed": self.start_speed,
            "start_at": self.start_at,
            "net": self.net,
            "digest": now,
            "route": way.edges,
        }
        self.start_lane += way.left

    def to_dict(self) -> dict[str, Any]:
        return self._data

    def start(self, vehicles: Sequence[Any], seed: int) -> None:
        self.step(vehicles)

    def step(self, controls: Sequence[Any]) -> None:
        self._states = [(each.x, each.y, each.heading, each.speed) for each in controls]

    def states(self) -> list[tuple[float, ...]]:
        # The positions of the fronts, with compass headings.
        return self._states


class Way:
    """The lanes along a route through a SUMO network.

    Raises:
        WorldError: if the file is not a network, or does not contain the route.
    """

    def __init__(self, path: str, route: Sequence[str] | None) -> None:
        try:
            from sumolib.net import readNet  # noqa: PLC0415  (part of libsumo, which is optional)
        except ImportError as error:
            fix = f"run `{install('sumo')}`"
            received = f"the error '{error}'"
            raise WorldError("pafot.sumo", "an installed sumolib", received, fix) from None

        field = f"net, {path}"
        expected = "a SUMO network, as written by netconvert"
        # a saved file may name anything, such as a pipe that never ends
        if not Path(path).is_file():
            raise WorldError(field, expected, "a path that is not a regular file")
        try:
            self._net = readNet(path, withInternal=True)
        except Exception as error:  # noqa: BLE001  (of the XML reader, of its handler, or of the file)
            received = f"the error {type(error).__name__}: {error}"
            raise WorldError(field, expected, received) from None
        self._edges = self._connected(self._ends() if route is None else route)
        self.edges = [edge.getID() for edge in self._edges]
        # The centre line of each lane along the route, from the left [m].
        columns = self._columns()
        numbers = sorted(columns)
        self.lines = [_line(columns[number]) for number in numbers]
        # The number of lanes to the left of the first edge's lanes, and the lanes of this edge, from 0 at its left.
        self.left = sum(number < 0 for number in numbers)
        start = self._edges[0]
        self.starts = [
            index - self.left
            for index, number in enumerate(numbers)
            if columns[number][0].getEdge() is start
        ]
        # The road is measured along its longest lane, so that lane must start at the start of the route.
        other = max(columns.values(), key=_length)[0].getEdge()
        if other is not start:
            after = other.getID()
            raise WorldError(
                "route",
                "a route on which the longest lane starts in the first edge",
                f"{self.edges[0]!r}, whose lanes end before the lanes that start in {after!r}",
                f"start the route with another edge, such as {after!r}",
            )
        self.width = float(self._cars(start)[0].getWidth())
        lanes = [lane for edge in self._edges for lane in self._cars(edge)]
        self.limit = min(float(lane.getSpeed()) for lane in lanes)

    def _ends(self) -> list[str]:
        # The only possible route.
        edges = self._edges_for_cars()
        first = [each.getID() for each in edges if not each.getIncoming()]
        last = [each.getID() for each in edges if not each.getOutgoing()]
        if len(first) != 1 or len(last) != 1:
            some = ", ".join(repr(each.getID()) for each in edges[:6])
            raise WorldError(
                "route",
                "the edges of the ego's route, because this network has more than one route",
                "None",
                f"write route=[first, last] with edges such as {some}",
            )
        if first == last:
            return first
        return first + last

    def _edges_for_cars(self) -> list[Any]:
        return [each for each in self._net.getEdges(withInternal=False) if self._cars(each)]

    def _connected(self, route: Sequence[str]) -> list[Any]:
        edges: list[Any] = []
        for name in route:
            if not self._net.hasEdge(name) or not self._cars(self._net.getEdge(name)):
                near = ", ".join(each.getID() for each in self._edges_for_cars()[:6])
                fix = f"use edges such as {near}"
                raise WorldError("route", "edges for passenger cars", repr(name), fix)
            edge = self._net.getEdge(name)
            if not edges:
                edges = [edge]
                continue
            # The shortest path connects two edges that are not adjacent.
            found, _ = self._net.getShortestPath(edges[-1], edge, vClass="passenger")
            if not found:
                received = f"{edges[-1].getID()!r} and {name!r}, which are not connected"
                expected = "edges that are connected in this order"
                raise WorldError("route", expected, received, "omit one of them")
            edges += found[1:]
        return edges

    @staticmethod
    def _cars(edge: Any) -> list[Any]:
        # For passenger cars, from the left.
        return [lane for lane in reversed(edge.getLanes()) if lane.allows("passenger")]

    def _columns(self) -> dict[int, list[Any]]:
        # The pieces of each lane, in order, by the number of the lane from the left. A lane continues in a lane of the
        # next edge if they are connected, and if most lanes move as many positions to the left or right. If two pieces
        # have the same number, the shorter one is omitted.
        shift = 0
        first = self._cars(self._edges[0])
        parts = {number: [[lane]] for number, lane in enumerate(first)}
        for before, after in pairwise(self._edges):
            old = self._cars(before)
            new = self._cars(after)
            joined = [
                (old.index(each.getFromLane()), new.index(each.getToLane()), each)
                for each in before.getOutgoing().get(after, ())
                if each.getFromLane() in old and each.getToLane() in new
            ]
            # The number of positions that most lanes move to the right from one edge to the next.
            moves = [there - here for here, there, _ in joined]
            smallest_first = sorted(set(moves), key=abs)
            move = max(smallest_first, key=moves.count)
            shift -= move
            via = {there: each for here, there, each in joined if there - here == move}
            # Continue each lane, or start a new piece if nothing leads to it.
            for number, lane in enumerate(new):
                column = parts.setdefault(number + shift, [])
                if number in via and column and column[-1][-1] is old[number - move]:
                    column[-1] += [*self._inside(via[number]), lane]
                else:
                    column.append([lane])
        return {number: max(column, key=_length) for number, column in parts.items()}

    def _inside(self, connection: Any) -> list[Any]:
        # The lanes within the junction.
        lanes = []
        via = connection.getViaLaneID()
        while via:
            lane = self._net.getLane(via)
            lanes.append(lane)
            via = next((each.getViaLaneID() for each in lane.getOutgoing()), "")
        return lanes


def _length(lanes: Sequence[Any]) -> float:
    return float(sum(lane.getLength() for lane in lanes))


def _line(lanes: Sequence[Any]) -> list[tuple[float, float]]:
    # Without points at the same position [m].
    points: list[tuple[float, float]] = []
    for lane in lanes:
        for x, y, *_ in lane.getShape():
            # networks are exact to a centimetre
            if not points or math.dist(points[-1], (x, y)) > 0.05:
                points.append((x, y))
    return points
