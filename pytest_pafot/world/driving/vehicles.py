"""highway-env's road networks and vehicles as its own code sees them in a run, with the same results but faster."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.objects import Landmark

from pytest_pafot.model.trace import Lane
from pytest_pafot.world.driving.policy import CONSTANTS, idm_model
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.idm import EgosRoadRules, GoalVehicle, NetworkVehicle, StaticObstacle
from pytest_pafot.world.kernel.lane_network import Network
from pytest_pafot.world.kernel.places import Places
from pytest_pafot.world.roads.network import NetworkRoad
from pytest_pafot.world.roads.road import StraightRoad
from pytest_pafot.world.run_config import Rules
from pytest_pafot.world.stock import (
    CircularLane,
    ControlledVehicle,
    MDPVehicle,
    RegulatedRoad,
    Road,
    RoadNetwork,
    SineLane,
    StraightLane,
    Vehicle,
)

KINDS = (StraightLane, SineLane, CircularLane)
"""The classes of lanes in the order of the kinds of a :class:`Network`."""


def compiled_network(network: Any) -> Network | None:
    """Return a road network of highway-env in plain numbers; None if it has lanes of other classes."""
    lanes = network.lanes_dict()
    kinds = list[int]()
    shapes = list[Any]()
    for lane in lanes.values():
        if type(lane) not in KINDS or lane.speed_limit is None:
            return None
        kinds.append(KINDS.index(type(lane)))
        if type(lane) is CircularLane:
            shape = *lane.center, lane.radius, lane.start_phase, lane.direction
        else:
            wave = (lane.amplitude, lane.pulsation, lane.phase) if type(lane) is SineLane else ()
            shape = *lane.start, *lane.direction, lane.heading, *wave
        shapes += (*shape, *([0.0] * (9 - len(shape))))
    sections = {section: number for number, section in enumerate(dict.fromkeys(index[:2] for index in lanes))}
    return Network(
        kinds,
        [float(each) for each in shapes],
        [float(lane.length) for lane in lanes.values()],
        [float(lane.width) for lane in lanes.values()],
        [float(lane.speed_limit) for lane in lanes.values()],
        [sections[index[:2]] for index in lanes],
        [index[2] for index in lanes],
        [int(bool(lane.forbidden)) for lane in lanes.values()],
    )


class SearchedLanes(RoadNetwork):  # type: ignore[misc]
    """A road network whose lane search is compiled if its lanes are of highway-env's own classes."""

    def __init__(self, network: RoadNetwork) -> None:
        super().__init__()
        self.graph = network.graph
        self._indexes = list(network.lanes_dict())
        self._compiled = compiled_network(network)

    def get_closest_lane_index(self, position: Any, heading: float | None = None) -> tuple[str, str, int]:
        """Return the index of the lane with the smallest sum of distance and angle, as highway-env does."""
        index: tuple[str, str, int]
        x, y = float(position[0]), float(position[1])
        if self._compiled is None or heading is None or not (math.isfinite(x) and math.isfinite(y)):
            index = super().get_closest_lane_index(position, heading)
        else:
            index = self._indexes[self._compiled.closest(x, y, heading)]
        return index


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
            self._found = pose, self.road.network.get_closest_lane_index(self.position, pose[2])
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


def constants_of(vehicle: Any) -> dict[str, float]:
    """Return the constants of a vehicle of highway-env, or of its IDM if the vehicle lacks one."""
    return {name: getattr(vehicle, name, getattr(IDMVehicle, name)) for name in CONSTANTS}


