"""Faster versions of highway-env's road networks and vehicles, and the NPCs as vehicles of highway-env."""

from __future__ import annotations

import inspect
import math
import types
from collections.abc import Mapping
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np

from pytest_pafot.model.trace import Lane
from pytest_pafot.world.driving.policy import CONSTANTS, idm_model
from pytest_pafot.world.kernel.crossing import CrossingNpc
from pytest_pafot.world.kernel.director import Npc
from pytest_pafot.world.kernel.idm import EgosRoadRules, GoalVehicle, NetworkVehicle, StaticObstacle
from pytest_pafot.world.kernel.lane_network import Network
from pytest_pafot.world.kernel.lanes import Body, Places
from pytest_pafot.world.roads.network import STEP, NetworkRoad
from pytest_pafot.world.roads.road import Road as RoadOfGrid
from pytest_pafot.world.roads.road import StraightRoad
from pytest_pafot.world.stock import (
    CircularLane,
    ControlledVehicle,
    IDMVehicle,
    Landmark,
    MDPVehicle,
    RegulatedRoad,
    RoadNetwork,
    SineLane,
    StraightLane,
    Vehicle,
    class_from_path,
    not_zero,
)

KINDS = (StraightLane, SineLane, CircularLane)  # in the order of the kinds of a Network


def compiled_network(network: Any) -> Network | None:
    """Convert a highway-env road network for the kernel, or return None if it has custom lanes."""
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
            wave: tuple[float, ...] = ()
            if type(lane) is SineLane:
                wave = (lane.amplitude, lane.pulsation, lane.phase)
            shape = *lane.start, *lane.direction, lane.heading, *wave
        shapes += (*shape, *([0.0] * (9 - len(shape))))  # padded with zeros, see Network
    sections = {
        section: number
        for number, section in enumerate(dict.fromkeys(index[:2] for index in lanes))
    }
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
    """A road network with a compiled lane search, unless it has custom lanes."""

    def __init__(self, network: RoadNetwork) -> None:
        super().__init__()
        self.graph = network.graph
        self._indexes = list(network.lanes_dict())
        self._compiled = compiled_network(network)

    def get_closest_lane_index(
        self, position: Any, heading: float | None = None
    ) -> tuple[str, str, int]:
        index: tuple[str, str, int]
        x = float(position[0])
        y = float(position[1])
        if self._compiled is None or heading is None or not (math.isfinite(x) and math.isfinite(y)):
            index = super().get_closest_lane_index(position, heading)
        else:
            index = self._indexes[self._compiled.closest(x, y, heading)]
        return index


def is_regulated(vehicle: Vehicle) -> bool:
    """Return whether highway-env's :class:`RegulatedRoad` can make a vehicle yield."""
    return isinstance(vehicle, ControlledVehicle) and not isinstance(vehicle, MDPVehicle)


class EgosRegulatedRoad(RegulatedRoad):  # type: ignore[misc]
    """A regulated road of highway-env on which only the first vehicle, the ego, yields."""

    vehicles: list[Any]

    def regulate(self, dt: float) -> None:
        self.steps += 1
        if self.steps % int(1 / dt / self.REGULATION_FREQUENCY) == 0:
            self.enforce_road_rules()

    def enforce_road_rules(self) -> None:
        ego, *others = everybody = self.vehicles
        if not is_regulated(ego):
            return
        self.vehicles = [ego]
        super().enforce_road_rules()  # ends the ego's yielding after the set time
        for other in others:  # pairs of other vehicles need no check, because only the ego yields
            if self.is_conflict_possible(ego, other) and self.respect_priorities(ego, other) is ego:
                ego.color = self.YIELDING_COLOR
                ego.target_speed = 0
                ego.is_yielding = True
                ego.yield_timer = 0
        self.vehicles = everybody


