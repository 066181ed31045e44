# cython: boundscheck=False, initializedcheck=False, wraparound=False, cdivision=True, auto_pickle=False
# The checks are off because no index exceeds the shapes that the constructor checks and no divisor is zero.
"""One pass over the ticks of a run for the three extremes that a search reads of every run, in typed, plain Python.

The values equal those of :class:`~pytest_pafot.criticality.measures.Encounters` to the last bit, because the pass does
the same operations in the same order. It skips ticks if bounds show that they cannot be extreme. The compiled pass
takes a tenth of the time of numpy's whole arrays. The interpreted pass would be slower than numpy's arrays, so an
installation without compiled code uses the arrays.

The bounds need no trigonometry: a sine is at most its angle h and differs from it by at most h^3 / 6, and a cosine is
between 1 - h^2 / 2 and 1. ``SLACK`` is far more than all rounding, up to the sizes and times that are accepted.
"""

from __future__ import annotations

import math
import os
from typing import Any

import numpy as np

from pytest_pafot.model.trace import FloatArray

SLACK = 1e-6
"""The margin that is added to the bounds, so that rounding never makes them skip a tick that is extreme [m]."""
LARGE = 1e6
"""The limit for the sum of the absolute values of a vehicle's state. For a larger sum or NaN, numpy's arrays replace
this pass."""
LONGEST = 1e5
"""The limit for the least time to contact [s]. If it is longer or infinite, numpy's arrays replace this pass."""
TINY = 1e-290
"""A tiny velocity that avoids a division by zero [m/s], as in :mod:`~pytest_pafot.criticality.boxes`."""


def is_compiled() -> bool:
    """Return whether this module is compiled."""
    return not __file__.endswith(".py")


def is_in_use() -> bool:
    """Return whether the compiled pass replaces numpy's arrays, which it does only if both give the same results."""
    if not is_compiled() or os.environ.get("PAFOT_KERNEL") == "interpreted":
        return False
    angles = np.linspace(-2.0, 2.0, 256)  # numpy's sine and cosine must be the C library's
    return bool(
        (np.sin(angles) == [math.sin(angle) for angle in angles.tolist()]).all()
        and (np.cos(angles) == [math.cos(angle) for angle in angles.tolist()]).all()
    )


