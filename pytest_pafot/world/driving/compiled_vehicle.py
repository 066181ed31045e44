"""Vehicles and road networks of highway-env as compiled ones."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.objects import Landmark

from pytest_pafot.world.driving.idm_model import CONSTANTS, idm_model
from pytest_pafot.world.driving.vehicles import EgosRegulatedRoad
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.idm import GoalVehicle
from pytest_pafot.world.kernel.lane_network import Network
from pytest_pafot.world.kernel.network_vehicle import NetworkVehicle, StaticObstacle
from pytest_pafot.world.kernel.places import Places
from pytest_pafot.world.kernel.road_rules import RoadRules
from pytest_pafot.world.kernel.traffic import TrafficVehicle
from pytest_pafot.world.roads.network import NetworkRoad
from pytest_pafot.world.roads.straight import StraightRoad
from pytest_pafot.world.run_config import Rules
from pytest_pafot.world.stock import ControlledVehicle


def constants_of(vehicle: Any) -> dict[str, float]:
    """Return the constants of a vehicle of highway-env, or of its IDM if the vehicle lacks one."""
    return {name: getattr(vehicle, name, getattr(IDMVehicle, name)) for name in CONSTANTS}


def compiled_vehicle(vehicle: Any, road: StraightRoad) -> TrafficVehicle:
    """Return a compiled vehicle of ordinary traffic, in road coordinates, in the state of a highway-env vehicle."""
    body = TrafficVehicle(
        constants_of(vehicle),
        road.grid,
        road.speed_limit,
        has_goal=isinstance(vehicle, ControlledVehicle),
        drives_itself=idm_model(type(vehicle)) is not None,
        # highway-env's IDM treats a vehicle without a target speed as one that wants to stand still.
        taken_for=math.nan if hasattr(vehicle, "target_speed") else 0.0,
    )
    pose = road.project(float(vehicle.position[0]), float(vehicle.position[1]), float(vehicle.heading))
    body.start(*pose, float(vehicle.speed), bool(getattr(vehicle, "enable_lane_change", True)))
    goal = getattr(vehicle, "target_lane_index", vehicle.lane_index)[2]
    body.begin(goal, float(getattr(vehicle, "target_speed", 0.0)), float(getattr(vehicle, "timer", 0.0)))
    body.checks = bool(vehicle.check_collisions)
    return body


def goal_vehicle(vehicle: Any, lanes: StraightRoad | Network) -> GoalVehicle:
    """Return a compiled vehicle with a goal, at the start of a vehicle of highway-env.

    At the end of a lane of a network, it asks highway-env's network for the next lane, which shortens the vehicle's
    route. A straight road must start at the world's origin.
    """
    road, indexes = vehicle.road, list(vehicle.road.network.lanes_dict())
    numbers = {index: number for number, index in enumerate(indexes)}

    def routed() -> int:
        route = getattr(vehicle, "route", None)
        return -1 if not route or route[0][2] is None else int(route[0][2])

    def following(lane: int, x: float, y: float) -> tuple[int, int]:
        here, route = np.array([x, y]), getattr(vehicle, "route", None)
        after = road.network.next_lane(indexes[lane], route=route, position=here, np_random=road.np_random)
        return numbers[after[0], after[1], int(after[2])], routed()

    body: GoalVehicle
    if isinstance(lanes, Network):
        body = NetworkVehicle(constants_of(vehicle), lanes, following, routed(), _searched(road, numbers))
    else:
        body = GoalVehicle(constants_of(vehicle), lanes.grid, lanes.speed_limit)
    x, y = map(float, vehicle.position)
    body.start(x, y, float(vehicle.heading), float(vehicle.speed), bool(getattr(vehicle, "enable_lane_change", True)))
    if isinstance(vehicle, ControlledVehicle):
        body.aim(numbers[vehicle.target_lane_index], float(vehicle.target_speed))
    return body


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


def rules_for(ego: Any, model: GoalVehicle, places: Places, rules: Rules, network: Any) -> RoadRules | None:
    """Return the rules of a regulated road for an ego of highway-env, which ``model`` drives; None on other roads."""
    road, way = ego.road, rules.road
    if not (isinstance(road, EgosRegulatedRoad) and isinstance(model, NetworkVehicle) and isinstance(way, NetworkRoad)):
        return None
    lanes = road.network.lanes_dict()
    indexes, numbers = list(lanes), {index: number for number, index in enumerate(lanes)}

    def route(lane: int) -> list[int]:
        """Return the lanes of the ego's route; where the route leaves the lane open, the ego keeps its number."""
        origin, end, own = indexes[lane]
        kept = own if own < len(road.network.graph[origin][end]) else 0
        steps = ego.route or [indexes[lane]]
        return [numbers[a, b, kept if number is None else int(number)] for a, b, number in steps]

    frequency = road.REGULATION_FREQUENCY
    return RoadRules(
        model,
        places,
        way.bends,
        network,
        priorities=[int(each.priority) for each in lanes.values()],
        route=route,
        steps=road.steps,
        every=int(1 / (1 / rules.physics_hz) / frequency),  # as highway-env rounds it
        lasts=road.YIELD_DURATION * frequency,
    )


def obstacles_on(road: Any) -> list[Body]:
    """Return the objects on a road of highway-env behind which its vehicles brake."""
    bodies: list[Body] = []
    for each in road.objects:
        if not isinstance(each, Landmark):
            bodies.append(StaticObstacle(float(each.LENGTH), float(each.WIDTH)))
            x, y = map(float, each.position)
            bodies[-1].place(x, y, float(each.heading), float(each.speed))
    return bodies
