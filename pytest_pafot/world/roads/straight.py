"""The straight road in the grid's coordinates: positions along the road and across its lanes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from pytest_pafot.model.grid import Cell
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.sight import Sight
from pytest_pafot.model.trace import Lane
from pytest_pafot.model.vehicle_type import CAR, VehicleType
from pytest_pafot.world.driving.perception import ImperfectSensor
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.director import Director
from pytest_pafot.world.kernel.lanes import Lanes
from pytest_pafot.world.kernel.observation import Observer, Sensor
from pytest_pafot.world.kernel.places import Places
from pytest_pafot.world.limits import TOP_SPEED, NpcLimits
from pytest_pafot.world.roads.road import Pose, Road


def ego_start(headway: float, clearance: float) -> float:
    """Return the ego's place along a straight road at the start [m], with room behind it for NPCs at any speed."""
    return max(200.0, 50.0 + headway * TOP_SPEED + clearance)


@dataclass(frozen=True)
class StraightRoad(Road):
    """Parallel straight lanes of equal width along the x axis, lane 0 at the left (smallest y).

    Attributes:
        lanes: the lanes from the left, at least one.
        lane_width: the width of every lane [m].
        speed_limit: the speed limit of the fastest lane [m/s].
        grid: the lanes in road coordinates.
    """

    is_straight = True

    lanes: tuple[Lane, ...]
    lane_width: float = field(init=False)
    speed_limit: float = field(init=False)
    grid: Lanes = field(init=False, repr=False, compare=False)
    _origin: tuple[float, float] = field(init=False, repr=False)
    _cells: tuple[frozenset[Cell], ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        first, count = self.lanes[0], len(self.lanes)
        cells = tuple(frozenset(cell for cell in Cell if 0 <= lane + cell.column < count) for lane in range(count))
        self.__dict__.update(  # the class is frozen and refuses assignments
            lane_width=first.width,
            speed_limit=max(lane.speed_limit for lane in self.lanes),
            grid=Lanes(count, first.width, first.length),
            _origin=(first.x, first.y),
            _cells=cells,
        )

    @classmethod
    def uniform(cls, lanes: int, length: float, lane_width: float, speed_limit: float) -> StraightRoad:
        """Make a road of equal lanes that start at x = 0, with the centre of lane 0 at y = 0."""
        return cls(
            tuple(
                Lane(x=0.0, y=k * lane_width, heading=0.0, length=length, width=lane_width, speed_limit=speed_limit)
                for k in range(lanes)
            )
        )

    @property
    def lane_count(self) -> int:
        """The number of lanes."""
        return len(self.lanes)

    @property
    def length(self) -> float:
        """The length of the lanes [m]."""
        return self.lanes[0].length

    @property
    def starts_at_origin(self) -> bool:
        """True if world coordinates and road coordinates are the same."""
        return self._origin == (0.0, 0.0)

    def project(self, x: float, y: float, heading: float) -> tuple[float, float, float]:
        """Return the place along the road [m], to the right of lane 0's centre [m], and the angle to the road [rad]."""
        x0, y0 = self._origin
        return x - x0, y - y0, heading

    def position(self, longitudinal: float, lane: int, vehicle: VehicleType = CAR) -> Pose:
        """Return the pose of a point on the centre of a lane."""
        x0, y0 = self._origin
        return x0 + longitudinal, y0 + self.centre(lane), 0.0

    def cells(self, ego_lane: int) -> frozenset[Cell]:
        """Return the cells whose lane exists around an ego in the given lane."""
        return self._cells[ego_lane]

    def has_lane(self, lane: int, along: float) -> bool:
        """Return whether a lane exists, with room for an NPC at both ends of the road."""
        return 0 <= lane < self.lane_count and CAR.length < along < self.length - CAR.length

    def ego_start(self, headway: float, clearance: float) -> float:
        """Return the ego's place along the road at the start [m]."""
        return ego_start(headway, clearance)

    @property
    def start_lanes(self) -> range:
        """All lanes."""
        return range(self.lane_count)

    @property
    def said_of_start_lanes(self) -> tuple[str, str]:
        """What an error says of the ego's lane."""
        return f"a lane from 0 to {self.lane_count - 1}", f"the road has {self.lane_count} lanes"

    def start_cells(self, lane: int, distance: float) -> frozenset[Cell]:
        """Return the cells whose lane exists around an ego in the given lane."""
        return self._cells[lane]

    def director(self, scenario: Scenario, limits: NpcLimits, cells: frozenset[Cell], **common: Any) -> Director:
        """Make the director of the NPCs."""
        return Director(scenario, self.grid, limits, speed_limit=self.speed_limit, cells=self._cells, **common)

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
        """Make the places of the vehicles of a run, which follow from their coordinates alone."""
        return Places(vehicles, bodies, self.grid, *self._origin)

    def sensor(
        self,
        places: Places,
        record: Any,
        scenario: Scenario,
        rates: tuple[int, int],
        sight: Sight | None,
        ego: VehicleType,
    ) -> Sensor:
        """Make the maker of a planner's observations."""
        sizes = [(each.length, each.width) for each in places.vehicles]
        observer = Observer(record, sizes, self.grid, self.speed_limit, *rates, *self._origin)
        return observer if sight is None else ImperfectSensor(observer, sight, scenario.seed)
