"""The ordinary traffic of highway-env: the ticks of its vehicles, and its test for crashes.

The equations are highway-env's (``Road.step``, ``RoadObject.handle_collisions``). Positions are equal except for
rounding, because on some processors numpy's power, trigonometric and inverse trigonometric functions and its products
of vectors differ from C's in the last bit.
"""

from __future__ import annotations

import math
from array import array
from typing import Any

from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.idm import GoalVehicle
from pytest_pafot.world.kernel.observation import COLUMNS
from pytest_pafot.world.kernel.road_rules import RoadRules


class OrdinaryTraffic:
    """An episode of ordinary traffic up to its current tick.

    Args:
        vehicles: the vehicles in the road's order.
        obstacles: the objects on the road.
        dt: physics tick [s].
        record: a buffer for ``ticks + 1`` rows of all vehicles; None if nothing reads it.
        rules: the rules of the road; None if there are none.

    Attributes:
        vehicles: the vehicles in the road's order; they may be replaced between two ticks if there is no record.
    """

    def __init__(
        self,
        vehicles: list[Any],
        obstacles: list[Any],
        dt: float,
        record: array[float] | None = None,
        rules: RoadRules | None = None,
    ) -> None:
        self.vehicles = vehicles
        self._obstacles = obstacles
        self._record = record
        self._rules = rules
        self._dt = dt
        self._row = 0
        self._columns = COLUMNS
        self._note()

    def step(self) -> None:
        """Let all vehicles act, move, and test for crashes, in the road's order."""
        vehicles, dt = self.vehicles, self._dt
        everything = vehicles + self._obstacles
        for vehicle in vehicles:
            vehicle.act(everything)
        if self._rules is not None and self._rules.is_due():
            self._rules.apply(vehicles)
        for vehicle in vehicles:
            vehicle.step(dt)
        count = len(vehicles)
        for index in range(count):
            vehicle = vehicles[index]
            for other_index in range(index + 1, count):
                other = vehicles[other_index]
                if vehicle.checks or other.checks:
                    _meet(vehicle, other, other, other.diagonal, dt)
            for obstacle in self._obstacles:
                _meet(vehicle, obstacle, None, obstacle.diagonal, dt)
        self._note()

    def _note(self) -> None:
        """Record the state after a step, and the controls that led to it."""
        if self._record is None:
            return
        row, record, columns = self._row, self._record, self._columns
        for vehicle in self.vehicles:
            record[row] = vehicle.x
            record[row + 1] = vehicle.y
            record[row + 2] = vehicle.heading
            record[row + 3] = vehicle.speed
            record[row + 4] = vehicle.acceleration
            record[row + 5] = vehicle.steering
            row += columns
        self._row = row


def _meet(a: GoalVehicle, b: Body, other: GoalVehicle | None, diagonal: float, dt: float) -> None:
    """Flag two vehicles as crashed if they overlap, and push them apart if they will overlap within the next tick.

    If ``b`` is an object on the road and not a vehicle, ``other`` is None, and only ``a`` is pushed. ``diagonal`` is
    that of ``b`` [m].

    The boxes are compared along the normals of their sides, in highway-env's order. If one box contains the other along
    a normal, the depth depends on the direction of the normal, as in highway-env.
    """
    dx, dy = a.x - b.x, a.y - b.y
    if math.sqrt(dx * dx + dy * dy) > (a.diagonal + diagonal) / 2.0 + a.speed * dt:
        return
    cos_a, sin_a = math.cos(a.heading), math.sin(a.heading)
    cos_b, sin_b = math.cos(b.heading), math.sin(b.heading)
    moved_x = (a.speed * cos_a - b.speed * cos_b) * dt
    moved_y = (a.speed * sin_a - b.speed * sin_b) * dt
    intersecting = will_intersect = True
    least, push_x, push_y = math.inf, 0.0, 0.0
    for side in range(8):
        nx, ny = (-cos_a, -sin_a) if side < 4 else (-cos_b, -sin_b)
        for turn in range(side % 4):  # noqa: B007  (typed for the compiler)
            nx, ny = ny, -nx
        half_a = (a.length * abs(nx * cos_a + ny * sin_a) + a.width * abs(ny * cos_a - nx * sin_a)) / 2.0
        half_b = (b.length * abs(nx * cos_b + ny * sin_b) + b.width * abs(ny * cos_b - nx * sin_b)) / 2.0
        centre, moved = nx * dx + ny * dy, nx * moved_x + ny * moved_y
        intersecting = intersecting and abs(centre) <= half_a + half_b
        low, high = centre - half_a + min(moved, 0.0), centre + half_a + max(moved, 0.0)
        apart = -half_b - high if low < -half_b else low - half_b
        will_intersect = will_intersect and apart <= 0.0
        if not (intersecting or will_intersect):
            return
        if abs(apart) < least:
            least = abs(apart)
            push_x, push_y = (nx, ny) if centre > 0.0 else (-nx, -ny)
    if will_intersect:
        shared = 1.0 if other is None else 2.0
        a.push(push_x * least / shared, push_y * least / shared)
        if other is not None:
            other.push(-push_x * least / shared, -push_y * least / shared)
    if intersecting:
        a.crashed = True
        if other is not None:
            other.crashed = True
