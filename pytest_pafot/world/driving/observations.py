"""The Kinematics observation of highway-env in compiled code and without pandas, equal to the last bit.

highway-env's own function takes milliseconds for it, which is longer than all the rest of a run. All other observations
are left to highway-env.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, lru_cache
from types import MethodType
from typing import Any

from pytest_pafot.support.errors import WorldError
from pytest_pafot.world.driving.vehicles import compiled_network
from pytest_pafot.world.kernel.features import FEATURES, Features, Table
from pytest_pafot.world.kernel.lane_network import Network
from pytest_pafot.world.stock import AbstractLane, Road, RoadObject, Vehicle, observation

_REPLACED = {
    Road: ("close_objects_to", "close_vehicles_to"),
    RoadObject: ("to_dict",),
    Vehicle: (
        "to_dict", "velocity", "direction", "destination", "destination_direction", "lane_offset", "lane_distance_to",
    ),
}  # fmt: skip
"""What highway-env's observations read of each class, but the compiled code does not."""

OF_THE_ROAD = ("KinematicObservation", "OccupancyGridObservation", "TimeToCollisionObservation", "LidarObservation")
"""The observation classes of highway-env that are computed only from a road's vehicles."""


def observer(env: Any) -> Any:
    """Return a function for an environment's observation, faster than the environment's own function if possible."""
    stock = env.observation_type
    network = compiled_network(env.road.network) if _is_fit(stock) else None
    return _slow(stock) if network is None else FastTable(env, stock, network)


def observe_by(env: Any, observe: Callable[[], Any]) -> None:
    """Replace an environment's function for its observation, also after resets."""

    def define_spaces() -> None:
        type(env).define_spaces(env)
        env.observation_type.observe = observe

    env.define_spaces = define_spaces
    env.observation_type.observe = observe


def hide(env: Any, npc: int) -> Callable[[], Any]:
    """Let an environment observe as if an NPC was not on its road, and return its function for that.

    Raises:
        WorldError: for an observation that is not computed only from the vehicles on the road.
    """
    kinds = [each.__name__ for each in type(env.observation_type).__mro__]
    if not {*kinds}.intersection(OF_THE_ROAD):
        expected = f"an observation of the vehicles on the road, one of {', '.join(OF_THE_ROAD)}"
        raise WorldError(field="config.observation", expected=expected, received=kinds[0])

    def observe() -> Any:
        road, vehicles = env.road, env.road.vehicles
        hidden = [each for each in vehicles if each is not env.vehicle][npc]
        road.vehicles = [each for each in vehicles if each is not hidden]
        try:
            return observer(env)()
        finally:
            road.vehicles = vehicles

    observe_by(env, observe)
    return observe


def _is_fit(stock: Any) -> bool:
    """Return whether the kind and the options of highway-env's observation are supported."""
    if type(stock) not in (observation.KinematicObservation, observation.ExitObservation):
        return False
    names = set(stock.features)
    is_plain = names <= {*FEATURES} and len(names) == len(stock.features)
    return is_plain and stock.order == "sorted" and stock.vehicles_count >= 1


class FastTable:
    """A faster function for Kinematics, and for the same table with the distance to an exit.

    highway-env's own function observes if the road or any vehicle is of a class that observes in its own way.
    """

    def __init__(self, env: Any, stock: Any, network: Network) -> None:
        self._env = env
        self._stock = stock
        self._slowly = _slow(stock)
        self._network = network
        self._roads = env.road.network
        self._lanes = {lane: number for number, lane in enumerate(self._roads.lanes_list())}

    def __call__(self) -> Any:
        """Return the observation."""
        road, stock, exit_lane, objects = self._env.road, self._stock, -1, []
        if not road or road.network is not self._roads:
            return self._slowly()
        if type(stock) is observation.ExitObservation:
            exit_lane = self._lanes[self._roads.get_lane(("1", "2", -1))]
        elif stock.include_obstacles:
            objects = road.objects
        ego = stock.observer_vehicle
        is_plain = (
            all(_is_plain(kind, Vehicle) for kind in {type(ego), *map(type, road.vehicles)})
            and _is_plain(road.__class__, Road)
            and all(_is_plain(each.__class__, RoadObject) for each in objects)
        )
        if is_plain:
            try:
                return self._table.observe(ego, road.vehicles, objects, self._env.PERCEPTION_DISTANCE, exit_lane)
            except (LookupError, ZeroDivisionError):  # a lane that is not on the road, or an empty features_range
                pass
        return self._slowly()

    @cached_property
    def _table(self) -> Table:
        """The table with its scale, which highway-env chooses at the first observation."""
        stock = self._stock
        if stock.normalize and not stock.features_range:
            lanes = len(self._roads.all_side_lanes(stock.observer_vehicle.lane_index))
            ends = 5.0 * Vehicle.MAX_SPEED, AbstractLane.DEFAULT_WIDTH * lanes, *(2 * Vehicle.MAX_SPEED,) * 2
            stock.features_range = {name: [-end, end] for name, end in zip(("x", "y", "vx", "vy"), ends, strict=True)}
        ranges = stock.features_range if stock.normalize else {}
        return Table(Features(self._network, self._lanes, stock.features, ranges, is_clipped=stock.clip), stock)


def _slow(stock: Any) -> Any:
    """Return highway-env's own function, although another one may have replaced it."""
    return MethodType(type(stock).observe, stock)


@lru_cache(maxsize=1000)
def _is_plain(kind: Any, base: Any) -> bool:
    """Return whether a class has those methods of a class of highway-env that compiled code replaces."""
    return issubclass(kind, base) and all(getattr(kind, name) is getattr(base, name) for name in _REPLACED[base])
