"""Random scenarios and egos for the tests of the world, and a check of the NPC limits on a finished trace."""

from __future__ import annotations

import math
import random

import numpy as np
from highway_env.vehicle.behavior import IDMVehicle

from pytest_pafot.model.instructions import PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import ACCELERATION, HEADING, SPEED, STEERING, X, Y
from pytest_pafot.model.vehicle_type import STYLES

LENGTH, WIDTH, LANE_WIDTH = 5.0, 2.0, 4.0
STANDING = 1e-6
"""The speed below which an NPC counts as standing [m/s]."""


def constant_speed():
    """Return an ADS that neither accelerates nor steers."""
    return lambda observation: (0.0, 0.0)


def weaving():
    """Return an ADS that speeds up and slows down while it swerves, sometimes off the road."""
    return lambda seen: (3 * math.sin(0.7 * seen.time), 0.05 * math.sin(1.3 * seen.time))


def stopping():
    """Return an ADS that speeds up, then brakes to a standstill."""
    return lambda observation: (-4.0 if observation.time > 2 else 2.0, 0.0)


def changing_lanes():
    """Return an ADS that steers to the next lane and back every few seconds."""

    def drive(observation):
        lane = 1 + (observation.time % 8 > 4)
        offset = observation.ego.y - lane * observation.lane_width
        return 0.0, -0.01 * offset - 0.3 * observation.ego.heading

    return drive


def idm():
    """Return highway-env's own driver."""
    return IDMVehicle


EGOS = (constant_speed, weaving, stopping, changing_lanes, IDMVehicle)


TRAFFICS = (*STYLES,)
"""One traffic of each style, and one with changed parameters."""


def chains(
    rng: random.Random, npcs: int, genes: int, speed_limit: float
) -> list[list[PositionInstruction]]:
    """Return random chains, which may be invalid, with speeds over the whole range."""
    top = int(speed_limit * 10 + 1e-6)
    return [
        [PositionInstruction(rng.randint(1, 8), rng.randint(0, top) / 10) for _ in range(genes)]
        for _ in range(npcs)
    ]


def random_scenario(
    rng: random.Random, *, lanes: int, speed_limit: float, npcs: int | None = None
) -> Scenario:
    """Return a short scenario for a highway with this many lanes, any traffic, and chains of different lengths."""
    lane = rng.randrange(lanes)
    free = 8 if 0 < lane < lanes - 1 else 5
    count = min(npcs or rng.randint(1, 8), free)
    drawn = [chains(rng, 1, rng.randint(1, 4), speed_limit)[0] for _ in range(count)]
    seed, uniform = rng.randrange(2**40), rng.uniform(0, speed_limit)
    speed = rng.choice([0.0, 5.0, speed_limit, uniform, 0.8 * speed_limit])
    durations, traffic = rng.choice([1.0, 2.0, 4.0]), rng.choice(TRAFFICS)
    common = {"gene_seconds": durations, "traffic": traffic}
    return Scenario.repaired(drawn, seed=seed, ego_lane=lane, ego_speed=speed, **common)


def violations(trace, limits, speed_limit):
    """Return the limits that the NPCs of a trace break, as texts with the worst value.

    It computes everything from positions, headings, speeds and the recorded controls.
    """
    s = trace.npcs
    x, y, heading = s[..., X], s[..., Y], s[..., HEADING]
    length, width = trace.sizes[1:].T
    half_width = (length * np.abs(np.sin(heading)) + width * np.abs(np.cos(heading))) / 2
    bounds, course = bounds_of_motion(s, limits, *own_limits(trace, limits, speed_limit), trace.dt)
    turning = s[0, :, SPEED] * course[0] / trace.dt
    road_right = (len(trace.lanes) - 0.5) * LANE_WIDTH
    bounds |= {
        "turning at the start": (turning, *bounds["turning of the course"][1:]),
        "heading": (heading, -limits.heading, limits.heading),
        "course": (course, -limits.heading, limits.heading),
        "forward motion": (np.diff(x, axis=0), 0.0, np.inf),
        "left corner on the road": (y - half_width, -LANE_WIDTH / 2, np.inf),
        "right corner on the road": (y + half_width, -np.inf, road_right),
        "within the road's length": (x, LENGTH / 2, trace.lanes[0].length - LENGTH / 2),
    }
    return beyond(bounds)


def bounds_of_motion(s, limits, top, own, dt):
    """Return the bounds by name for how NPCs with some states move on any road, and their courses [rad].

    The course is the direction of motion: heading plus the slip angle of highway-env's bicycle model, which is checked
    against the positions. The top speed and the own limits are from :func:`own_limits`.
    """
    heading, speed, acceleration = s[..., HEADING], s[..., SPEED], s[..., ACCELERATION]
    course = heading[:-1] + np.arctan(np.tan(s[1:, :, STEERING]) / 2)
    standing = (speed[1:] <= STANDING) | (speed[:-1] <= STANDING)
    jerk = np.where(standing, 0.0, np.diff(acceleration, axis=0) / dt)
    turning = speed[:-1] * wrapped(np.diff(heading, axis=0)) / dt
    turning_of_course = speed[1:-1] * wrapped(np.diff(course, axis=0)) / dt
    gain = np.diff(speed, axis=0) - acceleration[1:] * dt
    along_x = np.diff(s[..., X], axis=0) - speed[:-1] * np.cos(course) * dt
    along_y = np.diff(s[..., Y], axis=0) - speed[:-1] * np.sin(course) * dt
    lateral = own["lateral_acceleration"]
    return {
        "acceleration": (acceleration, -own["braking"], own["acceleration"]),
        "jerk": (jerk, -limits.jerk, limits.jerk),
        "speed": (speed, 0.0, top),
        "turning of the heading": (turning, -lateral, lateral),
        "turning of the course": (turning_of_course, -lateral, lateral),
        "speed follows acceleration": (gain, 0.0, 0.0),
        "motion follows course, x": (along_x, 0.0, 0.0),
        "motion follows course, y": (along_y, 0.0, 0.0),
    }, course


def wrapped(angle):
    """Return an angle in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def own_limits(trace, limits, speed_limit):
    """Return the top speed of each NPC [m/s], and by name each limit that a vehicle may have itself."""
    kinds, own = trace.scenario.all_vehicles, {}
    top = np.array([min(limits.overspeed * speed_limit, kind.top_speed) for kind in kinds])
    for name in ("acceleration", "braking", "lateral_acceleration"):
        own[name] = np.array([min(getattr(limits, name), getattr(kind, name)) for kind in kinds])
    return top, own


def beyond(bounds):
    """Return the out-of-bounds values as texts with the worst; ``bounds`` has values, least and greatest by name."""
    broken = []
    for name, (values, low, high) in bounds.items():
        worst = max(np.max(values - high, initial=-1.0), np.max(low - values, initial=-1.0))
        if not worst <= 1e-6:  # also NaN
            broken.append(f"{name}: {worst:.3g} beyond [{low}, {high}]")
    return broken
