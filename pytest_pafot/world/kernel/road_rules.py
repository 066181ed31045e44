"""highway-env's rules of a regulated road for the ego, operation by operation: whether it has to yield to an NPC."""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Sequence
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


class RoadRules:
    """The rules for an ego that drives by IDM; no other vehicle obeys them.

    The ego is predicted along its route at its speed, an NPC along its way or its lane.

    Args:
        ego: the ego.
        places: the vehicles, and their places on the ego's way.
        bends: the ego's way.
        network: the lanes of the road.
        priorities: the priority of each lane.
        route: returns the lanes of the ego's route from its lane on.
        steps: the number of steps that the road has done before.
        every: the number of steps between two decisions of the rules.
        lasts: the number of decisions for which the ego yields beyond the first.
    """

    def __init__(
        self,
        ego: NetworkVehicle,
        places: Places,
        bends: Bends,
        network: Network,
        *,
        priorities: Sequence[int],
        route: Callable[[int], list[int]],
        steps: int,
        every: int,
        lasts: float,
    ) -> None:
        self._ego = ego
        self._places = places
        self._bends = bends
        self._network = network
        self._priorities = array("i", priorities)
        self._route = route
        self._steps = steps
        self._every = every
        self._lasts = lasts
        self._waited = -1  # the number of decisions for which it has yielded; -1 if it does not
        self._predicted = array("d", [0.0]) * (3 * MOMENTS)  # x, y and heading of the ego at each moment
        self._x = self._y = self._heading = 0.0  # of an NPC at a moment

    def apply(self) -> None:
        """Count a step of the road, and decide if it is time."""
        self._steps += 1
        if self._steps % self._every != 0:
            return
        ego, network = self._ego, self._network
        lane = network.closest(ego.x, ego.y, ego.heading)
        if self._waited >= self._lasts:
            ego.want(network.speed_limit(lane))
            self._waited = -1
        elif self._waited >= 0:
            self._waited += 1
        self._predict(lane)
        for number in range(1, len(self._places.vehicles)):
            npc = self._places.vehicles[number]
            if self._conflicts(npc, self._places.bodies[number]) and self._comes_second(lane, npc):
                ego.want(0.0)
                self._waited = 0

    def _predict(self, lane: int) -> None:
        """Predict the ego at each moment."""
        ego, network, route = self._ego, self._network, self._route(lane)
        network.locate(lane, ego.x, ego.y)
        here = network.along
        for moment in range(MOMENTS):
            along, place = here + ego.speed * (APART * (moment + 1)), 0
            at: int = route[0]
            while place < len(route) - 1 and along > network.length(at):
                along -= network.length(at)
                place += 1
                at = route[place]
            network.position(at, along, 0.0)
            self._predicted[3 * moment] = network.x
            self._predicted[3 * moment + 1] = network.y
            self._predicted[3 * moment + 2] = network.heading_at(at, along)

    def _conflicts(self, npc: Body, body: Body) -> bool:
        """Return whether an NPC and the ego touch at a moment, as highway-env predicts them."""
        ego = self._ego
        for moment in range(MOMENTS):
            self._foresee(body, APART * (moment + 1))
            x, y = self._predicted[3 * moment], self._predicted[3 * moment + 1]
            heading, dx, dy = self._predicted[3 * moment + 2], self._x - x, self._y - y
            if math.sqrt(dx * dx + dy * dy) > ego.length:
                continue
            if _has_corner_inside(
                x, y, heading, ego.length, ego.width, self._x, self._y, self._heading, npc.length, npc.width
            ) or _has_corner_inside(
                self._x, self._y, self._heading, npc.length, npc.width, x, y, heading, ego.length, ego.width
            ):
                return True
        return False

    def _foresee(self, body: Body, time: float) -> None:
        """Predict an NPC after a time [s]."""
        along, bends = body.x + body.speed * time, self._bends
        if isinstance(body, CrossingNpc):
            npc: Any = body
            self._x, self._y, self._heading = npc.track.pose(along)
            return
        heading, across = bends.heading_at(along), bends.across_at(body.lane, along)
        self._x = bends.x_at(along) - math.sin(heading) * across
        self._y = bends.y_at(along) + math.cos(heading) * across
        self._heading = bends.direction_at(body.lane, along) + bends.lean_at(body.lane, along)

    def _comes_second(self, lane: int, npc: Body) -> bool:
        """Return whether the ego has to let an NPC pass: by the priorities of their lanes, or if it is behind."""
        ego, network = self._ego, self._network
        mine, theirs = self._priorities[lane], self._priorities[network.closest(npc.x, npc.y, npc.heading)]
        if mine != theirs:
            return mine < theirs
        dx, dy = npc.x - ego.x, npc.y - ego.y
        ahead = math.cos(ego.heading) * dx + math.sin(ego.heading) * dy
        return ahead > -(math.cos(npc.heading) * dx + math.sin(npc.heading) * dy)


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
