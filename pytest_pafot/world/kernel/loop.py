# cython: boundscheck=False, initializedcheck=False, wraparound=False, auto_pickle=False
# Bounds are not checked, because `_note` makes one check for all values of a tick.
"""The loop that simulates a run, for every kind of road and ego.

In each tick, the ego's driver makes a decision if one is due, and sets the ego's controls. The director then sets the
controls of the NPCs, which see the ego at its position in the last tick. Next, all vehicles move and are recorded.
Contacts are checked last, so the last row of a record contains the contact. Row 0 contains the start.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, cast

from pytest_pafot.model.trace import AdsError
from pytest_pafot.model.vehicle_type import VehicleType
from pytest_pafot.support.errors import BadAction, OutOfTime
from pytest_pafot.world.guard.hang_guard import UNFIT, HangGuard, error_of
from pytest_pafot.world.kernel.action import (
    LaneCommand,
    acceleration_to_speed,
    checked_si_action,
    possible_acceleration,
    possible_steering,
    without_reversing,
)
from pytest_pafot.world.kernel.driver import LaneTracker
from pytest_pafot.world.kernel.idm import EgosRoadRules, GoalVehicle
from pytest_pafot.world.kernel.lanes import COLUMNS, Body, Box, Places, overlap
from pytest_pafot.world.kernel.observation import Sensor


class EgoDriver:
    """The base class of drivers that control the ego in one run."""

    def __init__(self, ego: Body, every: int) -> None:
        self.ego = ego
        self.every = every  # ticks from one decision to the next
        self.actions: list[Any] = []
        self.slowest = 0.0  # duration of the longest decision [s]

    def decide(self, tick: int) -> AdsError | None:
        """Call the ADS for its next decision, and return the error that it raised, or None.

        A driver without an ADS does nothing.
        """
        return None

    def actuate(self) -> None:
        """Set the ego's controls for the coming tick."""

    def step(self, dt: float) -> AdsError | None:
        """Move the ego by one tick of ``dt`` seconds, and return the ADS's error, or None."""
        self.ego.step(dt)
        return None


class ModelDriver(EgoDriver):
    """The driver of an ego that a driver model controls at every tick.

    The model reacts to the vehicles and objects in ``others``, and follows the road's ``rules``, if any.
    """

    def __init__(
        self, ego: GoalVehicle, others: list[Any], rules: EgosRoadRules | None = None
    ) -> None:
        super().__init__(ego, 1)
        self.model = ego
        self.others = others
        self.rules = rules

    def actuate(self) -> None:
        self.model.act(self.others)

    def step(self, dt: float) -> AdsError | None:
        if self.rules is not None:
            self.rules.apply_to_ego()
        self.model.step(dt)
        return None


