"""The engine for policies, which observe and act through a copy of an environment whose road is stepped directly."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from contextlib import ExitStack
from typing import Any

import numpy as np

from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.sight import Sight
from pytest_pafot.model.trace import Trace
from pytest_pafot.world.driving.ads import (
    AdsFactory,
    EgoDriver,
    SelfDriving,
    give_route,
    is_vehicle_class,
    make_ads,
    wants_env,
)
from pytest_pafot.world.driving.perception import ads_and_sight
from pytest_pafot.world.driving.policy import Policy, View, copies_on
from pytest_pafot.world.driving.seeing import policy_sight
from pytest_pafot.world.driving.vehicles import EgosRegulatedRoad, quick
from pytest_pafot.world.engines.object_engine import ObjectRun, run
from pytest_pafot.world.guard.failure import closing
from pytest_pafot.world.guard.hang_guard import HangGuard
from pytest_pafot.world.gym_environment import GymEnvironment
from pytest_pafot.world.run_config import Rules
from pytest_pafot.world.stock import RegulatedRoad, Road


def rollout(environment: GymEnvironment, rules: Rules, scenario: Scenario, ads_factory: AdsFactory) -> Trace:
    """Simulate a scenario, which fits the rules, with a fresh ADS of any kind."""
    env, route, every = _env_of(environment, scenario), environment.route, rules.physics_hz // rules.ads_hz

    at_the_end = ExitStack()

    def make_ego(start: tuple[float, float, float]) -> EgoDriver:
        ads, view = ads_factory, None
        if not is_vehicle_class(ads):
            put_new_ego(env, quick(env.action_type.vehicle_class), start, scenario.ego_speed, route)
            if wants_env(ads_factory):
                view = View(environment.make().unwrapped, env)
            ads = make_ads(ads_factory) if view is None else make_ads(ads_factory, env=view.env)
            at_the_end.enter_context(closing(ads, rules.hang_limit))
        if is_vehicle_class(ads):
            return SelfDriving(ads, env.road, start, scenario.ego_speed, route)
        ads, sight = ads_and_sight(ads)
        return Policy(ads, env, every, view, policy_sight(env, sight, scenario))

    with at_the_end:
        return run(rules, scenario, env.road, make_ego)


def begin(
    environment: GymEnvironment, rules: Rules, scenario: Scenario, guard: HangGuard, sight: Sight | None
) -> ObjectRun:
    """Begin a run to which the caller passes the actions, for an ADS with the given sight."""
    env = _env_of(environment, scenario)

    def make_ego(start: tuple[float, float, float]) -> Policy:
        put_new_ego(env, quick(env.action_type.vehicle_class), start, scenario.ego_speed, environment.route)
        every = rules.physics_hz // rules.ads_hz
        return Policy(None, env, every, sight=policy_sight(env, sight, scenario))

    return ObjectRun(rules, scenario, env.road, make_ego, guard)


def put_ego(env: Any, ego: Any, route: Sequence[Any] | None) -> None:
    """Make ``ego`` the only vehicle of an environment, and give it the route if it follows routes.

    highway-env's own check of collisions is turned off, because pafot tests for contact itself.
    """
    ego.check_collisions = False
    give_route(ego, route)
    env.road.vehicles = [ego]
    env.controlled_vehicles = [ego]
    env.define_spaces()


def put_new_ego(
    env: Any, vehicle_class: Any, start: tuple[float, float, float], speed: float, route: Sequence[Any] | None
) -> None:
    """Make a vehicle of a class, with a speed [m/s] at x [m], y [m], heading [rad]; then call :func:`put_ego`."""
    x, y, heading = start
    put_ego(env, vehicle_class(env.road, [x, y], heading, speed), route)


def _env_of(environment: GymEnvironment, scenario: Scenario) -> Any:
    """Copy the environment for one run, without vehicles; runs may nest, so they share no state."""
    env = copy.copy(environment.unwrapped)
    env.np_random = np.random.default_rng(scenario.seed)
    env.time = env.steps = 0
    own = environment.unwrapped.road
    env.road = (EgosRegulatedRoad if type(own) is RegulatedRoad else Road)(
        environment.network,
        np_random=env.np_random,
        neighbour_vehicles_connected_lanes=env.config.get("neighbour_vehicles_connected_lanes", False),
    )
    if isinstance(env.road, EgosRegulatedRoad):
        env.road.steps = own.steps  # a reset has done some steps, and the count decides when rules are enforced next
    env.road.objects = copies_on(environment.unwrapped.road.objects, env.road)
    return env
