"""Runs of scenarios with ``env.step`` of a registered highway-env environment.

This module confirms findings with highway-env's own road, vehicles, observations, action types and frames. Only the
following parts come from this package: the director of the NPCs, which the road's ``act`` calls; the check for contact
after each step of the road; the record; and the observations and controls of planners in SI units.

This is the only engine for environments with wrappers or a user's ``step``.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from types import MethodType
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium.wrappers import TimeLimit

from pytest_pafot.model.scenario import Scenario, rng_of
from pytest_pafot.model.trace import AdsError, Trace
from pytest_pafot.support.errors import WorldError
from pytest_pafot.support.text import plural
from pytest_pafot.world.driving.environment import (
    GuardedDriver,
    ObjectDriver,
    View,
    body_of,
    check_action_space,
    checked_action,
    follow,
    foresee,
    hide,
)
from pytest_pafot.world.driving.policy import Ads, Policy, Unseeing
from pytest_pafot.world.driving.vehicles import StockVehicle, Traffic, TrafficClass, is_regulated
from pytest_pafot.world.engines.policies import (
    give_speeds,
    put_ego,
    put_policys_ego,
    showing,
    usual_class,
)
from pytest_pafot.world.engines.run import (
    OwnEnds,
    VehiclesOfRun,
    built_as,
    planner_driver,
    vehicle_of,
)
from pytest_pafot.world.guard.hang_guard import (
    UNFIT,
    AdsHang,
    HangGuard,
    WorldHang,
    closing,
    error_of,
    let_through,
)
from pytest_pafot.world.gym_environment import (
    ENDS,
    EnvironmentGuard,
    GymEnvironment,
    has_own_act,
    obstacles_of,
    vehicle_classes_kept,
    wrapper_names,
    wrappers_of,
)
from pytest_pafot.world.kernel.lanes import Body
from pytest_pafot.world.kernel.loop import EgoDriver, Loop, PlannerDriver
from pytest_pafot.world.limits import ADS_HZ, check_divides, whole_within
from pytest_pafot.world.plausible import Implausible, Plausibility
from pytest_pafot.world.run_config import Rules
from pytest_pafot.world.stock import AbstractEnv, RegulatedRoad, RoadNetwork

# highway-env's intersections change their traffic with these methods after each step.
TRAFFIC_HOOKS = ("_spawn_vehicle", "_clear_vehicles")


class StockPolicy(GuardedDriver):
    """The driver of an ego with a policy that observes and acts only through ``env.step``.

    ``outer`` is the environment in its wrappers. ``view`` is a second environment in which a planner can simulate. It
    is updated before each decision.
    """

    def __init__(
        self,
        ads: Callable[[Any], Any],
        outer: Any,
        ego: Body,
        every: int,
        guard: HangGuard,
        view: View | None,
    ) -> None:
        plain = outer.unwrapped
        check_action_space(plain.action_space)
        if outer.action_space is not plain.action_space:
            check_action_space(outer.action_space, wrapper_names(outer))
        super().__init__(ego, every, guard)
        self.failure: BaseException | None = None
        self.is_over = False
        self._seen: Any = None
        self._action: Any = None
        self._ads = ads
        self.outer = outer
        self._view = view
        if isinstance(ads, Unseeing):
            hide(outer.unwrapped, ads.npc)

    def begin(
        self, around: EnvironmentGuard, seed: int, objects: Sequence[Any], hold: Callable[[], None]
    ) -> None:
        """Reset the environment for its first observation, but keep all vehicles at the scenario's start positions.

        Raises:
            WorldHang: if the environment or a wrapper does not return in time.
        """
        with around.call():
            self._see(lambda: _reset_in_place(self.outer, seed, objects, hold))

    def make_decision(self, tick: int) -> Any:
        if self.failure is not None:
            raise self.failure
        if self._view is not None:
            self._view.show(tick)
        self._action = checked_action(self._ads(self._seen), self.outer.action_space)
        return self._action

    def take_step(self, around: EnvironmentGuard) -> None:
        """Run a step of the environment with the last action.

        Raises:
            WorldHang: if the environment or a wrapper does not return in time.
        """
        with around.call():
            self._see(lambda: self.outer.step(self._action))

    def _see(self, call: Callable[[], tuple[Any, ...]]) -> None:
        # An exception of a wrapper is raised again in the next decision.
        try:
            self._seen, *others = result = call()
            # a reset returns only one more value, the info
            self.is_over = len(others) != 1 and _has_ended(result)
        except UNFIT as error:
            if self.outer is self.outer.unwrapped or isinstance(error, AdsHang):
                raise
            let_through(error)
            self.failure = error

    def actuate(self) -> None:
        self.outer.unwrapped.vehicle.act()


def _reset_in_place(
    outer: Any, seed: int, objects: Sequence[Any], hold: Callable[[], None]
) -> tuple[Any, ...]:
    """Reset an environment and its wrappers without moving any vehicle, and return the result.

    ``objects`` are the objects that :func:`_reset` returned. ``hold`` prevents code from moving NPCs. It is called
    before a user's ``reset``, and after highway-env's.
    """
    plain = outer.unwrapped

    # highway-env's `_reset` would make new vehicles, so this function replaces it.
    def in_place_of_the_reset() -> None:
        # a copy, because the environment's own `reset` may add objects
        plain.road.objects = list(objects)
        # a reset may have drawn the speeds
        if type(plain.vehicle) is usual_class(plain.action_type):
            give_speeds(plain.vehicle, getattr(plain.action_type, "target_speeds", None))

    def in_place_of_highway_envs(
        options: Mapping[str, Any] | None = None, **_: Any
    ) -> tuple[Any, dict[str, Any]]:
        result = _reset_result(plain, seed, options)
        hold()
        return result

    # A user's `reset` is called, and in turn calls highway-env's `reset` with the replaced `_reset`. Without a user's
    # `reset`, the effects of highway-env's `reset` are repeated, and NPCs are held afterwards.
    if type(plain).reset is AbstractEnv.reset:
        plain.reset = in_place_of_highway_envs
    else:
        hold()
    plain._reset = in_place_of_the_reset
    plain.action_space.seed(seed)
    try:
        result: tuple[Any, ...] = outer.reset(seed=seed)
    finally:
        plain.road.np_random = plain.np_random
    return result


def _reset_result(
    env: Any, seed: int, options: Mapping[str, Any] | None
) -> tuple[Any, dict[str, Any]]:
    # Return the result of highway-env's own `reset`, with the configuration that wrappers have set.
    env.configure((options or {}).get("config"))
    env.define_spaces()
    env._reset()
    env.define_spaces()
    env.action_space.seed(seed)
    seen = env.observation_type.observe()
    return seen, env._info(seen, env.action_space.sample())


def replay_highway(rules: Rules, scenario: Scenario, policy: Policy) -> Trace:
    """Repeat a run of a :class:`pytest_pafot.Highway` in highway-v0, with the same lanes and speed limit."""
    lane, lanes = rules.road.lanes[0], rules.road.lane_count
    config = {
        "lanes_count": lanes,
        "vehicles_count": 0,
        "simulation_frequency": rules.physics_hz,
        "policy_frequency": rules.ads_hz,
        "action": {"type": "ContinuousAction"},
        # unused, so this is the fastest type
        "observation": {"type": "AttributesObservation", "attributes": ()},
    }
    env, _ = _reset(gymnasium.make("highway-v0", config=config, disable_env_checker=True), scenario)
    env.road.network = RoadNetwork.straight_road_network(
        lanes, length=lane.length, speed_limit=lane.speed_limit
    )
    ads = policy.make()
    with closing(ads.given, rules.hang_limit):
        return _si_run(rules, scenario, env, ads)


def replay_environment(
    environment: GymEnvironment,
    rules: Rules,
    scenario: Scenario,
    policy: Policy,
    *,
    is_planner: bool,
) -> Trace:
    """Simulate a run of a :class:`pytest_pafot.World` with ``env.step`` of its environment."""
    outer, route = environment.make(), environment.route
    env, objects = _reset(outer, scenario, environment)
    # A policy needs an ego of the environment. A planner that simulates also needs a second environment.
    view, traffic = (
        None,
        environment.traffic if rules.ends or not (is_planner or policy.drives_itself) else None,
    )
    if not (is_planner or policy.drives_itself):
        put_policys_ego(environment, env, rules, scenario)
    if policy.simulates:
        if environment.wrappers is not None:
            raise WorldError(
                f"wrappers: expected no wrappers= for a factory with the parameter `env`, received "
                f"{', '.join(wrapper_names(outer)) or 'wrappers=[]'}. Omit wrappers=, because a planner that "
                f"simulates inside the environment uses the environment's observations and actions without wrappers"
            )
        view = View(environment.make().unwrapped, env)
    ads = policy.make() if view is None else policy.make(env=view.env)
    if ads.drives_itself:
        return _si_run(rules, scenario, env, ads, route, traffic)
    with closing(ads.given, rules.hang_limit):
        if is_planner:
            return _si_run(rules, scenario, env, ads, route, traffic)
        seen, ego, guard = (
            env if environment.wrappers is None else outer,
            body_of(env.vehicle),
            HangGuard(rules.hang_limit),
        )
        driver = StockPolicy(ads.policy, seen, ego, rules.every, guard, view)
        # any wrappers count the steps
        limit = environment.step_limit if environment.wrappers is None else None
        vehicles = VehiclesOfRun(rules, scenario, ego, lambda: env.road)
        return _Loop(vehicles, env, driver, guard, traffic, objects, limit).run()


def _reset(
    outer: Any, scenario: Scenario, environment: GymEnvironment | None = None
) -> tuple[Any, list[Any]]:
    """Reset an environment, disable the methods that add traffic later, and return it without wrappers.

    The second return value is the list of objects that the reset has put on the road.
    """
    env = outer.unwrapped
    if environment is not None:
        # because this reset makes the road
        env.config |= copy.deepcopy(environment.config_of_wrappers)
    objects, put = list[Any](), env._reset

    def noting_objects() -> None:
        put()
        objects[:] = env.road.objects

    env._reset = noting_objects
    with vehicle_classes_kept(), nullcontext() if environment is None else environment.in_time():
        env.reset(seed=0)
    env._reset = put
    for name in TRAFFIC_HOOKS:
        if hasattr(env, name):
            setattr(env, name, _nothing)
    env.road.np_random = env.np_random = rng_of(scenario.seed)
    return env, objects


def _si_run(
    rules: Rules,
    scenario: Scenario,
    env: Any,
    ads: Ads,
    route: tuple[Any, ...] | None = None,
    traffic: TrafficClass | None = None,
) -> Trace:
    # The ego does not use the environment's observations and actions. Observations would take longer than all the
    # rest, and some environments compute rewards only for their own egos, so both are disabled.
    guard, start = HangGuard(rules.hang_limit), rules.ego_position(scenario)
    # A vehicle class decides in every tick.
    env.config["policy_frequency"] = (
        env.config["simulation_frequency"] if ads.drives_itself else rules.ads_hz
    )
    ego_class = built_as(rules.ego, ads.given if ads.drives_itself else StockVehicle)
    put_ego(env, vehicle_of(ego_class, env.road, start, rules.ego_speed(scenario), route))
    ego = body_of(env.vehicle)
    vehicles = VehiclesOfRun(rules, scenario, ego, lambda: env.road)
    driver: EgoDriver
    if ads.drives_itself:
        driver = ObjectDriver(env.vehicle, env.road, guard, ego=ego)
    else:
        driver = planner_driver(vehicles, ads.decides, guard, ads.sight)
    env.observation_type.observe = env._reward = env._info = _nothing
    return _Loop(vehicles, env, driver, guard, traffic).run()


class EpisodeEnds(OwnEnds):
    """The detection of an episode's end by a wrapped environment's ``step``, in a run that moves the vehicles itself.

    The run replaces only the simulation in ``step``. So an episode ends at the same tick as with ``env.step``, unless
    its end depends on the action. If the environment has an action without effect, each step uses it.
    """

    def __init__(
        self,
        environment: GymEnvironment,
        outer: Any,
        objects: Sequence[Any],
        rules: Rules,
        scenario: Scenario,
        vehicles: VehiclesOfRun,
        guard: HangGuard,
    ) -> None:
        super().__init__(outer.unwrapped, ENDS, rules, guard)
        self._environment = environment
        self._outer, self._loop, self._last = outer, vehicles.loop, rules.ticks(scenario)
        self._around = EnvironmentGuard(rules.hang_limit)
        self._begin: Callable[[], None] = partial(self._reset, objects, scenario.seed, vehicles)
        self._put: Callable[[], None] = _nothing
        self._move: Callable[[], AdsError | None] = _nothing
        self._error: AdsError | None = None

    def _reset(self, objects: Sequence[Any], seed: int, vehicles: VehiclesOfRun) -> None:
        """Reset the environment, and replace its simulation with the simulation of the run."""
        outer, env = self._outer, self._env
        _reset_in_place(outer, seed, objects, _nothing)
        self._put = showing(self._environment, env, vehicles)
        stand_in(env, "_simulate", self._simulate)
        for name in ENDS:
            stand_in(env, name, partial(self._says, name))
        space, names = outer.action_space, getattr(env.action_type, "actions_indexes", {})
        space.seed(seed)
        self._action = space.sample()
        if isinstance(space, gymnasium.spaces.Box):
            self._action = np.clip(np.zeros_like(self._action), space.low, space.high)
        elif space is env.action_space and "IDLE" in names:
            self._action = names["IDLE"]

    def step(self, move: Callable[[], AdsError | None], loop: Loop) -> AdsError | None:
        """Run a step of the wrapped environment, simulated by ``move``, and return the policy's error or None."""
        self._move, self.asked = move, loop.tick
        try:
            begin, self._begin = self._begin, _nothing  # before the first step
            with self._around as around, around.call():
                begin()
                is_over = _has_ended(self._outer.step(self._action))
        except WorldHang as error:
            return self._error or error_of(error, loop.tick, self._guard)
        except UNFIT as error:
            failed = error_of(error, self.asked, self._guard).text
            self.ended, self.has_failed = f"{end_of(self._outer)} failed: {failed}", True
        else:
            if loop.tick == self.asked:  # a user's step that simulates nothing
                self._simulate()
            # keep the name of a method that ended it, unless a wrapper continues
            if not self.has_failed:
                self.ended = (self.ended or end_of(self._outer)) if is_over else ""
        return self._error

    def _simulate(self, *_: Any) -> None:
        if not self._is_over:
            with self._around.paused():
                self._error = self._move()
        self._put()
        self._env.steps = self._loop.tick

    def _says(self, name: str) -> bool:
        return self._is_over or self.says(name)  # see _Loop._says

    @property
    def _is_over(self) -> bool:
        return self._error is not None or self._loop.is_over or self._loop.tick == self._last


