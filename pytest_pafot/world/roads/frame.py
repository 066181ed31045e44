"""Where the vehicles of one run are on the road, tick by tick, and whether the run leaves it."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from typing import Any

import numpy as np

from pytest_pafot.trace import FloatArray, Outcome
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.roads.network import NetworkRoad, Spot
from pytest_pafot.world.roads.straight import StraightRoad

State = tuple[float, float, float, float]
"""x [m], y [m], heading [rad], speed [m/s]."""


class StraightFrame:
    """Shows vehicles on a straight road to the director."""

    def __init__(self, road: StraightRoad) -> None:
        self._road = road

    def see(self, states: Sequence[State], bodies: Sequence[Body]) -> tuple[list[int], Outcome | None]:
        """Put bodies where the vehicles are on the road; the lane of each, and how the run leaves the road: not at all.

        A run on a straight road goes on where the ego is beside it.
        """
        road, lanes = self._road, []
        for body, (x, y, heading, speed) in zip(bodies, states, strict=True):
            body.place(*road.project(x, y, heading), speed)
            lanes.append(road.grid.locate(body))
        return lanes, None


class NetworkFrame:
    """Follows the vehicles along the road: a road may cross itself, and a circuit comes back to where it began."""

    def __init__(self, road: NetworkRoad, network: Any, starts: Sequence[float]) -> None:
        """``starts`` is where along the road each vehicle starts [m], the ego first."""
        self._road = road
        self._network = network  # highway-env's, to see on which lane an ego is that has left the road
        self._along = list(starts)
        self._rows = array("d")

    def see(self, states: Sequence[State], bodies: Sequence[Body]) -> tuple[list[int], Outcome | None]:
        """Put bodies where the vehicles are on the road; the lane of each, and how the run leaves the road, if it does.

        Across the road bodies are in the measure of lanes, their heading is to the ego's way; see :class:`Trace`.
        """
        road = self._road
        spots = [road.spot(x, y, heading, near) for (x, y, heading, _), near in zip(states, self._along, strict=True)]
        self._along = [spot.along for spot in spots]
        for body, spot, state in zip(bodies, spots, states, strict=True):
            body.place(spot.along, road.in_lanes(spot), spot.angle, state[3])
            body.lane = road.nearest_lane(body.y)
            self._rows.extend((*spot[:3], spot.offset, road.stretch(spot.along, spot.across)))
        lanes = [road.part(spot) for spot in spots]
        if any(spot.along + body.length / 2 >= road.end for spot, body in zip(spots, bodies, strict=True)):
            return lanes, Outcome.END_OF_ROAD
        if lanes[0] >= 0:
            return lanes, None
        own, ended = self._beside(np.array(states[0][:2]), spots[0])
        return [own, *lanes[1:]], ended

    def track(self) -> FloatArray:
        """Where all were at every tick, with the columns of :attr:`pytest_pafot.Trace.track`."""
        return np.array(self._rows).reshape(-1, len(self._along), 5)

    def _beside(self, position: FloatArray, spot: Spot) -> tuple[int, Outcome | None]:
        """Of an ego that is on no lane of its way: the lane that it is on, and what that means."""
        on = [index for index, lane in self._network.lanes_dict().items() if lane.on_lane(position)]
        if any(index[:2] in self._road.sections for index in on):
            return self._road.columns[spot.lane].part[self._road.point(spot.along)], None
        if on:
            first = len(self._road.lanes) - len(self._road.others)
            return first + self._road.others.index(on[0]), Outcome.LEFT_ROUTE
        return -1, Outcome.OFF_ROAD
