"""The plain registered environment gives the same runs, for every kind of ADS and every ending."""

import pytest
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle

from pytest_pafot import Highway, PositionInstruction, Run, Scenario, World
from pytest_pafot.findings.finding import disagreement
from pytest_pafot.model.trace import Outcome
from pytest_pafot.world.driving.vehicles import StockVehicle, TrafficClass
from tests.helpers.c_library import c_library
from tests.helpers.run_cases import differences
from tests.helpers.world_cases import constant_speed


def test_environment_drives_its_own_road_and_vehicles():
    """Nothing of this package's physics is used, nor of a class of the environment's own traffic."""

    class Flying(IDMVehicle):
        step = act = clip_actions = on_state_update = None

    own = {name for name in vars(StockVehicle) if not name.startswith("_")}
    assert own & set(vars(Vehicle)) == set()
    for name in ("step", "act", "clip_actions", "on_state_update", "handle_collisions"):
        assert getattr(TrafficClass(Flying).moved, name) is getattr(Vehicle, name)


@pytest.mark.parametrize("constant", ["LANE_CHANGE_DELAY", "COMFORT_ACC_MAX"])
@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")  # highway-env divides by it, too
def test_idm_with_a_constant_of_zero_drives_as_highway_envs_code(constant):
    """The compiled model cannot divide by it, so that highway-env's own code drives."""
    ads = type("Zero", (IDMVehicle,), {constant: 0.0})
    worlds = {20.0: Highway(duration=6.0), 8.0: World("roundabout-v0", duration=6.0)}
    for speed, world in worlds.items():
        slow = Scenario(npcs=[[PositionInstruction(2, 3.0)]], ego_lane=1, ego_speed=speed)
        with c_library():
            assert differences(world.rollout(slow, ads), world.rollout_in_gym(slow, ads)) == []


def differing():
    """Return pairs of runs that differ, by what differs."""
    stops = Scenario(npcs=((PositionInstruction(2, 0.0),),))
    hit, safe, slower = (
        Run(Highway().rollout(stops, lambda braking=braking: lambda observation: (braking, 0.0)))
        for braking in (0.0, -3.0, -2.9)
    )
    cuts_in = Scenario(npcs=((PositionInstruction(1, 15.0), PositionInstruction(2, 0.0)),))
    later = Run(Highway().rollout(cuts_in, constant_speed))
    assert [each.outcome for each in (hit, safe)] == [Outcome.COLLISION, Outcome.COMPLETED]
    return {"the outcome": (hit, safe), "the states": (safe, slower), "the collision": (hit, later)}


def test_two_runs_that_differ_are_told_apart():
    for one, other in differing().values():
        assert disagreement(one, other)
        assert disagreement(one, one) == ""
