"""Vehicles as boxes that move: highway-env's kinematic bicycle model in plain numbers."""

from __future__ import annotations

import math

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
