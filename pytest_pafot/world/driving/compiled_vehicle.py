"""Vehicles and road networks of highway-env as compiled ones."""

from __future__ import annotations

from typing import Any

import numpy as np
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.objects import Landmark

from pytest_pafot.world.driving.idm_model import CONSTANTS, idm_model
from pytest_pafot.world.driving.vehicles import EgosRegulatedRoad
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.idm import EgosRoadRules, GoalVehicle, NetworkVehicle, StaticObstacle
from pytest_pafot.world.kernel.lane_network import Network
from pytest_pafot.world.kernel.places import Places
from pytest_pafot.world.roads.network import NetworkRoad
from pytest_pafot.world.roads.road import StraightRoad
from pytest_pafot.world.run_config import Rules
from pytest_pafot.world.stock import ControlledVehicle, RegulatedRoad


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
        body.stay(self._numbers[vehicle.lane_index])
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
            body.aim(self._numbers[vehicle.target_lane_index], float(vehicle.target_speed))
        body.acceleration, body.steering = float(vehicle.action["acceleration"]), float(vehicle.action["steering"])

    def show(self, vehicle: Any, body: GoalVehicle) -> None:
        """Copy the state of a compiled vehicle to a vehicle of highway-env."""
        x, y, vehicle.heading, vehicle.speed, lane, goal, wanted, timer = body.seen()
        vehicle.position = np.array([x + self._x, y + self._y])
        vehicle.action = {"steering": body.steering, "acceleration": body.acceleration}
        vehicle.lane_index, vehicle.lane = self._named[lane]
        if body.has_goal:
            vehicle.target_lane_index, vehicle.target_speed = self._named[goal][0], wanted
        if body.drives_itself:
            vehicle.timer = timer
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