def episode_beside(
    environment: GymEnvironment,
    rules: Rules,
    scenario: Scenario,
    vehicles: VehiclesOfRun,
    guard: HangGuard,
) -> EpisodeEnds:
    """Return the ``EpisodeEnds`` of a wrapped environment for an ego that does not belong to the environment."""
    outer = environment.make()
    env, objects = _reset(outer, scenario, environment)
    put_policys_ego(environment, env, rules, scenario)
    return EpisodeEnds(environment, outer, objects, rules, scenario, vehicles, guard)


def stand_in(env: Any, name: str, call: Callable[..., Any]) -> None:
    """Replace a method of an environment with ``call``.

    Copies of the environment, in which a user's code looks ahead, keep the original method.
    """

    def method(asked: Any, *given: Any, **named: Any) -> Any:
        return (
            call(*given, **named)
            if asked is env
            else getattr(type(asked), name)(asked, *given, **named)
        )

    setattr(env, name, MethodType(method, env))


def _has_ended(result: Sequence[Any]) -> bool:
    # Steps of the old gym API return other values in the third and fourth position.
    if len(result) != 5:
        raise ValueError(
            "step: expected (observation, reward, terminated, truncated, info), as in gymnasium, received "
            f"{len(result)} values. Return both terminated and truncated"
        )
    return bool(result[2]) or bool(result[3])


