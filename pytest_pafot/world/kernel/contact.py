"""The contact oracle: do two boxes overlap, and which side of the ego was hit.

highway-env's own ``crashed`` also fires on predicted contact and pushes vehicles apart; it is switched off.
"""

from __future__ import annotations

import math

from pytest_pafot.trace import Side
from pytest_pafot.world.kernel.bodies import Box


def overlap(a: Box, b: Box) -> bool:
    """Whether two boxes share more than a border (separating axes)."""
    turn_a, turn_b = abs(a.heading), abs(b.heading)  # bound the sines, so that most pairs cost no trigonometry
    if 2.0 * abs(b.x - a.x) > a.length + b.length + a.width * turn_a + b.width * turn_b:
        return False
    if 2.0 * abs(b.y - a.y) > a.width + b.width + a.length * turn_a + b.length * turn_b:
        return False
    return depth(a, b) < 0.0


def depth(a: Box, b: Box) -> float:
    """Gap between two boxes along the axis of theirs along which it is largest [m]; negative where they overlap."""
    along, across = separation(a, b)
    its_along, its_across = separation(b, a)
    return max(along, across, its_along, its_across)


def separation(a: Box, b: Box) -> tuple[float, float]:
    """Gap between two boxes along the first one's length and along its width [m]; negative where they overlap."""
    cos_a, sin_a = math.cos(a.heading), math.sin(a.heading)
    turn = b.heading - a.heading
    cos_t, sin_t = abs(math.cos(turn)), abs(math.sin(turn))
    dx, dy = b.x - a.x, b.y - a.y
    along = abs(dx * cos_a + dy * sin_a)
    across = abs(dy * cos_a - dx * sin_a)
    return (
        along - (a.length + b.length * cos_t + b.width * sin_t) / 2.0,
        across - (a.width + b.length * sin_t + b.width * cos_t) / 2.0,
    )


def side_hit(ego_before: Box, other_before: Box) -> Side:
    """The ego's side that the other met, judged at the last tick without contact.

    The axis along which the boxes were further apart then is the one along which they met.
    """
    along, across = separation(ego_before, other_before)
    dx, dy = other_before.x - ego_before.x, other_before.y - ego_before.y
    cos_h, sin_h = math.cos(ego_before.heading), math.sin(ego_before.heading)
    if along >= across:
        return "front" if dx * cos_h + dy * sin_h > 0.0 else "rear"
    return "right" if dy * cos_h - dx * sin_h > 0.0 else "left"
