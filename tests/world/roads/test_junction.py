"""Ways of other traffic and the zones in which they meet the ego's, against boxes placed along them."""

from __future__ import annotations

import functools
import math
from typing import ClassVar

import numpy as np
import pytest
from highway_env.road.lane import CircularLane, StraightLane

from pytest_pafot import World
from pytest_pafot.world.roads.junction import WIDER, Course, meetings_of, near_pairs
from tests.helpers.polygons import corners, polygons_meet
from tests.helpers.road_cases import ROADS, OwnEnvironment, world_of
from tests.helpers.stages import oracle
from tests.helpers.tables import table
from tests.helpers.traces import LENGTH, WIDTH
from tests.helpers.world_cases import wrapped

STEP = 0.5


@functools.cache
def intersection(destination):
    return World("intersection-v0", {"destination": destination})


def zones_of(world):
    return {zone.way: (zone.kind, zone.origin, zone.priority) for zone in world.crossings.zones}


@table(("destination", "zones"), {
    "to the left": ("o1", {
        "o1>o3": ("crossing", "left", "npc"), "o1>o2": ("crossing", "left", "npc"),
        "o2>o0": ("oncoming", "ahead", "npc"), "o2>o1": ("merging", "ahead", "npc"),
        "o3>o0": ("crossing", "right", "npc"), "o3>o1": ("merging", "right", "npc"),
    }),
    "straight on": ("o2", {
        "o1>o2": ("merging", "left", "npc"), "o1>o3": ("crossing", "left", "npc"),
        "o2>o3": ("oncoming", "ahead", "ego"),
        "o3>o0": ("crossing", "right", "npc"), "o3>o1": ("crossing", "right", "npc"),
        "o3>o2": ("merging", "right", "npc"),
    }),
    "to the right": ("o3", {"o1>o3": ("merging", "left", "npc"), "o2>o3": ("merging", "ahead", "ego")}),
}.values())  # fmt: skip
def test_ways_that_meet_the_egos_have_a_kind_an_origin_and_a_priority(destination, zones):
    """The ego comes from the south, o0; o1 is in the west. The road from west to east has priority."""
    assert zones_of(intersection(destination)) == zones


def test_circulating_vehicles_have_priority_and_roundabout_zones_merge():
    """The ego enters in the south and leaves in the north; the ring turns left, through the east."""
    circulating = ("wer>wxr", "wer>nxr", "wer>exr", "ner>nxr", "ner>exr")
    entering = ("eer>exr", "eer>wxr", "eer>sxr", "eer>nxr")
    expected = dict.fromkeys(circulating, ("merging", "left", "npc"))
    assert zones_of(world_of("roundabout-v1")) == expected | dict.fromkeys(
        entering, ("merging", "right", "ego")
    )


WITHOUT = [each for each in ROADS if not each.startswith(("intersection", "roundabout"))]


@pytest.mark.parametrize("env_id", [*WITHOUT, "highway-v0"])
def test_other_roads_of_highway_env_have_no_crossings(env_id):
    """Their ramps jump by a lane, two-way roads are side by side, and circuits have no entry."""
    assert world_of(env_id).crossings is None


@pytest.mark.parametrize(
    "env_id", ["intersection-v0", "intersection-v1", "roundabout-v1", "roundabout-generic-v1"]
)
def test_ego_starts_six_seconds_before_first_zone(env_id):
    world = world_of(env_id)
    crossings, own = world.crossings, world.environment.unwrapped.vehicle
    first = min(zone.ego[0] for zone in crossings.zones)
    assert first - crossings.ego_start == pytest.approx(6 * crossings.ego_speed, abs=STEP)
    assert world.rules.ego_start == world.road.start == crossings.ego_start
    assert crossings.ego_speed == own.speed == world.start[1]
    x, y, heading = world.road.position(crossings.ego_start, world.start[0])
    assert world.network.get_closest_lane_index(np.array([x, y]), heading) == own.lane_index


@table("destination", ["o1", "o2", "o3"])
def test_way_speeds_respect_its_limit_and_bends(destination):
    world = intersection(destination)
    for way in world.crossings.ways.values():
        line = world.road.junction.ways[way.zone.way].line
        turned = np.abs(np.diff(np.unwrap(line.heading))) / STEP
        pull = np.minimum(way.speeds[1:], way.speeds[:-1]) ** 2 * turned
        assert pull.max() < world.limits.lateral_acceleration
        assert way.speeds.max() <= world.limits.overspeed * 10.0
        length = math.fsum(np.hypot(np.diff(line.x), np.diff(line.y)))
        assert way.length == pytest.approx(length, abs=STEP)


