"""The careful driver at junctions gives way by the book, and drives on where it may."""

import pytest

import pytest_pafot as pafot
from example_ads import junctions
from example_ads.junctions import LINE_GAP, STANDING
from pytest_pafot import CrossingInstruction, CrossingVehicle, Observation, Scenario, Zone
from pytest_pafot.world.kernel.observation import VehicleState
from tests.helpers.tables import table

ZONE = Zone(
    way="o3>o1",
    kind="crossing",
    origin="right",
    ego=(100.0, 112.0),
    npc=(108.0, 120.0),
    priority="npc",
)


def ego(x=70.0, speed=9.0):
    return VehicleState(x=x, y=0.0, heading=0.0, speed=speed, lane=0, length=5.0, width=2.0)


def other(distance, speed=8.0, *, x=70.0, number=0, **zone):
    """Return a vehicle this far before its zone, as an ego at x sees it; its place in the plane does not matter."""
    zone = pafot.Zone(
        **{
            name: getattr(ZONE, name)
            for name in ("way", "kind", "origin", "ego", "npc", "priority")
        }
        | zone
    )
    return CrossingVehicle(
        number, zone, distance, zone.ego[0] - x, 30.0, 20.0, -1.5, speed, 5.0, 2.0
    )


def view(*crossing, own=None, others=(), time=0.0):
    return Observation(time, own or ego(), tuple(others), 1, 4.0, 10.0, crossing=tuple(crossing))


def acceleration(*crossing, **seen):
    return junctions.make()(view(*crossing, **seen)).acceleration


def comes_to_rest(seconds=20.0, start=60.0, *, of):
    """Return the ego's place and speed after some time among the vehicles that ``of(time, x)`` gives."""
    driver, x, speed = junctions.make(), start, 9.0
    for tick in range(round(seconds * 15)):
        if tick % 3 == 0:
            wanted = driver(view(*of(tick / 15, x), own=ego(x, speed), time=tick / 15)).acceleration
        speed = max(speed + wanted / 15, 0.0)
        x += speed / 15
    return x, speed


def test_alone_it_drives_on():
    assert acceleration() == 0.0
    assert acceleration(own=ego(speed=5.0)) == 2.0


@table(
    ("distance", "speed", "priority", "waits"),
    [
        (20.0, 8.0, "npc", True),
        (20.0, 8.0, "none", True),
        (20.0, 8.0, "ego", False),  # it gives way
        (10.0, 9.0, "ego", True),  # it cannot stop any more
        (-3.0, 8.0, "ego", True),  # it is in the zone
        (60.0, 8.0, "npc", False),  # the ego has been gone for 1.5 s when it arrives
        (-13.0, 8.0, "npc", False),  # it has left
    ],
)
def test_it_waits_for_who_comes_first(distance, speed, priority, waits):
    seen = view(other(distance, speed, x=88.0, priority=priority), own=ego(88.0))
    assert (junctions.make().line(seen) == pytest.approx(12.0 - LINE_GAP)) is waits


def test_it_counts_with_another_that_speeds_up():
    driver = junctions.make()
    assert driver.line(view(other(33.0, 6.0, x=85.0), own=ego(85.0))) == float("inf")
    for number in range(2):
        driver.watch(view(other(33.0, 6.0 + number, x=85.0), own=ego(85.0), time=0.4 * number))
    assert driver.line(view(other(33.0, 7.0, x=85.0), own=ego(85.0), time=0.4)) < 15.0


def test_it_stops_before_the_line_and_stays_there():
    x, speed = comes_to_rest(of=lambda time, x: [other(6.0, 3.0, x=x)])
    assert 100.0 - LINE_GAP - 1.0 < x < 100.0
    assert speed < STANDING


def test_it_goes_when_the_zone_is_free():
    x, speed = comes_to_rest(of=lambda time, x: [other(40.0 - 8.0 * time, x=x)])
    assert x > 112.0
    assert speed == pytest.approx(9.0, abs=0.1)


def test_it_goes_when_who_has_priority_lets_it():
    assert comes_to_rest(of=lambda time, x: [other(2.0, 0.0, x=x)])[0] > 112.0
    assert comes_to_rest(of=lambda time, x: [other(2.0, 1.0, x=x)])[0] < 100.0


def test_policy_never_stops_inside_one_zone_for_another():
    first = {"ego": (90.0, 102.0), "way": "o1>o3", "origin": "left"}
    x, _ = comes_to_rest(
        of=lambda time, x: [other(6.0, 3.0, x=x), other(90.0, 3.0, x=x, number=1, **first)]
    )
    assert 90.0 - LINE_GAP - 1.0 < x < 90.0


def test_it_stops_in_no_zone_behind_a_queue():
    queue = ego(116.0, 0.0)
    seen = view(other(60.0, x=85.0), own=ego(85.0), others=[queue])
    assert junctions.make().line(seen) == pytest.approx(15.0 - LINE_GAP)


def test_it_leaves_a_zone_that_it_is_in():
    assert acceleration(other(5.0, x=103.0), own=ego(103.0, 4.0)) > 0.0


@table(("gap", "speed"), [(10.0, 9.0), (20.0, 3.0), (25.0, 0.0)])
def test_it_brakes_behind_a_leader(gap, speed):
    assert acceleration(others=[ego(75.0 + gap, speed)]) < -0.5


def test_it_brakes_behind_who_joins_its_lane_ahead():
    zone = {"kind": "merging", "ego": (100.0, 125.0), "npc": (108.0, 133.0)}
    ahead, behind = (other(to_leave - 25.0, 3.0, x=108.0, **zone) for to_leave in (2.0, 24.0))
    assert acceleration(ahead, own=ego(108.0)) < -0.5
    assert acceleration(behind, own=ego(108.0)) == 0.0


@pytest.mark.parametrize("env_id", ["intersection-v0", "roundabout-v0"])
def test_it_drives_where_ways_cross(env_id):
    world = pafot.World(env_id, planner_hz=5)
    lane, speed = world.start
    for zone in world.crossings.zones[:3]:
        scenario = Scenario(
            npcs=[[CrossingInstruction(zone.way, 0.5, 7.0)]], ego_lane=lane, ego_speed=speed
        )
        trace = world.rollout(scenario, junctions.make)
        assert trace.outcome == "safe"
        assert trace.track[-1, 0, 0] > zone.ego[0] - 5.0
