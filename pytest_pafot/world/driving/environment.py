"""Drivers that use the actions, observations or vehicle classes of an environment.

Compiled code creates the Kinematics observation, which is identical to highway-env's to the last bit. highway-env's own
function takes milliseconds, longer than the rest of a run. highway-env creates all other observations.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache
from types import MethodType
from typing import Any

import numpy as np
from gymnasium import spaces

from pytest_pafot.model.scenario import rng_of
from pytest_pafot.model.trace import AdsError
from pytest_pafot.support.errors import BadAction, WorldError
from pytest_pafot.support.text import safe_repr
from pytest_pafot.world.driving.policy import Unseeing
from pytest_pafot.world.driving.vehicles import (
    CompiledRoad,
    EgosRegulatedRoad,
    StockVehicle,
    Traffic,
    TrafficClass,
    compiled_network,
    is_regulated,
    state_of,
)
from pytest_pafot.world.engines.run import Plausibility
from pytest_pafot.world.guard.hang_guard import UNFIT, HangGuard, error_of
from pytest_pafot.world.kernel.action import hint_at
from pytest_pafot.world.kernel.lane_network import FEATURES, Network, Table
from pytest_pafot.world.kernel.lanes import Body, Places
from pytest_pafot.world.kernel.loop import EgoDriver
from pytest_pafot.world.roads.road import Pose, StraightRoad
from pytest_pafot.world.roads.road import Road as RoadOfGrid
from pytest_pafot.world.stock import (
    AbstractLane,
    Road,
    RoadObject,
    Vehicle,
    class_from_path,
    observation,
)


def check_action_space(space: Any, wrappers: Sequence[str] = ()) -> None:
    """Raise a :class:`WorldError` if an action space does not control exactly one vehicle.

    ``wrappers`` are the names of the wrappers that define the space, if any.
    """
    if isinstance(space, (spaces.Discrete, spaces.Box)):
        return
    expected = "a discrete or continuous action space for one vehicle"
    received = str(space)
    if wrappers:
        received = f"{received} from {', '.join(wrappers)}"
        fix = "make the wrappers' action_space a Discrete or a Box"
        raise WorldError(field="wrappers", expected=expected, received=received, fix=fix)
    fix = "use an action type for one vehicle, for example DiscreteMetaAction"
    raise WorldError(field="config.action", expected=expected, received=received, fix=fix)


def checked_action(action: Any, space: Any) -> Any:
    """Convert an action to an int, or to a float array with the shape of the space.

    Raises:
        BadAction: if the type or shape does not match the space. Numbers outside the bounds of a Box are accepted.
    """
    is_choice = isinstance(space, spaces.Discrete)
    expected = f"expected finite numbers of shape {space.shape}"
    # only a choice must be within bounds, because the environment limits other numbers itself
    if is_choice:
        expected = f"expected a whole number from {space.start} to {space.start + space.n - 1}"
    try:
        given = np.asarray(action)  # may run the ADS's code, for example __array__
    except (TypeError, ValueError):  # such as rows of different lengths
        raise _bad(expected, action) from None
    if is_choice:
        if given.size == 1 and given.dtype.kind in "iu":
            choice = int(given.reshape(()))
            if space.contains(choice):
                return choice
        raise _bad(expected, action, _hint_at_choice(given, space))
    if given.dtype.kind not in "iuf" or given.shape != space.shape or not np.isfinite(given).all():
        raise _bad(expected, action)
    # a copy: the ADS may reuse its array
    return np.array(given, dtype=np.result_type(given, np.float32))


def _bad(expected: str, action: Any, hint: str = "") -> BadAction:
    hint = hint_at(action) or hint
    message = f"{expected}, received {safe_repr(action)}"
    if hint:
        message = f"{message}; {hint}"
    return BadAction(message)


def _hint_at_choice(array: Any, space: Any) -> str:
    if array.dtype.kind != "f":
        return ""
    if array.shape == (2,) and space.n != 2:
        return (
            "planners in SI units drive without world=, or in a pafot.World(..., planner_hz=5); for a command, write "
            "@planner after the name"
        )
    if array.size == space.n:
        return "if these are values of the actions, return the number of the largest: `int(np.argmax(...))`"
    if array.size == 1:
        return "return `int(...)` of it"
    return ""


def copies_on(objects: Sequence[Any], road: Road) -> list[Any]:
    """Return copies of fixed objects, placed on a different road."""
    copies = [copy.copy(each) for each in objects]
    for each in copies:
        each.road = road
    return copies


class View:
    """An environment in which a planner can simulate, with the state of the run but without the NPCs' plans.

    Every NPC is an instance of the environment's traffic class, with its current speed as the desired speed, because an
    observer cannot know more.
    """

    def __init__(self, env: Any, run_env: Any) -> None:
        self.env = env
        self._run_env = run_env
        self._traffic = class_from_path(env.config["other_vehicles_type"])
        self.show(0)

    def show(self, tick: int) -> None:
        source = self._run_env
        env = self.env
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
        # without a route or a target, so that the NPCs' plans stay hidden
        for each in source.road.vehicles:
            if each is not source.vehicle:
                state = np.array(each.position), float(each.heading), float(each.speed)
                road.vehicles.append(self._traffic(road, *state))
        env.road = road
        env.controlled_vehicles = [ego]
        env.np_random = road.np_random
        env.steps = source.steps
        env.time = source.time
        env.done = False
        env.define_spaces()
        env.action_space.seed(tick)  # planners sample from it
        env.observation_space.seed(tick)


# the members of each class that highway-env's observations use, and the compiled code does not
_REPLACED = {
    Road: ("close_objects_to", "close_vehicles_to"),
    RoadObject: ("to_dict",),
    Vehicle: (
        "to_dict", "velocity", "direction", "destination", "destination_direction", "lane_offset", "lane_distance_to",
    ),
}  # fmt: skip

# highway-env's classes of observations that depend only on the vehicles on the road
OF_THE_ROAD = (
    "KinematicObservation",
    "OccupancyGridObservation",
    "TimeToCollisionObservation",
    "LidarObservation",
)


def observer(env: Any) -> Any:
    """Return a function that computes an environment's observation, faster than the environment itself if possible."""
    stock = env.observation_type
    network = None
    if _is_fit(stock):
        network = compiled_network(env.road.network)
    if network is None:
        return _slow(stock)
    return FastTable(env, stock, network)


