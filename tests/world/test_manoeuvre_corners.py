"""Corners of manoeuvres: starts beside others, lanes and speeds that do not exist, long explanations."""

import numpy as np
import pytest

from pytest_pafot import Highway, World
from pytest_pafot.model.instructions import LaneInstruction, Manoeuvre, PositionInstruction, ScenarioError, Step
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import LANE, Outcome, Y
from pytest_pafot.oracle.run import Run


def idle():
    return lambda observation: (0.0, 0.0)


def ahead(*steps, **fields):
    return Manoeuvre(**({"beside": 0, "ahead": 30.0, "speed": 20.0, "steps": steps} | fields))


def drive(*npcs, world=None, ads=idle, **fields):
    chains = [(npc,) if isinstance(npc, Manoeuvre) else npc for npc in npcs]
    world = world or Highway(duration=12.0)
    return world.rollout(Scenario(npcs=chains, **({"ego_speed": 20.0} | fields)), ads)


@pytest.mark.parametrize("name", ["after", "offset", "lateral_speed", "acceleration"])
def test_none_is_no_number(name):
    with pytest.raises(ScenarioError):
        Step(**{name: None})


def test_repaired_start_of_another_npc_is_checked():
    world = Highway(headway=2.0, duration=2.0)
    scenario = Scenario(npcs=[[PositionInstruction(1, 20.0)], [ahead(ahead=44.0)]], ego_lane=0, ego_speed=22.0)
    try:
        world.check_fits(scenario)
    except ScenarioError:
        return
    assert world.rollout(scenario, idle).outcome is not Outcome.INVALID


def test_npc_in_lanes_is_not_refused_where_it_does_not_start():
    npcs = [[LaneInstruction("keep", 20.0)], [ahead(beside=-1, ahead=44.0)]]
    Highway().check_fits(Scenario(npcs=npcs, ego_speed=22.0))


def test_lane_that_does_not_exist_on_a_bent_road_is_not_as_asked():
    world = World("roundabout-v0", planner_hz=5, duration=4.0)
    trace = drive(ahead(Step(lane="left"), ahead=12.0, speed=8.0), world=world, ego_lane=1, ego_speed=8.0)
    assert np.ptp(trace.npcs[:, 0, LANE]) == 0
    assert not Run(trace).as_asked


def test_change_of_lanes_keeps_its_lateral_speed_while_a_later_step_begins():
    trace = drive(ahead(Step(lane="right", lateral_speed=0.5), Step(gap=25.0, speed=12.0), beside=1, speed=15.0))
    fastest = np.abs(np.diff(trace.npcs[:, 0, Y])).max() * trace.physics_hz
    assert fastest <= 0.5 + 1e-9 or not Run(trace).as_asked


def test_explanation_has_some_twenty_lines():
    steps = tuple(Step(after=1.0, speed=float(5 + each)) for each in range(16))
    npcs = [ahead(*steps, beside=lane, ahead=distance) for lane in (-1, 0, 1) for distance in (10.0, 20.0)]
    assert len(Run(drive(*npcs)).explain().splitlines()) <= 30


def test_too_fast_step_is_named_as_a_step():
    with pytest.raises(ScenarioError) as caught:
        Highway().check_fits(Scenario(npcs=[[ahead(Step(), Step(speed=30.0))]], ego_speed=20.0))
    assert caught.value.field == "npcs[0][0].steps[1].speed"