def end_of(outer: Any) -> str:
    """Return the name of the step limit, wrappers or ``step`` that ended an episode, if no other method did."""
    limits = [each for each in wrappers_of(outer) if isinstance(each, TimeLimit)]
    passed = [
        each._max_episode_steps for each in limits if each._elapsed_steps == each._max_episode_steps
    ]
    said = " in ".join(wrapper_names(outer)) or f"{type(outer.unwrapped).__name__}.step"
    return f"max_episode_steps={passed[0]}" if passed else said


def _nothing(*_: Any, **__: Any) -> None:
    """Do nothing, in place of a method of the environment."""


class _Loop:
    """The loop of an episode. The road's ``act`` also calls the director of the NPCs, and its ``step`` records them."""

    def __init__(
        self,
        vehicles: VehiclesOfRun,
        env: Any,
        driver: EgoDriver,
        guard: HangGuard,
        traffic: TrafficClass | None = None,
        objects: Sequence[Any] = (),
        step_limit: int | None = None,
    ) -> None:
        self._env, self._driver, self._guard, self._run, self._objects = (
            env,
            driver,
            guard,
            vehicles,
            objects,
        )
        self._around = EnvironmentGuard(vehicles.rules.hang_limit)
        self._hz = vehicles.rules.ads_hz
        self._step_limit = step_limit
        self._bodies = vehicles.vehicles
        self._plausibility = Plausibility(self._states(), 1.0 / vehicles.rules.physics_hz)
        vehicles.plausibility = self._plausibility
        common = env.road, env.vehicle, vehicles.places, vehicles.rules.road
        self._class = traffic or TrafficClass(StockVehicle)
        self._traffic = Traffic(self._class, *common)
        self._vehicles = [env.vehicle, *self._traffic.vehicles]
        if not isinstance(driver, StockPolicy):  # a vehicle class sees NPCs without goals
            self._vehicles[1:] = Traffic(TrafficClass(StockVehicle), *common).vehicles
        self._find_contacts_alone()
        if not isinstance(driver, StockPolicy) or is_regulated(env.vehicle):
            foresee(self._vehicles[1:], vehicles.places, vehicles.rules.road)
        env.road.vehicles = list(self._vehicles)  # the environment's own code may change its list
        self._last = vehicles.rules.ticks(vehicles.scenario)
        self._asked: list[int] = []
        self._error: AdsError | None = None
        self._moved = ""  # how the environment's own code has moved an NPC
        if isinstance(env.road, RegulatedRoad) and not is_regulated(env.vehicle):
            env.road.enforce_road_rules = _nothing  # without effect here, and slow
        self._ends: OwnEnds | None = None
        if (ends := vehicles.rules.ends) is not None:
            # If the run is no episode, it calls the methods itself, because its steps may be shorter than decisions.
            is_episode = isinstance(driver, StockPolicy)
            self._ends = OwnEnds(env, ENDS if is_episode else ends, vehicles.rules, guard)
            for name in ENDS:
                stand_in(
                    env, name, partial(self._says, self._ends, name) if is_episode else _nothing
                )
        self._road_act = env.road.act if has_own_act(env.road) else None
        self._road_step = env.road.step
        env.road.act, env.road.step = self._act, self._step

    def __deepcopy__(self, memo: object) -> _Loop:
        # highway-env deep-copies vehicles and their road to predict motion.
        return self

    def run(self) -> Trace:
        try:
            with self._guard, self._around:
                try:
                    self._drive()
                except WorldHang as error:
                    self._error = error_of(error, self._run.loop.tick, self._guard)
            trace = self._run.trace(self._driver, self._error)
        finally:
            self._run.close()
        if not isinstance(self._driver, StockPolicy):
            return trace
        trace = replace(trace, ads_hz=self._hz)
        # A wrapper or the environment's own step may have repeated actions.
        return (
            trace
            if self._asked == list(trace.decision_ticks)
            else replace(trace, decided=tuple(self._asked))
        )

    def _says(self, ends: OwnEnds, name: str) -> bool:
        # A method also reports the end of the run. Otherwise, a wrapper that steps until the end of the episode would
        # never stop after a collision.
        return self._is_over or ends.says(name)

    def _drive(self) -> None:
        driver, loop, around = self._driver, self._run.loop, self._around
        if isinstance(driver, StockPolicy):
            # some environments slow their traffic down in `reset`
            hold = partial(self._make_npcs, "held")
            driver.begin(around, self._run.scenario.seed, self._objects, hold)
            self._make_npcs("seen")
            self._hz = self._rate()
            self._check_vehicles("reset")
            self._check_objects()
            self._find_contacts_alone()
        while not self._is_over:
            tick = loop.tick
            self._asked.append(tick)
            self._error = driver.decide(tick)
            if self._error is not None:
                break
            if isinstance(driver, StockPolicy):
                driver.take_step(around)
            else:  # the driver has set the ego's controls, and None does not change them
                with around.call():
                    AbstractEnv.step(self._env, None)
            self._check_vehicles("step")
            self._check_objects()
            if loop.tick == tick and not self._is_over and getattr(driver, "failure", None) is None:
                raise WorldError(
                    f"wrappers: expected each step of the wrappers to step the environment, received a step at "
                    f"{tick / self._run.rules.physics_hz:.1f} s that did not. Remove wrappers that end or reset "
                    f"episodes"
                )
            if self._ends is not None and not self._is_over:
                self._end(self._ends)

    def _end(self, ends: OwnEnds) -> None:
        run, driver = self._run, self._driver
        if isinstance(driver, StockPolicy):
            if len(self._asked) == self._step_limit and not ends.ended:
                ends.ended = f"max_episode_steps={self._step_limit}"
            elif driver.is_over and not ends.ended:
                ends.ended = end_of(driver.outer)
            elif not driver.is_over and not ends.has_failed:  # a wrapper continues
                ends.ended = ""
        elif run.loop.tick % ends.every == 0:
            road, self._env.road.vehicles = (
                self._env.road,
                [self._env.vehicle, *self._traffic.vehicles],
            )
            self._traffic.show()
            ends.ask(run.loop.tick)
            road.vehicles = list(self._vehicles)
        run.ended, run.has_failed = ends.ended, ends.has_failed

    def _rate(self) -> int:
        # The reset may have changed the environment's configuration.
        config, ticks = self._env.config, self._run.rules.physics_hz
        name, received = "config.simulation_frequency", config["simulation_frequency"]
        if received != ticks:
            fix = "set the same value in every reset"
            raise WorldError(
                field=name,
                expected=f"{ticks}, as after a reset with seed 0",
                received=f"{received!r:.100}",
                fix=fix,
            )
        hz = whole_within("config.policy_frequency", config["policy_frequency"], *ADS_HZ)
        check_divides((name, int(ticks)), ("config.policy_frequency", hz))
        return hz

    def _make_npcs(self, name: Literal["seen", "held", "moved"]) -> None:
        """Give every NPC a class derived from the traffic class, if a policy drives the ego."""
        for npc in self._vehicles[1:] if isinstance(self._driver, StockPolicy) else ():
            npc.__class__ = getattr(self._class, name)

    def _find_contacts_alone(self) -> None:
        # highway-env's own check of contacts with fixed objects would push the ego back.
        for each in self._env.road.objects:
            each.check_collisions = False

    def _check_vehicles(self, method: str) -> None:
        # A `reset` or `step` of the environment may add or remove vehicles, or move the NPCs.
        found, known = list(self._env.road.vehicles), self._vehicles
        added, removed = (
            [each for each in a if all(each is not one for one in b)]
            for a, b in ((found, known), (known, found))
        )
        changes = [
            f"{word} {plural(len(each), 'vehicle')}"
            for word, each in (("adds", added), ("removes", removed))
            if each
        ]
        if self._env.vehicle is not known[0]:
            changes.append("replaces the ego")
        if method == "step" and not changes and self._moved:
            changes.append(self._moved)
        if not changes:
            return
        raise WorldError(
            field="env_id",
            expected="an environment that does not change the vehicles of a run",
            received=f"{self._who}, whose `{method}` {' and '.join(changes)} at "
            f"{self._run.loop.tick / self._run.rules.physics_hz:.1f} s",
            fix="if the environment has other vehicles, create them in `_reset`, so that the NPCs can replace them. "
            "For a vehicle that appears, moves or leaves, use an NPC",
        )

    @property
    def _who(self) -> str:
        """The class names of the environment and its wrappers."""
        wrappers = wrapper_names(getattr(self._driver, "outer", self._env))
        return " in ".join([type(self._env).__name__, *wrappers])

    def _moved_npc(self) -> str:
        """Describe how the environment has moved an NPC since the last tick, or return an empty string."""
        for number, (vehicle, body) in enumerate(
            zip(self._vehicles[1:], self._bodies[1:], strict=True)
        ):
            if vehicle.speed != body.speed:
                return f"sets the speed of NPC {number} from {body.speed:.1f} to {vehicle.speed:.1f} m/s"
            if (*vehicle.position, vehicle.heading) != (body.x, body.y, body.heading):
                return f"moves NPC {number} from ({body.x:.1f}, {body.y:.1f}) m"
        return ""

    def _check_objects(self) -> None:
        # Reference drivers and verdicts would not know of objects that appear, move or disappear.
        known, found = set(self._run.rules.obstacles), set(obstacles_of(self._env))
        if known == found:
            return
        (x, y, *_), seconds = min(known ^ found), self._run.loop.tick / self._run.rules.physics_hz
        what = "an additional" if found > known else "a missing" if found < known else "a changed"
        raise WorldError(
            field="env_id",
            expected="an environment whose fixed objects never differ from those after a reset with seed 0",
            received=f"{type(self._env).__name__}, with {what} object at ({x:.1f}, {y:.1f}) m at {seconds:.1f} s",
            fix="create all objects in `_reset`, or create them at the same positions in each `reset`. For an object "
            "that appears or moves, use an NPC",
        )

    def _act(self) -> None:
        # Replaces `Road.act`, which calls each vehicle's `act`. A user's `act` is called for its effect on the ego.
        driver, (vehicle, *npcs), (ego, *bodies) = self._driver, self._vehicles, self._bodies
        # A `reset`, in which NPCs are held, may call the environment's `step`. A road's `act` may call the NPCs' `act`.
        self._make_npcs("seen" if self._road_act is None else "moved")
        if self._road_act is not None and isinstance(driver, StockPolicy):
            self._road_act()
        else:
            driver.actuate()
            if isinstance(driver, PlannerDriver):
                vehicle.control(ego.acceleration, ego.steering)
            # the ego has acted, and a user's class may act only once
            if self._road_act is not None:
                act = vehicle.act
                vehicle.act = lambda action=None: None if action is None else act(action)
                self._road_act()
                del vehicle.act
        if not self._is_over:
            self._moved = self._moved or self._moved_npc()
            self._run.loop.command()
            for npc, body in zip(npcs, bodies, strict=True):
                npc.action = {"steering": body.steering, "acceleration": body.acceleration}

    def _step(self, dt: float) -> None:
        loop = self._run.loop
        try:
            self._make_npcs("moved")
            try:
                self._road_step(dt)
            finally:
                self._make_npcs("seen")
            if self._is_over:
                return
            for vehicle, body in zip(self._vehicles, self._bodies, strict=True):
                follow(body, vehicle)
        except UNFIT as error:
            # it interrupts the whole step
            if isinstance(error, AdsHang) and self._around.interruption is not None:
                raise
            failed = error_of(error, loop.tick, self._guard)
            self._error = self._error if self._is_over else failed
            return
        try:
            if not self._moved:  # if the environment has moved NPCs, it is rejected after its step
                accelerations = [body.acceleration for body in self._bodies]
                self._plausibility.check(self._states(), f"{self._who}.step", accelerations)
        except Implausible as fault:  # the run ends, but not the environment's step
            self._run.ended, self._run.has_failed = str(fault), True
            return
        loop.moved()
        if isinstance(self._driver, StockPolicy):
            self._traffic.show_targets()

    def _states(self) -> list[tuple[float, float, float, float]]:
        return [(body.x, body.y, body.heading, body.speed) for body in self._bodies]

    @property
    def _is_over(self) -> bool:
        loop = self._run.loop
        return (
            loop.is_over
            or loop.tick == self._last
            or self._error is not None
            or bool(self._run.ended)
        )
