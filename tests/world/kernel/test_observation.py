"""A planner's observation is made on access, and is a value like any other, which users can make and change."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from pytest_pafot.model.instructions import PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.world import Highway, Observation, VehicleState
from tests.helpers.tables import table

SCENARIO = Scenario(
    npcs=[[PositionInstruction(1, 25.0)], [PositionInstruction(5, 20.0)]], gene_seconds=4.0
)
EGO = VehicleState(x=200.0, y=4.0, heading=0.1, speed=20.0, lane=1)
OTHERS = (EGO._replace(x=230.0), EGO._replace(y=8.0, lane=2))


def seen_in(rollout):
    seen = []
    rollout(SCENARIO, lambda: lambda observation: seen.append(observation) or (0.5, 0.002))
    return seen


def test_observation_matches_last_tick_of_the_trace():
    seen = []
    trace = Highway(ads_hz=3).rollout(
        SCENARIO, lambda: lambda observation: seen.append(observation) or (0.5, 0.002)
    )
    assert [(now.acceleration, now.steering) for now in seen] == [
        tuple(row) for row in trace.ego[:-1:5, 4:6].tolist()
    ]
    assert {(now.decision_period, now.ids, now.road_length) for now in seen} == {
        (1 / 3, (0, 1), trace.lanes[0].length)
    }
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
    assert (made.ids, made.lateral_velocities, made.lane_centres) == (
        (0,),
        (0.0, 0.0),
        (0.0, 4.0, 8.0, 12.0),
    )
    assert eval(repr(made)) == made
    assert made.array.tolist() == [list(state), list(state)]
    for observation in (made, seen_in(Highway().rollout)[3]):
        assert pickle.loads(pickle.dumps(observation)) == observation


@table("name", ["time", "ego", "others", "lanes", "lane_width", "speed_limit", "ids", "steering"])
def test_an_observation_is_read_only(name):
    with pytest.raises(AttributeError):
        setattr(seen_in(Highway().rollout)[0], name, 1)


def test_user_makes_an_observation_of_an_ego_alone():
    seen = Observation(time=1.0, ego=EGO)
    assert (seen.others, seen.ids, seen.lanes, seen.lane_width, seen.speed_limit) == (
        (),
        (),
        4,
        4.0,
        26.8,
    )
    assert seen.array.tolist() == [[200.0, 4.0, 0.1, 20.0, 1.0, 5.0, 2.0]]


def test_copy_has_the_changed_field_and_all_others():
    seen = Observation(
        time=1.0,
        ego=EGO,
        others=OTHERS,
        steering=0.2,
        ids=(4, 7),
        lateral_velocities=(1.0, 2.0, 3.0),
    )
    copy = seen.replace(time=2.0)
    assert (copy.time, copy.steering, copy.ids, copy.lateral_velocities) == (
        2.0,
        0.2,
        (4, 7),
        (1.0, 2.0, 3.0),
    )
    assert copy.replace(time=1.0) == seen


def test_what_describes_other_vehicles_is_made_again_for_them():
    seen = Observation(
        time=1.0, ego=EGO, others=OTHERS, ids=(4, 7), lateral_velocities=(1.0, 2.0, 3.0)
    )
    alone = seen.replace(others=())
    assert (alone.ids, alone.lateral_velocities) == (
        (),
        (pytest.approx(20.0 * 0.0998334, abs=1e-4),),
    )
    moved = seen.replace(others=OTHERS[::-1])
    assert (moved.ids, len(moved.lateral_velocities)) == ((4, 7), 3)


def test_observation_of_a_run_is_copied_as_it_is_seen_and_has_no_other_fields():
    seen = seen_in(Highway().rollout)[2]
    assert seen.replace() == seen
    assert seen.replace() is not seen
    with pytest.raises(TypeError, match="colour"):
        seen.replace(colour="red")
