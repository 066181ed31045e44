"""The four kinds of ADS behind one interface, which drives the ego of one run; and calls of ADS factories."""

from __future__ import annotations

import functools
import inspect
import re
import sys
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from types import FunctionType
from typing import TYPE_CHECKING, Any, Protocol, cast

from pytest_pafot.support.errors import AdsFactoryError
from pytest_pafot.support.text import shown
from pytest_pafot.world.driving.seeing import PlannerSight, SeeingAds
from pytest_pafot.world.guard.hang_guard import one_process, unending
from pytest_pafot.world.kernel.action import (
    Drive,
    acceleration_to_speed,
    checked_si_action,
    possible_acceleration,
    possible_steering,
    without_reversing,
)
from pytest_pafot.world.kernel.driver import LaneTracker
from pytest_pafot.world.kernel.observation import Observation, VehicleState, lateral_velocity
from pytest_pafot.world.roads.network import NetworkRoad
from pytest_pafot.world.roads.straight import StraightRoad

if TYPE_CHECKING:
    from highway_env.road.road import Road

    from pytest_pafot.world.driving.vehicles import Car

PREDICTING = "`lambda: lambda observation: model.predict(observation, deterministic=True)[0]`"
"""An example of a factory whose ADS calls a trained model, for messages."""

AdsFactory = Callable[..., Any]
"""A callable that returns a fresh ADS; it is called once per scenario.

It may have these optional members: a method ``check_world(world)``, which raises if its ADSs cannot drive there; a
method ``preload()``, which the session calls so that forked processes share what it loads; a text ``weights_digest``, a
hash of the policy, which findings store; and a text ``loading_hint``, which a search reports as a note.
"""


class EgoDriver(Protocol):
    """The driver of the ego in one run.

    Attributes:
        vehicle: the ego, a highway-env vehicle.
        every: the number of physics ticks between decisions.
    """

    vehicle: Any
    every: int

    def decide(self, tick: int) -> Any:
        """Call the ADS, which is the user's code, apply its action, and return the action."""

    def actuate(self) -> None:
        """Apply the low-level control of a tick; called in every tick, after a decision if there is one."""


class AskedDriver(EgoDriver, Protocol):
    """A driver of the ego whose ADS may also be called by other code, which passes the actions to :meth:`apply`."""

    def observe(self, tick: int) -> Any:
        """Return the ADS's observation at a tick."""

    def apply(self, action: Any) -> Any:
        """Check an action, apply it, and return the checked action."""


def is_vehicle_class(candidate: object) -> bool:
    """Return whether an object is a highway-env vehicle class, or a ``functools.partial`` of one."""
    inner = candidate.func if isinstance(candidate, functools.partial) else candidate
    kinematics = sys.modules.get("highway_env.vehicle.kinematics")  # imported wherever a vehicle class exists
    return kinematics is not None and isinstance(inner, type) and issubclass(inner, kinematics.Vehicle)


def wants_env(factory: AdsFactory) -> bool:
    """Return whether a factory has a parameter ``env``."""
    if _takes_nothing(factory):
        return False
    try:
        return "env" in inspect.signature(factory).parameters
    except (TypeError, ValueError):  # builtins without a signature
        return False


def check_drives_in(factory: AdsFactory, world: Any) -> None:
    """Call a factory's ``check_world``, if it has one; its error reports what does not fit the world."""
    check = _of_factory(factory, "check_world")
    if check is not None:
        check(world)


def preload(factory: AdsFactory) -> None:
    """Call a factory's ``preload``, if it has one, so that forked processes share what it loads."""
    load = _of_factory(factory, "preload")
    if load is not None:
        load()


def weights_digest(factory: AdsFactory) -> str:
    """Return the hash of a factory's policy; empty if it states none."""
    told = _of_factory(factory, "weights_digest")
    return told if isinstance(told, str) else ""


def loading_hint(factory: AdsFactory) -> str:
    """Return a factory's note that its policy may need other options for loading; empty if it has none."""
    told = _of_factory(factory, "loading_hint")
    return told if isinstance(told, str) else ""


