"""ADSs and their factories: calls of factories, and what they are told about what a factory returns."""

from __future__ import annotations

import functools
import inspect
import re
import sys
from collections.abc import Callable, Sequence
from types import FunctionType
from typing import Any

from pytest_pafot.model.sight import Sight
from pytest_pafot.support.errors import AdsFactoryError
from pytest_pafot.support.text import shown
from pytest_pafot.world.guard.hang_guard import one_process, unending

PREDICTING = "`lambda: lambda observation: model.predict(observation, deterministic=True)[0]`"
"""An example of a factory whose ADS calls a trained model, for messages."""

AdsFactory = Callable[..., Any]
"""A callable that returns a fresh ADS; it is called once per scenario.

It may have these optional members: a method ``check_world(world)``, which raises if its ADSs cannot drive there; a
method ``preload()``, which the session calls so that forked processes share what it loads; and a text
``loading_hint``, which a search reports as a note.
"""


def is_vehicle_class(candidate: object) -> bool:
    """Return whether an object is a highway-env vehicle class, or a ``functools.partial`` of one."""
    inner = candidate.func if isinstance(candidate, functools.partial) else candidate
    kinematics = sys.modules.get("highway_env.vehicle.kinematics")  # imported wherever a vehicle class exists
    return kinematics is not None and isinstance(inner, type) and issubclass(inner, kinematics.Vehicle)


def make_ads(factory: AdsFactory, **arguments: Any) -> Any:
    """Make a fresh ADS; a vehicle class is returned as it is.

    Raises:
        AdsFactoryError: if the factory cannot be called with these arguments, or returns nothing that drives.
    """
    if is_vehicle_class(factory):
        return _checked_vehicle_class(factory)
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
    except SystemExit as error:
        raise AdsFactoryError(
            f"ads: expected the factory to return an ADS, received SystemExit: {error}. It calls sys.exit: let it "
            "raise an error instead"
        ) from error
    except TypeError as error:
        if re.search(r"__init__\(\) missing .*'position'", str(error)):
            error.add_note(
                "To let a highway-env vehicle drive, give its class itself, as in `ads=MyVehicle`, without calling it: "
                "each run makes its own vehicle."
            )
        raise
    if isinstance(getattr(ads, "sight", None), Sight):
        _check_sight_is_told(factory, ads.sight)
    if is_vehicle_class(ads):
        return _checked_vehicle_class(ads)
    if callable(ads):
        return ads
    hint = hint_at_object(ads) or (
        "An action is what the ADS returns: write `lambda: lambda observation: ...`, or `lambda: MyPlanner()`"
    )
    raise AdsFactoryError(
        "ads: expected the factory to return an ADS, a callable `observation -> action` or a highway-env vehicle "
        f"class, received {shown(ads)}. {'Is a `return` missing in it?' if ads is None else hint}"
    )


@functools.lru_cache(maxsize=1)  # a run of the kernel takes little longer than the signature of its vehicle class
def _checked_vehicle_class(vehicle_class: Any) -> Any:
    """Return a vehicle class that each run can call with a road, a position, a heading and a speed."""
    signature = inspect.signature(vehicle_class)
    try:
        signature.bind(None, [0.0, 0.0], 0.0, 0.0)
    except TypeError as error:
        name = getattr(vehicle_class, "func", vehicle_class).__name__
        raise AdsFactoryError(
            "ads: expected a highway-env vehicle class that can be called with (road, position, heading, speed), "
            f"received {name} with the signature {signature} ({error}). Give its other arguments by name, as in "
            f"`ads=functools.partial({name}, <name>=<value>)`, or write a subclass without them"
        ) from None
    return vehicle_class


def _check_sight_is_told(factory: AdsFactory, sight: Sight) -> None:
    """Refuse an imperfect sight that only the ADS has, because a reader of the factory would assume perfect sight."""
    seeing = inspect.unwrap(factory, stop=lambda each: getattr(each, "sight", None) == sight)
    if getattr(seeing, "sight", None) != sight:
        raise AdsFactoryError(
            f"ads: expected a pafot.Perception as the factory itself, received a pafot.Perception that "
            f"{shown(factory)} makes, so findings would not state the imperfect sight; write "
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


def takes_nothing(factory: AdsFactory) -> bool:
    """Return whether a factory is a plain function without parameters; this is much faster than its signature."""
    if type(factory) is not FunctionType or factory.__dict__:
        return False
    code = factory.__code__
    takes_any_number = code.co_flags & (inspect.CO_VARARGS | inspect.CO_VARKEYWORDS)
    return not (code.co_argcount or code.co_kwonlyargcount or takes_any_number)


def _check_call(factory: AdsFactory, arguments: dict[str, Any]) -> None:
    if not arguments and takes_nothing(factory):
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
