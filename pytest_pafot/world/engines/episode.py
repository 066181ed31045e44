"""Episodes of an unchanged environment: its own start, its own steps and traffic, and its own flag for crashes."""

from __future__ import annotations

import itertools
import math
from array import array
from collections.abc import Callable
from dataclasses import dataclass
from types import MethodType
from typing import Any

from pytest_pafot.model.trace import AdsError, Outcome
from pytest_pafot.support.errors import AdsFactoryError, WorldError
from pytest_pafot.support.references import described
from pytest_pafot.world.driving.ads import AdsFactory, give_route
from pytest_pafot.world.driving.environment_actions import View, check_action_space, checked_action
from pytest_pafot.world.driving.object_driver import body_of
from pytest_pafot.world.driving.observations import observe_fast
from pytest_pafot.world.driving.policy import Ads, Policy
from pytest_pafot.world.driving.seeing import ImperfectSensor, hidden_from_policy
from pytest_pafot.world.driving.vehicles import straight_road
from pytest_pafot.world.engines.gym_replay import StockVehicle
from pytest_pafot.world.guard.failure import UNFIT, closing, error_of
from pytest_pafot.world.guard.hang_guard import HangGuard, WorldHang
from pytest_pafot.world.gym_environment import EnvironmentGuard, vehicle_classes_kept
from pytest_pafot.world.gym_world import World
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.loop import PlannerDriver
from pytest_pafot.world.kernel.observation import COLUMNS, Observer, Sensor
from pytest_pafot.world.limits import PLANNER_HZ

