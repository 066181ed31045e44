"""An intentionally flawed driver that changes lanes every eight seconds without looking.

It is a planner for ``pafot.Highway``. Within its lane it is careful: it follows the vehicle ahead according to the
Intelligent Driver Model (Treiber, Hennecke, Helbing 2000). However, its lane changes depend only on time. It changes to
the right until it reaches the last lane, then to the left, and so on, and never checks whether the new lane is free.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pytest_pafot import Observation

SECONDS_PER_LANE = 8.0

MAX_ACCELERATION = 2.0
COMFORTABLE_BRAKING = 3.0
HARDEST_BRAKING = 8.0
TIME_HEADWAY = 1.5
STANDSTILL_GAP = 3.0

LATERAL_GAIN = 0.7
HEADING_GAIN = 2.5
MAX_STEERING = 0.4


class BlindLaneChange:
    """A driver that aims for the speed limit and changes to the next lane every eight seconds."""

    def __init__(self) -> None:
        self._lane: int | None = None
        self._direction = 1
        self._changes = 0

    def __call__(self, observation: Observation) -> tuple[float, float]:
        """Return the acceleration [m/s^2] and the steering angle [rad]."""
        if self._lane is None:
            self._lane = observation.ego.lane
        if observation.time >= (self._changes + 1) * SECONDS_PER_LANE:
            self._lane = self._next_lane(self._lane, observation.lanes)
            self._changes += 1
        return acceleration(observation), steering(observation, self._lane * observation.lane_width)

    def _next_lane(self, lane: int, lanes: int) -> int:
        if not 0 <= lane + self._direction < lanes:
            self._direction = -self._direction
        return lane + self._direction


def acceleration(observation: Observation) -> float:
    """Return the Intelligent Driver Model's acceleration [m/s^2] for the next vehicle ahead in the ego's lane."""
    ego = observation.ego
    free = 1 - (max(ego.speed, 0.0) / observation.speed_limit) ** 4
    ahead = [other for other in observation.others if other.lane == ego.lane and other.x > ego.x]
    if not ahead:
        return max(MAX_ACCELERATION * free, -HARDEST_BRAKING)
    leader = min(ahead, key=lambda other: other.x)
    gap = max(leader.x - ego.x - (leader.length + ego.length) / 2, 0.1)
    closing = (
        ego.speed
        * (ego.speed - leader.speed)
        / (2 * math.sqrt(MAX_ACCELERATION * COMFORTABLE_BRAKING))
    )
    wanted = STANDSTILL_GAP + max(TIME_HEADWAY * ego.speed + closing, 0.0)
    return max(MAX_ACCELERATION * (free - (wanted / gap) ** 2), -HARDEST_BRAKING)


def steering(observation: Observation, target_y: float) -> float:
    """Return the steering angle [rad] towards a line along the road.

    The lateral error determines a heading, and the heading error determines the turning rate.
    """
    ego = observation.ego
    speed = max(ego.speed, 1.0)
    wanted_heading = math.asin(max(-0.5, min(0.5, LATERAL_GAIN * (target_y - ego.y) / speed)))
    turning = HEADING_GAIN * (wanted_heading - ego.heading)
    slip = math.asin(max(-0.9, min(0.9, ego.length / 2 / speed * turning)))
    return max(-MAX_STEERING, min(MAX_STEERING, math.atan(2 * math.tan(slip))))


def make() -> BlindLaneChange:
    """Return a new driver, at the start of its first eight seconds."""
    return BlindLaneChange()
