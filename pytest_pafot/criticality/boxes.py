"""Oriented boxes that move at constant velocity: overlap, distance and time to contact, vectorised and exact.

Two convex shapes are apart exactly when some axis separates their projections; for rectangles it is enough to
look along the four edge directions (separating axis theorem; Gottschalk, Lin, Manocha, "OBBTree", SIGGRAPH
1996). Along each axis, moving boxes overlap during one interval of time, so they touch during the intersection of the
four intervals (the swept form of the theorem).

All arrays broadcast against each other; results have their common shape. Boxes that only touch count as overlapping.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
import numpy.typing as npt

from pytest_pafot.model.trace import FloatArray

_TINY = 1e-290
"""A tiny velocity that is added to relative velocities, so that no division is by zero [m/s]. Any velocity other than
zero stays the same, and a division by it does not overflow."""

FourAxes = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""One array per axis. A single stacked array would be so large that the allocator returns it to the system each time,
and faulting its pages in again takes several times as long as the arithmetic."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Boxes:
    """Rectangles that move without turning.

    Attributes:
        x, y: centres [m].
        cos, sin: cosines and sines of the headings; a heading points along the length.
        vx, vy: velocities [m/s].
        half_length, half_width: half of the lengths and of the widths [m].
    """

    x: FloatArray
    y: FloatArray
    cos: FloatArray
    sin: FloatArray
    vx: FloatArray
    vy: FloatArray
    half_length: FloatArray
    half_width: FloatArray

    @classmethod
    def driving(
        cls, x: FloatArray, y: FloatArray, heading: FloatArray, speed: FloatArray, length: FloatArray, width: FloatArray
    ) -> Boxes:
        """Make boxes that move along their heading [m, rad, m/s]; a negative speed means backwards."""
        cos, sin = np.cos(heading), np.sin(heading)
        return cls(
            x=x, y=y, cos=cos, sin=sin, vx=speed * cos, vy=speed * sin, half_length=length / 2, half_width=width / 2
        )

    def part(self, vehicles: slice, ticks: slice) -> Boxes:
        """Return the boxes of some vehicles at some ticks; these boxes have shape [vehicles, ticks]."""
        moving = {name: getattr(self, name)[vehicles, ticks] for name in ("x", "y", "cos", "sin", "vx", "vy")}
        return Boxes(**moving, half_length=self.half_length[vehicles], half_width=self.half_width[vehicles])


@dataclass(frozen=True, slots=True, kw_only=True)
class Pairs:
    """Pairs of boxes a and b, projected onto the four axes that can separate them.

    The axes are a's length, a's width, b's length and b's width.

    Attributes:
        a, b: the boxes of each pair.
        offsets: offset of b's centre from a's, along each axis [m].
        reaches: half extent of a plus half extent of b along each axis [m]; the boxes overlap there below this offset.
        cos, sin: cosine and sine of b's heading relative to a's.
    """

    a: Boxes
    b: Boxes
    offsets: FourAxes
    reaches: FourAxes
    cos: FloatArray
    sin: FloatArray


def relate(a: Boxes, b: Boxes) -> Pairs:
    """Project the pairs (a, b) onto their four axes, which all measures of this module need."""
    cos = a.cos * b.cos + a.sin * b.sin
    sin = a.cos * b.sin - a.sin * b.cos
    c, s = np.abs(cos), np.abs(sin)
    reaches = (
        a.half_length + b.half_length * c + b.half_width * s,
        a.half_width + b.half_length * s + b.half_width * c,
        b.half_length + a.half_length * c + a.half_width * s,
        b.half_width + a.half_length * s + a.half_width * c,
    )
    return Pairs(a=a, b=b, offsets=_along_axes(a, b, b.x - a.x, b.y - a.y), reaches=reaches, cos=cos, sin=sin)


def overlaps(pairs: Pairs) -> npt.NDArray[np.bool_]:
    """Return whether the boxes have a point in common, which means that no axis separates them."""
    result: npt.NDArray[np.bool_] = np.ones(pairs.cos.shape, dtype=np.bool_)
    for offset, reach in zip(pairs.offsets, pairs.reaches, strict=True):
        result &= np.abs(offset) <= reach
    return result


def depth(pairs: Pairs) -> FloatArray:
    """Return how deep the boxes overlap along the axis with the least overlap [m]; negative if they are apart."""
    spare = [reach - np.abs(offset) for offset, reach in zip(pairs.offsets, pairs.reaches, strict=True)]
    result: FloatArray = np.min(spare, axis=0)
    return result


def box_gap(pairs: Pairs) -> FloatArray:
    """Return the smallest distance between the boxes [m], 0 at overlap; lower is worse.

    The smallest distance between two separate rectangles is always at a corner of one of them.
    """
    a, b = pairs.a, pairs.b
    along, across, back_along, back_across = pairs.offsets
    from_b = _corners_to_box(along, across, pairs.cos, pairs.sin, a, b)
    # As seen from b, the offset has the opposite sign. That mirrors the set of a's corners in b's centre, which does
    # not change their distances from b's box, so the sign can stay.
    from_a = _corners_to_box(back_along, back_across, pairs.cos, -pairs.sin, b, a)
    return np.where(overlaps(pairs), 0.0, np.sqrt(np.minimum(from_a, from_b)))


def contact_time(pairs: Pairs) -> FloatArray:
    """Return the time until the boxes first touch if both keep their velocity and heading [s]; lower is worse.

    The time is 0 at overlap, and infinite if the boxes never touch. Along each of the four axes, the projections of the
    boxes overlap during one interval of time. Contact begins when the last of these four intervals begins, unless one
    of them has ended by then.
    """
    velocities = _along_axes(pairs.a, pairs.b, pairs.b.vx - pairs.a.vx, pairs.b.vy - pairs.a.vy)
    begins: FloatArray = np.full(pairs.cos.shape, -np.inf)
    ends: FloatArray = np.full(pairs.cos.shape, np.inf)
    for offset, reach, velocity in zip(pairs.offsets, pairs.reaches, velocities, strict=True):
        distance = np.abs(offset)
        parting = np.copysign(1.0, offset) * velocity + _TINY
        near, far = (reach - distance) / parting, -(reach + distance) / parting
        begins = np.maximum(begins, np.minimum(near, far))
        ends = np.minimum(ends, np.maximum(near, far))
    # This order makes NaN fail the comparisons, so the result is NaN.
    return np.where((begins > ends) | (ends < 0), np.inf, np.maximum(begins, 0.0))


def _along_axes(a: Boxes, b: Boxes, x: FloatArray, y: FloatArray) -> FourAxes:
    """Return the components of the vector (x, y) along the four axes of the boxes a and b."""
    return x * a.cos + y * a.sin, y * a.cos - x * a.sin, x * b.cos + y * b.sin, y * b.cos - x * b.sin


def _corners_to_box(
    u: FloatArray, v: FloatArray, cos: FloatArray, sin: FloatArray, box: Boxes, other: Boxes
) -> FloatArray:
    """Return the squared distance from the nearest corner of ``other`` to ``box`` [m^2].

    ``(u, v)`` is the centre of ``other`` in the frame of ``box``. ``cos`` and ``sin`` are the cosine and sine of the
    heading of ``other`` in that frame.
    """
    length_u, length_v = other.half_length * cos, other.half_length * sin
    width_u, width_v = -other.half_width * sin, other.half_width * cos
    nearest: FloatArray = np.full(u.shape, np.inf)
    for move, side in product((np.add, np.subtract), repeat=2):
        outside_u = np.maximum(np.abs(side(move(u, length_u), width_u)) - box.half_length, 0.0)
        outside_v = np.maximum(np.abs(side(move(v, length_v), width_v)) - box.half_width, 0.0)
        nearest = np.minimum(nearest, outside_u * outside_u + outside_v * outside_v)
    return nearest
