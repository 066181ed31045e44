"""Creation and checks of a world's environment, with the requested wrappers but without random traffic."""

from __future__ import annotations

import ast
import copy
import difflib
import inspect
import itertools
import math
import textwrap
import traceback
import warnings
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from functools import cached_property
from types import FunctionType, MappingProxyType
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import load_env_creator
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit

from pytest_pafot.support.errors import WorldError
from pytest_pafot.world.driving.vehicles import (
    EgosRegulatedRoad,
    SearchedLanes,
    TrafficClass,
    compiled_network,
    straight_road,
    traffic_class,
)
from pytest_pafot.world.engines.run import ADS_HZ, OTHER_KIND, PHYSICS_HZ, FixedObject, plain_data
from pytest_pafot.world.guard.hang_guard import (
    UNFIT,
    AdsHang,
    HangGuard,
    WorldHang,
    let_through,
    patience_with_world,
)
from pytest_pafot.world.kernel.lane_network import Network
from pytest_pafot.world.limits import whole_within
from pytest_pafot.world.roads.road import StraightRoad
from pytest_pafot.world.stock import (
    AbstractEnv,
    ExitEnv,
    IntersectionEnv,
    RegulatedRoad,
    Road,
    Vehicle,
    action,
    observation,
)

# The environment option that lets highway-env's IDM also look for vehicles in connected lanes. Only egos of its class
# do so.
CONNECTED = "neighbour_vehicles_connected_lanes"
# The options for random traffic, other than `vehicles_count`.
TRAFFIC = ("initial_vehicle_count", "other_vehicles", "spawn_probability")
# Options that this package replaces while scenarios run: those for traffic, and one that depends on the machine.
REPLACED = (*TRAFFIC, "vehicles_count", "offscreen_rendering")

# All highway-env options for vehicles other than the ego. NPCs replace these vehicles in a search.
TRAFFIC_OPTIONS = (
    *TRAFFIC,
    "vehicles_count",
    "vehicles_density",
    "other_vehicles_type",
    "incoming_vehicle_destination",
)
# These options have no effect on an ego that decides without the environment's observations and actions.
POLICY_OPTIONS = ("observation", "action", "policy_frequency")

# The largest accepted values of options that affect how long highway-env computes. With these values, creating
# an environment takes seconds.
LARGEST: Mapping[str, float] = MappingProxyType(
    {
        "lanes_count": 20,
        "roundabout_lanes": 20,
        "no_lanes": 10,
        "length": 2000,
        "roundabout_radius": 1000,
        **{f"{part}_merge_length": 5000 for part in ("before", "converge", "parallel", "after")},
        "vehicles_count": 1000,
        "controlled_vehicles": 10,
        "cells": 10_000,
        "horizon": 1000,
        "stack_size": 100,
        "observation_shape": 2000,
        "actions_per_axis": 100,
        "scaling": 1000,
    }
)
# The smallest accepted values of options by which highway-env divides: pixels per metre, and metres per cell, which is
# also the step along each lane.
SMALLEST: Mapping[str, float] = MappingProxyType({"scaling": 0.01, "grid_step": 0.05})
# The largest accepted number of entries of options that are lists.
LONGEST: Mapping[str, int] = MappingProxyType(
    {
        # highway-env's vehicles have 13 features
        **dict.fromkeys(("features", "attributes", "scales"), 50),
        "target_speeds": 100,
        "observation_configs": 20,
        "observation_shape": 2,
        "weights": 3,
    }
)
# The options that contain configurations of observations and actions.
NESTED = ("observation_config", "observation_configs", "action_config")
# The largest accepted number of cells of an occupancy grid.
MOST_CELLS = 250_000
# The largest accepted number of values in an observation: 40 features of the largest grid, or four images of 1920 by
# 1080.
MOST_NUMBERS = 10_000_000
# A part of an observation counts as at least this many values, because even a small part takes milliseconds
# to compute.
LEAST_NUMBERS = MOST_NUMBERS // 20

# The attributes through which highway-env accesses the ego. A run replaces this ego.
WITH_EGO = ("controlled_vehicles", "road", "action_type", "observation_type")

# The attributes with which highway-env's classes and roads control vehicles.
OF_HIGHWAY_ENV = (
    "route",
    "target_lane_index",
    "target_speed",
    "target_speeds",
    "speed_index",
    "enable_lane_change",
    "timer",
    "collecting_data",
    "data",
    "is_yielding",
    "yield_timer",
)

# The methods that report, after a step, whether the episode is over.
ENDS = ("_is_terminated", "_is_truncated")
# The classes of highway-env that terminate episodes only after a crash, or when the ego leaves a curved road. Both end
# runs anyway.
ENDED_ANYWAY = (
    "AbstractEnv",
    "ExitEnv",
    "LaneKeepingEnv",
    "RacetrackEnv",
    "RoundaboutEnv",
    "TwoWayEnv",
    "UTurnEnv",
)

# The methods that are called only by an environment's `step` and `reset`. Runs do not need them.
LEFT_OUT = ("_reward", "_rewards", "_info", *ENDS)

# The numbers of compared resets without and with wrappers. Wrappers can be slow, for example if they record videos.
RESETS = 10
RESETS_IN_WRAPPERS = 4

# Attributes of these types are values, not parts of highway-env.
PLAIN = (bool, int, float, str, list, tuple, dict, set, np.ndarray, np.generic)