class StockVehicle(Vehicle):  # type: ignore[misc]
    """A vehicle with highway-env's physics, lane search and shape, but without goals."""

    @property
    # highway-env's IDM uses this as the desired speed of a follower. An observer cannot know more about an NPC.
    def target_speed(self) -> float:
        return float(self.speed)

    @target_speed.setter
    def target_speed(self, speed: float) -> None:
        """Ignore the desired speed that an environment's code sets."""

    def control(self, acceleration: float, steering: float) -> None:
        super().act({"steering": steering, "acceleration": acceleration})


# the attributes that a run sets in vehicles of an environment's traffic class
STATE = (
    "position",
    "heading",
    "speed",
    "action",
    "lane",
    "lane_index",
    "target_lane_index",
    "target_speed",
)


def _copied(held: Any, protocol: Any) -> Any:
    # A planner that simulates copies held vehicles. The copies must move, so they get the class without HELD.
    kind = type(held)
    seen = type(held).__base__
    made: Any = object.__reduce_ex__(held, protocol)
    make, given, *others = made
    return (
        (seen if make is kind else make),
        tuple([seen if each is kind else each for each in given]),
        *others,
    )


# with these members, an environment's code can read and copy a vehicle, but not move it
HELD: Mapping[str, Any] = MappingProxyType(
    {
        "speed": property(lambda self: vars(self)["speed"], lambda self, _: None),
        "heading": property(lambda self: vars(self)["heading"], lambda self, _: None),
        "position": property(lambda self: vars(self)["position"].copy(), lambda self, _: None),
        "__reduce_ex__": _copied,
    }
)
# with these members, a vehicle of any class keeps its controls, and does not check for contacts
MOVED: Mapping[str, Any] = MappingProxyType(
    {
        **{
            name: vars(Vehicle)[name] for name in ("act", "step", "clip_actions", "on_state_update")
        },
        "handle_collisions": Vehicle.handle_collisions,
        # Properties, because the vehicle itself may have these attributes.
        "MAX_SPEED": property(lambda self: Vehicle.MAX_SPEED),
        "MIN_SPEED": property(lambda self: Vehicle.MIN_SPEED),
        "check_collisions": property(lambda self: False, lambda self, _: None),
    }
)


class TrafficClass:
    """The traffic class of an environment, which the environment's code sees as the class of the NPCs."""

    def __init__(self, seen: Any, constants: Mapping[str, Any] = MappingProxyType({})) -> None:
        self.seen = seen
        self.constants = constants
        self.is_controlled = issubclass(seen, ControlledVehicle)

    @cached_property
    def held(self) -> Any:
        """The class of the vehicles during a reset, derived from the traffic class."""
        return self._with(HELD)

    @cached_property
    def moved(self) -> Any:
        """The class of the vehicles during a step of the road, derived from the traffic class."""
        return self._with(MOVED)

    def __reduce__(self) -> Any:
        return TrafficClass, (self.seen, dict(self.constants))

    def _with(self, own: Mapping[str, Any]) -> Any:
        body = {"__slots__": (), "__module__": self.seen.__module__, **own}
        return types.new_class(
            self.seen.__name__,
            (self.seen,),
            exec_body=lambda names: names.update(body),
        )


def traffic_class(given: Any, road: Any, changed: Mapping[Any, Mapping[str, Any]]) -> TrafficClass:
    """Return the class that ``config["other_vehicles_type"]`` names, after a test with one of its vehicles on a road.

    ``changed`` contains the constants that the environment has set, by class.

    Raises:
        Exception: if the class does not exist, or if its vehicles cannot be put at the NPCs' positions.
    """
    seen: Any = given if isinstance(given, type) else class_from_path(given)
    if not (isinstance(seen, type) and issubclass(seen, Vehicle)):
        raise TypeError(f"{given!r:.100} is not a class derived from highway-env's Vehicle")
    given_by_class = {name: inspect.getattr_static(seen, name, None) for name in STATE}
    own = [name for name, each in given_by_class.items() if inspect.isdatadescriptor(each)]
    if own:
        raise TypeError(
            f"{seen.__name__} itself computes {', '.join(own)}, which the run has to set"
        )
    ego = road.vehicles[0]
    pose = np.array(ego.position), float(ego.heading), float(ego.speed)
    # The class must accept the attributes that a run sets, and its vehicles must be able to change to derived classes.
    made = seen(road, *pose)
    plain = next(
        each for each in (IDMVehicle, ControlledVehicle, Vehicle) if issubclass(seen, each)
    )(road, *pose)
    if lacking := [name for name in vars(plain) if not hasattr(made, name)]:
        raise TypeError(f"{seen.__name__}.__init__ does not set {', '.join(lacking)}")
    for name in vars(plain).keys() & STATE:
        setattr(made, name, getattr(made, name))
    # base classes come first, so that derived classes override their constants
    constants = dict[str, Any]()
    for each in reversed(seen.__mro__):
        constants = {name: value for name, value in constants.items() if name not in vars(each)}
        constants |= changed.get(each, {})
    traffic = TrafficClass(seen, constants)
    for each in (traffic.held, traffic.moved, seen):
        made.__class__ = each
    return traffic


