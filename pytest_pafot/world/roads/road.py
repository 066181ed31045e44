"""The base class of roads, and the straight road.

Grid coordinates are along the ego's path and across its lanes. Other code never checks the class of a road.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from pytest_pafot.model.crossings import Crossings, Zone
from pytest_pafot.model.instructions import Cell
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.sight import Sight
from pytest_pafot.model.trace import Lane
from pytest_pafot.model.vehicle_type import CAR, VehicleType
from pytest_pafot.world.driving.policy import ImperfectSensor
from pytest_pafot.world.kernel.crossing import JunctionDirector
from pytest_pafot.world.kernel.director import Director
from pytest_pafot.world.kernel.lanes import Body, Lanes, Places
from pytest_pafot.world.kernel.observation import Observer, Sensor
from pytest_pafot.world.limits import TOP_SPEED, NpcLimits

Meeting = Literal["crosses", "joins", "oncoming"]
"""The kind of conflict between another road and the ego's path. A road that only branches off does not conflict."""

Pose = tuple[float, float, float]
"""The world x [m], y [m] and heading [rad] of a vehicle."""


class Road(ABC):
    """A road in grid coordinates. By default, the ego can start in any lane, and no traffic crosses.

    Attributes:
        lanes: all lanes as in a trace, starting with the lanes along the ego's path, from the left.
        lane_width: width [m] of the ego's lane at the start.
        speed_limit: speed limit [m/s] of the fastest lane.
        is_straight: True if a run continues after the ego has left the road, False if the run then ends.
    """

    lanes: tuple[Lane, ...]
    lane_width: float
    speed_limit: float
    is_straight = False

    @property
    def length(self) -> float:
        """The length [m] that a run must not exceed, or infinity if a run can end at the end of the road."""
        return math.inf

    @property
    def prescribed(self) -> tuple[int, float] | None:
        """The ego's required lane and speed [m/s] at the start, or None if both can be chosen."""
        return None

    @property
    def unused(self) -> frozenset[Meeting]:
        """The kinds of conflict that cannot occur, because no NPCs drive on the other roads."""
        return frozenset()

    @property
    def crossings(self) -> Crossings | None:
        """The paths of other traffic that cross or join the ego's path, or None if there are none."""
        return None

    def zones(self, scenario: Scenario) -> tuple[Zone | None, ...]:
        """Return each crossing NPC's zone and None for the other NPCs, or an empty tuple if no NPC crosses."""
        return ()

    # Positions.

    @property
    @abstractmethod
    def lane_count(self) -> int:
        """The number of lanes along the ego's path, including shorter lanes."""

    @property
    def starts_at_origin(self) -> bool:
        return False

    def centre(self, lane: int) -> float:
        """Return the nominal lateral position [m] of a lane's centre."""
        return lane * self.lane_width

    @abstractmethod
    def position(self, longitudinal: float, lane: int, vehicle: VehicleType = CAR) -> Pose:
        """Return the pose of a vehicle at the centre of a lane, at a position [m] along the road."""

    @abstractmethod
    def has_lane(self, lane: int, along: float) -> bool:
        """Return whether an NPC can start in a lane at a position [m] along the road."""

    # Starts.

    @abstractmethod
    def ego_start(self, headway: float, clearance: float) -> float:
        """Return the ego's start position [m] along the road, given the headway [s] and clearance [m] of NPCs."""

    @property
    @abstractmethod
    def start_lanes(self) -> Sequence[int]:
        """The lanes in which the ego can start."""

    @property
    @abstractmethod
    def said_of_start_lanes(self) -> tuple[str, str]:
        """The expected value and a hint, for an error message about the ego's lane."""

    @abstractmethod
    def start_cells(self, lane: int, distance: float) -> frozenset[Cell]:
        """Return the cells around the ego's start in which NPCs can start.

        ``distance`` [m] is the distance between rows.
        """

    def can_drive(self, vehicle: VehicleType, zone: str | None = None) -> bool:
        """Return whether a vehicle can follow all bends of the ego's path or of the path with the given zone."""
        return True

    def start_speed(
        self,
        wanted: float,
        lane: int,
        along: float,
        vehicle: VehicleType,
    ) -> float:
        """Limit the start speed [m/s] of an NPC to the speed that the road allows."""
        return wanted

    # The components of a run.

    @abstractmethod
    def director(
        self,
        scenario: Scenario,
        limits: NpcLimits,
        cells: frozenset[Cell],
        **common: Any,
    ) -> Director | JunctionDirector:
        """Create the director of the NPCs, which can start in ``cells``."""

    @abstractmethod
    def places(
        self,
        vehicles: list[Body],
        bodies: list[Body],
        scenario: Scenario,
        *,
        starts: Sequence[float],
        ticks: int,
        stock_road: Callable[[], Any],
    ) -> Places:
        """Create the object that tracks all vehicles on this road during a run.

        ``vehicles`` are in world coordinates and ``bodies`` in road coordinates, both with the ego first. ``starts``
        contains the vehicles' start positions [m] along their paths. ``stock_road`` returns the matching highway-env
        road.
        """

    @abstractmethod
    def sensor(
        self,
        places: Places,
        record: Any,
        scenario: Scenario,
        rates: tuple[float, int],
        sight: Sight | None,
        ego: VehicleType,
    ) -> Sensor:
        """Create the sensor for a planner.

        ``rates`` are the numbers of ticks per second and per decision.
        """

    def foresight(self, body: Body) -> Callable[[float], Pose] | None:
        """Return a function that maps an NPC's position along its path to its pose, or None."""
        return None


