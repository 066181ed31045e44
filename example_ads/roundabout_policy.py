"""A policy for ``pafot.World("roundabout-v0")`` in the environment's own terms: five actions, one decision a second.

Kind (b). It approaches from the south with 8 m/s, gives way to vehicles on the ring or about to enter it on the left,
and then follows the vehicle ahead. It assumes that others keep their speed and stay on the ring.
"""

from __future__ import annotations

import math
from typing import Any

IDLE, FASTER, SLOWER = 1, 3, 4
RADIUS, ENTRY, WEST = 24.0, math.radians(66.0), math.radians(156.0)
"""The radius of the outer lane [m], and the angles at which the ego and vehicles from the west enter it."""
LINE = 30.0
"""The y at which the ego waits [m]."""
SPEED = 8.0
"""The speed before the roundabout [m/s]."""
MERGING = 20.0
"""The distance from the line until the ego is on the ring [m]."""
GAP_BEFORE, GAP_AFTER = 1.5, 2.5
"""The least time between the ego and a vehicle ahead of it at the entry, and behind it [s]."""
BRAKING = 14.0
"""The distance in which the ego stops if it brakes from the next decision on [m]."""
FOLLOWING = 17.0
"""The distance to a vehicle ahead below which the ego brakes [m]."""


class GivesWay:
    """A policy that decides by when others reach its entry."""

    def __call__(self, observation: Any) -> int:
        """Return the number of an action."""
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
    """Return whether a place is on the ring [m]."""
    return math.hypot(x, y) < RADIUS + 5.0


def round_to_entry(x: float, y: float) -> float:
    """Return the distance along the ring to the ego's entry [m]."""
    return RADIUS * ((math.atan2(y, x) - ENTRY) % math.tau)


def seconds_to_entry(x: float, y: float, speed: float) -> float | None:
    """Return when a vehicle on the ring or on the road from the west reaches the ego's entry [s]; None for others."""
    if is_on_ring(x, y):
        distance = round_to_entry(x, y)
    elif x < 0 and abs(y) < 15.0 and y > 0:
        distance = -x - RADIUS + RADIUS * (WEST - ENTRY)
    else:
        return None
    return distance / max(speed, 0.1)


def make() -> GivesWay:
    """Return a fresh policy."""
    return GivesWay()
