"""The healthy driver from which all defective drivers derive: highway-env's IDM+MOBIL, with methods to override.

It drives exactly as ``IDMVehicle`` does, but has a clock, and perceives other vehicles only through
:meth:`Driver.sees` and :meth:`Driver.neighbours`. A defect overrides one of these methods or one formula of the model.
"""

from __future__ import annotations

from typing import Any

from highway_env.road.road import Road
from highway_env.vehicle.behavior import IDMVehicle


class Driver(IDMVehicle):  # type: ignore[misc]
    """IDM+MOBIL without a defect.

    Attributes:
        clock: time since the start [s].
    """

    def __init__(
        self, road: Road, position: Any, heading: float = 0.0, speed: float = 0.0, **options: Any
    ) -> None:
        super().__init__(road, position, heading, speed, **options)
        self.clock = 0.0
        self.road = Perceived(road, self)

    def sees(self, other: Any) -> bool:
        """Return whether the driver takes another vehicle into account."""
        return True

    def neighbours(self, lane_index: Any, ahead: Any, behind: Any) -> tuple[Any, Any]:
        """Return the vehicles ahead and behind in a lane. A vehicle that the driver ignores becomes None."""
        return ahead, behind

    def relative(self, other: Any) -> tuple[float, float]:
        """Return how far [m] another vehicle's centre is ahead and to the right, relative to the driver's lane."""
        along, across = self.lane.local_coordinates(self.position)
        other_along, other_across = self.lane.local_coordinates(other.position)
        return float(other_along - along), float(other_across - across)

    def step(self, dt: float) -> None:
        """Advance the vehicle and its clock by a time [s]."""
        self.clock += dt
        super().step(dt)


class Perceived(Road):  # type: ignore[misc]
    """A road with only the vehicles that a driver sees."""

    def __init__(self, road: Road, driver: Driver) -> None:
        self._road, self._driver = road, driver
        super().__init__(
            road.network,
            np_random=road.np_random,
            record_history=road.record_history,
            neighbour_vehicles_connected_lanes=road.neighbour_vehicles_connected_lanes,
        )

    @property
    def everybody(self) -> list[Any]:
        """All other vehicles, whether or not the driver sees them."""
        return [other for other in self._road.vehicles if other is not self._driver]

    @property
    def vehicles(self) -> list[Any]:
        """The driver and the vehicles that it sees, in the same order as on the road."""
        driver = self._driver
        return [other for other in self._road.vehicles if other is driver or driver.sees(other)]

    @vehicles.setter
    def vehicles(self, value: list[Any]) -> None:
        """Ignore the empty list that highway-env assigns, because the vehicles come from the original road."""

    def neighbour_vehicles(self, vehicle: Any, lane_index: Any = None) -> tuple[Any, Any]:
        """Return the vehicles ahead and behind in a lane. For the driver, ignored vehicles become None."""
        ahead, behind = super().neighbour_vehicles(vehicle, lane_index)
        driver = self._driver
        return (
            driver.neighbours(lane_index or driver.lane_index, ahead, behind)
            if vehicle is driver
            else (ahead, behind)
        )
