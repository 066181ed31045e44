"""Faster subclasses of highway-env's road networks and vehicles, with the same results.

The vehicles are real subclasses, so that highway-env's own drivers treat them as vehicles. They are faster, because
their state is plain floats instead of arrays, and because the lane search uses that lanes are parallel. The equations
are highway-env's, operation by operation.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np

from pytest_pafot.model.trace import Lane
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.lanes import Lanes
from pytest_pafot.world.roads.straight import StraightRoad
from pytest_pafot.world.stock import (
    AbstractLane,
    CircularLane,
    ControlledVehicle,
    MDPVehicle,
    RegulatedRoad,
    Road,
    RoadNetwork,
    SineLane,
    StraightLane,
    Vehicle,
    not_zero,
    wrap_to_pi,
)

OUTLINE_STEP = 1.0
"""The largest distance between the points of a lane's outline [m]."""
SQUARE = 4.0
"""The side of the squares for which the distances of lanes are cached [m]."""
ROUNDING = 1e-6
"""A bound far above the rounding errors of a distance [m]."""


class ParallelLanes(RoadNetwork):  # type: ignore[misc]
    """A road network of parallel straight lanes along x, whose lane search takes only a few additions."""

    def __init__(self, network: RoadNetwork) -> None:
        super().__init__()
        self.graph = network.graph
        ((self._start, ends),) = self.graph.items()
        ((self._end, lanes),) = ends.items()
        first = lanes[0]
        self._x, self._y = float(first.start[0]), float(first.start[1])
        self._grid = Lanes(len(lanes), float(first.width), float(first.length))

    def get_closest_lane_index(self, position: Any, heading: float | None = None) -> tuple[str, str, int]:
        """Return the index of the lane with the smallest sum of lateral distance and angle, as highway-env does."""
        return self.closest(float(position[0]), float(position[1]), 0.0 if heading is None else heading)

    def closest(self, x: float, y: float, heading: float) -> tuple[str, str, int]:
        """Return highway-env's index of the closest lane to a vehicle at x, y [m] with a heading [rad]."""
        return self._start, self._end, self._grid.closest(x - self._x, y - self._y, heading)


class SearchedLanes(RoadNetwork):  # type: ignore[misc]
    """Any road network, with highway-env's lane search restricted to the lanes that are near enough.

    highway-env's distance from a vehicle to a lane is at least a known share of the distance to the lane's outline. A
    lane whose lower limit exceeds the best distance found so far need not be computed. The lower limits are cached for
    each square of the plane that a vehicle has visited.
    """

    def __init__(self, network: RoadNetwork) -> None:
        super().__init__()
        self.graph = network.graph
        self._lanes: list[tuple[tuple[str, str, int], Any]] = list(network.lanes_dict().items())
        self._outlines = [_outline(lane) for _, lane in self._lanes]
        self._squares: dict[tuple[int, int], list[tuple[float, int]]] = {}

    def get_closest_lane_index(self, position: Any, heading: float | None = None) -> tuple[str, str, int]:
        """Return the index of the lane with the smallest sum of lateral distance and angle, as highway-env does."""
        index: tuple[str, str, int]
        x, y = float(position[0]), float(position[1])
        if not (math.isfinite(x) and math.isfinite(y)):
            index = super().get_closest_lane_index(position, heading)
            return index
        square = math.floor(x / SQUARE), math.floor(y / SQUARE)
        near = self._squares.get(square)
        if near is None:
            near = self._squares[square] = self._near(square)
        best, nearest = math.inf, 0
        for least, number in near:
            if least > best + ROUNDING:
                break
            distance = self._lanes[number][1].distance_with_heading(position, heading)
            if distance < best or (distance == best and number < nearest):
                best, nearest = distance, number
        index = self._lanes[nearest][0]
        return index

    def closest(self, x: float, y: float, heading: float | None) -> tuple[str, str, int]:
        """Return highway-env's index of the closest lane."""
        return self.get_closest_lane_index(np.array([x, y]), heading)

    def _near(self, square: tuple[int, int]) -> list[tuple[float, int]]:
        """Return each lane's least distance from all points of a square [m], and its number; the nearest first."""
        x, y = ((each + 0.5) * SQUARE for each in square)
        least = []
        for number, (points, share) in enumerate(self._outlines):
            away = float(np.hypot(points[:, 0] - x, points[:, 1] - y).min())
            # Any point of the square is nearer by at most half its diagonal, any of the lane by at most one step.
            least.append((share * max(away - SQUARE * math.sqrt(0.5) - OUTLINE_STEP, 0.0), number))
        return sorted(least)


