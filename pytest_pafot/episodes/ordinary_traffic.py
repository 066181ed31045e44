"""Episodes of an unchanged environment: its own start, its own random traffic, and its own flag for crashes.

The start of an episode is the result of ``env.reset`` with its seed. Compiled code then drives the traffic if possible;
otherwise the environment takes its own steps. Both give the same outcome at the same tick, and positions that differ by
less than 1e-9 m.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import numpy as np
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.road.road import Road
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle
from highway_env.vehicle.kinematics import Vehicle

from pytest_pafot.episodes.episode import Episode, EpisodeRecording, Kind, Start, Step
from pytest_pafot.model.trace import AdsError, Outcome
from pytest_pafot.support.errors import AdsFactoryError, WorldError
from pytest_pafot.world.driving.ads import AdsFactory, is_vehicle_class, make_ads, wants_env
from pytest_pafot.world.driving.compiled_vehicle import compiled_vehicle
from pytest_pafot.world.driving.idm_model import idm_model
from pytest_pafot.world.driving.observations import observer
from pytest_pafot.world.driving.perception import ads_and_sight
from pytest_pafot.world.driving.policy import View
from pytest_pafot.world.guard.failure import UNFIT, closing, error_of
from pytest_pafot.world.guard.hang_guard import HangGuard
from pytest_pafot.world.gym_environment import NEUTRAL, GymEnvironment, vehicle_classes_kept
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.loop import EgoDriver
from pytest_pafot.world.kernel.observation import COLUMNS
from pytest_pafot.world.kernel.traffic import OrdinaryTraffic, TrafficVehicle
from pytest_pafot.world.roads.straight import StraightRoad

# Episodes on a straight road among highway-env's IDM and MOBIL vehicles, whose motion is computed by compiled code.
#
# The environment still creates the start and the observations, interprets actions, and decides when the episode is
# over. Before each of these steps, the environment's vehicles are moved to the places that the compiled code has
# computed.


def why_not(start: Start) -> str:
    """Return the reason why compiled code cannot drive the traffic of an episode; empty if it can."""
    env, road, ego, inner, cls = start.env, start.env.road, start.env.vehicle, start.outer, type(start.env)
    while isinstance(inner, NEUTRAL):
        inner = inner.env
    if inner is not env:
        return f"the environment is wrapped in {type(inner).__name__}"
    if type(road) is not Road or cls.step is not AbstractEnv.step or cls._simulate is not AbstractEnv._simulate:
        return f"{cls.__name__} has its own steps"
    if start.road is None or len({lane.speed_limit for lane in start.road.lanes}) > 1:
        return "the road is not straight, or its lanes differ"
    if road.objects or any(lane.forbidden for lane in road.network.lanes_list()):
        return "there are objects on the road, or lanes that may not be entered"
    for each in road.vehicles:
        if each is not ego and (idm_model(type(each)) is None or each.route):
            return f"the traffic has a {type(each).__name__}, not only IDM and MOBIL"
        if (each.MIN_SPEED, each.MAX_SPEED) != (Vehicle.MIN_SPEED, Vehicle.MAX_SPEED):
            return f"a {type(each).__name__} has its own speed limits"
    if start.kind == "vehicle" and not isinstance(ego, ControlledVehicle) and hasattr(ego, "target_speed"):
        return f"{type(ego).__name__} has a target speed and no target lane"
    has_range = getattr(env.action_type, "speed_range", None) is not None  # actions limit the ego's speed to it
    if start.kind == "policy" and (type(ego) not in (MDPVehicle, Vehicle) or has_range):
        return f"the actions drive a {type(ego).__name__} with its own limits"
    if road.vehicles[0] is not ego:
        return "the ego is not the first on its road"
    return ""


def compiled(start: Start, seed: int, *, is_recorded: bool) -> Episode:
    """Drive an episode with compiled traffic; :func:`why_not` must have returned an empty text for its start."""
    road, record = start.straight, start.record()
    traffic, mirror = _compiled(start, record)
    driver: EgoDriver
    if start.kind == "planner":
        driver = start.driver(mirror.ego, record)
    elif start.kind == "policy":
        driver = _PolicyDriver(start, mirror)
    else:
        driver = (
            EgoDriver(mirror.ego, start.ticks) if idm_model(start.ads) is not None else _VehicleDriver(start, mirror)
        )
    error = _drive(start, traffic, driver, mirror)
    mirror.show()
    recording = None
    if is_recorded:
        vehicles = start.vehicles
        states = np.array(record).reshape(-1, len(vehicles), COLUMNS)[: traffic.tick + 1, :, :4]
        states[:, :, :2] += road.position(0.0, 0)[:2]
        sizes = np.array([[each.LENGTH, each.WIDTH] for each in vehicles])
        recording = EpisodeRecording(states=states, sizes=sizes, lanes=road.lanes, physics_hz=start.physics_hz)
    return start.ended(seed, traffic.tick, error, recording=recording)


class CompiledSteps:
    """An episode with compiled traffic that receives its actions one by one, as ``env.step`` does.

    :func:`why_not` must have returned an empty text for its start. The episode ends at the tick at which the ego is
    flagged as crashed.
    """

    def __init__(self, start: Start) -> None:
        self._start = start
        self._traffic, self._mirror = _compiled(start, start.record())
        self._driver = _PolicyDriver(start, self._mirror)

    def step(self, action: Any) -> Step:
        """Take one step with an action, and return the same values as ``env.step`` of the environment."""
        start, env, traffic = self._start, self._start.env, self._traffic
        env.time += 1 / env.config["policy_frequency"]
        self._driver.apply(action)
        for _ in range(start.every):
            if traffic.step():
                break
        self._mirror.show()
        env.steps = traffic.tick
        seen, reward = self._driver.observe(), float(env._reward(action))
        is_truncated = bool(env._is_truncated()) or traffic.tick + start.every > start.ticks
        return seen, reward, bool(env._is_terminated()), is_truncated, env._info(seen, action)


def _compiled(start: Start, record: array[float]) -> tuple[OrdinaryTraffic, _Mirror]:
    """Return the compiled traffic of an episode and its mirror; the traffic writes all states into ``record``."""
    bodies = [compiled_vehicle(each, start.straight) for each in start.vehicles]
    return OrdinaryTraffic(bodies, record, 1 / start.physics_hz), _Mirror(start, bodies, start.straight)


def _drive(start: Start, traffic: OrdinaryTraffic, driver: EgoDriver, mirror: _Mirror) -> AdsError | None:
    """Drive until the ego is flagged as crashed, the environment ends the episode, or the ADS does not decide."""
    env, time = start.env, 0.0
    while traffic.tick < start.ticks:
        tick = traffic.tick
        if tick % start.every == 0:
            mirror.show()
            env.time = time
            if tick > 0 and (env._is_terminated() or env._is_truncated()):
                return None
            time += 1 / env.config["policy_frequency"]
        if tick % driver.every == 0:
            error = driver.decide(tick)
            if error is not None:
                return error
        driver.actuate()
        if traffic.step():
            return None
    return None


class _Mirror:
    """A mirror, which copies the state of the compiled vehicles into the environment's vehicles."""

    def __init__(self, start: Start, bodies: list[TrafficVehicle], road: StraightRoad) -> None:
        self.ego = bodies[0]
        self._start = start
        self._pairs = list(zip(start.vehicles, bodies, strict=True))
        self._lanes = list(start.env.road.network.lanes_dict().items())
        self._x, self._y, _ = road.position(0.0, 0)

    def show(self) -> None:
        """Copy the state of the compiled vehicles into the environment's vehicles."""
        for vehicle, body in self._pairs:
            x, y, vehicle.heading, vehicle.speed, lane, goal = body.seen()
            vehicle.position = np.array([x + self._x, y + self._y])
            vehicle.action = {"steering": body.steering, "acceleration": body.acceleration}
            vehicle.lane_index, vehicle.lane = self._lanes[lane]
            vehicle.crashed = body.crashed
            if isinstance(vehicle, ControlledVehicle):
                vehicle.target_lane_index = self._lanes[goal][0]