class GivenDriver(EgoDriver):
    """A driver that executes decisions: acceleration [m/s^2] and steering angle [rad], or a :class:`LaneCommand`."""

    def __init__(
        self,
        ego: Body,
        place: Body,
        sensor: Sensor,
        *,
        lanes: int,
        lane_width: float,
        every: int,
        dt: float,
        kind: VehicleType | None = None,
    ) -> None:
        super().__init__(ego, every)
        # the ego in road coordinates; this is `ego` if the road starts at the world's origin
        self._place = place
        self._sensor = sensor
        self._lanes = lanes
        self._lane_width = lane_width
        self._dt = dt
        self._kind = kind  # the ego's type of vehicle if that type limits the ego, else None
        self._wanted = 0.0
        self._lane = -1  # target lane; -1 if the decision is a pair
        self._speed = -1.0  # target speed [m/s]; negative if the decision has an acceleration
        self._angle = 0.0  # steering angle, without the angle for following a bend [rad]
        self._tracker = LaneTracker(ego.length, dt)
        self._most = self._jerk = 0.0  # lateral limits of a LaneCommand

    def observe(self, tick: int) -> Any:
        return self._sensor.observation(tick)

    def take(self, action: Any, seconds: float) -> None:
        """Check and apply an action, for which the ADS took ``seconds``.

        Raises:
            BadAction: if the action is invalid.
        """
        checked = checked_si_action(action, self._lanes)
        sensor = self._sensor
        self._speed = -1.0
        if type(checked) is tuple:  # faster than isinstance
            acceleration, steering = checked  # faster than two indices
            self._lane = -1
            self._wanted = possible_acceleration(acceleration)
            self._steer(possible_steering(steering))
        else:
            command = cast("LaneCommand", checked)
            if not sensor.has_lane(command.lane):
                raise BadAction(
                    f"expected pafot.LaneCommand with a lane that exists at {sensor.along:.0f} m, received {command}"
                )
            self._most = command.lateral_acceleration
            self._jerk = command.lateral_jerk
            if self._lane < 0:
                heading = self._place.heading
                if sensor.is_bent:
                    heading = sensor.heading
                self._tracker.begin(heading, self._angle, self.ego.speed, self._most)
            self._lane = command.lane
            if command.acceleration is not None:
                self._wanted = possible_acceleration(command.acceleration)
            elif command.speed is not None:
                self._speed = command.speed
        self.actions.append(checked)
        self.slowest = max(self.slowest, seconds)

    def actuate(self) -> None:
        """Set the controls for the coming tick from the last decision, so that the ego does not reverse."""
        ego = self.ego
        if self._lane >= 0:
            across = self._place.y
            heading = self._place.heading
            if self._sensor.is_bent:  # the position of the last observation, which must exist
                across = self._sensor.across
                heading = self._sensor.heading
            offset = across - self._lane * self._lane_width
            self._steer(self._tracker.steering(offset, heading, ego.speed, self._most, self._jerk))
        if self._speed >= 0.0:
            self._wanted = acceleration_to_speed(self._speed, ego.speed)
        wanted = self._wanted
        if self._kind is not None:
            # the commanded angle, because the possible angle depends on the speed
            self._steer(self._angle)
            wanted, ego.steering = self._kind.limited(wanted, ego.steering, ego.speed)
        ego.acceleration = without_reversing(wanted, ego.speed, self._dt)

    def _steer(self, angle: float) -> None:
        self._angle = angle
        # on a curved road, the steering angle for following the lane is added
        self.ego.steering = angle
        if self._sensor.is_bent:
            self.ego.steering = angle + self._sensor.bend


class PlannerDriver(GivenDriver):
    """A driver that calls an ADS with observations, and executes the actions that the ADS returns.

    The items of ``decisions`` replace the actions of the ADS, which is not called for these decisions.
    """

    def __init__(
        self,
        ads: Callable[[Any], Any],
        guard: HangGuard,
        decisions: Sequence[Any],
        ego: Body,
        place: Body,
        sensor: Sensor,
        **common: Any,
    ) -> None:
        super().__init__(ego, place, sensor, **common)
        self._decisions = tuple(decisions)
        self._given = len(self._decisions)
        self._ads = ads
        self._guard = guard
        self._clock = guard.clock
        self._until = guard.until
        self._limit = guard.limit

    def decide(self, tick: int) -> AdsError | None:
        """Call the ADS with a time limit and apply its action, or apply a given decision.

        Raises:
            BadAction: if a given decision is not a valid action.
            OutOfTime: if the search has run out of time.
        """
        taken = len(self.actions)
        if taken < self._given:
            # a decision is applied at the position of the last observation
            if self._sensor.is_bent:
                self._sensor.observation(tick)
            self.take(self._decisions[taken], 0.0)
            return None
        guard = self._guard
        started = self._clock()
        if started >= self._until:
            raise OutOfTime
        try:
            try:
                guard.started = started
                action = self._ads(self._sensor.observation(tick))
                # reading an action may run the ADS's code, too
                self.take(action, self._clock() - started)
            finally:
                guard.started = None  # before the clock is read; see HangGuard
                seconds = self._clock() - started
                if seconds > self._limit or started + seconds > self._until:
                    guard.settle()
            if guard.interruption is not None:
                del self.actions[taken:]  # without the action of the interrupted decision
                guard.raise_swallowed()
        except UNFIT as error:
            return error_of(error, tick, guard)
        return None


