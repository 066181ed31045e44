"""A policy for ``pafot.World("intersection-v0")`` in the environment's own terms: three actions, one decision a second.

Kind (b). It turns left, as the environment asks for, and knows the map. Of each action it imagines what follows for six
seconds. It goes ahead where nobody comes near who drives straight on; otherwise where it can still stop at the line
afterwards; and in either case where it could stop behind whoever brakes hard. If none of that is possible it brakes.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

SLOWER, IDLE, FASTER = 0, 1, 2
SPEEDS = (0.0, 4.5, 9.0)
"""Of the environment's meta-actions [m/s]."""
STEP, HORIZON, DECISION = 0.2, 6.0, 1.0
"""[s]."""
SETTLING = 0.6
"""Within which a meta-action brings the speed nearer to its own by a factor of e [s]."""
NEAR = 5.5
"""Distance of two centres that is too small [m], and by how much more of it is kept for each second to come."""
DOUBT = 0.4
"""[m/s]."""
HARD = 8.0
"""[m/s^2]."""
INTO_TURN, RADIUS, LANE = 11.0, 13.0, 2.0
"""The turn begins so far from the middle, with this radius; lanes are so far from the middle of their road [m]."""
LINE = INTO_TURN + 4.0
"""Where the ego waits [m]."""


class LookAhead:
    """Decides by what it imagines."""

    def __init__(self) -> None:
        self.level = 2  # the ego starts with 10 m/s, which highway-env takes for its highest speed

    def __call__(self, observation: Any) -> int:
        """The number of an action."""
        _, x, y, vx, vy, *_ = observation[0]
        place, speed = along(100 * x, 100 * y), 20 * math.hypot(vx, vy)
        others = [(100 * x, 100 * y, 20 * vx, 20 * vy) for present, x, y, vx, vy, *_ in observation[1:] if present]
        action = next((each for each in (FASTER, IDLE) if self.is_safe(each, place, speed, others)), SLOWER)
        self.level = after(self.level, action)
        return action

    def is_safe(self, action: int, place: float, speed: float, others: Sequence[tuple[float, ...]]) -> bool:
        """Whether an action leaves a way out: ahead of or behind everybody, or a stop at the line."""
        level = after(self.level, action)
        stop = list(imagined(place, speed, level, SLOWER))
        if meets(stop, others, braking=HARD):
            return False
        return stop[-1][1] < -LINE or not meets(imagined(place, speed, level, FASTER), others)


def after(level: int, action: int) -> int:
    """The number of the speed that is driven after an action."""
    return min(max(level + action - IDLE, 0), len(SPEEDS) - 1)


def imagined(place: float, speed: float, level: int, later: int) -> Iterator[tuple[float, float]]:
    """Times and places of the ego: one decision at the speed of a level, and the same action in all later ones."""
    for tick in range(round(HORIZON / STEP)):
        if tick and tick % round(DECISION / STEP) == 0:
            level = after(level, later)
        speed += (SPEEDS[level] - speed) * STEP / SETTLING
        place += speed * STEP
        yield (tick + 1) * STEP, place


def meets(way: Iterable[tuple[float, float]], others: Sequence[tuple[float, ...]], braking: float = 0.0) -> bool:
    """Whether one of the others, who go straight on and may brake [m/s^2], comes near the ego on an imagined way."""
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


# The ego's way: from the south, and to the left. Places on it count from where the turn would begin, 11 m before it.


def along(x: float, y: float) -> float:
    """The place of a point in the world [m]."""
    if y > INTO_TURN:
        return -y
    angle = math.atan2(INTO_TURN - y, x + INTO_TURN)
    if angle < math.pi / 2 and x > -INTO_TURN:
        return RADIUS * angle - INTO_TURN
    return RADIUS * math.pi / 2 - INTO_TURN - (x + INTO_TURN)


def position(place: float) -> tuple[float, float]:
    """The point in the world of a place, x and y [m]."""
    if place < -INTO_TURN:
        return LANE, -place
    angle = (place + INTO_TURN) / RADIUS
    if angle < math.pi / 2:
        return RADIUS * math.cos(angle) - INTO_TURN, INTO_TURN - RADIUS * math.sin(angle)
    return -INTO_TURN - RADIUS * (angle - math.pi / 2), -LANE


def make() -> LookAhead:
    """A fresh policy."""
    return LookAhead()
