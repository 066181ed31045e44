"""Vehicles as boxes that move, and the contact of two: do they overlap, and which side of the ego was hit.

They move by highway-env's kinematic bicycle model in plain numbers. Its own ``crashed`` also fires on predicted contact
and pushes vehicles apart; it is switched off.
"""

from __future__ import annotations

import math

from pytest_pafot.model.trace import Side
from pytest_pafot.world.limits import TOP_SPEED

NPC_LENGTH, NPC_WIDTH = 5.0, 2.0
"""Of highway-env's vehicles, and so of NPCs and of egos in SI units [m]."""
MAX_SPEED = TOP_SPEED
"""Highest speed, forwards and backwards [m/s]; here a number of C's where compiled."""


class Box:
    """An oriented rectangle: centre [m], heading [rad], length and width [m]."""

    def __init__(self, x: float, y: float, heading: float, length: float, width: float) -> None:
        self.x = x
        self.y = y
        self.heading = heading
        self.length = length
        self.width = width


class Body(Box):
    """A box with a speed and controls, which are held until they are set again.

    Attributes:
        speed: [m/s].
        acceleration: [m/s^2].
        steering: [rad].
        lane: index of the nearest lane; whoever moves a body keeps it true.
    """

    def __init__(self, length: float, width: float) -> None:
        self.x = self.y = self.heading = self.speed = self.acceleration = self.steering = 0.0
        self.length = length
        self.width = width
        self.lane = 0

    def place(self, x: float, y: float, heading: float, speed: float) -> None:
        """Put it somewhere [m, m, rad, m/s]."""
        self.x = x
        self.y = y
        self.heading = heading
        self.speed = speed

    def step(self, dt: float) -> None:
        """highway-env's kinematic bicycle model, one explicit Euler step of ``dt`` seconds, operation by operation."""
        speed = self.speed
        if speed > MAX_SPEED:
            self.acceleration = min(self.acceleration, MAX_SPEED - speed)
        elif speed < -MAX_SPEED:
            self.acceleration = max(self.acceleration, -MAX_SPEED - speed)
        course = self.heading
        if self.steering != 0.0:
            slip = math.atan(0.5 * math.tan(self.steering))
            course += slip
            self.heading += speed * math.sin(slip) / (self.length / 2.0) * dt
        if course == 0.0:
            self.x += speed * dt
        else:
            self.x += speed * math.cos(course) * dt
            self.y += speed * math.sin(course) * dt
        self.speed = speed + self.acceleration * dt


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
