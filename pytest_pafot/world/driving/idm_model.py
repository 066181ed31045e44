"""Recognition of the vehicle classes that the kernel can drive: IDMVehicle, and subclasses that only set constants."""

from __future__ import annotations

import functools
import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from types import FunctionType
from typing import Any

CONSTANTS = (
    "LENGTH", "WIDTH", "ACC_MAX", "COMFORT_ACC_MAX", "COMFORT_ACC_MIN", "DISTANCE_WANTED", "TIME_WANTED", "DELTA",
    "POLITENESS", "LANE_CHANGE_MIN_ACC_GAIN", "LANE_CHANGE_MAX_BRAKING_IMPOSED", "LANE_CHANGE_DELAY", "KP_HEADING",
    "KP_LATERAL", "MAX_STEERING_ANGLE", "KP_A",
)  # fmt: skip
"""The constants of ``IDMVehicle`` that a subclass may set."""
POSITIVE = ("LENGTH", "WIDTH", "COMFORT_ACC_MAX", "DELTA", "LANE_CHANGE_DELAY")
"""Those that must be positive for the model; with others, highway-env's code runs and gets NaN or worse."""
PURSUIT = 0.1
"""The time constant of highway-env's steering [s], which is also the kernel's."""
OF_UTILS = ("not_zero", "wrap_to_pi")
"""The functions of ``highway_env.utils`` that the model calls."""
ORDINARY = frozenset({
    "__module__", "__qualname__", "__doc__", "__annotations__", "__annotate__", "__annotate_func__",
    "__firstlineno__", "__static_attributes__", "__abstractmethods__", "_abc_impl",
})  # fmt: skip
"""The attributes that Python itself adds to a class."""


@dataclass(frozen=True, slots=True, kw_only=True)
class IdmModel:
    """The constants of a vehicle class that drives by IDM and MOBIL, and whether it changes lanes."""

    constants: Mapping[str, float]
    changes_lanes: bool


def is_patched(cls: type) -> bool:
    """Return whether a class of highway-env has functions that were put into it later, such as by a test."""
    module, qualname = cls.__module__, cls.__qualname__
    for name, each in vars(cls).items():  # plain comparisons, because every run of a vehicle class asks
        if type(each) is FunctionType and (each.__qualname__ != f"{qualname}.{name}" or each.__module__ != module):
            return True
    return False


def takes(constants: Mapping[str, Any]) -> bool:
    """Return whether the model has an answer with these constants, of a class or of one vehicle."""
    if not all(isinstance(value, (int, float)) and math.isfinite(value) for value in constants.values()):
        return False
    return constants["COMFORT_ACC_MIN"] < 0 and all(constants[name] > 0 for name in POSITIVE)


def idm_model(ads: Any) -> IdmModel | None:
    """Return the model of a vehicle class or a ``functools.partial`` of one; None if the class has its own code."""
    whole = ads if isinstance(ads, functools.partial) else functools.partial(ads)
    cls, options = whole.func, whole.keywords
    stock = getattr(sys.modules.get("highway_env.vehicle.behavior"), "IDMVehicle", None)
    if stock is None or not isinstance(cls, type) or not issubclass(cls, stock):
        return None
    own = [base for base in cls.__mro__ if base not in stock.__mro__]  # a base may also stand behind the stock class
    only_sets_constants = all(set(vars(base)) <= ORDINARY | set(CONSTANTS) for base in own)
    if whole.args or set(options) - {"enable_lane_change"} or not only_sets_constants:
        return None
    utils, roads = sys.modules["highway_env.utils"], sys.modules["highway_env.road.road"]
    other_code = any(map(is_patched, [*stock.__mro__, roads.Road, roads.RoadNetwork])) or any(
        (each.__module__, each.__qualname__) != (utils.__name__, name)
        for name, each in ((name, getattr(utils, name)) for name in OF_UTILS)
    )
    if type(cls).__call__ is not type.__call__ or other_code or stock.TAU_PURSUIT != PURSUIT:
        return None
    named = {name: value for base in reversed(cls.__mro__) for name, value in vars(base).items()}
    constants = {name: named[name] for name in CONSTANTS}  # without getattr, because a descriptor is no constant
    if not takes(constants):
        return None
    return IdmModel(constants=constants, changes_lanes=bool(options.get("enable_lane_change", True)))
