# cython: initializedcheck=False, wraparound=False
"""Read-only observations in SI units, computed lazily, and the sensors that create them."""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from typing import Any, NamedTuple, TypedDict, Unpack

import numpy as np

from pytest_pafot.model.crossings import CrossingVehicle
from pytest_pafot.model.sight import Sight
from pytest_pafot.model.trace import FloatArray
from pytest_pafot.world.kernel.lanes import COLUMNS, Bends, Lanes, Places

HALF_TURN = math.pi  # [rad]; unlike math.pi, it is a C number in compiled code


class VehicleState(NamedTuple):
    """The state of a vehicle, as far as it can be measured from outside.

    Attributes:
        x, y: position [m] of the centre. x is measured along the road, and y to the right, from the centre of the
            leftmost lane.
        heading: heading [rad], which is 0 along the road and positive to the right.
        speed: speed [m/s].
        lane: number of the nearest lane, counted from 0 at the left.
        length, width: length [m] and width [m].
    """

    x: float
    y: float
    heading: float
    speed: float
    lane: int
    length: float = 5.0
    width: float = 2.0


# the fields of an Observation, in the order of the constructor's arguments
Fields = TypedDict("Fields", {  # noqa: UP013  (a class is longer)
    "time": float, "ego": VehicleState, "others": Sequence[VehicleState], "lanes": int, "lane_width": float,
    "speed_limit": float, "decision_period": float, "acceleration": float, "steering": float,
    "lateral_velocities": tuple[float, ...], "ids": Sequence[int], "road_length": float,
    "crossing": tuple[CrossingVehicle, ...],
}, total=False)  # fmt: skip

_NEW = tuple.__new__  # creates a VehicleState in half the time of a call of the class

# decision period, acceleration, steering, ids, road length, crossing vehicles: few planners use them
_Details = tuple[float, float, float, tuple[int, ...], float, tuple[CrossingVehicle, ...]]


def lateral_velocity(heading: float, speed: float, steering: float) -> float:
    """Return the lateral velocity [m/s] of a vehicle's centre, given angles [rad] and a speed [m/s]."""
    return speed * math.sin(heading + math.atan(0.5 * math.tan(steering)))


class Sensor:
    """The base class of sensors, which create the ADS's observations."""

    def __init__(self) -> None:
        self.is_bent = False  # true on a curved road, which observations show straightened
        # The ego in the last observation of a curved road: the position along the road and the nominal position across
        # it [m], the heading relative to a vehicle that follows the lane, and the steering angle of that vehicle [rad].
        self.along = self.across = self.heading = self.bend = 0.0

    def observation(self, tick: int) -> Observation:
        """Return the observation at the current tick. On a straight road, ``tick`` can also be an earlier tick.

        On a curved road, this also locates the ego, as the driver's steering requires.
        """
        raise NotImplementedError

    def has_lane(self, lane: int) -> bool:
        """Return whether a lane exists at the ego's position."""
        return True


