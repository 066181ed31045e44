"""The policies with planted defects are complete, are split into random halves, and drive."""

from collections import Counter

import pytest

from pytest_pafot import Cell, Highway, Outcome, PositionInstruction, Scenario
from tests.benchmarks.planted import PLANTED, SET_ASIDE, TUNING

WORLD = Highway(duration=8.0)
CELLS = ((Cell.FRONT, 12.0), (Cell.LEFT, 26.0), (Cell.RIGHT, 15.0), (Cell.REAR, 20.0))
BUSY = Scenario(npcs=tuple((PositionInstruction(cell, speed),) for cell, speed in CELLS), seed=0)


def test_planted_policies_cover_eight_kinds_and_three_difficulties():
    assert Counter(policy.kind for policy in PLANTED.values()) == dict.fromkeys(
        ("keeping", "changing", "sampling", "tabled", "learned", "vehicle", "predicting", "merging"), 5
    )
    assert Counter(policy.conditions for policy in PLANTED.values()) == {1: 13, 2: 14, 3: 13}


def test_halves_are_disjoint_and_alike():
    assert not set(TUNING) & set(SET_ASIDE)
    assert set(TUNING) | set(SET_ASIDE) == set(PLANTED)
    for half in (TUNING, SET_ASIDE):
        assert len(half) == 20
        assert set(Counter(PLANTED[name].conditions for name in half).values()) <= {6, 7}
        assert set(Counter(PLANTED[name].kind for name in half).values()) <= {2, 3}


@pytest.mark.parametrize("name", sorted(PLANTED))
def test_policy_and_twin_drive(name):
    for make in (PLANTED[name].make, PLANTED[name].twin):
        trace, again = (WORLD.rollout(BUSY, make()) for _ in range(2))
        assert trace.outcome is not Outcome.ADS_ERROR
        assert (trace.states == again.states).all()
