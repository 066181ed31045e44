"""Runs of policies and vehicle classes in an environment.

Each run has a copy of the environment, which the ego's driver and the observations read. The loop moves the vehicles,
and never calls ``step`` of the environment or the road.
"""

from __future__ import annotations

import copy
import functools
import inspect
from collections.abc import Callable
from typing import Any

import numpy as np

from pytest_pafot.model.scenario import Scenario, rng_of
from pytest_pafot.model.trace import Trace
from pytest_pafot.world.driving.environment import (
    ModelPolicyDriver,
    ObjectDriver,
    PolicyDriver,
    View,
    copies_on,
)
from pytest_pafot.world.driving.policy import Ads, Policy, idm_model
from pytest_pafot.world.driving.vehicles import (
    CompiledRoad,
    EgosRegulatedRoad,
    Traffic,
    egos_rules,
    obstacles_on,
)
from pytest_pafot.world.engines.run import OwnEnds, Rules, VehiclesOfRun, built_as, make_ego
from pytest_pafot.world.guard.hang_guard import HangGuard, closing
from pytest_pafot.world.gym_environment import (
    OF_HIGHWAY_ENV,
    PLAIN,
    GymEnvironment,
    put_ego,
    refused_environment,
)
from pytest_pafot.world.kernel.loop import ModelDriver
from pytest_pafot.world.roads.road import StraightRoad
from pytest_pafot.world.stock import MDPVehicle, Vehicle

# Returns the `OwnEnds` of a run, or None if the environment cannot end it.
EndsOf = Callable[[VehiclesOfRun, HangGuard], OwnEnds | None]


def rollout(
    environment: GymEnvironment, rules: Rules, scenario: Scenario, policy: Policy, ends_of: EndsOf
) -> Trace:
    """Simulate a scenario with a vehicle class or a policy.

    ``ends_of``, which calls a function like :func:`ends_beside`, is called for a vehicle class.
    """
    env = _env_of(environment, scenario)
    # A vehicle class replaces the ego, so only a policy needs the ego of the environment.
    if policy.drives_itself:
        return _class_run(environment, env, rules, scenario, policy.make().given, ends_of)
    put_policys_ego(environment, env, rules, scenario)
    view = None
    if policy.simulates:
        view = View(environment.make().unwrapped, env)
    ads = make_ads(policy, view)
    with closing(ads.given, rules.hang_limit):
        if ads.drives_itself:
            return _class_run(environment, env, rules, scenario, ads.given, ends_of)
        guard = HangGuard(rules.hang_limit)
        common = env, guard, rules.every, environment.traffic, view
        # A user's class of ego, or an action type that limits its speed, needs its own code.
        lanes = environment.compiled_lanes
        is_plain = getattr(env.action_type, "speed_range", None) is None
        if type(env.vehicle) in (MDPVehicle, Vehicle) and is_plain and lanes is not None:
            # the kernel moves the ego
            driver: PolicyDriver = ModelPolicyDriver(ads.policy, *common, lanes)
        else:
            driver = PolicyDriver(ads.policy, *common)
        vehicles = _vehicles(rules, scenario, driver)
        ends = None
        if rules.ends:
            ends = OwnEnds(env, rules.ends, rules, guard, driver.show_all)
        return vehicles.drive(driver, guard, ends)


def make_ads(policy: Policy, view: View | None) -> Ads:
    """Call a policy's factory, with the environment of ``view`` if the policy simulates in it."""
    if view is None:
        return policy.make()
    return policy.make(env=view.env)


def _class_run(
    environment: GymEnvironment,
    env: Any,
    rules: Rules,
    scenario: Scenario,
    given: Any,
    ends_of: EndsOf,
) -> Trace:
    """Simulate a scenario with a vehicle class."""
    guard = HangGuard(rules.hang_limit)
    lanes = environment.compiled_lanes
    vehicle_class = built_as(rules.ego, given)
    ego = make_ego(rules, scenario, vehicle_class, env.road, environment.route)
    # The kernel drives an IDM on lanes that it supports.
    is_known = idm_model(vehicle_class) is not None
    if isinstance(lanes, StraightRoad):
        # On a straight road, the kernel's IDM knows neither objects nor rules for yielding.
        has_more = env.road.objects or isinstance(env.road, EgosRegulatedRoad)
        is_known = is_known and not has_more
    if is_known and lanes is not None:
        model = CompiledRoad(env.road, lanes).vehicle(ego)
        vehicles = VehiclesOfRun(rules, scenario, model, lambda: env.road)
        others = [*vehicles.vehicles[1:], *obstacles_on(env.road)]
        # On a regulated road, the ego also yields to other vehicles.
        yielding = egos_rules(env.road, model, vehicles.places, rules.road, rules.physics_hz, lanes)
        kernel_driver = ModelDriver(model, others, yielding)
        return vehicles.drive(kernel_driver, guard, ends_of(vehicles, guard))
    if rules.ends:
        put_ego(env, ego)
    driver = ObjectDriver(ego, env.road, guard)
    vehicles = _vehicles(rules, scenario, driver)
    ends = None
    if rules.ends_in_steps:
        ends = ends_of(vehicles, guard)
    elif rules.ends:
        # The ego sees NPCs without goals. The environment's methods see them as its own traffic, on a copy of the road.
        env.road = copy.copy(env.road)
        traffic = Traffic(environment.traffic, env.road, env.vehicle, vehicles.places, rules.road)
        ends = OwnEnds(env, rules.ends, rules, guard, traffic.show)
    return vehicles.drive(driver, guard, ends)


