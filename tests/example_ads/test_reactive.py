"""The adapter of CommonRoad's reactive planner translates axes, car and road; the planner is the published one."""

import pytest

from pytest_pafot import Drive, Observation
from pytest_pafot.world import VehicleState
from tests.helpers.bicycle import drive

pytest.importorskip("commonroad_rp", reason='needs pip install "commonroad-reactive-planner>=2025.1,<2026"')

from example_ads import reactive

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of its dependencies


def vehicle(*, x=100.0, y=4.0, speed=16.0, heading=0.0):
    return VehicleState(x=x, y=y, heading=heading, speed=speed, lane=round(y / 4.0), length=5.0, width=2.0)


def test_it_reaches_its_desired_speed_and_keeps_its_lane():
    ego, _ = drive(5, ego=vehicle(speed=15.0), ads=reactive.make("16.67"))
    assert ego.speed == pytest.approx(16.67, abs=0.5)
    assert ego.y == pytest.approx(4.0, abs=0.05)


@pytest.mark.parametrize("side", [-1, 1])
def test_it_steers_back_to_the_centre_of_its_lane(side):
    start = vehicle(y=4.0 + 0.8 * side, heading=0.02 * side)
    ego, _ = drive(4, ego=start, ads=reactive.make("16"))
    assert ego.y == pytest.approx(4.0, abs=0.3)


def test_on_a_single_lane_it_follows_a_slower_leader():
    leader = vehicle(x=140.0, y=0.0, speed=12.0)
    ego, (leader,) = drive(12, leader, ego=vehicle(y=0.0), ads=reactive.make("16"), lanes=1)
    assert ego.x < leader.x
    assert ego.speed < 14.0


def test_without_a_trajectory_it_brakes_in_the_lane():
    wall = [vehicle(x=112.0, y=y, speed=0.0) for y in (0.0, 4.0, 8.0)]
    answer = reactive.make()(Observation(0.0, vehicle(), tuple(wall), 3, 4.0, 26.8))
    assert answer == Drive(lane=1, acceleration=-reactive.MAX_DECELERATION)
