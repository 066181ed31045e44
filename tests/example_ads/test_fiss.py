"""The adapter of FISS+ translates axes, car and map; the planner itself is the published one."""

import pytest

from pytest_pafot.world.kernel.observation import Observation, VehicleState
from tests.helpers.bicycle import HZ, moved
from tests.helpers.stages import oracle

pytest.importorskip("fiss_planner", reason='needs pip install "pytest-pafot[fiss]"')

from example_ads import fiss


def vehicle(*, x=100.0, lane=1, speed=22.0):
    return VehicleState(
        x=x, y=lane * 4.0, heading=0.0, speed=speed, lane=lane, length=5.0, width=2.0
    )


def drive(seconds, *others, ego=None, lanes=4):
    """Return the ego and the others, which keep their speed, at every tick until their boxes touch."""
    ads, ego, track = fiss.make(), ego or vehicle(), []
    for tick in range(round(seconds * HZ)):
        if tick % 3 == 0:
            seen = Observation(
                tick / HZ, ego, others, lanes=lanes, lane_width=4.0, speed_limit=26.8
            )
            action = ads(seen)
        ego, others = moved(ego, *action), tuple(map(moved, others))
        track.append((ego, others))
        assert not any(abs(ego.x - o.x) < 5.0 and abs(ego.y - o.y) < 2.0 for o in others), "contact"
    return track


def test_driver_reaches_speed_limit_on_an_empty_road():
    ego, _ = drive(8, ego=vehicle(speed=25.0))[-1]
    assert ego.speed == pytest.approx(26.8, abs=0.1)
    assert ego.y == pytest.approx(4.0, abs=0.05)


@pytest.mark.parametrize(("lane", "side"), [oracle(0, +1), (3, -1)])
def test_outer_lane_driver_overtakes_on_the_road_side(lane, side):
    ego, (slow,) = drive(15, vehicle(x=150.0, lane=lane, speed=12.0), ego=vehicle(lane=lane))[-1]
    assert ego.x > slow.x
    assert (ego.y - lane * 4.0) * side == pytest.approx(4.0, abs=0.2)


@pytest.mark.oracle
def test_where_both_sides_are_taken_it_follows_instead():
    wall = [
        vehicle(x=100.0 + 15.0 * n, lane=lane, speed=15.0) for lane in (0, 2) for n in range(-2, 8)
    ]
    ego, (slow, *_) = drive(15, vehicle(x=150.0, speed=15.0), *wall, lanes=3)[-1]
    assert ego.x < slow.x
    assert ego.y == pytest.approx(4.0, abs=0.5)
    assert ego.speed == pytest.approx(15.0, abs=1.0)


def test_vehicle_close_behind_does_not_cause_braking():
    track = drive(3, vehicle(x=94.0))
    assert min(ego.speed for ego, _ in track) >= 21.9


@pytest.mark.oracle
def test_road_continues_beyond_the_short_map(monkeypatch):
    monkeypatch.setattr(fiss, "MAP_AHEAD", 260.0)
    monkeypatch.setattr(fiss, "MAP_RENEWED_AHEAD", 200.0)
    distance = drive(14, ego=vehicle(speed=26.8))[-1][0].x - 100.0
    assert distance > fiss.MAP_BEHIND + fiss.MAP_AHEAD
    assert distance == pytest.approx(14 * 26.8, rel=0.01)
