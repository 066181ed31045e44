"""Vehicles as moving boxes, and the detection of contacts between boxes.

Vehicles move according to highway-env's kinematic bicycle model. highway-env's own collision check is switched off,
because it also reports predicted contacts and pushes vehicles apart.
"""

from __future__ import annotations

import math

from pytest_pafot.model.trace import Side
from pytest_pafot.world.limits import TOP_SPEED

# values per vehicle and tick in a record: x, y, heading, speed, acceleration, steering, lane
COLUMNS = 7
# both forwards and backwards [m/s]; unlike TOP_SPEED, it is a C number in compiled code
MAX_SPEED = TOP_SPEED


class Box:
    """A rectangle with a centre [m], a heading [rad], a length [m] and a width [m]."""

    def __init__(self, x: float, y: float, heading: float, length: float, width: float) -> None:
        self.x = x
        self.y = y
        self.heading = heading
        self.length = length
        self.width = width


class Body(Box):
    """A box with a speed [m/s] and controls, which apply until they are changed."""

    def __init__(self, length: float, width: float) -> None:
        self.x = self.y = self.heading = self.speed = self.acceleration = self.steering = 0.0
        self.length = length
        self.width = width
        # nearest lane, updated after all bodies have moved; not used for crossing vehicles
        self.lane = 0

    def place(self, x: float, y: float, heading: float, speed: float) -> None:
        """Set the position [m], the heading [rad] and the speed [m/s]."""
        self.x = x
        self.y = y
        self.heading = heading
        self.speed = speed

    def step(self, dt: float) -> None:
        """Move the body for ``dt`` seconds, with one explicit Euler step of highway-env's bicycle model."""
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
    """Return whether two boxes overlap. A shared edge is not an overlap."""
    # Angles are upper bounds of their sines. With these bounds, most pairs are found to be apart without trigonometry.
    turn_a, turn_b = abs(a.heading), abs(b.heading)
    if 2.0 * abs(b.x - a.x) > a.length + b.length + a.width * turn_a + b.width * turn_b:
        return False
    if 2.0 * abs(b.y - a.y) > a.width + b.width + a.length * turn_a + b.length * turn_b:
        return False
    return depth(a, b) < 0.0


def depth(a: Box, b: Box) -> float:
    """Return the largest gap [m] between two boxes along any of their axes, negative if the boxes overlap."""
    along, across = separation(a, b)
    its_along, its_across = separation(b, a)
    return max(along, across, its_along, its_across)


def separation(a: Box, b: Box) -> tuple[float, float]:
    """Return the gaps [m] between two boxes along the length and the width of the first. Overlaps are negative."""
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
    """Return the side of the ego that was hit, given both boxes at the last tick before the contact."""
    # The contact occurred along the axis of the ego along which the gap was larger before.
    along, across = separation(ego_before, other_before)
    dx, dy = other_before.x - ego_before.x, other_before.y - ego_before.y
    cos_h, sin_h = math.cos(ego_before.heading), math.sin(ego_before.heading)
    if along >= across:
        return "front" if dx * cos_h + dy * sin_h > 0.0 else "rear"
    return "right" if dy * cos_h - dx * sin_h > 0.0 else "left"