# An oracle: boxes as polygons, at places of the two ways between the points of their lines.


def poses_of_way(world, name):
    """Return places along a way and a vehicle's poses there, by highway-env's lanes for a way of points."""
    way = world.road.junction.ways[name]
    places = np.arange(0.1, way.way.length - 1, 0.47)
    return places, posed(way.line, np.array(way.column.lean), places)


def poses_of_ego(world):
    column = world.road.columns[world.road.ego_lane]
    places = np.arange(world.road.start, world.road.end - 1, 0.47)
    return places, posed(world.road.line, np.array(column.lean), places)


def inner(places, poses):
    """Return those inside a junction, without the roads that lead away from it."""
    is_inner = np.hypot(poses[:, 0], poses[:, 1]) < 40
    return places[is_inner], poses[is_inner]


def posed(line, lean, places):
    points = np.arange(len(line.x)) * STEP
    columns = line.x, line.y, line.heading + lean
    return np.stack([np.interp(places, points, column) for column in columns], axis=-1)


def touching(first, second, wider):
    """Return which poses of two rows touch as boxes, by their corners and edges."""
    apart = np.hypot(*(first[:, None, :2] - second[None, :, :2]).transpose(2, 0, 1))
    near = apart < math.hypot(LENGTH, WIDTH + wider)
    boxes, others = (
        [corners(pose, LENGTH, WIDTH + wider) for pose in poses.tolist()]
        for poses in (first, second)
    )
    found = np.zeros(near.shape, dtype=bool)
    for a, b in np.argwhere(near):
        found[a, b] = polygons_meet(boxes[a], others[b])
    return found


def first_run(places, flags, since):
    """Return the first and last of the first consecutive flagged places from a place on."""
    flagged = np.flatnonzero(flags & (places >= since))
    breaks = np.flatnonzero(np.diff(flagged) > 2)
    return places[flagged[0]], places[flagged[breaks[0] if breaks.size else -1]]


@pytest.mark.parametrize("world", [
    pytest.param(intersection("o1"), id="left"),
    oracle(intersection("o2"), id="straight on"),
    oracle(intersection("o3"), id="right"),
    oracle(world_of("roundabout-v1"), id="roundabout"),
])  # fmt: skip
def test_zones_are_stretches_where_boxes_along_ways_touch(world):
    along_ego, ego = poses_of_ego(world)
    for zone in world.crossings.zones:
        along, npc = poses_of_way(world, zone.way)
        near = (along > zone.npc[0] - 30) & (along < zone.npc[1] + 10)
        own = (along_ego > zone.ego[0] - 30) & (along_ego < zone.ego[1] + 10)
        wide = touching(ego[own], npc[near], WIDER)
        stretches = (
            (zone.ego, along_ego[own], wide.any(axis=1)),
            (zone.npc, along[near], wide.any(axis=0)),
        )
        for (enters, leaves), places, touches in stretches:
            first, last = first_run(places, touches, places[0])
            assert enters <= first <= enters + 1.5, zone
            if zone.kind == "merging":
                assert last > leaves, zone  # both continue in one lane
            else:
                assert leaves - 1.5 <= last <= leaves, zone
        assert touching(ego[own], npc[near], 0.0).any(), zone


@table("destination", ["o1", "o2", "o3"])
def test_middle_of_a_way_is_in_its_zone_and_in_the_egos_lane(destination):
    world = intersection(destination)
    _, ego = poses_of_ego(world)
    for way in world.road.junction.ways.values():
        enters, leaves = way.way.zone.npc
        assert enters < way.middle < leaves
        (x, y, _), *_ = posed(way.line, np.array(way.column.lean), [way.middle])
        assert np.hypot(ego[:, 0] - x, ego[:, 1] - y).min() < 0.6, way.way.zone


@pytest.mark.parametrize(("angle", "merges"), [(0.09, True), (0.11, False)])
def test_ways_merge_if_they_differ_by_less_than_a_tenth_of_a_radian(angle, merges):
    """One crosses the other at a small angle, halfway along both."""
    places, courses = np.arange(-50.0, 50.0, STEP), []
    for turned in (0.0, angle):
        direction = turned, math.cos(turned), math.sin(turned)
        constant = [np.full(places.shape, value) for value in direction]
        courses.append(Course(places * direction[1], places * direction[2], *constant))
    (meeting,) = meetings_of(*courses, near_pairs(*courses))
    assert meeting.merges == merges


