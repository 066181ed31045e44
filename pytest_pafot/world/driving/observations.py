"""The observations of highway-env in compiled code and without pandas, equal to the last bit.

highway-env's own functions take milliseconds for an observation, which is longer than all the rest of a run.
"""

from __future__ import annotations

from functools import cached_property, lru_cache
from types import MethodType
from typing import Any

import numpy as np

from pytest_pafot.world.driving.vehicles import compiled_network
from pytest_pafot.world.kernel.features import FEATURES, Collisions, Features, Grid, Table
from pytest_pafot.world.kernel.lane_network import Network
from pytest_pafot.world.stock import AbstractLane, MDPVehicle, Road, RoadObject, Vehicle, observation

_REPLACED = {
    Road: ("close_objects_to", "close_vehicles_to"),
    RoadObject: ("to_dict",),
    Vehicle: (
        "to_dict", "velocity", "direction", "destination", "destination_direction", "lane_offset", "lane_distance_to",
    ),
    MDPVehicle: ("index_to_speed",),
}  # fmt: skip
"""What highway-env's observations read of each class, but the compiled code does not."""


def observer(env: Any) -> Any:
    """Return a function for an environment's observation, faster than the environment's own function if possible."""
    stock = env.observation_type
    fast = _FAST.get(type(stock))
    network = None if fast is None else compiled_network(env.road.network)
    return fast(env, stock, network) if fast and network and fast.is_fit(stock) else _slow(stock)


def observe_fast(env: Any) -> None:
    """Replace an environment's function for its observation by that of :func:`observer`, also after resets."""

    def define_spaces() -> None:
        type(env).define_spaces(env)
        env.observation_type.observe = lambda: observer(env)()  # noqa: PLW0108  (a reset makes the road only later)

    env.define_spaces = define_spaces


class FastObservation:
    """A faster function for an environment's observation.

    highway-env's own function observes if the road or any vehicle is of a class that observes in its own way.
    """

    def __init__(self, env: Any, stock: Any, network: Network) -> None:
        self._env = env
        self._stock = stock
        self._slowly = _slow(stock)
        self._network = network
        self._roads = env.road.network
        self._lanes = {lane: number for number, lane in enumerate(self._roads.lanes_list())}

    @staticmethod
    def is_fit(stock: Any) -> bool:
        """Return whether the options of highway-env's observation are supported."""
        return True

    def __call__(self) -> Any:
        """Return the observation."""
        road, ego = self._env.road, self._stock.observer_vehicle
        if road and road.network is self._roads:
            vehicles = {type(ego), *map(type, road.vehicles)}
            if all(_is_plain(kind, Vehicle) for kind in vehicles):
                try:
                    return self._observe(ego, road)
                except (LookupError, ZeroDivisionError):  # a lane that is not on the road, or an empty features_range
                    pass
        return self._slowly()

    def _observe(self, ego: Any, road: Any) -> Any:
        raise NotImplementedError

    def _features(self, ranges: dict[str, Any], *, is_clipped: bool) -> Features:
        return Features(self._network, self._lanes, self._stock.features, ranges, is_clipped=is_clipped)


class FastTable(FastObservation):
    """A faster function for Kinematics and for the same table with the distance to an exit."""

    @staticmethod
    def is_fit(stock: Any) -> bool:
        """Return whether the options of highway-env's observation are supported."""
        names = set(stock.features)
        is_plain = names <= {*FEATURES} and len(names) == len(stock.features)
        return is_plain and stock.order == "sorted" and stock.vehicles_count >= 1

    def _observe(self, ego: Any, road: Any) -> Any:
        stock, exit_lane, objects = self._stock, -1, []
        if type(stock) is observation.ExitObservation:
            exit_lane = self._lanes[self._roads.get_lane(("1", "2", -1))]
        elif stock.include_obstacles:
            objects = road.objects
        if not (_is_plain(road.__class__, Road) and all(_is_plain(each.__class__, RoadObject) for each in objects)):
            return self._slowly()
        return self._table.observe(ego, road.vehicles, objects, self._env.PERCEPTION_DISTANCE, exit_lane)

    @cached_property
    def _table(self) -> Table:
        """The table with its scale, which highway-env chooses at the first observation."""
        stock = self._stock
        if stock.normalize and not stock.features_range:
            lanes = len(self._roads.all_side_lanes(stock.observer_vehicle.lane_index))
            ends = 5.0 * Vehicle.MAX_SPEED, AbstractLane.DEFAULT_WIDTH * lanes, *(2 * Vehicle.MAX_SPEED,) * 2
            stock.features_range = {name: [-end, end] for name, end in zip(("x", "y", "vx", "vy"), ends, strict=True)}
        return Table(self._features(stock.features_range if stock.normalize else {}, is_clipped=stock.clip), stock)


class FastGrid(FastObservation):
    """A faster function for OccupancyGrid."""

    @staticmethod
    def is_fit(stock: Any) -> bool:
        """Return whether the options of highway-env's observation are supported."""
        return not stock.absolute

    def _observe(self, ego: Any, road: Any) -> Any:
        stock = self._stock
        stock.grid.fill(np.nan)
        self._grid.fill(stock.grid, ego, road.vehicles)
        seen = np.clip(stock.grid, -1, 1) if stock.clip else stock.grid
        if stock.as_image:
            seen = ((np.clip(seen, -1, 1) + 1) / 2 * 255).astype(np.uint8)
        return np.nan_to_num(seen).astype(np.uint8 if stock.as_image else np.float32)

    @cached_property
    def _grid(self) -> Grid:
        """The grid with its scale, which highway-env chooses at the first observation."""
        stock = self._stock
        if not stock.features_range:
            stock.features_range = {name: [-2 * Vehicle.MAX_SPEED, 2 * Vehicle.MAX_SPEED] for name in ("vx", "vy")}
        return Grid(self._features(stock.features_range, is_clipped=False), stock)


class FastCollisions(FastObservation):
    """A faster function for TimeToCollision."""

    def _observe(self, ego: Any, road: Any) -> Any:
        # With a single speed, highway-env returns the grid for two speeds.
        is_usual = _is_plain(ego.__class__, MDPVehicle) and ego.target_speeds.size > 1
        if ego is not self._env.vehicle or not is_usual:
            return self._slowly()
        period = 1 / self._env.config["policy_frequency"]
        cells = int(self._stock.horizon / period)
        return self._collisions.observe(ego, road.vehicles, self._roads, period, cells)

    @cached_property
    def _collisions(self) -> Collisions:
        return Collisions(self._network, self._lanes)


_FAST: dict[Any, type[FastObservation]] = {
    observation.KinematicObservation: FastTable,
    observation.ExitObservation: FastTable,
    observation.OccupancyGridObservation: FastGrid,
    observation.TimeToCollisionObservation: FastCollisions,
}


def _slow(stock: Any) -> Any:
    """Return highway-env's own function, although another one may have replaced it."""
    return MethodType(type(stock).observe, stock)


@lru_cache(maxsize=1000)
def _is_plain(kind: Any, base: Any) -> bool:
    """Return whether a class has those methods of a class of highway-env that compiled code replaces."""
    return issubclass(kind, base) and all(getattr(kind, name) is getattr(base, name) for name in _REPLACED[base])
