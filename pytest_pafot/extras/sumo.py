"""SUMO as a world: ``pafot.sumo()``, by libsumo (``pip install "pytest-pafot[sumo]"``).

The ego and the NPCs with instructions are moved by the package's own model of a vehicle, and placed into SUMO at each
tick, as co-simulations of SUMO with other simulators do. SUMO keeps such a place exactly, on a road or beside it.
Free NPCs with one of SUMO's drivers are moved by SUMO, and see all the others. So who is steered, who touches whom and
who is to blame is found as in the other worlds, and SUMO's own detection of collisions is off. In a run without one of
its drivers SUMO would only give back what it is given, so it is not started.

libsumo has one simulation in a process, and ``libsumo.start`` replaces it. Runs in a process follow each other, so each
begins with that.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import math
import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any
from xml.sax.saxutils import quoteattr

from pytest_pafot import Simulator, SimulatorWorld, WorldError
from pytest_pafot.support.errors import install

BRAKING = 8.0
"""How hard every vehicle can brake, as NPCs do by default [m/s^2]; SUMO's default for emergencies is 9 m/s^2. SUMO's
drivers choose their gaps by what the vehicle ahead can do."""
LANE_WIDTH = 4.0
"""The width of the lanes of the straight road [m], as in ``pafot.Highway``."""
ENDLESS = 1_000_000.0
"""The length of the straight road [m]. The cost of a run does not depend on it."""
EAST = 90.0
"""The direction along the x axis, in degrees of a compass."""
AS_ASKED = 0
"""SUMO's mode of lane changes in which a vehicle wants none, and does not ask others for room."""
ANY_PLACE = 2
"""SUMO's mode of ``moveToXY`` in which the vehicle is where it is put, also beside the road."""
OPTIONS = (
    "--no-step-log=true",
    "--no-warnings=true",
    "--xml-validation=never",
    "--xml-validation.net=never",
    "--xml-validation.routes=never",
    "--collision.action=none",
    "--time-to-teleport=-1",
)

DRIVERS: Mapping[str, Mapping[str, str]] = MappingProxyType(
    {
        "sumo-krauss": {"carFollowModel": "Krauss"},
        "sumo-idm": {"carFollowModel": "IDM"},
        "sumo-eidm": {"carFollowModel": "EIDM"},
        "sumo-acc": {"carFollowModel": "ACC"},
        "sumo-w99": {"carFollowModel": "W99"},
    }
)
"""The drivers of free NPCs unless the user names others: SUMO's attributes of a vehicle type by the driver's name."""
OURS = frozenset({"id", "length", "width", "maxSpeed", "speedFactor", "speedDev"})
"""The attributes of a vehicle type that the scenario decides."""
NAMED = re.compile(r"[A-Za-z]\w*", re.ASCII)
"""The name of an attribute. Names are written into a file that SUMO obeys, and may come from a stranger's scenario."""


def sumo(
    net: str | Path | None = None,
    *,
    route: Sequence[str] | None = None,
    lanes: int = 4,
    speed_limit: float | None = None,
    hz: int = 20,
    drivers: Mapping[str, Mapping[str, Any]] | None = None,
    lane_change: float = 3.0,
    start_lane: int = 0,
    start_speed: float | None = None,
    start_at: float | None = None,
    **world: Any,
) -> SimulatorWorld:
    """Return a world in which SUMO drives: a straight road, or a way through a net of the user's.

    Args:
        net: the file of a net, as SUMO's netconvert and netedit write it (``.net.xml``); None for a straight road.
        route: the ids of the edges of the ego's way through the net, in order. Where two are not connected, the
            shortest way between them is taken, so the first and the last are enough. None if the net has only one way.
        lanes: the number of lanes of the straight road, 4 m wide.
        speed_limit: its speed limit [m/s]; None for 26.8. In a net, it is the lowest one along the way.
        hz: ticks per second; a divisor of 1000, because SUMO counts milliseconds.
        drivers: the drivers of free NPCs by name, each with SUMO's attributes of a vehicle type, such as
            ``{"calm": {"carFollowModel": "IDM", "tau": 2.0}}``; None for those that the guide lists.
        lane_change: how long a driver of SUMO takes to change lanes [s].
        start_lane, start_speed, start_at: on a way with bends, the ego's first lane, counted from 0 at the left of the
            first edge, its first speed [m/s], and its place along the lane [m]; by default 22 m/s or the limit, with
            room behind it.
        world: other arguments of :class:`pytest_pafot.SimulatorWorld`, such as ``ads_hz``, ``duration``, ``limits``.

    Raises:
        WorldError: if an argument cannot be used, the net does not fit, or libsumo is not installed.
    """
    arguments: dict[str, Any] = {"hz": hz, "lane_change": lane_change}
    arguments["drivers"] = _checked(DRIVERS if drivers is None else drivers)
    if net is None:
        arguments |= {"lanes": lanes, "speed_limit": speed_limit}
    else:
        arguments |= {"net": str(net), "route": None if route is None else list(route)}
        arguments |= {"start_lane": start_lane, "start_speed": start_speed, "start_at": start_at}
    return SimulatorWorld(partial(Sumo, **arguments), **world)