# Attributes of these types can be changed in place.
MUTABLE = (list, dict, set, bytearray, deque, np.ndarray)

# The time [s] for which an environment can ignore an interruption before its worker process is ended.
IGNORED = 0.5

# The wrappers that `gymnasium.make` itself adds. They check calls or end episodes, but change neither observations nor
# actions.
NEUTRAL = (OrderEnforcing, PassiveEnvChecker, TimeLimit)


class EnvironmentGuard(HangGuard):
    """A time limit for the code of an environment and its wrappers.

    Args:
        hang_limit: time limit [s] for a decision in the world. The environment's code may take longer. Decisions within
            a step have separate guards.
    """

    def __init__(self, hang_limit: float) -> None:
        super().__init__(patience_with_world(hang_limit))
        # as for decisions, because the timer may still run when the next decision starts
        self.silence = hang_limit

    @contextmanager
    def call(self) -> Iterator[None]:
        """Guard a call of the environment in a ``with`` block.

        Raises:
            WorldHang: if the call does not return in time.
            OutOfTime: if the search has run out of time.
        """
        try:
            with self.decision():
                yield
        except AdsHang as error:
            self.decision_ends()
            message = f"{_interrupted_method(error)} did not return within {self.limit:g} s and was interrupted"
            raise WorldHang(message).with_traceback(error.__traceback__) from None

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Exclude other code, in a ``with`` block, from the time of the guarded call."""
        started, now = self.started, self.clock()
        self.decision_ends()
        try:
            yield
        finally:
            if started is not None:
                self.started = started + self.clock() - now

    def is_stuck(self) -> bool:
        started = self.started
        return started is not None and self.clock() - started > self.limit + IGNORED


def _interrupted_method(error: AdsHang) -> str:
    # Prefer the user's innermost method, because a wrapper in an endless loop spends most of its time in the
    # environment.
    found = "the environment"
    is_own = False
    for frame, _ in traceback.walk_tb(error.__traceback__):
        env = frame.f_locals.get("self")
        name = frame.f_code.co_name
        library = str(frame.f_globals.get("__name__")).partition(".")[0]
        is_users = library not in ("gymnasium", "highway_env")
        if isinstance(env, gymnasium.Env) and not name.startswith("<") and (is_users or not is_own):
            found = f"{type(env).__name__}.{name}"
            is_own = is_users
    return found


@dataclass(frozen=True, eq=False)
class GymEnvironment:
    """The environment of a world, created at its first use.

    Attributes:
        env_id: id of the registered environment.
        config: the user's configuration. None for the registered configuration.
        wrappers: the user's wrappers. None if the policy must see the environment without wrappers.
        hang_limit: time limit [s] for a decision in the world.
    """

    env_id: str
    config: dict[str, Any] | None
    wrappers: Sequence[Callable[[Any], Any]] | None
    hang_limit: float

    @contextmanager
    def in_time(self) -> Iterator[None]:
        """Guard a call of an environment outside a run, in a ``with`` block.

        Raises:
            WorldError: if the call does not return in time.
        """
        try:
            with EnvironmentGuard(self.hang_limit) as guard, guard.call():
                yield
        except WorldHang as error:
            raise refused_environment(
                "an environment whose methods return in time",
                f"one in which {error}",
                "correct the environment, or increase the world's hang_limit",
            ) from error

    def make(self, *, has_traffic: bool = False) -> Any:
        """Create an environment, including all its wrappers, with or without random traffic.

        If a user's environment cannot be reset without other vehicles, it keeps them at first. NPCs then replace them.
        """
        # First reject an environment that would take minutes to create.
        creator = _creator(self.env_id)
        given = self.config or {}
        # A function can return an environment of any class, which is only known after the call below.
        if isinstance(creator, type):
            _check_base(self.env_id, creator)
        _check_sizes(given, creator)
        # In episodes with its own traffic, an environment keeps the constants that it changes, as in its __init__.
        kept: Any = nullcontext({})
        if not has_traffic:
            kept = vehicle_classes_kept()
        try:
            with kept as changed, self.in_time():
                env = _make_environment(
                    self.env_id, creator, self._given_config, has_traffic=has_traffic
                )
            self._changed.update(changed)
        except WorldError:
            raise
        except Exception as error:
            # highway-env's own environments need no traffic. With too much traffic, a second attempt would take long.
            is_much = any(_exceeded("vehicles_count", given.get(name)) for name in REPLACED)
            if not (has_traffic or of_highway_env(creator) or is_much):
                return self.make(has_traffic=True)
            field, received = "config", f"{self.config!r:.200}"
            expected = f"a configuration that the environment {self.env_id} accepts"
            if not given:
                field, received = "env_id", repr(self.env_id)
                expected = (
                    "an environment that can be created with gymnasium.make and reset with seed 0"
                )
            raise WorldError(
                field=field,
                expected=expected,
                received=received,
                fix=f"the environment raised {type(error).__name__}: {error!s:.200}",
            ) from error
        # Now the class is known, and the default configuration with it.
        _check_base(self.env_id, type(env.unwrapped))
        _check_config(self.env_id, given, env.unwrapped)
        # Without these wrappers, the policy might not receive the observations that it was made for.
        added = wrapper_names(env)
        if self.wrappers is None and added:
            raise refused_environment(
                "an environment that is registered without wrappers",
                f"{self.env_id!r}, which is registered with these wrappers: {', '.join(added)}",
                f"to use these wrappers, write pafot.World({self.env_id!r}, wrappers=[]), with any additional "
                "wrappers in the list",
            )
        with self.in_time():
            return _wrap(env, self.wrappers or ())

    @cached_property
    def _changed(self) -> dict[Any, dict[str, Any]]:
        # The constants that the environment sets in highway-env's vehicle classes, by class.
        return {}

    @cached_property
    def outer(self) -> Any:
        """The environment in its wrappers, after a reset in which the wrappers may have changed the configuration."""
        outer = self.make()
        has_wrappers = bool(wrapper_names(outer))
        if has_wrappers:
            env = outer.unwrapped
            # A wrapper that sets the configuration in its reset must not bring the traffic back.
            without_traffic = {name: env.config[name] for name in REPLACED if name in env.config}
            with vehicle_classes_kept():
                self._can_reset(outer)
                env.config |= without_traffic
                env.reset(seed=0)
        if has_wrappers or not of_highway_env(type(outer.unwrapped)):
            self._check_resets()
        return outer

    def _can_reset(self, outer: Any) -> bool:
        """Reset an environment in its wrappers, and return False if it raises an error."""
        try:
            with self.in_time():
                outer.reset(seed=0)
        except WorldError:
            raise
        except UNFIT as error:  # in a run, this is a failure of the first decision
            let_through(error)
            return False
        return True

    def _check_resets(self) -> None:
        # If resets with the same seed differ, for example because they count episodes, runs cannot be repeated.
        outer = self.make()
        names = wrapper_names(outer)
        resets = RESETS_IN_WRAPPERS
        first: dict[str, str] = {}  # the wrappers have not been reset yet
        if not names:
            resets = RESETS
            first = _beginning(outer)
        for _ in range(resets):
            with vehicle_classes_kept():
                if not self._can_reset(outer):
                    return
            found = _beginning(outer)
            first = first or found
            for name in {**first, **found}:
                if first.get(name) == found.get(name):
                    continue
                was = first.get(name, "none")[:60]
                now = found.get(name, "none")[:60]
                who = " in ".join([type(outer.unwrapped).__name__, *names])
                raise refused_environment(
                    "an environment whose resets depend only on the seed, so that runs can be repeated",
                    f"{who}, where {name} is {was} after the first reset and {now} after a later one",
                    "does it count its resets, or draw random numbers without using the seed? If the difference "
                    "is intended, make it an option in config= and set a value in each test",
                )

    @property
    def wrapper_names(self) -> list[str]:
        """The class names of the wrappers, including registered wrappers, with the innermost first."""
        return wrapper_names(self.outer)

    @property
    def unwrapped(self) -> Any:
        """The environment without wrappers or traffic. Runs do not change it."""
        return self.outer.unwrapped

    @property
    def is_stock(self) -> bool:
        """True if the environment's class is one of highway-env's."""
        return of_highway_env(type(self.unwrapped))

    @cached_property
    def straight_road(self) -> StraightRoad | None:
        return straight_road(self.unwrapped.road.network)

    @cached_property
    def obstacles(self) -> tuple[FixedObject, ...]:
        """The x [m], y [m], heading [rad], length [m] and width [m] of each solid object on the road."""
        return obstacles_of(self.unwrapped)

    @cached_property
    def network(self) -> Any:
        return SearchedLanes(self.unwrapped.road.network)

    @cached_property
    def traffic(self) -> TrafficClass:
        """The vehicle class that the environment's code expects NPCs to have.

        Raises:
            WorldError: if the NPCs cannot have this class.
        """
        default = "highway_env.vehicle.behavior.IDMVehicle"
        given = self.unwrapped.config.get("other_vehicles_type", default)
        road = self.road(np.random.default_rng(0))
        # The class is tried on a road with the ego, as in a run.
        road.vehicles = [self.unwrapped.vehicle]
        try:
            with vehicle_classes_kept(), self.in_time():
                return traffic_class(given, road, self._changed)
        except WorldError:
            raise
        except UNFIT as error:
            let_through(error)
            raise WorldError(
                field="config.other_vehicles_type",
                expected="a highway-env vehicle class that can be called with (road, position, heading, speed), and "
                "whose vehicles a run can move, because the NPCs are objects of this class",
                received=f"{given!r:.200} ({type(error).__name__}: {error!s:.200})",
                fix=f"correct the class, or set the option to a different class, such as {default!r}",
            ) from error

    def road(self, np_random: Any = None) -> Any:
        """Return a new road without vehicles or objects, for one run."""
        own = self.unwrapped.road
        road_class: Any = Road
        if type(own) is RegulatedRoad:
            road_class = EgosRegulatedRoad
        made = road_class(
            self.network,
            np_random=np_random,
            neighbour_vehicles_connected_lanes=self.unwrapped.config.get(CONNECTED, False),
        )
        if road_class is EgosRegulatedRoad:
            # a reset has done some steps, and the count decides when rules are enforced next
            made.steps = own.steps
        return made

    @cached_property
    def compiled_lanes(self) -> StraightRoad | Network | None:
        """The road in the kernel's form, or None if the kernel does not support one of its lanes."""
        road = self.straight_road
        if road is not None and road.starts_at_origin:
            return road
        return compiled_network(self.unwrapped.road.network)

    @property
    def route(self) -> tuple[Any, ...] | None:
        """The ego's planned route, or None if it has none or the road is straight."""
        # On a straight road, runs need none.
        route = getattr(self.unwrapped.vehicle, "route", None)
        if route is None or self.straight_road is not None:
            return None
        return tuple(route)

    def steps_itself(self, *, drives_itself: bool) -> bool:
        """Return whether runs must call the environment's ``step``, because user code overrides it or ``road.step``."""
        road = self.unwrapped.road
        steps = type(road) is not RegulatedRoad and type(road).step is not Road.step
        has_own_road = steps or "step" in vars(road) or has_own_act(road)
        return has_own_road or (self.has_own_step and not drives_itself)

    @property
    def has_own_step(self) -> bool:
        cls: Any = type(self.unwrapped)
        # The `step` of these two classes only adds vehicles or information, which runs do not need.
        is_stock = cls.step in (AbstractEnv.step, IntersectionEnv.step, ExitEnv.step)
        return not is_stock or cls._simulate is not AbstractEnv._simulate

    @property
    def may_repeat_actions(self) -> bool:
        # A user's `step` may simulate an action several times.
        return self.has_own_step and not of_highway_env(type(self.unwrapped).step)

    @cached_property
    def own_ends(self) -> tuple[str, ...]:
        """The methods with which the environment can end an episode before the run is over.

        Regardless of them, a run ends at a contact, at the end of its duration or, on a curved road, when the ego
        leaves the road.
        """
        found = []
        cls = type(self.unwrapped)
        # A HighwayEnv also ends when the ego leaves the straight road, but only with this option.
        ended_anyway: tuple[str, ...] = ENDED_ANYWAY
        if not self.unwrapped.config.get("offroad_terminal"):
            ended_anyway = (*ENDED_ANYWAY, "HighwayEnv")
        for name in ENDS:
            method = getattr(cls, name)  # in a user's class, it need not be a function
            owner = getattr(method, "__qualname__", "").partition(".")[0]
            is_early = name == "_is_terminated" and owner not in ended_anyway
            if is_early or not of_highway_env(method):
                found.append(name)
        return tuple(found)

    @cached_property
    def step_limit(self) -> int | None:
        """The step limit of gymnasium's ``TimeLimit`` for an episode, or None if there is no limit.

        A ``TimeLimit`` around other wrappers is ignored here, because these wrappers may repeat steps.
        """
        inner = itertools.takewhile(lambda each: type(each) in NEUTRAL, wrappers_of(self.outer))
        limits = [each._max_episode_steps for each in inner if isinstance(each, TimeLimit)]
        return min(limits, default=None)

    @property
    def has_own_ends(self) -> bool:
        """True if an episode can end before the run has reached its duration.

        This includes all environments with a user's ``step``, because the return value of ``step`` is not known in
        advance.
        """
        has_limit = self.step_limit is not None
        return bool(self.own_ends) or has_limit or self.has_own_step or self.sets_ends

    @cached_property
    def ends_in_steps(self) -> bool:
        """True if runs must call ``step`` to find out whether an episode has ended.

        This is the case if a wrapper, a step limit around other wrappers, or the environment's own ``step`` can end it.
        """
        others = itertools.dropwhile(lambda each: type(each) in NEUTRAL, wrappers_of(self.outer))
        return self.has_own_step or any(
            isinstance(each, TimeLimit) or not type(each).step.__module__.startswith("gymnasium.")
            for each in others
        )

    @cached_property
    def sets_ends(self) -> bool:
        # True if methods of `ENDS` are attributes of the object itself. Its copies would call the original's methods.
        return any(name in vars(self.unwrapped) for name in ENDS)

    @cached_property
    def own_state(self) -> tuple[str, ...]:
        """The names of attributes that the environment's code can change in place.

        Each run gets copies of the values, except for objects of libraries and values that cannot be copied.
        """
        env = self.unwrapped
        found = []
        known = {id(each): each for each in (env, env.road, env.vehicle)}
        # The packages of the user's classes. Objects of other packages are assumed not to change.
        homes = {each.__module__.partition(".")[0] for each in type(env).__mro__}
        homes -= {"highway_env", "gymnasium", "builtins"}
        for name, value in vars(env).items():
            home = type(value).__module__.partition(".")[0]
            is_own = isinstance(value, MUTABLE) or home in homes
            if is_own and name not in (*WITH_EGO, "config"):
                with suppress(Exception):
                    copy.deepcopy(value, {**known})
                    found.append(name)
        return tuple(found)

    def episodes_itself(self, *, drives_itself: bool) -> bool:
        """Return whether each run must be an episode of the environment, because of its ``step`` or ``reset``."""
        # For an ego that drives itself, the environment's own `reset` does not matter.
        resets_itself = type(self.unwrapped).reset is not AbstractEnv.reset
        is_its_own = resets_itself or self.sets_ends
        return self.steps_itself(drives_itself=drives_itself) or (is_its_own and not drives_itself)

    @cached_property
    def left_out(self) -> dict[str, tuple[str, ...]]:
        """The user's reward, info and end methods that change attributes, with the names of these attributes.

        Runs that are not episodes of the environment do not call them.
        """
        found = dict[str, tuple[str, ...]]()
        cls = type(self.unwrapped)
        # highway-env's own methods change nothing that a run reads.
        own = [name for name in LEFT_OUT if not of_highway_env(getattr(cls, name))]
        if not own:
            return found
        env = self.make().unwrapped
        seen = env.observation_type.observe()
        action = env.action_space.sample()
        for name in own:
            given: tuple[Any, ...] = (action,)
            if name == "_info":
                given = (seen, action)
            elif name in ENDS:
                given = ()
            before = _plain_state(env)
            with suppress(Exception), self.in_time():  # an episode would report the error
                getattr(env, name)(*given)
            after = _plain_state(env)
            changed = [key for key in after if after[key] != before.get(key)]
            # This call may not have reached every assignment.
            changed += [key for key in _assigned(cls, name) if key not in changed]
            if changed:
                found[name] = tuple(changed)
        return found

    def check_keeps_no_ego(self) -> None:
        """Reject an environment if, during a run, its code keeps using the ego that its reset created.

        Raises:
            WorldError: if the run's ego does not replace that ego everywhere.
        """
        if self._keeper:
            raise refused_environment(
                "an environment that accesses its ego only through self.vehicle",
                f"{type(self.unwrapped).__name__}, whose `{self._keeper}` still has the ego of the last reset",
                "read self.vehicle each time, because every run has a new ego",
            )

    @cached_property
    def _keeper(self) -> str:
        # The name of a collection or helper that contains the environment's ego. A run replaces this ego only in
        # attributes of the environment itself.
        env = self.unwrapped
        for name, value in vars(env).items():
            if name in WITH_EGO or value is env.vehicle:
                continue
            # The items of a collection, or the attributes of a helper object.
            parts = value
            if not isinstance(value, (list, tuple, set)):
                parts = getattr(value, "__dict__", value)
            if isinstance(parts, Mapping):
                parts = parts.values()
            if isinstance(parts, Collection) and any(each is env.vehicle for each in parts):
                return str(name)
        return ""

    def without_effect(
        self, *, is_planner: bool, drives_itself: bool, simulates: bool, ends: bool
    ) -> dict[str, list[str]]:
        """Return the options that have no effect in a search, grouped by reason.

        Args:
            is_planner: whether the ego decides in SI units.
            drives_itself: whether the ego is a vehicle class, which may react to other vehicles as IDM does.
            simulates: whether the policy receives the environment, with vehicles of the traffic class.
            ends: whether the environment can end runs.
        """
        given = self.config or {}
        is_straight = self.straight_road is not None
        # Both decide without the environment.
        has_own_policy = is_planner or drives_itself
        traffic = set(TRAFFIC_OPTIONS)
        if not (drives_itself or simulates):
            traffic.add(CONNECTED)
        if not has_own_policy or (ends and not self.is_stock):
            traffic.remove("other_vehicles_type")  # NPCs have this class in the environment's code
        found: dict[str, list[str]] = {}
        for name, value in given.items():
            if name in traffic:
                told = "NPCs replace the environment's own traffic"
            elif name in POLICY_OPTIONS and has_own_policy:
                told = "the ego decides without the environment's observations and actions"
            elif name == "ego_spacing" and is_straight:
                told = "the world's headway= sets the gaps at the start"
            elif name == "initial_lane_id" and is_straight and value is not None:
                told = f"write ego_lane={value!r:.20}"
            elif name == "offroad_terminal" and is_straight and value and not ends:
                told = (
                    "runs continue after the ego leaves a straight road, which run.off_road reports"
                )
            elif name in ("offroad_terminal", "terminate_off_road") and not (is_straight or value):
                told = "runs on this road end when the ego leaves it"
            else:
                continue
            found.setdefault(told, []).append(name)
        return found

    @property
    def whole_config(self) -> dict[str, Any]:
        """All JSON-compatible options of the environment, with the original values of the traffic options."""
        env = self.unwrapped
        values = {**env.default_config(), **self._given_config}
        config: dict[str, Any] = {}
        for name, value in values.items():
            if name in env.config and name not in REPLACED:
                value = env.config[name]  # noqa: PLW2901  (what the environment or a wrapper has set)
            # Objects such as classes cannot be saved. A replay has the environment's own values of them.
            with suppress(WorldError):
                config[name] = plain_data(f"config.{name}", value)
        return config

    @property
    def _given_config(self) -> dict[str, Any]:
        # As in gymnasium, the user's configuration replaces the registered one.
        if self.config is not None:
            return self.config
        registered: dict[str, Any] = gymnasium.registry[self.env_id].kwargs.get("config") or {}
        return registered


