"""Worlds: the roads on which scenarios run against an ADS. Most code that uses highway-env is in this package."""

from pytest_pafot.model.crossings import CrossingVehicle
from pytest_pafot.support.errors import AdsFactoryError, WorldError
from pytest_pafot.world.codec import from_dict
from pytest_pafot.world.driving.perception import Perception
from pytest_pafot.world.gym_world import World
from pytest_pafot.world.highway import Highway
from pytest_pafot.world.kernel.action import Drive
from pytest_pafot.world.kernel.observation import Observation, VehicleState
from pytest_pafot.world.limits import NpcLimits
from pytest_pafot.world.protocol import WorldLike

__all__ = [
    "AdsFactoryError",
    "CrossingVehicle",
    "Drive",
    "Highway",
    "NpcLimits",
    "Observation",
    "Perception",
    "VehicleState",
    "World",
    "WorldError",
    "WorldLike",
    "from_dict",
]
