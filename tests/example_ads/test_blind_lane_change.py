"""The blind lane changer is careful within its lane and blind to the next one."""

from example_ads import blind_lane_change
from pytest_pafot.world.kernel.observation import Observation, VehicleState
from tests.helpers.bicycle import moved
from tests.helpers.tables import table


def vehicle(*, x=100.0, lane=1, speed=22.0, y=None):
    y = lane * 4.0 if y is None else y
    return VehicleState(x=x, y=y, heading=0.0, speed=speed, lane=lane, length=5.0, width=2.0)


def view(*others, time=0.0, ego=None, lanes=4):
    ego = vehicle() if ego is None else ego
    return Observation(
        time=time, ego=ego, others=others, lanes=lanes, lane_width=4.0, speed_limit=26.8
    )


def drive(seconds, *, lane=1, lanes=4, hz=15):
    """Return the ego's y and speed at every tick on an empty road, by highway-env's bicycle model."""
    ads, ego, track = blind_lane_change.make(), vehicle(lane=lane), []
    for tick in range(round(seconds * hz)):
        if tick % 3 == 0:
            acceleration, steering = ads(view(time=tick / hz, ego=ego, lanes=lanes))
        ego = moved(ego, acceleration, steering)
        ego = ego._replace(lane=min(max(round(ego.y / 4.0), 0), lanes - 1))
        track.append((ego.y, ego.speed))
    return track


def test_what_is_in_the_other_lanes_changes_nothing():
    lonely, crowded = blind_lane_change.make(), blind_lane_change.make()
    others = (vehicle(lane=0), vehicle(lane=2), vehicle(x=90.0, lane=2))
    for time in (0.0, 4.0, 8.0, 8.2):
        assert lonely(view(time=time)) == crowded(view(*others, time=time))


def test_driver_turns_back_at_the_road_edge():
    lanes = [round(drive(seconds)[-1][0] / 4.0) for seconds in (7.9, 15.9, 23.9, 31.9, 39.9, 47.9)]
    assert lanes == [1, 2, 3, 2, 1, 0]


@table(("gap", "speed"), [(15.0, 10.0), (40.0, 5.0), (60.0, 0.0)])
def test_driver_brakes_for_slower_vehicle_in_its_lane(gap, speed):
    leader = vehicle(x=105.0 + gap, speed=speed)
    assert -8.0 <= blind_lane_change.make()(view(leader))[0] < -1.0


def test_it_does_not_brake_for_a_vehicle_behind():
    assert blind_lane_change.make()(view(vehicle(x=90.0, speed=26.0)))[0] > 0.0
