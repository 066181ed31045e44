"""highway-env's vehicles with a goal on any road, operation by operation."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from pytest_pafot.world.kernel.action import lane_steering
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.driver import clamped
from pytest_pafot.world.kernel.idm import GoalVehicle
from pytest_pafot.world.kernel.lane_network import Network
from pytest_pafot.world.kernel.lanes import Lanes

ON_LANE = 1.0
"""The distance beyond a lane's lines up to which a vehicle is still in the lane [m]."""
NOWHERE = float("nan")
PURSUIT = 0.1
"""The time for which a vehicle looks ahead along its lane to steer [s]."""


class StaticObstacle(Body):
    """An object that stands on the road. Other vehicles drive behind it, but it is nobody's follower."""


class NetworkVehicle(GoalVehicle):
    """A vehicle with a goal on any road.

    Args:
        constants: the constants of the vehicle class, by name.
        network: the lanes of the road.
        following: returns the lane that follows a lane for a vehicle at x and y [m], and the lane that the rest of its
            route demands, counted from the left, or -1.
        routed: the lane that its route demands at the start, or -1.
        route: returns the lanes of the rest of its route, for the lane in which it is.
        searched: for each lane, the lanes in which it looks for vehicles, and where each begins along the lane [m].
    """

    def __init__(
        self,
        constants: Mapping[str, float],
        network: Network,
        following: Callable[[int, float, float], tuple[int, int]],
        routed: int,
        route: Callable[[int], list[int]],
        searched: Sequence[Sequence[tuple[int, float]]],
    ) -> None:
        super().__init__(constants, Lanes(1, 1.0, 1.0), 0.0)
        self._network = network
        self._following = following
        self._routed = routed
        self._route = route
        self._searched = list(searched)

    def route(self) -> list[int]:
        """Return the lanes of the rest of its route."""
        return self._route(self._closest)

    def _found(self, vehicle: Body) -> int:
        return self._network.closest(vehicle.x, vehicle.y, vehicle.heading)

    def _follow_road(self) -> None:
        if self._network.is_after_end(self._goal, self.x, self.y):
            self._goal, self._routed = self._following(self._goal, self.x, self.y)

    def _has_beside(self, lane: int, side: int) -> bool:
        return self._network.is_beside(lane, side)

    def _reaches(self, lane: int) -> bool:
        return self._network.is_reachable(lane, self.x, self.y) and abs(self.speed) >= 1.0

    def _is_demanded(self, lane: int) -> bool:
        number = self._network.number(self._goal)
        return self._routed < number if lane < self._goal else self._routed > number

    def _pulled(self, vehicle: Body | None, front: Body | None) -> float:
        return 0.0 if isinstance(vehicle, StaticObstacle) else GoalVehicle._pulled(self, vehicle, front)

    def _apart(self, vehicle: Body, front: Body) -> float:
        network, lane = self._network, self._lane_of(vehicle)
        network.locate(lane, front.x, front.y)
        there = network.along
        network.locate(lane, vehicle.x, vehicle.y)
        return there - network.along

    def _limit(self, vehicle: Body) -> float:
        return self._network.speed_limit(self._lane_of(vehicle))

    def _lane_of(self, vehicle: Body) -> int:
        return self._closest if vehicle is self else self._found(vehicle)

    def _steering(self) -> float:
        network, goal = self._network, self._goal
        network.locate(goal, self.x, self.y)
        offset, ahead = network.across, network.heading_at(goal, network.along + self.speed * PURSUIT)
        angle = lane_steering(offset, ahead, self.heading, self.speed, self.length, self._kp_heading, self._kp_lateral)
        return clamped(angle, self._max_steering)

    def _ahead(self, others: list[Any], lane: int) -> Body | None:
        found, nearest = None, math.inf
        self._network.locate(lane, self.x, self.y)
        own = self._network.along
        for other in others:
            along = self._along(lane, other)
            if own <= along <= nearest and other is not self:  # also false for NaN
                nearest, found = along, other
        return found

    def _behind(self, others: list[Any], lane: int) -> Body | None:
        found, nearest = None, -math.inf
        self._network.locate(lane, self.x, self.y)
        own = self._network.along
        for other in others:
            along = self._along(lane, other)
            if nearest < along < own and other is not self:  # also false for NaN
                nearest, found = along, other
        return found

    def _along(self, lane: int, other: Body) -> float:
        """Return the place of another vehicle along a lane [m]; NaN if it is on none of the lanes that are searched."""
        network = self._network
        for each, begins in self._searched[lane]:
            if network.is_on(each, other.x, other.y, ON_LANE):
                return network.along + begins
        return NOWHERE