def _vehicles(rules: Rules, scenario: Scenario, driver: ObjectDriver) -> VehiclesOfRun:
    vehicles = VehiclesOfRun(rules, scenario, driver.ego, lambda: driver.road)
    driver.show(vehicles.places, rules.road)
    return vehicles


def ends_beside(
    environment: GymEnvironment, vehicles: VehiclesOfRun, guard: HangGuard
) -> OwnEnds | None:
    """Return an environment's ``OwnEnds`` for an ego that does not belong to it, or None if it cannot end runs."""
    rules = vehicles.rules
    if not rules.ends:
        return None
    env = _env_of(environment, vehicles.scenario)
    put_policys_ego(environment, env, rules, vehicles.scenario)
    return OwnEnds(env, rules.ends, rules, guard, showing(environment, env, vehicles))


def showing(environment: GymEnvironment, env: Any, vehicles: VehiclesOfRun) -> Callable[[], None]:
    """Put a run's vehicles into an environment, and return a function that updates their states."""
    ego = env.vehicle
    body = vehicles.vehicles[0]
    traffic = Traffic(environment.traffic, env.road, ego, vehicles.places, vehicles.rules.road)

    def show() -> None:
        traffic.show()
        ego.position = np.array([body.x, body.y])
        ego.heading = body.heading
        ego.speed = body.speed
        # The rewards and ends of some environments depend on the ego's controls.
        ego.action = {"steering": body.steering, "acceleration": body.acceleration}
        ego.on_state_update()

    return show


def put_policys_ego(
    environment: GymEnvironment, env: Any, rules: Rules, scenario: Scenario
) -> None:
    """Put a policy's ego, with the same class as the ego that the reset created, into an environment.

    Raises:
        WorldError: if the class cannot be called with the arguments that highway-env passes.
    """
    own = env.vehicle
    if type(own) is usual_class(env.action_type):
        vehicle_class = built_as(rules.ego, env.action_type.vehicle_class)
        ego = make_ego(rules, scenario, vehicle_class, env.road, environment.route)
        put_ego(env, ego)
        return
    signature = inspect.signature(type(own))
    try:
        signature.bind(None, [0.0, 0.0], 0.0, 0.0)
    except TypeError as error:
        raise refused_environment(
            "an environment whose ego has a class that can be called with (road, position, heading, speed)",
            f"{type(own).__name__}{signature} ({error})",
            "give the other parameters default values",
        ) from None
    vehicle_class = built_as(rules.ego, type(own))
    ego = make_ego(rules, scenario, vehicle_class, env.road, environment.route)
    give_speeds(ego, getattr(own, "target_speeds", None))
    # The reset may have set attributes to values that the class alone does not give them.
    start = env.road, [*own.position], own.heading, own.speed
    plain = Vehicle(*start)
    same = type(own)(*start)
    for name, value in vars(own).items():
        if name in OF_HIGHWAY_ENV or name in vars(plain) or not isinstance(value, PLAIN):
            continue
        if repr(value) != repr(getattr(same, name, None)):
            setattr(ego, name, copy.deepcopy(value))
    put_ego(env, ego)


def _env_of(environment: GymEnvironment, scenario: Scenario) -> Any:
    # Runs may nest, so each has its own road, time and random numbers.
    first = environment.unwrapped
    env = copy.copy(first)
    env.np_random = rng_of(scenario.seed)
    env.time = env.steps = 0
    env.road = environment.road(env.np_random)
    env.road.objects = copies_on(first.road.objects, env.road)
    # Methods of the environment may keep counters in it.
    env.config = dict(env.config)
    if environment.own_state:
        # The ego of the reset is not copied, because `put_ego` looks for it.
        known = {id(first): env, id(first.road): env.road, id(first.vehicle): first.vehicle}
        for old, new in zip(first.road.objects, env.road.objects, strict=True):
            known[id(old)] = new
        own_state = {name: vars(first)[name] for name in environment.own_state}
        vars(env).update(copy.deepcopy(own_state, known))
    return env


def usual_class(action_type: Any) -> Any:
    """Return the class of ego for which an action type is designed."""
    vehicle_class = action_type.vehicle_class
    if isinstance(vehicle_class, functools.partial):
        return vehicle_class.func
    return vehicle_class


def give_speeds(ego: Any, speeds: Any) -> None:
    """Set the target speeds of an ego that chooses between several speeds, as highway-env does."""
    if not isinstance(ego, MDPVehicle) or speeds is None:
        return
    # Otherwise, the index that the class has chosen for its speed is kept.
    if not np.array_equal(ego.target_speeds, speeds):
        ego.target_speeds = np.array(speeds)
        ego.speed_index = ego.speed_to_index(ego.speed)
        ego.target_speed = ego.index_to_speed(ego.speed_index)