def observe_by(env: Any, observe: Callable[[], Any]) -> None:
    """Replace the function that computes an environment's observation, even after resets."""

    def define_spaces() -> None:
        type(env).define_spaces(env)
        env.observation_type.observe = observe

    env.define_spaces = define_spaces
    env.observation_type.observe = observe


def hide(env: Any, npc: int) -> Callable[[], Any]:
    """Remove an NPC from an environment's observations, and return the new observation function.

    Raises:
        WorldError: if the observation does not depend only on the vehicles on the road.
    """
    kinds = [each.__name__ for each in type(env.observation_type).__mro__]
    if not {*kinds}.intersection(OF_THE_ROAD):
        expected = f"an observation of the vehicles on the road, one of {', '.join(OF_THE_ROAD)}"
        raise WorldError(field="config.observation", expected=expected, received=kinds[0])

    def observe() -> Any:
        road = env.road
        vehicles = road.vehicles
        hidden = [each for each in vehicles if each is not env.vehicle][npc]
        road.vehicles = [each for each in vehicles if each is not hidden]
        try:
            return observer(env)()
        finally:
            road.vehicles = vehicles

    observe_by(env, observe)
    return observe


def _is_fit(stock: Any) -> bool:
    if type(stock) not in (observation.KinematicObservation, observation.ExitObservation):
        return False
    names = set(stock.features)
    is_plain = names <= {*FEATURES} and len(names) == len(stock.features)
    return is_plain and stock.order == "sorted" and stock.vehicles_count >= 1


class FastTable:
    """A faster function for the Kinematics observation, including the variant with the distance to an exit.

    It calls highway-env's own function if the class of the road or of a vehicle overrides a member that matters here.
    """

    def __init__(self, env: Any, stock: Any, network: Network) -> None:
        self._env = env
        self._stock = stock
        self._slowly = _slow(stock)
        self._network = network
        self._roads = env.road.network
        self._lanes = {lane: number for number, lane in enumerate(self._roads.lanes_list())}

    def reads_poses_alone(self, traffic: Any) -> bool:
        """Return whether observations show only the positions, headings and speeds of a traffic class's vehicles."""
        of_lanes = {"cos_d", "sin_d", "long_off", "lat_off", "ang_off"}
        return of_lanes.isdisjoint(self._stock.features) and _is_plain(traffic, Vehicle)

    def __call__(self) -> Any:
        road = self._env.road
        stock = self._stock
        exit_lane = -1
        objects: list[Any] = []
        if not road or road.network is not self._roads:
            return self._slowly()
        if type(stock) is observation.ExitObservation:
            exit_lane = self._lanes[self._roads.get_lane(("1", "2", -1))]
        elif stock.include_obstacles:
            objects = road.objects
        ego = stock.observer_vehicle
        # classes that override these members need highway-env's function
        if (
            not _is_plain(road.__class__, Road)
            or not all(_is_plain(kind, Vehicle) for kind in {type(ego), *map(type, road.vehicles)})
            or not all(_is_plain(each.__class__, RoadObject) for each in objects)
        ):
            return self._slowly()
        reach = self._env.PERCEPTION_DISTANCE
        try:
            return self._table.observe(ego, road.vehicles, objects, reach, exit_lane)
        # a lane that is not on the road, or an empty features_range
        except (LookupError, ZeroDivisionError):
            return self._slowly()

    @cached_property
    def _table(self) -> Table:
        stock = self._stock
        # as highway-env does at the first observation
        if stock.normalize and not stock.features_range:
            lanes = len(self._roads.all_side_lanes(stock.observer_vehicle.lane_index))
            fastest = 2 * Vehicle.MAX_SPEED
            ends = {
                "x": 5.0 * Vehicle.MAX_SPEED,
                "y": AbstractLane.DEFAULT_WIDTH * lanes,
                "vx": fastest,
                "vy": fastest,
            }
            stock.features_range = {name: [-end, end] for name, end in ends.items()}
        ranges = stock.features_range
        if not stock.normalize:
            ranges = {}
        return Table(self._network, self._lanes, stock, ranges)


