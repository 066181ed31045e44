"""A planner's observation is made on access, and is a value like any other, which users can make and change."""

import pickle

import numpy as np
import pytest

from pytest_pafot import Highway, Observation, PositionInstruction, Scenario, VehicleState
from tests.helpers.tables import table

NPCS = [[PositionInstruction(1, 25.0)], [PositionInstruction(5, 20.0)]]
SCENARIO = Scenario(npcs=NPCS, gene_seconds=4.0)
EGO = VehicleState(x=200.0, y=4.0, heading=0.1, speed=20.0, lane=1)
OTHERS = (EGO._replace(x=230.0), EGO._replace(y=8.0, lane=2))
SEVERAL = {"others": OTHERS, "ids": (4, 7), "lateral_velocities": (1.0, 2.0, 3.0)}


def driven(**rates):
    """Return a run, and the observations of its policy."""
    seen, world = [], Highway(**rates)
    trace = world.rollout(SCENARIO, lambda: lambda now: seen.append(now) or (0.5, 0.002))
    return trace, seen


def test_observation_matches_last_tick_of_the_trace():
    trace, seen = driven(ads_hz=3)
    controls = [(now.acceleration, now.steering) for now in seen]
    assert controls == [tuple(row) for row in trace.ego[:-1:5, 4:6].tolist()]
    for now in seen:
        assert (now.decision_period, now.ids) == (1 / 3, (0, 1))
        assert now.road_length == trace.lanes[0].length
        assert now.lane_centres == tuple(lane.y for lane in trace.lanes)
    next_tick = np.diff(trace.states[:, 0, 1])[5::5] * 15  # the ego's controls stay constant
    assert [now.lateral_velocities[0] for now in seen[1:]] == pytest.approx(next_tick, abs=1e-9)


def test_observations_of_different_times_differ_and_are_copied_as_they_are_seen():
    _, seen = driven()
    first, second, *_ = seen
    assert first != second
    assert first != tuple(first._values())
    assert len({*map(hash, seen)}) == 20
    assert second.replace() == second
    assert second.replace() is not second
    with pytest.raises(TypeError):
        second.replace(colour="red")


def test_an_observation_can_be_made_printed_and_pickled():
    state = VehicleState(1.0, 2.0, 0.0, 20.0, 0, 5.0, 2.0)
    made = Observation(time=1, ego=state, others=(state,), lanes=4, lane_width=4, speed_limit=26.8)
    assert type(made.time) is type(made.lane_width) is float
    assert (made.ids, made.lateral_velocities) == ((0,), (0.0, 0.0))
    assert made.lane_centres == (0.0, 4.0, 8.0, 12.0)
    assert eval(repr(made)) == made
    assert made.array.tolist() == [list(state), list(state)]
    for observation in (made, driven()[1][3]):
        assert pickle.loads(pickle.dumps(observation)) == observation


@table("name", ["time", "ego", "others", "lanes", "lane_width", "speed_limit", "ids", "steering"])
def test_an_observation_is_read_only(name):
    with pytest.raises(AttributeError):
        setattr(Observation(time=1.0, ego=EGO), name, 1)
    with pytest.raises(AttributeError):
        setattr(driven()[1][0], name, 1)


def test_user_makes_an_observation_of_an_ego_alone_and_copies_of_it():
    seen = Observation(time=1.0, ego=EGO)
    assert (seen.others, seen.ids) == ((), ())
    assert (seen.lanes, seen.lane_width, seen.speed_limit) == (4, 4.0, 26.8)
    assert seen.array.tolist() == [[200.0, 4.0, 0.1, 20.0, 1.0, 5.0, 2.0]]
    seen = Observation(time=1.0, ego=EGO, steering=0.2, **SEVERAL)
    copy = seen.replace(time=2.0)
    assert (copy.time, copy.steering) == (2.0, 0.2)
    assert (copy.ids, copy.lateral_velocities) == ((4, 7), (1.0, 2.0, 3.0))
    assert copy.replace(time=1.0) == seen


def test_what_describes_other_vehicles_is_made_again_for_them():
    seen = Observation(time=1.0, ego=EGO, **SEVERAL)
    alone, moved = seen.replace(others=()), seen.replace(others=OTHERS[::-1])
    assert alone.ids == ()
    assert alone.lateral_velocities == (pytest.approx(20.0 * 0.0998334, abs=1e-4),)
    assert (moved.ids, len(moved.lateral_velocities)) == ((4, 7), 3)