def _plain_state(env: Any) -> dict[str, str]:
    values = {**vars(env)}
    values |= {f"vehicle.{name}": value for name, value in vars(env.vehicle).items()}
    return {name: repr(value) for name, value in values.items() if isinstance(value, PLAIN)}


def _beginning(outer: Any) -> dict[str, str]:
    # The values that a run reads from an environment after a reset, as strings by name.
    env = outer.unwrapped
    found = {}
    for name, value in env.config.items():
        if name not in (*TRAFFIC_OPTIONS, *REPLACED):
            found[f"config[{name!r}]"] = repr(value)
    for index, lane in env.road.network.lanes_dict().items():
        # Three points are enough to notice a changed lane.
        points = [lane.position(share * lane.length, 0).tolist() for share in (0.0, 0.5, 1.0)]
        found[f"lane {index}"] = repr((points, lane.width_at(0), lane.speed_limit))
    found["road.objects"] = repr(obstacles_of(env))
    ego = env.vehicle
    if ego is not None:
        state = (*ego.position, ego.heading, ego.speed)
        place = ", ".join(str(round(float(each), 6)) for each in state)
        found["vehicle"] = f"{type(ego).__name__} at {place}"
        found["vehicle.target_speeds"] = repr(getattr(ego, "target_speeds", None))
    for name in ("observation_space", "action_space"):
        found[name] = repr(getattr(outer, name))
    return found


