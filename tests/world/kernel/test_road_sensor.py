"""The observations of a planner in SI units: vehicles on its way along that way, and all others at junctions."""

import math
from array import array
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from gymnasium.wrappers import FlattenObservation

from pytest_pafot import (
    CrossingInstruction,
    LaneCommand,
    Perception,
    PositionInstruction,
    Scenario,
    World,
)
from pytest_pafot.model.sight import Sight
from pytest_pafot.model.trace import ALONG
from pytest_pafot.world import AdsFactoryError, from_dict
from pytest_pafot.world.kernel.lanes import COLUMNS, Body, Places
from pytest_pafot.world.kernel.observation import RoadSensor
from pytest_pafot.world.roads.network import STEP
from tests.helpers.refusals import refused
from tests.helpers.tables import table

WORLD = World("intersection-v0", config={"destination": "o2"}, planner_hz=5)
JUNCTION = WORLD.road.junction
FROM_THE_RIGHT, TURNS_IN = JUNCTION.ways["o3>o1"], JUNCTION.ways["o3>o2"]
HALF = 111.0
"""The distance from the middle of the intersection to the outer ends of the roads [m]."""


def sensor_on(*npcs, ways, sight=None):
    """Return the sensor of an ego that has driven 60 m from the south, among vehicles at x, y, heading, speed.

    The record of its run has four ticks, in which all drive straight on. ``ways`` has the way of each vehicle that
    crosses, and None for each other vehicle.
    """
    road, states = WORLD.road, ((2.0, HALF - 60.0, -math.pi / 2, 10.0), *npcs)
    vehicles, bodies = ([Body(5.0, 2.0) for _ in states] for _ in range(2))
    lines = [road.line, *(road.line if way is None else JUNCTION.ways[way].line for way in ways)]
    starts = [
        np.hypot(line.x - x, line.y - y).argmin() * STEP
        for line, (x, y, *_) in zip(lines, states, strict=True)
    ]
    own = [None, *(None if way is None else JUNCTION.ways[way].track for way in ways)]
    common = {
        "starts": starts,
        "ways": own,
        "end": road.end,
        "beside": lambda *_: (-1, None),
        "ticks": 3,
    }
    places = Places(vehicles, bodies, bends=road.bends, **common)
    rows = array("d", bytes(8 * 4 * len(states) * COLUMNS))
    for tick in range(4):
        for number, (vehicle, (x, y, heading, speed)) in enumerate(
            zip(vehicles, states, strict=True)
        ):
            far = speed * tick / 15
            vehicle.place(x + far * math.cos(heading), y + far * math.sin(heading), heading, speed)
            row = (tick * len(states) + number) * COLUMNS
            rows[row : row + 4] = array("d", (vehicle.x, vehicle.y, heading, speed))
        places.see(rows, tick * len(states) * COLUMNS)
    zones = [None if way is None else JUNCTION.ways[way].way.zone for way in ways]
    common = road.lane_count, road.lane_width, road.speed_limit, road.end
    leaning = [road.bends] * len(states)
    return RoadSensor(places, rows, road.bends, leaning, zones, common, 15, 3, sight, 7)


EGO_ENTERS, ENTERS = FROM_THE_RIGHT.way.zone.ego[0], FROM_THE_RIGHT.way.zone.npc[0]
EAST = (HALF - 90.0, -2.0, math.pi, 8.0)
"""A vehicle that has driven 90 m from the east towards the west."""


def test_crossing_vehicle_is_seen_on_its_own_way():
    leader = (2.0, HALF - 75.0, -math.pi / 2, 9.0)
    seen = sensor_on(leader, EAST, ways=[None, "o3>o1"]).observation(0)
    assert seen.ids == (0,)
    assert [other.x - seen.ego.x for other in seen.others] == pytest.approx([15.0])
    (crossing,) = seen.crossing
    assert crossing.zone == FROM_THE_RIGHT.way.zone
    distances = ENTERS - 90.0, EGO_ENTERS - 60.0, HALF - 60.0 + 2.0, HALF - 92.0
    expected = (1, None, *distances, -math.pi / 2, 8.0, 5.0, 2.0)
    assert crossing._replace(zone=None) == pytest.approx(expected, abs=0.05)


def test_who_has_merged_is_one_of_the_others():
    before = sensor_on((HALF - 105.0, -3.5, math.pi + 0.59, 6.0), ways=["o3>o2"]).observation(0)
    assert (len(before.others), [each.is_inside for each in before.crossing]) == (0, [True])
    assert before.crossing[0].to_leave == pytest.approx(TURNS_IN.way.zone.npc[1] - 105.3, abs=0.2)
    after = sensor_on((2.2, -30.0, -math.pi / 2 - 0.1, 6.0), ways=["o3>o2"]).observation(0)
    assert [other.x - after.ego.x for other in after.others] == pytest.approx([81.0], abs=0.2)
    assert after.crossing == ()


