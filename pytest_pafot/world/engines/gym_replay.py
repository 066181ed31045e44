"""A second run of a scenario by independent code: ``env.step`` of the plain registered highway-env environment.

A finding depends on this package's own road, vehicles and loop. This module confirms it with highway-env's own code:
the environment of ``gymnasium.make``, its road and vehicle classes, observations, action types and frames per decision.
Only three parts are this package's: the NPCs' director, called in the road's ``act``; the contact test, called after
each step of the road; and the record.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import gymnasium
import numpy as np

from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Trace
from pytest_pafot.support.errors import WorldError
from pytest_pafot.world.driving.ads import AdsFactory, Planner, SelfDriving, is_vehicle_class, make_ads, wants_env
from pytest_pafot.world.driving.perception import ads_and_sight
from pytest_pafot.world.driving.policy import View, check_action_space, checked_action
from pytest_pafot.world.driving.seeing import PolicySight, policy_sight
from pytest_pafot.world.driving.vehicles import is_regulated
from pytest_pafot.world.engines.object_engine import VehiclesOfRun, decide, planner_of, step_ego
from pytest_pafot.world.engines.policy_engine import put_ego, put_new_ego
from pytest_pafot.world.guard.failure import UNFIT, closing, let_through
from pytest_pafot.world.guard.hang_guard import HangGuard
from pytest_pafot.world.gym_environment import GymEnvironment, vehicle_classes_kept, wrapper_names
from pytest_pafot.world.run_config import Rules
from pytest_pafot.world.stock import AbstractEnv, RegulatedRoad, RoadNetwork, Vehicle

TRAFFIC_HOOKS = ("_spawn_vehicle", "_clear_vehicles")
"""The methods with which highway-env's intersections change their traffic after each step."""


class StockVehicle(Vehicle):  # type: ignore[misc]
    """A highway-env vehicle with properties for its state, and with highway-env's own physics, lane search and shape.

    ``target_speed`` is its current speed, which highway-env's IDM then assumes to be the desired speed of a vehicle
    ahead.
    """

    @property
    def x(self) -> float:
        """The world coordinate x [m]."""
        return float(self.position[0])

    @property
    def y(self) -> float:
        """The world coordinate y [m]."""
        return float(self.position[1])

    @property
    def target_speed(self) -> float:
        """The current speed [m/s], which stands in for the desired speed."""
        return float(self.speed)

    @property
    def acceleration(self) -> float:
        """The acceleration of its current action [m/s^2]."""
        return float(self.action["acceleration"])

    @acceleration.setter
    def acceleration(self, value: float) -> None:
        self.control(value, self.steering)

    @property
    def steering(self) -> float:
        """The steering angle of its current action [rad]."""
        return float(self.action["steering"])

    def control(self, acceleration: float, steering: float) -> None:
        """Set acceleration [m/s^2] and steering angle [rad] through the vehicle's own ``act``."""
        super().act({"steering": steering, "acceleration": acceleration})


class StockPolicy:
    """The driver of the ego for a policy that observes and acts only through ``env.step``.

    ``outer`` is the environment, in its wrappers if it has any. ``view`` is a second environment, for a planner that
    simulates; it is updated before each decision.
    """

    def __init__(
        self, ads: Callable[[Any], Any], outer: Any, every: int, view: View | None, sight: PolicySight | None
    ) -> None:
        check_action_space(outer.action_space)
        self.vehicle = outer.unwrapped.vehicle
        self.every = every
        self.failure: BaseException | None = None
        self._seen: Any = None
        self._action: Any = None
        self._ads = ads
        self._outer = outer
        self._view = view
        self._sight = sight
        if sight is not None:
            sight.observe_through()

    def begin(self, seed: int) -> None:
        """Reset the environment for its first observation, but leave all vehicles at the scenario's start.

        Raises:
            WorldError: if the reset adds vehicles.
        """
        plain = self._outer.unwrapped
        vehicles = list(plain.road.vehicles)
        if type(plain).reset is AbstractEnv.reset:
            plain.reset = lambda **_: _reset_result(plain)
        plain._reset = lambda: None
        plain.action_space.seed(seed)
        self._see(lambda: self._outer.reset(seed=seed))
        plain.road.np_random = plain.np_random
        if plain.road.vehicles != vehicles:
            raise WorldError(
                f"env_id: expected an environment that makes its vehicles in `_reset`, received "
                f"{type(plain).__name__}, whose `reset` adds vehicles afterwards; make all vehicles in `_reset`"
            )

    def decide(self, tick: int) -> Any:
        """Call the ADS, and return its checked action, which the environment applies in the next step."""
        if self.failure is not None:
            raise self.failure
        if self._view is not None:
            with nullcontext() if self._sight is None else self._sight.shown():
                self._view.show(tick)
        self._action = checked_action(self._ads(self._seen), self._outer.action_space)
        return self._action

    def step(self) -> None:
        """Do the environment's step with the last action."""
        self._see(lambda: self._outer.step(self._action))

    def _see(self, call: Callable[[], tuple[Any, ...]]) -> None:
        """Store the observation of a reset or step; a wrapper's exception is raised later, in the next decision."""
        try:
            self._seen, *_ = call()
        except UNFIT as error:
            if self._outer is self._outer.unwrapped:
                raise
            let_through(error)
            self.failure = error

    def actuate(self) -> None:
        """Apply the low-level control of highway-env's controlled vehicles."""
        if self._sight is not None:
            self._sight.note()
        self.vehicle.act()


