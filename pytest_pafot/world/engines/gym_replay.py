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
    make_ads,
    put_policys_ego,
    showing,
    usual_class,
)
from pytest_pafot.world.engines.run import (
    ADS_HZ,
    Implausible,
    OwnEnds,
    Plausibility,
    Rules,
    State,
    VehiclesOfRun,
    built_as,
    check_divides,
    make_ego,
    planner_driver,
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
    put_ego,
    refused_environment,
    vehicle_classes_kept,
    wrapper_names,
    wrappers_of,
)
from pytest_pafot.world.kernel.lanes import Body
from pytest_pafot.world.kernel.loop import EgoDriver, Loop, PlannerDriver
from pytest_pafot.world.limits import whole_within
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
        self.action: Any = None  # of the last decision
        self._ads = ads
        self.outer = outer
        self._view = view
        if isinstance(ads, Unseeing):
            hide(outer.unwrapped, ads.npc)

    def make_decision(self, tick: int) -> Any:
        if self.failure is not None:
            raise self.failure
        if self._view is not None:
            self._view.show(tick)
        self.action = checked_action(self._ads(self._seen), self.outer.action_space)
        return self.action

    def see(self, call: Callable[[], tuple[Any, ...]]) -> None:
        """Observe the result of a reset or a step of the environment.

        An exception of a wrapper is raised again in the next decision.
        """
        try:
            result = call()
            self._seen, *others = result
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
    env = outer.unwrapped

    def keep_vehicles() -> None:
        # a copy, because the environment's own `reset` may add objects
        env.road.objects = list(objects)
        # a reset may have drawn the speeds
        if type(env.vehicle) is usual_class(env.action_type):
            give_speeds(env.vehicle, getattr(env.action_type, "target_speeds", None))

    def reset(options: Mapping[str, Any] | None = None, **_: Any) -> tuple[Any, dict[str, Any]]:
        # The effects of highway-env's own `reset`, with the configuration that wrappers have set.
        env.configure((options or {}).get("config"))
        env.define_spaces()
        keep_vehicles()
        env.define_spaces()
        env.action_space.seed(seed)
        seen = env.observation_type.observe()
        info = env._info(seen, env.action_space.sample())
        hold()
        return seen, info

    # A user's `reset` is called, and in turn calls highway-env's `reset`. Without a user's `reset`, the effects of
    # highway-env's `reset` are repeated, and NPCs are held afterwards.
    if type(env).reset is AbstractEnv.reset:
        env.reset = reset
    else:
        hold()
    env._reset = keep_vehicles  # highway-env's `_reset` would make new vehicles
    env.action_space.seed(seed)
    try:
        result: tuple[Any, ...] = outer.reset(seed=seed)
    finally:
        env.road.np_random = env.np_random
    return result


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
    outer = environment.make()
    env, objects = _reset(outer, scenario, environment)
    has_wrappers = environment.wrappers is not None
    needs_ego = not (is_planner or policy.drives_itself)
    traffic = view = None
    if rules.ends or needs_ego:
        traffic = environment.traffic
    # A policy needs an ego of the environment. A planner that simulates also needs a second environment.
    if needs_ego:
        put_policys_ego(environment, env, rules, scenario)
    if policy.simulates:
        if has_wrappers:
            raise WorldError(
                f"wrappers: expected no wrappers= for a factory with the parameter `env`, received "
                f"{', '.join(wrapper_names(outer)) or 'wrappers=[]'}. Omit wrappers=, because a planner that "
                f"simulates inside the environment uses the environment's observations and actions without wrappers"
            )
        view = View(environment.make().unwrapped, env)
    ads = make_ads(policy, view)
    if ads.drives_itself:
        return _si_run(rules, scenario, env, ads, environment.route, traffic)
    with closing(ads.given, rules.hang_limit):
        if is_planner:
            return _si_run(rules, scenario, env, ads, environment.route, traffic)
        seen, limit = env, environment.step_limit
        if has_wrappers:  # which count the steps themselves
            seen, limit = outer, None
        ego = body_of(env.vehicle)
        guard = HangGuard(rules.hang_limit)
        driver = StockPolicy(ads.policy, seen, ego, rules.every, guard, view)
        vehicles = VehiclesOfRun(rules, scenario, ego, lambda: env.road)
        return _Loop(vehicles, env, driver, guard, traffic, objects, limit).run()


