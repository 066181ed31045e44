"""One run in a copy of a highway-env environment: policies see and act through it, and its road is stepped directly."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.road.road import Road

from pytest_pafot.scenario import Scenario
from pytest_pafot.trace import Trace
from pytest_pafot.world.driving.ads import AdsFactory, EgoDriver, SelfDriving, follow, is_vehicle_class, made, wants_env
from pytest_pafot.world.driving.guard import HangGuard
from pytest_pafot.world.driving.policy import Policy, View, moved
from pytest_pafot.world.engines.object_engine import ObjectRun, run
from pytest_pafot.world.run_config import Rules


class PolicyWorld(Protocol):
    """A world that is made of an environment."""

    @property
    def rules(self) -> Rules:
        """Of its runs."""

    @property
    def env(self) -> Any:
        """The environment without wrappers and vehicles, which no run changes."""

    @property
    def network(self) -> Any:
        """The environment's roads."""

    @property
    def route(self) -> tuple[Any, ...] | None:
        """The ego's, where it follows one."""

    @property
    def wrappers(self) -> Sequence[Callable[[Any], Any]] | None:
        """Around the environment; None where there are none."""

    def make(self) -> Any:
        """A fresh environment in its wrappers."""


def rollout(world: PolicyWorld, scenario: Scenario, ads_factory: AdsFactory) -> Trace:
    """Simulate a scenario, which fits the world, with a fresh ADS of any kind."""
    env, every = _env_of(world, scenario), world.rules.physics_hz // world.rules.ads_hz

    def make_ego(start: tuple[float, float, float]) -> EgoDriver:
        ads = ads_factory
        if not is_vehicle_class(ads):
            _put_own_ego(env, start, scenario.ego_speed, world.route)
            if wants_env(ads_factory):
                view = View(world.make().unwrapped, env)
                return Policy(made(ads_factory, env=view.env), env, every, view)
            ads = made(ads_factory)
        if is_vehicle_class(ads):
            return SelfDriving(ads, env.road, start, scenario.ego_speed, world.route)
        return Policy(ads, env, every)

    return run(world.rules, scenario, env.road, make_ego)


def begin(world: PolicyWorld, scenario: Scenario, guard: HangGuard) -> ObjectRun:
    """A run that is given its actions."""
    env = _env_of(world, scenario)

    def make_ego(start: tuple[float, float, float]) -> Policy:
        _put_own_ego(env, start, scenario.ego_speed, world.route)
        return Policy(None, env, world.rules.physics_hz // world.rules.ads_hz)

    return ObjectRun(world.rules, scenario, env.road, make_ego, guard)


def steps_itself(env: Any, *, drives_itself: bool) -> bool:
    """Whether a run needs the environment's own steps: they are its own, or its road does more than move vehicles.

    Args:
        env: without wrappers.
        drives_itself: whether the ego does: then it takes no part in the steps of the environment, only of the road.
    """
    cls, road = type(env), type(env.road)
    has_own_road = road.step is not Road.step or road.act is not Road.act
    has_own_step = cls.step is not AbstractEnv.step or cls._simulate is not AbstractEnv._simulate
    return has_own_road or (has_own_step and not drives_itself)


def put_ego(env: Any, ego: Any, route: Sequence[Any] | None) -> None:
    """Make a vehicle the only one of an environment, on a route if it follows one; pafot looks for contact itself."""
    ego.check_collisions = False
    follow(ego, route)
    env.road.vehicles = [ego]
    env.controlled_vehicles = [ego]
    env.define_spaces()


def _put_own_ego(env: Any, start: tuple[float, float, float], speed: float, route: Sequence[Any] | None) -> None:
    x, y, heading = start
    put_ego(env, env.action_type.vehicle_class(env.road, [x, y], heading, speed), route)


def _env_of(world: PolicyWorld, scenario: Scenario) -> Any:
    """The environment of one run, without vehicles; runs may nest and share no state."""
    env = copy.copy(world.env)
    env.np_random = np.random.default_rng(scenario.seed)
    env.time = env.steps = 0
    env.road = Road(
        world.network,
        np_random=env.np_random,
        neighbour_vehicles_connected_lanes=env.config.get("neighbour_vehicles_connected_lanes", False),
    )
    env.road.objects = moved(world.env.road.objects, env.road)
    return env