class _PolicyDriver(EgoDriver):
    """The driver of an ego by a policy, which receives the environment's observations and returns its actions."""

    def __init__(self, start: Start, mirror: _Mirror) -> None:
        super().__init__(mirror.ego, start.every)
        self._start = start
        self._mirror = mirror
        self.observe = observer(start.env) if start.eyes is None else start.env.observation_type.observe

    def decide(self, tick: int) -> AdsError | None:
        """Observe, call the policy under guard, and apply its action; return the policy's error, or None."""
        start = self._start
        start.env.steps = tick
        seen = start.seen if tick == 0 else self.observe()
        try:
            action = start.action(seen, tick)
        except UNFIT as error:
            return error_of(error, tick, start.guard)
        self.apply(action)
        return None

    def apply(self, action: Any) -> None:
        """Let the environment interpret an action for the ego."""
        env, body = self._start.env, self._mirror.ego
        env.action_type.act(action)
        ego = env.vehicle
        if isinstance(ego, MDPVehicle):
            body.aim(ego.target_lane_index[2], ego.target_speed)
        else:
            body.acceleration, body.steering = float(ego.action["acceleration"]), float(ego.action["steering"])

    def actuate(self) -> None:
        """Keep the last action; if the policy has an imperfect sight, record the places of all vehicles for it."""
        if self._start.eyes is not None:
            self._mirror.show()
            self._start.eyes.note()


