"""highway-env's own careful driver: it follows by IDM and changes lanes by MOBIL.

Kind (c): the ADS is a vehicle class that drives itself, and the class is its own factory. It keeps its distance and
looks before it changes lanes, so that most collisions in which it ends are others' fault. IDM does assume that nobody
cuts in close ahead and brakes hard.
"""

from __future__ import annotations

from typing import Any


def make() -> type[Any]:
    """The class ``highway_env.vehicle.behavior.IDMVehicle``; give it to the world as it is."""
    from highway_env.vehicle.behavior import IDMVehicle  # noqa: PLC0415 - highway-env takes a second to import

    vehicle: type[Any] = IDMVehicle
    return vehicle
