"""highway-env's rules of a regulated road, operation by operation: when an ego has to yield to others."""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from typing import Any

from pytest_pafot.world.kernel.bends import Bends
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.crossing import CrossingNpc
from pytest_pafot.world.kernel.lane_network import Network
from pytest_pafot.world.kernel.network_vehicle import NetworkVehicle
from pytest_pafot.world.kernel.places import Places

MOMENTS, APART = 11, 0.25
"""The number of moments at which highway-env predicts vehicles, and the time between them [s]."""
LONGER, NARROWER = 1.5, 0.9
"""The factors of a vehicle's length and width in these predictions."""


class EgosRoadRules:
    """The rules for an ego that drives by IDM; no other vehicle obeys them.

    The ego is predicted along its route, and an NPC along its way or its lane, at their speeds.

    Args:
        ego: the ego.
        places: the vehicles, and their places on the ego's way.
        bends: the ego's way.
        network: the lanes of the road.
        priorities: the priority of each lane.
        steps: the number of steps that the road has done before.
        every: the number of steps between two decisions of the rules.
        lasts: the number of decisions for which a vehicle yields beyond the first.
    """

    def __init__(
        self,
        ego: NetworkVehicle,
        places: Places,
        bends: Bends,
        network: Network,
        priorities: Sequence[int],
        steps: int,
        every: int,
        lasts: float,
    ) -> None:
        self._ego = ego
        self._places = places
        self._bends = bends
        self._network = network
        self._priorities = array("i", priorities)
        self._steps = steps
        self._every = every
        self._lasts = lasts
        self._predicted = array("d", [0.0]) * (6 * MOMENTS)  # x, y and heading at each moment, of the ego and an NPC

    def apply_to_ego(self) -> None:
        """Count a step of the road, and make the ego yield if it is time and it has to."""
        self._steps += 1
        if self._steps % self._every:
            return
        ego = self._ego
        self._release(ego)
        self._predict(ego)
        for number in range(1, len(self._places.vehicles)):
            npc = self._places.vehicles[number]
            for moment in range(MOMENTS):
                self._foresee_npc(3 * (MOMENTS + moment), self._places.bodies[number], APART * (moment + 1))
            if self._conflict(ego, npc) and self._comes_second(ego, npc):
                ego.want(0.0)
                ego.waited = 0

    def _release(self, vehicle: NetworkVehicle) -> None:
        """Let a vehicle drive on that has yielded for long enough."""
        if vehicle.waited >= self._lasts:
            vehicle.want(self._network.speed_limit(vehicle._closest))
            vehicle.waited = -1
        elif vehicle.waited >= 0:
            vehicle.waited += 1

    def _predict(self, vehicle: NetworkVehicle) -> None:
        """Predict the ego at each moment."""
        network, route = self._network, vehicle.route()
        network.locate(vehicle._closest, vehicle.x, vehicle.y)
        here = network.along
        for moment in range(MOMENTS):
            along, place = here + vehicle.speed * (APART * (moment + 1)), 0
            at: int = route[0]
            while place < len(route) - 1 and along > network.length(at):
                along -= network.length(at)
                place += 1
                at = route[place]
            network.position(at, along, 0.0)
            self._foresee(3 * moment, network.x, network.y, network.heading_at(at, along))

    def _foresee(self, row: int, x: float, y: float, heading: float) -> None:
        self._predicted[row] = x
        self._predicted[row + 1] = y
        self._predicted[row + 2] = heading

    def _conflict(self, one: Body, other: Body) -> bool:
        """Return whether two vehicles touch at a moment, as highway-env predicts them."""
        row, its_row = 0, 3 * MOMENTS
        for _ in range(MOMENTS):
            x, y, heading = self._predicted[row], self._predicted[row + 1], self._predicted[row + 2]
            its_x, its_y = self._predicted[its_row], self._predicted[its_row + 1]
            its_heading, dx, dy = self._predicted[its_row + 2], its_x - x, its_y - y
            row += 3
            its_row += 3
            if math.sqrt(dx * dx + dy * dy) > one.length:
                continue
            if _has_corner_inside(
                x, y, heading, one.length, one.width, its_x, its_y, its_heading, other.length, other.width
            ) or _has_corner_inside(
                its_x, its_y, its_heading, other.length, other.width, x, y, heading, one.length, one.width
            ):
                return True
        return False

    def _comes_second(self, one: NetworkVehicle, other: Body) -> bool:
        """Return whether a vehicle has to let another one pass: by the priorities of lanes, or if it is behind."""
        mine, theirs = self._priorities[one._closest], self._priorities[one._lane_of(other)]
        if mine != theirs:
            return mine < theirs
        dx, dy = other.x - one.x, other.y - one.y
        ahead = math.cos(one.heading) * dx + math.sin(one.heading) * dy
        return ahead > -(math.cos(other.heading) * dx + math.sin(other.heading) * dy)

    def _foresee_npc(self, row: int, body: Body, time: float) -> None:
        """Predict an NPC after a time [s]."""
        along, bends = body.x + body.speed * time, self._bends
        if isinstance(body, CrossingNpc):
            npc: Any = body
            x, y, heading = npc.track.pose(along)
            self._foresee(row, x, y, heading)
            return
        heading, across = bends.heading_at(along), bends.across_at(body.lane, along)
        x = bends.x_at(along) - math.sin(heading) * across
        y = bends.y_at(along) + math.cos(heading) * across
        self._foresee(row, x, y, bends.direction_at(body.lane, along) + bends.lean_at(body.lane, along))


def _has_corner_inside(
    x: float,
    y: float,
    heading: float,
    length: float,
    width: float,
    other_x: float,
    other_y: float,
    other_heading: float,
    other_length: float,
    other_width: float,
) -> bool:
    """Return whether a corner, a middle of a side or the centre of a box is inside another one, as in highway-env.

    highway-env turns the points by the other box's heading in the wrong direction, which is repeated here.
    """
    cos, sin = math.cos(heading), math.sin(heading)
    other_cos, other_sin = math.cos(other_heading), math.sin(other_heading)
    for along in range(-1, 2):
        for across in range(-1, 2):
            ahead, aside = along * (LONGER * length / 2.0), across * (NARROWER * width / 2.0)
            dx, dy = cos * ahead - sin * aside + x - other_x, sin * ahead + cos * aside + y - other_y
            turned_x, turned_y = other_cos * dx - other_sin * dy, other_sin * dx + other_cos * dy
            if abs(turned_x) <= LONGER * other_length / 2.0 and abs(turned_y) <= NARROWER * other_width / 2.0:
                return True
    return False
