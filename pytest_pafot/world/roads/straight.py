"""The straight road in the grid's coordinates: positions along the road and across its lanes.

A road maps world coordinates to (longitudinal, lateral, heading relative to the road). Every other road is a
:class:`~pytest_pafot.world.roads.network.NetworkRoad`; who needs more of a road than both have asks for its class.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from pytest_pafot.model.grid import Cell
from pytest_pafot.model.trace import Lane
from pytest_pafot.world.kernel.lanes import Lanes


@dataclass(frozen=True)
class StraightRoad:
    """Parallel straight lanes of equal width along the x axis, lane 0 at the left (smallest y).

    Attributes:
        lanes: the lanes from the left, at least one.
        lane_width: the width of every lane [m].
        speed_limit: the speed limit of the fastest lane [m/s].
        grid: the lanes in road coordinates.
    """

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
    def starts_at_origin(self) -> bool:
        """True if world coordinates and road coordinates are the same."""
        return self._origin == (0.0, 0.0)

    def project(self, x: float, y: float, heading: float) -> tuple[float, float, float]:
        """Return the place along the road [m], to the right of lane 0's centre [m], and the angle to the road [rad]."""
        x0, y0 = self._origin
        return x - x0, y - y0, heading

    def position(self, longitudinal: float, lane: int) -> tuple[float, float, float]:
        """Return world x [m], y [m] and heading [rad] of a point on the centre of a lane."""
        x0, y0 = self._origin
        return x0 + longitudinal, y0 + self.centre(lane), 0.0

    def seen_at(self, x: float, y: float, ego: object) -> tuple[float, float]:
        """Return world x and y of a place in the coordinates that a planner observes [m]."""
        return x + self._origin[0], y + self._origin[1]

    def centre(self, lane: int) -> float:
        """Return the position of a lane's centre across the road [m]."""
        return lane * self.lane_width

    def cells(self, ego_lane: int) -> frozenset[Cell]:
        """Return the cells whose lane exists around an ego in the given lane."""
        return self._cells[ego_lane]
