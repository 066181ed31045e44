"""highway-env's vehicles with a goal, operation by operation; some find it by Intelligent Driver Model and MOBIL.

:class:`GoalVehicle` is highway-env's ``ControlledVehicle``, ``MDPVehicle`` and ``IDMVehicle`` on a straight road;
:class:`pytest_pafot.world.kernel.network_vehicle.NetworkVehicle` is the same on any road.

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


class GoalVehicle(Body):
    """A vehicle that steers for a lane and drives at a speed, its goal, which it may find itself by IDM and MOBIL.

    Args:
        constants: the constants of the vehicle class, by name.
        lanes: the road's lanes.
        speed_limit: the speed limit of every lane [m/s].

    Attributes:
        has_goal: true if it steers for a lane and a speed, its goal; else its controls are set from outside and held.
        drives_itself: true if it finds its goal and its acceleration by MOBIL and IDM; else the goal is set from
            outside, for instance by meta-actions.
        timer: the time since its last decision on lanes [s].
        waited: the number of decisions of the road's rules for which it has yielded; -1 if it does not yield.
    """

    def __init__(self, constants: Mapping[str, float], lanes: Lanes, speed_limit: float) -> None:
        super().__init__(constants["LENGTH"], constants["WIDTH"])
        self.has_goal = self.drives_itself = True
        self.waited = -1
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
        self._kp_speed = constants["KP_A"]
        self._changes_lanes = True
        self._closest = 0
        self._goal = 0
        self._target_speed = 0.0
        self.timer = 0.0
        self._routed = -1  # the lane that a route demands, counted from the left; -1 for none

    def start(self, x: float, y: float, heading: float, speed: float, changes_lanes: bool) -> None:
        """Begin a run at x [m], y [m], heading [rad] and speed [m/s], which becomes the desired speed."""
        self.place(x, y, heading, speed)
        self._changes_lanes = changes_lanes
        self._closest = self._goal = self._found(self)
        self._target_speed = speed
        self.timer = ((x + y) * math.pi) % self._delay  # as in highway-env, so that not all vehicles decide at once

    def aim(self, goal: int, wanted: float) -> None:
        """Set the lane and speed of its goal [m/s]."""
        self._goal = goal
        self._target_speed = wanted

    def want(self, speed: float) -> None:
        """Set the speed of its goal [m/s]."""
        self._target_speed = speed

    def stay(self, lane: int) -> None:
        """Be in a lane until the next step, although another one may be closer."""
        self._closest = lane

    def seen(self) -> tuple[float, float, float, float, int, int, float, float]:
        """Return x [m], y [m], heading [rad], speed [m/s], its lane, its goal's lane and speed, and its timer [s]."""
        return self.x, self.y, self.heading, self.speed, self._closest, self._goal, self._target_speed, self.timer

    def pursue(self) -> None:
        """Set acceleration and steering for the coming tick towards the goal, whatever others do."""
        self._follow_road()
        self.steering = self._steering()
        self.acceleration = self._kp_speed * (self._target_speed - self.speed)

    def act(self, others: list[Body]) -> None:
        """Set acceleration and steering for the coming tick, by IDM and MOBIL if it drives itself."""
        if not self.drives_itself:
            if self.has_goal:
                self.pursue()
            return
        self._follow_road()
        if self._changes_lanes:
            self._choose_lane(others)
        self.steering = self._steering()
        acceleration = self._pulled(self, self._ahead(others, self._closest))
        if self._closest != self._goal:
            there = self._pulled(self, self._ahead(others, self._goal))
            acceleration = min(acceleration, there)
        self.acceleration = min(max(acceleration, -self._acc_max), self._acc_max)

    def step(self, dt: float) -> None:
        """Move for one time step [s]."""
        self.timer += dt
        Body.step(self, dt)  # C methods have no super()
        self._closest = self._found(self)

    # What a road of another shape replaces.

    def _found(self, vehicle: Body) -> int:
        """Return the lane that is closest to a vehicle."""
        return self._lanes.closest(vehicle.x, vehicle.y, vehicle.heading)

    def _follow_road(self) -> None:
        """Take the next lane at the end of a lane; this road has none."""

    def _is_demanded(self, lane: int) -> bool:
        """Return whether a lane is towards the one that the route demands; this road has no routes."""
        return False

    def _has_beside(self, lane: int, side: int) -> bool:
        """Return whether a lane is next to another one."""
        return 0 <= side < self._lanes.count

    def _choose_lane(self, others: list[Body]) -> None:
        if self._closest != self._goal or self.timer <= self._delay:
            return
        self.timer = 0.0
        lane = self._closest
        for side in (lane - 1, lane + 1):
            if self._has_beside(lane, side) and self._reaches(side) and self._gains(side, others):
                self._goal = side

    def _reaches(self, lane: int) -> bool:
        lateral = abs(self.y - lane * self._lanes.width)
        inside = 0.0 <= self.x < self._lanes.length + LANE_ENDS
        return lateral <= 2.0 * self._lanes.width and inside and abs(self.speed) >= 1.0

    def _gains(self, lane: int, others: list[Body]) -> bool:
        """Return whether MOBIL advises a change to a lane."""
        ahead, behind = self._ahead(others, lane), self._behind(others, lane)
        behind_then = self._pulled(behind, self)
        if behind_then < -self._max_imposed:
            return False
        left, follower = self._ahead(others, self._closest), self._behind(others, self._closest)
        own = self._pulled(self, ahead)
        if self._routed >= 0:
            return self._is_demanded(lane) and own >= -self._max_imposed
        own_gain = own - self._pulled(self, left)
        others_gain = (
            behind_then - self._pulled(behind, ahead) + self._pulled(follower, left) - self._pulled(follower, self)
        )
        return own_gain + self._politeness * others_gain >= self._min_gain

    def _pulled(self, vehicle: Body | None, front: Body | None) -> float:
        """Return the acceleration of a vehicle behind ``front`` by the IDM [m/s^2]; 0 if ``vehicle`` is None."""
        if vehicle is None:
            return 0.0
        wanted = self._target_speed if vehicle is self else vehicle.speed
        liked = min(max(wanted, 0.0), self._limit(vehicle))
        share = max(vehicle.speed, 0.0) / abs(not_zero(liked))
        acceleration = self._comfort * (1.0 - math.pow(share, self._delta))
        if front is not None:
            gap = self._desired_gap(vehicle, front) / not_zero(self._apart(vehicle, front))
            acceleration -= self._comfort * (gap * gap)
        return acceleration

    def _apart(self, vehicle: Body, front: Body) -> float:
        """Return the distance to another vehicle along the lane [m]."""
        return front.x - vehicle.x

    def _limit(self, vehicle: Body) -> float:
        """Return the speed limit of a vehicle's lane [m/s]."""
        return self._speed_limit

    def _desired_gap(self, vehicle: Body, front: Body) -> float:
        cos_h, sin_h = math.cos(vehicle.heading), math.sin(vehicle.heading)
        closing_x = vehicle.speed * cos_h - front.speed * math.cos(front.heading)
        closing_y = vehicle.speed * sin_h - front.speed * math.sin(front.heading)
        closing = closing_x * cos_h + closing_y * sin_h
        ab = -self._comfort * self._braking
        return self._distance + vehicle.speed * self._time + vehicle.speed * closing / (2.0 * math.sqrt(ab))

    def _steering(self) -> float:
        offset = self.y - self._goal * self._lanes.width
        angle = lane_steering(offset, 0.0, self.heading, self.speed, self.length, self._kp_heading, self._kp_lateral)
        return clamped(angle, self._max_steering)

    def _ahead(self, others: list[Body], lane: int) -> Body | None:
        """Return the nearest vehicle ahead in a lane; if several are at the same place, the last of them."""
        found = None
        for other in others:
            if (
                other is not self
                and other.x >= self.x
                and (found is None or other.x <= found.x)
                and _is_on(other, lane, self._lanes)
            ):
                found = other
        return found

    def _behind(self, others: list[Body], lane: int) -> Body | None:
        """Return the nearest vehicle behind in a lane; if several are at the same place, the first of them."""
        found = None
        for other in others:
            if other.x < self.x and (found is None or other.x > found.x) and _is_on(other, lane, self._lanes):
                found = other
        return found


def _is_on(vehicle: Body, lane: int, lanes: Lanes) -> bool:
    inside = -LANE_ENDS <= vehicle.x < lanes.length + LANE_ENDS
    return inside and abs(vehicle.y - lane * lanes.width) <= lanes.width / 2.0 + ON_LANE