def _of_factory(factory: AdsFactory, name: str) -> Any:
    """Return an attribute of a factory or of the factory that it wraps; None if there is none.

    A class has none, because its attributes belong to its instances, the ADSs.
    """
    inner = inspect.unwrap(factory)
    return None if isinstance(inner, type) else getattr(inner, name, None)


def make_ads(factory: AdsFactory, **arguments: Any) -> Any:
    """Make a fresh ADS; a vehicle class is returned as it is.

    Raises:
        AdsFactoryError: if the factory cannot be called with these arguments, or returns nothing that drives.
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
        with unending(), one_process():
            ads = factory(**arguments)
    except TypeError as error:
        if re.search(r"__init__\(\) missing .*'position'", str(error)):
            error.add_note(
                "To let a highway-env vehicle drive, give its class itself, as in `ads=MyVehicle`, without calling it: "
                "each run makes its own vehicle."
            )
        raise
    if isinstance(ads, SeeingAds):
        _check_sight_is_told(factory, ads)
    if is_vehicle_class(ads) or callable(ads):
        return ads
    hint = hint_at_object(ads) or (
        "An action is what the ADS returns: write `lambda: lambda observation: ...`, or `lambda: MyPlanner()`"
    )
    raise AdsFactoryError(
        "ads: expected the factory to return an ADS, a callable `observation -> action` or a highway-env vehicle "
        f"class, received {shown(ads)}. {'Is a `return` missing in it?' if ads is None else hint}"
    )


def _check_sight_is_told(factory: AdsFactory, ads: SeeingAds) -> None:
    """Refuse an imperfect sight that only the ADS has, because a reader of the factory would assume perfect sight."""
    seeing = inspect.unwrap(factory, stop=lambda each: getattr(each, "sight", None) == ads.sight)
    if getattr(seeing, "sight", None) != ads.sight:
        raise AdsFactoryError(
            f"ads: expected a pafot.Perception as the factory itself, received a pafot.Perception that "
            f"{shown(factory)} makes and calls, so findings would not state the imperfect sight; write "
            "`ads=pafot.Perception(lambda: MyPlanner(), ...)`, or return that from the fixture"
        )


def hint_at_object(given: Any) -> str:
    """Return a hint for a vehicle or a model with a method such as ``predict``, which is no ADS; otherwise empty."""
    if is_vehicle_class(type(given)):
        name = type(given).__name__
        return f"Give the class itself, `{name}`, without calling it: each run makes its own vehicle"
    method = next((name for name in ("predict", "act", "decide", "step") if callable(getattr(given, name, None))), "")
    if not method:
        return ""
    example = f", {PREDICTING}" if method == "predict" else ""
    return f"It has a method {method!r}: let the factory return a function of the observation that calls it{example}"


def _takes_nothing(factory: AdsFactory) -> bool:
    """Return whether a factory is a plain function without parameters; this is much faster than its signature."""
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
            hint = f"For a model, write {PREDICTING}"
        elif inspect.isfunction(inner) and inner.__name__ != "<lambda>":
            name = inner.__name__
            hint = f"If {name} is the ADS itself, write `lambda: {name}`; if it makes one, `lambda: {name}(...)`"
        else:
            hint = (
                "An ADS itself is not a factory. Wrap it so that each scenario gets a fresh one: "
                "`lambda: MyPlanner()`, or `return lambda: MyPlanner()` in the fixture"
            )
        raise AdsFactoryError(
            f"ads: expected a factory that can be called {given}, received one with the signature {signature} "
            f"({error}). {hint}"
        ) from None


def give_route(vehicle: Any, route: Sequence[Any] | None) -> None:
    """Give a vehicle a copy of the environment's route, if both have one; highway-env shortens it while driving."""
    if route is not None and hasattr(vehicle, "route"):
        vehicle.route = list(route)


class SelfDriving:
    """The driver of an ego of a highway-env vehicle class, which drives itself and decides at every physics tick."""

    every = 1

    def __init__(
        self, vehicle_class: Any, road: Road, start: tuple[float, float, float], speed: float, route: Any = None
    ) -> None:
        x, y, heading = start
        self.vehicle = vehicle_class(road, [x, y], heading, speed)
        self.vehicle.check_collisions = False
        give_route(self.vehicle, route)

    def decide(self, tick: int) -> None:
        """Call the vehicle's own ``act``."""
        self.vehicle.act()

    def actuate(self) -> None:
        """Do nothing, because the vehicle has acted."""


