"""The careful driver of highway-env, which follows according to IDM and changes lanes according to MOBIL.

The ADS is a vehicle class that drives itself, and the class is its own factory. It keeps its distance and looks before
it changes lanes, so other vehicles are responsible for most of its collisions. However, IDM assumes that no vehicle
cuts in closely and brakes hard.
"""

from __future__ import annotations

from typing import Any


def make() -> type[Any]:
    """Return the class ``highway_env.vehicle.behavior.IDMVehicle``. Pass it to the world unchanged."""
    from highway_env.vehicle.behavior import IDMVehicle  # noqa: PLC0415 - highway-env takes a second to import

    vehicle: type[Any] = IDMVehicle
    return vehicle