def test_merging_zone_ends_one_vehicle_length_after_joining():
    for world in (*map(intersection, ("o1", "o2", "o3")), world_of("roundabout-v1")):
        for zone in (each for each in world.crossings.zones if each.kind == "merging"):
            (along, npc), (_, ego) = poses_of_way(world, zone.way), poses_of_ego(world)
            apart = np.hypot(*(npc[:, None, :2] - ego[None, :, :2]).transpose(2, 0, 1))
            turned = np.abs(wrapped(npc[:, 2] - ego[apart.argmin(axis=1), 2]))
            together = (apart.min(axis=1) < 0.6) & (turned < 0.11)
            assert together[(along > zone.npc[1] - LENGTH) & (along < zone.npc[1])].all(), zone
            assert not together[along < zone.npc[1] - LENGTH - 1.5].any(), zone


@pytest.mark.parametrize(
    "world", [pytest.param(intersection("o1"), id="left"), oracle(world_of("roundabout-v1"))]
)
def test_ways_meet_wherever_boxes_along_them_touch(world):
    crossings, names = world.crossings, sorted(world.crossings.ways)
    for number, one in enumerate(names):
        for other in names[number + 1 :]:
            if one.split(">")[0] == other.split(">")[0]:
                assert (one, other) in crossings.meetings
                continue
            (along, first), (its_along, second) = (
                inner(*poses_of_way(world, name)) for name in (one, other)
            )
            touches = touching(first, second, 0.0)
            assert ((one, other) in crossings.meetings) == touches.any(), (one, other)
            if not touches.any():
                continue
            known = np.zeros(touches.shape, dtype=bool)
            for (begins, ends), (its_begins, its_ends) in crossings.meetings[one, other]:
                mine, theirs = along >= begins, its_along >= its_begins
                known |= ((along <= ends) & mine)[:, None] & (its_along <= its_ends) & theirs
                pose, its_pose = (each[np.abs(places - end).argmin()] for each, places, end in (
                    (first, along, ends), (second, its_along, its_ends)
                ))  # fmt: skip
                if np.hypot(*(pose - its_pose)[:2]) < 1.0:  # both lead on in one lane
                    known |= mine[:, None] & theirs
            assert not (touches & ~known).any(), (one, other)


# Networks of the user's own.


class OwnJunction(OwnEnvironment):
    """A straight road from west to east, a second one across it, and a road that joins it with a bend.

    The option says from where the ego comes, the west or the bend.
    """

    options: ClassVar = {"from": "w", "duration": 12, "policy_frequency": 5}

    def _reset(self):
        bend = [20, 20], 20, math.pi, 1.5 * math.pi
        lanes = [
            ("w", "m", StraightLane([-150, 0], [20, 0], speed_limit=15)),
            ("m", "e", StraightLane([20, 0], [200, 0], speed_limit=15)),
            ("n", "s", StraightLane([-20, -120], [-20, 120], speed_limit=15)),
            ("b", "c", StraightLane([0, 150], [0, 20], speed_limit=15)),
            ("c", "m", CircularLane(*bend, clockwise=True, speed_limit=15)),
        ]
        lane = next(lane for origin, _, lane in lanes if origin == self.config["from"])
        at = lane.length - 90
        self.open(lanes, lane.position(at, 0), lane.heading_at(at))


@pytest.fixture
def own_junction(register):
    register("OwnJunction-v0", OwnJunction)
    return lambda origin: World("OwnJunction-v0", {"from": origin})


def test_joining_vehicle_yields_and_equal_roads_have_none(own_junction):
    assert zones_of(own_junction("w")) == {
        "n>s": ("crossing", "left", "none"),
        "b>e": ("merging", "right", "ego"),
    }
    assert zones_of(own_junction("b")) == {"w>e": ("merging", "left", "npc")}


def test_ego_starts_no_later_than_its_environment_says(own_junction):
    for origin, before in (("w", 60.0), ("b", None)):
        world = own_junction(origin)
        zone = world.crossings.zones[0]
        x, y, _ = world.road.position(world.crossings.ego_start, world.start[0])
        own = world.environment.unwrapped.vehicle.position
        if before is None:
            assert (x, y) == pytest.approx(tuple(own), abs=0.1)
        else:
            assert zone.ego[0] - world.crossings.ego_start == pytest.approx(before, abs=STEP)
            assert x < own[0] - 10