LONGEST = 3600.0
"""The longest episode of an environment that does not specify a duration [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Episode:
    """The result of an episode.

    Attributes:
        seed: seed of the episode.
        outcome: ``collision`` if highway-env flagged the ego as crashed, ``ads_error`` or ``hang`` if the ADS did not
            decide, else ``safe``.
        error: error of the ADS, if it did not decide, else None.
    """

    seed: int
    outcome: Outcome
    error: AdsError | None = None


def drive_episode(world: World, factory: AdsFactory, seed: int, *, is_planner: bool = False) -> Episode:
    """Drive an episode of a world's own traffic with a new ADS.

    Args:
        world: world, whose environment is reset with the seed.
        factory: factory of an ADS of any kind.
        seed: seed of the episode.
        is_planner: whether the ADS receives an :class:`pytest_pafot.Observation` and returns acceleration and steering.

    Raises:
        AdsFactoryError: if the factory returns an object that cannot drive.
        WorldError: if the environment cannot be used, or its road is not straight and the ADS is a planner.
    """
    environment, limit, error = world.environment, world.hang_limit, None
    environment.unwrapped  # noqa: B018  (it imports the user's module, whose changes to classes are not undone)
    with vehicle_classes_kept(), HangGuard(limit) as guard:
        outer = environment.with_traffic()
        env = outer.unwrapped
        observe_fast(env)
        try:
            with environment.in_time():
                seen, _ = outer.reset(seed=seed)
        except WorldError:
            raise
        except Exception as wrong:
            expected = f"that {environment.env_id}, in its wrappers, can be reset with the seed {seed}"
            raise WorldError(field="world", expected=expected, received=described(wrong), fix="correct it") from wrong
        view, policy = None, Policy(factory)
        try:
            if policy.simulates:
                view = View(environment.make().unwrapped, env)
            made = policy.make() if view is None else policy.make(env=view.env)
        except (AdsFactoryError, WorldError):
            raise
        except UNFIT as wrong:
            return Episode(seed=seed, outcome=Outcome.ADS_ERROR, error=error_of(wrong, 0, guard))
        with closing(made.given, limit), EnvironmentGuard(limit) as around:
            drive = _Drive(outer, made, guard, around, view, seed, is_planner=is_planner)
            try:
                error = drive.run(seen)
            finally:
                drive.clear()
        ended = Outcome.COLLISION if env.vehicle.crashed else Outcome.SAFE
        outcome = ended if error is None else Outcome.HANG if error.interrupted else Outcome.ADS_ERROR
        return Episode(seed=seed, outcome=outcome, error=error)


class _Drive:
    """The steps of an episode, from a reset environment on.

    A vehicle class, or a planner's car, takes the place of the environment's own ego.
    """

    def __init__(
        self,
        outer: Any,
        made: Ads,
        guard: HangGuard,
        around: EnvironmentGuard,
        view: View | None,
        seed: int,
        *,
        is_planner: bool,
    ) -> None:
        self._outer, self._env, self._made, self._view, self._seed = outer, outer.unwrapped, made, view, seed
        self._guard, self._around = guard, around
        self._is_vehicle, self._is_planner = made.drives_itself, is_planner and not made.drives_itself
        self._error: AdsError | None = None
        self._is_stock = type(self._env).__module__.partition(".")[0] == "highway_env"

    def run(self, seen: Any) -> AdsError | None:
        """Take steps until the episode is over, and return the error of an ADS that did not decide."""
        env, outer, config = self._env, self._outer, self._env.config
        is_policy = not (self._is_vehicle or self._is_planner)
        if not is_policy:
            self._replace_ego()
        else:
            check_action_space(outer.action_space)
            hidden_from_policy(env, self._made.sight)
        every = int(config["simulation_frequency"] // config["policy_frequency"])
        steps = math.ceil(min(float(config.get("duration", LONGEST)), LONGEST) * config["policy_frequency"]) + 1
        for step in range(min(steps, getattr(outer.spec, "max_episode_steps", None) or steps)):
            try:
                action = None
                if is_policy:
                    if self._view is not None:
                        self._view.show(step * every)
                    action = checked_action(self._decided(self._made.decides, seen), outer.action_space)
                seen, _, *ends, _ = self._stepped(outer if is_policy else env, action)
            except UNFIT as error:
                if isinstance(error, WorldError):
                    raise
                return error_of(error, step * every, self._guard)
            if self._error or env.vehicle.crashed or any(ends):
                break
        return self._error

    def clear(self) -> None:
        """Restore what an environment that is used again has lost."""
        if self._is_stock:
            for name in ("_reward", "_info"):
                vars(self._env).pop(name, None)

    def _replace_ego(self) -> None:
        """Put a vehicle of the given class in the place of the environment's ego."""
        env, old = self._env, self._env.vehicle
        ego = (self._made.decides if self._is_vehicle else StockVehicle)(env.road, old.position, old.heading, old.speed)
        give_route(ego, getattr(old, "route", None))
        env.road.vehicles = [ego if each is old else each for each in env.road.vehicles]
        env.controlled_vehicles = [ego]
        try:
            env.define_spaces()
        except Exception as error:
            raise self._unfit(error) from error
        env.observation_type.observe = lambda: 0.0
        if self._is_stock:  # whose rewards may need an action, and nothing reads them
            env._reward, env._info = lambda *_: 0.0, lambda *_: {}
        if self._is_planner:
            ego.act = self._planned()
        else:
            for name in ("act", "step"):
                setattr(env.road, name, self._guarded(name))

    def _guarded(self, name: str) -> MethodType:
        """Return a method of the road whose errors are those of the vehicle class; after one, nothing moves."""
        road, method = self._env.road, getattr(self._env.road, name)

        def guarded(called: Any, *arguments: float) -> None:
            if called is not road:  # a copy, in which the ADS simulates
                getattr(type(called), name)(called, *arguments)
            elif self._error is None:
                try:
                    with self._around.paused():
                        self._decided(method, *arguments)
                    body_of(self._env.vehicle)  # it raises BadAction for NaN
                except UNFIT as error:
                    self._error = error_of(error, 0, self._guard)

        return MethodType(guarded, road)

    def _stepped(self, stepped: Any, action: Any) -> Any:
        """Return the result of a step of the environment."""
        try:
            with self._around.call():
                return stepped.step(action)
        except WorldHang:
            raise
        except Exception as error:
            raise self._unfit(error) from error

    def _unfit(self, error: Exception) -> WorldError:
        """Return the error for an environment that raised an exception, as it may with an ego of a different class."""
        name, ego = type(self._env).__name__, type(self._env.vehicle).__name__
        return WorldError(
            f"world: expected an environment whose steps work with an ego of the class {ego}, received {name}, "
            f"which raised {described(error)}; rate a policy that returns the environment's own "
            "actions, or use a different environment"
        )

    def _decided(self, call: Callable[..., Any], *arguments: Any) -> Any:
        """Call the ADS's code under the time limit of a decision, and return its result."""
        self._guard.decision_starts()
        try:
            result = call(*arguments)
        finally:
            self._guard.decision_ends()
        self._guard.raise_swallowed()
        return result

    def _planned(self) -> Callable[[], None]:
        """Return what lets a planner see the vehicles that were there at the start, and control its car."""
        env, road, hz = self._env, straight_road(self._env.road.network), int(self._env.config["simulation_frequency"])
        every, duration = hz // PLANNER_HZ or 1, float(env.config.get("duration", LONGEST))
        if road is None:
            raise WorldError(
                f"world: expected a straight road for a planner in SI units, received the road of "
                f"{type(env).__name__}; give a policy with the environment's own observations and actions, or a "
                "vehicle class"
            )
        ego = env.vehicle
        vehicles = [ego, *(each for each in env.road.vehicles if each is not ego)]
        row = len(vehicles) * COLUMNS
        record, body = (
            array("d", bytes(8 * row * math.ceil((min(duration, LONGEST) + 2) * hz))),
            Body(ego.LENGTH, ego.WIDTH),
        )
        sizes = [(each.LENGTH, each.WIDTH) for each in vehicles]
        sensor: Sensor = Observer(record, sizes, road.grid, road.speed_limit, hz, every)
        if self._made.sight is not None:
            sensor = ImperfectSensor(sensor, self._made.sight, self._seed, road.grid, hz)
        lanes: dict[str, Any] = {"lanes": road.lane_count, "lane_width": road.lane_width, "every": every}
        driver = PlannerDriver(self._made.decides, self._guard, (), body, body, sensor, dt=1 / hz, **lanes)

        ticks = itertools.count()

        def plan() -> None:
            tick = next(ticks)
            for number, each in enumerate(vehicles):
                at = tick * row + number * COLUMNS
                pose = road.project(float(each.position[0]), float(each.position[1]), float(each.heading))
                held = each.action["acceleration"], each.action["steering"]
                record[at : at + 6] = array("d", (*pose, each.speed, *held))
            x, y = map(float, ego.position)
            body.place(*road.project(x, y, ego.heading), ego.speed)
            if tick % every == 0 and self._error is None:
                with self._around.paused():
                    self._error = driver.decide(tick)
            driver.actuate()
            ego.control(body.acceleration, body.steering)

        return plan
