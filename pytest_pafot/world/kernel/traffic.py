"""The ordinary traffic of highway-env on a straight road: vehicles that drive by IDM and MOBIL, and the crash test.

The equations are highway-env's (``IDMVehicle``, ``ControlledVehicle``, ``RoadObject.handle_collisions``). Positions are
equal except for rounding, because numpy's power and inverse trigonometric functions differ from C's in the last bit.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Mapping
from typing import Any

from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.idm import GoalVehicle
from pytest_pafot.world.kernel.lanes import Lanes
from pytest_pafot.world.kernel.observation import COLUMNS


class TrafficVehicle(GoalVehicle):
    """A vehicle of highway-env's ordinary traffic, or the ego in that traffic.

    Args:
        constants: the constants of the vehicle class, by name.
        lanes: the road's lanes.
        speed_limit: the speed limit of every lane [m/s].
        has_goal: true if it steers for a lane and a speed, its goal; else its controls are set from outside and held.
        drives_itself: true if it finds its goal and its acceleration by MOBIL and IDM; else the goal is set from
            outside, for instance by meta-actions.
        taken_for: the desired speed that others assume [m/s]. NaN stands for the speed of its goal, or without a goal
            for its current speed.

    Attributes:
        checks: true if it tests for crashes; a pair is tested if one of the two does.
        crashed: true if highway-env would flag it as crashed.
    """

    def __init__(
        self,
        constants: Mapping[str, float],
        lanes: Lanes,
        speed_limit: float,
        *,
        has_goal: bool,
        drives_itself: bool,
        taken_for: float,
    ) -> None:
        super().__init__(constants, lanes, speed_limit)
        self.checks = True
        self.crashed = False
        self._has_goal = has_goal
        self._drives_itself = drives_itself
        self._taken_for = taken_for
        self._is_led = self._is_pushed = False
        self._next_x = self._next_y = self._next_heading = self._next_speed = 0.0
        self._push_x = self._push_y = 0.0
        self._diagonal = math.hypot(self.length, self.width)

    def begin(self, goal: int, wanted: float, timer: float) -> None:
        """Set the lane and speed of its goal [m/s], and the time since its last decision on lanes [s].

        Call it after ``start``, which sets all three from the vehicle's position and speed.
        """
        self.aim(goal, wanted)
        self._timer = timer

    def lead(self, x: float, y: float, heading: float, speed: float) -> None:
        """Move to the given state in the next tick, whatever the controls are [m, m, rad, m/s]."""
        self._is_led = True
        self._next_x = x
        self._next_y = y
        self._next_heading = heading
        self._next_speed = speed

    def act(self, others: list[Any]) -> None:
        """Set acceleration and steering for the coming tick, unless they are set from outside."""
        if self._drives_itself and not self.crashed:
            GoalVehicle.act(self, others)
        elif self._has_goal and not self._drives_itself and not self._is_led:
            self.pursue()

    def step(self, dt: float) -> None:
        """Move for one time step [s]; a crashed vehicle stops, and a vehicle in a contact is pushed aside."""
        if self.crashed:
            self.steering = 0.0
            self.acceleration = -self.speed
        self._timer += dt
        if self._is_led:
            self.place(self._next_x, self._next_y, self._next_heading, self._next_speed)
        else:
            Body.step(self, dt)
        if self._is_pushed:
            self.x += self._push_x
            self.y += self._push_y
            self.crashed = True
            self._is_pushed = False
        self._closest = self._lanes.closest(self.x, self.y, self.heading)

    def _push(self, x: float, y: float) -> None:
        self._is_pushed = True
        self._push_x = x
        self._push_y = y

    def _choose_lane(self, others: list[Any]) -> None:
        if self._closest == self._goal:
            GoalVehicle._choose_lane(self, others)
            return
        for each in others:  # as in highway-env, it gives way to a vehicle ahead that enters the same lane
            other: TrafficVehicle = each
            if other is self or not other._has_goal or other._goal != self._goal:
                continue
            if other._closest != self._goal and 0.0 < other.x - self.x < self._desired_gap(self, other):
                self._goal = self._closest
                return

    def _liked(self, vehicle: Any) -> float:
        other: TrafficVehicle = vehicle
        if not math.isnan(other._taken_for):
            return other._taken_for
        return other._target_speed if other._has_goal else other.speed


class OrdinaryTraffic:
    """An episode of ordinary traffic up to its current tick.

    Args:
        vehicles: the vehicles at their starts, the ego first.
        record: a buffer for ``ticks + 1`` rows of all vehicles; their lanes are not written.
        dt: physics tick [s].

    Attributes:
        tick: the last recorded tick.
    """

    def __init__(self, vehicles: list[TrafficVehicle], record: array[float], dt: float) -> None:
        self.tick = 0
        self._vehicles = vehicles
        self._record = record
        self._dt = dt
        self._row = 0
        self._columns = COLUMNS
        self._note()

    def step(self) -> bool:
        """Let all vehicles act, move, and test for crashes, in the road's order; return whether the ego has crashed."""
        vehicles, dt = self._vehicles, self._dt
        for vehicle in vehicles:
            vehicle.act(vehicles)
        for vehicle in vehicles:
            vehicle.step(dt)
        count = len(vehicles)
        for index in range(count):
            vehicle = vehicles[index]
            for other_index in range(index + 1, count):
                other = vehicles[other_index]
                if vehicle.checks or other.checks:
                    _meet(vehicle, other, dt)
        self.tick += 1
        self._note()
        ego = vehicles[0]
        return ego.crashed

    def _note(self) -> None:
        """Record the state after a step, and the controls that led to it."""
        row, record, columns = self._row, self._record, self._columns
        for vehicle in self._vehicles:
            record[row] = vehicle.x
            record[row + 1] = vehicle.y
            record[row + 2] = vehicle.heading
            record[row + 3] = vehicle.speed
            record[row + 4] = vehicle.acceleration
            record[row + 5] = vehicle.steering
            row += columns
        self._row = row


def _meet(a: TrafficVehicle, b: TrafficVehicle, dt: float) -> None:
    """Flag two vehicles as crashed if they overlap, and push them apart if they will overlap within the next tick.

    The boxes are compared along the normals of their sides, in highway-env's order. If one box contains the other along
    a normal, the depth depends on the direction of the normal, as in highway-env.
    """
    dx, dy = a.x - b.x, a.y - b.y
    if math.sqrt(dx * dx + dy * dy) > (a._diagonal + b._diagonal) / 2.0 + a.speed * dt:
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
        a._push(push_x * least / 2.0, push_y * least / 2.0)
        b._push(-push_x * least / 2.0, -push_y * least / 2.0)
    if intersecting:
        a.crashed = b.crashed = True
