"""Episodes of an unchanged environment, with its own start, steps, traffic and crash flag."""

from __future__ import annotations

import itertools
import math
from array import array
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pytest_pafot.algorithms.evaluation import IMMEDIATE
from pytest_pafot.model.trace import AdsError
from pytest_pafot.support.errors import AdsFactoryError, WorldError
from pytest_pafot.support.references import described
from pytest_pafot.world.driving.environment import (
    View,
    body_of,
    check_action_space,
    checked_action,
    observe_by,
    observer,
)
from pytest_pafot.world.driving.policy import Ads, AdsFactory, ImperfectSensor, Policy, give_route
from pytest_pafot.world.driving.vehicles import StockVehicle, straight_road
from pytest_pafot.world.engines.gym_replay import end_of, stand_in
from pytest_pafot.world.guard.hang_guard import UNFIT, HangGuard, closing, error_of
from pytest_pafot.world.gym_environment import ENDS, EnvironmentGuard, vehicle_classes_kept
from pytest_pafot.world.gym_world import World
from pytest_pafot.world.kernel.lanes import COLUMNS, Body
from pytest_pafot.world.kernel.loop import PlannerDriver
from pytest_pafot.world.kernel.observation import Observer, Sensor
from pytest_pafot.world.limits import PLANNER_HZ
from pytest_pafot.world.plausible import Plausibility

# Returns what the ego has done in an episode so far: `crashed`, `moved`, both or neither.
Watch = Callable[[], set[str]]

# The longest duration [s] of an episode.
LONGEST = 3600.0


@dataclass(frozen=True, slots=True)
class Episode:
    """The result of one episode of an environment.

    Attributes:
        seed: seed of the episode.
        crashed: whether highway-env flagged the ego as crashed, even if it cleared the flag within the step.
        error: error that ended the episode: an exception, a hang or an invalid action.
        undriven: reason why the episode does not count, or empty if it does. An episode does not count if it ended
            without a crash in its first second or step, or if the ego never moved.
    """

    seed: int
    crashed: bool = False
    error: AdsError | None = None
    undriven: str = ""


def drive_episode(
    world: World, factory: AdsFactory, seed: int, *, is_planner: bool = False
) -> Episode:
    """Run one episode of a world's environment, with its own traffic and a new policy.

    Args:
        world: world with the environment.
        factory: factory of the policy, which can be of any kind.
        seed: seed of the reset.
        is_planner: whether the policy receives an :class:`pytest_pafot.Observation` and acts in SI units.

    Raises:
        AdsFactoryError: if the factory returns an object that cannot drive.
        WorldError: if the environment cannot be used, or if the policy is a planner and the road is not straight.
    """
    environment, limit, policy = world.environment, world.hang_limit, Policy(factory)
    environment.unwrapped  # noqa: B018  (it imports the user's module, whose changes to classes are not undone)
    with vehicle_classes_kept(), HangGuard(limit) as guard, EnvironmentGuard(limit) as around:
        outer = environment.make(has_traffic=True)
        env = outer.unwrapped
        observe_by(env, lambda: observer(env)())  # noqa: PLW0108  (only a reset makes the road)
        try:
            with environment.in_time():
                seen, _ = outer.reset(seed=seed)
        except WorldError:
            raise
        except Exception as wrong:
            expected = f"{environment.env_id}, with its wrappers, to reset with the seed {seed}"
            raise WorldError(
                field="world", expected=expected, received=described(wrong), fix="correct it"
            ) from wrong
        view = View(environment.make().unwrapped, env) if policy.simulates else None
        try:
            watch, made = _watching(env), policy.make(**({} if view is None else {"env": view.env}))
            with closing(made.given, limit):
                if made.drives_itself or is_planner:
                    steps, error = _drive_beside(env, made, seed, guard, around, watch)
                else:
                    steps, error = (
                        _drive_by_actions(outer, made, guard, around, seen, view, watch),
                        None,
                    )
            if error is not None or "crashed" in watch():
                return Episode(seed, error is None, error)
            if steps > 1 and max(env.time, steps / env.config["policy_frequency"]) > IMMEDIATE:
                return Episode(seed, undriven="" if "moved" in watch() else "the ego never moved")
            with around.call():
                enders = [f"{type(env).__name__}.{name}" for name in ENDS if getattr(env, name)()]
            return Episode(seed, undriven=f"{[*enders, end_of(outer)][0]} ended it in step {steps}")
        except (AdsFactoryError, WorldError):
            raise
        except UNFIT as wrong:
            return Episode(seed, error=error_of(wrong, 0, guard))