class Traffic:
    """The NPCs of a run as an environment's code sees them, as vehicles of the environment's traffic class."""

    def __init__(
        self,
        traffic: TrafficClass,
        stock_road: Any,
        ego: Any,
        places: Places,
        road: RoadOfGrid,
    ) -> None:
        self.vehicles: list[Any] = []
        self._network = stock_road.network
        self._road = road
        self._bodies = places.vehicles[1:]
        self._npcs = places.bodies[1:]
        self._is_controlled = traffic.is_controlled
        stock_road.vehicles = [ego]
        # NPCs have routes if the environment plans a route for its ego, or if its road is regulated.
        route = getattr(ego, "route", None)
        is_regulated = isinstance(stock_road, RegulatedRoad)
        for body, npc in zip(self._bodies, self._npcs, strict=True):
            made = traffic.seen(stock_road, np.array([body.x, body.y]), body.heading, body.speed)
            vars(made).update(traffic.constants, LENGTH=body.length, WIDTH=body.width)
            made.diagonal = np.hypot(body.length, body.width)
            # a StockVehicle must not react to contacts
            made.check_collisions = traffic.seen is not StockVehicle
            self.vehicles.append(made)
            # one by one, because a class may look for other vehicles
            stock_road.vehicles.append(made)
            if self._is_controlled and isinstance(npc, CrossingNpc) and (route or is_regulated):
                *end, heading = npc.track.pose((len(npc.track.parts) - 1) * STEP)
                made.plan_route_to(self._network.get_closest_lane_index(np.array(end), heading)[1])
            elif self._is_controlled and route:
                made.plan_route_to(route[-1][1])
        self.show()

    def show(self, *, is_lean: bool = False) -> None:
        """Move the vehicles to the NPCs' positions and, unless ``is_lean``, update their lanes and targets."""
        for each, body in zip(self.vehicles, self._bodies, strict=True):
            each.position = np.array([body.x, body.y])
            each.heading = body.heading
            each.speed = body.speed
            each.action = {"steering": body.steering, "acceleration": body.acceleration}
            if not is_lean:
                each.lane_index = self._network.get_closest_lane_index(each.position, each.heading)
                each.lane = self._network.get_lane(each.lane_index)
        if not is_lean:
            self.show_targets()

    def show_targets(self) -> None:
        """Copy the NPCs' targets to the vehicles. The lanes of the vehicles must be up to date."""
        if not self._is_controlled:
            return
        for each, npc in zip(self.vehicles, self._npcs, strict=True):
            lane = each.lane_index
            each.target_lane_index = each.lane_index
            # The target speed is never exactly 0, because environments such as merge-v0 divide by it.
            each.target_speed = float(not_zero(_target_speed(npc)))
            if isinstance(npc, Npc) and npc.executed and npc.heading_for != npc.lane:
                x, y, heading = self._road.position(npc.x, npc.heading_for)
                each.target_lane_index = self._network.get_closest_lane_index(
                    np.array([x, y]), heading
                )
            passed = [step[:2] for step in each.route or ()]
            if lane[:2] in passed:
                each.route = each.route[passed.index(lane[:2]) :]