def _outline(lane: AbstractLane) -> tuple[Any, float]:
    """Return points of a lane, and a lower limit of highway-env's distance as a share of the distance to them.

    Beyond an end, highway-env measures along the lane, but for a :class:`SineLane` along its axis, which is shorter
    than the line itself. For other classes of lanes no limit is known, and the share is 0.
    """
    share = 0.0
    if type(lane) in (StraightLane, CircularLane):
        share = 1.0
    elif type(lane) is SineLane:
        share = 1.0 / math.hypot(1.0, lane.amplitude * lane.pulsation)
    count = math.ceil(lane.length / OUTLINE_STEP / (share or 1.0)) + 1
    places = np.linspace(0.0, lane.length, max(2, count))
    return np.array([lane.position(float(place), 0) for place in places]), share


def is_regulated(vehicle: Vehicle) -> bool:
    """Return whether highway-env's :class:`RegulatedRoad` may make a vehicle yield."""
    return isinstance(vehicle, ControlledVehicle) and not isinstance(vehicle, MDPVehicle)


class EgosRegulatedRoad(RegulatedRoad):  # type: ignore[misc]
    """The regulated road of highway-env for runs in which only the ego, the first vehicle, may have to yield.

    Pairs of other vehicles are therefore not checked; nor is any pair if the ego does not obey the road's rules.
    """

    vehicles: list[Any]

    def regulate(self, dt: float) -> None:
        """Apply the road's rules as highway-env does in each step before the vehicles move."""
        self.steps += 1
        if self.steps % int(1 / dt / self.REGULATION_FREQUENCY) == 0:
            self.enforce_road_rules()

    def enforce_road_rules(self) -> None:
        """Find the ego's conflicts, and make it yield if it has to."""
        ego, *others = everybody = self.vehicles
        if not is_regulated(ego):
            return
        self.vehicles = [ego]
        super().enforce_road_rules()  # ends its yielding after the set time
        for other in others:
            if self.is_conflict_possible(ego, other) and self.respect_priorities(ego, other) is ego:
                ego.color = self.YIELDING_COLOR
                ego.target_speed = 0
                ego.is_yielding = True
                ego.yield_timer = 0
        self.vehicles = everybody


class Car(Vehicle):  # type: ignore[misc]
    """An NPC as highway-env's code sees it: a view of its body, which the loop moves.

    ``target_speed`` is its current speed. highway-env's IDM uses it as the desired speed of a follower, and an observer
    can know no more about an NPC.
    """

    def __init__(self, road: Road, body: Body) -> None:
        self.body = body
        self.LENGTH, self.WIDTH = body.length, body.width
        self._seen: Any = None
        self._found: Any = None  # the pose at which the lane was found, and the lane's index
        super().__init__(road, (body.x, body.y), body.heading, body.speed)
        self.check_collisions = False

    def __copy__(self) -> Car:
        """Return a view of a body of its own, because an imperfect sight shows NPCs elsewhere."""
        own = Body(self.body.length, self.body.width)
        own.place(self.body.x, self.body.y, self.body.heading, self.body.speed)
        own.acceleration, own.steering = self.body.acceleration, self.body.steering
        copied = Car.__new__(Car)
        copied.__dict__.update(self.__dict__, body=own)
        return copied

    @property
    def position(self) -> Any:
        """The world coordinates [m], as an array made on demand."""
        body, seen = self.body, self._seen
        if seen is None or seen[0] != body.x or seen[1] != body.y:
            self._seen = seen = np.array([body.x, body.y])
        return seen

    @position.setter
    def position(self, value: Any) -> None:
        self.body.x, self.body.y = float(value[0]), float(value[1])

    @property
    def heading(self) -> float:
        """The heading [rad]."""
        return self.body.heading

    @heading.setter
    def heading(self, value: float) -> None:
        self.body.heading = float(value)

    @property
    def speed(self) -> float:
        """The speed [m/s]."""
        return self.body.speed

    @speed.setter
    def speed(self, value: float) -> None:
        self.body.speed = float(value)

    @property
    def lane_index(self) -> tuple[str, str, int]:
        """The index of the closest lane in highway-env, found on demand."""
        pose = self.body.x, self.body.y, self.body.heading
        if self._found is None or self._found[0] != pose:
            self._found = pose, self.road.network.closest(*pose)
        index: tuple[str, str, int] = self._found[1]
        return index

    @lane_index.setter
    def lane_index(self, value: object) -> None:
        """Ignore the lane that highway-env sets, because it follows from the place."""

    @property
    def lane(self) -> StraightLane:
        """The closest lane."""
        return self.road.network.get_lane(self.lane_index)

    @lane.setter
    def lane(self, value: StraightLane) -> None:
        """Ignore the lane that highway-env sets, because it follows from the place."""

    @property
    def target_speed(self) -> float:
        """The current speed [m/s], which highway-env's IDM takes for the vehicle's desired speed."""
        return self.body.speed

    @property
    def action(self) -> dict[str, float]:
        """The controls as a dict, as in highway-env."""
        return {"steering": self.body.steering, "acceleration": self.body.acceleration}

    @action.setter
    def action(self, value: dict[str, float]) -> None:
        self.body.steering, self.body.acceleration = float(value["steering"]), float(value["acceleration"])

    def act(self, action: Any = None) -> None:
        """Hold the current controls, or set the controls in ``action``, which highway-env's predictions pass."""
        if action:
            self.action = action

    def step(self, dt: float) -> None:
        """Do one step of highway-env's kinematic bicycle model [s], as its predictions of copies ask for."""
        self.body.step(dt)


