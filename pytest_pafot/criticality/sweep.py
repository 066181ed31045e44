# cython: boundscheck=False, initializedcheck=False, wraparound=False, cdivision=True, auto_pickle=False
# Cython's checks are off, because no index exceeds the shapes that `extremes` checks, and no divisor is zero.
"""A function that computes the three extremes for the default fitness in a single pass over a run's ticks."""

# The values equal those of numpy's arrays in criticality/measures.py to the last bit, because the pass performs the
# same operations in the same order. It skips ticks if bounds show that they cannot be extreme. The compiled pass takes
# a tenth of the time of numpy's arrays. The interpreted pass would be slower than the arrays, so it is not used.
#
# The bounds need no trigonometry: a sine is at most its angle h and differs from it by at most h^3 / 6, and a cosine is
# between 1 - h^2 / 2 and 1.

from __future__ import annotations

import math
from typing import Any

import numpy as np

from pytest_pafot.model.trace import FloatArray

# The margin of the bounds [m]. It is far larger than rounding errors, so no extreme tick is skipped.
SLACK = 1e-6
# The limit of the sum of the absolute values of a vehicle's state. For a larger sum or NaN, numpy's arrays are used.
LARGE = 1e6
# The limit of the smallest time to contact [s]. If it is longer or infinite, numpy's arrays are used.
LONGEST = 1e5
UNENDING = math.inf  # infinity as a C number; `math.inf` would be a Python object in compiled code
TINY = 1e-290  # avoids a division by zero [m/s], as in criticality/measures.py


def is_in_use() -> bool:
    """Return whether the pass is compiled and computes the same results as numpy."""
    if __file__.endswith(".py"):  # it runs interpreted
        return False
    angles = np.linspace(-2.0, 2.0, 256)  # numpy's sine and cosine must be the C library's
    return bool(
        (np.sin(angles) == [math.sin(angle) for angle in angles.tolist()]).all()
        and (np.cos(angles) == [math.cos(angle) for angle in angles.tolist()]).all()
    )


def extremes(
    states: FloatArray, sizes: FloatArray, road: tuple[float, float], manoeuvre_seconds: float
) -> tuple[float, float, float] | None:
    """Return the smallest time to contact, the smallest gap and the largest safety shortfall of a run.

    If the result is None, the caller must compute these values with numpy. ``road`` contains the cosine and sine of the
    road's heading.
    """
    if states.ndim != 3 or states.shape[2] != 7 or sizes.shape != (states.shape[1], 2):
        raise ValueError(
            f"states, sizes: expected the shapes [ticks + 1, vehicles, 7] and [vehicles, 2], but received "
            f"{states.shape} and {sizes.shape}. Pass the states and sizes of a trace."
        )
    return _swept(states, sizes, road[0], road[1], manoeuvre_seconds)


