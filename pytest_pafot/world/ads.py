"""The four kinds of ADS, behind one interface: something that drives the ego vehicle of one run."""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Callable
from typing import Any, Protocol

from highway_env.road.road import Road
from highway_env.vehicle.kinematics import Vehicle

from pytest_pafot.world.errors import AdsFactoryError
from pytest_pafot.world.observation import Observation, VehicleState
from pytest_pafot.world.road import StraightRoad
from pytest_pafot.world.vehicles import Car

EGO_ACCELERATION = 6.0
"""Strongest acceleration that a planner's action has an effect up to [m/s^2]."""
EGO_BRAKING = 9.81
"""Strongest deceleration, likewise: full braking on a dry road [m/s^2]."""
EGO_STEERING = math.pi / 4
"""Largest steering angle, likewise [rad]."""

AdsFactory = Callable[..., Any]
"""Gives a fresh ADS, called once per scenario."""


class BadAction(Exception):  # noqa: N818  (named in findings as the fault it is)
    """What an ADS returned is no action; the message says what was expected."""


class EgoDriver(Protocol):
    """Drives the ego of one run.

    Attributes:
        vehicle: the ego, a highway-env vehicle.
        every: physics ticks from one decision to the next.
    """

    vehicle: Vehicle
    every: int

    def decide(self, tick: int) -> Any:
        """Ask the ADS, apply its action, and return that; runs the user's code."""

    def actuate(self) -> None:
        """Low-level control in every tick, after a decision if there is one."""


def is_vehicle_class(candidate: object) -> bool:
    """Whether something is a highway-env vehicle class, or a ``functools.partial`` of one."""
    inner = candidate.func if isinstance(candidate, functools.partial) else candidate
    return isinstance(inner, type) and issubclass(inner, Vehicle)


def wants_env(factory: AdsFactory) -> bool:
    """Whether a factory has a parameter ``env``."""
    try:
        return "env" in inspect.signature(factory).parameters
    except (TypeError, ValueError):  # builtins without a signature
        return False


def made(factory: AdsFactory, **arguments: Any) -> Any:
    """A fresh ADS.

    Raises:
        AdsFactoryError: when the factory cannot be called so, or gives nothing that drives.
    """
    if is_vehicle_class(factory):
        return factory
    if not callable(factory):
        raise AdsFactoryError(
            f"ads: expected a factory, a callable that returns a fresh ADS for each scenario, received {factory!r}; "
            "return a function or class from the fixture, such as `return lambda: MyPlanner()`"
        )
    _check_call(factory, arguments)
    ads = factory(**arguments)
    if is_vehicle_class(ads) or callable(ads):
        return ads
    raise AdsFactoryError(
        f"ads: expected the factory to return an ADS, a callable `observation -> action` or a highway-env vehicle "
        f"class, received {ads!r}. If the fixture gives the ADS itself, wrap it: `return lambda: MyPlanner()`"
    )


def _check_call(factory: AdsFactory, arguments: dict[str, Any]) -> None:
    try:
        signature = inspect.signature(factory)
    except (TypeError, ValueError):  # builtins without a signature
        return
    try:
        signature.bind(**arguments)
    except TypeError as error:
        given = "with env=<environment>" if arguments else "without arguments"
        raise AdsFactoryError(
            f"ads: expected a factory that can be called {given}, received one with the signature {signature} "
            f"({error}). If the fixture gives the ADS itself, wrap it: `return lambda: MyPlanner()`"
        ) from None


class SelfDriving:
    """Kind (c): a highway-env vehicle class that drives itself, at every physics tick."""

    every = 1

    def __init__(self, vehicle_class: Any, road: Road, start: tuple[float, float, float], speed: float) -> None:
        x, y, heading = start
        self.vehicle = vehicle_class(road, [x, y], heading, speed)
        self.vehicle.check_collisions = False

    def decide(self, tick: int) -> None:
        """The vehicle's own ``act``."""
        self.vehicle.act()

    def actuate(self) -> None:
        """Nothing: the vehicle has acted."""


class Planner:
    """Kind (a): a callable from :class:`Observation` to (acceleration [m/s^2], steering [rad])."""

    def __init__(
        self,
        ads: Callable[[Observation], Any],
        road: Road,
        straight: StraightRoad,
        ego: Car,
        physics_hz: int,
        every: int,
    ) -> None:
        self.vehicle = ego
        self.every = every
        self._ads = ads
        self._road = road
        self._straight = straight
        self._physics_hz = physics_hz

    def decide(self, tick: int) -> tuple[float, float]:
        """Observe, ask, check and apply."""
        action = checked_si_action(self._ads(self.observe(tick)))
        acceleration = min(max(action[0], -EGO_BRAKING), EGO_ACCELERATION)
        self._wanted = acceleration
        self.vehicle.control(acceleration, min(max(action[1], -EGO_STEERING), EGO_STEERING))
        return action

    def actuate(self) -> None:
        """Brake to a standstill, never into reverse."""
        dt = 1 / self._physics_hz
        self.vehicle.acceleration = max(self._wanted, -self.vehicle.speed / dt) if self._wanted < 0 else self._wanted

    def observe(self, tick: int) -> Observation:
        """The scene as it is now."""
        states = [
            VehicleState(v.x, v.y, v.heading, v.speed, v.lane_index[2], v.LENGTH, v.WIDTH) for v in self._road.vehicles
        ]
        straight = self._straight
        return Observation(
            tick / self._physics_hz,
            states[0],
            tuple(states[1:]),
            len(straight.lanes),
            straight.lane_width,
            straight.speed_limit,
        )


def checked_si_action(action: Any) -> tuple[float, float]:
    """(acceleration, steering) as two floats.

    Raises:
        BadAction: unless it is a pair of finite numbers.
    """
    expected = "expected (acceleration [m/s^2], steering [rad]), two finite numbers"
    if isinstance(action, (str, bytes, dict, set)):
        raise BadAction(f"{expected}, received {shown(action)}")
    try:
        acceleration, steering = action
        if isinstance(acceleration, (str, bytes)) or isinstance(steering, (str, bytes)):
            raise TypeError("text is no number")
        pair = float(acceleration), float(steering)
    except (TypeError, ValueError, OverflowError):
        raise BadAction(f"{expected}, received {shown(action)}") from None
    if not (math.isfinite(pair[0]) and math.isfinite(pair[1])):
        raise BadAction(f"{expected}, received {shown(action)}")
    return pair


def shown(value: Any) -> str:
    """A value in an error message, cut to a line."""
    return one_line(repr(value))


def one_line(text: str) -> str:
    """A text on one line, cut to what one can hold."""
    line = " ".join(text.split())
    return line if len(line) <= 120 else f"{line[:117]}..."