class Observer(Sensor):
    """A sensor for straight roads, which computes observations from the run's record."""

    def __init__(
        self,
        record: array[float],
        sizes: list[tuple[float, float]],
        lanes: Lanes,
        speed_limit: float,
        physics_hz: float,
        every: int,
        x0: float = 0.0,
        y0: float = 0.0,
    ) -> None:
        super().__init__()
        self._x0 = x0
        self._y0 = y0
        self.record = record
        self.sizes = sizes
        self.lanes = lanes
        self.speed_limit = speed_limit
        self.physics_hz = physics_hz
        self.every = every
        self.columns = COLUMNS

    def vehicle(self, tick: int, index: int) -> VehicleState:
        """Return the state of a vehicle at a tick. The ego has index 0."""
        length, width = self.sizes[index]
        row = (tick * len(self.sizes) + index) * self.columns
        x = self.record[row] - self._x0
        y = self.record[row + 1] - self._y0
        heading = self.record[row + 2]
        lane = self.lanes.closest(x, y, heading)
        return _NEW(VehicleState, (x, y, heading, self.record[row + 3], lane, length, width))

    def details(self, tick: int) -> _Details:
        row = tick * len(self.sizes) * self.columns
        count = len(self.sizes) - 1
        period = self.every / self.physics_hz
        ids = tuple(range(count))
        return period, self.record[row + 4], self.record[row + 5], ids, self.lanes.length, ()

    def lateral_velocities(self, tick: int) -> tuple[float, ...]:
        first = tick * len(self.sizes) * self.columns
        columns = self.columns
        record = self.record
        values = []
        for index in range(len(self.sizes)):
            row = first + index * columns
            values.append(lateral_velocity(record[row + 2], record[row + 3], record[row + 5]))
        return tuple(values)

    def fill(self, tick: int, values: FloatArray, run: int) -> None:
        """Write the states of all vehicles at a tick into an array of shape [runs, vehicles, 7], at index ``run``."""
        row = tick * len(self.sizes) * self.columns
        for index, (length, width) in enumerate(self.sizes):
            x = self.record[row] - self._x0
            y = self.record[row + 1] - self._y0
            heading = self.record[row + 2]
            values[run, index, 0] = x
            values[run, index, 1] = y
            values[run, index, 2] = heading
            values[run, index, 3] = self.record[row + 3]
            values[run, index, 4] = self.lanes.closest(x, y, heading)
            values[run, index, 5] = length
            values[run, index, 6] = width
            row += self.columns

    def observation(self, tick: int) -> Observation:
        seen = Observation.__new__(Observation)
        seen._observer = self
        seen._tick = tick
        seen._time = tick / self.physics_hz
        seen._ego = seen._others = seen._details = seen._lateral = None
        seen._lanes = self.lanes.count
        seen._lane_width = self.lanes.width
        seen._speed_limit = self.speed_limit
        return seen


