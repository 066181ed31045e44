"""Episodes of an unchanged environment: its own start, its own random traffic, and its own flag for crashes.

The start of an episode is the result of ``env.reset`` with its seed. Compiled code then drives the traffic if possible;
otherwise the environment takes its own steps. Both give the same outcome at the same tick, and positions that differ
only because numpy rounds some functions differently: by less than 1e-9 m, and up to 1e-7 m where vehicles crawl at an
intersection, because highway-env's steering is unstable at such speeds.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import numpy as np
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.exit_env import ExitEnv
from highway_env.envs.intersection_env import IntersectionEnv
from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import Road
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Obstacle

from pytest_pafot.episodes.episode import Episode, EpisodeRecording, Kind, Start, Step
from pytest_pafot.model.trace import AdsError, Outcome
from pytest_pafot.support.errors import AdsFactoryError, WorldError
from pytest_pafot.world.driving.ads import AdsFactory, is_vehicle_class, make_ads, wants_env
from pytest_pafot.world.driving.compiled_vehicle import CompiledRoad, obstacles_on, road_rules
from pytest_pafot.world.driving.idm_model import idm_model
from pytest_pafot.world.driving.observations import observe_fast, observer
from pytest_pafot.world.driving.perception import ads_and_sight
from pytest_pafot.world.driving.policy import View
from pytest_pafot.world.guard.failure import UNFIT, closing, error_of
from pytest_pafot.world.guard.hang_guard import HangGuard
from pytest_pafot.world.gym_environment import NEUTRAL, GymEnvironment, vehicle_classes_kept
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.observation import COLUMNS
from pytest_pafot.world.kernel.traffic import OrdinaryTraffic


def why_not(start: Start) -> str:
    """Return the reason why compiled code cannot drive the traffic of an episode; empty if it can."""
    env, road, ego, inner, cls = start.env, start.env.road, start.env.vehicle, start.outer, type(start.env)
    while isinstance(inner, NEUTRAL):
        inner = inner.env
    if inner is not env:
        return f"the environment is wrapped in {type(inner).__name__}"
    steps = AbstractEnv.step, ExitEnv.step, IntersectionEnv.step
    is_known = cls.step in steps and cls._simulate is AbstractEnv._simulate
    if type(road) not in (Road, RegulatedRoad) or not is_known:
        return f"{cls.__name__} has its own steps"
    if start.compiled_lanes is None:
        return "the road has lanes of a class of its own"
    if start.kind == "planner" and start.compiled_lanes is not start.road:
        return "a planner needs lanes of one speed limit, without objects and routes"
    for each in road.objects:
        if type(each) is not Obstacle:
            return f"there is a {type(each).__name__} on the road"
    for each in road.vehicles:
        if each is not ego and idm_model(type(each)) is None:
            return f"the traffic has a {type(each).__name__}, not only IDM and MOBIL"
        if (each.MIN_SPEED, each.MAX_SPEED) != (Vehicle.MIN_SPEED, Vehicle.MAX_SPEED):
            return f"a {type(each).__name__} has its own speed limits"
    if start.kind == "vehicle" and not isinstance(ego, ControlledVehicle) and hasattr(ego, "target_speed"):
        return f"{type(ego).__name__} has a target speed and no target lane"
    has_range = getattr(env.action_type, "speed_range", None) is not None  # actions limit the ego's speed to it
    if start.kind == "policy" and (type(ego) not in (MDPVehicle, Vehicle) or has_range):
        return f"the actions drive a {type(ego).__name__} with its own limits"
    decides_itself = start.kind == "planner" or (start.kind == "vehicle" and idm_model(type(ego)) is None)
    if decides_itself and (road.vehicles[0] is not ego or type(road) is RegulatedRoad):
        return "the ego is not the first on its road, or the road makes it yield"
    return ""


class Steps:
    """An episode in which the environment takes its steps, but something else than its road's functions may do a tick.

    Attributes:
        tick: current tick of the episode.
        crashed_at: tick at which the ego was flagged as crashed, else None; the environment continues to the end of its
            step.
        error: error of the ADS, if it did not decide, else None.
    """

    def __init__(self, start: Start, act: Callable[[], None], step: Callable[[float], None]) -> None:
        self.tick = 0
        self.crashed_at: int | None = None
        self.error: AdsError | None = None
        self._start = start
        self._frames: list[dict[Any, tuple[float, ...]]] | None = None
        # A copy of a vehicle with its road shares plain functions. It would copy a method with its object.
        start.env.road.act, start.env.road.step = lambda: act(), lambda dt: step(dt)  # noqa: PLW0108

    def run(self, seed: int, reason: str, *, is_recorded: bool) -> Episode:
        """Take steps until the episode is over, and return its result.

        ``reason`` says why its traffic is not compiled, and is stored in the result.
        """
        start, seen, is_over = self._start, self._start.seen, False
        outer, ask = (start.outer, start.action) if start.kind == "policy" else (start.env, lambda *_: None)
        self._frames = [] if is_recorded else None
        self._note()
        while not (is_over or self.error or self.crashed_at or self.tick >= start.ticks):
            before = self.tick
            try:
                action = ask(seen, before)
            except UNFIT as error:
                self.error = error_of(error, before, start.guard)
                break
            try:
                seen, _, is_terminated, is_truncated, _ = outer.step(action)
            except Exception as error:
                raise start.unfit(error) from error
            is_over = bool(is_terminated or is_truncated)
            if self.tick == before and self.error is None:
                raise WorldError(
                    "wrappers: expected their step to step the environment, received a step that did not, at "
                    f"{before / start.physics_hz:.1f} s of an episode"
                )
        tick = self.tick if self.crashed_at is None else self.crashed_at
        tick = tick if self.error is None else self.error.tick
        return start.ended(seed, tick, self.error, steps=reason, recording=self._recording())

    def _ticked(self) -> None:
        """Count a tick in which all vehicles have moved."""
        self.tick += 1
        if self._start.env.vehicle.crashed and self.crashed_at is None:
            self.crashed_at = self.tick
        self._note()

    def _guarded(self, call: Callable[..., None], *arguments: float) -> None:
        """Call the user's code under guard; nothing after an error."""
        if self.error is None:
            try:
                self._start.guarded(call, *arguments)
            except UNFIT as error:
                self.error = error_of(error, self.tick, self._start.guard)

    def _note(self) -> None:
        if self._frames is not None and self.crashed_at in (None, self.tick):
            poses = {each: (*each.position, each.heading, each.speed) for each in self._start.vehicles}
            self._frames.append(poses)

    def _recording(self) -> EpisodeRecording | None:
        """Return the recording of the ticks so far; None if there is none."""
        if self._frames is None:
            return None
        frames = self._frames
        vehicles, gone = list(dict.fromkeys(each for frame in frames for each in frame)), (math.nan,) * 4
        return EpisodeRecording(
            states=np.array([[frame.get(each, gone) for each in vehicles] for frame in frames], dtype=float),
            sizes=np.array([[each.LENGTH, each.WIDTH] for each in vehicles]),
            lanes=self._start.lanes,
            physics_hz=self._start.physics_hz,
        )


