"""An oracle for boxes: plain scalar Python on corners and edges, without separating axes."""

from __future__ import annotations

import math

from pytest_pafot.model.trace import HEADING, SPEED, X, Y
from tests.helpers.traces import LENGTH, WIDTH


def corners(state, length=LENGTH, width=WIDTH):
    x, y, cos, sin = state[X], state[Y], math.cos(state[HEADING]), math.sin(state[HEADING])
    signs = ((1, 1), (1, -1), (-1, -1), (-1, 1))
    halves = [(a * length / 2, b * width / 2) for a, b in signs]
    return [(x + a * cos - b * sin, y + a * sin + b * cos) for a, b in halves]


def moved(state, seconds):
    state = state.copy()
    state[X] += seconds * state[SPEED] * math.cos(state[HEADING])
    state[Y] += seconds * state[SPEED] * math.sin(state[HEADING])
    return state


def polygons_meet(p, q):
    """Return whether a corner of a convex polygon is inside another, or two of their edges cross."""
    if contains(p, q[0]) or contains(q, p[0]):
        return True
    return any(cross_each_other(*a, *b) for a in edges_of(p) for b in edges_of(q))


def polygon_distance(p, q):
    """Return the distance of two convex polygons."""
    if polygons_meet(p, q):
        return 0.0
    edges = [(a, b) for a in edges_of(p) for b in edges_of(q)]
    both = [*edges, *((b, a) for a, b in edges)]
    return min(point_to_segment(end, *b) for a, b in both for end in a)


def edges_of(polygon):
    return list(zip(polygon, polygon[1:] + polygon[:1], strict=True))


def turn(a, b, c):
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def contains(polygon, point):
    turns = [turn(a, b, point) for a, b in edges_of(polygon)]
    return all(t <= 0 for t in turns) or all(t >= 0 for t in turns)


def cross_each_other(a, b, c, d):
    return turn(a, b, c) * turn(a, b, d) < 0 and turn(c, d, a) * turn(c, d, b) < 0


def point_to_segment(point, a, b):
    dx, dy = b[0] - a[0], b[1] - a[1]
    share = ((point[0] - a[0]) * dx + (point[1] - a[1]) * dy) / (dx * dx + dy * dy)
    share = min(1.0, max(0.0, share))
    return math.hypot(point[0] - a[0] - share * dx, point[1] - a[1] - share * dy)


def distance_after(ego, npc, seconds):
    return polygon_distance(corners(moved(ego[0], seconds)), corners(moved(npc[0], seconds)))
