"""Planners in SI units on roads of any shape: they see the road as if it were straight, and steer along its bends."""

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
from pytest_pafot.world.roads.network import NetworkRoad, Spot
from pytest_pafot.world.roads.route import STEP, Line, wrapped


class Pose(NamedTuple):
    """A vehicle in the world, as it is or as it is seen; the lane is nobody's, columns are those of VehicleState."""

    x: float
    y: float
    heading: float
    speed: float
    lane: int
    length: float
    width: float
    steering: float


ALONG_THE_WAY = 0.5
"""Angle to the ego's way up to which a vehicle drives along it [rad]."""


@dataclass(eq=False)
class RoadPlanner(Planner):
    """A callable from :class:`Observation` to (acceleration [m/s^2], steering [rad]) or :class:`Drive`, as if straight.

    Positions are along the ego's way and in the measure of lanes, distances as they are driven, headings to the lane.
    The steering is that beside what following the lane takes. A lane can be driven to where it exists.

    Attributes:
        starts: where along the road vehicles start [m].
        ways: of each NPC that crosses, its zone and the line of its way; None of one that drives along the ego's.
    """

    lanes: NetworkRoad
    starts: Sequence[float]
    ways: Sequence[tuple[Zone, Line] | None] = ()
    _along: list[float] = field(default_factory=list, init=False)
    _lean: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        # Who is seen late is put on the road as it is now; the straight road's past has no places in the world.
        self._poses: deque[list[Pose]] = deque(maxlen=self._past.maxlen)
        self._past = deque(maxlen=0)

    def apply(self, action: Any) -> tuple[float, float] | Drive:
        """Check an action, apply it, and return it as checked."""
        checked = super().apply(action)
        if isinstance(checked, Drive) and not self.lanes.exists(checked.lane, self._along[0]):
            raise BadAction(
                f"expected pafot.Drive with a lane that exists at {self._along[0]:.0f} m, received {checked}"
            )
        return checked

    def actuate(self) -> None:
        """Steer and accelerate as decided; with a latency, remember where everybody is."""
        if self._poses.maxlen:
            self._poses.append(self._everybody())
        super().actuate()

    def observe(self, tick: int) -> Observation:
        """What the ADS sees with the road straightened out: all as it is now, unless its sight is imperfect."""
        network, everybody = self.lanes, self._everybody()
        near = self._along or [self._start_of(pose) for pose in everybody]
        self._along = [network.spot(*pose[:3], place).along for pose, place in zip(everybody, near, strict=True)]
        ego, own = everybody[0], network.spot(*everybody[0][:3], self._along[0])
        self._lean = network.lane_at(own.lane, own.along)[2]
        self._own, drift = self._state(ego, own, own)
        others, ids, lateral, crossing = [], [], [drift], []
        for npc, pose in self._seen(everybody, tick):
            spot = network.spot(*pose[:3], self._along[npc + 1])
            way = self.ways[npc] if self.ways else None
            if way is not None and not self._is_on_way(spot):
                crossing.append(self._crossing(npc, pose, ego, own, *way))
                continue
            state, drift = self._state(pose, spot, own)
            others.append(state)
            ids.append(npc)
            lateral.append(drift)
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
        """All vehicles as they are, the ego first."""
        return [Pose(v.x, v.y, v.heading, v.speed, 0, v.LENGTH, v.WIDTH, v.steering) for v in self.road.vehicles]

    def _seen(self, now: list[Pose], tick: int) -> list[tuple[int, Pose]]:
        """The NPCs that are seen, each as it is seen."""
        if self.sight is None:
            return list(enumerate(now[1:]))
        then = self._poses[0] if self._poses else now
        states = np.array([pose[:7] for pose in then])
        seen = []
        for npc, x, y, speed in self.sight.sight.glimpses(states, self.sight.seed, tick):
            was = then[npc + 1]
            seen.append((npc, was._replace(x=was.x + x, y=was.y + y, speed=was.speed + speed)))
        return seen

    def _is_on_way(self, spot: Spot) -> bool:
        """Return whether a vehicle whose way meets the ego's drives in its lane, as after a merge."""
        return abs(spot.offset) < self.lanes.lane_width / 2 and abs(spot.angle) < ALONG_THE_WAY

    def _crossing(self, npc: int, pose: Pose, ego: Pose, own: Spot, zone: Zone, line: Line) -> CrossingVehicle:
        x, y, cos, sin = pose.x - ego.x, pose.y - ego.y, math.cos(ego.heading), math.sin(ego.heading)
        return CrossingVehicle(
            id=npc,
            zone=zone,
            distance=zone.npc[0] - along_line(line, pose.x, pose.y),
            ego_distance=zone.ego[0] - own.along,
            ahead=x * cos + y * sin,
            right=y * cos - x * sin,
            heading=wrapped(pose.heading - ego.heading),
            speed=pose.speed,
            length=pose.length,
            width=pose.width,
        )

    def _bend(self) -> float:
        return math.atan(2 * math.tan(-self._lean))

    def _place(self) -> tuple[float, float]:
        return self._own.y, self._own.heading

    def _state(self, vehicle: Pose, spot: Spot, own: Spot) -> tuple[VehicleState, float]:
        """A vehicle, and its velocity across the lane [m/s]."""
        network = self.lanes
        here, there = network.stretch(own.along, own.across), network.stretch(spot.along, spot.across)
        _, direction, lean = network.lane_at(spot.lane, spot.along)
        to_lane = spot.angle + network.reference(spot.along)[2] - direction
        x = own.along + driven_between(own.along, spot.along, here, there)
        y = network.in_lanes(spot)
        state = VehicleState(x, y, to_lane - lean, vehicle.speed, spot.lane, vehicle.length, vehicle.width)
        return state, lateral_velocity(to_lane, vehicle.speed, vehicle.steering)

    def _start_of(self, vehicle: Pose) -> float:
        """Of all places along the road where vehicles start, the nearest to one [m]."""
        place = vehicle.x, vehicle.y
        return min(self.starts, key=lambda along: math.dist(place, self.lanes.reference(along)[:2]))


def along_line(line: Line, x: float, y: float) -> float:
    """Return where along a line the point of it is that is nearest to a place in the world [m]."""
    nearest = int(np.hypot(line.x - x, line.y - y).argmin())
    heading = float(line.heading[nearest])
    ahead = (x - float(line.x[nearest])) * math.cos(heading) + (y - float(line.y[nearest])) * math.sin(heading)
    return nearest * STEP + ahead