class Sweep:
    """A pass over the ticks of a run, which computes the extremes of three measures.

    Args:
        states: states of a trace, shape [ticks + 1, vehicles, 7].
        sizes: sizes of a trace, shape [vehicles, 2].
        road: cosine and sine of the road's heading.
        manoeuvre_seconds: time to manoeuvre, t in the equation of the safety distance [s].

    Attributes:
        min_ttc, min_gap, max_safety_shortfall: see the functions of these names; valid if :meth:`run` returned True.
    """

    def __init__(
        self, states: FloatArray, sizes: FloatArray, road: tuple[float, float], manoeuvre_seconds: float
    ) -> None:
        if states.ndim != 3 or states.shape[2] != 7 or sizes.shape != (states.shape[1], 2):
            raise ValueError(
                f"states, sizes: expected the shapes [ticks + 1, vehicles, 7] and [vehicles, 2], received "
                f"{states.shape} and {sizes.shape}; give those of a trace"
            )
        self.min_ttc = math.inf
        self.min_gap = math.inf
        self.max_safety_shortfall = 0.0
        self._states: Any = states
        self._sizes: Any = sizes
        self._road_cos, self._road_sin = road
        self._seconds = manoeuvre_seconds
        self._half_seconds_squared = manoeuvre_seconds * manoeuvre_seconds / 2
        self._ticks = states.shape[0]
        self._vehicles = states.shape[1]
        self._al, self._aw = sizes[0, 0] / 2, sizes[0, 1] / 2

    def run(self) -> bool:
        """Read all ticks and return whether the results are valid; if not, the caller has to use numpy's arrays."""
        for tick in range(self._ticks):
            if not self._is_sane(tick):
                return False
            self._see_ego(tick)
            for vehicle in range(1, self._vehicles):
                self._see(tick, vehicle)
                self._measure()
        return self.min_ttc < LONGEST

    def _is_sane(self, tick: int) -> bool:
        for vehicle in range(self._vehicles):
            size = 0.0
            for column in range(7):
                size += abs(self._states[tick, vehicle, column])
            if not size < LARGE:
                return False
        return True

    def _see_ego(self, tick: int) -> None:
        """Read the ego's state at a tick, as vehicle a of the formulas."""
        self._ax, self._ay = self._states[tick, 0, 0], self._states[tick, 0, 1]
        self._heading_a, self._speed_a = self._states[tick, 0, 2], self._states[tick, 0, 3]
        self._acceleration_a, self._lane_a = self._states[tick, 0, 4], self._states[tick, 0, 6]

    def _see(self, tick: int, vehicle: int) -> None:
        """Read an NPC's state at a tick, as vehicle b of the formulas; its position is relative to the ego's."""
        self._x = self._states[tick, vehicle, 0] - self._ax
        self._y = self._states[tick, vehicle, 1] - self._ay
        self._heading_b, self._speed_b = self._states[tick, vehicle, 2], self._states[tick, vehicle, 3]
        self._acceleration_b, self._lane_b = self._states[tick, vehicle, 4], self._states[tick, vehicle, 6]
        self._bl, self._bw = self._sizes[vehicle, 0] / 2, self._sizes[vehicle, 1] / 2

    def _measure(self) -> None:
        """Update the extremes from the present pair; compute exactly only if the bounds allow a new extreme."""
        turn_a, turn_b = abs(self._heading_a), abs(self._heading_b)
        # Lower bounds of the distance between the boxes along x and along y.
        room_x = abs(self._x) - (self._al + self._aw * turn_a + self._bl + self._bw * turn_b) - SLACK
        room_y = abs(self._y) - (self._aw + self._al * turn_a + self._bw + self._bl * turn_b) - SLACK
        room_x = room_x if room_x > 0.0 else 0.0
        room_y = room_y if room_y > 0.0 else 0.0
        apart = room_x * room_x + room_y * room_y
        comes = self._may_come(room_x, room_y, turn_a, turn_b)
        keep = self._safety_distance()
        demanded = (1.0 - self.max_safety_shortfall) * keep + SLACK  # a larger gap cannot be a larger shortfall
        near = apart < self.min_gap * self.min_gap or (keep > 0.0 and apart < demanded * demanded)
        if not (comes or near):
            return
        self._relate()
        if comes:
            time = self._contact_time()
            self.min_ttc = time if time < self.min_ttc else self.min_ttc
        if near:
            gap = self._gap()
            self.min_gap = gap if gap < self.min_gap else self.min_gap
            if keep > 0.0 and 1.0 - gap / keep > self.max_safety_shortfall:
                self.max_safety_shortfall = 1.0 - gap / keep

    def _may_come(self, room_x: float, room_y: float, turn_a: float, turn_b: float) -> bool:
        """Return whether bounds along x and y allow a shorter time to contact than the shortest one so far."""
        fast_a, fast_b = abs(self._speed_a) * turn_a * turn_a / 2.0, abs(self._speed_b) * turn_b * turn_b / 2.0
        if room_x > 0.0:
            closing = self._speed_a - self._speed_b
            closing = (closing if self._x > 0.0 else -closing) + fast_a + fast_b
            if closing <= 0.0 or room_x >= closing * self.min_ttc:
                return False
        if room_y > 0.0:
            closing = self._speed_a * self._heading_a - self._speed_b * self._heading_b
            closing = (closing if self._y > 0.0 else -closing) + (fast_a * turn_a + fast_b * turn_b) / 3.0
            if closing <= 0.0 or room_y >= closing * self.min_ttc:
                return False
        return True

    def _safety_distance(self) -> float:
        """Return the safety distance of the paper's equation 5 [m] if ego and NPC are in one lane, else 0."""
        if self._lane_a != self._lane_b or self._lane_a < 0.0:
            return 0.0
        gain = self._speed_a - self._speed_b
        pull = self._acceleration_a - self._acceleration_b
        if not self._x * self._road_cos + self._y * self._road_sin >= 0.0:
            gain, pull = -gain, -pull
        distance: float = gain * self._seconds + pull * self._half_seconds_squared
        return distance

    def _relate(self) -> None:
        """Project the boxes onto their four axes, as :func:`pytest_pafot.criticality.boxes.relate` does."""
        self._ac, self._as = math.cos(self._heading_a), math.sin(self._heading_a)
        self._bc, self._bs = math.cos(self._heading_b), math.sin(self._heading_b)
        ac, sa, bc, sb = self._ac, self._as, self._bc, self._bs
        x, y = self._x, self._y
        self._turn_cos = ac * bc + sa * sb
        self._turn_sin = ac * sb - sa * bc
        c, s = abs(self._turn_cos), abs(self._turn_sin)
        self._reach_0 = self._al + self._bl * c + self._bw * s
        self._reach_1 = self._aw + self._bl * s + self._bw * c
        self._reach_2 = self._bl + self._al * c + self._aw * s
        self._reach_3 = self._bw + self._al * s + self._aw * c
        self._offset_0, self._offset_1 = x * ac + y * sa, y * ac - x * sa
        self._offset_2, self._offset_3 = x * bc + y * sb, y * bc - x * sb

    def _contact_time(self) -> float:
        """Return the time to contact [s], as :func:`pytest_pafot.criticality.boxes.contact_time` computes it."""
        ac, sa, bc, sb = self._ac, self._as, self._bc, self._bs
        vx, vy = self._speed_b * bc - self._speed_a * ac, self._speed_b * sb - self._speed_a * sa
        self._begins, self._ends = -math.inf, math.inf
        self._cut(self._offset_0, self._reach_0, vx * ac + vy * sa)
        self._cut(self._offset_1, self._reach_1, vy * ac - vx * sa)
        self._cut(self._offset_2, self._reach_2, vx * bc + vy * sb)
        self._cut(self._offset_3, self._reach_3, vy * bc - vx * sb)
        if self._begins > self._ends or self._ends < 0.0:
            return math.inf
        return self._begins if self._begins > 0.0 else 0.0

    def _cut(self, offset: float, reach: float, velocity: float) -> None:
        """Restrict the time of contact to the time in which the boxes overlap along one axis."""
        distance = abs(offset)
        parting = math.copysign(1.0, offset) * velocity + TINY
        near, far = (reach - distance) / parting, -(reach + distance) / parting
        first, last = (near, far) if near < far else (far, near)
        self._begins = first if first > self._begins else self._begins
        self._ends = last if last < self._ends else self._ends

    def _gap(self) -> float:
        """Return the distance between the boxes [m], as :func:`pytest_pafot.criticality.boxes.box_gap` computes it."""
        if (
            abs(self._offset_0) <= self._reach_0
            and abs(self._offset_1) <= self._reach_1
            and abs(self._offset_2) <= self._reach_2
            and abs(self._offset_3) <= self._reach_3
        ):
            return 0.0
        cos, sin = self._turn_cos, self._turn_sin
        al, aw, bl, bw = self._al, self._aw, self._bl, self._bw
        from_b = _corners_to_box(self._offset_0, self._offset_1, bl * cos, bl * sin, -bw * sin, bw * cos, al, aw)
        from_a = _corners_to_box(self._offset_2, self._offset_3, al * cos, -al * sin, aw * sin, aw * cos, bl, bw)
        return math.sqrt(from_a if from_a < from_b else from_b)


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
    """Return the squared distance from the nearest corner of one box to another box [m^2].

    ``(u, v)`` is the centre of the first box in the frame of the second box, which is centred at the origin and has the
    half sizes ``half_length`` and ``half_width``. The other arguments are the half sides of the first box as vectors.
    """
    nearest = _square(u + length_u + width_u, v + length_v + width_v, half_length, half_width)
    square = _square(u + length_u - width_u, v + length_v - width_v, half_length, half_width)
    nearest = square if square < nearest else nearest
    square = _square(u - length_u + width_u, v - length_v + width_v, half_length, half_width)
    nearest = square if square < nearest else nearest
    square = _square(u - length_u - width_u, v - length_v - width_v, half_length, half_width)
    return square if square < nearest else nearest


def _square(u: float, v: float, half_length: float, half_width: float) -> float:
    """Return the squared distance from the point (u, v) to a box that is centred at the origin [m^2]."""
    outside_u, outside_v = abs(u) - half_length, abs(v) - half_width
    outside_u = outside_u if outside_u > 0.0 else 0.0
    outside_v = outside_v if outside_v > 0.0 else 0.0
    return outside_u * outside_u + outside_v * outside_v