def _assigned(cls: Any, name: str) -> list[str]:
    # The attributes that a method assigns, directly or through other methods of its object; none without source code.
    found = dict[str, None]()
    names = [name]
    for called in names:
        for base in cls.__mro__:
            function = vars(base).get(called)
            if not isinstance(function, FunctionType) or of_highway_env(function):
                continue
            with suppress(OSError, SyntaxError):
                source = textwrap.dedent(inspect.getsource(function))
                for node in ast.walk(ast.parse(source)):
                    place = node
                    if isinstance(node, ast.Subscript):
                        place = node.value  # an assignment to an item changes the attribute
                    is_stored = isinstance(getattr(node, "ctx", None), ast.Store)
                    if is_stored and isinstance(place, ast.Attribute):
                        found[ast.unparse(node).removeprefix("self.")] = None
                    if isinstance(node, ast.Call):
                        method = ast.unparse(node.func)
                        own = method.removeprefix("self.")
                        if own != method and own not in names:
                            names.append(own)
    return list(found)


def put_ego(env: Any, ego: Any) -> None:
    """Make ``ego`` the only vehicle in an environment, instead of the ego that a reset has created.

    ``ego`` gets the attributes that the environment has added to its own ego, such as a goal.
    """
    own = env.vehicle
    for name, value in vars(own).items():
        if name not in OF_HIGHWAY_ENV and not hasattr(ego, name):
            setattr(ego, name, value)
    for name in [name for name, value in vars(env).items() if value is own]:
        setattr(env, name, ego)
    env.road.vehicles = [ego]
    env.controlled_vehicles = [ego]
    env.define_spaces()


