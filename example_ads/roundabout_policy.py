"""A policy for ``pafot.World("roundabout-v0")`` in the environment's own terms: five actions, one decision a second.

Kind (b). It drives up from the south with 8 m/s, gives way to whoever is on the ring or about to enter it on the left,
and then follows whoever is ahead. Others are taken to keep their speed and to stay on the ring.
"""

from __future__ import annotations

import math
from typing import Any

IDLE, FASTER, SLOWER = 1, 3, 4
RADIUS, ENTRY, WEST = 24.0, math.radians(66.0), math.radians(156.0)
"""Of the outer lane [m], and the angles at which the ego and those from the west come to it."""
LINE = 30.0
"""The y at which the ego waits [m]."""
SPEED = 8.0
"""[m/s]."""
MERGING = 20.0
"""From the line until the ego is on the ring [m]."""
GAP_BEFORE, GAP_AFTER = 1.5, 2.5
"""Between the ego and somebody ahead of it at the entry, and behind it [s]."""
BRAKING = 14.0
"""Within which the ego stands that brakes from the next decision on [m]."""
FOLLOWING = 17.0
"""Distance to somebody ahead below which the ego brakes [m]."""


class GivesWay:
    """Decides by when others come to its entry."""

    def __call__(self, observation: Any) -> int:
        """The number of an action."""
        _, x, y, vx, vy = observation[0]
        x, y, speed = 100 * x, 100 * y, 15 * math.hypot(vx, vy)
        others = [(100 * x, 100 * y, 15 * math.hypot(vx, vy)) for present, x, y, vx, vy in observation[1:] if present]
        towards = FASTER if speed < SPEED / 2 else IDLE
        if math.hypot(x, y) < RADIUS + 3.0:
            own = round_to_entry(x, y)
            ahead = [
                (own - round_to_entry(*other[:2])) % (math.tau * RADIUS) for other in others if is_on_ring(*other[:2])
            ]
            return SLOWER if any(0.0 < gap < FOLLOWING for gap in ahead) else towards
        if any(abs(other_x - x) < 4.0 and 0.0 < y - other_y < FOLLOWING for other_x, other_y, _ in others):
            return SLOWER
        distance = y - LINE
        enters = max(distance, 0.0) / SPEED
        leaves = enters + MERGING / SPEED
        arrivals = [arrival for other in others if (arrival := seconds_to_entry(*other)) is not None]
        if distance < 0 or not any(enters - GAP_BEFORE < arrival < leaves + GAP_AFTER for arrival in arrivals):
            return towards
        return SLOWER if distance < BRAKING else IDLE


def is_on_ring(x: float, y: float) -> bool:
    """Whether a place is on the ring [m]."""
    return math.hypot(x, y) < RADIUS + 5.0


def round_to_entry(x: float, y: float) -> float:
    """How far it is along the ring to the ego's entry [m]."""
    return RADIUS * ((math.atan2(y, x) - ENTRY) % math.tau)


def seconds_to_entry(x: float, y: float, speed: float) -> float | None:
    """When somebody on the ring or on the road from the west comes to the ego's entry; None for all others [s]."""
    if is_on_ring(x, y):
        distance = round_to_entry(x, y)
    elif x < 0 and abs(y) < 15.0 and y > 0:
        distance = -x - RADIUS + RADIUS * (WEST - ENTRY)
    else:
        return None
    return distance / max(speed, 0.1)


def make() -> GivesWay:
    """A fresh policy."""
    return GivesWay()
