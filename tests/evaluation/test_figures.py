"""Figures tell all algorithms apart."""

from pytest_pafot.evaluation.figures import STYLES
from pytest_pafot.searching import ALGORITHMS


def test_each_algorithm_has_a_colour_a_line_a_marker_and_a_hatch_of_its_own():
    assert len(STYLES) >= len(ALGORITHMS)
    for name in ("colour", "line", "marker", "hatch"):
        assert len({getattr(style, name) for style in STYLES}) == len(STYLES), name
