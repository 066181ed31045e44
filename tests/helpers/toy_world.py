"""A world without physics, whose ADS does whatever a test wants with a scenario, in any process."""

import numpy as np

from pytest_pafot.model.instructions import Cell, PositionInstruction
from pytest_pafot.model.scenario import Scenario
from tests.helpers import traces


def scenario(number):
    """Return the scenario with a number; the ADS distinguishes scenarios by their seeds."""
    return Scenario(npcs=((PositionInstruction(Cell.FRONT, 20.0),),), seed=number)


def trace_of(scenario):
    """Return a trace in which nothing moves."""
    states = np.full((2, 2, 7), float(scenario.seed))
    return traces.trace_of(
        *states, scenario=scenario, lanes=traces.straight_lanes(1), arrivals=((0,),)
    )


class Toy:
    """A world that passes the number of each scenario to the ADS."""

    hang_limit = 30.0

    def rollout(self, scenario, ads_factory):
        ads_factory()(scenario.seed)
        return trace_of(scenario)


def idle():
    """Return an ADS that does nothing; this factory can be imported."""
    return lambda number: None
