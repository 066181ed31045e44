"""A planner's observation is made on access, and is a value like any other."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from pytest_pafot.model.instructions import PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.world import Highway, Observation, VehicleState
from tests.helpers.tables import table

SCENARIO = Scenario(npcs=[[PositionInstruction(1, 25.0)], [PositionInstruction(5, 20.0)]], gene_seconds=4.0)


def seen_in(rollout):
    seen = []
    rollout(SCENARIO, lambda: lambda observation: seen.append(observation) or (0.5, 0.002))
    return seen


def test_observation_matches_last_tick_of_the_trace():
    seen = []
    trace = Highway(ads_hz=3).rollout(SCENARIO, lambda: lambda observation: seen.append(observation) or (0.5, 0.002))
    assert [(now.acceleration, now.steering) for now in seen] == [tuple(row) for row in trace.ego[:-1:5, 4:6].tolist()]
    assert {(now.decision_period, now.ids, now.road_length) for now in seen} == {(1 / 3, (0, 1), trace.lanes[0].length)}
    assert {now.lane_centres for now in seen} == {tuple(lane.y for lane in trace.lanes)}
    next_tick = np.diff(trace.states[:, 0, 1])[5::5] * 15  # the ego's controls stay constant
    assert [now.lateral_velocities[0] for now in seen[1:]] == pytest.approx(next_tick, abs=1e-9)


def test_observations_of_different_times_differ():
    first, second, *_ = seen_in(Highway().rollout)
    assert first != second
    assert first != tuple(first._values())
    assert len({hash(observation) for observation in seen_in(Highway().rollout)}) == 20


def test_an_observation_can_be_made_printed_and_pickled():
    state = VehicleState(1.0, 2.0, 0.0, 20.0, 0, 5.0, 2.0)
    made = Observation(time=1, ego=state, others=(state,), lanes=4, lane_width=4, speed_limit=26.8)
    assert type(made.time) is type(made.lane_width) is float
    assert (made.ids, made.lateral_velocities, made.lane_centres) == ((0,), (0.0, 0.0), (0.0, 4.0, 8.0, 12.0))
    assert eval(repr(made)) == made
    assert made.array.tolist() == [list(state), list(state)]
    for observation in (made, seen_in(Highway().rollout)[3]):
        assert pickle.loads(pickle.dumps(observation)) == observation


@table("name", ["time", "ego", "others", "lanes", "lane_width", "speed_limit", "ids", "steering"])
def test_an_observation_is_read_only(name):
    with pytest.raises(AttributeError):
        setattr(seen_in(Highway().rollout)[0], name, 1)
