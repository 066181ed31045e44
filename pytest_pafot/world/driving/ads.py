"""The four kinds of ADS, behind one interface: something that drives the ego vehicle of one run."""

from __future__ import annotations

import functools
import inspect
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import FunctionType
from typing import TYPE_CHECKING, Any, Protocol

from pytest_pafot.errors import AdsFactoryError
from pytest_pafot.world.kernel.action import (
    checked_si_action,
    possible_acceleration,
    possible_steering,
    shown,
    without_reversing,
)
from pytest_pafot.world.kernel.observation import Observation, VehicleState
from pytest_pafot.world.roads.network import NetworkRoad
from pytest_pafot.world.roads.straight import StraightRoad

if TYPE_CHECKING:
    from highway_env.road.road import Road

    from pytest_pafot.world.driving.vehicles import Car

PREDICTING = "`lambda: lambda observation: model.predict(observation, deterministic=True)[0]`"
"""The factory of an ADS that asks a trained model."""

AdsFactory = Callable[..., Any]
"""Gives a fresh ADS, called once per scenario."""


class EgoDriver(Protocol):
    """Drives the ego of one run.

    Attributes:
        vehicle: the ego, a highway-env vehicle.
        every: physics ticks from one decision to the next.
    """

    vehicle: Any
    every: int

    def decide(self, tick: int) -> Any:
        """Ask the ADS, apply its action, and return that; runs the user's code."""

    def actuate(self) -> None:
        """Low-level control in every tick, after a decision if there is one."""


class AskedDriver(EgoDriver, Protocol):
    """Drives the ego with the actions of an ADS, which may be asked elsewhere."""

    def observe(self, tick: int) -> Any:
        """What the ADS sees."""

    def apply(self, action: Any) -> Any:
        """Check an action, apply it, and return it as checked."""


def is_vehicle_class(candidate: object) -> bool:
    """Whether something is a highway-env vehicle class, or a ``functools.partial`` of one."""
    inner = candidate.func if isinstance(candidate, functools.partial) else candidate
    kinematics = sys.modules.get("highway_env.vehicle.kinematics")  # whoever has a vehicle class has imported it
    return kinematics is not None and isinstance(inner, type) and issubclass(inner, kinematics.Vehicle)


def wants_env(factory: AdsFactory) -> bool:
    """Whether a factory has a parameter ``env``."""
    if _takes_nothing(factory):
        return False
    try:
        return "env" in inspect.signature(factory).parameters
    except (TypeError, ValueError):  # builtins without a signature
        return False


def make_ads(factory: AdsFactory, **arguments: Any) -> Any:
    """A fresh ADS.

    Raises:
        AdsFactoryError: when the factory cannot be called so, or gives nothing that drives.
    """
    if is_vehicle_class(factory):
        return factory
    if not callable(factory):
        hint = hint_at_object(factory) or "Return one from the fixture, such as `return lambda: MyPlanner()`"
        raise AdsFactoryError(
            "ads: expected a factory, a callable that returns a fresh ADS for each scenario, received "
            f"{shown(factory)}. {hint}"
        )
    _check_call(factory, arguments)
    try:
        ads = factory(**arguments)
    except TypeError as error:
        if re.search(r"__init__\(\) missing .*'position'", str(error)):
            error.add_note(
                "To let a highway-env vehicle drive, give its class itself, as in `ads=MyVehicle`, without calling it: "
                "each run puts a vehicle of its own on its road."
            )
        raise
    if is_vehicle_class(ads) or callable(ads):
        return ads
    hint = hint_at_object(ads) or (
        "An action is what the ADS returns: write `lambda: lambda observation: ...`, or `lambda: MyPlanner()`"
    )
    raise AdsFactoryError(
        "ads: expected the factory to return an ADS, a callable `observation -> action` or a highway-env vehicle "
        f"class, received {shown(ads)}. {'Is a `return` missing in it?' if ads is None else hint}"
    )