class Loop:
    """The loop that simulates one run.

    Engines can use their own vehicles, with the attributes of a :class:`Body`. An engine with its own loop calls
    :meth:`command` before it moves the vehicles, and :meth:`moved` afterwards.
    """

    def __init__(
        self,
        director: Any,
        places: Places,
        record: Any,
        dt: float,
    ) -> None:
        self.tick = 0
        # replaces the states of all vehicles after each tick with those from a simulator; None in most runs
        self.simulation: Any = None
        self.ego_touched = False
        self.npcs_touched = False  # also true after a contact with a fixed object
        self._director = director
        self._places = places
        self._lanes = places.lanes
        self._record = record  # a buffer for `ticks + 1` rows per vehicle
        self._dt = dt
        self._row = 0
        self._end = len(record)
        self._columns = COLUMNS
        self._vehicles: list[Body] = places.vehicles
        self._npcs: list[Body] = places.vehicles[1:]
        self._ego: Body = places.bodies[0]
        self._obstacles: list[Box] = places.obstacles
        # vehicles that are farther apart cannot touch
        self._reach = max([math.hypot(body.length, body.width) for body in self._vehicles])
        self._note()

    @property
    def is_over(self) -> bool:
        """True if a contact has occurred, a vehicle has reached the end of the road, or the ego has left the road."""
        return self.ego_touched or self.npcs_touched or self._places.left is not None

    def run(self, driver: EgoDriver, ticks: int) -> AdsError | None:
        """Simulate until the run ends, tick ``ticks`` is reached or the ADS fails. Return the ADS's error or None."""
        due = 0
        while self.tick < ticks:
            if due == 0:
                due = driver.every
                error = driver.decide(self.tick)
                if error is not None:
                    return error
            due -= 1
            driver.actuate()
            self.command()
            error = driver.step(self._dt)
            if error is not None:
                return error
            for body in self._npcs:
                body.step(self._dt)
            if self.simulation is not None:
                self.simulation.move()
            if self.moved():
                break
        return None

    def command(self) -> None:
        """Set the controls of the NPCs for the coming tick."""
        self._director.command(self._ego)
        if self._lanes is None:
            self._places.control()

    def moved(self) -> bool:
        """Record a tick after all vehicles have moved, and return whether the run is over."""
        self.tick += 1
        self._note()
        return self._contact() or self._places.left is not None

    def _note(self) -> None:
        row = self._row
        record = self._record
        columns = self._columns
        lanes = self._lanes
        if row + len(self._vehicles) * columns > self._end:
            raise IndexError(
                f"record: expected room for tick {self.tick}, received a buffer of {self._end} numbers"
            )
        for body in self._vehicles:  # the state after a step, and the controls that led to it
            record[row] = body.x
            record[row + 1] = body.y
            record[row + 2] = body.heading
            record[row + 3] = body.speed
            record[row + 4] = body.acceleration
            record[row + 5] = body.steering
            if lanes is not None:
                record[row + 6] = lanes.locate(body)
            row += columns
        if lanes is None:
            self._places.see(record, self._row)
        self._row = row

    def _contact(self) -> bool:
        """Return whether a vehicle touches another vehicle or a fixed object. Record whether the ego is involved."""
        record = self._record
        columns = self._columns
        reach = self._reach
        count = len(self._vehicles)
        start = self._row - count * columns
        # Contacts of the ego are checked first, and contacts between vehicles before contacts with objects.
        for first in range(count - 1):
            x = record[start + first * columns]
            for second in range(first + 1, count):
                is_near = -reach < record[start + second * columns] - x < reach
                if is_near and overlap(self._vehicles[first], self._vehicles[second]):
                    self.ego_touched = first == 0
                    self.npcs_touched = first > 0
                    return True
        for first in range(count if self._obstacles else 0):
            for obstacle in self._obstacles:
                if overlap(self._vehicles[first], obstacle):
                    self.ego_touched = first == 0
                    self.npcs_touched = first > 0
                    return True
        return False
