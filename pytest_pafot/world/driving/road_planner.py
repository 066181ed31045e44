"""Reference drivers on roads of any shape: they see the road as if it were straight, and steer along its bends."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from pytest_pafot.criticality.relative import driven_between
from pytest_pafot.world.driving.ads import Planner
from pytest_pafot.world.driving.vehicles import Car
from pytest_pafot.world.kernel.observation import Observation, VehicleState
from pytest_pafot.world.roads.network import NetworkRoad, Spot


@dataclass(eq=False)
class RoadPlanner(Planner):
    """A callable from :class:`Observation` to (acceleration [m/s^2], steering [rad]), with the road straightened out.

    Positions are along the ego's way and in the measure of lanes, distances as they are driven, headings to the lane.
    The steering is that beside what following the lane takes.

    Attributes:
        starts: where along the road vehicles start [m].
    """

    lanes: NetworkRoad
    every: int = field(default=1, init=False)
    starts: Sequence[float]
    _along: list[float] = field(default_factory=list, init=False)
    _lean: float = field(default=0.0, init=False)

    def decide(self, tick: int) -> tuple[float, float]:
        """Observe, ask, check and apply, with the steering that the bend takes."""
        action = super().decide(tick)
        along_the_lane = math.atan(2 * math.tan(-self._lean))
        self.vehicle.control(self.vehicle.acceleration, self.vehicle.steering + along_the_lane)
        return action

    def observe(self, tick: int) -> Observation:
        """What the ADS sees: all vehicles as they are now, with the road straightened out."""
        network, vehicles = self.lanes, self.road.vehicles
        near = self._along or [self._start_of(vehicle) for vehicle in vehicles]
        spots = [network.spot(v.x, v.y, v.heading, place) for v, place in zip(vehicles, near, strict=True)]
        self._along = [spot.along for spot in spots]
        own = spots[0]
        self._lean = network.lane_at(own.lane, own.along)[2]
        states = [self._state(vehicle, spot, own) for vehicle, spot in zip(vehicles, spots, strict=True)]
        lanes, width, limit = len(network.columns), network.lane_width, network.speed_limit
        return Observation(tick / self.physics_hz, states[0], tuple(states[1:]), lanes, width, limit)

    def _state(self, vehicle: Car, spot: Spot, own: Spot) -> VehicleState:
        network = self.lanes
        here, there = network.stretch(own.along, own.across), network.stretch(spot.along, spot.across)
        _, direction, lean = network.lane_at(spot.lane, spot.along)
        heading = spot.angle + network.reference(spot.along)[2] - direction - lean
        x = own.along + driven_between(own.along, spot.along, here, there)
        y = network.in_lanes(spot)
        return VehicleState(x, y, heading, vehicle.speed, spot.lane, vehicle.LENGTH, vehicle.WIDTH)

    def _start_of(self, vehicle: Car) -> float:
        """Of all places along the road where vehicles start, the nearest to one [m]."""
        place = vehicle.x, vehicle.y
        return min(self.starts, key=lambda along: math.dist(place, self.lanes.reference(along)[:2]))