def obstacles_of(env: Any) -> tuple[FixedObject, ...]:
    """Return the x [m], y [m], heading [rad], length [m] and width [m] of each solid object on a road."""
    found = []
    for each in env.road.objects:
        if each.solid:
            place = (*each.position, each.heading, each.LENGTH, each.WIDTH)
            x, y, heading, length, width = map(float, place)
            found.append((x, y, heading, length, width))
    return tuple(found)


def of_highway_env(definition: Any) -> bool:
    """Return whether a class or function is defined in highway-env."""
    return str(getattr(definition, "__module__", "")).startswith("highway_env.")


def refused_environment(expected: str, received: str, fix: str) -> WorldError:
    """Return the error to raise for an environment in which scenarios cannot run."""
    return WorldError(
        field="env_id",
        expected=expected,
        received=received,
        fix=fix,
    )


def has_own_act(road: Any) -> bool:
    """Return whether a user's ``act`` controls the vehicles on a road."""
    return type(road).act is not Road.act or "act" in vars(road)


def wrapper_names(env: Any) -> list[str]:
    """Return the class names of an environment's wrappers, except those in ``NEUTRAL``, with the innermost first."""
    return [type(each).__name__ for each in wrappers_of(env) if type(each) not in NEUTRAL]


def wrappers_of(env: Any) -> list[Any]:
    """Return all wrappers of an environment, with the innermost first."""
    found = []
    while isinstance(env, gymnasium.Wrapper):
        found.append(env)
        env = env.env
    return found[::-1]


