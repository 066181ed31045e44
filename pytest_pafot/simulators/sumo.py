"""Nets of SUMO as a world: ``pafot.sumo()``, by sumolib (``pip install "pytest-pafot[sumo]"``).

The ego and the NPCs are moved by the package's own model of a vehicle, along the lanes of the net. So who is steered,
who touches whom and who is to blame is found as in the other worlds.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

from pytest_pafot.support.errors import WorldError, install
from pytest_pafot.world.engines.simulation import Simulator
from pytest_pafot.world.simulator_world import SimulatorWorld

if TYPE_CHECKING:
    from pytest_pafot.world.simulator_world import WorldArguments

LANE_WIDTH = 4.0
"""The width of the lanes of the straight road [m], as in ``pafot.Highway``."""


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
    """Return a world on a straight road, or on a way through a net of SUMO.

    Args:
        net: the file of a net, as SUMO's netconvert and netedit write it (``.net.xml``); None for a straight road.
        route: the ids of the edges of the ego's way through the net, in order. Where two are not connected, the
            shortest way between them is taken, so the first and the last are enough. None if the net has only one way.
        lanes: the number of lanes of the straight road, 4 m wide.
        speed_limit: its speed limit [m/s]; None for 26.8. In a net, it is the lowest one along the way.
        hz: ticks per second.
        start_lane, start_speed, start_at: on a way with bends, the ego's first lane, counted from 0 at the left of the
            first edge, its first speed [m/s], and its place along the lane [m]; by default 22 m/s or the limit, with
            room behind it.
        world: other arguments of :class:`pytest_pafot.SimulatorWorld`, such as ``ads_hz``, ``duration``, ``limits``.

    Raises:
        WorldError: if an argument cannot be used, the net does not fit, or sumolib is not installed.
    """
    arguments: dict[str, Any] = {"hz": hz}
    if net is None:
        arguments |= {"lanes": lanes, "speed_limit": speed_limit}
    else:
        arguments |= {"net": str(net), "route": None if route is None else list(route)}
        arguments |= {"start_lane": start_lane, "start_speed": start_speed, "start_at": start_at}
    return SimulatorWorld(partial(Sumo, **arguments), **world)


class Sumo(Simulator):
    """A net of SUMO, for :class:`pytest_pafot.SimulatorWorld`; the arguments are those of :func:`sumo`.

    Args:
        digest: of the net's content, in a file that names the net; a net with another one is refused.

    Attributes:
        edges: the ids of the edges of the way, in order.
    """

    y_is_left = degrees = True
    reference = "front"
    headings = "y to x"
    packages = ("libsumo",)

    def __init__(
        self,
        *,
        net: str | None = None,
        route: Sequence[str] | None = None,
        lanes: int = 4,
        speed_limit: float | None = None,
        hz: int = 20,
        start_lane: int = 0,
        start_speed: float | None = None,
        start_at: float | None = None,
        digest: str = "",
    ) -> None:
        self.hz = hz
        self.edges = ["road"]
        self._data: dict[str, Any] = {"hz": hz}
        self._states: list[tuple[float, ...]] = []
        if net is None:
            self.lanes, self.lane_width = lanes, LANE_WIDTH
            self.speed_limit = 26.8 if speed_limit is None else speed_limit
            self._data |= {"lanes": lanes, "speed_limit": speed_limit}
            return
        way = Way(net, route)
        self.edges, self.lanes, self.lane_width, self.speed_limit = way.edges, way.lines, way.width, way.limit
        if start_lane not in way.starts:
            expected = f"one of {', '.join(map(str, way.starts))}, the lanes of {self.edges[0]!r} along the route"
            fix = "the route may turn off from the other lanes; begin it with a later edge"
            raise WorldError(field="start_lane", expected=expected, received=repr(start_lane), fix=fix)
        self.start_lane, self.start_speed, self.start_at = start_lane + way.left, start_speed, start_at
        self._data |= {"start_lane": start_lane, "start_speed": start_speed, "start_at": start_at}
        now = hashlib.sha256(Path(net).read_bytes()).hexdigest()[:16]
        if digest not in ("", now):
            fix = "take the net of the commit that has the file, or search again"
            raise WorldError(field="net", expected=f"{net} as it was", received="another content", fix=fix)
        self._data |= {"net": net, "digest": now, "route": way.edges}

    def to_dict(self) -> dict[str, Any]:
        """Return the arguments, with the digest of the net."""
        return self._data

    def start(self, vehicles: Sequence[Any], seed: int) -> None:
        """Begin a run with these vehicles at their places."""
        self._states = [(each.x, each.y, each.heading, each.speed) for each in vehicles]

    def step(self, controls: Sequence[Any]) -> None:
        """Put the vehicles where the package's own model moves them."""
        self._states = [(each.x, each.y, each.heading, each.speed) for each in controls]

    def states(self) -> list[tuple[float, ...]]:
        """Return x, y, compass heading and speed of the front of each vehicle."""
        return self._states


