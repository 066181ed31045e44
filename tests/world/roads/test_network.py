"""Lines of roads, the speeds that their bends allow, and how vehicles lean in them, computed by hand."""

import math

import numpy as np
import pytest
from highway_env.road.lane import StraightLane

from pytest_pafot.world import NpcLimits
from pytest_pafot.world.kernel.lanes import even_rounded
from pytest_pafot.world.roads.network import (
    BEND_SHARE,
    SLOWING,
    SPEED_LAG,
    Piece,
    allowed_speeds,
    leans,
    line_of,
    sharpest_ahead,
)
from pytest_pafot.world.roads.survey import _curvature
from tests.helpers.tables import table

LENGTHS = np.arange(0.0, 200.0)
RADIUS = 20.0
BEND = np.where((LENGTHS >= 100) & (LENGTHS <= 140), 1 / RADIUS, 0.0)
LIMITS = NpcLimits()
IN_THE_BEND = math.sqrt(BEND_SHARE * LIMITS.lateral_acceleration * RADIUS)


@pytest.mark.parametrize("side", [1, -1])
def test_bend_to_either_side_is_driven_slowly_throughout(side):
    speed = allowed_speeds(side * BEND, np.full(200, 20.0), None, LENGTHS, LIMITS)
    assert speed[100:141] == pytest.approx(IN_THE_BEND)
    assert speed[141:] == pytest.approx(LIMITS.overspeed * 20.0)
    for before in range(100):
        then = math.sqrt(IN_THE_BEND**2 + 2 * SLOWING * (100 - before))
        ahead = min(100 - before, math.floor(then * SPEED_LAG) + 1)
        expected = math.sqrt(IN_THE_BEND**2 + 2 * SLOWING * (100 - before - ahead))
        assert speed[before] == pytest.approx(min(expected, LIMITS.overspeed * 20.0)), before
    sharpest = sharpest_ahead(side * BEND, LENGTHS, 30.0)
    assert sharpest.tolist() == [1 / RADIUS if 70 <= length <= 140 else 0.0 for length in LENGTHS]


def test_nobody_drives_beyond_the_end_of_a_lane():
    speed = allowed_speeds(np.zeros(200), np.full(200, 20.0), 150.0, LENGTHS, LIMITS)
    assert (speed[150:] == 0.0).all()
    # 9.4 m on while the control lags behind
    assert speed[100] == pytest.approx(math.sqrt(2 * SLOWING * (50 - 10)))


@pytest.mark.parametrize("side", [1, -1])
def test_curvature_of_a_circle_follows_its_radius(side):
    direction = side * LENGTHS / RADIUS
    assert _curvature(direction, LENGTHS) == pytest.approx(np.full(200, side / RADIUS))
    assert leans(direction, LENGTHS, 5.0)[-1] == pytest.approx(-side * math.asin(2.5 / RADIUS))


@table("exact", np.arange(-8, 80) / 8)
def test_points_are_rounded_as_python_rounds(exact):
    assert even_rounded(exact) == round(exact)


def test_joint_near_the_start_of_a_line_leaves_its_start_in_place():
    """Eight metres before the joint, the rounding is over but for a few millimetres; the line goes straight there."""
    lanes = StraightLane([0, 0], [8, 0]), StraightLane([8, 0], [48, 8])
    line = line_of([Piece(("a", "b", 0), lane, 0.0, float(lane.length)) for lane in lanes])
    assert (line.x[0], line.y[0]) == pytest.approx((0.0, 0.0), abs=0.01)
    assert line.heading[:4] == pytest.approx(0.0, abs=0.02)
    assert np.hypot(np.diff(line.x), np.diff(line.y))[:-1] == pytest.approx(0.5, abs=0.01)
