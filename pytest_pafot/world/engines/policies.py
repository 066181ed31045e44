"""The runs of egos in a copy of an environment, whose road the loop steps."""

from __future__ import annotations

import copy
from contextlib import ExitStack
from typing import Any

import numpy as np

from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.sight import Sight
from pytest_pafot.model.trace import Trace
from pytest_pafot.world.driving.ads import AdsFactory, is_vehicle_class, make_ads, wants_env
from pytest_pafot.world.driving.object_driver import ObjectDriver
from pytest_pafot.world.driving.perception import ads_and_sight
from pytest_pafot.world.driving.policy import PolicyDriver, View, copies_on
from pytest_pafot.world.driving.seeing import policy_sight
from pytest_pafot.world.driving.vehicles import EgosRegulatedRoad, quick
from pytest_pafot.world.engines.egos import vehicle_of
from pytest_pafot.world.engines.run import SteppedRun, VehiclesOfRun
from pytest_pafot.world.guard.failure import closing
from pytest_pafot.world.guard.hang_guard import HangGuard
from pytest_pafot.world.gym_environment import GymEnvironment
from pytest_pafot.world.run_config import Rules
from pytest_pafot.world.stock import RegulatedRoad, Road


def rollout(environment: GymEnvironment, rules: Rules, scenario: Scenario, ads_factory: AdsFactory) -> Trace:
    """Simulate a scenario, which fits the rules, with a fresh ADS that is a vehicle class or a policy."""
    with ExitStack() as at_the_end:
        ads, env, view = ads_factory, _env_of(environment, scenario), None
        if not is_vehicle_class(ads):
            _put_policys_ego(environment, env, rules, scenario)
            if wants_env(ads_factory):
                view = View(environment.make().unwrapped, env)
            ads = make_ads(ads_factory) if view is None else make_ads(ads_factory, env=view.env)
            at_the_end.enter_context(closing(ads, rules.hang_limit))
        guard = HangGuard(rules.hang_limit)
        if is_vehicle_class(ads):
            start = rules.ego_position(scenario)
            ego = vehicle_of(ads, env.road, start, scenario.ego_speed, environment.route)
            return _begun(rules, scenario, ObjectDriver(ego, env.road, guard), guard).finish()
        ads, sight = ads_and_sight(ads)
        every = rules.physics_hz // rules.ads_hz
        driver = PolicyDriver(ads, env, guard, every, view, policy_sight(env, sight, scenario))
        return _begun(rules, scenario, driver, guard).finish()


def begin(
    environment: GymEnvironment, rules: Rules, scenario: Scenario, guard: HangGuard, sight: Sight | None
) -> SteppedRun:
    """Begin a run to which the caller passes the actions, for an ADS with the given sight."""
    env = _env_of(environment, scenario)
    _put_policys_ego(environment, env, rules, scenario)
    every = rules.physics_hz // rules.ads_hz
    driver = PolicyDriver(None, env, guard, every, sight=policy_sight(env, sight, scenario))
    return _begun(rules, scenario, driver, guard)


def _begun(rules: Rules, scenario: Scenario, driver: ObjectDriver, guard: HangGuard) -> SteppedRun:
    vehicles = VehiclesOfRun(rules, scenario, driver.ego, driver.road.network)
    driver.show(vehicles.places, rules.road)
    return SteppedRun(vehicles, driver, guard)


def put_ego(env: Any, ego: Any) -> None:
    """Make ``ego`` the only vehicle of an environment."""
    env.road.vehicles = [ego]
    env.controlled_vehicles = [ego]
    env.define_spaces()


def _put_policys_ego(environment: GymEnvironment, env: Any, rules: Rules, scenario: Scenario) -> None:
    vehicle_class, start = quick(env.action_type.vehicle_class), rules.ego_position(scenario)
    put_ego(env, vehicle_of(vehicle_class, env.road, start, scenario.ego_speed, environment.route))


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
