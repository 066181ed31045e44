"""The parts of highway-env that the package uses, imported without matplotlib and pandas.

These two libraries take three times as long to import as the rest of highway-env, and most runs do not use them.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

from pytest_pafot.support import import_late


class _Later(ModuleType):
    def __init__(self, name: str, **parts: ModuleType) -> None:
        super().__init__(name)
        vars(self).update(parts)

    def __getattr__(self, name: str) -> Any:
        if sys.modules.get(self.__name__) is self:
            del sys.modules[self.__name__]
        return getattr(import_late(self.__name__), name)


@contextmanager
def _later() -> Iterator[None]:
    """Replace matplotlib and pandas, in a ``with`` block, with placeholders that import them at first use."""
    pyplot = _Later("matplotlib.pyplot")
    libraries = _Later("matplotlib", pyplot=pyplot), pyplot, _Later("pandas")
    absent = {each.__name__: each for each in libraries if each.__name__ not in sys.modules}
    sys.modules.update(absent)
    try:
        yield
    finally:
        for name, library in absent.items():
            if sys.modules.get(name) is library:
                del sys.modules[name]


with _later():
    import highway_env  # noqa: F401  (registers its environments)
    from highway_env.envs.common import action, observation
    from highway_env.envs.common.abstract import AbstractEnv
    from highway_env.envs.exit_env import ExitEnv
    from highway_env.envs.intersection_env import IntersectionEnv
    from highway_env.road.lane import AbstractLane, CircularLane, SineLane, StraightLane
    from highway_env.road.regulation import RegulatedRoad
    from highway_env.road.road import Road, RoadNetwork
    from highway_env.utils import class_from_path, not_zero, wrap_to_pi
    from highway_env.vehicle.behavior import IDMVehicle
    from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle
    from highway_env.vehicle.kinematics import Vehicle
    from highway_env.vehicle.objects import Landmark, RoadObject

__all__ = [
    "AbstractEnv", "AbstractLane", "CircularLane", "ControlledVehicle", "ExitEnv", "IDMVehicle", "IntersectionEnv",
    "Landmark", "MDPVehicle", "RegulatedRoad", "Road", "RoadNetwork", "RoadObject", "SineLane", "StraightLane",
    "Vehicle", "action", "class_from_path", "not_zero", "observation", "wrap_to_pi",
]  # fmt: skip
