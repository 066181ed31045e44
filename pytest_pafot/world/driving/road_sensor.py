"""The observations of planners in SI units on roads of any shape, which they see straightened."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, cast

import numpy as np

from pytest_pafot.criticality.relative import driven_between
from pytest_pafot.model.crossings import CrossingVehicle, Zone
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.sight import Sight
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.observation import COLUMNS, Observation, Sensor, VehicleState, lateral_velocity
from pytest_pafot.world.roads.network import NetworkRoad, Spot
from pytest_pafot.world.roads.route import wrapped
from pytest_pafot.world.run_config import Rules


class Pose(NamedTuple):
    """A vehicle's true or seen state in world coordinates, in the order of VehicleState; the lane is not used."""

    x: float
    y: float
    heading: float
    speed: float
    lane: int
    length: float
    width: float
    steering: float


class RoadSensor(Sensor):
    """The maker of observations on a bent road, from the record of a run.

    In its observations, x is along the ego's way and y nominal across it (see :class:`NetworkRoad`). Distances are
    driven distances, and headings are relative to the lane. The planner's steering is added to the steering that
    follows the lane. A :class:`Drive` can only use a lane that exists at the ego's place.
    """

    def __init__(
        self, rules: Rules, scenario: Scenario, vehicles: Sequence[Body], rows: Sequence[float], sight: Sight | None
    ) -> None:
        super().__init__()
        self.is_bent = True
        self.lanes = cast("NetworkRoad", rules.road)
        self.junction, self.ways = rules.junction, rules.ways(scenario)
        far = rules.start_distance(scenario)
        self.starts = [rules.ego_start + row * far for row in (-1, 0, 1)]
        self.physics_hz, self._period = rules.physics_hz, 1 / rules.ads_hz
        self.sight, self._seed = sight, scenario.seed
        self._sizes = [(each.length, each.width) for each in vehicles]
        self._rows = rows
        self._along: list[float] = []

    def has_lane(self, lane: int) -> bool:
        """Return whether a lane exists at the ego's place."""
        return self.lanes.exists(lane, self._along[0])

    def observation(self, tick: int) -> Observation:
        """Return an observation of the straightened road; with imperfect sight, vehicles may be late or missing."""
        network, everybody = self.lanes, self._everybody(tick)
        self._along = [self._place_of(number, pose) for number, pose in enumerate(everybody)]
        ego, own = everybody[0], network.spot(*everybody[0][:3], self._along[0])
        self.bend = math.atan(2 * math.tan(-network.lane_at(own.lane, own.along)[2]))
        state, drift = self._state(ego, own, own)
        self.along, self.across, self.heading = self._along[0], state.y, state.heading
        others, ids, lateral, crossing = [], [], [drift], []
        for npc, pose in self._seen(everybody, tick):
            spot, along = self._spot(npc, pose)
            if spot is not None:
                its, drift = self._state(pose, spot, own)
                others.append(its)
                ids.append(npc)
                lateral.append(drift)
            elif (way := self.ways[npc]) is not None:
                crossing.append(seen_on(way.way.zone, npc, pose, along, ego, own.along))
        at = tick * len(self._sizes) * COLUMNS
        return Observation(
            tick / self.physics_hz,
            state,
            tuple(others),
            len(network.columns),
            network.lane_width,
            network.speed_limit,
            decision_period=self._period,
            acceleration=self._rows[at + 4],
            steering=self._rows[at + 5],
            lateral_velocities=tuple(lateral),
            ids=tuple(ids),
            road_length=network.end,
            crossing=tuple(crossing),
        )

    def _everybody(self, tick: int) -> list[Pose]:
        """Return the poses of all vehicles at a tick, the ego first."""
        count, poses = len(self._sizes), []
        for number, size in enumerate(self._sizes):
            at = (tick * count + number) * COLUMNS
            x, y, heading, speed, _, steering = self._rows[at : at + 6]
            poses.append(Pose(x, y, heading, speed, 0, *size, steering))
        return poses

    def _seen(self, now: list[Pose], tick: int) -> list[tuple[int, Pose]]:
        """Return the number and the seen pose of each NPC that the ADS sees."""
        if self.sight is None:
            return list(enumerate(now[1:]))
        then = self._everybody(max(0, tick - self.sight.delay(self.physics_hz)))
        states = np.array([pose[:7] for pose in then])
        seen = []
        for npc, x, y, speed in self.sight.glimpses(states, self._seed, tick):
            was = then[npc + 1]
            seen.append((npc, was._replace(x=was.x + x, y=was.y + y, speed=was.speed + speed)))
        return seen

    def _place_of(self, vehicle: int, pose: Pose) -> float:
        """Return a vehicle's place along its way, near its last place; NPCs on the grid use the ego's way [m]."""
        way = self.ways[vehicle - 1] if vehicle and self.ways else None
        if way is None:
            return self.lanes.spot(*pose[:3], self._along[vehicle] if self._along else self._start_of(pose)).along
        near = self._along[vehicle] if self._along else way.nearest(pose.x, pose.y)
        return way.place(pose.x, pose.y, near)[0]

    def _spot(self, npc: int, pose: Pose) -> tuple[Spot | None, float]:
        """Return a seen NPC's spot on the ego's way, None if it is elsewhere, and its place along its own way [m]."""
        way, near = self.ways[npc] if self.ways else None, self._along[npc + 1]
        if way is None or self.junction is None:
            return self.lanes.spot(*pose[:3], near), near
        along = way.place(pose.x, pose.y, near)[0]
        return self.junction.spot(self.lanes, way, along, pose[:3]), along

    def _state(self, vehicle: Pose, spot: Spot, own: Spot) -> tuple[VehicleState, float]:
        """Return a vehicle's state on the straightened road, and its velocity across the lane [m/s]."""
        network = self.lanes
        here, there = network.stretch(own.along, own.across), network.stretch(spot.along, spot.across)
        _, direction, lean = network.lane_at(spot.lane, spot.along)
        to_lane = spot.angle + network.reference(spot.along)[2] - direction
        x = own.along + driven_between(own.along, spot.along, here, there)
        y = network.in_lanes(spot)
        state = VehicleState(x, y, to_lane - lean, vehicle.speed, spot.lane, vehicle.length, vehicle.width)
        return state, lateral_velocity(to_lane, vehicle.speed, vehicle.steering)

    def _start_of(self, vehicle: Pose) -> float:
        """Return the start along the road that is nearest to a vehicle [m]."""
        place = vehicle.x, vehicle.y
        return min(self.starts, key=lambda along: math.dist(place, self.lanes.reference(along)[:2]))


def seen_on(zone: Zone, npc: int, pose: Pose, along: float, ego: Pose, ego_along: float) -> CrossingVehicle:
    """Return an NPC on its own way as the ego sees it, with the distances of both to their zone [m]."""
    x, y, cos, sin = pose.x - ego.x, pose.y - ego.y, math.cos(ego.heading), math.sin(ego.heading)
    return CrossingVehicle(
        id=npc,
        zone=zone,
        distance=zone.npc[0] - along,
        ego_distance=zone.ego[0] - ego_along,
        ahead=x * cos + y * sin,
        right=y * cos - x * sin,
        heading=wrapped(pose.heading - ego.heading),
        speed=pose.speed,
        length=pose.length,
        width=pose.width,
    )
