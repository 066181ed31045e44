"""The positions of all vehicles on the road, updated after each tick."""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Sequence
from typing import Any

from pytest_pafot.model.crossings import NOT_ON_WAY, STEP
from pytest_pafot.model.trace import Outcome
from pytest_pafot.world.kernel.bodies import COLUMNS, Body, Box
from pytest_pafot.world.kernel.lanes import Bends, Lanes, Track, even_rounded

HALF_TURN = math.pi  # [rad]; unlike math.pi, it is a C number in compiled code
NOWHERE = float("nan")
TRACK_COLUMNS = 5  # values per vehicle and tick in Trace.track


class Places:
    """The positions of all vehicles of a run.

    On a curved road, vehicles are tracked from tick to tick, because the road can cross itself or be a circle.
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
        # outcome if the ego has left the road or a vehicle has reached its end; always None on a straight road
        self.left: Outcome | None = None
        self._lanes: Any = lanes
        self._x = x
        self._y = y
        # None if `see` must place bodies after each tick
        self.lanes = lanes if vehicles[0] is bodies[0] else None
        self._bends: Any = bends
        self._ways = list(ways)  # path of each crossing NPC, None for the other vehicles
        self._end = end  # position along the ego's path at which the run ends [m]
        # If the ego is on no lane of its path, this function is called with x, y, the nearest lane and the position
        # along the path. It returns the index of the ego's lane in Trace.lanes, and the outcome if the run ends.
        self._beside: Any = beside
        self._along = array("d", starts)  # position of each vehicle along its path [m]
        # sum of the vehicles recorded at all earlier ticks, from which indices in `track` follow
        self._row = 0
        npcs = len(vehicles) - 1
        rows, crosses = 0 if bends is None else ticks + 1, len(ways) > ways.count(None)
        # values of Trace.track and Trace.on_way; empty if the trace does not need them
        self.track = array("d", [NOWHERE]) * (TRACK_COLUMNS * (npcs + 1) * rows)
        self.on_way = array("d", [NOWHERE]) * (npcs * rows if crosses else 0)

    def control(self) -> None:
        """Copy the NPCs' controls, which the director has set, from the bodies to the vehicles."""
        for number in range(1, len(self.vehicles)):
            vehicle, body = self.vehicles[number], self.bodies[number]
            vehicle.acceleration = body.acceleration
            vehicle.steering = body.steering

    def see(self, record: Any, row: int) -> None:
        """Locate all vehicles, place their bodies on the road, and write their lanes into the record."""
        bends, has_ended, count, first = self._bends, False, len(self.vehicles), row
        for number in range(count):
            vehicle, body = self.vehicles[number], self.bodies[number]
            if bends is None:
                body.place(vehicle.x - self._x, vehicle.y - self._y, vehicle.heading, vehicle.speed)
                record[row + 6] = self._lanes.locate(body)
            # the body of a crossing NPC is placed along and across the NPC's own path
            elif (way := self._ways[number]) is not None:
                record[row + 6] = self._on_own_way(vehicle, body, way, number)
            else:
                # all other bodies are placed along the ego's path, at a nominal lateral position
                bends.locate(vehicle.x, vehicle.y, vehicle.heading, self._along[number])
                along = bends.along
                self._along[number] = along
                body.place(
                    along,
                    bends.in_lanes(bends.lane, along, bends.offset),
                    bends.angle,
                    vehicle.speed,
                )
                body.lane = bends.nearest_lane(body.y)
                record[row + 6] = bends.part(bends.lane, along, bends.offset)
                self._note(number)
                has_ended = has_ended or along + body.length / 2.0 >= self._end
            row += COLUMNS
        self._row += count
        if has_ended:
            self.left = Outcome.END_OF_ROAD
        # the ego is in a lane of another road, or off the road
        elif bends is not None and record[first + 6] < 0:
            ego = self.vehicles[0]
            bends.locate(ego.x, ego.y, ego.heading, self._along[0])
            record[first + 6], self.left = self._beside(ego.x, ego.y, bends.lane, bends.along)

    def _on_own_way(self, vehicle: Body, body: Body, way: Track, number: int) -> int:
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
        return self._along[number]

    def way(self, number: int) -> Track | None:
        return self._ways[number]

    def is_on_way(
        self, way: Track | None, x: float, y: float, heading: float, along: float
    ) -> bool:
        """Locate a vehicle along the ego's path, and return whether it is on that path."""
        bends: Bends = self._bends
        if way is None:
            bends.locate(x, y, heading, along)
            return True
        if along < way.enters:  # before its zone, a crossing NPC is never on the ego's path
            return False
        near = way.along_ego[min(even_rounded(along / STEP), len(way.along_ego) - 1)]
        if math.isnan(near):
            return False
        bends.locate(x, y, heading, near)
        is_on = bends.part(bends.lane, bends.along, bends.offset) >= 0
        return is_on and -NOT_ON_WAY < bends.angle < NOT_ON_WAY

    def _note(self, number: int) -> None:
        bends, track, row = self._bends, self.track, TRACK_COLUMNS * (self._row + number)
        track[row] = bends.along
        track[row + 1] = bends.across
        track[row + 2] = bends.angle
        track[row + 3] = bends.offset
        track[row + 4] = bends.stretch(bends.along, bends.across)
