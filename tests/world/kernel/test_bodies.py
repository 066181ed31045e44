"""The contact oracle, against a different method: clipping one polygon with the other."""

import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.model.trace import HEADING, X, Y
from pytest_pafot.world import Highway
from pytest_pafot.world.kernel.lanes import Box, overlap, separation, side_hit
from tests.helpers import polygons
from tests.helpers.tables import table
from tests.helpers.world_cases import random_scenario

angles = st.floats(-math.pi, math.pi)
boxes = st.builds(
    Box, st.floats(-10, 10), st.floats(-6, 6), angles, st.floats(0.5, 12), st.floats(0.5, 3)
)


def moved(box, x=0.0, y=0.0, heading=0.0):
    return Box(box.x + x, box.y + y, box.heading + heading, box.length, box.width)


def corners(box):
    return polygons.corners((box.x, box.y, box.heading), box.length, box.width)[::-1]


def shared_area(a, b):
    """Return the area of the intersection, by Sutherland and Hodgman's clipping and the shoelace formula."""
    polygon, clip = corners(a), corners(b)
    for start, end in zip(clip, clip[1:] + clip[:1], strict=True):
        clipped = []
        for p, q in zip(polygon, polygon[1:] + polygon[:1], strict=True):
            d_p, d_q = polygons.turn(start, end, p), polygons.turn(start, end, q)
            if d_p >= 0:
                clipped.append(p)
            if (d_p >= 0) != (d_q >= 0):
                t = d_p / (d_p - d_q)
                clipped.append((p[0] + t * (q[0] - p[0]), p[1] + t * (q[1] - p[1])))
        polygon = clipped
        if not polygon:
            return 0.0
    edges = zip(polygon, polygon[1:] + polygon[:1], strict=True)
    return abs(sum(p[0] * q[1] - q[0] * p[1] for p, q in edges)) / 2


@pytest.mark.parametrize("is_car", [True, False])
def test_boxes_overlap_exactly_when_they_share_an_area(is_car):
    rng, seen = random.Random(0), {True: 0, False: 0}
    for _ in range(6000):
        one = other = (5.0, 2.0)
        turn = 0.0
        if not is_car:
            one, other = ((rng.uniform(0.5, 12), rng.uniform(0.5, 3)) for _ in "ab")
            turn = rng.uniform(-math.pi, math.pi)
        a = Box(rng.uniform(-1e3, 1e3), rng.uniform(-9, 9), rng.gauss(0, 0.3), *one)
        place = a.x + rng.uniform(-7, 7), a.y + rng.uniform(-4, 4), turn + rng.gauss(0, 0.5)
        b = Box(*place, *other)
        area = shared_area(a, b)
        if not 0 < area < 1e-9:
            assert overlap(a, b) == (area > 0), (a, b)
            seen[area > 0] += 1
    assert min(seen.values()) > 1000


@given(boxes, boxes)
def test_contact_is_symmetric_and_independent_of_position(a, b):
    met = overlap(a, b)
    assert overlap(b, a) == met
    for turned in (math.pi, -math.pi):
        if abs(max(*separation(a, b), *separation(b, a))) > 1e-9:
            assert overlap(moved(a, heading=turned), b) == met
            assert overlap(moved(a, x=300.0), moved(b, x=300.0)) == met


def test_boxes_sharing_only_a_border_do_not_touch():
    ego = Box(0.0, 0.0, 0.0, 5.0, 2.0)
    assert not overlap(ego, moved(ego, x=5.0))
    assert not overlap(ego, moved(ego, y=-2.0))
    assert not overlap(ego, moved(ego, x=5.0, y=2.0))
    assert overlap(ego, moved(ego, x=5.0 - 1e-9))
    assert overlap(ego, ego)


@given(boxes, boxes)
def test_separation_is_projection_gap_on_first_box_axes(a, b):
    cos_h, sin_h = math.cos(a.heading), math.sin(a.heading)
    for gap, axis in zip(separation(a, b), ((cos_h, sin_h), (-sin_h, cos_h)), strict=True):
        along_a, along_b = ([x * axis[0] + y * axis[1] for x, y in corners(box)] for box in (a, b))
        expected = max(min(along_b) - max(along_a), min(along_a) - max(along_b))
        if expected > 0:
            assert gap == pytest.approx(expected, abs=1e-9)
        else:
            assert gap <= 1e-9


EGO = Box(0.0, 0.0, 0.0, 5.0, 2.0)


@table(("other", "side"), [
    (Box(6.0, 0.0, 0.0, 5.0, 2.0), "front"),
    (Box(-6.0, 0.0, 0.0, 5.0, 2.0), "rear"),
    (Box(0.0, 2.3, 0.0, 5.0, 2.0), "right"),
    (Box(0.0, -2.3, 0.0, 5.0, 2.0), "left"),
    (Box(6.0, 1.9, 0.0, 5.0, 2.0), "front"),  # offset, but still in the way
    (Box(4.8, 2.3, -0.2, 5.0, 2.0), "right"),  # cuts in from the side
    (Box(-5.5, 1.0, 0.1, 5.0, 2.0), "rear"),
    (Box(5.3, 2.1, -0.1, 5.0, 2.0), "front"),  # over the corner, further apart ahead
])  # fmt: skip
@table("turn", [0.0, 1.0, math.pi / 2, -2.5, math.pi])
def test_side_hit_is_relative_to_ego_heading(other, side, turn):
    cos_t, sin_t = math.cos(turn), math.sin(turn)
    ego = moved(EGO, x=300.0, y=4.0, heading=turn)
    x, y = 300.0 + other.x * cos_t - other.y * sin_t, 4.0 + other.x * sin_t + other.y * cos_t
    turned = Box(x, y, other.heading + turn, other.length, other.width)
    assert side_hit(ego, turned) == side


def weaving():
    return lambda observation: (0.0, 0.04 if int(observation.time / 3) % 2 else -0.04)


def test_side_hit_is_that_of_last_tick_apart():
    rng, differ = random.Random(5), 0
    for _ in range(160):
        scenario = random_scenario(rng, lanes=4, speed_limit=26.8)
        trace = Highway(duration=30.0).rollout(scenario, weaving)
        if (hit := trace.collision) is None:
            continue
        both = [0, hit.npc + 1]
        sizes = trace.sizes[both].tolist()
        poses = trace.states[hit.tick - 1 : hit.tick + 1, both][..., [X, Y, HEADING]].tolist()
        before, overlapping = (
            [Box(*pose, *size) for pose, size in zip(each, sizes, strict=True)] for each in poses
        )
        assert not overlap(*before)
        assert hit.side == side_hit(*before)
        differ += side_hit(*overlapping) != hit.side
    assert differ, "the tick of the contact would tell the same"
