"""Drivers of egos that are highway-env vehicles: by the code of their class, or by a policy with their actions."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from pytest_pafot.model.trace import AdsError
from pytest_pafot.support.errors import BadAction
from pytest_pafot.world.driving.environment import View, check_action_space, checked_action, hide, observer
from pytest_pafot.world.driving.shadow import Unseeing
from pytest_pafot.world.driving.vehicles import Car, CompiledRoad, EgosRegulatedRoad
from pytest_pafot.world.guard.hang_guard import UNFIT, HangGuard, error_of
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.lane_network import Network
from pytest_pafot.world.kernel.loop import EgoDriver
from pytest_pafot.world.kernel.places import Places
from pytest_pafot.world.roads.road import Pose, Road, StraightRoad


class GuardedDriver(EgoDriver):
    """A driver whose decisions are made by Python code under guard."""

    def __init__(self, ego: Body, every: int, guard: HangGuard) -> None:
        super().__init__(ego, every)
        self.guard = guard

    def decide(self, tick: int) -> AdsError | None:
        """Decide under guard, and return the error of the user's code, or None."""
        guard = self.guard
        started = guard.clock()
        try:
            try:
                guard.decision_starts()
                action = self.decided(tick)
            finally:
                guard.decision_ends()  # before the exception is handled, which nothing may interrupt
            guard.raise_swallowed()
        except UNFIT as error:
            return error_of(error, tick, guard)
        if action is not None:
            self.actions.append(action)
        self.slowest = max(self.slowest, guard.clock() - started)
        return None

    def decided(self, tick: int) -> Any:
        """Decide, and return the action for the record; None if there is none."""
        raise NotImplementedError


class ObjectDriver(GuardedDriver):
    """The driver of an ego that is a highway-env vehicle, moved by the code of its class.

    By default the class also decides, at every tick. :meth:`show` must be called before the run begins.

    Args:
        vehicle: the ego as a highway-env vehicle, at its start.
        road: the road of highway-env; the vehicle's own ``road`` may be the user's.
        guard: the guard of its code.
        every: the number of physics ticks between decisions.
        ego: the ego in the loop; by default a body that follows the vehicle.
    """

    def __init__(self, vehicle: Any, road: Any, guard: HangGuard, every: int = 1, ego: Body | None = None) -> None:
        super().__init__(ego or body_of(vehicle), every, guard)
        self.vehicle = vehicle
        self.road = road
        self._regulated = road if isinstance(road, EgosRegulatedRoad) else None
        self._tick = 0

    def show(self, places: Places, road: Road) -> None:
        """Put the ego on its road, and the NPCs as it sees them; ``road`` is the road in the grid's coordinates."""
        cars = [Car(self.road, body) for body in places.vehicles[1:]]
        foresee(cars, places, road)
        self.road.vehicles = [self.vehicle, *cars]

    def show_ego(self) -> None:
        """Let the vehicle of highway-env be where the ego is, which it is if it moves itself."""

    def decided(self, tick: int) -> Any:
        """Call the vehicle's own ``act``."""
        self.vehicle.act()

    def step(self, dt: float) -> AdsError | None:
        """Move the vehicle by its class, which may be the user's code, and return its error, or None."""
        self._tick += 1
        guard = self.guard
        try:
            try:
                guard.decision_starts()
                if self._regulated is not None:
                    self._regulated.regulate(dt)
                self.vehicle.step(dt)
                follow(self.ego, self.vehicle)
            finally:
                guard.decision_ends()
            guard.raise_swallowed()
        except UNFIT as error:
            return error_of(error, self._tick - 1, guard)
        return None