class Way:
    """The lanes along a route through a net of SUMO.

    Args:
        path: the file of the net.
        route: the edges in order, see :func:`sumo`.

    Attributes:
        edges: the ids of all edges of the route.
        lines: the centre line of each lane along it, from the left [m].
        left: how many of them are to the left of the lanes of the first edge.
        starts: the lanes of the first edge that are not left out, from 0 at its left.
        width: the width of the leftmost lane of the first edge [m].
        limit: the lowest speed limit of the edges [m/s].

    Raises:
        WorldError: if the file is no net, or the route is none in it.
    """

    def __init__(self, path: str, route: Sequence[str] | None) -> None:
        try:
            from sumolib.net import readNet  # noqa: PLC0415  (comes with libsumo, which not everybody has)
        except ImportError as error:
            expected, fix = "an installed sumolib", install("sumo")
            raise WorldError(field="pafot.sumo", expected=expected, received=f"{error}", fix=fix) from None

        try:
            self._net = readNet(path, withInternal=True)
        except Exception as error:  # noqa: BLE001  (of a reader of XML, of its handler, or of the file)
            expected = "a net of SUMO, as its netconvert writes it"
            received = f"{type(error).__name__}: {error}"
            raise WorldError(field=f"net, {path}", expected=expected, received=received) from None
        self._edges = self._connected(self._ends() if route is None else route)
        self.edges = [edge.getID() for edge in self._edges]
        columns = self._columns()
        self.lines = [_line(columns[number]) for number in sorted(columns)]
        self.left = sum(number < 0 for number in columns)
        first_lanes = [
            sorted(columns).index(number) for number, lanes in columns.items() if lanes[0].getEdge() is self._edges[0]
        ]
        self.starts = [each - self.left for each in first_lanes]
        longest = max(columns.values(), key=_length)
        if longest[0].getEdge() is not self._edges[0]:
            first, after = self.edges[0], longest[0].getEdge().getID()
            received = f"{first!r}, whose lanes end before those that begin in {after!r}"
            expected = "a way whose longest lane begins in its first edge, by which the road is measured"
            raise self._refused(expected, received, f"begin with another edge, such as {after!r}")
        first = self._cars(self._edges[0])
        self.width = float(first[0].getWidth())
        self.limit = min(float(lane.getSpeed()) for edge in self._edges for lane in self._cars(edge))

    def _refused(self, expected: str, received: str, fix: str) -> WorldError:
        return WorldError(field="route", expected=expected, received=received, fix=fix)

    def _ends(self) -> list[str]:
        """Return the first and the last edge of a net with a single way."""
        edges = [each for each in self._net.getEdges(withInternal=False) if self._cars(each)]
        first = [each.getID() for each in edges if not each.getIncoming()]
        last = [each.getID() for each in edges if not each.getOutgoing()]
        if len(first) != 1 or len(last) != 1:
            some = ", ".join(repr(each.getID()) for each in edges[:6])
            expected = "the edges of the ego's way, because this net has more than one"
            raise self._refused(expected, "None", f"write route=[first, last] with edges such as {some}")
        return [*first, *last] if first != last else first

    def _connected(self, route: Sequence[str]) -> list[Any]:
        """Return the edges of a route, with those of the shortest way between two that are not connected."""
        edges: list[Any] = []
        for name in route:
            if not self._net.hasEdge(name) or not self._cars(self._net.getEdge(name)):
                near = [each.getID() for each in self._net.getEdges(withInternal=False) if self._cars(each)][:6]
                raise self._refused("edges of the net for passenger cars", repr(name), f"there are {', '.join(near)}")
            edge = self._net.getEdge(name)
            if edges:
                found, _ = self._net.getShortestPath(edges[-1], edge, vClass="passenger")
                if not found:
                    received = f"{edges[-1].getID()!r} and {name!r}, between which there is none"
                    raise self._refused("edges with a way from each to the next", received, "leave one of them out")
                edges += found[1:]
            else:
                edges = [edge]
        return edges

    @staticmethod
    def _cars(edge: Any) -> list[Any]:
        """Return the lanes of an edge for passenger cars, from the left."""
        return [lane for lane in reversed(edge.getLanes()) if lane.allows("passenger")]

    def _columns(self) -> dict[int, list[Any]]:
        """Return the lanes of the way by their number from the left, each with its pieces in order.

        A lane goes on in the next edge if it is connected to the lane that most of its neighbours move to, as many
        places to the left or right. A lane that ends is left out behind its end, and of two parts with the same number
        the shorter is.
        """
        shift, parts = 0, {number: [[lane]] for number, lane in enumerate(self._cars(self._edges[0]))}
        for before, after in zip(self._edges, self._edges[1:], strict=False):
            old, new = self._cars(before), self._cars(after)
            joined = [
                (old.index(each.getFromLane()), new.index(each.getToLane()), each)
                for each in before.getOutgoing().get(after, ())
                if each.getFromLane() in old and each.getToLane() in new
            ]
            moves = [there - here for here, there, _ in joined]
            move = max(sorted(set(moves), key=abs), key=moves.count)
            shift -= move
            via = {there: each for here, there, each in joined if there - here == move}
            for number, lane in enumerate(new):
                column = parts.setdefault(number + shift, [])
                if number in via and column and column[-1][-1] is old[number - move]:
                    column[-1] += [*self._inside(via[number]), lane]
                else:
                    column.append([lane])
        return {number: max(column, key=_length) for number, column in parts.items()}

    def _inside(self, connection: Any) -> list[Any]:
        """Return the lanes of a connection within its junction."""
        lanes, via = [], connection.getViaLaneID()
        while via:
            lane = self._net.getLane(via)
            lanes.append(lane)
            via = next((each.getViaLaneID() for each in lane.getOutgoing()), "")
        return lanes


def _length(lanes: Sequence[Any]) -> float:
    """Return the length of some lanes [m]."""
    return float(sum(lane.getLength() for lane in lanes))


def _line(lanes: Sequence[Any]) -> list[tuple[float, float]]:
    """Return the centre line along some lanes, without points at the same place [m]."""
    points: list[tuple[float, float]] = []
    for lane in lanes:
        for x, y, *_ in lane.getShape():
            if not points or math.dist(points[-1], (x, y)) > 0.05:  # nets have centimetres
                points.append((x, y))
    return points
