"""The healthy driver that all defective ones derive from: highway-env's IDM+MOBIL, with methods to override.

It drives exactly as ``IDMVehicle`` does. It perceives the others only through :meth:`Driver.sees` and
:meth:`Driver.neighbours`, and it has a clock. A defect overrides one of these or one formula of the model.
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

    def __init__(self, road: Road, position: Any, heading: float = 0.0, speed: float = 0.0, **options: Any) -> None:
        super().__init__(road, position, heading, speed, **options)
        self.clock = 0.0
        self.road = Perceived(road, self)

    def sees(self, other: Any) -> bool:
        """Return whether the driver takes another vehicle into account at all."""
        return True

    def neighbours(self, lane_index: Any, ahead: Any, behind: Any) -> tuple[Any, Any]:
        """Return the vehicles ahead and behind in a lane, or None instead of one that the driver ignores."""
        return ahead, behind

    def relative(self, other: Any) -> tuple[float, float]:
        """Return how far another vehicle's centre is ahead and to the right, along the driver's lane [m]."""
        along, across = self.lane.local_coordinates(self.position)
        other_along, other_across = self.lane.local_coordinates(other.position)
        return float(other_along - along), float(other_across - across)

    def step(self, dt: float) -> None:
        """Advance the time [s]."""
        self.clock += dt
        super().step(dt)


class Perceived(Road):  # type: ignore[misc]
    """A road with only the vehicles that its driver sees."""

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
        """All other vehicles, seen or not."""
        return [other for other in self._road.vehicles if other is not self._driver]

    @property
    def vehicles(self) -> list[Any]:
        """The driver itself and the vehicles that it sees, in the order of the road."""
        driver = self._driver
        return [other for other in self._road.vehicles if other is driver or driver.sees(other)]

    @vehicles.setter
    def vehicles(self, value: list[Any]) -> None:
        """Ignore the empty list that highway-env sets at first: the vehicles of the road count."""

    def neighbour_vehicles(self, vehicle: Any, lane_index: Any = None) -> tuple[Any, Any]:
        """Return the vehicles ahead and behind in a lane; for the driver, only those that it takes into account."""
        ahead, behind = super().neighbour_vehicles(vehicle, lane_index)
        driver = self._driver
        return (
            driver.neighbours(lane_index or driver.lane_index, ahead, behind) if vehicle is driver else (ahead, behind)
        )