@contextmanager
def vehicle_classes_kept() -> Iterator[dict[Any, dict[str, Any]]]:
    """Undo the changes that a ``with`` block makes to the constants of highway-env's vehicle classes.

    After the block, the yielded mapping contains the changed constants of each class.
    """
    before: dict[Any, dict[str, Any]] = {}
    queue: list[Any] = [Vehicle]
    # A class with several bases is found more than once.
    for cls in queue:
        if cls not in before:
            before[cls] = _constants(cls)
            queue += cls.__subclasses__()
    changed = dict[Any, dict[str, Any]]()
    try:
        yield changed
    finally:
        for cls, constants in before.items():
            now = _constants(cls)
            own = {name: value for name, value in now.items() if value is not constants.get(name)}
            if own:
                changed[cls] = own
            for name in now.keys() - constants:
                delattr(cls, name)
            for name, value in constants.items():
                if vars(cls)[name] is not value:
                    setattr(cls, name, value)


def _constants(cls: Any) -> dict[str, Any]:
    return {name: value for name, value in vars(cls).items() if name.isupper()}


def _wrap(env: Any, wrappers: Sequence[Callable[[Any], Any]]) -> Any:
    outer = env
    for index, wrapper in enumerate(wrappers):
        expected = f"wrappers[{index}]: expected a callable that takes an environment and returns it wrapped"
        try:
            outer = wrapper(outer)
        except Exception as error:
            received = f"{wrapper!r:.200}, which raised {type(error).__name__}: {error}"
            raise WorldError(f"{expected}, received {received}") from error
        # A wrapper may also have created an environment of its own, without the configuration.
        if not isinstance(outer, gymnasium.Env) or outer.unwrapped is not env.unwrapped:
            raise WorldError(
                f"{expected}, received {wrapper!r:.200}, which returned {outer!r:.200}"
            )
    return outer


