"""How fast an NPC may be at each place of a lane, and how a vehicle lies in its bends. Pure functions of arrays."""

from __future__ import annotations

import math

import numpy as np

from pytest_pafot.trace import FloatArray
from pytest_pafot.world.limits import NpcLimits

BEND_SHARE = 0.8
"""Share of the lateral acceleration that following a bend may take; the rest is left for control."""
SLOWING = 2.0
"""Deceleration by which an NPC gets slower for a bend or an end [m/s^2], at most a third of what it can."""
SPEED_LAG = 1 / 1.5
"""How long the speed control lags behind a speed that falls steadily: the inverse of its gain [s]."""


def allowed_speeds(
    curvature: FloatArray, limit: FloatArray, stops: float | None, lengths: FloatArray, limits: NpcLimits
) -> FloatArray:
    """The highest speed at each point of a lane [m/s].

    At most the speed limit times the NPCs' excess of it, at most what the bend allows, sqrt(share * a / curvature),
    and at every point so slow that gentle braking suffices for all points that follow, begun early enough. Arrays have
    an entry per point: curvature [1/m], speed limit [m/s], length along the lane [m]. ``stops`` is the length at which
    the lane ends [m], None if it does not.
    """
    with np.errstate(divide="ignore"):
        bend = np.sqrt(BEND_SHARE * limits.lateral_acceleration / np.abs(curvature))
    speed = np.minimum(bend, limits.overspeed * limit)
    slowing = min(SLOWING, limits.braking / 3)
    if stops is not None:
        speed = np.where(lengths >= stops, 0.0, speed)
    squares = speed**2
    for index in range(len(squares) - 2, -1, -1):
        reach = squares[index + 1] + 2 * slowing * (lengths[index + 1] - lengths[index])
        squares[index] = min(squares[index], reach)
    speed = np.sqrt(squares)
    reached = np.searchsorted(lengths, lengths + speed * SPEED_LAG, side="right")  # while the speed control lags behind
    return np.array([speed[index : last + 1].min() for index, last in enumerate(reached)])


def leans(direction: FloatArray, lengths: FloatArray, vehicle_length: float) -> FloatArray:
    """The angle to a lane of a vehicle whose centre follows it exactly [rad], by highway-env's bicycle model.

    Its rear axle is half a length behind its centre and moves where it points: per metre the heading turns by
    sin(direction - heading) / (length / 2).
    """
    lean = np.zeros(len(direction))
    for index in range(1, len(direction)):
        step = float(lengths[index] - lengths[index - 1])
        turn = float(direction[index] - direction[index - 1])
        settled = math.asin(max(-0.99, min(0.99, turn / step * vehicle_length / 2))) if step > 0 else 0.0
        share = 1 - math.exp(-2 * step / vehicle_length)
        lean[index] = lean[index - 1] + share * (-settled - lean[index - 1])
    return lean


def sharpest_ahead(curvature: FloatArray, lengths: FloatArray, reach: float) -> FloatArray:
    """The largest curvature from each point of a lane to so far ahead [1/m]."""
    last = np.searchsorted(lengths, lengths + reach, side="right")
    bend = np.abs(curvature)
    return np.array([bend[index:end].max() for index, end in enumerate(last)])
