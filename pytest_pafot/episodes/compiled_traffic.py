"""Episodes on a straight road among highway-env's IDM and MOBIL vehicles, whose motion is computed by compiled code.

The environment still creates the start and the observations, interprets actions, and decides when the episode is over.
Before each of these steps, the environment's vehicles are moved to the places that the compiled code has computed.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterator
from itertools import chain
from typing import Any

import numpy as np
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.road.road import Road
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle
from highway_env.vehicle.kinematics import Vehicle

from pytest_pafot.episodes.episode import Episode, EpisodeRecording, Start, Step
from pytest_pafot.model.trace import AdsError
from pytest_pafot.world.driving.idm_model import CONSTANTS, idm_model
from pytest_pafot.world.driving.kinematics import observer
from pytest_pafot.world.guard.failure import UNFIT, error_of
from pytest_pafot.world.gym_environment import NEUTRAL
from pytest_pafot.world.kernel.loop import Pilot
from pytest_pafot.world.kernel.observation import COLUMNS
from pytest_pafot.world.kernel.traffic import OrdinaryTraffic, TrafficVehicle
from pytest_pafot.world.roads.straight import StraightRoad


def why_not(start: Start) -> str:
    """Return the reason why compiled code cannot drive the traffic of an episode; empty if it can."""
    return next(chain(_of_the_environment(start), _of_the_vehicles(start)), "")


def _of_the_environment(start: Start) -> Iterator[str]:
    env, road, inner, cls = start.env, start.env.road, start.outer, type(start.env)
    while isinstance(inner, NEUTRAL):
        inner = inner.env
    if inner is not env:
        yield f"the environment is wrapped in {type(inner).__name__}"
    if type(road) is not Road or cls.step is not AbstractEnv.step or cls._simulate is not AbstractEnv._simulate:
        yield f"{cls.__name__} has its own steps"
    if start.road is None or len({lane.speed_limit for lane in start.road.lanes}) > 1:
        yield "the road is not straight, or its lanes differ"
    if road.objects or any(lane.forbidden for lane in road.network.lanes_list()):
        yield "there are objects on the road, or lanes that may not be entered"


def _of_the_vehicles(start: Start) -> Iterator[str]:
    env, road, ego = start.env, start.env.road, start.env.vehicle
    for each in road.vehicles:
        if each is not ego and (idm_model(type(each)) is None or each.route):
            yield f"the traffic has a {type(each).__name__}, not only IDM and MOBIL"
        if (each.MIN_SPEED, each.MAX_SPEED) != (Vehicle.MIN_SPEED, Vehicle.MAX_SPEED):
            yield f"a {type(each).__name__} has its own speed limits"
    if start.kind == "vehicle" and not isinstance(ego, ControlledVehicle) and hasattr(ego, "target_speed"):
        yield f"{type(ego).__name__} has a target speed and no target lane"
    has_range = getattr(env.action_type, "speed_range", None) is not None  # actions limit the ego's speed to it
    if start.kind == "policy" and (type(ego) not in (MDPVehicle, Vehicle) or has_range):
        yield f"the actions drive a {type(ego).__name__} with its own limits"
    if road.vehicles[0] is not ego:
        yield "the ego is not the first on its road"


def compiled(start: Start, seed: int, *, is_recorded: bool) -> Episode:
    """Drive an episode with compiled traffic; :func:`why_not` must have returned an empty text for its start."""
    road, record = start.straight, start.record()
    traffic, mirror = _compiled(start, record)
    pilot: Pilot
    if start.kind == "planner":
        pilot = start.pilot(mirror.ego, record)
    elif start.kind == "policy":
        pilot = _PolicyPilot(start, mirror)
    else:
        pilot = Pilot(start.ticks) if idm_model(start.ads) is not None else _VehiclePilot(start, mirror)
    error = _drive(start, traffic, pilot, mirror)
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
        self._pilot = _PolicyPilot(start, self._mirror)

    def step(self, action: Any) -> Step:
        """Take one step with an action, and return the same values as ``env.step`` of the environment."""
        start, env, traffic = self._start, self._start.env, self._traffic
        env.time += 1 / env.config["policy_frequency"]
        self._pilot.apply(action)
        for _ in range(start.every):
            if traffic.step():
                break
        self._mirror.show()
        env.steps = traffic.tick
        seen, reward = self._pilot.observe(), float(env._reward(action))
        is_truncated = bool(env._is_truncated()) or traffic.tick + start.every > start.ticks
        return seen, reward, bool(env._is_terminated()), is_truncated, env._info(seen, action)


def _compiled(start: Start, record: array[float]) -> tuple[OrdinaryTraffic, _Mirror]:
    """Return the compiled traffic of an episode and its mirror; the traffic writes all states into ``record``."""
    bodies = [_body(each, start.straight) for each in start.vehicles]
    return OrdinaryTraffic(bodies, record, 1 / start.physics_hz), _Mirror(start, bodies, start.straight)


def _drive(start: Start, traffic: OrdinaryTraffic, pilot: Pilot, mirror: _Mirror) -> AdsError | None:
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
        if tick % pilot.every == 0:
            error = pilot.decide(tick)
            if error is not None:
                return error
        pilot.actuate()
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


class _PolicyPilot(Pilot):
    """The driver of an ego by a policy, which receives the environment's observations and returns its actions."""

    def __init__(self, start: Start, mirror: _Mirror) -> None:
        super().__init__(start.every)
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


class _VehiclePilot(Pilot):
    """The driver of an ego whose vehicle class has its own code to act and move."""

    def __init__(self, start: Start, mirror: _Mirror) -> None:
        super().__init__(1)
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


def _body(vehicle: Any, road: StraightRoad) -> TrafficVehicle:
    """Return the compiled vehicle with the state of one of the environment's vehicles."""
    constants = {name: getattr(vehicle, name, getattr(IDMVehicle, name)) for name in (*CONSTANTS, "KP_A")}
    body = TrafficVehicle(
        constants,
        road.grid,
        road.speed_limit,
        has_goal=isinstance(vehicle, ControlledVehicle),
        drives_itself=idm_model(type(vehicle)) is not None,
        # highway-env's IDM treats a vehicle without a target speed as one that wants to stand still.
        taken_for=math.nan if hasattr(vehicle, "target_speed") else 0.0,
    )
    pose = road.project(float(vehicle.position[0]), float(vehicle.position[1]), float(vehicle.heading))
    body.start(*pose, float(vehicle.speed), bool(getattr(vehicle, "enable_lane_change", True)))
    goal = getattr(vehicle, "target_lane_index", vehicle.lane_index)[2]
    body.begin(goal, float(getattr(vehicle, "target_speed", 0.0)), float(getattr(vehicle, "timer", 0.0)))
    body.checks = bool(vehicle.check_collisions)
    return body
