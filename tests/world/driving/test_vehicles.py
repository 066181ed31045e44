"""The trimmed vehicles and roads against highway-env's own, and roads that are not highway-env's."""

import math

import numpy as np
import pytest
from highway_env.road.lane import CircularLane, SineLane, StraightLane
from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import MDPVehicle
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.world import World
from pytest_pafot.world.driving.vehicles import (
    EgosRegulatedRoad,
    SearchedLanes,
    StockVehicle,
    straight_network,
    straight_road,
)
from pytest_pafot.world.kernel.lanes import Body
from tests.helpers.stages import mostly_oracle, oracle
from tests.helpers.tables import table

controls = st.lists(st.tuples(st.floats(-8, 6), st.floats(-0.78, 0.78)), min_size=1, max_size=12)


def parallel(lanes=3, *, x=0.0, y=0.0, width=4.0, length=1000.0):
    network = RoadNetwork()
    for number in range(lanes):
        ends = [x, y + width * number], [x + length, y + width * number]
        network.add_lane("a", "b", StraightLane(*ends, width=width, speed_limit=25))
    return network


OTHERS = parallel(), parallel(5, x=100.0, y=-20.0, width=3.5), parallel(1)
NETWORKS = [RoadNetwork.straight_road_network(4), *OTHERS]
places_y = st.floats(-40, 40) | st.sampled_from([2.0, 6.0, -18.25])
headings = st.none() | st.floats(-10, 10)


@given(st.sampled_from(NETWORKS), st.floats(-300, 12_000), places_y, headings)
def test_the_closest_lane_is_highway_envs(network, x, y, heading):
    position = np.array([x, y])
    closest = SearchedLanes(network).get_closest_lane_index(position, heading)
    assert closest == network.get_closest_lane_index(position, heading)


class Shifted(StraightLane):
    """An unknown class of lane: each place along it is elsewhere than its positions say."""

    def local_coordinates(self, position):
        return super().local_coordinates(np.asarray(position) - [0.0, 60.0])


def tangled(*others):
    """Return lanes of all kinds that cross and cover each other, some of them twice, and other lanes."""
    network = RoadNetwork()
    lanes = [
        StraightLane([-40, -10], [60, 30]),
        StraightLane([60, 30], [-40, -10]),
        CircularLane([0, 0], 25, -0.4, 1.2),
        CircularLane([5, 0], 18, 3.0, -2.5, clockwise=False),
        CircularLane([0, 0], 25, -0.4, 1.2),
        SineLane([0, -60], [4, -60], 12.0, 0.3, -1.2),
        StraightLane([20, -45], [-20, -45]),
        SineLane([0, -40], [0, 40], 0.5, 0.2, 0.0),
        *others,
    ]
    for number, lane in enumerate(lanes):
        network.add_lane("abc"[number % 3], "def"[number % 2], lane)
    return network


def places(network, rng, count):
    """Yield places near lanes, beyond their ends, and anywhere else."""
    for number in range(count):
        heading = None if number % 2 else rng.uniform(-10, 10)
        lane = network.lanes_list()[rng.integers(len(network.lanes_list()))]
        yield lane.position(rng.uniform(-8, lane.length + 8), rng.normal(0, 2)), heading
        yield rng.uniform(-120, 120, 2), heading


@pytest.mark.parametrize(("name", "count"), [
    ("tangled", 600),
    ("an unknown lane", 100),
    oracle("racetrack-v1", 150),
    oracle("roundabout-v1", 100),
    oracle("intersection-v0", 100),
])  # fmt: skip
def test_closest_lane_equals_highway_env_on_winding_roads(name, count):
    others = {"tangled": (), "an unknown lane": (Shifted([-60, -30], [60, -30]),)}
    network, found = tangled(*others[name]) if name in others else World(name).network, set()
    searched = SearchedLanes(network)
    for position, heading in places(network, np.random.default_rng(0), count):
        closest = RoadNetwork.get_closest_lane_index(network, position, heading)
        assert searched.get_closest_lane_index(position, heading) == closest
        found.add(closest)
    assert len(found) > len(network.lanes_list()) / 2