def _target_speed(npc: Any) -> float:
    if isinstance(npc, CrossingNpc):
        return float(npc.wanted)
    if not npc.executed:
        return float(npc.chain[0].speed)
    if npc.kept_lane < 0 and npc.shift_lane < 0:
        return float(npc.target_speed)
    return float(npc.kept_speed)


def straight_network(
    lanes: int, length: float, lane_width: float, speed_limit: float
) -> RoadNetwork:
    """Create a highway-env network of parallel straight lanes between the nodes "0" and "1", with sizes in metres."""
    network = RoadNetwork()
    stock = RoadNetwork.straight_road_network(lanes, length=length, speed_limit=speed_limit)
    for index, lane in enumerate(stock.lanes_list()):
        y = index * lane_width
        types = lane.line_types
        own = StraightLane(
            [0.0, y],
            [length, y],
            width=lane_width,
            line_types=types,
            speed_limit=speed_limit,
        )
        network.add_lane("0", "1", own)
    return network


def straight_road(network: RoadNetwork) -> StraightRoad | None:
    """Convert a network to a straight road, or return None if it is not one straight road along the x axis."""
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
    if is_parallel:
        return StraightRoad(values)
    return None


def constants_of(vehicle: Any) -> dict[str, float]:
    """Return the constants of a highway-env vehicle, with the values of ``IDMVehicle`` for missing constants."""
    return {name: getattr(vehicle, name, getattr(IDMVehicle, name)) for name in CONSTANTS}


class CompiledRoad:
    """The compiled form of a highway-env road, which copies states between highway-env vehicles and compiled vehicles.

    Compiled vehicles have road coordinates on a straight road, and world coordinates on other roads.
    """

    def __init__(self, road: Any, lanes: StraightRoad | Network) -> None:
        self._road = road
        self._lanes = lanes
        self._named = list(road.network.lanes_dict().items())
        self._numbers = {index: number for number, (index, _) in enumerate(self._named)}
        self._x, self._y, _ = (
            lanes.position(0.0, 0) if isinstance(lanes, StraightRoad) else (0.0, 0.0, 0.0)
        )
        self._searched = _searched(road, self._numbers)
        self._is_regulated = isinstance(road, RegulatedRoad)

    def vehicle(self, vehicle: Any) -> GoalVehicle:
        """Return a compiled vehicle with the state of a highway-env vehicle."""
        network = self._road.network
        numbers = self._numbers

        def routed() -> int:
            route = getattr(vehicle, "route", None)
            if not route or route[0][2] is None:
                return -1
            return int(route[0][2])

        # highway-env's network shortens the vehicle's route in this call
        def following(lane: int, x: float, y: float) -> tuple[int, int]:
            here = np.array([x, y])
            route = getattr(vehicle, "route", None)
            random = self._road.np_random
            after = network.next_lane(
                self._named[lane][0],
                route=route,
                position=here,
                np_random=random,
            )
            return numbers[after], routed()

        def route(lane: int) -> list[int]:
            here = self._named[lane][0]
            return [
                numbers[a, b, here[2] if number is None else number]
                for a, b, number in vehicle.route or [here]
            ]

        body: GoalVehicle
        if isinstance(self._lanes, Network):
            body = NetworkVehicle(
                constants_of(vehicle),
                self._lanes,
                following,
                routed(),
                route,
                self._searched,
            )
        else:
            body = GoalVehicle(constants_of(vehicle), self._lanes.grid, self._lanes.speed_limit)
        body.has_goal = isinstance(vehicle, ControlledVehicle)
        body.drives_itself = idm_model(type(vehicle)) is not None
        body.waited = -1
        if getattr(vehicle, "is_yielding", False):
            body.waited = vehicle.yield_timer
        # sets default values; the lane and the timer of the vehicle replace them below
        body.start(*self.state(vehicle), bool(getattr(vehicle, "enable_lane_change", True)))
        body.closest = self._numbers[vehicle.lane_index]
        body.timer = float(getattr(vehicle, "timer", body.timer))
        self.take(vehicle, body)
        return body

    def state(self, vehicle: Any) -> tuple[float, float, float, float]:
        """Return x [m], y [m], heading [rad] and speed [m/s] of a highway-env vehicle, in the compiled coordinates."""
        x, y, heading, speed = state_of(vehicle)
        return x - self._x, y - self._y, heading, speed

    def take(self, vehicle: Any, body: GoalVehicle) -> None:
        """Copy the goal and the controls of a highway-env vehicle to a compiled vehicle."""
        if body.has_goal:
            body.goal = self._numbers[vehicle.target_lane_index]
            body.target_speed = float(vehicle.target_speed)
        body.acceleration = float(vehicle.action["acceleration"])
        body.steering = float(vehicle.action["steering"])

    def show(self, vehicle: Any, body: GoalVehicle) -> None:
        """Copy the state of a compiled vehicle to a highway-env vehicle."""
        vehicle.position = np.array([body.x + self._x, body.y + self._y])
        vehicle.heading = body.heading
        vehicle.speed = body.speed
        vehicle.action = {"steering": body.steering, "acceleration": body.acceleration}
        vehicle.lane_index, vehicle.lane = self._named[body.closest]
        if body.has_goal:
            vehicle.target_lane_index = self._named[body.goal][0]
            vehicle.target_speed = body.target_speed
        if body.drives_itself:
            vehicle.timer = body.timer
            if self._is_regulated:
                vehicle.is_yielding = body.waited >= 0
            if self._is_regulated and vehicle.is_yielding:
                vehicle.yield_timer = body.waited
                vehicle.color = RegulatedRoad.YIELDING_COLOR


