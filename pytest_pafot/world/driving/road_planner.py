"""Planners in SI units on roads of any shape. They see the road straightened, and are steered along its bends."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from pytest_pafot.criticality.relative import driven_between
from pytest_pafot.model.crossings import CrossingVehicle, Zone
from pytest_pafot.support.errors import BadAction
from pytest_pafot.world.driving.ads import Planner
from pytest_pafot.world.kernel.action import Drive
from pytest_pafot.world.kernel.observation import Observation, VehicleState, lateral_velocity
from pytest_pafot.world.roads.junction import CrossingWay, Junction
from pytest_pafot.world.roads.network import NetworkRoad, Spot
from pytest_pafot.world.roads.route import wrapped


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


@dataclass(eq=False)
class RoadPlanner(Planner):
    """The driver of the ego for a planner in SI units on a bent road, which the planner sees straightened.

    In its observations, x is along the ego's way and y nominal across it (see :class:`NetworkRoad`). Distances are
    driven distances, and headings are relative to the lane. The planner's steering is added to the steering that
    follows the lane. A :class:`Drive` can only use a lane that exists at the ego's place.

    Attributes:
        starts: the places along the road at which vehicles start [m].
        junction: the ways on which other traffic meets the ego's way; None if there are none.
        ways: the way of each crossing NPC, None for each NPC on the grid; empty if no NPC crosses.
    """

    lanes: NetworkRoad
    starts: Sequence[float]
    junction: Junction | None = None
    ways: Sequence[CrossingWay | None] = ()
    _along: list[float] = field(default_factory=list, init=False)
    _lean: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        # With a latency, old world poses are put on today's straightened road. The base class stores observations,
        # which have no places in the world.
        self._poses: deque[list[Pose]] = deque(maxlen=self._past.maxlen)
        self._past = deque(maxlen=0)

    def apply(self, action: Any) -> tuple[float, float] | Drive:
        """Check an action, apply it, and return the checked action."""
        checked = super().apply(action)
        if isinstance(checked, Drive) and not self.lanes.exists(checked.lane, self._along[0]):
            raise BadAction(
                f"expected pafot.Drive with a lane that exists at {self._along[0]:.0f} m, received {checked}"
            )
        return checked

    def actuate(self) -> None:
        """Set the controls of a tick as decided; with a latency, store all poses for later observations."""
        if self._poses.maxlen:
            self._poses.append(self._everybody())
        super().actuate()

    def observe(self, tick: int) -> Observation:
        """Return an observation of the straightened road; with imperfect sight, vehicles may be late or missing."""
        network, everybody = self.lanes, self._everybody()
        self._along = [self._place_of(number, pose) for number, pose in enumerate(everybody)]
        ego, own = everybody[0], network.spot(*everybody[0][:3], self._along[0])
        self._lean = network.lane_at(own.lane, own.along)[2]
        self._own, drift = self._state(ego, own, own)
        others, ids, lateral, crossing = [], [], [drift], []
        for npc, pose in self._seen(everybody, tick):
            spot, along = self._spot(npc, pose)
            if spot is not None:
                state, drift = self._state(pose, spot, own)
                others.append(state)
                ids.append(npc)
                lateral.append(drift)
            elif (way := self.ways[npc]) is not None:
                crossing.append(seen_on(way.way.zone, npc, pose, along, ego, own.along))
        return Observation(
            tick / self.physics_hz,
            self._own,
            tuple(others),
            len(network.columns),
            network.lane_width,
            network.speed_limit,
            **self._details(tuple(lateral)),
            ids=tuple(ids),
            road_length=network.end,
            crossing=tuple(crossing),
        )

    def _everybody(self) -> list[Pose]:
        """Return the current poses of all vehicles, the ego first."""
        return [Pose(v.x, v.y, v.heading, v.speed, 0, v.LENGTH, v.WIDTH, v.steering) for v in self.road.vehicles]

    def _seen(self, now: list[Pose], tick: int) -> list[tuple[int, Pose]]:
        """Return the number and the seen pose of each NPC that the ADS sees."""
        if self.sight is None:
            return list(enumerate(now[1:]))
        then = self._poses[0] if self._poses else now
        states = np.array([pose[:7] for pose in then])
        seen = []
        for npc, x, y, speed in self.sight.sight.glimpses(states, self.sight.seed, tick):
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

    def _bend(self) -> float:
        return math.atan(2 * math.tan(-self._lean))

    def _place(self) -> tuple[float, float]:
        return self._own.y, self._own.heading

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