def _reset_result(env: Any) -> tuple[Any, dict[str, Any]]:
    """Return the result of highway-env's own reset for the current state."""
    seen = env.observation_type.observe()
    return seen, env._info(seen, env.action_space.sample())


Driver = Planner | SelfDriving | StockPolicy


def replay_highway(rules: Rules, scenario: Scenario, ads_factory: AdsFactory) -> Trace:
    """Repeat a run of a :class:`pytest_pafot.Highway` in highway-v0, with its lanes and speed limit."""
    lane, lanes = rules.straight.lanes[0], rules.straight.lane_count
    config = {
        "lanes_count": lanes,
        "vehicles_count": 0,
        "simulation_frequency": rules.physics_hz,
        "policy_frequency": rules.ads_hz,
        "action": {"type": "ContinuousAction"},
        "observation": {"type": "AttributesObservation", "attributes": ()},  # unused; this one is the fastest
    }
    env = _reset(gymnasium.make("highway-v0", config=config, disable_env_checker=True), scenario)
    env.road.network = RoadNetwork.straight_road_network(lanes, length=lane.length, speed_limit=lane.speed_limit)
    put_new_ego(env, StockVehicle, rules.ego_position(scenario), scenario.ego_speed, None)
    ads = make_ads(ads_factory)
    with closing(ads, rules.hang_limit):
        return _Loop(rules, scenario, env, _si_driver(rules, scenario, env, ads, None)).run()


