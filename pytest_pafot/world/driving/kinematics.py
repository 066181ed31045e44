"""The Kinematics observation of highway-env without pandas, equal to the last bit.

highway-env builds the observation with pandas, which takes longer than all the rest of a run.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pytest_pafot.world.driving.vehicles import ParallelLanes, straight_road
from pytest_pafot.world.stock import AbstractLane, Vehicle, observation

_DIRECT = ("presence", "x", "y", "vx", "vy", "heading", "cos_h", "sin_h")
_RELATIVE = ("x", "y", "vx", "vy")


def observer(env: Any) -> Any:
    """Return a function for an environment's observation, faster than the environment's own function if possible."""
    stock = env.observation_type
    is_supported = (
        type(stock) is observation.KinematicObservation
        and stock.order == "sorted"
        and stock.vehicles_count >= 2
        and all(feature in _DIRECT for feature in stock.features)
        and len(set(stock.features)) == len(stock.features)
        and not (stock.include_obstacles and env.road.objects)
    )
    return FastKinematics(env, stock) if is_supported else stock.observe


@dataclass(eq=False)
class FastKinematics:
    """A faster function for the Kinematics observation: the ego and the vehicles that are nearest along its lane."""

    _env: Any
    _stock: Any

    def __call__(self) -> Any:
        """Return the observation as float32 of shape [vehicles_count, features]."""
        stock = self._stock
        ego = stock.observer_vehicle
        rows = [_features(vehicle) for vehicle in (ego, *self._close(ego))]
        if not stock.absolute:
            for row in rows[1:]:
                for feature in _RELATIVE:
                    row[feature] -= rows[0][feature]
        table = np.zeros((stock.vehicles_count, len(stock.features)))
        for index, row in enumerate(rows):
            table[index] = [row[feature] for feature in stock.features]
        if stock.normalize:
            self._normalize(table[: len(rows)])
        return table.astype(np.float32)

    def _close(self, ego: Any) -> list[Any]:
        road, reach = self._env.road, self._env.PERCEPTION_DISTANCE
        x, y = float(ego.position[0]), float(ego.position[1])
        along = self._along(ego)
        here, found = along(ego.position), []
        for vehicle in road.vehicles:
            if vehicle is ego:
                continue
            dx, dy = vehicle.position[0] - x, vehicle.position[1] - y
            if math.sqrt(dx * dx + dy * dy) < reach:
                ahead = along(vehicle.position) - here
                if self._stock.see_behind or ahead > -2 * ego.LENGTH:
                    found.append((abs(ahead), vehicle))
        found.sort(key=lambda pair: pair[0])
        return [vehicle for _, vehicle in found[: self._stock.vehicles_count - 1]]

    def _along(self, ego: Any) -> Callable[[Any], float]:
        """Return a function from a position to its place along the ego's lane [m]."""
        lane = ego.lane
        if not self._is_straight:
            return lambda position: float(lane.local_coordinates(position)[0])
        start = float(lane.start[0])
        return lambda position: position[0] - start

    @cached_property
    def _is_straight(self) -> bool:
        network = self._env.road.network
        return isinstance(network, ParallelLanes) or straight_road(network) is not None

    def _normalize(self, rows: Any) -> None:
        for column, bounds in enumerate(self._ranges):
            if bounds is None:
                continue
            low, high = bounds
            rows[:, column] = -1 + (rows[:, column] - low) * (1 - -1) / (high - low)
            if self._stock.clip:
                np.clip(rows[:, column], -1, 1, out=rows[:, column])

    @cached_property
    def _ranges(self) -> list[tuple[float, float] | None]:
        """The values of each feature that become -1 and 1; None for a feature that is not scaled."""
        ranges = self._stock.features_range
        if not ranges:
            lanes = len(self._env.road.network.all_side_lanes(self._stock.observer_vehicle.lane_index))
            top, across = Vehicle.MAX_SPEED, AbstractLane.DEFAULT_WIDTH * lanes
            ends = {"x": 5.0 * top, "y": across, "vx": 2 * top, "vy": 2 * top}
            ranges = {feature: (-end, end) for feature, end in ends.items()}
        return [tuple(ranges[feature]) if feature in ranges else None for feature in self._stock.features]


def _features(vehicle: Any) -> dict[str, float]:
    cos_h, sin_h = np.cos(vehicle.heading), np.sin(vehicle.heading)
    return {
        "presence": 1,
        "x": vehicle.position[0],
        "y": vehicle.position[1],
        "vx": vehicle.speed * cos_h,
        "vy": vehicle.speed * sin_h,
        "heading": vehicle.heading,
        "cos_h": cos_h,
        "sin_h": sin_h,
    }
