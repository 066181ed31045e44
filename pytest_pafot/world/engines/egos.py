"""Runs of planners in SI units, and of vehicle classes on :class:`pytest_pafot.Highway`."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

from pytest_pafot.model.scenario import Scenario, rng_of
from pytest_pafot.model.sight import Sight
from pytest_pafot.model.vehicle_type import CAR, VehicleType
from pytest_pafot.support.errors import WorldError
from pytest_pafot.world.driving.ads import give_route
from pytest_pafot.world.driving.idm_model import idm_model
from pytest_pafot.world.driving.perception import ads_and_sight
from pytest_pafot.world.engines.run import SteppedRun, VehiclesOfRun
from pytest_pafot.world.guard.hang_guard import HangGuard
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.idm import GoalVehicle
from pytest_pafot.world.kernel.loop import GivenDriver, ModelDriver, PlannerDriver
from pytest_pafot.world.roads.straight import StraightRoad
from pytest_pafot.world.run_config import Rules


def planner_run(
    rules: Rules,
    scenario: Scenario,
    stock_road: Callable[[], Any],
    ads: Callable[[Any], Any],
    guard: HangGuard,
    *,
    decisions: Sequence[Any] = (),
    body: Body | None = None,
) -> SteppedRun:
    """Begin a run of a planner in SI units, on any road.

    Args:
        rules, scenario: the world's rules, and a scenario that fits them.
        stock_road: returns the road as a road of highway-env, which not every run needs.
        ads: the planner.
        guard: the guard of its decisions.
        decisions: the first decisions of the run, which replace calls of the planner.
        body: the ego, in place of its usual body.
    """
    decides, sight = ads_and_sight(ads)
    ego = body or Body(rules.ego.length, rules.ego.width)
    ego.place(*rules.ego_position(scenario), rules.ego_speed(scenario))
    vehicles = VehiclesOfRun(rules, scenario, ego, stock_road)
    return SteppedRun(vehicles, planner_driver(vehicles, decides, guard, sight, decisions), guard)


def planner_driver(
    vehicles: VehiclesOfRun,
    ads: Callable[[Any], Any] | None,
    guard: HangGuard,
    sight: Sight | None,
    decisions: Sequence[Any] = (),
    *,
    rules: Rules | None = None,
) -> GivenDriver:
    """Return the driver of an ego for a planner in SI units; the arguments are those of :func:`planner_run`.

    ``ads`` is None if the decisions are passed in, and ``sight`` for perfect sight. ``rules`` may have another rate of
    decisions than those of the run.
    """
    rules, scenario, road = rules or vehicles.rules, vehicles.scenario, vehicles.rules.road
    every = rules.physics_hz // rules.ads_hz
    sensor = road.sensor(vehicles.places, vehicles.rows, scenario, (rules.physics_hz, every), sight, rules.ego)
    common: dict[str, Any] = {"lanes": road.lane_count, "lane_width": road.lane_width}
    common |= {"every": every, "dt": 1 / rules.physics_hz, "kind": rules.ego if rules.ego.has_limits else None}
    ego, place = vehicles.vehicles[0], vehicles.places.bodies[0]
    if ads is None:
        return GivenDriver(ego, place, sensor, **common)
    return PlannerDriver(ads, guard, decisions, ego, place, sensor, **common)


def vehicle_run(
    rules: Rules, scenario: Scenario, road: StraightRoad, network: Callable[[], Any], vehicle_class: Any
) -> SteppedRun:
    """Begin a run of a highway-env vehicle class, which drives itself, on a straight road that starts at the origin."""
    vehicle_class = built_as(rules.ego, vehicle_class)
    guard, start, model = HangGuard(rules.hang_limit), rules.ego_position(scenario), idm_model(vehicle_class)

    def stock_road() -> Any:
        from pytest_pafot.world.stock import Road  # noqa: PLC0415  (a second of imports)

        return Road(network(), np_random=rng_of(scenario.seed))

    if model is not None:
        ego = GoalVehicle(model.constants, road.grid, road.speed_limit)
        ego.start(*start, rules.ego_speed(scenario), model.changes_lanes)
        vehicles = VehiclesOfRun(rules, scenario, ego, stock_road)
        return SteppedRun(vehicles, ModelDriver(ego, vehicles.vehicles[1:]), guard)
    from pytest_pafot.world.driving.object_driver import ObjectDriver  # noqa: PLC0415  (a second of imports)

    on = stock_road()
    driver = ObjectDriver(vehicle_of(vehicle_class, on, start, rules.ego_speed(scenario), None), on, guard)
    vehicles = VehiclesOfRun(rules, scenario, driver.ego, lambda: on)
    driver.show(vehicles.places, road)
    return SteppedRun(vehicles, driver, guard)


def built_as(kind: VehicleType, vehicle_class: Any) -> Any:
    """Return a vehicle class of highway-env, or a ``functools.partial`` of one, as an ego that is a given vehicle.

    An ego that is a car, which is what a world has unless the user says otherwise, has the size of its class.

    Raises:
        WorldError: if the class has another size of its own.
    """
    if kind == CAR:
        return vehicle_class
    if isinstance(vehicle_class, functools.partial):
        made = built_as(kind, vehicle_class.func)
        return functools.partial(made, *vehicle_class.args, **vehicle_class.keywords)
    size, own = (kind.length, kind.width), (vehicle_class.LENGTH, vehicle_class.WIDTH)
    if own not in (size, (CAR.length, CAR.width)):
        name = vehicle_class.__name__
        expected = f"the size that {name} has itself, {own[0]:g} x {own[1]:g} m"
        fix = f"leave out ego= of the world, or LENGTH and WIDTH of {name}"
        raise WorldError(field="ego", expected=expected, received=kind.described, fix=fix)

    def clip_actions(self: Any) -> None:
        vehicle_class.clip_actions(self)
        wanted = self.action["acceleration"], self.action["steering"]
        self.action["acceleration"], self.action["steering"] = kind.limited(*wanted, self.speed)

    namespace: dict[str, Any] = {"LENGTH": size[0], "WIDTH": size[1], "__module__": vehicle_class.__module__}
    if kind.has_limits:  # else the kernel drives a class that only sets constants
        namespace["clip_actions"] = clip_actions
    return type(vehicle_class)(vehicle_class.__name__, (vehicle_class,), namespace)


def vehicle_of(
    vehicle_class: Any, road: Any, start: tuple[float, float, float], speed: float, route: Sequence[Any] | None
) -> Any:
    """Return a new ego on a road of highway-env at x [m], y [m], heading [rad] and speed [m/s].

    highway-env's own check of collisions is turned off, because this package tests for contact itself.
    """
    x, y, heading = start
    vehicle = vehicle_class(road, [x, y], heading, speed)
    vehicle.check_collisions = False
    give_route(vehicle, route)
    return vehicle