class PolicyDriver(ObjectDriver):
    """A driver that passes an environment's observation to an ADS, and applies the action that it returns.

    Args:
        ads: the ADS.
        env: the environment with the road and the ego of the run.
        guard: the guard of the ADS's decisions.
        every: the number of physics ticks between decisions.
        view: a second environment, in which the ADS may simulate ahead; it shows the state of the run before each
            decision.
        ego: the ego in the loop; by default a body that follows the environment's vehicle.
    """

    def __init__(
        self,
        ads: Any,
        env: Any,
        guard: HangGuard,
        every: int,
        view: View | None = None,
        ego: Body | None = None,
    ) -> None:
        check_action_space(env.action_space)
        super().__init__(env.vehicle, env.road, guard, every, ego)
        self.env = env
        self._ads = ads
        self._observe = hide(env, ads.npc) if isinstance(ads, Unseeing) else observer(env)
        self._view = view

    def decided(self, tick: int) -> Any:
        """Observe, call the ADS, and check and apply its action."""
        return self._applied(self._ads(self.observe(tick)))

    def observe(self, tick: int) -> Any:
        """Return the ADS's observation at the current tick."""
        env = self.env
        env.steps = tick
        env.time = tick / env.config["simulation_frequency"]
        if self._view is not None:
            self._view.show(tick)
        return self._observe()

    def _applied(self, action: Any) -> Any:
        """Check an action, apply it, and return the checked action."""
        checked = checked_action(action, self.env.action_space)
        self.env.action_type.act(checked)
        return checked

    def actuate(self) -> None:
        """Apply the low-level control of highway-env's controlled vehicles."""
        self.vehicle.act()


class ModelPolicyDriver(PolicyDriver):
    """A driver whose ego the kernel moves, as highway-env's vehicle classes of its actions would.

    The environment's vehicle gets the state of the ego before anything reads it, which is once a decision.
    """

    def __init__(
        self,
        ads: Any,
        env: Any,
        guard: HangGuard,
        every: int,
        view: View | None,
        lanes: StraightRoad | Network,
    ) -> None:
        self._compiled = CompiledRoad(env.road, lanes)
        self._model = self._compiled.vehicle(env.vehicle)
        super().__init__(ads, env, guard, every, view, self._model)

    def show_ego(self) -> None:
        """Let the environment's vehicle be where the ego is."""
        self._compiled.show(self.vehicle, self._model)

    def observe(self, tick: int) -> Any:
        """Return the ADS's observation at the current tick."""
        self.show_ego()
        return super().observe(tick)

    def _applied(self, action: Any) -> Any:
        """Check an action, let the environment interpret it, and return the checked action."""
        checked = super()._applied(action)
        self._compiled.take(self.vehicle, self._model)
        return checked

    def actuate(self) -> None:
        """Set the controls of a tick."""
        self._model.act([])

    def step(self, dt: float) -> None:
        """Move the ego for one tick [s]."""
        self._model.step(dt)


def body_of(vehicle: Any) -> Body:
    """Return a body in the loop for a highway-env vehicle."""
    body = Body(float(vehicle.LENGTH), float(vehicle.WIDTH))
    follow(body, vehicle)
    return body


def follow(body: Body, vehicle: Any) -> None:
    """Give a body in the loop the state of a highway-env vehicle.

    Raises:
        BadAction: if the state is not finite.
    """
    x, y = vehicle.position
    state = float(x), float(y), float(vehicle.heading), float(vehicle.speed)
    if not all(map(math.isfinite, state)):
        raise BadAction(f"expected a vehicle with a finite position, heading and speed, received {state}")
    body.place(*state)
    body.acceleration, body.steering = float(vehicle.action["acceleration"]), float(vehicle.action["steering"])


def foresee(npcs: Sequence[Any], places: Places, road: Road) -> None:
    """Let highway-env's regulated roads predict NPCs along their ways or lanes; no other road predicts them."""
    for npc, body in zip(npcs, places.bodies[1:], strict=True):
        pose_at = road.foresight(body)
        if pose_at is not None:
            npc.predict_trajectory_constant_speed = prediction(body, pose_at)


def prediction(body: Body, pose_at: Callable[[float], Pose]) -> Callable[[Any], tuple[list[Any], list[float]]]:
    """Return a prediction for highway-env's regulated road: an NPC continues along its way or lane at its speed."""

    def predicted(times: Any) -> tuple[list[Any], list[float]]:
        poses = [pose_at(body.x + body.speed * float(time)) for time in times]
        return [np.array(pose[:2]) for pose in poses], [pose[2] for pose in poses]

    return predicted
