"""Vehicles of highway-env's own classes as compiled vehicles."""

from __future__ import annotations

import math
from typing import Any

from highway_env.vehicle.behavior import IDMVehicle

from pytest_pafot.world.driving.idm_model import CONSTANTS, idm_model
from pytest_pafot.world.kernel.traffic import TrafficVehicle
from pytest_pafot.world.roads.straight import StraightRoad
from pytest_pafot.world.stock import ControlledVehicle


def compiled_vehicle(vehicle: Any, road: StraightRoad) -> TrafficVehicle:
    """Return a compiled vehicle, in road coordinates, with the state of a vehicle of highway-env."""
    constants = {name: getattr(vehicle, name, getattr(IDMVehicle, name)) for name in (*CONSTANTS, "KP_A")}
    body = TrafficVehicle(
        constants,
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