class Observation:
    """The observation that a planner receives for one decision.

    Attributes:
        time: time [s] since the start of the run.
        ego: vehicle that the planner drives.
        others: NPCs; at a junction, only the NPCs on the ego's path.
        lanes: number of lanes.
        lane_width: width [m] of each lane.
        speed_limit: speed limit [m/s] of the fastest lane.
        decision_period: time [s] between two decisions.
        acceleration, steering: the ego's acceleration [m/s^2] and steering angle [rad] in the last tick, or 0 at the
            start.
        lateral_velocities: lateral velocities [m/s] of the ego and the others, positive to the right.
        ids: index in ``run.npcs`` of each vehicle in ``others``.
        lane_centres: y-coordinate [m] of each lane's centre, from the left.
        road_length: x-coordinate [m] of the end of the lanes, which start at x = 0.
        crossing: NPCs on other paths that cross or join the ego's path (:class:`pytest_pafot.CrossingVehicle`).
            ``ids`` and ``array`` do not contain these NPCs.
    """

    __slots__ = (
        "_details", "_ego", "_lane_width", "_lanes", "_lateral", "_observer", "_others", "_speed_limit", "_tick",
        "_time",
    )  # fmt: skip

    def __init__(
        self,
        time: float,
        ego: VehicleState,
        others: Sequence[VehicleState] = (),
        lanes: int = 4,
        lane_width: float = 4.0,
        speed_limit: float = 26.8,
        decision_period: float = 0.2,
        acceleration: float = 0.0,
        steering: float = 0.0,
        lateral_velocities: tuple[float, ...] | None = None,
        ids: Sequence[int] | None = None,
        road_length: float = 1e5,
        crossing: tuple[CrossingVehicle, ...] = (),
    ) -> None:
        self._time = float(time)
        self._ego: VehicleState | None = ego
        self._others: tuple[VehicleState, ...] | None = tuple(others)
        self._lanes = lanes
        self._lane_width = float(lane_width)
        self._speed_limit = float(speed_limit)
        numbers = tuple(range(len(others))) if ids is None else tuple(ids)
        self._details: _Details | None = (
            decision_period,
            acceleration,
            steering,
            numbers,
            road_length,
            crossing,
        )
        self._lateral = lateral_velocities
        self._observer: Any = None  # not needed, because all fields are set
        self._tick = 0

    @property
    def time(self) -> float:
        return self._time

    @property
    def ego(self) -> VehicleState:
        if self._ego is None:
            self._ego = self._observer.vehicle(self._tick, 0)
        return self._ego

    @property
    def others(self) -> tuple[VehicleState, ...]:
        if self._others is None:
            count = len(self._observer.sizes)
            self._others = tuple(
                [self._observer.vehicle(self._tick, index) for index in range(1, count)]
            )
        return self._others

    @property
    def lanes(self) -> int:
        return self._lanes

    @property
    def lane_width(self) -> float:
        return self._lane_width

    @property
    def speed_limit(self) -> float:
        return self._speed_limit

    @property
    def decision_period(self) -> float:
        return self._detailed()[0]

    @property
    def acceleration(self) -> float:
        return self._detailed()[1]

    @property
    def steering(self) -> float:
        return self._detailed()[2]

    @property
    def lateral_velocities(self) -> tuple[float, ...]:
        if self._lateral is None and self._observer is not None:
            self._lateral = self._observer.lateral_velocities(self._tick)
        elif self._lateral is None:  # the steering angles are not known
            vehicles = [self.ego, *self.others]
            self._lateral = tuple(
                [lateral_velocity(each.heading, each.speed, 0.0) for each in vehicles]
            )
        return self._lateral

    @property
    def ids(self) -> tuple[int, ...]:
        return self._detailed()[3]

    @property
    def lane_centres(self) -> tuple[float, ...]:
        return tuple([lane * self._lane_width for lane in range(self._lanes)])

    @property
    def road_length(self) -> float:
        return self._detailed()[4]

    @property
    def crossing(self) -> tuple[CrossingVehicle, ...]:
        return self._detailed()[5]

    @property
    def array(self) -> FloatArray:
        """The ego and then the others, as a float64 array of shape [vehicles, 7] with :class:`VehicleState` columns."""
        values: FloatArray = stacked([self])[0]
        return values

    def _detailed(self) -> _Details:
        if self._details is None:
            self._details = self._observer.details(self._tick)
        return self._details

    def _count(self) -> int:
        if self._observer is None:
            return len(self.others) + 1
        return len(self._observer.sizes)

    def _fill(self, values: FloatArray, run: int) -> None:
        if self._observer is None:
            for index, vehicle in enumerate((self.ego, *self.others)):
                for column, value in enumerate(vehicle):
                    values[run, index, column] = value
        else:
            self._observer.fill(self._tick, values, run)

    def _values(self) -> tuple[Any, ...]:
        period, acceleration, steering, ids, length, crossing = self._detailed()
        seen = self.time, self.ego, self.others, self.lanes, self.lane_width, self.speed_limit
        return *seen, period, acceleration, steering, self.lateral_velocities, ids, length, crossing

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Observation) and self._values() == other._values()

    def __hash__(self) -> int:
        return hash(self._values())

    def replace(self, **changes: Unpack[Fields]) -> Observation:
        """Return a copy of the observation with new values for some fields, for example ``others=()``.

        If ``ego`` or ``others`` changes, missing lateral velocities are computed as if all wheels were straight. If the
        number of ``others`` changes, missing ids are counted from 0.

        Raises:
            TypeError: if a field is unknown.
        """
        fields: dict[str, Any] = dict(zip(Fields.__annotations__, self._values(), strict=True))
        if "ego" in changes or "others" in changes:
            fields["lateral_velocities"] = None
        if len(changes.get("others", self.others)) != len(self.others):
            fields["ids"] = None
        return Observation(**{**fields, **changes})

    def __repr__(self) -> str:
        named = zip(Fields.__annotations__, self._values(), strict=True)
        return f"Observation({', '.join([f'{name}={value!r}' for name, value in named])})"

    def __reduce__(self) -> tuple[type[Observation], tuple[Any, ...]]:
        return Observation, self._values()


def stacked(observations: Sequence[Observation]) -> FloatArray:
    """Stack observations into a float64 array of shape [observations, vehicles, 7].

    The columns are those of :attr:`Observation.array`. Rows for missing vehicles contain NaN.
    """
    most = max([seen._count() for seen in observations])
    made = np.full((len(observations), most, len(VehicleState._fields)), np.nan)
    values = made  # a typed memoryview in compiled code, to which writing is fast
    for run, seen in enumerate(observations):
        seen._fill(values, run)
    return made


