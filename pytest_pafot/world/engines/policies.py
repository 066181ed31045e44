"""Runs of policies and vehicle classes in an environment.

Each run has a copy of the environment, which the ego's driver and the observations read. The loop moves the vehicles,
and never calls ``step`` of the environment or the road.
"""

from __future__ import annotations

import copy
import functools
import inspect
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import numpy as np

from pytest_pafot.model.scenario import Scenario, rng_of
from pytest_pafot.model.trace import Trace
from pytest_pafot.support.errors import WorldError
from pytest_pafot.world.driving.environment import (
    ModelPolicyDriver,
    ObjectDriver,
    PolicyDriver,
    View,
    copies_on,
)
from pytest_pafot.world.driving.policy import Policy, idm_model
from pytest_pafot.world.driving.vehicles import (
    CompiledRoad,
    EgosRegulatedRoad,
    Traffic,
    egos_rules,
    obstacles_on,
)
from pytest_pafot.world.engines.run import OwnEnds, VehiclesOfRun, built_as, vehicle_of
from pytest_pafot.world.guard.hang_guard import HangGuard, closing
from pytest_pafot.world.gym_environment import PLAIN, GymEnvironment
from pytest_pafot.world.kernel.loop import ModelDriver
from pytest_pafot.world.roads.road import StraightRoad
from pytest_pafot.world.run_config import Rules
from pytest_pafot.world.stock import MDPVehicle, Vehicle

# The attributes with which highway-env's classes and roads control vehicles.
OF_HIGHWAY_ENV = frozenset(
    (
        *(
            "route",
            "target_lane_index",
            "target_speed",
            "target_speeds",
            "speed_index",
            "enable_lane_change",
            "timer",
        ),
        *("collecting_data", "data", "is_yielding", "yield_timer"),
    )
)


def rollout(
    environment: GymEnvironment,
    rules: Rules,
    scenario: Scenario,
    policy: Policy,
    own_ends: Callable[..., OwnEnds | None],
) -> Trace:
    """Simulate a scenario with a vehicle class or a policy.

    ``own_ends``, a function like :func:`ends_beside`, is called for a vehicle class.
    """
    with ExitStack() as at_the_end:
        # A vehicle class replaces the ego, so only a policy needs the ego of the environment.
        env, view = _env_of(environment, scenario), None
        if policy.drives_itself:
            ads = policy.make()
        else:
            put_policys_ego(environment, env, rules, scenario)
            if policy.simulates:
                view = View(environment.make().unwrapped, env)
            ads = policy.make() if view is None else policy.make(env=view.env)
            at_the_end.enter_context(closing(ads.given, rules.hang_limit))
        guard, lanes = HangGuard(rules.hang_limit), environment.compiled_lanes
        if ads.drives_itself:
            start = rules.ego_position(scenario)
            given = built_as(rules.ego, ads.given)
            ego = vehicle_of(given, env.road, start, rules.ego_speed(scenario), environment.route)
            # On a straight road, the kernel's IDM knows neither objects nor rules for yielding.
            has_more = isinstance(lanes, StraightRoad) and (
                env.road.objects or isinstance(env.road, EgosRegulatedRoad)
            )
            if idm_model(given) is None or lanes is None or has_more:
                if rules.ends:
                    put_ego(env, ego)
                return _run_driver(
                    environment, rules, scenario, ObjectDriver(ego, env.road, guard), env, own_ends
                )
            # The kernel drives an IDM on lanes that it supports.
            model = CompiledRoad(env.road, lanes).vehicle(ego)
            vehicles = VehiclesOfRun(rules, scenario, model, lambda: env.road)
            others = [*vehicles.vehicles[1:], *obstacles_on(env.road)]
            model_driver = ModelDriver(
                model, others, egos_rules(env.road, model, vehicles.places, rules, lanes)
            )
            return vehicles.drive(model_driver, guard, own_ends(rules, scenario, vehicles, guard))
        every = rules.every
        is_known = (
            type(env.vehicle) in (MDPVehicle, Vehicle)
            and getattr(env.action_type, "speed_range", None) is None
        )
        if is_known and lanes is not None:  # the kernel moves the ego
            driver: PolicyDriver = ModelPolicyDriver(
                ads.policy, env, guard, every, environment.traffic, view, lanes
            )
        else:
            driver = PolicyDriver(ads.policy, env, guard, every, environment.traffic, view)
        return _run_driver(environment, rules, scenario, driver, env)


def ends_beside(
    environment: GymEnvironment,
    rules: Rules,
    scenario: Scenario,
    vehicles: VehiclesOfRun,
    guard: HangGuard,
) -> OwnEnds | None:
    """Return an environment's ``OwnEnds`` for an ego that does not belong to it, or None if it cannot end runs."""
    if not rules.ends:
        return None
    env = _env_of(environment, scenario)
    put_policys_ego(environment, env, rules, scenario)
    return OwnEnds(env, rules.ends, rules, guard, showing(environment, env, vehicles))


