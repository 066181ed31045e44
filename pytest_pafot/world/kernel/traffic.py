"""highway-env's own traffic on a straight road: everybody drives by IDM and MOBIL, and highway-env's crash test.

The equations are highway-env's (``IDMVehicle``, ``ControlledVehicle``, ``RoadObject.handle_collisions``), whose
positions they meet within rounding: numpy's power and inverse trigonometric functions differ from C's in the last bit.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Mapping
from typing import Any

from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.idm import IdmEgo
from pytest_pafot.world.kernel.lanes import Lanes
from pytest_pafot.world.kernel.observation import COLUMNS


class TrafficVehicle(IdmEgo):
    """A vehicle of the traffic, or the ego in it.

    Args:
        constants: those of the vehicle class, by name.
        lanes: of the road.
        speed_limit: of every lane [m/s].
        has_goal: whether it steers for a lane and a speed; else its controls are set from outside and held.
        drives_itself: whether it finds its goal and its acceleration by MOBIL and IDM; else the goal is set from
            outside, as by meta-actions. One that is led somewhere does neither.
        taken_for: the speed that others take it to want [m/s]; NaN for that of its goal, or without one its own.

    Attributes:
        checks: whether it looks for crashes; a pair is looked at where one of the two does.
        crashed: whether highway-env has flagged it.
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
        self._kp_speed = constants["KP_A"]
        self._is_led = self._is_pushed = False
        self._next_x = self._next_y = self._next_heading = self._next_speed = 0.0
        self._push_x = self._push_y = 0.0
        self._diagonal = math.hypot(self.length, self.width)

    def begin(self, goal: int, wanted: float, timer: float) -> None:
        """After ``start``: on the way to a lane and a speed [m/s], so long after it thought of changing lanes [s]."""
        self.aim(goal, wanted)
        self._timer = timer

    def aim(self, goal: int, wanted: float) -> None:
        """Go on to a lane, with a speed [m/s]."""
        self._goal = goal
        self._target_speed = wanted

    def lead(self, x: float, y: float, heading: float, speed: float) -> None:
        """Go there in the next tick [m, m, rad, m/s], in the place of what controls would do."""
        self._is_led = True
        self._next_x = x
        self._next_y = y
        self._next_heading = heading
        self._next_speed = speed

    def seen(self) -> tuple[float, float, float, float, int, int]:
        """Its x [m], y [m], heading [rad] and speed [m/s], its lane, and the one that it is on its way to."""
        return self.x, self.y, self.heading, self.speed, self._closest, self._goal

    def act(self, others: list[Any]) -> None:
        """Decide on acceleration and steering, unless they are given."""
        if self._drives_itself and not self.crashed:
            IdmEgo.act(self, others)
        elif self._has_goal and not self._drives_itself and not self._is_led:
            self.steering = self._steering()
            self.acceleration = self._kp_speed * (self._target_speed - self.speed)

    def step(self, dt: float) -> None:
        """Let time pass [s]: after a crash out of control, and pushed off whom it would have run into."""
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
            IdmEgo._choose_lane(self, others)
            return
        for each in others:  # a lane change is given up for another who is on its way into the same lane ahead
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
    """An episode as far as it has come.

    Args:
        vehicles: at their starts, the ego first.
        record: room for ``ticks + 1`` rows of all vehicles.
        dt: physics tick [s].

    Attributes:
        tick: the last one that is recorded.
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
        """Everybody acts, moves and meets the others, in the order of the road; whether the ego is flagged now."""
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
            record[row + 6] = vehicle._closest
            row += columns
        self._row = row


def _meet(a: TrafficVehicle, b: TrafficVehicle, dt: float) -> None:
    """Flag two vehicles that overlap as crashed; push those apart that will within the next tick, by their velocities.

    Boxes are told apart by the normals of their sides, in highway-env's order. A box that contains the other one along
    a normal is as deep in it as highway-env has it, which depends on the direction of the normal.
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
