"""Modified MetaDrive classes for :mod:`pytest_pafot.simulators.metadrive`. Importing this module requires MetaDrive."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

from metadrive.component.sensors.lidar import Lidar
from metadrive.component.vehicle.base_vehicle import BaseVehicle
from metadrive.component.vehicle.vehicle_type import VaryingDynamicsVehicle
from metadrive.constants import CollisionGroup
from metadrive.engine.base_engine import BaseEngine
from metadrive.engine.engine_utils import close_engine, get_engine
from metadrive.envs.metadrive_env import MetaDriveEnv
from metadrive.policy.idm_policy import IDMPolicy

from pytest_pafot.support.errors import WorldError, flag

__all__ = ["Env", "IDMPolicy"]

# The distance between the points of the centre line of a lane [m].
SPACING = 3.0
# The group of vehicles in Bullet.
VEHICLES = CollisionGroup.Vehicle.getLowestOnBit()


class OrderedLidar(Lidar):  # type: ignore[misc]
    """A lidar that returns objects in a fixed order. MetaDrive's order depends on memory addresses."""

    def get_surrounding_objects(self, vehicle: Any, radius: int = 50) -> list[Any]:
        return sorted(
            super().get_surrounding_objects(vehicle, radius), key=lambda each: tuple(each.position)
        )

    @staticmethod
    def get_surrounding_vehicles(detected_objects: Sequence[Any]) -> list[Any]:
        return [each for each in detected_objects if isinstance(each, BaseVehicle)]


class Engine(BaseEngine):  # type: ignore[misc]
    """A MetaDrive engine that does not download the models and textures, which are needed only for images."""

    @staticmethod
    def try_pull_asset() -> None:
        """Download nothing."""


class Env(MetaDriveEnv):  # type: ignore[misc]
    """A MetaDrive environment without images or traffic, in which no run depends on earlier runs.

    Args:
        blocks: string with one letter per block of the road.
        lanes: number of lanes.
        sensors: sensor settings in MetaDrive's ``vehicle_config``.
    """

    def __init__(self, blocks: str, lanes: int, sensors: Mapping[str, Any]) -> None:
        if isinstance(get_engine(), Engine):
            close_engine()
        if get_engine() is not None:
            raise WorldError(
                "pafot.metadrive",
                "no other environment in this process",
                "one that is still open",
                f"call `close` of your own MetaDriveEnv, or search in other processes with {flag('workers', 2)}",
            )
        super().__init__(
            {
                "use_render": False,
                "image_observation": False,
                "log_level": logging.ERROR,
                # reused vehicles would keep the state of steering and wheels
                "force_destroy": True,
                "sensors": {"lidar": (OrderedLidar,)},
                "map_config": {"type": "block_sequence", "config": blocks, "lane_num": lanes},
                "traffic_density": 0.0,
                "random_spawn_lane_index": False,
                "num_scenarios": 1,
                "start_seed": 0,
                # the default model has random forces
                "vehicle_config": {"vehicle_model": "static_default", **sensors},
            }
        )
        self._own = Engine(self.config)
        self.setup_engine()

    @property
    def is_open(self) -> bool:
        # False after this environment was closed or another one was created.
        return get_engine() is self._own

    def begin(self, position: Sequence[float], heading: float, speed: float) -> Any:
        """Start a run with the ego at a position [m] with a heading [rad] and a speed [m/s]."""
        # Not with set_position, because only a new vehicle gets the checkpoints ahead of its position.
        agent = self.config["agent_configs"]["default_agent"]
        agent["spawn_position_heading"] = (tuple(position), heading)
        self.reset(seed=0)  # 0 is the map; nothing in a run is random
        # Vehicles pass through each other, because Bullet would push them. The package detects contacts.
        self.engine.physics_world.dynamic_world.setGroupCollisionFlag(VEHICLES, VEHICLES, False)
        velocity = (math.cos(heading), math.sin(heading)), speed
        self.agent.set_velocity(*velocity)
        # MetaDrive returns positions before the last substep, so there must be one
        self.engine.step_physics_world()
        self.agent.set_velocity(*velocity)  # the substep may have changed it
        return self.agent

    def lines(self) -> list[list[tuple[float, float]]]:
        """Return the points [m] of each lane's centre line, from the left, and end the current run."""
        self.reset(seed=0)
        ways = self.agent.navigation.checkpoints
        graph = self.current_map.road_network.graph
        lines: list[list[tuple[float, float]]] = []
        for number in range(len(graph[ways[0]][ways[1]])):
            lanes = [graph[start][end][number] for start, end in pairwise(ways)]
            lines.append([_point(lanes[0].position(0.0, 0.0))])
            for lane in lanes:
                steps = math.ceil(lane.length / SPACING)
                for step in range(1, steps + 1):
                    lines[-1].append(_point(lane.position(lane.length * step / steps, 0.0)))
        return lines

    def add_other(
        self, length: float, width: float, position: Sequence[float], heading: float
    ) -> Any:
        """Add a vehicle that does not move on its own, and return it. The next run removes it."""
        size = {"length": length, "width": width, "height": 1.5, "mass": 1100.0}
        # The traffic manager removes its vehicles at the next reset.
        other = self.engine.traffic_manager.spawn_object(
            VaryingDynamicsVehicle,
            vehicle_config=size,
            position=list(position),
            heading=heading,
        )
        other.set_static(True)  # else it falls and drives on
        return other


def _point(place: Any) -> tuple[float, float]:
    return float(place[0]), float(place[1])
