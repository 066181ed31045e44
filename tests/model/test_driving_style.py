"""Styles of traffic: what is no style is refused by a scenario and by a search."""

import numpy as np
import pytest

from pytest_pafot import PositionInstruction, Scenario, ScenarioError
from pytest_pafot.model.vehicle_type import PAPERS, STYLES
from pytest_pafot.searching.space import SearchSpace
from tests.helpers.tables import table


def test_only_paper_traffic_is_not_attentive():
    assert [style for style in STYLES if not STYLES[style].is_attentive] == [PAPERS]


@table("given", [None, 3, True, [], ["hostile"], "fast", "", {"style": "paper"}, np.array(["paper", "x"])])
def test_what_is_no_style_is_refused(given):
    with pytest.raises(ScenarioError, match="traffic: expected one of paper, hostile, assertive, everyday, received"):
        Scenario(npcs=[[PositionInstruction(2, 20.0)]], traffic=given)
    with pytest.raises(ValueError, match="traffic: expected one of paper, hostile, assertive, everyday, received"):
        SearchSpace(traffic=given)
