"""The observations of planners on bent roads, which they see straightened."""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from typing import Any

import numpy as np

from pytest_pafot.model.crossings import CrossingVehicle
from pytest_pafot.model.sight import Sight
from pytest_pafot.model.trace import FloatArray
from pytest_pafot.world.kernel.bends import Bends
from pytest_pafot.world.kernel.observation import COLUMNS, Observation, Sensor, VehicleState, lateral_velocity
from pytest_pafot.world.kernel.places import RoadPlaces

HALF_TURN = math.pi
"""Pi [rad]; unlike ``math.pi``, it is a C number in compiled code."""


class RoadSensor(Sensor):
    """The maker of observations on a bent road, from the record of a run.

    In its observations, x is along the ego's way and y nominal across it (see :class:`NetworkRoad`). Distances are
    driven distances, and headings are relative to that of a vehicle that follows the lane. NPCs on ways of their own
    are in ``crossing``.

    Args:
        places: the vehicles and their places on the road.
        record: rows of :data:`COLUMNS` numbers for each vehicle at each tick.
        bends: the ego's way.
        leaning: for each vehicle, the ego first, the same way with the leans of a vehicle of its length.
        zones: the zone of each crossing NPC, None for each other NPC.
        common: the lanes' number, their width [m], the speed limit [m/s] and the length of the road [m].
        physics_hz, every: ticks per second, and the number of ticks between decisions.
        sight: the planner's sight, and the seed of its errors; None for perfect sight.
    """

    def __init__(
        self,
        places: RoadPlaces,
        record: array[float],
        bends: Bends,
        leaning: Sequence[Bends],
        zones: Sequence[Any],
        common: tuple[int, float, float, float],
        physics_hz: int,
        every: int,
        sight: tuple[Sight, int] | None,
    ) -> None:
        super().__init__()
        self.is_bent = True
        self._places = places
        self._record = record
        self._bends = bends
        self._leaning = list(leaning)
        self._zones = list(zones)
        self._common = common
        self._physics_hz = physics_hz
        self._every = every
        self._sight: Any = None
        self._seed = 0
        if sight is not None:
            self._sight, self._seed = sight
        self._sizes = [(each.length, each.width) for each in places.vehicles]
        self._drift = 0.0

    def has_lane(self, lane: int) -> bool:
        """Return whether a lane exists at the ego's place."""
        return self._bends.exists(lane, self.along)

    def observation(self, tick: int) -> Observation:
        """Return the observation at the current tick; with imperfect sight, vehicles may be late or missing."""
        bends, record, places, count = self._bends, self._record, self._places, len(self._sizes)
        row = tick * count * COLUMNS
        x, y, heading, speed = record[row], record[row + 1], record[row + 2], record[row + 3]
        bends.locate(x, y, heading, places.along(0))
        own, across = bends.along, bends.across
        stretch = bends.stretch(own, across)
        self.along = own
        own_bends = self._leaning[0]
        self.bend = math.atan(2.0 * math.tan(-own_bends.lean_at(bends.lane, own)))
        ego = self._state(0, speed, record[row + 5], own, stretch)
        self.across, self.heading = ego.y, ego.heading
        cos, sin = math.cos(heading), math.sin(heading)
        others, ids, lateral, crossing = [], [], [self._drift], []
        then = row
        glimpses: Any = [(npc, 0.0, 0.0, 0.0) for npc in range(count - 1)]
        if self._sight is not None:
            before = max(0, tick - self._sight.delay(self._physics_hz))
            then = before * count * COLUMNS
            glimpses = self._sight.glimpses(self._states(then), self._seed, tick)
        for npc, error_x, error_y, error_speed in glimpses:
            at = then + (npc + 1) * COLUMNS
            its_x, its_y, its_heading = record[at] + error_x, record[at + 1] + error_y, record[at + 2]
            its_speed, along = record[at + 3] + error_speed, places.along(npc + 1)
            way = places.way(npc + 1)
            if way is not None:
                way.track.locate(its_x, its_y, along)
                along = way.track.along
            if places.is_on_way(way, its_x, its_y, its_heading, along):
                others.append(self._state(npc + 1, its_speed, record[at + 5], own, stretch))
                ids.append(npc)
                lateral.append(self._drift)
                continue
            zone, (length, width) = self._zones[npc], self._sizes[npc + 1]
            dx, dy, turned = its_x - x, its_y - y, its_heading - heading
            crossing.append(
                CrossingVehicle(
                    id=npc,
                    zone=zone,
                    distance=zone.npc[0] - along,
                    ego_distance=zone.ego[0] - own,
                    ahead=dx * cos + dy * sin,
                    right=dy * cos - dx * sin,
                    heading=(turned + HALF_TURN) % (2.0 * HALF_TURN) - HALF_TURN,
                    speed=its_speed,
                    length=length,
                    width=width,
                )
            )
        lanes, lane_width, speed_limit, road_length = self._common
        return Observation(
            tick / self._physics_hz,
            ego,
            tuple(others),
            lanes,
            lane_width,
            speed_limit,
            decision_period=self._every / self._physics_hz,
            acceleration=record[row + 4],
            steering=record[row + 5],
            lateral_velocities=tuple(lateral),
            ids=tuple(ids),
            road_length=road_length,
            crossing=tuple(crossing),
        )

    def _state(self, number: int, speed: float, steering: float, own: float, stretch: float) -> VehicleState:
        """Return the state, on the straightened road, of the vehicle that was located last.

        Its velocity across its lane [m/s] is stored for the observation's ``lateral_velocities``. The ego's place and
        the stretch there are ``own`` [m] and ``stretch``.
        """
        bends, own_bends, (length, width) = self._bends, self._leaning[number], self._sizes[number]
        along, lane = bends.along, bends.lane
        driven = (along - own) * (stretch + bends.stretch(along, bends.across)) / 2.0
        to_lane = bends.angle + bends.heading_at(along) - bends.direction_at(lane, along)
        self._drift = lateral_velocity(to_lane, speed, steering)
        y, leaning = bends.in_lanes(lane, along, bends.offset), to_lane - own_bends.lean_at(lane, along)
        return VehicleState(own + driven, y, leaning, speed, lane, length, width)

    def _states(self, row: int) -> FloatArray:
        """Return the states of all vehicles at a row of the record as a sight takes them; the lane is not used."""
        count = len(self._sizes)
        states: FloatArray = np.array(self._record[row : row + count * COLUMNS]).reshape(count, COLUMNS)
        states[:, 4:] = [(0.0, *size) for size in self._sizes]
        return states