def _slow(stock: Any) -> Any:
    return MethodType(type(stock).observe, stock)


@lru_cache(maxsize=1000)
def _is_plain(kind: Any, base: Any) -> bool:
    if not issubclass(kind, base):
        return False
    return all(getattr(kind, name) is getattr(base, name) for name in _REPLACED[base])


class GuardedDriver(EgoDriver):
    """A driver that makes decisions in Python code, which a guard can interrupt."""

    def __init__(self, ego: Body, every: int, guard: HangGuard) -> None:
        super().__init__(ego, every)
        self.guard = guard

    def decide(self, tick: int) -> AdsError | None:
        guard = self.guard
        started = guard.clock()
        try:
            try:
                guard.decision_starts()
                action = self.make_decision(tick)
            finally:
                # before the exception is handled, which nothing may interrupt
                guard.decision_ends()
            guard.raise_swallowed()
        except UNFIT as error:
            return error_of(error, tick, guard)
        if action is not None:
            self.actions.append(action)
        self.slowest = max(self.slowest, guard.clock() - started)
        return None

    def make_decision(self, tick: int) -> Any:
        """Make a decision, and return the action to record, or None."""
        raise NotImplementedError


class ObjectDriver(GuardedDriver):
    """The driver of an ego that is moved by the code of a highway-env vehicle class.

    By default, the class makes a decision at every tick. Call :meth:`show` before the run starts.
    """

    def __init__(
        self,
        vehicle: Any,
        road: Any,
        guard: HangGuard,
        every: int = 1,
        ego: Body | None = None,
        traffic: TrafficClass | None = None,
    ) -> None:
        super().__init__(ego or body_of(vehicle), every, guard)
        self.vehicle = vehicle  # at its start
        self.road = road  # highway-env's; the vehicle's own `road` may be the user's
        self._class = traffic or TrafficClass(StockVehicle)  # by default NPCs have no goals
        self.traffic: Any = None  # on the road after `show`, if it is called
        self._regulated = None
        if isinstance(road, EgosRegulatedRoad):
            self._regulated = road
        self._plausibility: Plausibility | None = None
        self._tick = 0

    def show(self, places: Places, road: RoadOfGrid) -> None:
        """Put the ego and the NPCs on a highway-env road."""
        self.traffic = Traffic(self._class, self.road, self.vehicle, places, road)
        if self._class.seen is StockVehicle or is_regulated(self.vehicle):
            foresee(self.traffic.vehicles, places, road)

    def show_all(self, *, is_lean: bool = False) -> None:
        """Update all highway-env vehicles except the ego, which moves itself, to the state of the run."""
        if self.traffic is not None:
            self.traffic.show(is_lean=is_lean)

    def make_decision(self, tick: int) -> Any:
        self.show_all()
        self.vehicle.act()

    def step(self, dt: float) -> AdsError | None:
        """Move the vehicle with the code of its class, and return the error that the code raised, or None.

        Raises:
            Implausible: if the vehicle moves in an impossible way.
        """
        self._tick += 1
        guard = self.guard
        ego = self.ego
        if self._plausibility is None:
            self._plausibility = Plausibility([(ego.x, ego.y, ego.heading, ego.speed)], dt)
        try:
            try:
                self.show_all(is_lean=True)  # NPCs have new controls, but have not moved yet
                guard.decision_starts()
                if self._regulated is not None:
                    self._regulated.regulate(dt)
                self.vehicle.step(dt)
                follow(ego, self.vehicle)
            finally:
                guard.decision_ends()
            guard.raise_swallowed()
        except UNFIT as error:
            return error_of(error, self._tick - 1, guard)
        state = (ego.x, ego.y, ego.heading, ego.speed)
        name = type(self.vehicle).__name__
        self._plausibility.check([state], f"{name}.step", [ego.acceleration])
        return None


