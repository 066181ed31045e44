"""Styles of traffic: their parts, their plain form and back, and invalid values."""

import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given

from pytest_pafot.model.driving_style import BOUNDS, PAPERS, PARTS, STYLES, Traffic
from pytest_pafot.support.errors import FieldError
from tests.findings.builders import traffics
from tests.helpers.tables import table


@given(traffics())
def test_traffic_is_restored_from_plain_form_and_pickle(traffic):
    assert Traffic.of(traffic.plain()) == Traffic.of(traffic) == pickle.loads(pickle.dumps(traffic)) == traffic
    assert replace(traffic, style=traffic.style) == traffic


def test_only_paper_traffic_is_not_attentive_by_default():
    assert Traffic() == Traffic("hostile")
    assert [style for style in STYLES if not Traffic(style).is_attentive] == [PAPERS.style]


def test_part_equal_to_the_style_default_is_dropped():
    assert Traffic("everyday", **PARTS["everyday"]) == Traffic("everyday")
    assert Traffic("everyday", least_gap=np.float32(4)).plain() == {"style": "everyday", "least_gap": 4.0}


def test_traffic_description_has_style_and_its_own_parts():
    told = [each.described for each in (PAPERS, Traffic(), Traffic("everyday", least_gap=4, braking=1.5))]
    assert told == [
        "",
        "hostile traffic (NPCs may stop, brake hard and cut in close)",
        "everyday traffic (as most drivers drive, least_gap 4, braking 1.5)",
    ]


@table("part", list(BOUNDS))
@table("value", [-1, -1.0, -0.1, 1e9, 10**400, math.nan, math.inf, True, "4", [4.0], {}, np.array([4.0, 5.0])])
def test_traffic_part_out_of_bounds_is_refused(part, value):
    with pytest.raises(FieldError, match=rf"traffic\.{part}: expected a number from .* to .*, received"):
        Traffic("everyday", **{part: value})


@table("given", [None, 3, True, [], ["hostile"], "fast", "", {"gap": 4}, {1: 2}, {"style": None}, {"style": ["paper"]},
                 {"style": np.array(["paper", "x"])}, {"style": "paper", "least_gap": 4.0}])  # fmt: skip
def test_what_is_no_traffic_is_refused(given):
    with pytest.raises(FieldError, match=r"traffic.*: expected .*, received"):
        Traffic.of(given)
