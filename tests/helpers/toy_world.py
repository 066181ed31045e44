"""A world without physics, whose ADS does whatever a test wants with a scenario, in any process."""

import numpy as np

from pytest_pafot.model.instructions import Cell, PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Lane, Outcome, Trace


def scenario(number):
    """Return the scenario with a number; the ADS distinguishes scenarios by their seeds."""
    return Scenario(npcs=((PositionInstruction(Cell.FRONT, 20.0),),), seed=number)


def trace_of(scenario):
    """Return a trace in which nothing moves."""
    return Trace(
        scenario=scenario,
        executed=scenario,
        outcome=Outcome.SAFE,
        states=np.full((2, 2, 7), float(scenario.seed)),
        sizes=np.full((2, 2), 2.0),
        lanes=(Lane(x=0.0, y=0.0, heading=0.0, length=1000.0, width=4.0, speed_limit=30.0),),
        physics_hz=15,
        ads_hz=5,
        arrivals=((0,),),
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
