# cython: auto_pickle=False
"""The loop of a run: the ego's driver decides, the director commands, all vehicles move one tick and are recorded."""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Sequence
from typing import Any, cast

from pytest_pafot.model.trace import AdsError
from pytest_pafot.support.errors import OutOfTime
from pytest_pafot.world.guard.failure import UNFIT, error_of
from pytest_pafot.world.guard.hang_guard import HangGuard
from pytest_pafot.world.kernel.action import (
    Drive,
    acceleration_to_speed,
    checked_si_action,
    possible_acceleration,
    possible_steering,
    without_reversing,
)
from pytest_pafot.world.kernel.bodies import Body, overlap
from pytest_pafot.world.kernel.director import Director
from pytest_pafot.world.kernel.driver import LaneTracker
from pytest_pafot.world.kernel.idm import IdmEgo
from pytest_pafot.world.kernel.lanes import Lanes
from pytest_pafot.world.kernel.observation import COLUMNS, Observer


class Pilot:
    """The driver of the ego.

    Attributes:
        every: the number of physics ticks between decisions.
    """

    def __init__(self, every: int) -> None:
        self.every = every

    def decide(self, tick: int) -> AdsError | None:
        """Decide what to do until the next decision, and return the error of the ADS, or None."""
        return None

    def actuate(self) -> None:
        """Set the ego's controls for the coming tick."""


class SelfPilot(Pilot):
    """The driver of an ego whose own model sets its controls at every tick, so there is no ADS to call."""

    def __init__(self, ego: IdmEgo, others: list[Any]) -> None:
        super().__init__(1)
        self.ego = ego
        self.others = others

    def actuate(self) -> None:
        """Apply the vehicle's own model."""
        self.ego.act(self.others)


class GivenPilot(Pilot):
    """A driver whose decisions are passed in: acceleration [m/s^2] and steering [rad], or a :class:`Drive`.

    Args:
        ego: the ego.
        lanes: the road's lanes.
        every: the number of physics ticks between decisions.
        dt: physics tick [s].

    Attributes:
        actions: all decisions so far.
        slowest: the longest decision [s].
    """

    def __init__(self, ego: Body, lanes: Lanes, *, every: int, dt: float) -> None:
        super().__init__(every)
        self._ego = ego
        self._lanes = lanes
        self._dt = dt
        self._wanted = 0.0
        self._lane = -1  # -1 for none, if the decision is a pair
        self._speed = -1.0  # negative for none, if the decision has an acceleration
        self._tracker = LaneTracker(ego.length, dt)
        self._most = self._jerk = 0.0  # lateral limits of a Drive
        self.actions: list[tuple[float, float] | Drive] = []
        self.slowest = 0.0

    def take(self, action: Any, seconds: float) -> None:
        """Check and apply a decision that took ``seconds``.

        Raises:
            BadAction: if the action is not valid.
        """
        checked = checked_si_action(action, self._lanes.count)
        self.actions.append(checked)
        self.slowest = max(self.slowest, seconds)
        self._speed = -1.0
        if type(checked) is tuple:  # faster than isinstance
            acceleration, steering = checked  # faster than two indices
            self._lane = -1
            self._wanted = possible_acceleration(acceleration)
            self._ego.steering = possible_steering(steering)
            return
        drive, ego = cast("Drive", checked), self._ego
        self._most, self._jerk = drive.lateral_acceleration, drive.lateral_jerk
        if self._lane < 0:
            self._tracker.begin(ego.heading, ego.steering, ego.speed, self._most)
        self._lane = drive.lane
        if drive.acceleration is not None:
            self._wanted = possible_acceleration(drive.acceleration)
        elif drive.speed is not None:
            self._speed = drive.speed

    def actuate(self) -> None:
        """Set the controls of a tick: steer towards the lane and speed of a Drive, and never drive in reverse."""
        ego = self._ego
        if self._lane >= 0:
            offset = ego.y - self._lane * self._lanes.width
            ego.steering = self._tracker.steering(offset, ego.heading, ego.speed, self._most, self._jerk)
        if self._speed >= 0.0:
            self._wanted = acceleration_to_speed(self._speed, ego.speed)
        ego.acceleration = without_reversing(self._wanted, ego.speed, self._dt)


