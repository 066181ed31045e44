"""The careful driver of highway-env, which follows by IDM and changes lanes by MOBIL.

Kind (c): the ADS is a vehicle class that drives itself, and the class is its own factory. It keeps its distance and
looks before it changes lanes, so most of its collisions are the fault of others. IDM does assume that no vehicle
cuts in close ahead and brakes hard.
"""

from __future__ import annotations

from typing import Any


def make() -> type[Any]:
    """Return the class ``highway_env.vehicle.behavior.IDMVehicle``; pass it to the world unchanged."""
    from highway_env.vehicle.behavior import IDMVehicle  # noqa: PLC0415 - highway-env takes a second to import

    vehicle: type[Any] = IDMVehicle
    return vehicle
