"""The usual way to run highway-env, ``gymnasium.make`` and ``env.step``, driven with a recorded run's controls."""

from __future__ import annotations

from typing import Any

import gymnasium
import highway_env  # noqa: F401  (registers its environments)
import numpy as np
from highway_env.utils import lmap
from highway_env.vehicle.kinematics import Vehicle

from pytest_pafot.model.trace import ACCELERATION, HEADING, SPEED, STEERING, FloatArray, Trace


class Replayed(Vehicle):
    """A stock vehicle that follows a recorded list of controls, one per physics tick."""

    controls: FloatArray

    def act(self, action: Any = None) -> None:
        acceleration, steering = self.controls[self.tick]
        self.tick += 1
        super().act({"acceleration": float(acceleration), "steering": float(steering)})


class StateLog:
    """A replacement for ``road.step`` that records every vehicle's state after each physics step."""

    def __init__(self, road: Any) -> None:
        self.rows: list[list[tuple[float, ...]]] = []
        self._road = road
        self._step = road.step

    def __call__(self, dt: float) -> None:
        self._step(dt)
        self.rows.append(
            [(*vehicle.position, vehicle.heading, vehicle.speed) for vehicle in self._road.vehicles]
        )


ACCELERATION_RANGE = (-5, 5.0)
STEERING_RANGE = (-np.pi / 4, np.pi / 4)
"""The range to which highway-env's ContinuousAction maps [-1, 1] [m/s^2, rad]."""


def si_actions(actions: list[FloatArray]) -> list[tuple[float, float]]:
    """Convert actions to accelerations and steering angles by highway-env's own mapping in float32."""
    return [
        (float(lmap(a, [-1, 1], ACCELERATION_RANGE)), float(lmap(s, [-1, 1], STEERING_RANGE)))
        for a, s in actions
    ]


def make_env(trace: Trace) -> Any:
    """Make highway-v0 with the trace's road and frequencies, and with continuous actions in [-1, 1]."""
    env = gymnasium.make(
        "highway-v0",
        disable_env_checker=True,
        config={
            "lanes_count": len(trace.lanes),
            "vehicles_count": 0,
            "simulation_frequency": trace.physics_hz,
            "policy_frequency": trace.ads_hz,
            "duration": 10_000,
            "action": {"type": "ContinuousAction"},
        },
    )
    env.reset(seed=0)
    return env


def place(env: Any, trace: Trace, *, stub_observation: bool = False) -> StateLog:
    """Place the trace's vehicles on the road of a new episode, its NPCs with their recorded controls."""
    road = env.unwrapped.road
    vehicles = []
    for index, state in enumerate(trace.states[0]):
        vehicle_class = Vehicle if index == 0 else Replayed
        vehicle = vehicle_class(road, state[:2], float(state[HEADING]), float(state[SPEED]))
        vehicle.check_collisions = False
        if index:
            vehicle.tick = 0
            vehicle.controls = trace.states[1:, index, (ACCELERATION, STEERING)]
        vehicles.append(vehicle)
    road.vehicles = vehicles
    env.unwrapped.controlled_vehicles = vehicles[:1]
    if stub_observation:
        nothing = np.zeros(env.observation_space.shape, dtype=np.float32)
        env.unwrapped.observation_type.observe = lambda: nothing
    log = StateLog(road)
    road.step = log
    return log


def drive(env: Any, trace: Trace, actions: list[FloatArray]) -> None:
    """Step the environment with the ego's actions, one per decision of the trace."""
    for action in actions[: -(-trace.ticks * trace.ads_hz // trace.physics_hz)]:
        env.step(action)