def _searched(road: Any, numbers: dict[Any, int]) -> list[list[tuple[int, float]]]:
    """Return, for each lane, the lanes in which highway-env's IDM looks for vehicles, and their starts [m]."""
    lanes = road.network.lanes_dict()
    graph = road.network.graph
    searched = [[(number, 0.0)] for number in numbers.values()]
    for (origin, end, lane), number in (
        numbers.items() if road.neighbour_vehicles_connected_lanes else ()
    ):
        after = [(end, node) for node in graph.get(end, {})]
        before = [(node, origin) for node, ends in graph.items() if origin in ends]
        # the lanes that follow and the lanes that lead here, if IDM looks there
        for section in (*after, *before):
            count = len(graph[section[0]][section[1]])
            index = (*section, lane if lane < count else 0)
            begins = lanes[origin, end, lane].length if section in after else -lanes[index].length
            searched[number].append((numbers[index], float(begins)))
    return searched


def egos_rules(
    road: Any,
    model: GoalVehicle,
    places: Places,
    way: RoadOfGrid,
    physics_hz: float,
    network: Any,
) -> EgosRoadRules | None:
    """Return a regulated road's rules for an ego driven by ``model``, or None for other roads."""
    is_regulated = type(road) in (RegulatedRoad, EgosRegulatedRoad)
    if not (is_regulated and isinstance(model, NetworkVehicle) and isinstance(way, NetworkRoad)):
        return None
    frequency = road.REGULATION_FREQUENCY
    priorities = [int(each.priority) for each in road.network.lanes_list()]
    every = int(1 / (1 / physics_hz) / frequency)  # as highway-env rounds it
    regulation = priorities, road.steps, every, road.YIELD_DURATION * frequency
    return EgosRoadRules(model, places, way.bends, network, *regulation)


def obstacles_on(road: Any) -> list[Body]:
    """Return the objects on a highway-env road for which vehicles brake."""
    bodies: list[Body] = []
    for each in road.objects:
        if not isinstance(each, Landmark):
            body = StaticObstacle(float(each.LENGTH), float(each.WIDTH))
            body.place(*state_of(each))
            bodies.append(body)
    return bodies


def state_of(vehicle: Any) -> tuple[float, float, float, float]:
    """Return x [m], y [m], heading [rad] and speed [m/s] of a highway-env vehicle or object."""
    x, y = vehicle.position
    return float(x), float(y), float(vehicle.heading), float(vehicle.speed)