class PlannerPilot(GivenPilot):
    """A driver of the ego that calls an ADS with an observation, and applies the decision that the ADS returns.

    Args:
        ads: the ADS, a callable from an observation to a decision.
        ego: the ego.
        lanes: the road's lanes.
        observer: the maker of the ADS's observations.
        guard: the guard of the ADS's decisions.
        every: the number of physics ticks between decisions.
        dt: physics tick [s].
        decisions: the first decisions, which replace calls of the ADS.
    """

    def __init__(
        self,
        ads: Callable[[Any], Any],
        ego: Body,
        lanes: Lanes,
        observer: Observer,
        guard: HangGuard,
        *,
        every: int,
        dt: float,
        decisions: Sequence[Any] = (),
    ) -> None:
        super().__init__(ego, lanes, every=every, dt=dt)
        self._decisions = tuple(decisions)
        self._given = len(self._decisions)
        self._ads = ads
        self._observer = observer
        self._guard = guard
        self._clock = guard.clock
        self._until = guard.until

    def decide(self, tick: int) -> AdsError | None:
        """Observe, call the ADS under guard, and check and apply its action; or apply a given decision.

        Raises:
            BadAction: if a given decision is not a valid action.
            OutOfTime: if the time of the search is over.
        """
        taken = len(self.actions)
        if taken < self._given:
            self.take(self._decisions[taken], 0.0)
            return None
        guard = self._guard
        started = self._clock()
        if started >= self._until:
            raise OutOfTime
        try:
            try:
                guard.started = started
                action = self._ads(self._observer.observation(tick))
            finally:
                guard.started = None  # before the clock is read; see HangGuard
                seconds = self._clock() - started
                if seconds > guard.limit or started + seconds > self._until:
                    guard.settle()
            self.take(action, seconds)
        except UNFIT as error:
            return error_of(error, tick, guard)
        return None


class Loop:
    """The loop of one run.

    Args:
        ego: the ego, at its start.
        director: the director of the NPCs, which are at their starts.
        lanes: the road's lanes.
        record: a buffer for ``ticks + 1`` rows of all vehicles.
        dt: physics tick [s].

    Attributes:
        tick: the current tick of the run.
        ego_touched: true if the run ended by a contact of the ego.
        npcs_touched: true if the run ended by a contact of two NPCs.
    """

    def __init__(self, ego: Body, director: Director, lanes: Lanes, record: array[float], dt: float) -> None:
        self.tick = 0
        self.ego_touched = False
        self.npcs_touched = False
        self._ego = ego
        self._director = director
        self._lanes = lanes
        self._record = record
        self._dt = dt
        self._row = 0
        self._columns = COLUMNS
        self._bodies: list[Body] = [ego, *director.npcs]
        self._reach = max(
            [math.hypot(body.length, body.width) for body in self._bodies]
        )  # farther apart, none can touch
        self._note()

    def run(self, pilot: Pilot, ticks: int) -> AdsError | None:
        """Drive until two vehicles touch, ``ticks`` is reached, or the ADS fails; return the ADS's error, or None."""
        due = 0
        while self.tick < ticks:
            if due == 0:
                due = pilot.every
                error = pilot.decide(self.tick)
                if error is not None:
                    return error
            due -= 1
            pilot.actuate()
            self._director.command(self._ego)
            for body in self._bodies:
                body.step(self._dt)
            self.tick += 1
            self._note()
            if self._contact():
                break
        return None

    def _note(self) -> None:
        """Record the state after a step, and the controls that led to it."""
        row, record, lanes, columns = self._row, self._record, self._lanes, self._columns
        for body in self._bodies:
            record[row] = body.x
            record[row + 1] = body.y
            record[row + 2] = body.heading
            record[row + 3] = body.speed
            record[row + 4] = body.acceleration
            record[row + 5] = body.steering
            record[row + 6] = lanes.locate(body)
            row += columns
        self._row = row

    def _contact(self) -> bool:
        """Return whether two vehicles touch, and set which; a contact of the ego is found before contacts of NPCs."""
        record, columns, reach, count = self._record, self._columns, self._reach, len(self._bodies)
        start = self._row - count * columns
        for first in range(count - 1):
            x = record[start + first * columns]
            for second in range(first + 1, count):
                is_near = -reach < record[start + second * columns] - x < reach
                if is_near and overlap(self._bodies[first], self._bodies[second]):
                    self.ego_touched = first == 0
                    self.npcs_touched = first > 0
                    return True
        return False
