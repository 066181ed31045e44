"""The policies with planted defects drive, the same in each run."""

import pytest

from pytest_pafot import Cell, Highway, PositionInstruction, Scenario
from pytest_pafot.model.trace import Outcome
from tests.benchmarks.planted import PLANTED

WORLD = Highway(duration=8.0)
CELLS = ((Cell.FRONT, 12.0), (Cell.LEFT, 26.0), (Cell.RIGHT, 15.0), (Cell.REAR, 20.0))
BUSY = Scenario(npcs=tuple((PositionInstruction(cell, speed),) for cell, speed in CELLS), seed=0)


@pytest.mark.parametrize("name", sorted(PLANTED))
def test_policy_and_twin_drive(name):
    for make in (PLANTED[name].make, PLANTED[name].twin):
        trace, again = (WORLD.rollout(BUSY, make()) for _ in range(2))
        assert trace.outcome is not Outcome.ADS_ERROR
        assert (trace.states == again.states).all()