@table(
    ("is_seen", "sight"),
    [(False, {"range": 50.0}), (True, {"range": 60.0}), (False, {"dropout": 1.0})],
)
def test_an_imperfect_sight_hides_who_crosses(sight, is_seen):
    seen = sensor_on(EAST, ways=["o3>o1"], sight=Sight(**sight)).observation(0)
    assert bool(seen.crossing) is is_seen


def test_who_crosses_is_seen_late_and_with_errors():
    sensor = sensor_on(EAST, ways=["o3>o1"], sight=Sight(latency=0.2))
    (was,), (now,) = (sensor.observation(tick).crossing for tick in (0, 3))
    assert (now.distance, now.ahead - was.ahead) == pytest.approx((was.distance, -2.0), abs=1e-6)
    assert was.ego_distance - now.ego_distance == pytest.approx(2.0, abs=1e-6)
    noise = Sight(noise={"position": 1.0, "speed": 1.0})
    (noisy,) = sensor_on(EAST, ways=["o3>o1"], sight=noise).observation(0).crossing
    assert noisy.distance - was.distance == pytest.approx(noisy.right - was.right, abs=0.01)
    assert noisy.ahead != was.ahead
    assert noisy.speed != was.speed


def test_it_sees_what_the_run_records():
    crossing = CrossingInstruction("o3>o2", -0.5, 8.0), CrossingInstruction("o1>o3", 1.0, 6.0)
    npcs = [[crossing[0]], [crossing[1]], [PositionInstruction(6, 5.0)]]
    scenario, seen = replace(scenario_of(WORLD), npcs=npcs), []
    trace = WORLD.rollout(scenario, lambda: lambda now: seen.append(now) or (-0.5, 0.0))
    assert len(seen) == len(trace.actions) > 30
    for tick, now in zip(range(0, trace.ticks, 3), seen, strict=True):
        along = trace.track[tick, :, ALONG]
        on_way = np.flatnonzero(~np.isnan(along[1:]))
        assert now.ids == tuple(on_way)
        for each in now.crossing:
            zone, place = trace.zones[each.id], trace.on_way[tick, each.id]
            assert each.id not in on_way
            assert each.distance == pytest.approx(zone.npc[0] - place, abs=1e-6)
            assert each.ego_distance == pytest.approx(zone.ego[0] - along[0], abs=1e-6)
            apart = np.hypot(*(trace.states[tick, each.id + 1, :2] - trace.states[tick, 0, :2]))
            assert math.hypot(each.ahead, each.right) == pytest.approx(apart)
    assert {each.id for now in seen for each in now.crossing} == {0, 1}
    assert 0 in seen[-1].ids


def scenario_of(world):
    lane, speed = world.start or (1, 20.0)
    npcs = [[PositionInstruction(2, 5.0)]]
    return Scenario(npcs=npcs, ego_lane=lane, ego_speed=speed, gene_seconds=10.0)


def follows():
    def decide(seen):
        speed = min([8.0, *(each.speed - 1.0 for each in seen.others)])
        return LaneCommand(lane=seen.ego.lane, speed=max(speed, 0.0))

    return decide


@pytest.mark.parametrize("env_id", ["intersection-v0", "roundabout-v0", "highway-v0"])
@pytest.mark.parametrize("sight", [{}, {"latency": 0.4, "noise": {"position": 0.2}}])
def test_planner_drives_the_same_in_environment_steps(env_id, sight):
    world = World(env_id, duration=5.0, planner_hz=5)
    ads = Perception(follows, **sight)
    runs = [roll(scenario_of(world), ads) for roll in (world.rollout, world.rollout_in_gym)]
    assert runs[0].error is None
    assert len(runs[0].actions) == math.ceil(runs[0].ticks / 3)
    assert runs[0].states.tobytes() == runs[1].states.tobytes()


def test_a_file_has_how_often_a_planner_decides():
    assert from_dict(WORLD.to_dict()).planner_hz == 5
    assert "planner_hz" not in World("intersection-v0").to_dict()
    assert (WORLD.observation_space, WORLD.ads_hz) == (None, 5)


REFUSED = {
    "no decisions": (lambda: World("intersection-v0", planner_hz=0), "planner_hz"),
    "decisions between ticks": (World("intersection-v0", planner_hz=4).check, "planner_hz"),
    "wrappers": (lambda: World("intersection-v0", planner_hz=5, wrappers=[FlattenObservation]), "wrappers"),
}  # fmt: skip


def plan_inside():
    WORLD.rollout(scenario_of(WORLD), lambda env: SimpleNamespace())


def test_world_for_planners_refuses_policy_options():
    for make, field in REFUSED.values():
        with refused(field):
            make()
    with pytest.raises(AdsFactoryError):
        plan_inside()