@table("position", [(math.nan, 0.0), (math.inf, 0.0), (0.0, -math.inf)])
def test_invalid_position_gets_closest_lane_of_highway_env(position):
    network = tangled()
    with np.errstate(invalid="ignore"):
        closest = SearchedLanes(network).get_closest_lane_index(np.array(position), 0.0)
        assert closest == network.get_closest_lane_index(np.array(position), 0.0)


def crossroads(kind, seed, ego_class):
    """Return an ego and others near the middle of an intersection, and how the others predict their places."""
    rng, network = np.random.default_rng(seed), World("intersection-v0").network
    road = kind(network, np_random=rng)
    lanes = [lane for index, lane in network.lanes_dict().items() if index[0].startswith("o")]
    for number in range(4):
        lane, at = lanes[(seed + number) % len(lanes)], rng.uniform(70.0, 90.0)
        start = lane.position(at, 0.0), lane.heading_at(at), rng.uniform(6.0, 10.0)
        vehicle = (StockVehicle if number else ego_class)(road, *start)
        vehicle.check_collisions = False
        road.vehicles.append(vehicle)
    road.vehicles[0].plan_route_to("o1")
    return road


@pytest.mark.parametrize("ego_class", mostly_oracle([IDMVehicle, MDPVehicle], MDPVehicle))
def test_ego_yields_exactly_where_regulated_road_says_so(ego_class):
    told, kinds = 0, (RegulatedRoad, EgosRegulatedRoad)
    for seed in range(4):
        stock, own = (crossroads(kind, seed, ego_class) for kind in kinds)
        for _ in range(45):
            for road in (stock, own):
                road.vehicles[0].act()
            own.regulate(1 / 15)
            Road.step(own, 1 / 15)
            stock.step(1 / 15)
            yields = [getattr(road.vehicles[0], "is_yielding", None) for road in (stock, own)]
            assert yields[0] == yields[1]
            told += bool(yields[0])
            assert stock.vehicles[0].target_speed == own.vehicles[0].target_speed
            assert np.array_equal(stock.vehicles[0].position, own.vehicles[0].position)
    assert (told > 0) == (ego_class is IDMVehicle)


def test_own_network_has_lanes_of_highway_env():
    stock = RoadNetwork.straight_road_network(4, length=900.0, speed_limit=26.8)
    pairs = straight_network(4, 900.0, 4.0, 26.8).lanes_list(), stock.lanes_list()
    for own, lane in zip(*pairs, strict=True):
        for name in ("start", "end", "width", "speed_limit", "line_types"):
            assert np.array_equal(getattr(own, name), getattr(lane, name))


def of_lanes(*lanes):
    network = RoadNetwork()
    for lane in lanes:
        network.add_lane("a", "b", lane)
    return network


EQUAL = [StraightLane([0, y], [500, y], speed_limit=25) for y in (0.0, 4.0, 8.0)]
UNEQUAL = StraightLane([0, 4.0], [400, 4.0], speed_limit=25)
CURVED = SineLane([0, 0], [100, 0], 2, 0.1, 0, speed_limit=20)
TURNED = RoadNetwork.straight_road_network(3, angle=0.3)


@table("network", [
    of_lanes(), of_lanes(CURVED), of_lanes(EQUAL[0], UNEQUAL), TURNED, of_lanes(EQUAL[1], EQUAL[0]),
])  # fmt: skip
def test_roads_not_straight_along_x_are_recognised(network):
    assert straight_road(network) is None
    assert straight_road(of_lanes(*EQUAL)) is not None


def test_lane_off_the_road_is_minus_one():
    grid = straight_road(parallel(3, x=100.0, y=-20.0, width=3.5)).grid

    def located(x, y):
        body = Body(5.0, 2.0)
        body.place(x, y, 0.0, 0.0)
        return grid.locate(body), body.lane

    lanes = {-1.76: -1, -1.75: 0, 0.0: 0, 1.75: 0, 1.76: 1, 7.0: 2, 8.75: 2, 8.76: -1}
    assert {y: located(400.0, y)[0] for y in lanes} == lanes
    assert [located(x, 0.0)[0] for x in (-0.1, 0.0, 1000.0, 1000.1)] == [-1, 0, 0, -1]
    for lateral in (-1.0, 0.0, 1.75, 1.76, 5.25, 7.0, 99.0):
        assert located(400.0, lateral)[1] == min(max(math.ceil(lateral / 3.5 - 0.5), 0), 2)