def _watching(env: Any) -> Watch:
    # Also watch within each step, because the environment or a wrapper may reset the ego before the step ends.
    start, simulate, done = tuple(env.vehicle.position), env._simulate, set[str]()
    road_step, known = env.road.step, dict[str, Any]()

    def watch() -> set[str]:
        now = {"crashed": env.vehicle.crashed, "moved": tuple(env.vehicle.position) != start}
        done.update(name for name, is_so in now.items() if is_so)
        return done

    def simulated(*given: Any, **named: Any) -> None:
        simulate(*given, **named)
        watch()

    def pose_of(ego: Any) -> tuple[float, ...]:
        return *map(float, ego.position), float(ego.heading), float(ego.speed)

    def stepped(dt: float) -> None:
        ego = env.vehicle
        if known.get("ego") is not ego:
            known.update(ego=ego, plausibility=Plausibility([pose_of(ego)], dt))
        road_step(dt)
        if "crashed" not in watch():
            name, acceleration = type(env).__name__, float(ego.action["acceleration"])
            known["plausibility"].check([pose_of(ego)], f"{name}.step", [acceleration])

    stand_in(env, "_simulate", simulated)
    stand_in(env.road, "step", stepped)
    return watch


def _drive_by_actions(
    outer: Any,
    made: Ads,
    guard: HangGuard,
    around: EnvironmentGuard,
    seen: Any,
    view: View | None,
    watch: Watch,
) -> int:
    # Returns the number of steps.
    env, policy = outer.unwrapped, made.policy
    check_action_space(outer.action_space)
    every = int(env.config["simulation_frequency"] // env.config["policy_frequency"])
    for step in range(_steps(outer)):
        if view is not None:
            view.show(step * every)
        with guard.decision():
            action = policy(seen)
        action = checked_action(action, outer.action_space)
        with around.call():
            seen, _, *ends, _ = outer.step(action)
        if "crashed" in watch() or any(ends):
            break
    return step + 1


def _drive_beside(
    env: Any, made: Ads, seed: int, guard: HangGuard, around: EnvironmentGuard, watch: Watch
) -> tuple[int, AdsError | None]:
    """Run an episode in which a vehicle of the policy's class, or a planner's car, replaces the environment's ego.

    Return the number of steps, and the planner's error or None.
    """
    old, kind = env.vehicle, made.decides if made.drives_itself else StockVehicle
    ego = kind(env.road, old.position, old.heading, old.speed)
    give_route(ego, getattr(old, "route", None))
    env.road.vehicles = [ego if each is old else each for each in env.road.vehicles]
    env.controlled_vehicles = [ego]
    env.define_spaces()
    env.observation_type.observe = lambda: 0.0
    # nothing reads its rewards, which may need an action
    if type(env).__module__.startswith("highway_env."):
        env._reward, env._info = lambda *_: 0.0, lambda *_, **__: {}
    errors = list[AdsError]()
    if not made.drives_itself:
        ego.act = _connect_planner(env, made, seed, guard, around, errors)
    for steps in itertools.count(1):
        with around.call():
            _, _, *ends, _ = env.step(None)
        body_of(ego)  # raises BadAction for NaN
        if errors or "crashed" in watch() or any(ends) or steps >= _steps(env):
            break
    return steps, next(iter(errors), None)


def _connect_planner(
    env: Any,
    made: Ads,
    seed: int,
    guard: HangGuard,
    around: EnvironmentGuard,
    errors: list[AdsError],
) -> Callable[..., None]:
    # The planner sees the vehicles that exist at the start. After an error of the planner, its car keeps its controls
    # until the end of the step.
    road, hz = straight_road(env.road.network), int(env.config["simulation_frequency"])
    if road is None:
        raise WorldError(
            f"world: expected a straight road for a planner in SI units, received the road of {type(env).__name__}. "
            "Use a policy for the environment's own observations and actions, or a vehicle class"
        )
    ego, every = env.vehicle, hz // PLANNER_HZ or 1
    vehicles = [ego, *(each for each in env.road.vehicles if each is not ego)]
    row, sizes = len(vehicles) * COLUMNS, [(each.LENGTH, each.WIDTH) for each in vehicles]
    record = array("d", bytes(8 * row * math.ceil((_duration(env) + 2) * hz)))
    exact = Observer(record, sizes, road.grid, road.speed_limit, hz, every)
    sensor: Sensor = exact if made.sight is None else ImperfectSensor(exact, made.sight, seed)
    body, lanes = (
        Body(ego.LENGTH, ego.WIDTH),
        {"lanes": road.lane_count, "lane_width": road.lane_width},
    )
    driver = PlannerDriver(
        made.decides, guard, (), body, body, sensor, dt=1 / hz, every=every, **lanes
    )
    ticks = itertools.count()

    def plan(action: None = None) -> None:
        tick = next(ticks)
        for number, each in enumerate(vehicles):
            at = tick * row + number * COLUMNS
            pose = road.project(
                float(each.position[0]), float(each.position[1]), float(each.heading)
            )
            held = each.action["acceleration"], each.action["steering"]
            record[at : at + 6] = array("d", (*pose, each.speed, *held))
        body.place(*record[tick * row : tick * row + 4])
        if tick % every == 0 and not errors:
            with around.paused():
                errors.extend(filter(None, [driver.decide(tick)]))
        driver.actuate()
        ego.control(body.acceleration, body.steering)

    return plan


def _steps(env: Any) -> int:
    steps: int = math.ceil(_duration(env.unwrapped) * env.unwrapped.config["policy_frequency"]) + 1
    limit: int | None = getattr(env.spec, "max_episode_steps", None)
    return min(steps, limit or steps)


def _duration(env: Any) -> float:
    return min(float(env.config.get("duration", LONGEST)), LONGEST)