def replay_environment(
    environment: GymEnvironment, rules: Rules, scenario: Scenario, ads_factory: AdsFactory, *, is_planner: bool
) -> Trace:
    """Simulate a run of a :class:`pytest_pafot.World` with ``env.step`` of its environment, in all wrappers."""
    outer, route = environment.make(), environment.route
    env = _reset(outer, scenario)
    is_policy, view = not (is_planner or is_vehicle_class(ads_factory)), None
    vehicle_class = env.action_type.vehicle_class if is_policy else StockVehicle
    put_new_ego(env, vehicle_class, rules.ego_position(scenario), scenario.ego_speed, route)
    if is_policy and wants_env(ads_factory):
        if environment.wrappers is not None:
            raise WorldError(
                f"wrappers: expected no wrappers= for a factory with a parameter `env`, received "
                f"{', '.join(wrapper_names(outer)) or 'wrappers=[]'}; leave wrappers= out, because a planner that "
                f"simulates inside the environment uses the environment's observations and actions without wrappers"
            )
        view = View(environment.make().unwrapped, env)
    ads = make_ads(ads_factory) if view is None else make_ads(ads_factory, env=view.env)
    if is_vehicle_class(ads):
        return _Loop(rules, scenario, env, _si_driver(rules, scenario, env, ads, route)).run()
    if is_planner:
        with closing(ads, rules.hang_limit):
            return _Loop(rules, scenario, env, _si_driver(rules, scenario, env, ads, route)).run()
    seen = env if environment.wrappers is None else outer
    with closing(ads, rules.hang_limit):
        ads, sight = ads_and_sight(ads)
        policy = StockPolicy(ads, seen, rules.physics_hz // rules.ads_hz, view, policy_sight(env, sight, scenario))
        return _Loop(rules, scenario, env, policy).run()


def _reset(outer: Any, scenario: Scenario) -> Any:
    """Reset an environment, disable its methods that add traffic later, and return it without wrappers."""
    env = outer.unwrapped
    with vehicle_classes_kept():
        env.reset(seed=0)
    for name in TRAFFIC_HOOKS:
        if hasattr(env, name):
            setattr(env, name, _nothing)
    env.road.np_random = env.np_random = np.random.default_rng(scenario.seed)
    return env


def _si_driver(
    rules: Rules, scenario: Scenario, env: Any, ads: Any, route: tuple[Any, ...] | None
) -> Planner | SelfDriving:
    """Make the driver of an ego that does not use the environment's observations and actions.

    Observations, rewards and infos are disabled. Observations would take longer than all the rest, and some
    environments compute rewards only for their own egos.
    """
    driver: Planner | SelfDriving
    if is_vehicle_class(ads):
        env.config["policy_frequency"] = env.config["simulation_frequency"]  # such a vehicle decides in every tick
        driver = SelfDriving(ads, env.road, rules.ego_position(scenario), scenario.ego_speed, route)
        put_ego(env, driver.vehicle, None)
    else:
        env.config["policy_frequency"] = rules.ads_hz
        ads, sight = ads_and_sight(ads)
        driver = planner_of(rules, scenario, env.road, ads, sight, env.vehicle)
    env.observation_type.observe = env._reward = env._info = _nothing
    return driver


def _nothing(*_: Any, **__: Any) -> None:
    """Do nothing, in place of a method of the environment."""


class _Loop:
    """One episode, with the NPCs' director added to the road's ``act``, and the record to its ``step``."""

    def __init__(self, rules: Rules, scenario: Scenario, env: Any, driver: Driver) -> None:
        def npc(x: float, y: float, heading: float, speed: float) -> StockVehicle:
            vehicle = StockVehicle(env.road, [x, y], heading, speed)
            vehicle.check_collisions = False
            return vehicle

        self._env, self._driver, self._guard = env, driver, HangGuard(rules.hang_limit)
        self._traffic = VehiclesOfRun(rules, scenario, driver, npc)
        env.road.vehicles = self._traffic.vehicles
        self._last = rules.ticks(scenario)
        self._ended: Trace | None = None
        if isinstance(env.road, RegulatedRoad) and not is_regulated(driver.vehicle):
            env.road.enforce_road_rules = _nothing  # without effect here, and slow
        self._road_step = env.road.step
        env.road.act, env.road.step = self._act, self._step

    def __deepcopy__(self, memo: object) -> _Loop:
        """Return itself, because highway-env deep-copies vehicles and their road to predict them."""
        return self

    def run(self) -> Trace:
        """Decide and step until the run ends, and return its trace."""
        driver, record = self._driver, self._traffic.record
        with self._guard as guard:
            if isinstance(driver, StockPolicy):
                driver.begin(record.scenario.seed)
            while record.tick < self._last:
                tick = record.tick
                error = decide(driver, tick, record, guard)
                if error is not None:
                    return record.trace(error=error)
                if isinstance(driver, StockPolicy):
                    driver.step()
                else:  # the driver has set the ego's controls, and None does not change them
                    AbstractEnv.step(self._env, None)
                if self._ended is not None:
                    return self._ended
                if record.tick == tick and getattr(driver, "failure", None) is None:
                    raise WorldError(
                        f"wrappers: expected that a step of the wrappers steps the environment, received a step that "
                        f"did not, at {tick / record.rules.physics_hz:.1f} s; leave out wrappers that end or reset "
                        f"episodes"
                    )
        return record.trace()

    def _act(self) -> None:
        """Control the ego and then the NPCs; this replaces ``Road.act``, which calls each vehicle's ``act``."""
        self._driver.actuate()
        if not self._is_over:
            self._traffic.command()

    def _step(self, dt: float) -> None:
        """Call ``Road.step``; then record and test for contact, unless the run has already ended."""
        record = self._traffic.record
        error = step_ego(record.tick, self._guard, lambda: self._road_step(dt))
        if not self._is_over:
            self._ended = self._traffic.note() if error is None else record.trace(error=error)

    @property
    def _is_over(self) -> bool:
        return self._ended is not None or self._traffic.record.tick == self._last