def _creator(env_id: str) -> Any:
    # Returns the class of a registered environment, or the function that makes it.
    if env_id not in gymnasium.registry:
        known = sorted(name for name in gymnasium.registry if name.startswith("highway"))
        accepted = []
        for name, spec in gymnasium.registry.items():
            home = spec.entry_point
            if not isinstance(home, str):
                home = home.__module__
            if not home.startswith("gymnasium."):  # they would be rejected
                accepted.append(name)
        meant = ""
        for near in difflib.get_close_matches(env_id, accepted, n=1):
            meant = f"did you mean {near!r}? "
        raise refused_environment(
            "a registered environment",
            repr(env_id),
            f"{meant}highway-env's straight roads are in {' and '.join(known)}. To use your own environment, first "
            f"import the module that registers it, as `--world module:id` does, or write {OTHER_KIND}",
        )
    entry_point = gymnasium.registry[env_id].entry_point
    if isinstance(entry_point, str):
        return load_env_creator(entry_point)
    return entry_point


def _check_base(env_id: str, cls: type[Any]) -> None:
    if not issubclass(cls, AbstractEnv):
        raise refused_environment(
            "an environment derived from highway-env's AbstractEnv",
            f"{env_id!r} ({cls.__name__})",
            f"write {OTHER_KIND}",
        )


def _check_sizes(config: dict[str, Any], creator: Any) -> None:
    """Reject values of known options with which highway-env would compute for minutes."""
    # The package sets these options itself, so their values do not matter.
    given = {name: value for name, value in config.items() if name not in REPLACED}
    for name, bounds in (("simulation_frequency", PHYSICS_HZ), ("policy_frequency", ADS_HZ)):
        if name in given:
            whole_within(f"config.{name}", given[name], *bounds)
    # In a user's environment, an option such as `length` can have another meaning.
    if not of_highway_env(creator):
        known = ("observation", "action", "scaling")
        given = {name: given[name] for name in known if name in given}
    _check_size("config", given)
    numbers = _numbers(given.get("observation"), config)
    if numbers > MOST_NUMBERS:
        raise WorldError(
            field="config.observation",
            expected=f"at most {MOST_NUMBERS:,} numbers",
            received=f"about {numbers:,.0f}",
            fix="use fewer features, parts or images, or larger cells",
        )


def _check_size(place: str, config: Any) -> None:
    if isinstance(config, (list, tuple)):
        for index, inner in enumerate(config):
            _check_size(f"{place}[{index}]", inner)
    if not isinstance(config, Mapping):
        return
    if config.get("type") == "OccupancyGrid":
        cells = _cells(config)
        # `not <=` also rejects NaN.
        if not cells <= MOST_CELLS:
            received = f"{cells:,.0f} cells"
            if cells == math.inf:
                received = "infinitely many cells"
            raise WorldError(
                field=f"{place}.grid_step",
                expected=f"at most {MOST_CELLS:,} cells",
                received=received,
            )
    for name, value in config.items():
        limit = _exceeded(name, value)
        if limit:
            raise WorldError(
                field=f"{place}.{name}",
                expected=f"{limit}, so that the environment can be created within seconds",
                received=f"{value!r:.100}",
            )
        _check_size(f"{place}.{name}", value)


def _exceeded(name: str, value: Any) -> str:
    """Describe the limit that an option's value, or an item of its list, exceeds, or return an empty string."""
    entries = _listed(value)
    numbers = [abs(each) for each in entries if isinstance(each, (int, float))]
    if _length(value, 0) > LONGEST.get(name, math.inf):
        return f"at most {LONGEST[name]} entries"
    # a matrix would make one image per column
    if name == "weights" and len(numbers) < len(entries):
        return "one number for each colour"
    if any(each > LARGEST.get(name, math.inf) for each in numbers):
        return f"at most {LARGEST[name]:g}"
    if any(0 < each < SMALLEST.get(name, 0) for each in numbers):
        return f"at least {SMALLEST[name]:g}"
    return ""


def _listed(value: Any) -> Sequence[Any]:
    if isinstance(value, (list, tuple)):
        return value
    return [value]


def _length(value: Any, default: int) -> int:
    if isinstance(value, (list, tuple, str, Mapping)):
        return len(value)
    return default


def _cells(grid: Mapping[str, Any]) -> float:
    size = grid.get("grid_size")
    step = grid.get("grid_step")
    # highway-env's defaults
    if size is None:
        size = ((-27.5, 27.5), (-27.5, 27.5))
    if step is None:
        step = (5.0, 5.0)
    try:
        (low_x, high_x), (low_y, high_y) = size
        x, y = step
        return float(abs((high_x - low_x) / x) * abs((high_y - low_y) / y))
    except (TypeError, ValueError, ArithmeticError):
        return math.inf


def _numbers(observation: Any, config: Mapping[str, Any]) -> float:
    # An estimate that ignores the sizes of observations that other limits restrict.
    if not isinstance(observation, Mapping):
        return 0.0
    inner = 0.0
    # Observations can consist of others.
    parts = observation.get("observation_configs") or [observation.get("observation_config")]
    if isinstance(parts, (list, tuple)):
        inner = sum(_numbers(part, config) for part in parts)
    own = 0.0
    kind = observation.get("type")
    if kind == "OccupancyGrid":
        own = _cells(observation) * _length(observation.get("features"), 4)
    elif kind == "GrayscaleObservation":
        own = _product(observation.get("observation_shape"), observation.get("stack_size"))
    elif kind == "TimeToCollision":
        speeds = None
        action = config.get("action")
        if isinstance(action, Mapping):
            speeds = action.get("target_speeds")
        own = _product(
            observation.get("horizon", 10),
            config.get("policy_frequency", 15),
            config.get("lanes_count", 4),
            _length(speeds, 3),
        )
    return inner + max(own, LEAST_NUMBERS)