def _reset(
    outer: Any, scenario: Scenario, environment: GymEnvironment | None = None
) -> tuple[Any, list[Any]]:
    """Reset an environment, disable the methods that add traffic later, and return it without wrappers.

    The second return value is the list of objects that the reset has put on the road.
    """
    env = outer.unwrapped
    in_time: Any = nullcontext()
    if environment is not None:
        # The wrappers may have changed the configuration, and the reset below makes the road.
        if environment.wrapper_names:
            env.config |= copy.deepcopy(environment.unwrapped.config)
        in_time = environment.in_time()
    objects: list[Any] = []
    reset = env._reset

    def noting_objects() -> None:
        reset()
        objects[:] = env.road.objects

    env._reset = noting_objects
    with vehicle_classes_kept(), in_time:
        env.reset(seed=0)
    env._reset = reset
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
    guard = HangGuard(rules.hang_limit)
    vehicle_class: Any = StockVehicle
    env.config["policy_frequency"] = rules.ads_hz
    if ads.drives_itself:  # it decides in every tick
        vehicle_class = ads.given
        env.config["policy_frequency"] = env.config["simulation_frequency"]
    vehicle_class = built_as(rules.ego, vehicle_class)
    put_ego(env, make_ego(rules, scenario, vehicle_class, env.road, route))
    ego = body_of(env.vehicle)
    vehicles = VehiclesOfRun(rules, scenario, ego, lambda: env.road)
    if ads.drives_itself:
        driver: EgoDriver = ObjectDriver(env.vehicle, env.road, guard, ego=ego)
    else:
        driver = planner_driver(vehicles, ads.decides, guard, ads.sight)
    # The ego does not use the environment's observations and actions. Observations would take longer than all the
    # rest, and some environments compute rewards only for their own egos, so both are disabled.
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
        vehicles: VehiclesOfRun,
        guard: HangGuard,
    ) -> None:
        rules = vehicles.rules
        super().__init__(outer.unwrapped, ENDS, rules, guard)
        self._environment = environment
        self._outer = outer
        self._loop = vehicles.loop
        self._last = rules.ticks(vehicles.scenario)
        self._around = EnvironmentGuard(rules.hang_limit)
        self._begin: Callable[[], None] = partial(self._reset, objects, vehicles)
        self._put: Callable[[], None] = _nothing
        self._move: Callable[[], AdsError | None] = _nothing
        self._error: AdsError | None = None

    def _reset(self, objects: Sequence[Any], vehicles: VehiclesOfRun) -> None:
        """Reset the environment, and replace its simulation with the simulation of the run."""
        env = self._env
        seed = vehicles.scenario.seed
        _reset_in_place(self._outer, seed, objects, _nothing)
        self._put = showing(self._environment, env, vehicles)
        stand_in(env, "_simulate", self._simulate)
        for name in ENDS:
            stand_in(env, name, partial(self._says, name))
        space = self._outer.action_space
        names = getattr(env.action_type, "actions_indexes", {})
        space.seed(seed)
        self._action = space.sample()
        if isinstance(space, gymnasium.spaces.Box):
            self._action = np.clip(np.zeros_like(self._action), space.low, space.high)
        elif space is env.action_space and "IDLE" in names:
            self._action = names["IDLE"]

    def step(self, move: Callable[[], AdsError | None], loop: Loop) -> AdsError | None:
        """Run a step of the wrapped environment, simulated by ``move``, and return the policy's error or None."""
        self._move = move
        self.asked = loop.tick
        try:
            begin = self._begin
            self._begin = _nothing  # only before the first step
            with self._around as around, around.call():
                begin()
                is_over = _has_ended(self._outer.step(self._action))
        except WorldHang as error:
            return self._error or error_of(error, loop.tick, self._guard)
        except UNFIT as error:
            failure = error_of(error, self.asked, self._guard)
            self.ended = f"{end_of(self._outer)} failed: {failure.text}"
            self.has_failed = True
            return self._error
        if loop.tick == self.asked:  # a user's step that simulates nothing
            self._simulate()
        # keep the name of a method that ended it, unless a wrapper continues
        if not self.has_failed:
            if not is_over:
                self.ended = ""
            elif not self.ended:
                self.ended = end_of(self._outer)
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
    environment: GymEnvironment, vehicles: VehiclesOfRun, guard: HangGuard
) -> EpisodeEnds:
    """Return the ``EpisodeEnds`` of a wrapped environment for an ego that does not belong to the environment."""
    outer = environment.make()
    env, objects = _reset(outer, vehicles.scenario, environment)
    put_policys_ego(environment, env, vehicles.rules, vehicles.scenario)
    return EpisodeEnds(environment, outer, objects, vehicles, guard)


