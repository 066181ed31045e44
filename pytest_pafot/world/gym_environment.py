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
from pytest_pafot.world.guard.hang_guard import (
    UNFIT,
    AdsHang,
    HangGuard,
    WorldHang,
    let_through,
    patience_with_world,
)
from pytest_pafot.world.kernel.lane_network import Network
from pytest_pafot.world.limits import (
    ADS_HZ,
    CONNECTED,
    OTHER_KIND,
    PHYSICS_HZ,
    plain_data,
    whole_within,
)
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
RESETS, RESETS_IN_WRAPPERS = 10, 4

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
    found, is_own = "the environment", False
    for frame, _ in traceback.walk_tb(error.__traceback__):
        env, name = frame.f_locals.get("self"), frame.f_code.co_name
        is_users = str(frame.f_globals.get("__name__")).partition(".")[0] not in (
            "gymnasium",
            "highway_env",
        )
        if isinstance(env, gymnasium.Env) and not name.startswith("<") and (is_users or not is_own):
            found, is_own = f"{type(env).__name__}.{name}", is_users
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
            fix = "correct the environment, or increase the world's hang_limit"
            expected = "an environment whose methods return in time"
            raise WorldError(
                field="env_id", expected=expected, received=f"one in which {error}", fix=fix
            ) from error

    def make(self, *, has_traffic: bool = False) -> Any:
        """Create an environment, including all its wrappers, with or without random traffic.

        If a user's environment cannot be reset without other vehicles, it keeps them at first. NPCs then replace them.
        """
        # First reject an environment that would take minutes to create.
        creator, given = _creator(self.env_id), self.config or {}
        if isinstance(creator, type):
            _check_base(self.env_id, creator)
        _check_sizes(given, creator)
        try:
            # In episodes with its own traffic, an environment keeps the constants that it changes, as in its __init__.
            kept: Any = nullcontext({}) if has_traffic else vehicle_classes_kept()
            with kept as changed, self.in_time():
                env = _make_environment(
                    self.env_id, creator, self._given_config, has_traffic=has_traffic
                )
            self._changed.update(changed)
        except WorldError:
            raise
        except Exception as error:
            # highway-env's own environments need no traffic. With too much traffic, a second attempt would take long.
            is_stock = str(getattr(creator, "__module__", "")).startswith("highway_env.")
            is_much = any(_exceeded("vehicles_count", given.get(name)) for name in REPLACED)
            if not (has_traffic or is_stock or is_much):
                return self.make(has_traffic=True)
            field, received = "config", f"{self.config!r:.200}"
            expected = f"a configuration that the environment {self.env_id} accepts"
            if not given:
                field, received = "env_id", repr(self.env_id)
                expected = (
                    "an environment that can be created with gymnasium.make and reset with seed 0"
                )
            fix = f"the environment raised {type(error).__name__}: {error!s:.200}"
            raise WorldError(field=field, expected=expected, received=received, fix=fix) from error
        _check_base(self.env_id, type(env.unwrapped))
        _check_config(self.env_id, given, env.unwrapped)
        # Without these wrappers, the policy might not receive the observations that it was made for.
        added = wrapper_names(env)
        if self.wrappers is None and added:
            raise WorldError(
                field="env_id",
                expected="an environment that is registered without wrappers",
                received=f"{self.env_id!r}, which is registered with these wrappers: {', '.join(added)}",
                fix=f"to use these wrappers, write pafot.World({self.env_id!r}, wrappers=[]), with any additional "
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
        if wrapper_names(outer):
            env = outer.unwrapped
            without_traffic = {name: env.config[name] for name in REPLACED if name in env.config}
            with vehicle_classes_kept():
                try:
                    with self.in_time():
                        outer.reset(seed=0)
                except WorldError:
                    raise
                except UNFIT as error:  # in a run, this is a failure of the first decision
                    let_through(error)
                env.config |= without_traffic
                env.reset(seed=0)
        if wrapper_names(outer) or not type(outer.unwrapped).__module__.startswith("highway_env."):
            self._check_resets()
        return outer

    def _check_resets(self) -> None:
        # If resets with the same seed differ, for example because they count episodes, runs cannot be repeated.
        outer = self.make()
        names, resets = wrapper_names(outer), RESETS_IN_WRAPPERS if wrapper_names(outer) else RESETS
        first = {} if names else _beginning(outer)  # the wrappers have not been reset yet
        for _ in range(resets):
            with vehicle_classes_kept():
                try:
                    with self.in_time():
                        outer.reset(seed=0)
                except WorldError:
                    raise
                except UNFIT as error:  # in a run, this is a failure of the first decision
                    let_through(error)
                    return
            found = _beginning(outer)
            first = first or found
            changed = [name for name in {**first, **found} if first.get(name) != found.get(name)]
            if changed:
                who = " in ".join([type(outer.unwrapped).__name__, *names])
                was, now = (each.get(changed[0], "none")[:60] for each in (first, found))
                raise WorldError(
                    field="env_id",
                    expected="an environment whose resets depend only on the seed, so that runs can be repeated",
                    received=f"{who}, where {changed[0]} is {was} after the first reset and {now} after a later one",
                    fix="does it count its resets, or draw random numbers without using the seed? If the difference "
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

    @cached_property
    def straight_road(self) -> StraightRoad | None:
        return straight_road(self.unwrapped.road.network)

    @cached_property
    def obstacles(self) -> tuple[tuple[float, float, float, float, float], ...]:
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
        given = self.unwrapped.config.get(
            "other_vehicles_type", "highway_env.vehicle.behavior.IDMVehicle"
        )
        road = self.road(np.random.default_rng(0))
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
                fix="correct the class, or set the option to a different class, such as "
                "'highway_env.vehicle.behavior.IDMVehicle'",
            ) from error

    def road(self, np_random: Any = None) -> Any:
        """Return a new road without vehicles or objects, for one run."""
        own, connected = self.unwrapped.road, self.unwrapped.config.get(CONNECTED, False)
        made = (EgosRegulatedRoad if type(own) is RegulatedRoad else Road)(
            self.network, np_random=np_random, neighbour_vehicles_connected_lanes=connected
        )
        if isinstance(made, EgosRegulatedRoad):
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
    def config_of_wrappers(self) -> dict[str, Any]:
        """The configuration after a reset of the wrapped environment, or an empty dict if there are no wrappers."""
        return dict(self.unwrapped.config) if wrapper_names(self.outer) else {}

    @property
    def route(self) -> tuple[Any, ...] | None:
        """The ego's planned route, or None if it has none or the road is straight."""
        route = (
            getattr(self.unwrapped.vehicle, "route", None) if self.straight_road is None else None
        )
        return None if route is None else tuple(route)

    def steps_itself(self, *, drives_itself: bool) -> bool:
        """Return whether runs must call the environment's ``step``, because user code overrides it or ``road.step``."""
        road = self.unwrapped.road
        steps = type(road) is not RegulatedRoad and type(road).step is not Road.step
        has_own_road = steps or "step" in vars(road) or has_own_act(road)
        return has_own_road or (self.has_own_step and not drives_itself)

    @property
    def has_own_step(self) -> bool:
        cls: Any = type(self.unwrapped)
        is_stock = cls.step in (AbstractEnv.step, IntersectionEnv.step, ExitEnv.step)
        return not (is_stock and cls._simulate is AbstractEnv._simulate)

    @cached_property
    def own_ends(self) -> tuple[str, ...]:
        """The methods with which the environment can end an episode before the run is over.

        Regardless of them, a run ends at a contact, at the end of its duration or, on a curved road, when the ego
        leaves the road.
        """
        found, cls, config = [], type(self.unwrapped), self.unwrapped.config
        for name in ENDS:
            method = getattr(cls, name)  # in a user's class, it need not be a function
            owner = getattr(method, "__qualname__", "").partition(".")[0]
            by_crash = owner in ENDED_ANYWAY or (
                owner == "HighwayEnv" and not config.get("offroad_terminal")
            )
            is_stock = str(getattr(method, "__module__", "")).startswith("highway_env.")
            if not is_stock or (name == "_is_terminated" and not by_crash):
                found.append(name)
        return tuple(found)

    @cached_property
    def step_limit(self) -> int | None:
        """The step limit of gymnasium's ``TimeLimit`` for an episode, or None if there is no limit.

        A ``TimeLimit`` around other wrappers is ignored here, because these wrappers may repeat steps.
        """
        inner = itertools.takewhile(lambda each: type(each) in NEUTRAL, wrappers_of(self.outer))
        return min(
            (each._max_episode_steps for each in inner if isinstance(each, TimeLimit)), default=None
        )

    @property
    def has_own_ends(self) -> bool:
        """True if an episode can end before the run has reached its duration.

        This includes all environments with a user's ``step``, because the return value of ``step`` is not known in
        advance.
        """
        return (
            bool(self.own_ends)
            or self.step_limit is not None
            or self.has_own_step
            or self.sets_ends
        )

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
        env, found = self.unwrapped, []
        homes = {each.__module__.partition(".")[0] for each in type(env).__mro__} - {
            "highway_env",
            "gymnasium",
        }
        for name, value in vars(env).items():
            home = type(value).__module__.partition(".")[0]
            is_own = isinstance(value, MUTABLE) or (home in homes and home != "builtins")
            if not is_own or name in (*WITH_EGO, "config"):
                continue
            with suppress(Exception):
                copy.deepcopy(
                    value, {id(env): env, id(env.road): env.road, id(env.vehicle): env.vehicle}
                )
                found.append(name)
        return tuple(found)

    def episodes_itself(self, *, drives_itself: bool) -> bool:
        """Return whether each run must be an episode of the environment, because of its ``step`` or ``reset``."""
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
        own = [
            name
            for name in LEFT_OUT
            if not str(getattr(cls, name).__module__).startswith("highway_env.")
        ]
        if not own:
            return found
        env = self.make().unwrapped
        seen, action = env.observation_type.observe(), env.action_space.sample()
        for name in own:
            given = {"_info": (seen, action), "_is_terminated": (), "_is_truncated": ()}.get(
                name, (action,)
            )
            before = _plain_state(env)
            with suppress(Exception), self.in_time():  # an episode would report the error
                getattr(env, name)(*given)
            after = _plain_state(env)
            changed = [key for key in after if after[key] != before.get(key)]
            if changed := [*changed, *(key for key in _assigned(cls, name) if key not in changed)]:
                found[name] = tuple(changed)
        return found

    def check_keeps_no_ego(self) -> None:
        """Reject an environment if, during a run, its code keeps using the ego that its reset created.

        Raises:
            WorldError: if the run's ego does not replace that ego everywhere.
        """
        if self._keeper:
            raise WorldError(
                field="env_id",
                expected="an environment that accesses its ego only through self.vehicle",
                received=f"{type(self.unwrapped).__name__}, whose `{self._keeper}` still has the ego of the last reset",
                fix="read self.vehicle each time, because every run has a new ego",
            )

    @cached_property
    def _keeper(self) -> str:
        # The name of a collection or helper that contains the environment's ego. A run replaces this ego only in
        # attributes of the environment itself.
        env = self.unwrapped
        for name, value in vars(env).items():
            parts = (
                value
                if isinstance(value, (list, tuple, set))
                else getattr(value, "__dict__", value)
            )
            parts = parts.values() if isinstance(parts, Mapping) else parts
            is_looked_at = (
                name not in WITH_EGO and value is not env.vehicle and isinstance(parts, Collection)
            )
            if is_looked_at and any(each is env.vehicle for each in parts):
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
        given, is_straight = self.config or {}, self.straight_road is not None
        is_read = ends and not type(self.unwrapped).__module__.startswith("highway_env.")
        found: dict[str, list[str]] = {}
        for name in given:
            told = ""
            if name == "other_vehicles_type" and (is_read or not (is_planner or drives_itself)):
                continue  # NPCs have this class in the environment's code
            if name in TRAFFIC_OPTIONS or (name == CONNECTED and not (drives_itself or simulates)):
                told = "NPCs replace the environment's own traffic"
            elif name in POLICY_OPTIONS and (is_planner or drives_itself):
                told = "the ego decides without the environment's observations and actions"
            elif name == "ego_spacing" and is_straight:
                told = "the world's headway= sets the gaps at the start"
            elif name == "initial_lane_id" and is_straight and given[name] is not None:
                told = f"write ego_lane={given[name]!r:.20}"
            elif name == "offroad_terminal" and is_straight and given[name] and not ends:
                told = (
                    "runs continue after the ego leaves a straight road, which run.off_road reports"
                )
            elif (
                name in ("offroad_terminal", "terminate_off_road")
                and not is_straight
                and not given[name]
            ):
                told = "runs on this road end when the ego leaves it"
            if told:
                found.setdefault(told, []).append(name)
        return found

    @property
    def whole_config(self) -> dict[str, Any]:
        """All JSON-compatible options of the environment, with the original values of the traffic options."""
        env = self.unwrapped
        values = {**env.default_config(), **self._given_config}
        values |= {
            name: env.config[name] for name in values if name in env.config and name not in REPLACED
        }
        config: dict[str, Any] = {}
        for name, value in values.items():
            with suppress(WorldError):
                config[name] = plain_data(f"config.{name}", value)
        return config

    @property
    def _given_config(self) -> dict[str, Any]:
        # As in gymnasium, the user's configuration replaces the registered one.
        registered: dict[str, Any] = gymnasium.registry[self.env_id].kwargs.get("config") or {}
        return registered if self.config is None else self.config


def _plain_state(env: Any) -> dict[str, str]:
    owners = (("", env), ("vehicle.", env.vehicle))
    return {
        f"{owner}{name}": repr(value)
        for owner, each in owners
        for name, value in vars(each).items()
        if isinstance(value, PLAIN)
    }


def _beginning(outer: Any) -> dict[str, str]:
    # The values that a run reads from an environment after a reset, as strings by name.
    env = outer.unwrapped
    replaced = (*TRAFFIC_OPTIONS, *REPLACED)
    found = {
        f"config[{name!r}]": repr(value)
        for name, value in env.config.items()
        if name not in replaced
    }
    for index, lane in env.road.network.lanes_dict().items():
        points = [lane.position(share * lane.length, 0).tolist() for share in (0.0, 0.5, 1.0)]
        found[f"lane {index}"] = repr((points, lane.width_at(0), lane.speed_limit))
    found["road.objects"] = repr(obstacles_of(env))
    if (ego := env.vehicle) is not None:
        place = (round(float(each), 6) for each in (*ego.position, ego.heading, ego.speed))
        found["vehicle"] = f"{type(ego).__name__} at {', '.join(map(str, place))}"
        found["vehicle.target_speeds"] = repr(getattr(ego, "target_speeds", None))
    return found | {
        name: repr(getattr(outer, name)) for name in ("observation_space", "action_space")
    }


def _assigned(cls: Any, name: str) -> list[str]:
    # The attributes that a method assigns, directly or through other methods of its object; none without source code.
    found, names = dict[str, None](), [name]
    for called in names:
        functions = [vars(each).get(called) for each in cls.__mro__]
        for function in functions:
            if not isinstance(function, FunctionType) or str(function.__module__).startswith(
                "highway_env."
            ):
                continue
            with suppress(OSError, SyntaxError):
                for node in ast.walk(ast.parse(textwrap.dedent(inspect.getsource(function)))):
                    place = node.value if isinstance(node, ast.Subscript) else node
                    if isinstance(place, ast.Attribute) and isinstance(
                        getattr(node, "ctx", None), ast.Store
                    ):
                        found[ast.unparse(node).removeprefix("self.")] = None
                    method = ast.unparse(node.func) if isinstance(node, ast.Call) else ""
                    if (
                        method.startswith("self.")
                        and (own := method.removeprefix("self.")) not in names
                    ):
                        names.append(own)
    return list(found)


def obstacles_of(env: Any) -> tuple[tuple[float, float, float, float, float], ...]:
    """Return the x [m], y [m], heading [rad], length [m] and width [m] of each solid object on a road."""
    found = []
    for each in env.road.objects:
        if each.solid:
            x, y = map(float, each.position)
            found.append((x, y, float(each.heading), float(each.LENGTH), float(each.WIDTH)))
    return tuple(found)


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
    classes, queue = set(), [Vehicle]
    while queue:
        classes.add(queue[-1])
        queue.extend(queue.pop().__subclasses__())
    before = {
        cls: {name: value for name, value in vars(cls).items() if name.isupper()} for cls in classes
    }
    changed = dict[Any, dict[str, Any]]()
    try:
        yield changed
    finally:
        for cls, constants in before.items():
            now = {name: value for name, value in vars(cls).items() if name.isupper()}
            if own := {
                name: value for name, value in now.items() if value is not constants.get(name)
            }:
                changed[cls] = own
            for name in now.keys() - constants:
                delattr(cls, name)
            for name, value in constants.items():
                if vars(cls)[name] is not value:
                    setattr(cls, name, value)


def _wrap(env: Any, wrappers: Sequence[Callable[[Any], Any]]) -> Any:
    outer = env
    for index, wrapper in enumerate(wrappers):
        expected = f"wrappers[{index}]: expected a callable that takes an environment and returns it wrapped"
        try:
            outer = wrapper(outer)
        except Exception as error:
            received = f"{wrapper!r:.200}, which raised {type(error).__name__}: {error}"
            raise WorldError(f"{expected}, received {received}") from error
        if not isinstance(outer, gymnasium.Env) or outer.unwrapped is not env.unwrapped:
            raise WorldError(
                f"{expected}, received {wrapper!r:.200}, which returned {outer!r:.200}"
            )
    return outer


def _creator(env_id: str) -> Any:
    # Returns the class of a registered environment, or the function that makes it.
    if env_id not in gymnasium.registry:
        known = sorted(name for name in gymnasium.registry if name.startswith("highway"))
        entries = ((name, spec.entry_point) for name, spec in gymnasium.registry.items())
        homes = (
            (name, entry if isinstance(entry, str) else entry.__module__) for name, entry in entries
        )
        # gymnasium's own environments would be rejected.
        near = difflib.get_close_matches(
            env_id, [name for name, home in homes if not home.startswith("gymnasium.")], n=1
        )
        meant = f"did you mean {near[0]!r}? " if near else ""
        fix = (
            f"{meant}highway-env's straight roads are in {' and '.join(known)}. To use your own environment, first "
            f"import the module that registers it, as `--world module:id` does, or write {OTHER_KIND}"
        )
        raise WorldError(
            field="env_id", expected="a registered environment", received=repr(env_id), fix=fix
        )
    entry_point = gymnasium.registry[env_id].entry_point
    return load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point


def _check_base(env_id: str, cls: type[Any]) -> None:
    if not issubclass(cls, AbstractEnv):
        expected = "an environment derived from highway-env's AbstractEnv"
        raise WorldError(
            field="env_id",
            expected=expected,
            received=f"{env_id!r} ({cls.__name__})",
            fix=f"write {OTHER_KIND}",
        )


def _check_sizes(config: dict[str, Any], creator: Any) -> None:
    """Reject values of known options with which highway-env would compute for minutes."""
    given = {name: value for name, value in config.items() if name not in REPLACED}
    for name, bounds in (("simulation_frequency", PHYSICS_HZ), ("policy_frequency", ADS_HZ)):
        if name in given:
            whole_within(f"config.{name}", given[name], *bounds)
    if not str(getattr(creator, "__module__", "")).startswith("highway_env."):
        given = {
            name: given[name] for name in ("observation", "action", "scaling") if name in given
        }
    _check_size("config", given)
    if (numbers := _numbers(given.get("observation"), config)) > MOST_NUMBERS:
        expected, received = f"at most {MOST_NUMBERS:,} numbers", f"about {numbers:,.0f}"
        fix = "use fewer features, parts or images, or larger cells"
        raise WorldError(field="config.observation", expected=expected, received=received, fix=fix)


def _check_size(place: str, config: Any) -> None:
    if isinstance(config, (list, tuple)):
        for index, inner in enumerate(config):
            _check_size(f"{place}[{index}]", inner)
    if not isinstance(config, Mapping):
        return
    cells = _cells(config) if config.get("type") == "OccupancyGrid" else 0.0
    if not cells <= MOST_CELLS:
        received = "infinitely many cells" if cells == math.inf else f"{cells:,.0f} cells"
        raise WorldError(
            field=f"{place}.grid_step", expected=f"at most {MOST_CELLS:,} cells", received=received
        )
    for name, value in config.items():
        if limit := _exceeded(name, value):
            expected, received = (
                f"{limit}, so that the environment can be created within seconds",
                f"{value!r:.100}",
            )
            raise WorldError(field=f"{place}.{name}", expected=expected, received=received)
        _check_size(f"{place}.{name}", value)


def _exceeded(name: str, value: Any) -> str:
    """Describe the limit that an option's value, or an item of its list, exceeds, or return an empty string."""
    entries = value if isinstance(value, (list, tuple)) else [value]
    numbers = [abs(each) for each in entries if isinstance(each, (int, float))]
    if _length(value, 0) > LONGEST.get(name, math.inf):
        return f"at most {LONGEST[name]} entries"
    # a matrix would make one image per column
    if name == "weights" and len(numbers) < len(entries):
        return "one number for each colour"
    if any(each > LARGEST.get(name, math.inf) for each in numbers):
        return f"at most {LARGEST[name]:g}"
    return (
        f"at least {SMALLEST[name]:g}"
        if any(0 < each < SMALLEST.get(name, 0) for each in numbers)
        else ""
    )


def _length(value: Any, default: int) -> int:
    return len(value) if isinstance(value, (list, tuple, str, Mapping)) else default


def _cells(grid: Mapping[str, Any]) -> float:
    size, step = grid.get("grid_size"), grid.get("grid_step")
    try:
        (low_x, high_x), (low_y, high_y) = ((-27.5, 27.5), (-27.5, 27.5)) if size is None else size
        x, y = (5.0, 5.0) if step is None else step
        return float(abs((high_x - low_x) / x) * abs((high_y - low_y) / y))
    except (TypeError, ValueError, ArithmeticError):
        return math.inf


def _numbers(observation: Any, config: Mapping[str, Any]) -> float:
    # An estimate that ignores the sizes of observations that other limits restrict.
    if not isinstance(observation, Mapping):
        return 0.0

    def product(*values: Any) -> float:
        numbers = [
            each
            for value in values
            for each in (value if isinstance(value, (list, tuple)) else [value])
        ]
        return math.prod(min(abs(each), 1e9) for each in numbers if isinstance(each, (int, float)))

    parts = observation.get("observation_configs") or [observation.get("observation_config")]
    inner = (
        sum(_numbers(part, config) for part in parts) if isinstance(parts, (list, tuple)) else 0.0
    )
    own, kind = 0.0, observation.get("type")
    if kind == "OccupancyGrid":
        own = _cells(observation) * _length(observation.get("features"), 4)
    elif kind == "GrayscaleObservation":
        own = product(observation.get("observation_shape"), observation.get("stack_size"))
    elif kind == "TimeToCollision":
        action = config.get("action")
        speeds = action.get("target_speeds") if isinstance(action, Mapping) else None
        rate, lanes = config.get("policy_frequency", 15), config.get("lanes_count", 4)
        own = product(observation.get("horizon", 10), rate, lanes, _length(speeds, 3))
    return inner + max(own, LEAST_NUMBERS)


def _check_config(env_id: str, given: dict[str, Any], env: Any) -> None:
    default = env.default_config()
    unknown = sorted(set(given) - set(default))
    if unknown:
        fix = _hint(unknown[0], default)
        raise WorldError(
            field="config", expected=f"options of {env_id}", received=", ".join(unknown), fix=fix
        )
    for name, value in given.items():
        # it would fail during a run
        if isinstance(value, str) and isinstance(default[name], (int, float)):
            expected = f"a number such as {default[name]!r}"
            raise WorldError(field=f"config.{name}", expected=expected, received=repr(value))
    if (egos := env.config.get("controlled_vehicles", 1)) != 1:
        fix = "all other vehicles are NPCs"
        raise WorldError(
            field="config.controlled_vehicles", expected="1, the ego", received=repr(egos), fix=fix
        )
    if env.config.get("manual_control"):
        expected, fix = "False, because the policy drives", "omit this option"
        received = repr(env.config["manual_control"])
        raise WorldError(
            field="config.manual_control", expected=expected, received=received, fix=fix
        )
    for name, module in (("observation", observation), ("action", action)):
        kind = getattr(env, f"{name}_type", None)
        # options of other classes are not known
        if name in given and type(kind).__module__ == module.__name__:
            _check_names(f"config.{name}", given[name], {*_options(module), *default.get(name, ())})


def _check_names(place: str, given: Any, known: Collection[str]) -> None:
    """Reject options of observations and actions that highway-env would ignore, including nested options."""
    if isinstance(given, list):
        for index, inner in enumerate(given):
            _check_names(f"{place}[{index}]", inner, known)
    if not isinstance(given, Mapping):
        return
    for name in given:
        if name not in known:
            fix = _hint(name, known)
            raise WorldError(
                field=place, expected="a highway-env option", received=str(name), fix=fix
            )
        if name in NESTED:
            _check_names(f"{place}.{name}", given[name], known)


def _hint(name: str, known: Collection[str]) -> str:
    near = difflib.get_close_matches(name, known, n=1)
    return f"did you mean {near[0]!r}?" if near else f"the options are {', '.join(sorted(known))}"


def _options(module: Any) -> set[str]:
    # Each class also accepts the options of all other classes, and highway-env's configurations rely on that.
    kinds = [
        each
        for each in vars(module).values()
        if inspect.isclass(each) and each.__module__ == module.__name__
    ]
    taken = {name for kind in kinds for name in inspect.signature(kind).parameters}
    # intersection-v0 has "flatten", which no class uses
    return (taken - {"env", "kwargs"}) | {"type", "flatten"}


def _make_environment(
    env_id: str, creator: Any, given: dict[str, Any], *, has_traffic: bool
) -> Any:
    # Reset with seed 0, because the road and the start may be random.
    known = creator.default_config() if hasattr(creator, "default_config") else {}
    config = _as_known(_with_tuples(given), known)
    if not has_traffic:
        config |= {"vehicles_count": 0, **{name: 0 for name in TRAFFIC if name in known}}
    parameters = inspect.signature(creator).parameters
    takes_config = "config" in parameters or any(
        each.kind is each.VAR_KEYWORD for each in parameters.values()
    )
    keywords: dict[str, Any] = {"config": config} if takes_config else {}
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

    def is_known(name: str, value: Any) -> bool:
        with suppress(WorldError):
            return name in known and repr(plain_data(name, value)) == repr(
                plain_data(name, known[name])
            )
        return False

    return {name: known[name] if is_known(name, value) else value for name, value in config.items()}


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
