"""The IDMVehicle of highway-env on a straight road, operation by operation: Intelligent Driver Model and MOBIL.

Sources: Treiber, Hennecke, Helbing, "Congested traffic states in empirical observations and microscopic simulations",
Physical Review E 62, 2000; Kesting, Treiber, Helbing, "General lane-changing model MOBIL for car-following models",
Transportation Research Record 1999, 2007. For NPCs, which are no IDM vehicles, the model assumes that each desires its
current speed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from pytest_pafot.world.kernel.action import lane_steering, not_zero
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.driver import clamped
from pytest_pafot.world.kernel.lanes import Lanes

ON_LANE = 1.0
"""The distance beyond a lane's lines up to which a vehicle is still in the lane [m]."""
LANE_ENDS = 5.0
"""The distance beyond a lane's ends up to which a vehicle is still in the lane [m]."""


class IdmEgo(Body):
    """A vehicle that drives itself by IDM and MOBIL.

    Args:
        constants: the constants of the vehicle class, by name.
        lanes: the road's lanes.
        speed_limit: the speed limit of every lane [m/s].
    """

    def __init__(self, constants: Mapping[str, float], lanes: Lanes, speed_limit: float) -> None:
        super().__init__(constants["LENGTH"], constants["WIDTH"])
        self._lanes = lanes
        self._speed_limit = speed_limit
        self._acc_max = constants["ACC_MAX"]
        self._comfort = constants["COMFORT_ACC_MAX"]
        self._braking = constants["COMFORT_ACC_MIN"]
        self._distance = constants["DISTANCE_WANTED"]
        self._time = constants["TIME_WANTED"]
        self._delta = constants["DELTA"]
        self._politeness = constants["POLITENESS"]
        self._min_gain = constants["LANE_CHANGE_MIN_ACC_GAIN"]
        self._max_imposed = constants["LANE_CHANGE_MAX_BRAKING_IMPOSED"]
        self._delay = constants["LANE_CHANGE_DELAY"]
        self._kp_heading = constants["KP_HEADING"]
        self._kp_lateral = constants["KP_LATERAL"]
        self._max_steering = constants["MAX_STEERING_ANGLE"]
        self._changes_lanes = True
        self._closest = 0
        self._goal = 0
        self._target_speed = 0.0
        self._timer = 0.0

    def start(self, x: float, y: float, heading: float, speed: float, changes_lanes: bool) -> None:
        """Begin a run at x [m], y [m], heading [rad] and speed [m/s], which becomes the desired speed."""
        self.place(x, y, heading, speed)
        self._changes_lanes = changes_lanes
        self._closest = self._goal = self._lanes.closest(x, y, heading)
        self._target_speed = speed
        self._timer = ((x + y) * math.pi) % self._delay  # as in highway-env, so that not all vehicles decide at once

    def act(self, others: list[Body]) -> None:
        """Set acceleration and steering for the coming tick."""
        if self._changes_lanes:
            self._choose_lane(others)
        self.steering = self._steering()
        acceleration = self._pulled(self, _ahead(others, self, self._closest, self._lanes))
        if self._closest != self._goal:
            there = self._pulled(self, _ahead(others, self, self._goal, self._lanes))
            acceleration = min(acceleration, there)
        self.acceleration = min(max(acceleration, -self._acc_max), self._acc_max)

    def step(self, dt: float) -> None:
        """Move for one time step [s]."""
        self._timer += dt
        Body.step(self, dt)  # C methods have no super()
        self._closest = self._lanes.closest(self.x, self.y, self.heading)

    def _choose_lane(self, others: list[Body]) -> None:
        if self._closest != self._goal or self._timer <= self._delay:
            return
        self._timer = 0.0
        lane = self._closest
        for side in (lane - 1, lane + 1):
            if 0 <= side < self._lanes.count and self._reaches(side) and self._gains(side, others):
                self._goal = side

    def _reaches(self, lane: int) -> bool:
        lateral = abs(self.y - lane * self._lanes.width)
        inside = 0.0 <= self.x < self._lanes.length + LANE_ENDS
        return lateral <= 2.0 * self._lanes.width and inside and abs(self.speed) >= 1.0

    def _gains(self, lane: int, others: list[Body]) -> bool:
        """Return whether MOBIL advises a change to a lane."""
        ahead, behind = _ahead(others, self, lane, self._lanes), _behind(others, self, lane, self._lanes)
        behind_then = self._pulled(behind, self)
        if behind_then < -self._max_imposed:
            return False
        left, follower = (
            _ahead(others, self, self._closest, self._lanes),
            _behind(others, self, self._closest, self._lanes),
        )
        own_gain = self._pulled(self, ahead) - self._pulled(self, left)
        others_gain = (
            behind_then - self._pulled(behind, ahead) + self._pulled(follower, left) - self._pulled(follower, self)
        )
        return own_gain + self._politeness * others_gain >= self._min_gain

    def _pulled(self, vehicle: Body | None, front: Body | None) -> float:
        """Return the acceleration of a vehicle behind ``front`` by the IDM [m/s^2]; 0 if ``vehicle`` is None."""
        if vehicle is None:
            return 0.0
        liked = min(max(self._liked(vehicle), 0.0), self._speed_limit)
        share = max(vehicle.speed, 0.0) / abs(not_zero(liked))
        acceleration = self._comfort * (1.0 - math.pow(share, self._delta))
        if front is not None:
            gap = self._desired_gap(vehicle, front) / not_zero(front.x - vehicle.x)
            acceleration -= self._comfort * (gap * gap)
        return acceleration

    def _liked(self, vehicle: Body) -> float:
        """Return the desired speed of a vehicle, as far as this vehicle knows [m/s]."""
        return self._target_speed if vehicle is self else vehicle.speed

    def _desired_gap(self, vehicle: Body, front: Body) -> float:
        cos_h, sin_h = math.cos(vehicle.heading), math.sin(vehicle.heading)
        closing_x = vehicle.speed * cos_h - front.speed * math.cos(front.heading)
        closing_y = vehicle.speed * sin_h - front.speed * math.sin(front.heading)
        closing = closing_x * cos_h + closing_y * sin_h
        ab = -self._comfort * self._braking
        return self._distance + vehicle.speed * self._time + vehicle.speed * closing / (2.0 * math.sqrt(ab))

    def _steering(self) -> float:
        offset = self.y - self._goal * self._lanes.width
        angle = lane_steering(offset, self.heading, self.speed, self.length, self._kp_heading, self._kp_lateral)
        return clamped(angle, self._max_steering)


def _ahead(others: list[Body], mine: Body, lane: int, lanes: Lanes) -> Body | None:
    """Return the nearest vehicle ahead in a lane; if several are at the same place, the last of them."""
    found = None
    for other in others:
        if (
            other is not mine
            and other.x >= mine.x
            and (found is None or other.x <= found.x)
            and _is_on(other, lane, lanes)
        ):
            found = other
    return found


def _behind(others: list[Body], mine: Body, lane: int, lanes: Lanes) -> Body | None:
    """Return the nearest vehicle behind in a lane; if several are at the same place, the first of them."""
    found = None
    for other in others:
        if other.x < mine.x and (found is None or other.x > found.x) and _is_on(other, lane, lanes):
            found = other
    return found


def _is_on(vehicle: Body, lane: int, lanes: Lanes) -> bool:
    inside = -LANE_ENDS <= vehicle.x < lanes.length + LANE_ENDS
    return inside and abs(vehicle.y - lane * lanes.width) <= lanes.width / 2.0 + ON_LANE