def _product(*values: Any) -> float:
    numbers = [each for value in values for each in _listed(value)]
    return math.prod(min(abs(each), 1e9) for each in numbers if isinstance(each, (int, float)))


def _check_config(env_id: str, given: dict[str, Any], env: Any) -> None:
    default = env.default_config()
    unknown = sorted(set(given) - set(default))
    if unknown:
        raise WorldError(
            field="config",
            expected=f"options of {env_id}",
            received=", ".join(unknown),
            fix=_hint(unknown[0], default),
        )
    for name, value in given.items():
        # it would fail during a run
        if isinstance(value, str) and isinstance(default[name], (int, float)):
            raise _refused_option(name, f"a number such as {default[name]!r}", value)
    egos = env.config.get("controlled_vehicles", 1)
    if egos != 1:
        fix = "all other vehicles are NPCs"
        raise _refused_option("controlled_vehicles", "1, the ego", egos, fix)
    manual = env.config.get("manual_control")
    if manual:
        expected = "False, because the policy drives"
        raise _refused_option("manual_control", expected, manual, "omit this option")
    for name, module in (("observation", observation), ("action", action)):
        kind = getattr(env, f"{name}_type", None)
        # options of other classes are not known
        if name in given and type(kind).__module__ == module.__name__:
            known = {*_options(module), *default.get(name, ())}
            _check_names(f"config.{name}", given[name], known)


def _refused_option(name: str, expected: str, value: object, fix: str = "") -> WorldError:
    return WorldError(
        field=f"config.{name}",
        expected=expected,
        received=repr(value),
        fix=fix,
    )


def _check_names(place: str, given: Any, known: Collection[str]) -> None:
    """Reject options of observations and actions that highway-env would ignore, including nested options."""
    if isinstance(given, list):
        for index, inner in enumerate(given):
            _check_names(f"{place}[{index}]", inner, known)
    if not isinstance(given, Mapping):
        return
    for name in given:
        if name not in known:
            raise WorldError(
                field=place,
                expected="a highway-env option",
                received=str(name),
                fix=_hint(name, known),
            )
        if name in NESTED:
            _check_names(f"{place}.{name}", given[name], known)


def _hint(name: str, known: Collection[str]) -> str:
    for near in difflib.get_close_matches(name, known, n=1):
        return f"did you mean {near!r}?"
    return f"the options are {', '.join(sorted(known))}"


def _options(module: Any) -> set[str]:
    # Each class also accepts the options of all other classes, and highway-env's configurations rely on that.
    options = {"type", "flatten"}  # intersection-v0 has "flatten", which no class uses
    for each in vars(module).values():
        # Imported classes, such as those of numpy, are no kinds of observations.
        if inspect.isclass(each) and each.__module__ == module.__name__:
            options |= set(inspect.signature(each).parameters)
    return options - {"env", "kwargs"}


def _make_environment(
    env_id: str, creator: Any, given: dict[str, Any], *, has_traffic: bool
) -> Any:
    # Reset with seed 0, because the road and the start may be random.
    known = {}
    if hasattr(creator, "default_config"):
        known = creator.default_config()
    config = _as_known(_with_tuples(given), known)
    if not has_traffic:
        config["vehicles_count"] = 0
        config |= {name: 0 for name in TRAFFIC if name in known}
    # An environment that cannot be created with a configuration may have a method for it.
    parameters = inspect.signature(creator).parameters
    takes_any = any(each.kind is each.VAR_KEYWORD for each in parameters.values())
    takes_config = takes_any or "config" in parameters
    keywords: dict[str, Any] = {}
    if takes_config:
        keywords["config"] = config
    with warnings.catch_warnings():  # a user who chose merge-v0 needs no warning in every run
        warnings.filterwarnings("ignore", message=".*is out of date", category=DeprecationWarning)
        env: Any = gymnasium.make(env_id, disable_env_checker=True, **keywords)
    unwrapped: Any = env.unwrapped
    if not takes_config and hasattr(unwrapped, "configure"):
        unwrapped.configure(config)
    if getattr(unwrapped, "road", None) is not None:
        unwrapped.reset(seed=0)
    return env


def _as_known(config: dict[str, Any], known: Mapping[str, Any]) -> dict[str, Any]:
    """Replace a value that is equivalent to the environment's default, such as a list for a tuple, with the default."""
    replaced = {**config}
    for name in config.keys() & known:
        with suppress(WorldError):
            # Compared as data, because a file has lists in place of tuples and arrays.
            default = plain_data(name, known[name])
            if repr(plain_data(name, config[name])) == repr(default):
                replaced[name] = known[name]
    return replaced


def _with_tuples(config: Any) -> Any:
    """Copy a configuration, with tuples where highway-env requires them."""
    if isinstance(config, list):
        return [_with_tuples(item) for item in config]
    if not isinstance(config, dict):
        return config
    copied = {key: _with_tuples(item) for key, item in config.items()}
    if isinstance(copied.get("observation_shape"), list):
        copied["observation_shape"] = tuple(copied["observation_shape"])
    return copied