def _swept(
    states: Any, sizes: Any, road_cos: float, road_sin: float, seconds: float
) -> tuple[float, float, float] | None:
    min_ttc, min_gap, max_shortfall = UNENDING, UNENDING, 0.0
    al, aw = sizes[0, 0] / 2, sizes[0, 1] / 2
    for tick in range(states.shape[0]):
        for vehicle in range(states.shape[1]):
            size = 0.0
            for column in range(7):
                size += abs(states[tick, vehicle, column])
            if not size < LARGE:
                return None
        # The ego is vehicle a of the formulas and an NPC is vehicle b, at (x, y) relative to the ego.
        heading_a, speed_a = states[tick, 0, 2], states[tick, 0, 3]
        acceleration_a, lane_a = states[tick, 0, 4], states[tick, 0, 6]
        turn_a = abs(heading_a)
        fast_a = abs(speed_a) * turn_a * turn_a / 2.0
        for vehicle in range(1, states.shape[1]):
            x, y = (
                states[tick, vehicle, 0] - states[tick, 0, 0],
                states[tick, vehicle, 1] - states[tick, 0, 1],
            )
            heading_b, speed_b = states[tick, vehicle, 2], states[tick, vehicle, 3]
            bl, bw = sizes[vehicle, 0] / 2, sizes[vehicle, 1] / 2
            turn_b = abs(heading_b)

            # Lower bounds of the distance between the boxes along x and along y.
            room_x = abs(x) - (al + aw * turn_a + bl + bw * turn_b) - SLACK
            room_y = abs(y) - (aw + al * turn_a + bw + bl * turn_b) - SLACK
            room_x = room_x if room_x > 0.0 else 0.0
            room_y = room_y if room_y > 0.0 else 0.0
            apart = room_x * room_x + room_y * room_y

            # Whether upper bounds of the closing speeds along x and along y allow a shorter time to contact.
            comes = True
            fast_b = abs(speed_b) * turn_b * turn_b / 2.0
            if room_x > 0.0:
                closing = speed_a - speed_b
                closing = (closing if x > 0.0 else -closing) + fast_a + fast_b
                comes = closing > 0.0 and room_x < closing * min_ttc
            if comes and room_y > 0.0:
                closing = speed_a * heading_a - speed_b * heading_b
                closing = (closing if y > 0.0 else -closing) + (
                    fast_a * turn_a + fast_b * turn_b
                ) / 3.0
                comes = closing > 0.0 and room_y < closing * min_ttc

            # The safety distance of the paper's equation 5, if ego and NPC are in one lane. A gap that is larger than
            # ``demanded`` cannot cause a larger shortfall.
            keep = 0.0
            if lane_a == states[tick, vehicle, 6] and lane_a >= 0.0:
                gain, pull = speed_a - speed_b, acceleration_a - states[tick, vehicle, 4]
                if not x * road_cos + y * road_sin >= 0.0:
                    gain, pull = -gain, -pull
                keep = gain * seconds + pull * (seconds * seconds / 2)
            demanded = (1.0 - max_shortfall) * keep + SLACK
            near = apart < min_gap * min_gap or (keep > 0.0 and apart < demanded * demanded)
            if not (comes or near):
                continue

            # The projections of the boxes onto their four axes, as in measures.relate.
            ac, sa, bc, sb = (
                math.cos(heading_a),
                math.sin(heading_a),
                math.cos(heading_b),
                math.sin(heading_b),
            )
            cos, sin = ac * bc + sa * sb, ac * sb - sa * bc
            c, s = abs(cos), abs(sin)
            reach_0, reach_1 = al + bl * c + bw * s, aw + bl * s + bw * c
            reach_2, reach_3 = bl + al * c + aw * s, bw + al * s + aw * c
            offset_0, offset_1 = x * ac + y * sa, y * ac - x * sa
            offset_2, offset_3 = x * bc + y * sb, y * bc - x * sb

            if comes:  # the time to contact, as in measures.contact_time
                vx, vy = speed_b * bc - speed_a * ac, speed_b * sb - speed_a * sa
                begins, ends = _cut(-UNENDING, UNENDING, offset_0, reach_0, vx * ac + vy * sa)
                begins, ends = _cut(begins, ends, offset_1, reach_1, vy * ac - vx * sa)
                begins, ends = _cut(begins, ends, offset_2, reach_2, vx * bc + vy * sb)
                begins, ends = _cut(begins, ends, offset_3, reach_3, vy * bc - vx * sb)
                if begins <= ends and ends >= 0.0:
                    begins = begins if begins > 0.0 else 0.0
                    min_ttc = begins if begins < min_ttc else min_ttc
            if near:  # the distance between the boxes, as in measures.box_gap
                gap = 0.0
                if (
                    abs(offset_0) > reach_0
                    or abs(offset_1) > reach_1
                    or abs(offset_2) > reach_2
                    or abs(offset_3) > reach_3
                ):
                    from_b = _corners_to_box(
                        offset_0, offset_1, bl * cos, bl * sin, -bw * sin, bw * cos, al, aw
                    )
                    from_a = _corners_to_box(
                        offset_2, offset_3, al * cos, -al * sin, aw * sin, aw * cos, bl, bw
                    )
                    gap = math.sqrt(from_a if from_a < from_b else from_b)
                min_gap = gap if gap < min_gap else min_gap
                if keep > 0.0 and 1.0 - gap / keep > max_shortfall:
                    max_shortfall = 1.0 - gap / keep
    return (min_ttc, min_gap, max_shortfall) if min_ttc < LONGEST else None


def _cut(
    begins: float, ends: float, offset: float, reach: float, velocity: float
) -> tuple[float, float]:
    # Restrict an interval of contact to the time in which the boxes overlap along one axis.
    distance = abs(offset)
    parting = math.copysign(1.0, offset) * velocity + TINY
    near, far = (reach - distance) / parting, -(reach + distance) / parting
    first, last = (near, far) if near < far else (far, near)
    return first if first > begins else begins, last if last < ends else ends


def _corners_to_box(
    u: float,
    v: float,
    length_u: float,
    length_v: float,
    width_u: float,
    width_v: float,
    half_length: float,
    half_width: float,
) -> float:
    # The result is the squared distance from the nearest corner of one box to another box [m^2].
    # (u, v) is the centre of the first box in the frame of the second box, which is centred at the origin and has the
    # half sizes half_length and half_width. The other arguments are the half sides of the first box as vectors.
    nearest = UNENDING
    for corner in range(4):
        along, across = 1.0 if corner < 2 else -1.0, 1.0 if corner % 2 == 0 else -1.0
        outside_u = abs(u + along * length_u + across * width_u) - half_length
        outside_v = abs(v + along * length_v + across * width_v) - half_width
        outside_u = outside_u if outside_u > 0.0 else 0.0
        outside_v = outside_v if outside_v > 0.0 else 0.0
        square = outside_u * outside_u + outside_v * outside_v
        nearest = square if square < nearest else nearest
    return nearest
