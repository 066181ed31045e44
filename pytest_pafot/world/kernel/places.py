"""The places of the vehicles of a run on their roads, found anew after each tick, for the director and the record."""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Sequence
from typing import Any

from pytest_pafot.model.crossings import NOT_ON_WAY, STEP
from pytest_pafot.model.trace import Outcome
from pytest_pafot.world.kernel.bodies import COLUMNS, Body, Box
from pytest_pafot.world.kernel.lanes import Bends, Lanes, Track, even_rounded

HALF_TURN = math.pi
"""Pi [rad]; unlike ``math.pi``, it is a C number in compiled code."""
NOWHERE = float("nan")
TRACK_COLUMNS = 5
"""The number of values of a vehicle in a row of ``Trace.track``."""


class Places:
    """The places of the vehicles of a run on its road.

    On a straight road they follow from coordinates. On a bent road and on the ways that meet it, vehicles are tracked
    from tick to tick, because roads may cross or repeat themselves. On the ego's way, a body gets its nominal position
    across the road, and its heading relative to the way. A crossing NPC's body gets its place along its own way, its
    distance to the right of it, and its angle to it.

    Args:
        vehicles: the vehicles in world coordinates, the ego first.
        bodies: the same vehicles in road coordinates; the same objects if a straight road starts at the world's origin.
        lanes: the lanes of a straight road; None on a bent one.
        x, y: where the straight road starts [m].
        bends: the ego's way on a bent road; the following arguments are for such a road.
        starts: each vehicle's place along its way at the start [m].
        ways: the own way of each crossing NPC, None for each other vehicle; the ego is first.
        end: the place along the ego's way at which the run ends [m].
        beside: returns, for an ego that is on no lane of its way, the index of its lane in ``Trace.lanes`` and how the
            run has left its road, by x and y [m], the nearest lane, and the place along the way [m].
        ticks: the largest number of ticks of the run.

    Attributes:
        left: the outcome if the run has left its road, else None. A run on a straight road continues beside it.
        lanes: the road's lanes if world and road coordinates are the same, so that bodies need not be placed; else
            None.
        obstacles: the fixed objects on the road, in world coordinates.
        track, on_way: rows of ``Trace.track`` and of ``Trace.on_way``; empty if the trace has none.
    """

    def __init__(
        self,
        vehicles: list[Any],
        bodies: list[Any],
        lanes: Lanes | None = None,
        x: float = 0.0,
        y: float = 0.0,
        *,
        bends: Bends | None = None,
        starts: Sequence[float] = (),
        ways: Sequence[Track | None] = (),
        end: float = 0.0,
        beside: Callable[[float, float, int, float], tuple[int, Outcome | None]] | None = None,
        ticks: int = 0,
    ) -> None:
        self.vehicles: list[Body] = vehicles
        self.obstacles: list[Box] = []
        self.bodies: list[Body] = bodies
        self.left: Outcome | None = None
        self._lanes: Any = lanes
        self._x = x
        self._y = y
        self.lanes = lanes if vehicles[0] is bodies[0] else None
        self._bends: Any = bends
        self._ways = list(ways)
        self._end = end
        self._beside: Any = beside
        self._along = array("d", starts)
        self._row = 0  # of the tick in `track` and `on_way`, in vehicles
        npcs = len(vehicles) - 1
        rows, crosses = 0 if bends is None else ticks + 1, len(ways) > ways.count(None)
        self.track = array("d", [NOWHERE]) * (TRACK_COLUMNS * (npcs + 1) * rows)
        self.on_way = array("d", [NOWHERE]) * (npcs * rows if crosses else 0)

    def control(self) -> None:
        """Give the NPCs in world coordinates the controls that the director has set."""
        for number in range(1, len(self.vehicles)):
            vehicle, body = self.vehicles[number], self.bodies[number]
            vehicle.acceleration = body.acceleration
            vehicle.steering = body.steering

    def see(self, record: Any, row: int) -> None:
        """Find all vehicles, place the bodies on the road, and write the vehicles' lanes into a row of a record.

        Called once a tick, unless :attr:`lanes` makes it unnecessary. On a bent road, it also keeps the vehicles'
        places, and the run may have left its road.
        """
        bends, has_ended, count, first = self._bends, False, len(self.vehicles), row
        for number in range(count):
            vehicle, body = self.vehicles[number], self.bodies[number]
            if bends is None:
                body.place(vehicle.x - self._x, vehicle.y - self._y, vehicle.heading, vehicle.speed)
                record[row + 6] = self._lanes.locate(body)
            elif (way := self._ways[number]) is not None:
                record[row + 6] = self._on_own_way(vehicle, body, way, number)
            else:
                bends.locate(vehicle.x, vehicle.y, vehicle.heading, self._along[number])
                along = bends.along
                self._along[number] = along
                body.place(along, bends.in_lanes(bends.lane, along, bends.offset), bends.angle, vehicle.speed)
                body.lane = bends.nearest_lane(body.y)
                record[row + 6] = bends.part(bends.lane, along, bends.offset)
                self._note(number)
                has_ended = has_ended or along + body.length / 2.0 >= self._end
            row += COLUMNS
        self._row += count
        if has_ended:
            self.left = Outcome.END_OF_ROAD
        elif bends is not None and record[first + 6] < 0:
            ego = self.vehicles[0]
            bends.locate(ego.x, ego.y, ego.heading, self._along[0])
            record[first + 6], self.left = self._beside(ego.x, ego.y, bends.lane, bends.along)

    def _on_own_way(self, vehicle: Body, body: Body, way: Track, number: int) -> int:
        """Find a crossing NPC, note its places on both ways, and return its lane."""
        way.locate(vehicle.x, vehicle.y, self._along[number])
        along = self._along[number] = way.along
        turned = vehicle.heading - way.direction
        turned = (turned + HALF_TURN) % (2.0 * HALF_TURN) - HALF_TURN
        body.place(along, way.across, turned, vehicle.speed)
        self.on_way[self._row // len(self.vehicles) * (len(self.vehicles) - 1) + number - 1] = along
        if self.is_on_way(way, vehicle.x, vehicle.y, vehicle.heading, along):
            self._note(number)
        return way.parts[way.point(along)] if 0.0 <= along <= (len(way.parts) - 1) * STEP else -1

    def along(self, number: int) -> float:
        """Return the place of a vehicle along its way [m]."""
        return self._along[number]

    def way(self, number: int) -> Track | None:
        """Return the own way of a vehicle that crosses, else None."""
        return self._ways[number]

    def is_on_way(self, way: Track | None, x: float, y: float, heading: float, along: float) -> bool:
        """Locate a vehicle on the ego's way, and return whether it is there.

        It is at x and y [m] with a heading [rad], at a place along its own way [m], or along the ego's if it has none.
        Before its zone, a crossing NPC is never on the ego's way.
        """
        bends: Bends = self._bends
        if way is None:
            bends.locate(x, y, heading, along)
            return True
        if along < way.enters:
            return False
        near = way.along_ego[min(even_rounded(along / STEP), len(way.along_ego) - 1)]
        if math.isnan(near):
            return False
        bends.locate(x, y, heading, near)
        is_on = bends.part(bends.lane, bends.along, bends.offset) >= 0
        return is_on and -NOT_ON_WAY < bends.angle < NOT_ON_WAY

    def _note(self, number: int) -> None:
        """Record the place at which the last vehicle was located on the ego's way."""
        bends, track, row = self._bends, self.track, TRACK_COLUMNS * (self._row + number)
        track[row] = bends.along
        track[row + 1] = bends.across
        track[row + 2] = bends.angle
        track[row + 3] = bends.offset
        track[row + 4] = bends.stretch(bends.along, bends.across)