def _checked(drivers: Any) -> dict[str, dict[str, str]]:
    """Return the attributes of each driver as texts.

    Raises:
        WorldError: if they are no attributes by name, or some that the scenario decides.
    """
    if not isinstance(drivers, Mapping):
        received = f"{drivers!r:.200}"
        raise WorldError(field="drivers", expected="SUMO's attributes of a vehicle type by driver", received=received)
    for name, attributes in drivers.items():
        is_named = isinstance(attributes, Mapping) and all(NAMED.fullmatch(str(key)) for key in attributes)
        if not is_named or (ours := OURS.intersection(attributes)):
            expected = f"SUMO's attributes of a vehicle type by name, without {', '.join(sorted(OURS))}"
            received = ", ".join(sorted(ours)) if is_named else f"{attributes!r:.200}"
            fix = "a scenario says how long and wide a vehicle is, and how fast it wants to drive"
            raise WorldError(field=f"drivers[{name!r}]", expected=expected, received=received, fix=fix)
    return {name: {key: str(value) for key, value in each.items()} for name, each in drivers.items()}


class Sumo(Simulator):
    """SUMO, for :class:`pytest_pafot.SimulatorWorld`; the arguments are those of :func:`sumo`.

    Args:
        digest: of the net's content, in a file that names the net; a net with another one is refused.

    Attributes:
        edges: the ids of the edges of the way, in order.
    """

    y_is_left = degrees = at_front = True
    headings = "y to x"
    follows_recordings = True
    one_at_a_time = True
    packages = ("libsumo",)

    def __init__(
        self,
        *,
        net: str | None = None,
        route: Sequence[str] | None = None,
        lanes: int = 4,
        speed_limit: float | None = None,
        hz: int = 20,
        drivers: Mapping[str, Mapping[str, str]] = DRIVERS,
        lane_change: float = 3.0,
        start_lane: int = 0,
        start_speed: float | None = None,
        start_at: float | None = None,
        digest: str = "",
    ) -> None:
        self._sumo = _libsumo()
        if not isinstance(hz, int) or hz < 1 or 1000 % hz:
            expected = "a divisor of 1000, such as 10, 20, 25 or 50, because SUMO counts milliseconds"
            raise WorldError(field="hz", expected=expected, received=repr(hz))
        self.hz = hz
        self._attributes = _checked(drivers)
        self.drivers = tuple(self._attributes)
        self._options = [*OPTIONS, f"--step-length={1 / hz:g}", f"--lanechange.duration={lane_change:g}"]
        self._net, self.edges = net, ["road"]
        self._data: dict[str, Any] = {"hz": hz, "drivers": self._attributes}
        self._data |= {"lane_change": lane_change}
        self._is_asked = False
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
        """Begin a simulation with these vehicles at their places."""
        self._names = ["ego", *(f"npc{number}" for number in range(len(vehicles) - 1))]
        self._placed = [not each.driver for each in vehicles]
        self._is_asked = not all(self._placed)
        self._states = [(each.x, each.y, each.heading, each.speed) for each in vehicles]
        if not self._is_asked:
            return
        with TemporaryDirectory(prefix="pafot-sumo-") as folder:
            net = self._net or self._written(folder, "net.net.xml", self._straight())
            types = self._written(folder, "types.add.xml", self._types(vehicles))
            options = [*self._options, f"--seed={seed % 2**31}"]
            try:
                self._sumo.start(["sumo", f"--net-file={net}", f"--additional-files={types}", *options])
            except self._sumo.TraCIException as error:
                received = f"{error}, of which SUMO has printed the reason to the standard error"
                fix = "are the attributes in drivers= SUMO's, and does SUMO itself open the net?"
                raise WorldError(field="Sumo.start", expected="that SUMO starts", received=received, fix=fix) from None
        self._ticks = 1
        moves = self._sumo.vehicle
        for name, each in zip(self._names, vehicles, strict=True):
            moves.add(name, "way", typeID=name)
            if not each.driver:
                moves.setLaneChangeMode(name, AS_ASKED)
            moves.moveToXY(name, "", -1, each.x, each.y, each.heading, ANY_PLACE)
        self._sumo.simulationStep()
        missing = [name for name in self._names if name not in moves.getIDList()]
        if missing:
            expected = "that SUMO inserts every vehicle at its start"
            fix = "let the way begin further behind the ego, with a longer first edge or another start_at="
            raise WorldError(field="Sumo.start", expected=expected, received=f"none for {', '.join(missing)}", fix=fix)
        for name, each in zip(self._names, vehicles, strict=True):
            moves.setPreviousSpeed(name, max(each.speed, 0.0))

    def _types(self, vehicles: Sequence[Any]) -> str:
        """Return a vehicle type for each vehicle, as a file of SUMO."""
        rows = []
        for name, each in zip(self._names, vehicles, strict=True):
            kind = {"id": name, "length": f"{each.length:g}", "width": f"{each.width:g}"}
            kind |= {"speedDev": "0", "emergencyDecel": f"{BRAKING:g}"}
            if each.driver:  # it wants to drive as fast as the scenario says, but at most as fast as the lane allows
                kind |= {"speedFactor": "1", "maxSpeed": f"{max(each.wanted_speed, 0.1):g}"}
                kind |= self._attributes[each.driver]
            else:
                kind |= {"decel": f"{BRAKING:g}", "maxSpeed": "100"}
            rows.append(f"<vType {' '.join(f'{key}={quoteattr(value)}' for key, value in kind.items())}/>")
        route = f"<route id='way' edges={quoteattr(' '.join(self.edges))}/>"
        return f"<additional>{''.join(rows)}{route}</additional>"

    def _straight(self) -> str:
        """Return the straight road as a net of SUMO, which counts lanes from the right."""
        ends = 'type="dead_end" y="0" incLanes="" intLanes="" shape=""'
        count = self._data["lanes"]
        lanes = [
            f'<lane id="road_{index}" index="{index}" speed="{self.speed_limit}" length="{ENDLESS}" '
            f'width="{LANE_WIDTH}" shape="0,{y} {ENDLESS},{y}"/>'
            for index, y in ((index, -LANE_WIDTH * (count - 1 - index)) for index in range(count))
        ]
        return (
            f'<net version="1.20"><edge id="road" from="a" to="b" priority="1">{"".join(lanes)}</edge>'
            f'<junction id="a" x="0" {ends}/><junction id="b" x="{ENDLESS}" {ends}/></net>'
        )

    @staticmethod
    def _written(folder: str, name: str, text: str) -> str:
        path = Path(folder, name)
        path.write_text(text, encoding="utf-8")
        return str(path)

    def step(self, controls: Sequence[Any]) -> None:
        """Place the vehicles that controls move, and let SUMO move the others."""
        if not self._is_asked:
            self._states = [(each.x, each.y, each.heading, each.speed) for each in controls]
            return
        moves, placed = self._sumo.vehicle, list(zip(self._names, controls, self._placed, strict=True))
        if round(self._sumo.simulation.getTime() * self.hz) != self._ticks:
            expected = "that nobody else uses libsumo in this process, which has one simulation"
            fix = "a policy that runs SUMO itself drives in pafot.Highway"
            raise WorldError(field="Sumo.step", expected=expected, received="another simulation", fix=fix)
        for name, each, is_placed in placed:
            if is_placed:
                moves.moveToXY(name, "", -1, each.x, each.y, each.heading, ANY_PLACE)
        self._sumo.simulationStep()
        self._ticks += 1
        for name, each, is_placed in placed:
            if is_placed:  # SUMO places it at the end of the step, and others see its speed from then on
                moves.setPreviousSpeed(name, max(each.speed, 0.0), each.acceleration)
        there, before = set(moves.getIDList()), self._states
        self._states = [
            (each.x, each.y, each.heading, each.speed)
            if is_placed
            else (*moves.getPosition(name), moves.getAngle(name), moves.getSpeed(name))
            if name in there
            else self._beyond_end(name, state)
            for (name, each, is_placed), state in zip(placed, before, strict=True)
        ]

    def _beyond_end(self, name: str, state: tuple[float, ...]) -> tuple[float, float, float, float]:
        """Return where a vehicle is that SUMO has taken out where its way ends, if it drives on as it was."""
        if name in self._sumo.simulation.getStartingTeleportIDList():
            expected = "that SUMO moves a vehicle from place to place"
            raise WorldError(field="Sumo.step", expected=expected, received=f"that it teleports {name}")
        x, y, heading, speed = state
        angle, distance = math.radians(EAST - heading), speed / self.hz
        return x + distance * math.cos(angle), y + distance * math.sin(angle), heading, speed

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
        from sumolib.net import readNet  # noqa: PLC0415  (comes with libsumo, which not everybody has)

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


def _libsumo() -> Any:
    """Import libsumo, which prints a warning if pyarrow is another version than the one that it has inside.

    Raises:
        WorldError: if it is not installed.
    """
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            import libsumo  # noqa: PLC0415  (an extra that takes a second)
    except ImportError as error:
        expected, fix = "an installed libsumo", install("sumo")
        raise WorldError(field="pafot.sumo", expected=expected, received=f"{error}", fix=fix) from None
    return libsumo
