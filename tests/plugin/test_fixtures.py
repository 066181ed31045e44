"""The fixtures for ordinary tests, and the world that may be overridden."""

import pytest


def test_pafot_simulate_runs_a_scenario_against_any_ads_and_fails_if_it_fails(project):
    project.write("""
SCENARIO = pafot.Scenario(npcs=((pafot.PositionInstruction(2, 5.0),),), gene_seconds=5)

def broken(observation):
    return observation.ego.sped, 0.0

def test_simulates(pafot_simulate):
    run = pafot_simulate(SCENARIO, lambda: lambda observation: (0.0, 0.0))
    assert isinstance(run, pafot.Run)
    assert run.scenario == SCENARIO

def test_takes_another_world(pafot_simulate):
    run = pafot_simulate(SCENARIO, lambda: lambda observation: (0.0, 0.0), world=pafot.Highway(lanes=3, duration=1.0))
    assert (len(run.trace.lanes), run.duration) == (3, 1.0)

def test_takes_no_world_that_is_none(pafot_simulate):
    with pytest.raises(ValueError, match="pafot.Highway"):
        pafot_simulate(SCENARIO, lambda: lambda observation: (0.0, 0.0), world={})

def test_fails(pafot_simulate):
    assert not pafot_simulate(SCENARIO, lambda: broken).collision
""")
    project.run().assert_outcomes(passed=3, failed=1)


@pytest.mark.processes
def test_pafot_simulate_works_in_hypothesis_without_late_imports(project):
    project.write("""
import sys
from hypothesis import HealthCheck, given, settings

# Without limits of time: what else the machine does may make any run or any drawing of a scenario slow.
@settings(max_examples=5, database=None, deadline=None, suppress_health_check=list(HealthCheck))
@given(scenario=pafot.strategies.scenarios())
def test_any(pafot_simulate, scenario):
    world, before = pafot.Highway(duration=2.0), {*sys.modules}
    assert pafot_simulate(scenario, lambda: lambda observation: (0.0, 0.0), world=world).duration <= 2.0
    assert sys.modules.keys() == before
""")
    project.run(fresh=True, plugins=("hypothesispytest",)).assert_outcomes(passed=1)


def test_overridden_world_applies_to_searches_and_pafot_simulate(project):
    project.write("""
@pytest.fixture(scope="session")
def pafot_world():
    return pafot.Highway(lanes=3, duration=2.0)

@pafot.search
def test_search(run):
    assert (len(run.trace.lanes), run.duration) == (3, 2.0)

@pafot.search(world=pafot.Highway(lanes=6, duration=1.0))
def test_the_mark_wins(run):
    assert (len(run.trace.lanes), run.duration) == (6, 1.0)

def test_simulate(pafot_simulate):
    scenario = pafot.Scenario(npcs=((pafot.PositionInstruction(2, 5.0),),))
    assert pafot_simulate(scenario, lambda: lambda observation: (0.0, 0.0)).duration == 2.0
""")
    project.run().assert_outcomes(passed=3)


INVALID = """
from hypothesis import given, settings, strategies

class Standing(pafot.Simulator):
    def start(self, vehicles, seed):
        self.cars, self.ticks = [[each.x, each.y, each.heading, each.speed] for each in vehicles], 0

    def step(self, controls):
        self.ticks += 1
        if self.ticks < 5:
            self.cars = [[each.x, each.y, each.heading, each.speed] for each in controls]

    def states(self):
        return self.cars

def simulated(simulate, world):
    scenario = pafot.Scenario(npcs=((pafot.PositionInstruction(2, 5.0),),), gene_seconds=5)
    return simulate(scenario, lambda: lambda observation: (0.0, 0.0), world)

def test_by_hand(pafot_simulate):
    for _ in range(3):
        assert not simulated(pafot_simulate, pafot.SimulatorWorld(Standing, duration=5.0)).collision

def test_valid(pafot_simulate):
    assert not simulated(pafot_simulate, pafot.Highway(duration=1.0)).collision

@settings(max_examples=2, deadline=None)
@given(number=strategies.integers())
def test_generated(pafot_simulate, number):
    assert not simulated(pafot_simulate, pafot.SimulatorWorld(Standing, duration=5.0)).collision
"""


def test_pafot_simulate_warns_once_of_an_invalid_run_by_hand(project):
    project.write(INVALID)
    project.run("-W", "default").assert_outcomes(passed=3, warnings=1)