def showing(environment: GymEnvironment, env: Any, vehicles: VehiclesOfRun) -> Callable[[], None]:
    """Put a run's vehicles into an environment, and return a function that updates their states."""
    ego, body = env.vehicle, vehicles.vehicles[0]
    traffic = Traffic(environment.traffic, env.road, ego, vehicles.places, vehicles.rules.road)

    def show() -> None:
        traffic.show()
        ego.position, ego.heading, ego.speed = np.array([body.x, body.y]), body.heading, body.speed
        ego.action = {"steering": body.steering, "acceleration": body.acceleration}
        ego.on_state_update()

    return show


def _run_driver(
    environment: GymEnvironment,
    rules: Rules,
    scenario: Scenario,
    driver: ObjectDriver,
    env: Any,
    own_ends: Callable[..., OwnEnds | None] | None = None,
) -> Trace:
    vehicles = VehiclesOfRun(rules, scenario, driver.ego, lambda: driver.road)
    driver.show(vehicles.places, rules.road)
    ends = None
    if own_ends is not None and rules.ends_in_steps:
        ends = own_ends(rules, scenario, vehicles, driver.guard)
    elif own_ends is not None and rules.ends:
        # The ego sees NPCs without goals. The environment's methods see them as its own traffic, on a copy of the road.
        env.road = copy.copy(env.road)
        traffic = Traffic(environment.traffic, env.road, env.vehicle, vehicles.places, rules.road)
        ends = OwnEnds(env, rules.ends, rules, driver.guard, traffic.show)
    elif rules.ends:
        ends = OwnEnds(env, rules.ends, rules, driver.guard, driver.show_all)
    return vehicles.drive(driver, driver.guard, ends)


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


def put_policys_ego(
    environment: GymEnvironment, env: Any, rules: Rules, scenario: Scenario
) -> None:
    """Put a policy's ego, with the same class as the ego that the reset created, into an environment.

    Raises:
        WorldError: if the class cannot be called with the arguments that highway-env passes.
    """
    own, vehicle_class = env.vehicle, env.action_type.vehicle_class
    start, speed = rules.ego_position(scenario), rules.ego_speed(scenario)
    if type(own) is usual_class(env.action_type):
        put_ego(
            env,
            vehicle_of(
                built_as(rules.ego, vehicle_class), env.road, start, speed, environment.route
            ),
        )
        return
    signature = inspect.signature(type(own))
    try:
        signature.bind(None, [0.0, 0.0], 0.0, 0.0)
    except TypeError as error:
        raise WorldError(
            field="env_id",
            expected="an environment whose ego has a class that can be called with (road, position, heading, speed)",
            received=f"{type(own).__name__}{signature} ({error})",
            fix="give the other parameters default values",
        ) from None
    ego = vehicle_of(built_as(rules.ego, type(own)), env.road, start, speed, environment.route)
    give_speeds(ego, getattr(own, "target_speeds", None))
    there = (*own.position, own.heading), own.speed
    plain, same = (vehicle_of(cls, env.road, *there, None) for cls in (Vehicle, type(own)))
    for name, value in vars(own).items():
        is_known = name in OF_HIGHWAY_ENV or name in vars(plain)
        if (
            not is_known
            and isinstance(value, PLAIN)
            and repr(value) != repr(getattr(same, name, None))
        ):
            setattr(ego, name, copy.deepcopy(value))
    put_ego(env, ego)


def _env_of(environment: GymEnvironment, scenario: Scenario) -> Any:
    # Runs may nest, so each has its own road, time and random numbers.
    env = copy.copy(environment.unwrapped)
    env.np_random = rng_of(scenario.seed)
    env.time = env.steps = 0
    env.road = environment.road(env.np_random)
    env.road.objects = copies_on(environment.unwrapped.road.objects, env.road)
    env.config = dict(env.config)
    if environment.own_state:
        first = environment.unwrapped
        there = [
            (first, env),
            (first.road, env.road),
            *zip(first.road.objects, env.road.objects, strict=True),
        ]
        # The ego of the reset is not copied, because `put_ego` looks for it.
        known = {id(old): new for old, new in [*there, (first.vehicle, first.vehicle)]}
        vars(env).update(
            copy.deepcopy({name: vars(first)[name] for name in environment.own_state}, known)
        )
    return env


def usual_class(action_type: Any) -> Any:
    """Return the class of ego for which an action type is designed."""
    vehicle_class = action_type.vehicle_class
    return vehicle_class.func if isinstance(vehicle_class, functools.partial) else vehicle_class


def give_speeds(ego: Any, speeds: Any) -> None:
    """Set the target speeds of an ego that chooses between several speeds, as highway-env does."""
    if (
        isinstance(ego, MDPVehicle)
        and speeds is not None
        and not np.array_equal(ego.target_speeds, speeds)
    ):
        ego.target_speeds = np.array(speeds)
        ego.speed_index = ego.speed_to_index(ego.speed)
        ego.target_speed = ego.index_to_speed(ego.speed_index)
