"""A policy for ``pafot.World("intersection-v0")`` in the environment's own terms: three actions, one decision a second.

Kind (b). It turns left, as the environment requires, and knows the map. For each action it predicts the next six
seconds, in which the others drive straight on. It takes an action if no vehicle comes near, or if it can still stop at
the line afterwards; in both cases only if it could stop behind vehicles that brake hard. Otherwise it brakes.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

SLOWER, IDLE, FASTER = 0, 1, 2
SPEEDS = (0.0, 4.5, 9.0)
"""The speeds of the environment's meta-actions [m/s]."""
STEP, HORIZON, DECISION = 0.2, 6.0, 1.0
"""The step and the length of a prediction, and the time between decisions [s]."""
SETTLING = 0.6
"""The time in which a meta-action brings the speed closer to its own by a factor of e [s]."""
NEAR = 5.5
"""The distance between two centres below which they are too near [m]."""
DOUBT = 0.4
"""The additional distance for each second of prediction [m/s]."""
HARD = 8.0
"""The hard braking of others [m/s^2]."""
INTO_TURN, RADIUS, LANE = 11.0, 13.0, 2.0
"""The distance from the middle at which the turn begins, its radius, and the offset of a lane from its road's middle
[m]."""
LINE = INTO_TURN + 4.0
"""The distance from the middle at which the ego waits [m]."""


class LookAhead:
    """A policy that decides by predicting the result of each action."""

    def __init__(self) -> None:
        self.level = 2  # the ego starts with 10 m/s, which highway-env rounds to its highest speed

    def __call__(self, observation: Any) -> int:
        """Return the number of an action."""
        _, x, y, vx, vy, *_ = observation[0]
        place, speed = along(100 * x, 100 * y), 20 * math.hypot(vx, vy)
        others = [(100 * x, 100 * y, 20 * vx, 20 * vy) for present, x, y, vx, vy, *_ in observation[1:] if present]
        action = next((each for each in (FASTER, IDLE) if self.is_safe(each, place, speed, others)), SLOWER)
        self.level = after(self.level, action)
        return action

    def is_safe(self, action: int, place: float, speed: float, others: Sequence[tuple[float, ...]]) -> bool:
        """Return whether an action leaves a way out: passing before or after all others, or a stop at the line."""
        level = after(self.level, action)
        stop = list(imagined(place, speed, level, SLOWER))
        if meets(stop, others, braking=HARD):
            return False
        return stop[-1][1] < -LINE or not meets(imagined(place, speed, level, FASTER), others)


def after(level: int, action: int) -> int:
    """Return the index of the speed after an action."""
    return min(max(level + action - IDLE, 0), len(SPEEDS) - 1)


def imagined(place: float, speed: float, level: int, later: int) -> Iterator[tuple[float, float]]:
    """Yield predicted times and places of the ego: one decision at a level's speed, then always the same action."""
    for tick in range(round(HORIZON / STEP)):
        if tick and tick % round(DECISION / STEP) == 0:
            level = after(level, later)
        speed += (SPEEDS[level] - speed) * STEP / SETTLING
        place += speed * STEP
        yield (tick + 1) * STEP, place


def meets(way: Iterable[tuple[float, float]], others: Sequence[tuple[float, ...]], braking: float = 0.0) -> bool:
    """Return whether a vehicle that drives straight on, and may brake [m/s^2], comes near the predicted ego."""
    for time, place in way:
        x, y = position(place)
        for other_x, other_y, vx, vy in others:
            speed = math.hypot(vx, vy)
            driving = min(time, speed / braking) if braking else time
            share = driving - braking * driving**2 / (2 * max(speed, 0.1))
            if math.hypot(other_x + vx * share - x, other_y + vy * share - y) < NEAR + (
                0.0 if braking else DOUBT * time
            ):
                return True
    return False


# The ego's way leads from the south to the left. Places on it are relative to the middle; the turn begins 11 m before.


def along(x: float, y: float) -> float:
    """Return the place on the way of a point in the world [m]."""
    if y > INTO_TURN:
        return -y
    angle = math.atan2(INTO_TURN - y, x + INTO_TURN)
    if angle < math.pi / 2 and x > -INTO_TURN:
        return RADIUS * angle - INTO_TURN
    return RADIUS * math.pi / 2 - INTO_TURN - (x + INTO_TURN)


def position(place: float) -> tuple[float, float]:
    """Return the point in the world of a place on the way, x and y [m]."""
    if place < -INTO_TURN:
        return LANE, -place
    angle = (place + INTO_TURN) / RADIUS
    if angle < math.pi / 2:
        return RADIUS * math.cos(angle) - INTO_TURN, INTO_TURN - RADIUS * math.sin(angle)
    return -INTO_TURN - RADIUS * (angle - math.pi / 2), -LANE


def make() -> LookAhead:
    """Return a fresh policy."""
    return LookAhead()