class DirectedVehicle(MDPVehicle):  # type: ignore[misc]
    """The vehicle of highway-env for discrete actions, with the same steering computed in half the time.

    For a single number, ``numpy.clip`` takes longer than all other operations together.
    """

    def steering_control(self, target_lane_index: Any) -> float:
        """Return the steering to the centre of a lane, like :meth:`ControlledVehicle.steering_control` [rad]."""
        lane = self.road.network.get_lane(target_lane_index)
        longitudinal, lateral = lane.local_coordinates(self.position)
        speed = not_zero(self.speed)
        heading = np.arcsin(_clipped(-self.KP_LATERAL * lateral / speed, 1.0))
        wanted = lane.heading_at(longitudinal + self.speed * self.TAU_PURSUIT) + _clipped(heading, np.pi / 4)
        rate = self.KP_HEADING * wrap_to_pi(wanted - self.heading)
        slip = np.arcsin(_clipped(self.LENGTH / 2 / speed * rate, 1.0))
        return float(_clipped(np.arctan(2 * np.tan(slip)), self.MAX_STEERING_ANGLE))


def _clipped(value: Any, bound: float) -> Any:
    return bound if value > bound else -bound if value < -bound else value


def quick(vehicle_class: Any) -> Any:
    """Return a faster class with the same behaviour as a class of ego vehicles, or the given class if none is known."""
    if isinstance(vehicle_class, functools.partial) and vehicle_class.func is MDPVehicle:
        return functools.partial(DirectedVehicle, *vehicle_class.args, **vehicle_class.keywords)
    return vehicle_class


def straight_network(lanes: int, length: float, lane_width: float, speed_limit: float) -> RoadNetwork:
    """Make a highway-env network of parallel straight lanes between the nodes "0" and "1"; sizes are in metres."""
    network = RoadNetwork()
    stock = RoadNetwork.straight_road_network(lanes, length=length, speed_limit=speed_limit)
    for index, lane in enumerate(stock.lanes_list()):
        y, types = index * lane_width, lane.line_types
        own = StraightLane([0.0, y], [length, y], width=lane_width, line_types=types, speed_limit=speed_limit)
        network.add_lane("0", "1", own)
    return network


def straight_road(network: RoadNetwork) -> StraightRoad | None:
    """Return the road of a network if it is one straight road along the x axis, else None."""
    lanes = network.lanes_list()
    segments = [(start, end) for start, ends in network.graph.items() for end in ends]
    values = tuple(
        Lane(
            x=float(lane.start[0]),
            y=float(lane.start[1]),
            heading=float(lane.heading),
            length=float(lane.length),
            width=float(lane.width),
            speed_limit=float(lane.speed_limit),
        )
        for lane in lanes
        if type(lane) is StraightLane and lane.speed_limit is not None
    )
    if len(segments) != 1 or len(values) != len(lanes):
        return None
    first = values[0]
    is_parallel = all(
        lane.heading == 0.0
        and (lane.x, lane.length, lane.width) == (first.x, first.length, first.width)
        and math.isclose(lane.y, first.y + k * first.width)
        for k, lane in enumerate(values)
    )
    return StraightRoad(values) if is_parallel else None