class RoadSensor(Sensor):
    """A sensor for curved roads, which computes observations from the run's record.

    In observations, x is along the ego's path, and y is the nominal lateral position (see :class:`NetworkRoad`).
    Distances are driving distances, and headings are relative to a vehicle that follows the lane.
    """

    def __init__(
        self,
        places: Places,
        record: array[float],
        bends: Bends,
        leaning: Sequence[Bends],
        zones: Sequence[Any],
        common: tuple[int, float, float, float],
        physics_hz: float,
        every: int,
        sight: Sight | None,
        seed: int,
    ) -> None:
        super().__init__()
        self.is_bent = True
        self._places = places
        self._record = record
        self._bends = bends
        self._leaning = list(leaning)  # the path with the leans of each vehicle, the ego first
        self._zones = list(zones)  # zone of each crossing NPC; None for the other NPCs
        # number of lanes, width [m], speed limit [m/s] and length of the road [m]
        self._common = common
        self._physics_hz = physics_hz
        self._every = every
        self._sight: Any = sight
        self._seed = seed
        self._sizes = [(each.length, each.width) for each in places.vehicles]
        self._drift = 0.0

    def has_lane(self, lane: int) -> bool:
        return self._bends.exists(lane, self.along)

    def observation(self, tick: int) -> Observation:
        bends = self._bends
        record = self._record
        places = self._places
        count = len(self._sizes)
        row = tick * count * COLUMNS
        x = record[row]
        y = record[row + 1]
        heading = record[row + 2]
        speed = record[row + 3]
        # the ego first, because the others are relative to it
        bends.locate(x, y, heading, places.along(0))
        own = bends.along
        across = bends.across
        stretch = bends.stretch(own, across)
        self.along = own
        own_bends = self._leaning[0]
        self.bend = math.atan(2.0 * math.tan(-own_bends.lean_at(bends.lane, own)))
        ego = self._state(0, speed, record[row + 5], own, stretch)
        self.across = ego.y
        self.heading = ego.heading
        cos = math.cos(heading)
        sin = math.sin(heading)
        others = []
        ids = []
        lateral = [self._drift]
        crossing = []
        then = row
        glimpses: Any = [(npc, 0.0, 0.0, 0.0) for npc in range(count - 1)]
        # with imperfect perception, vehicles are seen late, with errors, or not at all
        if self._sight is not None:
            before = max(0, tick - self._sight.delay(self._physics_hz))
            then = before * count * COLUMNS
            glimpses = self._sight.glimpses(self._states(then), self._seed, tick)
        for npc, error_x, error_y, error_speed in glimpses:
            at = then + (npc + 1) * COLUMNS
            its_x = record[at] + error_x
            its_y = record[at + 1] + error_y
            its_heading = record[at + 2]
            its_speed = record[at + 3] + error_speed
            along = places.along(npc + 1)
            way = places.way(npc + 1)
            if way is not None:
                way.locate(its_x, its_y, along)
                along = way.along
            # NPCs on the ego's path are in `others`, all other NPCs in `crossing`
            if places.is_on_way(way, its_x, its_y, its_heading, along):
                others.append(self._state(npc + 1, its_speed, record[at + 5], own, stretch))
                ids.append(npc)
                lateral.append(self._drift)
                continue
            zone = self._zones[npc]
            length, width = self._sizes[npc + 1]
            dx = its_x - x
            dy = its_y - y
            turned = its_heading - heading
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

    def _state(
        self,
        number: int,
        speed: float,
        steering: float,
        own: float,
        stretch: float,
    ) -> VehicleState:
        # The state, on the straightened road, of the vehicle that was located last.
        bends = self._bends
        own_bends = self._leaning[number]
        length, width = self._sizes[number]
        along = bends.along
        lane = bends.lane
        # the mean of the stretches at both vehicles applies to the distance
        driven = (along - own) * (stretch + bends.stretch(along, bends.across)) / 2.0
        to_lane = bends.angle + bends.heading_at(along) - bends.direction_at(lane, along)
        # for the observation's lateral_velocities
        self._drift = lateral_velocity(to_lane, speed, steering)
        y = bends.in_lanes(lane, along, bends.offset)
        leaning = to_lane - own_bends.lean_at(lane, along)
        return VehicleState(own + driven, y, leaning, speed, lane, length, width)

    def _states(self, row: int) -> FloatArray:
        count = len(self._sizes)
        states: FloatArray = np.array(self._record[row : row + count * COLUMNS]).reshape(
            count, COLUMNS
        )
        states[:, 4:] = [(0.0, *size) for size in self._sizes]
        return states
