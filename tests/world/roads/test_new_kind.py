"""A kind of road that the package does not have: straight lanes at an angle to the x axis."""

import math
from array import array
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

import pytest_pafot as pafot
from pytest_pafot import Highway, LaneInstruction, PositionInstruction, Scenario
from pytest_pafot.model.trace import HEADING, SPEED
from pytest_pafot.model.vehicle_type import CAR
from pytest_pafot.world import codec
from pytest_pafot.world.kernel.lanes import COLUMNS, Places
from pytest_pafot.world.kernel.observation import Observer, Sensor
from pytest_pafot.world.roads.road import StraightRoad
from tests.helpers.tables import table

ANGLE = 0.7


class TurnedPlaces(Places):
    def __init__(self, road, vehicles, bodies):
        super().__init__(vehicles, bodies)
        self.road = road

    def see(self, record, row):
        for vehicle, body in zip(self.vehicles, self.bodies, strict=True):
            body.place(*self.road.project(vehicle.x, vehicle.y, vehicle.heading), vehicle.speed)
            record[row + 6] = self.road.grid.locate(body)
            row += COLUMNS


class TurnedSensor(Sensor):
    """Shows a planner the road from a record of its own, in road coordinates."""

    def __init__(self, road, record, places, rates):
        super().__init__()
        self.road, self.record, self.row = road, record, len(places.vehicles) * COLUMNS
        self.turned = array("d", [0.0]) * len(record)
        sizes = [(each.length, each.width) for each in places.vehicles]
        self.observer = Observer(self.turned, sizes, road.grid, road.speed_limit, *rates)

    def observation(self, tick):
        for at in range(tick * self.row, (tick + 1) * self.row, COLUMNS):
            values = self.record[at : at + COLUMNS]
            self.turned[at : at + COLUMNS] = array(
                "d", [*self.road.project(*values[:3]), *values[3:]]
            )
        return self.observer.observation(tick)


@dataclass(frozen=True)
class TurnedRoad(StraightRoad):
    starts_at_origin = False

    def project(self, x, y, heading):
        cos, sin = math.cos(ANGLE), math.sin(ANGLE)
        return x * cos + y * sin, y * cos - x * sin, heading - ANGLE

    def position(self, longitudinal, lane, vehicle=CAR):
        cos, sin, across = math.cos(ANGLE), math.sin(ANGLE), self.centre(lane)
        return longitudinal * cos - across * sin, longitudinal * sin + across * cos, ANGLE

    def places(self, vehicles, bodies, scenario, **_):
        return TurnedPlaces(self, vehicles, bodies)

    def sensor(self, places, record, scenario, rates, sight, ego, seat=0):
        return TurnedSensor(self, record, places, rates)


@dataclass(frozen=True, kw_only=True)
class TurnedHighway(Highway):
    @cached_property
    def road(self):
        cos, sin = math.cos(ANGLE), math.sin(ANGLE)
        lanes = super().road.lanes
        turned = [replace(each, heading=ANGLE, x=-sin * each.y, y=cos * each.y) for each in lanes]
        return TurnedRoad(tuple(turned))


def follower(seen):
    ego = seen.ego
    ahead = [each.x for each in seen.others if abs(each.y - ego.y) < 2 and each.x > ego.x]
    if min(ahead, default=ego.x + 100.0) - ego.x < 5 + 0.4 * ego.speed:
        return -6.0, 0.0
    return 0.5 * (ego.speed < 24), 0.0


@table("speed", [18.0, 19.0, 20.0])
def test_runs_on_a_turned_road_are_those_on_a_straight_one(speed):
    on_grid = [PositionInstruction(2, 20.0), PositionInstruction(1, 10.0)] * 3
    chains = [on_grid, [LaneInstruction("right", 18.0)] * 6]
    scenario = Scenario(npcs=chains, ego_lane=1, ego_speed=speed)
    straight, turned = (
        world.rollout(scenario, lambda: follower) for world in (Highway(), TurnedHighway())
    )
    for name in ("outcome", "executed", "arrivals"):
        assert getattr(turned, name) == getattr(straight, name)
    states = turned.states - np.eye(7)[HEADING] * ANGLE
    columns = [HEADING, SPEED]
    np.testing.assert_allclose(states[..., columns], straight.states[..., columns], atol=1e-9)
    for vehicle in range(3):
        np.testing.assert_allclose(turned.track_of(vehicle), straight.track_of(vehicle), atol=1e-8)
    np.testing.assert_allclose(turned.road.offsets, straight.road.offsets, atol=1e-8)


def test_collisions_on_a_turned_road_have_a_responsible_vehicle(monkeypatch):
    # as a new kind would be
    monkeypatch.setattr(codec, "BUILT_IN", codec.BUILT_IN | {"turned": TurnedHighway})
    found = pafot.explore(
        lambda: follower, world=TurnedHighway(), holds=lambda run: None, runs=16, seed=1, workers=1
    )
    assert found.summary.outcomes["collision"]
    assert found.summary.responsibilities["ego"]
