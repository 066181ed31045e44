"""highway-env's controlled vehicles, including vehicles with the Intelligent Driver Model (IDM) and MOBIL.

:class:`GoalVehicle` replaces highway-env's ``ControlledVehicle``, ``MDPVehicle`` and ``IDMVehicle`` on straight roads,
and :class:`NetworkVehicle` replaces them on any road. The equations equal highway-env's, operation by operation. NPCs
are not IDM vehicles, so the model takes their current speed as their desired speed.

Sources: Treiber, Hennecke, Helbing, "Congested traffic states in empirical observations and microscopic simulations",
Physical Review E 62, 2000; Kesting, Treiber, Helbing, "General lane-changing model MOBIL for car-following models",
Transportation Research Record 1999, 2007.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from pytest_pafot.world.kernel.action import lane_steering, not_zero
from pytest_pafot.world.kernel.crossing import CrossingNpc
from pytest_pafot.world.kernel.driver import clamp
from pytest_pafot.world.kernel.lane_network import Network
from pytest_pafot.world.kernel.lanes import Bends, Body, Lanes, Places

# distance outside a lane's lines within which a vehicle still counts as in the lane [m]
ON_LANE = 1.0
# distance past a lane's ends within which a vehicle still counts as in the lane [m]
LANE_ENDS = 5.0
NOWHERE = float("nan")
PURSUIT = 0.1  # time by which a vehicle looks ahead along its lane to steer [s]
# number of moments at which highway-env predicts vehicles, and time between them [s]
MOMENTS = 11
APART = 0.25
# factors for a vehicle's length and width in these predictions
LONGER = 1.5
NARROWER = 0.9


class GoalVehicle(Body):
    """A vehicle that drives towards a target lane and a target speed, which IDM and MOBIL can choose."""

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
        self.closest = 0  # nearest lane after the last step
        self.goal = 0  # target lane
        self.target_speed = 0.0
        self.timer = 0.0  # time since the last decision about lanes [s]
        self._routed = -1  # lane that the route requires, counted from the left; -1 for none

    def start(
        self,
        x: float,
        y: float,
        heading: float,
        speed: float,
        changes_lanes: bool,
    ) -> None:
        """Start a run at x [m], y [m], heading [rad] and speed [m/s]. The speed is also the desired speed."""
        self.place(x, y, heading, speed)
        self._changes_lanes = changes_lanes
        self.closest = self.goal = self._find_lane(self)
        self.target_speed = speed
        # as in highway-env, so that vehicles decide at different times
        self.timer = ((x + y) * math.pi) % self._delay

    def pursue(self) -> None:
        """Set the controls for the coming tick so that the vehicle pursues its goal, regardless of other vehicles."""
        self._follow_road()
        self.steering = self._steering()
        self.acceleration = self._kp_speed * (self.target_speed - self.speed)

    def act(self, others: list[Body]) -> None:
        """Set the controls for the coming tick, with IDM and MOBIL if the vehicle drives itself."""
        # its goal or its controls are set from outside, for example by meta-actions
        if not self.drives_itself:
            if self.has_goal:
                self.pursue()
            return
        self._follow_road()
        if self._changes_lanes:
            self._choose_lane(others)
        self.steering = self._steering()
        acceleration = self._idm(self, self._ahead(others, self.closest))
        # during a lane change, it brakes for the vehicle ahead in either lane
        if self.closest != self.goal:
            there = self._idm(self, self._ahead(others, self.goal))
            acceleration = min(acceleration, there)
        self.acceleration = min(max(acceleration, -self._acc_max), self._acc_max)

    def step(self, dt: float) -> None:
        self.timer += dt
        Body.step(self, dt)  # C methods have no super()
        self.closest = self._find_lane(self)

    # NetworkVehicle overrides most of the following methods.

    def _find_lane(self, vehicle: Body) -> int:
        return self._lanes.closest(vehicle.x, vehicle.y, vehicle.heading)

    def _follow_road(self) -> None:
        """At the end of a lane, switch to the next lane."""

    def _is_demanded(self, lane: int) -> bool:
        # Whether a lane is on the side that the route requires.
        return False

    def _has_beside(self, lane: int, side: int) -> bool:
        return 0 <= side < self._lanes.count

    def _choose_lane(self, others: list[Body]) -> None:
        if self.closest != self.goal or self.timer <= self._delay:
            return
        self.timer = 0.0
        lane = self.closest
        for side in (lane - 1, lane + 1):
            if self._has_beside(lane, side) and self._reaches(side) and self._gains(side, others):
                self.goal = side

    def _reaches(self, lane: int) -> bool:
        lateral = abs(self.y - lane * self._lanes.width)
        inside = 0.0 <= self.x < self._lanes.length + LANE_ENDS
        return lateral <= 2.0 * self._lanes.width and inside and abs(self.speed) >= 1.0

    def _gains(self, lane: int, others: list[Body]) -> bool:
        """Return whether MOBIL recommends changing to a lane."""
        ahead = self._ahead(others, lane)
        behind = self._behind(others, lane)
        # the new follower must not brake hard, even if a route requires it
        behind_then = self._idm(behind, self)
        if behind_then < -self._max_imposed:
            return False
        left = self._ahead(others, self.closest)
        follower = self._behind(others, self.closest)
        own = self._idm(self, ahead)
        if self._routed >= 0:
            return self._is_demanded(lane) and own >= -self._max_imposed
        # Kesting et al. 2007: the gain of this vehicle, plus the gain of both followers weighted by politeness
        own_gain = own - self._idm(self, left)
        others_gain = (
            behind_then
            - self._idm(behind, ahead)
            + self._idm(follower, left)
            - self._idm(follower, self)
        )
        return own_gain + self._politeness * others_gain >= self._min_gain

    def _idm(self, vehicle: Body | None, front: Body | None) -> float:
        # The acceleration [m/s^2] of a vehicle behind `front` according to IDM.
        if vehicle is None:
            return 0.0
        # other vehicles are assumed to desire their current speed
        wanted = vehicle.speed
        if vehicle is self:
            wanted = self.target_speed
        liked = min(max(wanted, 0.0), self._speed_limit_of(vehicle))
        share = max(vehicle.speed, 0.0) / abs(not_zero(liked))
        # Treiber et al. 2000: free road, then the interaction with the vehicle in front
        acceleration = self._comfort * (1.0 - math.pow(share, self._delta))
        if front is not None:
            gap = self._desired_gap(vehicle, front) / not_zero(self._distance_to(vehicle, front))
            acceleration -= self._comfort * (gap * gap)
        return acceleration

    def _distance_to(self, vehicle: Body, front: Body) -> float:
        return front.x - vehicle.x

    def _speed_limit_of(self, vehicle: Body) -> float:
        return self._speed_limit

    def _desired_gap(self, vehicle: Body, front: Body) -> float:
        cos_h = math.cos(vehicle.heading)
        sin_h = math.sin(vehicle.heading)
        closing_x = vehicle.speed * cos_h - front.speed * math.cos(front.heading)
        closing_y = vehicle.speed * sin_h - front.speed * math.sin(front.heading)
        closing = closing_x * cos_h + closing_y * sin_h
        ab = -self._comfort * self._braking
        return (
            self._distance
            + vehicle.speed * self._time
            + vehicle.speed * closing / (2.0 * math.sqrt(ab))
        )

    def _steering(self) -> float:
        offset = self.y - self.goal * self._lanes.width
        angle = lane_steering(
            offset,
            0.0,
            self.heading,
            self.speed,
            self.length,
            self._kp_heading,
            self._kp_lateral,
        )
        return clamp(angle, self._max_steering)

    def _ahead(self, others: list[Body], lane: int) -> Body | None:
        """Return the nearest vehicle ahead in a lane. If several are at the same position, return the last one."""
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
        """Return the nearest vehicle behind in a lane. If several are at the same position, return the first one."""
        found = None
        for other in others:
            if (
                other.x < self.x
                and (found is None or other.x > found.x)
                and _is_on(other, lane, self._lanes)
            ):
                found = other
        return found


def _is_on(vehicle: Body, lane: int, lanes: Lanes) -> bool:
    inside = -LANE_ENDS <= vehicle.x < lanes.length + LANE_ENDS
    return inside and abs(vehicle.y - lane * lanes.width) <= lanes.width / 2.0 + ON_LANE


class StaticObstacle(Body):
    """A stationary object on the road, behind which vehicles stop."""


class NetworkVehicle(GoalVehicle):
    """A :class:`GoalVehicle` on a road of any shape.

    ``following`` receives a lane and a vehicle's x [m] and y [m]. It returns the next lane, and the number from the
    left of the lane that the route then requires, or -1. ``route`` receives a lane and returns the remaining lanes of
    the route.
    """

    def __init__(
        self,
        constants: Mapping[str, float],
        network: Network,
        following: Callable[[int, float, float], tuple[int, int]],
        routed: int,
        route: Callable[[int], list[int]],
        searched: Sequence[Sequence[tuple[int, float]]],
    ) -> None:
        super().__init__(constants, Lanes(1, 1.0, 1.0), 0.0)
        self._network = network
        self._following = following
        self._routed = routed
        self._route = route
        self._searched = list(searched)

    def route(self) -> list[int]:
        return self._route(self.closest)

    def _find_lane(self, vehicle: Body) -> int:
        return self._network.closest(vehicle.x, vehicle.y, vehicle.heading)

    def _follow_road(self) -> None:
        if self._network.is_after_end(self.goal, self.x, self.y):
            self.goal, self._routed = self._following(self.goal, self.x, self.y)

    def _has_beside(self, lane: int, side: int) -> bool:
        return self._network.is_beside(lane, side)

    def _reaches(self, lane: int) -> bool:
        return self._network.is_reachable(lane, self.x, self.y) and abs(self.speed) >= 1.0

    def _is_demanded(self, lane: int) -> bool:
        number = self._network.numbers[self.goal]
        if lane < self.goal:
            return self._routed < number
        return self._routed > number

    def _idm(self, vehicle: Body | None, front: Body | None) -> float:
        if isinstance(vehicle, StaticObstacle):
            return 0.0
        return GoalVehicle._idm(self, vehicle, front)

    def _distance_to(self, vehicle: Body, front: Body) -> float:
        network = self._network
        lane = self._lane_of(vehicle)
        network.locate(lane, front.x, front.y)
        there = network.along
        network.locate(lane, vehicle.x, vehicle.y)
        return there - network.along

    def _speed_limit_of(self, vehicle: Body) -> float:
        return self._network.speed_limits[self._lane_of(vehicle)]

    def _lane_of(self, vehicle: Body) -> int:
        if vehicle is self:
            return self.closest
        return self._find_lane(vehicle)

    def _steering(self) -> float:
        network = self._network
        goal = self.goal
        network.locate(goal, self.x, self.y)
        offset = network.across
        ahead = network.heading_at(goal, network.along + self.speed * PURSUIT)
        angle = lane_steering(
            offset,
            ahead,
            self.heading,
            self.speed,
            self.length,
            self._kp_heading,
            self._kp_lateral,
        )
        return clamp(angle, self._max_steering)

    def _ahead(self, others: list[Any], lane: int) -> Body | None:
        found = None
        nearest = math.inf
        self._network.locate(lane, self.x, self.y)
        own = self._network.along
        for other in others:
            along = self._along(lane, other)
            if own <= along <= nearest and other is not self:  # also false for NaN
                nearest = along
                found = other
        return found

    def _behind(self, others: list[Any], lane: int) -> Body | None:
        found = None
        nearest = -math.inf
        self._network.locate(lane, self.x, self.y)
        own = self._network.along
        for other in others:
            along = self._along(lane, other)
            if nearest < along < own and other is not self:  # also false for NaN
                nearest = along
                found = other
        return found

    def _along(self, lane: int, other: Body) -> float:
        # A vehicle's position [m] along a lane, or NaN if the vehicle is on none of the searched lanes.
        network = self._network
        for each, begins in self._searched[lane]:
            if network.is_on(each, other.x, other.y, ON_LANE):
                return network.along + begins
        return NOWHERE


class EgosRoadRules:
    """The right-of-way rules of highway-env's ``RegulatedRoad``, which only an ego with IDM follows."""

    def __init__(
        self,
        ego: NetworkVehicle,
        places: Places,
        bends: Bends,
        network: Network,
        priorities: Sequence[int],
        steps: int,
        every: int,
        lasts: float,
    ) -> None:
        self._ego = ego
        self._places = places
        self._bends = bends
        self._network = network
        self._priorities = array("i", priorities)
        self._steps = steps
        self._every = every
        self._lasts = lasts
        # x, y and heading at each moment, for ego and NPC
        self._predicted = array("d", [0.0]) * (6 * MOMENTS)

    def apply_to_ego(self) -> None:
        """Count a step of the road. If a decision is due, make the ego yield or continue."""
        self._steps += 1
        if self._steps % self._every:
            return
        ego = self._ego
        self._release(ego)
        self._predict(ego)
        for number in range(1, len(self._places.vehicles)):
            npc = self._places.vehicles[number]
            for moment in range(MOMENTS):
                self._foresee_npc(
                    3 * (MOMENTS + moment),
                    self._places.bodies[number],
                    APART * (moment + 1),
                )
            if self._conflict(ego, npc) and self._comes_second(ego, npc):
                ego.target_speed = 0.0
                ego.waited = 0

    def _release(self, vehicle: NetworkVehicle) -> None:
        if vehicle.waited >= self._lasts:
            vehicle.target_speed = self._network.speed_limits[vehicle.closest]
            vehicle.waited = -1
        elif vehicle.waited >= 0:
            vehicle.waited += 1

    def _predict(self, vehicle: NetworkVehicle) -> None:
        network = self._network
        route = vehicle.route()
        network.locate(vehicle.closest, vehicle.x, vehicle.y)
        here = network.along
        for moment in range(MOMENTS):
            along = here + vehicle.speed * (APART * (moment + 1))
            place = 0
            at: int = route[0]
            while place < len(route) - 1 and along > network.lengths[at]:
                along -= network.lengths[at]
                place += 1
                at = route[place]
            network.position(at, along, 0.0)
            self._foresee(3 * moment, network.x, network.y, network.heading_at(at, along))

    def _foresee(
        self,
        row: int,
        x: float,
        y: float,
        heading: float,
    ) -> None:
        self._predicted[row] = x
        self._predicted[row + 1] = y
        self._predicted[row + 2] = heading

    def _conflict(self, one: Body, other: Body) -> bool:
        row = 0
        its_row = 3 * MOMENTS
        for _ in range(MOMENTS):
            dx = self._predicted[its_row] - self._predicted[row]
            dy = self._predicted[its_row + 1] - self._predicted[row + 1]
            if math.sqrt(dx * dx + dy * dy) <= one.length and (
                self._has_corner_inside(one, row, other, its_row)
                or self._has_corner_inside(other, its_row, one, row)
            ):
                return True
            row += 3
            its_row += 3
        return False

    def _has_corner_inside(
        self,
        one: Body,
        row: int,
        other: Body,
        its_row: int,
    ) -> bool:
        """Return whether a corner, a side's midpoint or the centre of one box is inside another, as in highway-env."""
        predicted = self._predicted
        cos = math.cos(predicted[row + 2])
        sin = math.sin(predicted[row + 2])
        its_cos = math.cos(predicted[its_row + 2])
        its_sin = math.sin(predicted[its_row + 2])
        for along in range(-1, 2):
            for across in range(-1, 2):
                ahead = along * (LONGER * one.length / 2.0)
                aside = across * (NARROWER * one.width / 2.0)
                dx = cos * ahead - sin * aside + predicted[row] - predicted[its_row]
                dy = sin * ahead + cos * aside + predicted[row + 1] - predicted[its_row + 1]
                turned_x = its_cos * dx - its_sin * dy
                turned_y = its_sin * dx + its_cos * dy
                if (
                    abs(turned_x) <= LONGER * other.length / 2.0
                    and abs(turned_y) <= NARROWER * other.width / 2.0
                ):
                    return True
        return False

    def _comes_second(self, one: NetworkVehicle, other: Body) -> bool:
        # Whether a vehicle must yield to another vehicle that has a higher priority or is ahead.
        mine = self._priorities[one.closest]
        theirs = self._priorities[one._lane_of(other)]
        if mine != theirs:
            return mine < theirs
        dx = other.x - one.x
        dy = other.y - one.y
        ahead = math.cos(one.heading) * dx + math.sin(one.heading) * dy
        return ahead > -(math.cos(other.heading) * dx + math.sin(other.heading) * dy)

    def _foresee_npc(self, row: int, body: Body, time: float) -> None:
        along = body.x + body.speed * time
        bends = self._bends
        npc: Any = body
        x, y, heading = (
            npc.track.pose(along) if isinstance(body, CrossingNpc) else bends.pose(body.lane, along)
        )
        self._foresee(row, x, y, heading)