class _VehicleDriver(EgoDriver):
    """The driver of an ego whose vehicle class has its own code to act and move."""

    def __init__(self, start: Start, mirror: _Mirror) -> None:
        super().__init__(mirror.ego, 1)
        self._start = start
        self._mirror = mirror
        self._ego = start.env.vehicle

    def decide(self, tick: int) -> AdsError | None:
        """Let the ego act and move under guard; return its error, or None."""
        start, ego, body = self._start, self._ego, self._mirror.ego
        self._mirror.show()
        start.env.steps = tick
        try:
            start.guarded(ego.act)
            if isinstance(ego, ControlledVehicle):
                body.aim(ego.target_lane_index[2], float(ego.target_speed))
            start.guarded(ego.step, 1 / start.physics_hz)
        except UNFIT as error:
            return error_of(error, tick, start.guard)
        body.acceleration, body.steering = float(ego.action["acceleration"]), float(ego.action["steering"])
        x, y = ego.position
        body.lead(*start.straight.project(float(x), float(y), float(ego.heading)), float(ego.speed))
        return None


# An episode by the environment's own steps, which works for any environment and any ADS.


def stepped(start: Start, seed: int, reason: str, *, is_recorded: bool) -> Episode:
    """Drive an episode by the environment's own steps.

    ``reason`` says why its traffic is not compiled, and is stored in the result.
    """
    steps = _Steps(start, is_recorded=is_recorded)
    try:
        steps.run()
    finally:
        for name in ("_reward", "_info"):  # the environment may be used for more episodes
            vars(start.env).pop(name, None)
    tick = steps.tick if steps.crashed_at is None else steps.crashed_at
    if steps.error is not None:
        tick = steps.error.tick
    return start.ended(seed, tick, steps.error, steps=reason, recording=steps.recording() if is_recorded else None)


