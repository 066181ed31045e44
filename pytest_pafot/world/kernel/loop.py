# cython: auto_pickle=False
"""The loop of a run: the ego's driver decides, the director commands, everybody moves one tick, all is recorded."""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Sequence
from typing import Any, cast

from pytest_pafot.model.trace import AdsError
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
    """Drives the ego.

    Attributes:
        every: physics ticks from one decision to the next.
    """

    def __init__(self, every: int) -> None:
        self.every = every

    def decide(self, tick: int) -> AdsError | None:
        """Decide what to do until the next decision; or what went wrong."""
        return None

    def actuate(self) -> None:
        """Set the ego's controls for the coming tick."""


class SelfPilot(Pilot):
    """An ego that drives itself, at every tick."""

    def __init__(self, ego: IdmEgo, others: list[Any]) -> None:
        super().__init__(1)
        self.ego = ego
        self.others = others

    def actuate(self) -> None:
        """The vehicle's own model."""
        self.ego.act(self.others)


class GivenPilot(Pilot):
    """Pairs of acceleration [m/s^2] and steering [rad], or lanes to drive to, given from outside for each decision.

    Args:
        ego: is driven.
        lanes: of the road.
        every: physics ticks from one decision to the next.
        dt: physics tick [s].

    Attributes:
        actions: what was given.
        slowest: the longest decision [s].
    """

    def __init__(self, ego: Body, lanes: Lanes, *, every: int, dt: float) -> None:
        super().__init__(every)
        self._ego = ego
        self._lanes = lanes
        self._dt = dt
        self._wanted = 0.0
        self._lane = -1  # none, as for a pair
        self._speed = -1.0  # none, as where the acceleration is given
        self._tracker = LaneTracker(ego.length, dt)
        self._most = self._jerk = 0.0  # lateral limits of the drive
        self.actions: list[tuple[float, float] | Drive] = []
        self.slowest = 0.0

    def take(self, action: Any, seconds: float) -> None:
        """Check a decision that took so long, and apply it.

        Raises:
            BadAction: when it is none.
        """
        checked = checked_si_action(action, self._lanes.count)
        self.actions.append(checked)
        self.slowest = max(self.slowest, seconds)
        self._speed = -1.0
        if type(checked) is tuple:  # quicker than isinstance
            acceleration, steering = checked  # quicker than two indices
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
        """Steer to a lane and drive a speed, where so decided; brake to a standstill, never into reverse."""
        ego = self._ego
        if self._lane >= 0:
            offset = ego.y - self._lane * self._lanes.width
            ego.steering = self._tracker.steering(offset, ego.heading, ego.speed, self._most, self._jerk)
        if self._speed >= 0.0:
            self._wanted = acceleration_to_speed(self._speed, ego.speed)
        ego.acceleration = without_reversing(self._wanted, ego.speed, self._dt)


class PlannerPilot(GivenPilot):
    """A callable from an observation to its action.

    Args:
        ads: the callable.
        ego: it drives.
        lanes: of the road.
        observer: it sees.
        guard: of its decisions.
        every: physics ticks from one decision to the next.
        dt: physics tick [s].
        decisions: the first ones, which the callable is not asked for.
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

    def decide(self, tick: int) -> AdsError | None:
        """Observe, ask under guard, check and apply; or apply what was decided before.

        Raises:
            BadAction: when what was decided before is none.
        """
        taken = len(self.actions)
        if taken < self._given:
            self.take(self._decisions[taken], 0.0)
            return None
        guard = self._guard
        started = self._clock()
        try:
            try:
                guard.started = started
                action = self._ads(self._observer.observation(tick))
            finally:
                guard.started = None  # before the clock is read, see HangGuard
                seconds = self._clock() - started
                if seconds > guard.limit:
                    guard.settle()
            self.take(action, seconds)
        except UNFIT as error:
            return error_of(error, tick, guard)
        return None


class Loop:
    """One run.

    Args:
        ego: at its start.
        director: of the NPCs, which are at their starts.
        lanes: of the road.
        record: room for ``ticks + 1`` rows of all vehicles.
        dt: physics tick [s].

    Attributes:
        tick: how far the run has come.
        ego_touched, npcs_touched: whether it ended by a contact of the ego, or else by one of two NPCs.
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
        self._reach = max([math.hypot(body.length, body.width) for body in self._bodies])  # beyond, none can touch
        self._note()

    def run(self, pilot: Pilot, ticks: int) -> AdsError | None:
        """Drive until somebody touches somebody, the ego's driver fails, or the ticks are over."""
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
        """Whether somebody touches somebody; the ego's contact goes first."""
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
