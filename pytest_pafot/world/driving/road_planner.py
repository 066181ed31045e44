"""Reference drivers on roads of any shape: they see the road as if it were straight, and steer along its bends."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from pytest_pafot.criticality.relative import driven_between
from pytest_pafot.support.errors import BadAction
from pytest_pafot.world.driving.ads import Planner
from pytest_pafot.world.driving.vehicles import Car
from pytest_pafot.world.kernel.action import Drive
from pytest_pafot.world.kernel.observation import Observation, VehicleState, lateral_velocity
from pytest_pafot.world.roads.network import NetworkRoad, Spot


@dataclass(eq=False)
class RoadPlanner(Planner):
    """A callable from :class:`Observation` to (acceleration [m/s^2], steering [rad]) or :class:`Drive`, as if straight.

    Positions are along the ego's way and in the measure of lanes, distances as they are driven, headings to the lane.
    The steering is that beside what following the lane takes. A lane can be driven to where it exists.

    Attributes:
        starts: where along the road vehicles start [m].
    """

    lanes: NetworkRoad
    every: int = field(default=1, init=False)
    starts: Sequence[float]
    _along: list[float] = field(default_factory=list, init=False)
    _lean: float = field(default=0.0, init=False)

    def apply(self, action: Any) -> tuple[float, float] | Drive:
        """Check an action, apply it, and return it as checked."""
        checked = super().apply(action)
        if isinstance(checked, Drive) and not self.lanes.exists(checked.lane, self._along[0]):
            raise BadAction(
                f"expected pafot.Drive with a lane that exists at {self._along[0]:.0f} m, received {checked}"
            )
        return checked

    def observe(self, tick: int) -> Observation:
        """What the ADS sees: all vehicles as they are now, with the road straightened out."""
        network, vehicles = self.lanes, self.road.vehicles
        near = self._along or [self._start_of(vehicle) for vehicle in vehicles]
        spots = [network.spot(v.x, v.y, v.heading, place) for v, place in zip(vehicles, near, strict=True)]
        self._along = [spot.along for spot in spots]
        own = spots[0]
        self._lean = network.lane_at(own.lane, own.along)[2]
        pairs = [self._state(vehicle, spot, own) for vehicle, spot in zip(vehicles, spots, strict=True)]
        states, lateral = zip(*pairs, strict=True)
        self._own = states[0]
        return Observation(
            tick / self.physics_hz,
            states[0],
            states[1:],
            len(network.columns),
            network.lane_width,
            network.speed_limit,
            **self._details(lateral),
            road_length=network.end,
        )

    def _bend(self) -> float:
        return math.atan(2 * math.tan(-self._lean))

    def _place(self) -> tuple[float, float]:
        return self._own.y, self._own.heading

    def _state(self, vehicle: Car, spot: Spot, own: Spot) -> tuple[VehicleState, float]:
        """A vehicle, and its velocity across the lane [m/s]."""
        network = self.lanes
        here, there = network.stretch(own.along, own.across), network.stretch(spot.along, spot.across)
        _, direction, lean = network.lane_at(spot.lane, spot.along)
        to_lane = spot.angle + network.reference(spot.along)[2] - direction
        x = own.along + driven_between(own.along, spot.along, here, there)
        y = network.in_lanes(spot)
        state = VehicleState(x, y, to_lane - lean, vehicle.speed, spot.lane, vehicle.LENGTH, vehicle.WIDTH)
        return state, lateral_velocity(to_lane, vehicle.speed, vehicle.steering)

    def _start_of(self, vehicle: Car) -> float:
        """Of all places along the road where vehicles start, the nearest to one [m]."""
        place = vehicle.x, vehicle.y
        return min(self.starts, key=lambda along: math.dist(place, self.lanes.reference(along)[:2]))