class CompiledSteps(Steps):
    """An episode among highway-env's IDM and MOBIL vehicles, all of which compiled code moves.

    The environment still creates the start and the observations, interprets actions, and decides when the episode is
    over. Before each of these, its vehicles are moved to the places that the compiled code has computed.
    :func:`why_not` must have returned an empty text for the start.
    """

    def __init__(self, start: Start) -> None:
        env = start.env
        assert start.compiled_lanes is not None  # noqa: S101  (see why_not)
        self._road = CompiledRoad(env.road, start.compiled_lanes)
        self._bodies = {each: self._road.vehicle(each) for each in env.road.vehicles}
        self._ego = self._bodies[env.vehicle]
        record = start.record() if start.kind == "planner" else None
        self._traffic = OrdinaryTraffic(
            list(self._bodies.values()),
            obstacles_on(env.road),
            1 / start.physics_hz,
            record,
            road_rules(env.road, start.compiled_lanes, start.physics_hz),
        )
        self._planner = None if record is None else start.driver(self._ego, record)
        super().__init__(start, self._act, self._step)
        if start.kind == "policy" and start.eyes is None:
            env.observation_type.observe = observer(env)

    def step(self, action: Any) -> Step:
        """Take one step with an action, and return the values of ``env.step``; the episode ends at a crash's tick."""
        start = self._start
        seen, reward, is_terminated, is_truncated, info = start.env.step(action)
        is_truncated = bool(is_truncated) or self.tick + start.every > start.ticks
        return seen, float(reward), bool(is_terminated), is_truncated, info

    def _act(self) -> None:
        """Let the ego decide, unless its model does; the environment has interpreted the action of a policy."""
        if self._is_over():
            return
        start, ego, vehicles = self._start, self._start.env.vehicle, self._start.env.road.vehicles
        if vehicles != list(self._bodies):  # the environment has added or removed some after its last step
            self._bodies = {each: self._bodies.get(each) or self._road.vehicle(each) for each in vehicles}
            self._traffic.vehicles = list(self._bodies.values())
        if self._planner is not None:
            if self.tick % self._planner.every == 0:
                self.error = self._planner.decide(self.tick)
            self._planner.actuate()
        elif start.kind == "policy":
            if self.tick % start.every == 0:
                self._road.take(ego, self._ego)
            if start.eyes is not None:  # an imperfect sight stores the places of all vehicles
                self._show()
                start.eyes.note()
        elif not self._ego.drives_itself:
            self._show()
            self._guarded(ego.act)
            self._road.take(ego, self._ego)
            self._guarded(ego.step, 1 / start.physics_hz)
            self._ego.acceleration = float(ego.action["acceleration"])  # its step may have limited it
            self._ego.lead(*self._road.state(ego))

    def _step(self, dt: float) -> None:
        if self._is_over():
            return
        self._traffic.step()
        if self._ego.crashed or self._frames is not None or (self.tick + 1) % self._start.every == 0:
            self._show()
        self._ticked()

    def _is_over(self) -> bool:
        """Return whether an error or a crash has ended the episode, although the environment's step goes on."""
        return self.error is not None or self.crashed_at is not None

    def _show(self) -> None:
        """Move the environment's vehicles to the places of the compiled ones."""
        for vehicle, body in self._bodies.items():
            self._road.show(vehicle, body)


class OwnSteps(Steps):
    """An episode by the environment's own steps, which works for any environment and any ADS."""

    def __init__(self, start: Start) -> None:
        road, is_policy = start.env.road, start.kind == "policy"
        own_act, own_step = road.act, road.step

        def act() -> None:
            if start.eyes is not None:
                start.eyes.note()
            own_act() if is_policy else self._guarded(own_act)

        def step(dt: float) -> None:
            own_step(dt) if is_policy else self._guarded(own_step, dt)
            self._ticked()

        super().__init__(start, act, step)
        if start.kind == "planner":
            start.env.vehicle.act = self._planner()

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
        observe_fast(outer.unwrapped)
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
            steps = OwnSteps(start) if reason else CompiledSteps(start)
            env = start.env
            if not (reason and kind == "policy"):  # nothing reads them, but a wrapper may
                env._reward, env._info = lambda *_: 0.0, lambda *_: {}
                at_the_end.callback(lambda: [vars(env).pop(name) for name in ("_reward", "_info")])  # it is used again
            if kind != "policy":
                env.observation_type.observe = lambda: 0.0
            return steps.run(seed, reason, is_recorded=is_recorded)