class _Steps:
    """The environment's own steps in an episode; the ``step`` of its road is replaced to notice each tick.

    Attributes:
        tick: current tick of the episode.
        crashed_at: tick at which the ego was flagged as crashed, else None; the environment continues to the end of its
            step.
        error: error of the ADS, if it did not decide, else None.
    """

    def __init__(self, start: Start, *, is_recorded: bool) -> None:
        self.tick = 0
        self.crashed_at: int | None = None
        self.error: AdsError | None = None
        self._start = start
        self._frames: list[dict[Any, tuple[float, ...]]] | None = [] if is_recorded else None
        self._note()
        env, road = start.env, start.env.road
        act, step, is_policy = road.act, road.step, start.kind == "policy"

        def step_and_note(dt: float) -> None:
            step(dt) if is_policy else self._guarded(step, dt)
            self.tick += 1
            if env.vehicle.crashed and self.crashed_at is None:
                self.crashed_at = self.tick
            self._note()

        # Plain functions, because a copy of a vehicle with its road shares them. It would copy a method with its
        # object.
        road.step = step_and_note
        if start.eyes is not None:
            note = start.eyes.note

            def note_and_act() -> None:
                note()
                act()

            road.act = note_and_act
        if not is_policy:
            road.act = lambda: self._guarded(act)
            env.observation_type.observe = env._reward = lambda *_: 0.0  # nothing reads them
            env._info = lambda *_, **__: {}
        if start.kind == "planner":
            env.vehicle.act = self._planner()

    def run(self) -> None:
        """Take steps until the episode is over."""
        start, seen, is_over = self._start, self._start.seen, False
        outer, ask = (start.outer, start.action) if start.kind == "policy" else (start.env, lambda *_: None)
        while not (is_over or self.error or self.crashed_at or self.tick >= start.ticks):
            before = self.tick
            try:
                action = ask(seen, before)
            except UNFIT as error:
                self.error = error_of(error, before, start.guard)
                return
            try:
                seen, _, is_terminated, is_truncated, _ = outer.step(action)
            except Exception as error:
                raise start.unfit(error) from error
            is_over = bool(is_terminated or is_truncated)
            if self.tick == before:
                raise WorldError(
                    "wrappers: expected their step to step the environment, received a step that did not, at "
                    f"{before / start.physics_hz:.1f} s of an episode"
                )

    def _guarded(self, call: Callable[..., None], *arguments: float) -> None:
        """Let all vehicles act or move under guard, because the ego's class is the user's; nothing after an error."""
        if self.error is None:
            try:
                self._start.guarded(call, *arguments)
            except UNFIT as error:
                self.error = error_of(error, self.tick, self._start.guard)

    def _planner(self) -> Callable[..., None]:
        """Return the ``act`` of an ego that a planner drives."""
        start, ego, count = self._start, self._start.env.vehicle, len(self._start.vehicles)
        record, body = start.record(), Body(ego.LENGTH, ego.WIDTH)
        driver = start.driver(body, record)

        def act(action: Any = None) -> None:
            for row, each in enumerate(start.vehicles):
                at = (self.tick * count + row) * COLUMNS
                pose = start.straight.project(float(each.position[0]), float(each.position[1]), float(each.heading))
                held = each.action["acceleration"], each.action["steering"]
                record[at : at + 6] = array("d", (*pose, each.speed, *held))
            x, y = map(float, ego.position)
            body.place(*start.straight.project(x, y, ego.heading), ego.speed)
            error = driver.decide(self.tick) if self.tick % driver.every == 0 else None
            self.error = self.error or error
            driver.actuate()
            ego.control(body.acceleration, body.steering)

        return act

    def _note(self) -> None:
        if self._frames is not None and self.crashed_at in (None, self.tick):
            poses = {each: (*each.position, each.heading, each.speed) for each in self._start.vehicles}
            self._frames.append(poses)

    def recording(self) -> EpisodeRecording:
        """Return the recording of the ticks so far."""
        frames = self._frames or []
        vehicles, gone = list(dict.fromkeys(each for frame in frames for each in frame)), (math.nan,) * 4
        return EpisodeRecording(
            states=np.array([[frame.get(each, gone) for each in vehicles] for frame in frames], dtype=float),
            sizes=np.array([[each.LENGTH, each.WIDTH] for each in vehicles]),
            lanes=self._start.lanes,
            physics_hz=self._start.physics_hz,
        )


def drive(
    environment: GymEnvironment,
    factory: AdsFactory,
    seed: int,
    *,
    hang_limit: float,
    is_planner: bool = False,
    may_compile: bool = True,
    is_recorded: bool = False,
) -> Episode:
    """Drive one episode with a new ADS.

    Args:
        environment: environment, which is reset with the seed.
        factory: factory of an ADS of any kind.
        seed: seed of the episode.
        hang_limit: time after which a decision of the ADS is interrupted and counts as a hang [s].
        is_planner: whether the ADS receives an :class:`pytest_pafot.Observation` and returns acceleration and steering.
        may_compile: whether compiled code may drive the traffic; otherwise the environment takes its own steps.
        is_recorded: whether to record the episode.

    Raises:
        AdsFactoryError: if the factory returns an object that cannot drive.
        WorldError: if the environment cannot be used, or its road is not straight and the ADS is a planner.
    """
    with vehicle_classes_kept(), HangGuard(hang_limit) as guard:
        outer = environment.with_traffic()
        seen, _ = outer.reset(seed=seed)
        view = None
        try:
            if wants_env(factory) and not is_vehicle_class(factory):
                view = View(environment.make().unwrapped, outer.unwrapped)
                ads = make_ads(factory, env=view.env)
            else:
                ads = make_ads(factory)
        except (AdsFactoryError, WorldError):
            raise
        except UNFIT as error:
            return Episode(seed=seed, outcome=Outcome.ADS_ERROR, seconds=0.0, error=error_of(error, 0, guard))
        with closing(ads, hang_limit), ExitStack() as at_the_end:
            kind: Kind = "vehicle" if is_vehicle_class(ads) else "planner" if is_planner else "policy"
            ads, sight = ads_and_sight(ads)
            start = Start(outer=outer, seen=seen, ads=ads, kind=kind, guard=guard, view=view, seed=seed, sight=sight)
            if start.eyes is not None:
                at_the_end.callback(start.eyes.close)
            reason = why_not(start) if may_compile else "that was requested"
            if reason:
                return stepped(start, seed, reason, is_recorded=is_recorded)
            return compiled(start, seed, is_recorded=is_recorded)
