"""Observations that a user makes, and copies with some fields changed."""

import pytest

from pytest_pafot import Highway, Observation, PositionInstruction, Scenario, VehicleState

EGO = VehicleState(x=200.0, y=4.0, heading=0.1, speed=20.0, lane=1)
OTHERS = (EGO._replace(x=230.0), EGO._replace(y=8.0, lane=2))


def test_user_makes_an_observation_of_an_ego_alone():
    seen = Observation(time=1.0, ego=EGO)
    assert (seen.others, seen.ids, seen.lanes, seen.lane_width, seen.speed_limit) == ((), (), 4, 4.0, 26.8)
    assert seen.array.tolist() == [[200.0, 4.0, 0.1, 20.0, 1.0, 5.0, 2.0]]


def test_copy_has_the_changed_field_and_all_others():
    seen = Observation(time=1.0, ego=EGO, others=OTHERS, steering=0.2, ids=(4, 7), lateral_velocities=(1.0, 2.0, 3.0))
    copy = seen.replace(time=2.0)
    assert (copy.time, copy.steering, copy.ids, copy.lateral_velocities) == (2.0, 0.2, (4, 7), (1.0, 2.0, 3.0))
    assert copy.replace(time=1.0) == seen


def test_what_describes_other_vehicles_is_made_again_for_them():
    seen = Observation(time=1.0, ego=EGO, others=OTHERS, ids=(4, 7), lateral_velocities=(1.0, 2.0, 3.0))
    alone = seen.replace(others=())
    assert (alone.ids, alone.lateral_velocities) == ((), (pytest.approx(20.0 * 0.0998334, abs=1e-4),))
    moved = seen.replace(others=OTHERS[::-1])
    assert (moved.ids, len(moved.lateral_velocities)) == ((4, 7), 3)


def test_observation_of_a_run_is_copied_as_it_is_seen():
    seen = []
    scenario = Scenario(npcs=((PositionInstruction(2, 20.0),),))
    Highway(duration=1.0).rollout(scenario, lambda: lambda each: (seen.append(each), (0.0, 0.0))[1])
    copy = seen[2].replace()
    assert copy == seen[2]
    assert copy is not seen[2]


def test_unknown_field_is_refused():
    with pytest.raises(TypeError, match="colour"):
        Observation(time=1.0, ego=EGO).replace(colour="red")
