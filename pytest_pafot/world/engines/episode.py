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
from pytest_pafot.world.engines.policies import make_ads
from pytest_pafot.world.engines.run import Plausibility
from pytest_pafot.world.guard.hang_guard import UNFIT, HangGuard, closing, error_of
from pytest_pafot.world.gym_environment import (
    ENDS,
    EnvironmentGuard,
    of_highway_env,
    vehicle_classes_kept,
)
from pytest_pafot.world.gym_world import World
from pytest_pafot.world.kernel.lanes import COLUMNS, Body
from pytest_pafot.world.kernel.loop import PlannerDriver
from pytest_pafot.world.kernel.observation import Observer
from pytest_pafot.world.limits import PLANNER_HZ

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
    environment = world.environment
    limit = world.hang_limit
    policy = Policy(factory)
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
            raise WorldError(
                field="world",
                expected=f"{environment.env_id}, with its wrappers, to reset with the seed {seed}",
                received=described(wrong),
                fix="correct it",
            ) from wrong
        # A second environment, in which the planner can simulate without changing the episode.
        view = None
        if policy.simulates:
            view = View(environment.make().unwrapped, env)
        try:
            watch = _watching(env)
            made = make_ads(policy, view)
            error = None
            with closing(made.given, limit):
                if made.drives_itself or is_planner:
                    steps, error = _drive_beside(env, made, seed, guard, around, watch)
                else:
                    steps = _drive_by_actions(outer, made, guard, around, seen, view, watch)
            if error is not None or "crashed" in watch():
                # An error of the planner is not counted as a crash, even if it also crashed in that step.
                return Episode(seed, error is None, error)
            if steps > 1 and max(env.time, steps / env.config["policy_frequency"]) > IMMEDIATE:
                if "moved" in watch():
                    return Episode(seed)
                return Episode(seed, undriven="the ego never moved")
            with around.call():
                enders = [f"{type(env).__name__}.{name}" for name in ENDS if getattr(env, name)()]
            first = [*enders, end_of(outer)][0]
            return Episode(seed, undriven=f"{first} ended it in step {steps}")
        except (AdsFactoryError, WorldError):
            raise
        except UNFIT as wrong:
            return Episode(seed, error=error_of(wrong, 0, guard))


def _watching(env: Any) -> Watch:
    # Also watch within each step, because the environment or a wrapper may reset the ego before the step ends.
    start = tuple(env.vehicle.position)
    simulate = env._simulate
    road_step = env.road.step
    done = set[str]()
    watched: Any = None
    plausibility: Any = None

    def watch() -> set[str]:
        ego = env.vehicle
        if ego.crashed:
            done.add("crashed")
        if tuple(ego.position) != start:
            done.add("moved")
        return done

    def simulated(*given: Any, **named: Any) -> None:
        simulate(*given, **named)
        watch()

    def pose_of(ego: Any) -> tuple[float, ...]:
        return *map(float, ego.position), float(ego.heading), float(ego.speed)

    def stepped(dt: float) -> None:
        nonlocal watched, plausibility
        ego = env.vehicle
        # A reset within the episode replaces the ego, whose old position says nothing about the new one.
        if watched is not ego:
            watched = ego
            plausibility = Plausibility([pose_of(ego)], dt)
        road_step(dt)
        if "crashed" not in watch():
            acceleration = float(ego.action["acceleration"])
            plausibility.check([pose_of(ego)], f"{type(env).__name__}.step", [acceleration])

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
    # The view is numbered by ticks, as in a run.
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
    old = env.vehicle
    kind: Any = StockVehicle
    if made.drives_itself:
        kind = made.decides
    # The environment's ego may have a class that obeys only its action type.
    ego = kind(env.road, old.position, old.heading, old.speed)
    give_route(ego, getattr(old, "route", None))
    env.road.vehicles = [ego if each is old else each for each in env.road.vehicles]
    env.controlled_vehicles = [ego]
    env.define_spaces()
    # Nothing reads its observations, which take longer than all the rest.
    env.observation_type.observe = lambda: 0.0
    # nothing reads its rewards, which may need an action
    if of_highway_env(type(env)):
        env._reward = lambda *_: 0.0
        env._info = lambda *_, **__: {}
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
    road = straight_road(env.road.network)
    if road is None:
        raise WorldError(
            f"world: expected a straight road for a planner in SI units, received the road of {type(env).__name__}. "
            "Use a policy for the environment's own observations and actions, or a vehicle class"
        )
    ego = env.vehicle
    hz = int(env.config["simulation_frequency"])
    every = hz // PLANNER_HZ or 1
    # An observer expects the ego first.
    vehicles = [ego, *(each for each in env.road.vehicles if each is not ego)]
    sizes = [(each.LENGTH, each.WIDTH) for each in vehicles]
    row = len(vehicles) * COLUMNS
    record = array("d", bytes(8 * row * math.ceil((_duration(env) + 2) * hz)))
    sensor: Any = Observer(record, sizes, road.grid, road.speed_limit, hz, every)
    if made.sight is not None:
        sensor = ImperfectSensor(sensor, made.sight, seed)
    body = Body(ego.LENGTH, ego.WIDTH)
    driver = PlannerDriver(
        made.decides,
        guard,
        (),
        body,
        body,
        sensor,
        dt=1 / hz,
        every=every,
        lanes=road.lane_count,
        lane_width=road.lane_width,
    )
    ticks = itertools.count()

    def plan(action: None = None) -> None:
        tick = next(ticks)
        for number, each in enumerate(vehicles):
            at = tick * row + number * COLUMNS
            x, y = each.position
            pose = road.project(float(x), float(y), float(each.heading))
            held = each.action["acceleration"], each.action["steering"]
            record[at : at + 6] = array("d", (*pose, each.speed, *held))
        body.place(*record[tick * row : tick * row + 4])
        # Between decisions, the car follows its last action.
        if tick % every == 0 and not errors:
            with around.paused():
                error = driver.decide(tick)
            if error is not None:
                errors.append(error)
        driver.actuate()
        ego.control(body.acceleration, body.steering)

    return plan


def _steps(env: Any) -> int:
    steps: int = math.ceil(_duration(env.unwrapped) * env.unwrapped.config["policy_frequency"]) + 1
    limit: int | None = getattr(env.spec, "max_episode_steps", None)
    return min(steps, limit or steps)


def _duration(env: Any) -> float:
    return min(float(env.config.get("duration", LONGEST)), LONGEST)