@dataclass(eq=False)
class Planner:
    """The driver of the ego for a planner in SI units, a callable from :class:`Observation` to an action.

    The action is acceleration [m/s^2] and steering [rad], or a :class:`Drive`.
    """

    ads: Callable[[Observation], Any]
    road: Road
    lanes: StraightRoad | NetworkRoad
    vehicle: Car
    physics_hz: int
    every: int
    sight: PlannerSight | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        # The exact observations of the last ticks. The oldest is as old as the latency, or from the start.
        self._past: deque[Observation] = deque(maxlen=0 if self.sight is None else self.sight.delay)
        self._drive: Drive | None = None
        self._angle = 0.0  # of the wheels, without what a bend adds
        self._tracker = LaneTracker(self.vehicle.LENGTH, 1 / self.physics_hz)
        self._tracks = False

    def decide(self, tick: int) -> tuple[float, float] | Drive:
        """Observe, call the ADS, and check and apply its action."""
        return self.apply(self.ads(self.observe(tick)))

    def apply(self, action: Any) -> tuple[float, float] | Drive:
        """Check an action, apply it, and return the checked action."""
        checked = checked_si_action(action, self.lanes.lane_count)
        self._drive = checked if isinstance(checked, Drive) else None
        if isinstance(checked, Drive):
            self._wanted = possible_acceleration(checked.acceleration or 0.0)
        else:
            self._wanted = possible_acceleration(checked[0])
            self._steer(possible_steering(checked[1]))
            self._tracks = False
        return checked

    def actuate(self) -> None:
        """Set the controls of a tick: steer towards the lane and speed of a Drive, and never drive in reverse."""
        if self._past.maxlen:
            self._past.append(self._now(0))
        car, drive = self.vehicle, self._drive
        if drive is not None:
            across, heading = self._place()
            most, jerk = drive.lateral_acceleration, drive.lateral_jerk
            if not self._tracks:
                self._tracker.begin(heading, self._angle, car.speed, most)
                self._tracks = True
            offset = across - drive.lane * self.lanes.lane_width
            self._steer(self._tracker.steering(offset, heading, car.speed, most, jerk))
            if drive.speed is not None:
                self._wanted = acceleration_to_speed(drive.speed, car.speed)
        car.acceleration = without_reversing(self._wanted, car.speed, 1 / self.physics_hz)

    def _steer(self, angle: float) -> None:
        self._angle = angle
        self.vehicle.control(self._wanted, angle + self._bend())

    def _bend(self) -> float:
        """Return the steering angle with which a vehicle follows the lane [rad]."""
        return 0.0

    def _place(self) -> tuple[float, float]:
        """Return the ego's current position across the road [m] and its heading relative to it [rad]."""
        road, car = cast("StraightRoad", self.lanes), self.vehicle
        _, across, heading = road.project(car.x, car.y, car.heading)
        return across, heading

    def observe(self, tick: int) -> Observation:
        """Return the ADS's observation: all vehicles in their current state, unless its sight is imperfect."""
        now = self._now(tick)
        return now if self.sight is None else self.sight.seen(now, self._past[0] if self._past else now)

    def _now(self, tick: int) -> Observation:
        ego, *others = (
            VehicleState(v.x, v.y, v.heading, v.speed, v.lane_index[2], v.LENGTH, v.WIDTH) for v in self.road.vehicles
        )
        road, time = self.lanes, tick / self.physics_hz
        return Observation(
            time,
            ego,
            tuple(others),
            len(road.lanes),
            road.lane_width,
            road.speed_limit,
            **self._details(tuple([lateral_velocity(v.heading, v.speed, v.steering) for v in self.road.vehicles])),
            road_length=road.lanes[0].length,
        )

    def _details(self, lateral: tuple[float, ...]) -> dict[str, Any]:
        """Return the fields of an observation that any road has."""
        return {
            "decision_period": self.every / self.physics_hz,
            "acceleration": self.vehicle.acceleration,
            "steering": self.vehicle.steering,
            "lateral_velocities": lateral,
        }