def hint_at_object(given: Any) -> str:
    """What to write where an object cannot be called but has what an ADS is made of; empty for others."""
    if is_vehicle_class(type(given)):
        name = type(given).__name__
        return f"Give the class itself, `{name}`, without calling it: each run puts a vehicle of its own on its road"
    method = next((name for name in ("predict", "act", "decide", "step") if callable(getattr(given, name, None))), "")
    if not method:
        return ""
    example = f", {PREDICTING}" if method == "predict" else ""
    return f"It has a method {method!r}: let the factory return a function of the observation that calls it{example}"


def _takes_nothing(factory: AdsFactory) -> bool:
    """Whether a factory is a plain function without parameters, seen at a glance: signatures cost much."""
    if type(factory) is not FunctionType or factory.__dict__:
        return False
    code = factory.__code__
    takes_any_number = code.co_flags & (inspect.CO_VARARGS | inspect.CO_VARKEYWORDS)
    return not (code.co_argcount or code.co_kwonlyargcount or takes_any_number)


def _check_call(factory: AdsFactory, arguments: dict[str, Any]) -> None:
    if not arguments and _takes_nothing(factory):
        return
    try:
        signature = inspect.signature(factory)
    except (TypeError, ValueError):  # builtins without a signature
        return
    try:
        signature.bind(**arguments)
    except TypeError as error:
        given = "with env=<environment>" if arguments else "without arguments"
        inner = inspect.unwrap(factory)
        if isinstance(inner, type):
            hint = f"Give the arguments in a function, `lambda: {inner.__name__}(...)`"
        elif getattr(inner, "__name__", "") == "predict":
            hint = f"Of a model, write {PREDICTING}"
        else:
            hint = (
                "An ADS itself is no factory. Wrap it so that each scenario gets a fresh one: "
                "`ads=lambda: MyPlanner()`, or `return lambda: MyPlanner()` in the fixture"
            )
        raise AdsFactoryError(
            f"ads: expected a factory that can be called {given}, received one with the signature {signature} "
            f"({error}). {hint}"
        ) from None


def give_route(vehicle: Any, route: Sequence[Any] | None) -> None:
    """Give a vehicle the environment's route, if both have one; highway-env shortens the list as it drives."""
    if route is not None and hasattr(vehicle, "route"):
        vehicle.route = list(route)


class SelfDriving:
    """Kind (c): a highway-env vehicle class that drives itself, at every physics tick."""

    every = 1

    def __init__(
        self, vehicle_class: Any, road: Road, start: tuple[float, float, float], speed: float, route: Any = None
    ) -> None:
        x, y, heading = start
        self.vehicle = vehicle_class(road, [x, y], heading, speed)
        self.vehicle.check_collisions = False
        give_route(self.vehicle, route)

    def decide(self, tick: int) -> None:
        """The vehicle's own ``act``."""
        self.vehicle.act()

    def actuate(self) -> None:
        """Nothing: the vehicle has acted."""


@dataclass(eq=False)
class Planner:
    """Kind (a): a callable from :class:`Observation` to (acceleration [m/s^2], steering [rad])."""

    ads: Callable[[Observation], Any]
    road: Road
    lanes: StraightRoad | NetworkRoad
    vehicle: Car
    physics_hz: int
    every: int

    def decide(self, tick: int) -> tuple[float, float]:
        """Observe, ask, check and apply."""
        return self.apply(self.ads(self.observe(tick)))

    def apply(self, action: Any) -> tuple[float, float]:
        """Check an action, apply it, and return it as checked."""
        pair = checked_si_action(action)
        self._wanted = possible_acceleration(pair[0])
        self.vehicle.control(self._wanted, possible_steering(pair[1]))
        return pair

    def actuate(self) -> None:
        """Brake to a standstill, never into reverse."""
        self.vehicle.acceleration = without_reversing(self._wanted, self.vehicle.speed, 1 / self.physics_hz)

    def observe(self, tick: int) -> Observation:
        """What the ADS sees: all vehicles as they are now."""
        ego, *others = (
            VehicleState(v.x, v.y, v.heading, v.speed, v.lane_index[2], v.LENGTH, v.WIDTH) for v in self.road.vehicles
        )
        road, time = self.lanes, tick / self.physics_hz
        return Observation(time, ego, tuple(others), len(road.lanes), road.lane_width, road.speed_limit)