class CompiledRoad:
    """A road of highway-env and its lanes in compiled code, which copies vehicles from one to the other.

    Compiled vehicles are in road coordinates on a straight road, and otherwise in world coordinates.
    """

    def __init__(self, road: Any, lanes: StraightRoad | Network) -> None:
        self._road = road
        self._lanes = lanes
        self._named = list(road.network.lanes_dict().items())
        self._numbers = {index: number for number, (index, _) in enumerate(self._named)}
        self._x, self._y, _ = lanes.position(0.0, 0) if isinstance(lanes, StraightRoad) else (0.0, 0.0, 0.0)
        self._searched = _searched(road, self._numbers)
        self._is_regulated = isinstance(road, RegulatedRoad)

    def vehicle(self, vehicle: Any) -> GoalVehicle:
        """Return a compiled vehicle in the state of a vehicle of highway-env.

        At the end of a lane of a network, it asks highway-env's network for the next lane, which shortens the vehicle's
        route.
        """
        network, numbers = self._road.network, self._numbers

        def routed() -> int:
            route = getattr(vehicle, "route", None)
            return -1 if not route or route[0][2] is None else int(route[0][2])

        def following(lane: int, x: float, y: float) -> tuple[int, int]:
            here, route, random = np.array([x, y]), getattr(vehicle, "route", None), self._road.np_random
            after = network.next_lane(self._named[lane][0], route=route, position=here, np_random=random)
            return numbers[after], routed()

        def route(lane: int) -> list[int]:
            """Return the lanes of the route; where the route leaves the lane open, the vehicle keeps its number."""
            here = self._named[lane][0]
            return [numbers[a, b, here[2] if number is None else number] for a, b, number in vehicle.route or [here]]

        body: GoalVehicle
        if isinstance(self._lanes, Network):
            body = NetworkVehicle(constants_of(vehicle), self._lanes, following, routed(), route, self._searched)
        else:
            body = GoalVehicle(constants_of(vehicle), self._lanes.grid, self._lanes.speed_limit)
        body.has_goal = isinstance(vehicle, ControlledVehicle)
        body.drives_itself = idm_model(type(vehicle)) is not None
        body.waited = vehicle.yield_timer if getattr(vehicle, "is_yielding", False) else -1
        body.start(*self.state(vehicle), bool(getattr(vehicle, "enable_lane_change", True)))
        body.closest = self._numbers[vehicle.lane_index]
        body.timer = float(getattr(vehicle, "timer", body.timer))
        self.take(vehicle, body)
        return body

    def state(self, vehicle: Any) -> tuple[float, float, float, float]:
        """Return x [m], y [m], heading [rad] and speed [m/s] of a vehicle of highway-env for a compiled one."""
        x, y = vehicle.position
        return float(x) - self._x, float(y) - self._y, float(vehicle.heading), float(vehicle.speed)

    def take(self, vehicle: Any, body: GoalVehicle) -> None:
        """Copy the goal of a vehicle of highway-env, and its controls, which a goal may replace."""
        if body.has_goal:
            body.goal, body.target_speed = self._numbers[vehicle.target_lane_index], float(vehicle.target_speed)
        body.acceleration, body.steering = float(vehicle.action["acceleration"]), float(vehicle.action["steering"])

    def show(self, vehicle: Any, body: GoalVehicle) -> None:
        """Copy the state of a compiled vehicle to a vehicle of highway-env."""
        vehicle.position = np.array([body.x + self._x, body.y + self._y])
        vehicle.heading, vehicle.speed = body.heading, body.speed
        vehicle.action = {"steering": body.steering, "acceleration": body.acceleration}
        vehicle.lane_index, vehicle.lane = self._named[body.closest]
        if body.has_goal:
            vehicle.target_lane_index, vehicle.target_speed = self._named[body.goal][0], body.target_speed
        if body.drives_itself:
            vehicle.timer = body.timer
            if self._is_regulated:
                vehicle.is_yielding = body.waited >= 0
            if self._is_regulated and vehicle.is_yielding:
                vehicle.yield_timer, vehicle.color = body.waited, RegulatedRoad.YIELDING_COLOR


def _searched(road: Any, numbers: dict[Any, int]) -> list[list[tuple[int, float]]]:
    """Return, for each lane, the lanes in which highway-env's IDM looks for vehicles, and where each begins [m].

    These are the lane itself and, if the road asks for it, the lanes that follow it and those that lead to it.
    """
    lanes, graph = road.network.lanes_dict(), road.network.graph
    searched = [[(number, 0.0)] for number in numbers.values()]
    for (origin, end, lane), number in numbers.items() if road.neighbour_vehicles_connected_lanes else ():
        after = [(end, node) for node in graph.get(end, {})]
        before = [(node, origin) for node, ends in graph.items() if origin in ends]
        for section in (*after, *before):
            count = len(graph[section[0]][section[1]])
            index = (*section, lane if lane < count else 0)
            begins = lanes[origin, end, lane].length if section in after else -lanes[index].length
            searched[number].append((numbers[index], float(begins)))
    return searched


def egos_rules(road: Any, model: GoalVehicle, places: Places, rules: Rules, network: Any) -> EgosRoadRules | None:
    """Return the rules of a regulated road of highway-env for a vehicle that ``model`` drives; None on other roads.

    The vehicle is the ego.
    """
    way, is_regulated = rules.road, type(road) in (RegulatedRoad, EgosRegulatedRoad)
    if not (is_regulated and isinstance(model, NetworkVehicle) and isinstance(way, NetworkRoad)):
        return None
    frequency = road.REGULATION_FREQUENCY
    priorities = [int(each.priority) for each in road.network.lanes_list()]
    every = int(1 / (1 / rules.physics_hz) / frequency)  # as highway-env rounds it
    regulation = priorities, road.steps, every, road.YIELD_DURATION * frequency
    return EgosRoadRules(model, places, way.bends, network, *regulation)


def obstacles_on(road: Any) -> list[Body]:
    """Return the objects on a road of highway-env behind which its vehicles brake."""
    bodies: list[Body] = []
    for each in road.objects:
        if not isinstance(each, Landmark):
            bodies.append(StaticObstacle(float(each.LENGTH), float(each.WIDTH)))
            x, y = map(float, each.position)
            bodies[-1].place(x, y, float(each.heading), float(each.speed))
    return bodies
