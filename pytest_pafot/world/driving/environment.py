"""The actions of ADSs that act as an environment defines, and the environment in which they may simulate."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache
from types import MethodType
from typing import Any

import numpy as np
from gymnasium import spaces

from pytest_pafot.model.scenario import rng_of
from pytest_pafot.support.errors import BadAction, WorldError
from pytest_pafot.support.text import shown
from pytest_pafot.world.driving.vehicles import compiled_network
from pytest_pafot.world.kernel.action import hint_at
from pytest_pafot.world.kernel.lane_network import FEATURES, Network, Table
from pytest_pafot.world.stock import AbstractLane, Road, RoadObject, Vehicle, class_from_path, observation


def check_action_space(space: Any, wrappers: Sequence[str] = ()) -> None:
    """Raise a :class:`WorldError` for an action space that is not for one vehicle.

    ``wrappers`` are the names of the wrappers that have made it from another; empty if it is the environment's own.
    """
    if isinstance(space, (spaces.Discrete, spaces.Box)):
        return
    expected, received = "a discrete or continuous action for one vehicle", f"the space {space}"
    if wrappers:
        received = f"{received} in {', '.join(wrappers)}"
        fix = "let the wrappers' action_space be a Discrete or a Box"
        raise WorldError(field="wrappers", expected=expected, received=received, fix=fix)
    fix = "multi-agent actions have no single ego"
    raise WorldError(field="config.action", expected=expected, received=received, fix=fix)


def checked_action(action: Any, space: Any) -> Any:
    """Return an action as its space requires: as an int, or as a float array with the shape of the space.

    Raises:
        BadAction: for an action of another kind or shape than the space has; numbers outside its bounds are the
            environment's to limit.
    """
    is_choice = isinstance(space, spaces.Discrete)
    expected = f"expected finite numbers of shape {space.shape}"
    if is_choice:
        expected = f"expected a whole number from {space.start} to {space.start + space.n - 1}"
    try:
        given = np.asarray(action)
    except (TypeError, ValueError):  # such as rows of different lengths
        raise _bad(expected, action) from None
    if is_choice:
        if given.size != 1 or given.dtype.kind not in "iu" or not space.contains(int(given.reshape(()))):
            raise _bad(expected, action, _hint_at_choice(given, space))
        return int(given.reshape(()))
    if given.dtype.kind not in "iuf" or given.shape != space.shape or not np.isfinite(given).all():
        raise _bad(expected, action)
    return np.array(given, dtype=np.result_type(given, np.float32))  # a copy: the ADS may reuse its array


def _bad(expected: str, action: Any, hint: str = "") -> BadAction:
    hint = hint_at(action) or hint
    return BadAction(f"{expected}, received {shown(action)}{f'; {hint}' if hint else ''}")


def _hint_at_choice(array: Any, space: Any) -> str:
    """Return a hint for an array that an ADS returned in place of an action's number; empty if none fits."""
    if array.dtype.kind == "f" and array.shape == (2,) and space.n != 2:
        return (
            "planners in SI units drive without world=, or in a pafot.World(..., planner_hz=5); for a command, write "
            "@planner after the name"
        )
    if array.dtype.kind == "f" and array.size == space.n:
        return "if these are values of the actions, return the number of the largest: `int(np.argmax(...))`"
    if array.dtype.kind == "f" and array.size == 1:
        return "return `int(...)` of it"
    return ""


def copies_on(objects: Sequence[Any], road: Road) -> list[Any]:
    """Copy a road's fixed objects to a different road."""
    copies = [copy.copy(each) for each in objects]
    for each in copies:
        each.road = road
    return copies


class View:
    """An environment for a planner to copy and simulate in, with the run's state but without the NPCs' genes.

    The ego is a copy of the run's ego. Every other vehicle is of the environment's own traffic class, in the NPC's
    state, and with the current speed as its desired speed, because an observer cannot know more.
    """

    def __init__(self, env: Any, run_env: Any) -> None:
        self.env = env
        self._run_env = run_env
        self._traffic = class_from_path(env.config["other_vehicles_type"])
        self.show(0)

    def show(self, tick: int) -> None:
        """Update the view to the run's state."""
        source, env = self._run_env, self.env
        road = Road(
            source.road.network,
            np_random=rng_of(tick),
            neighbour_vehicles_connected_lanes=source.road.neighbour_vehicles_connected_lanes,
        )
        ego = copy.copy(source.vehicle)
        ego.road = road
        ego.position = np.array(source.vehicle.position)
        ego.action = dict(source.vehicle.action)
        ego.check_collisions = True
        road.objects = copies_on(source.road.objects, road)
        road.vehicles = [ego]
        for each in source.road.vehicles:
            if each is not source.vehicle:
                state = np.array(each.position), float(each.heading), float(each.speed)
                road.vehicles.append(self._traffic(road, *state))
        env.road = road
        env.controlled_vehicles = [ego]
        env.np_random = road.np_random
        env.steps, env.time, env.done = source.steps, source.time, False
        env.define_spaces()
        env.action_space.seed(tick)  # planners sample from it
        env.observation_space.seed(tick)


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
        return Table(self._network, self._lanes, stock, ranges)


def _slow(stock: Any) -> Any:
    """Return highway-env's own function, although another one may have replaced it."""
    return MethodType(type(stock).observe, stock)


@lru_cache(maxsize=1000)
def _is_plain(kind: Any, base: Any) -> bool:
    """Return whether a class has those methods of a class of highway-env that compiled code replaces."""
    return issubclass(kind, base) and all(getattr(kind, name) is getattr(base, name) for name in _REPLACED[base])