def ego_start(headway: float, clearance: float) -> float:
    """Return the ego's start position [m] on a straight road, with room behind it for NPCs at any speed."""
    return max(200.0, 50.0 + headway * TOP_SPEED + clearance)


@dataclass(frozen=True)
class StraightRoad(Road):
    """Parallel straight lanes of equal width along the x axis, numbered from the left (smallest y)."""

    is_straight = True

    lanes: tuple[Lane, ...]
    lane_width: float = field(init=False)
    speed_limit: float = field(init=False)
    grid: Lanes = field(init=False, repr=False, compare=False)
    _origin: tuple[float, float] = field(init=False, repr=False)
    _cells: tuple[frozenset[Cell], ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        first = self.lanes[0]
        count = len(self.lanes)
        cells = tuple(
            frozenset(cell for cell in Cell if 0 <= lane + cell.column < count)
            for lane in range(count)
        )
        self.__dict__.update(  # the class is frozen and does not allow assignments
            lane_width=first.width,
            speed_limit=max(lane.speed_limit for lane in self.lanes),
            grid=Lanes(count, first.width, first.length),
            _origin=(first.x, first.y),
            _cells=cells,
        )

    @classmethod
    def uniform(
        cls,
        lanes: int,
        length: float,
        lane_width: float,
        speed_limit: float,
    ) -> StraightRoad:
        """Create a road of equal lanes that start at x = 0, with the centre of lane 0 at y = 0."""
        return cls(
            tuple(
                Lane(
                    x=0.0,
                    y=k * lane_width,
                    heading=0.0,
                    length=length,
                    width=lane_width,
                    speed_limit=speed_limit,
                )
                for k in range(lanes)
            )
        )

    @property
    def lane_count(self) -> int:
        return len(self.lanes)

    @property
    def length(self) -> float:
        return self.lanes[0].length

    @property
    def starts_at_origin(self) -> bool:
        return self._origin == (0.0, 0.0)

    def project(self, x: float, y: float, heading: float) -> tuple[float, float, float]:
        """Return the positions [m] along the road and to the right of lane 0, and the angle [rad] to the road."""
        x0, y0 = self._origin
        return x - x0, y - y0, heading

    def position(self, longitudinal: float, lane: int, vehicle: VehicleType = CAR) -> Pose:
        x0, y0 = self._origin
        return x0 + longitudinal, y0 + self.centre(lane), 0.0

    def cells(self, ego_lane: int) -> frozenset[Cell]:
        """Return the cells that are on a lane when the ego is in ``ego_lane``."""
        return self._cells[ego_lane]

    def has_lane(self, lane: int, along: float) -> bool:
        return 0 <= lane < self.lane_count and CAR.length < along < self.length - CAR.length

    def ego_start(self, headway: float, clearance: float) -> float:
        return ego_start(headway, clearance)

    @property
    def start_lanes(self) -> range:
        return range(self.lane_count)

    @property
    def said_of_start_lanes(self) -> tuple[str, str]:
        return f"a lane from 0 to {self.lane_count - 1}", f"the road has {self.lane_count} lanes"

    def start_cells(self, lane: int, distance: float) -> frozenset[Cell]:
        return self._cells[lane]

    def director(
        self,
        scenario: Scenario,
        limits: NpcLimits,
        cells: frozenset[Cell],
        **common: Any,
    ) -> Director:
        return Director(
            scenario,
            self.grid,
            limits,
            speed_limit=self.speed_limit,
            cells=self._cells,
            **common,
        )

    def places(
        self,
        vehicles: list[Body],
        bodies: list[Body],
        scenario: Scenario,
        *,
        starts: Sequence[float],
        ticks: int,
        stock_road: Callable[[], Any],
    ) -> Places:
        return Places(vehicles, bodies, self.grid, *self._origin)

    def sensor(
        self,
        places: Places,
        record: Any,
        scenario: Scenario,
        rates: tuple[float, int],
        sight: Sight | None,
        ego: VehicleType,
    ) -> Sensor:
        sizes = [(each.length, each.width) for each in places.vehicles]
        observer = Observer(record, sizes, self.grid, self.speed_limit, *rates, *self._origin)
        if sight is None:
            return observer
        return ImperfectSensor(observer, sight, scenario.seed)