def stand_in(env: Any, name: str, call: Callable[..., Any]) -> None:
    """Replace a method of an environment with ``call``.

    Copies of the environment, in which a user's code looks ahead, keep the original method.
    """

    def method(asked: Any, *given: Any, **named: Any) -> Any:
        if asked is env:
            return call(*given, **named)
        return getattr(type(asked), name)(asked, *given, **named)

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
    for each in wrappers_of(outer):
        if isinstance(each, TimeLimit) and each._elapsed_steps == each._max_episode_steps:
            return f"max_episode_steps={each._max_episode_steps}"
    return " in ".join(wrapper_names(outer)) or f"{type(outer.unwrapped).__name__}.step"


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
        rules = vehicles.rules
        self._run = vehicles
        self._env = env
        self._driver = driver
        self._guard = guard
        self._objects = objects
        self._step_limit = step_limit
        self._around = EnvironmentGuard(rules.hang_limit)
        self._hz = rules.ads_hz
        self._bodies = vehicles.vehicles
        self._plausibility = Plausibility(self._states(), 1.0 / rules.physics_hz)
        vehicles.plausibility = self._plausibility
        common = env.road, env.vehicle, vehicles.places, rules.road
        self._class = traffic or TrafficClass(StockVehicle)
        self._traffic = Traffic(self._class, *common)
        self._vehicles = [env.vehicle, *self._traffic.vehicles]
        # If the run is an episode, the environment's code calls the policy's action type and the methods of `ENDS`.
        is_episode = isinstance(driver, StockPolicy)
        if not is_episode:  # a vehicle class sees NPCs without goals
            self._vehicles[1:] = Traffic(TrafficClass(StockVehicle), *common).vehicles
        self._find_contacts_alone()
        if not is_episode or is_regulated(env.vehicle):
            foresee(self._vehicles[1:], vehicles.places, rules.road)
        env.road.vehicles = list(self._vehicles)  # the environment's own code may change its list
        self._last = rules.ticks(vehicles.scenario)
        self._asked: list[int] = []
        self._error: AdsError | None = None
        self._moved = ""  # how the environment's own code has moved an NPC
        if isinstance(env.road, RegulatedRoad) and not is_regulated(env.vehicle):
            env.road.enforce_road_rules = _nothing  # without effect here, and slow
        self._ends: OwnEnds | None = None
        if rules.ends is not None:
            self._ends = OwnEnds(env, ENDS if is_episode else rules.ends, rules, guard)
            for name in ENDS:
                # If the run is no episode, it calls the methods itself, because a step may be shorter than a decision.
                says: Callable[..., Any] = _nothing
                if is_episode:
                    says = partial(self._says, self._ends, name)
                stand_in(env, name, says)
        self._road_act = None
        if has_own_act(env.road):
            self._road_act = env.road.act
        self._road_step = env.road.step
        env.road.act = self._act
        env.road.step = self._step

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
        if self._asked != list(trace.decision_ticks):
            trace = replace(trace, decided=tuple(self._asked))
        return trace

    def _says(self, ends: OwnEnds, name: str) -> bool:
        # A method also reports the end of the run. Otherwise, a wrapper that steps until the end of the episode would
        # never stop after a collision.
        return self._is_over or ends.says(name)

    def _drive(self) -> None:
        driver = self._driver
        loop = self._run.loop
        if isinstance(driver, StockPolicy):
            # The first observation. All vehicles stay at the scenario's start positions, although some environments
            # slow their traffic down in `reset`.
            seed = self._run.scenario.seed
            hold = partial(self._make_npcs, "held")
            with self._around.call():
                driver.see(lambda: _reset_in_place(driver.outer, seed, self._objects, hold))
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
            has_failed = False
            with self._around.call():
                if isinstance(driver, StockPolicy):
                    driver.see(lambda: driver.outer.step(driver.action))
                    has_failed = driver.failure is not None
                else:  # the driver has set the ego's controls, and None does not change them
                    AbstractEnv.step(self._env, None)
            self._check_vehicles("step")
            self._check_objects()
            if loop.tick == tick and not self._is_over and not has_failed:
                raise WorldError(
                    f"wrappers: expected each step of the wrappers to step the environment, received a step at "
                    f"{self._seconds:.1f} s that did not. Remove wrappers that end or reset episodes"
                )
            if self._ends is not None and not self._is_over:
                self._end(self._ends)

    def _end(self, ends: OwnEnds) -> None:
        run = self._run
        driver = self._driver
        if isinstance(driver, StockPolicy):
            is_early = not ends.ended
            if is_early and len(self._asked) == self._step_limit:
                ends.ended = f"max_episode_steps={self._step_limit}"
            elif is_early and driver.is_over:
                ends.ended = end_of(driver.outer)
            elif not driver.is_over and not ends.has_failed:  # a wrapper continues
                ends.ended = ""
        elif run.loop.tick % ends.every == 0:
            # The methods see NPCs of the environment's traffic class.
            road = self._env.road
            road.vehicles = [self._env.vehicle, *self._traffic.vehicles]
            self._traffic.show()
            ends.ask(run.loop.tick)
            road.vehicles = list(self._vehicles)
        run.ended = ends.ended
        run.has_failed = ends.has_failed

    def _rate(self) -> int:
        # The reset may have changed the environment's configuration.
        config = self._env.config
        ticks = self._run.rules.physics_hz
        name = "config.simulation_frequency"
        if config["simulation_frequency"] != ticks:
            raise WorldError(
                field=name,
                expected=f"{ticks}, as after a reset with seed 0",
                received=f"{config['simulation_frequency']!r:.100}",
                fix="set the same value in every reset",
            )
        hz = whole_within("config.policy_frequency", config["policy_frequency"], *ADS_HZ)
        check_divides(name, int(ticks), "config.policy_frequency", hz)
        return hz

    def _make_npcs(self, name: Literal["seen", "held", "moved"]) -> None:
        """Give every NPC a class derived from the traffic class, if a policy drives the ego."""
        if isinstance(self._driver, StockPolicy):
            for npc in self._vehicles[1:]:
                npc.__class__ = getattr(self._class, name)

    def _find_contacts_alone(self) -> None:
        # highway-env's own check of contacts with fixed objects would push the ego back.
        for each in self._env.road.objects:
            each.check_collisions = False

    def _check_vehicles(self, method: str) -> None:
        # A `reset` or `step` of the environment may add or remove vehicles, or move the NPCs.
        found = [id(each) for each in self._env.road.vehicles]
        known = [id(each) for each in self._vehicles]
        added = [each for each in found if each not in known]
        removed = [each for each in known if each not in found]
        changes = []
        if added:
            changes.append(f"adds {plural(len(added), 'vehicle')}")
        if removed:
            changes.append(f"removes {plural(len(removed), 'vehicle')}")
        if self._env.vehicle is not self._vehicles[0]:
            changes.append("replaces the ego")
        if method == "step" and not changes and self._moved:
            changes.append(self._moved)
        if changes:
            raise refused_environment(
                "an environment that does not change the vehicles of a run",
                f"{self._who}, whose `{method}` {' and '.join(changes)} at {self._seconds:.1f} s",
                "if the environment has other vehicles, create them in `_reset`, so that the NPCs can replace "
                "them. For a vehicle that appears, moves or leaves, use an NPC",
            )

    @property
    def _seconds(self) -> float:
        return self._run.loop.tick / self._run.rules.physics_hz

    @property
    def _who(self) -> str:
        """The class names of the environment and its wrappers."""
        wrappers = wrapper_names(getattr(self._driver, "outer", self._env))
        return " in ".join([type(self._env).__name__, *wrappers])

    def _moved_npc(self) -> str:
        """Describe how the environment has moved an NPC since the last tick, or return an empty string."""
        npcs = zip(self._vehicles[1:], self._bodies[1:], strict=True)
        for number, (vehicle, body) in enumerate(npcs):
            if vehicle.speed != body.speed:
                return f"sets the speed of NPC {number} from {body.speed:.1f} to {vehicle.speed:.1f} m/s"
            if (*vehicle.position, vehicle.heading) != (body.x, body.y, body.heading):
                return f"moves NPC {number} from ({body.x:.1f}, {body.y:.1f}) m"
        return ""

    def _check_objects(self) -> None:
        # Reference drivers and verdicts would not know of objects that appear, move or disappear.
        known = set(self._run.rules.obstacles)
        found = set(obstacles_of(self._env))
        if known == found:
            return
        what = "a changed"
        if found > known:
            what = "an additional"
        elif found < known:
            what = "a missing"
        x, y, *_ = min(known ^ found)
        env = type(self._env).__name__
        raise refused_environment(
            "an environment whose fixed objects never differ from those after a reset with seed 0",
            f"{env}, with {what} object at ({x:.1f}, {y:.1f}) m at {self._seconds:.1f} s",
            "create all objects in `_reset`, or create them at the same positions in each `reset`. For an object "
            "that appears or moves, use an NPC",
        )

    def _act(self) -> None:
        # Replaces `Road.act`, which calls each vehicle's `act`. A user's `act` is called for its effect on the ego.
        driver = self._driver
        vehicle, *npcs = self._vehicles
        ego, *bodies = self._bodies
        road_act = self._road_act
        # A `reset`, in which NPCs are held, may call the environment's `step`. A road's `act` may call the NPCs' `act`.
        if road_act is None:
            self._make_npcs("seen")
        else:
            self._make_npcs("moved")
        if road_act is not None and isinstance(driver, StockPolicy):
            road_act()
        else:
            driver.actuate()
            if isinstance(driver, PlannerDriver):
                vehicle.control(ego.acceleration, ego.steering)
            # the ego has acted, and a user's class may act only once
            if road_act is not None:
                act = vehicle.act
                vehicle.act = lambda action=None: None if action is None else act(action)
                road_act()
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
            if not self._is_over:
                self._error = failed
            return
        try:
            if not self._moved:  # if the environment has moved NPCs, it is rejected after its step
                accelerations = [body.acceleration for body in self._bodies]
                self._plausibility.check(self._states(), f"{self._who}.step", accelerations)
        except Implausible as fault:  # the run ends, but not the environment's step
            self._run.ended = str(fault)
            self._run.has_failed = True
            return
        loop.moved()
        if isinstance(self._driver, StockPolicy):
            self._traffic.show_targets()

    def _states(self) -> list[State]:
        return [(body.x, body.y, body.heading, body.speed) for body in self._bodies]

    @property
    def _is_over(self) -> bool:
        run = self._run
        is_last = run.loop.is_over or run.loop.tick == self._last
        return is_last or self._error is not None or bool(run.ended)