class PolicyDriver(ObjectDriver):
    """A driver that passes an environment's observation to an ADS and applies the action that the ADS returns.

    The ADS may simulate ahead in the ``view``, which shows the state of the run before each decision.
    """

    def __init__(
        self,
        ads: Any,
        env: Any,
        guard: HangGuard,
        every: int,
        traffic: TrafficClass,
        view: View | None = None,
        ego: Body | None = None,
    ) -> None:
        check_action_space(env.action_space)
        super().__init__(env.vehicle, env.road, guard, every, ego, traffic)
        self.env = env
        self._ads = ads
        if isinstance(ads, Unseeing):
            self._observe = hide(env, ads.npc)
        else:
            self._observe = observer(env)
        self._view = view
        self.reads_poses_alone = False  # true if a decision needs no lanes or targets of the NPCs

    def make_decision(self, tick: int) -> Any:
        return self._applied(self._ads(self.observe(tick)))

    def observe(self, tick: int) -> Any:
        """Return the ADS's observation for the current tick."""
        env = self.env
        self.show_all(is_lean=self.reads_poses_alone)
        env.steps = tick
        env.time = tick / env.config["simulation_frequency"]
        if self._view is not None:
            self._view.show(tick)
        return self._observe()

    def _applied(self, action: Any) -> Any:
        """Check and apply an action, and return it to be recorded."""
        checked = checked_action(action, self.env.action_space)
        self.env.action_type.act(checked)
        return checked

    def actuate(self) -> None:
        self.traffic.show()  # the controller of the vehicle's class may look at the NPCs
        self.vehicle.act()


class ModelPolicyDriver(PolicyDriver):
    """A driver for an ego that the kernel moves exactly as highway-env's vehicle classes would."""

    def __init__(
        self,
        ads: Any,
        env: Any,
        guard: HangGuard,
        every: int,
        traffic: TrafficClass,
        view: View | None,
        lanes: StraightRoad | Network,
    ) -> None:
        self._compiled = CompiledRoad(env.road, lanes)
        self._model = self._compiled.vehicle(env.vehicle)
        super().__init__(ads, env, guard, every, traffic, view, self._model)
        is_stock = type(env.action_type).__module__.startswith("highway_env.")
        if is_stock and isinstance(self._observe, FastTable):
            self.reads_poses_alone = self._observe.reads_poses_alone(traffic.seen)

    def show_all(self, *, is_lean: bool = False) -> None:
        self._compiled.show(self.vehicle, self._model)
        super().show_all(is_lean=is_lean)

    def _applied(self, action: Any) -> Any:
        # the environment interprets the action, and the kernel takes the goal
        checked = super()._applied(action)
        self._compiled.take(self.vehicle, self._model)
        return checked

    def actuate(self) -> None:
        self._model.act([])

    def step(self, dt: float) -> None:
        self._model.step(dt)


def body_of(vehicle: Any) -> Body:
    """Return a body for the loop, with the state of a highway-env vehicle."""
    body = Body(float(vehicle.LENGTH), float(vehicle.WIDTH))
    follow(body, vehicle)
    return body


def follow(body: Body, vehicle: Any) -> None:
    """Copy the state of a highway-env vehicle to the loop's body.

    Raises:
        BadAction: if the state is not finite.
    """
    state = state_of(vehicle)
    if not all(map(math.isfinite, state)):
        raise BadAction(
            f"expected a vehicle with a finite position, heading and speed, received {state}"
        )
    body.place(*state)
    body.acceleration = float(vehicle.action["acceleration"])
    body.steering = float(vehicle.action["steering"])


def foresee(npcs: Sequence[Any], places: Places, road: RoadOfGrid) -> None:
    """Make highway-env's regulated roads predict that NPCs follow their paths or lanes."""
    for npc, body in zip(npcs, places.bodies[1:], strict=True):
        pose_at = road.foresight(body)
        if pose_at is not None:
            npc.predict_trajectory_constant_speed = prediction(body, pose_at)


def prediction(
    body: Body, pose_at: Callable[[float], Pose]
) -> Callable[[Any], tuple[list[Any], list[float]]]:
    """Return a function that predicts an NPC's motion along its path or lane at its current speed."""

    def predicted(times: Any) -> tuple[list[Any], list[float]]:
        poses = [pose_at(body.x + body.speed * float(time)) for time in times]
        return [np.array(pose[:2]) for pose in poses], [pose[2] for pose in poses]

    return predicted
