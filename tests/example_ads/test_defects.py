"""Each positive control is IDM+MOBIL with one defect, which shows only in its own situation."""

from dataclasses import dataclass

import numpy as np
import pytest
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle

from example_ads import defects
from pytest_pafot import Cell, Highway, PositionInstruction, Scenario, World
from pytest_pafot.model.trace import SPEED, Outcome
from tests.helpers.c_library import c_library
from tests.helpers.stages import mostly_oracle, oracle
from tests.helpers.tables import table

LANE = 4.0
HZ = 15
ROAD = Highway(duration=20.0)
DEFECTIVE = [name for name in defects.POLICIES if name != "healthy"]


@dataclass(frozen=True)
class Other:
    """A vehicle: distance ahead of the ego's centre [m], lane, speed [m/s], and its first speed and lane."""

    ahead: float
    lane: int
    speed: float = 22.0
    before: float | None = None
    lane_before: int | None = None


@dataclass(frozen=True)
class Scene:
    """The ego in lane 1 and others around it.

    Attributes:
        others: The other vehicles when the ego decides.
        speed: The ego's speed [m/s].
        since: How long the ego has seen the others [s].
        lane_before: The ego's lane until now.
    """

    others: tuple[Other, ...]
    speed: float = 22.0
    since: float = 0.0
    lane_before: int = 1


def decision(policy, scene):
    """Return acceleration [m/s^2] and target lane of a driver that may change lanes now."""
    road = Road(
        RoadNetwork.straight_road_network(4, speed_limit=26.8), np_random=np.random.default_rng(0)
    )
    driver = policy(road, [500.0, LANE * scene.lane_before], 0.0, scene.speed)
    others = [Vehicle(road, [500.0 + o.ahead, LANE * o.lane], 0.0, o.speed) for o in scene.others]
    road.vehicles = [driver, *others]
    driver.enable_lane_change = False
    for tick in range(round(scene.since * HZ)):
        for vehicle, other in zip(others, scene.others, strict=True):
            vehicle.speed = other.speed if other.before is None or tick else other.before
            lane = other.lane if other.lane_before is None or tick else other.lane_before
            vehicle.position[1] = LANE * lane
            vehicle.lane_index = (*vehicle.lane_index[:2], lane)
            vehicle.position[0] = 500.0 + other.ahead - other.speed * (scene.since - tick / HZ)
        driver.act()
        driver.clock = (tick + 1) / HZ
    for vehicle, other in zip(others, scene.others, strict=True):
        vehicle.position[0] = 500.0 + other.ahead
    _put_in_lane_one(driver)
    driver.enable_lane_change = True
    driver.timer = 2 * driver.LANE_CHANGE_DELAY
    driver.act()
    return float(driver.action["acceleration"]), driver.target_lane_index[2]


def _put_in_lane_one(driver):
    driver.position = np.array([500.0, LANE])
    driver.lane_index = driver.target_lane_index = (*driver.lane_index[:2], 1)
    driver.lane = driver.road.network.get_lane(driver.lane_index)


LEADER = Scene((Other(40.0, 1, 20.0), Other(40.0, 0, 20.0), Other(40.0, 2, 20.0)))
SLOW_LEADER = Other(30.0, 1, 15.0)
TAKEN = (SLOW_LEADER, Other(30.0, 0, 15.0))
"""The own lane and the left one are slow, and the right one is faster; a vehicle there decides."""

SITUATIONS = {
    "follows-too-close": [LEADER],
    "brakes-late-above-20": [LEADER],
    "brakes-weakly": [Scene((Other(20.0, 1, 15.0), Other(20.0, 0, 15.0), Other(20.0, 2, 15.0)))],
    "blind-beside-front-wheel": [Scene((*TAKEN, Other(2.0, 2, 22.0)))],
    "sees-old-speeds": [
        Scene((Other(40.0, 1, 15.0, before=22.0), Other(40.0, 0), Other(40.0, 2)), since=1.0)
    ],
    "sees-cut-ins-late": [Scene((Other(20.0, 1, 15.0, lane_before=0),), since=1.0)],
    "ignores-standing-vehicles": [
        Scene((Other(40.0, 1, 2.0), Other(30.0, 0, 10.0), Other(30.0, 2, 10.0)))
    ],
    "forgets-after-lane-change": [Scene((SLOW_LEADER,), since=0.5, lane_before=2)],
    "looks-only-ahead": [
        Scene((*TAKEN, Other(-4.0, 2, 22.0))),
        Scene((*TAKEN, Other(-12.0, 2, 26.0))),
    ],
    "changes-lanes-unchecked": [Scene((Other(0.0, 0), Other(0.0, 2)), since=8.1)],
    "trusts-any-gap-behind": [Scene((*TAKEN, Other(-7.0, 2, 26.0)))],
    "brakes-for-ghosts": [Scene((), since=12.1), Scene((), since=25.0)],
    "stops-in-its-lane": [Scene((), since=20.1), Scene((), since=45.0)],
}
"""Scenes in which the defect shows."""

LIKE_HEALTHY = {
    "follows-too-close": [Scene((Other(-10.0, 1),))],
    "brakes-late-above-20": [Scene(LEADER.others, speed=19.0), Scene((Other(12.0, 1, 15.0),))],
    "brakes-weakly": [Scene((Other(60.0, 1, 22.0),))],
    "blind-beside-front-wheel": [
        LEADER,
        Scene((*TAKEN, Other(12.0, 2, 22.0))),
        Scene((*TAKEN, Other(-4.0, 2, 22.0))),
    ],
    "sees-old-speeds": [Scene(LEADER.others, since=1.0), Scene(LEADER.others, since=3.0)],
    "sees-cut-ins-late": [LEADER, Scene((Other(20.0, 1, 15.0, lane_before=0),), since=3.0)],
    "ignores-standing-vehicles": [LEADER, Scene((Other(40.0, 1, 4.0),))],
    "forgets-after-lane-change": [LEADER, Scene((SLOW_LEADER,), since=3.0)],
    "looks-only-ahead": [LEADER, Scene((*TAKEN, Other(2.0, 2, 22.0)))],
    "changes-lanes-unchecked": [LEADER, Scene((*TAKEN, Other(0.0, 2)), since=7.5)],
    "trusts-any-gap-behind": [LEADER, Scene((*TAKEN, Other(-6.0, 2, 26.0)))],
    "brakes-for-ghosts": [LEADER, Scene((), since=11.9), Scene((), since=13.5)],
    "stops-in-its-lane": [LEADER, Scene((), since=19.9), Scene((), since=33.0)],
}
"""Scenes that are close to the situation, but not in it."""


def cases(situations):
    return [(name, scene) for name, scenes in situations.items() for scene in scenes]


@table(("name", "scene"), cases(SITUATIONS))
def test_a_defect_shows_in_its_own_situation(name, scene):
    assert decision(defects.make(name), scene) != decision(defects.make("healthy"), scene)


@table(("name", "scene"), cases(LIKE_HEALTHY))
def test_driver_decides_like_healthy_one_outside_its_defect(name, scene):
    assert decision(defects.make(name), scene) == pytest.approx(
        decision(defects.make("healthy"), scene), abs=1e-9
    )


def test_every_defect_has_its_situation():
    assert set(SITUATIONS) == set(LIKE_HEALTHY) == set(DEFECTIVE) - set(defects.COMBINED)


def chain(*genes):
    return tuple(PositionInstruction(cell, speed) for cell, speed in genes)


PASSES_BY = Scenario(
    npcs=(chain((Cell.FRONT_LEFT, 26.0), (Cell.FRONT_LEFT, 26.0)),), gene_seconds=10.0
)
STEADY_LEADER = Scenario(
    npcs=(chain((Cell.FRONT, 21.0), (Cell.FRONT_RIGHT, 24.0)),), gene_seconds=10.0
)
BRAKES_AHEAD = Scenario(npcs=(chain((Cell.FRONT, 10.0), (Cell.FRONT, 10.0)),), gene_seconds=10.0)


@pytest.mark.parametrize(
    "scenario", [oracle(PASSES_BY, id="passes-by"), pytest.param(STEADY_LEADER, id="steady-leader")]
)
@pytest.mark.parametrize(
    "name", mostly_oracle(defects.POLICIES, "healthy", "sees-cut-ins-late", "brakes-for-ghosts")
)
def test_in_benign_traffic_nobody_collides(name, scenario):
    trace = ROAD.rollout(scenario, defects.make(name))
    assert trace.outcome is Outcome.COMPLETED, trace.error
    assert trace.duration == 20.0


@pytest.mark.parametrize("scenario", [oracle(PASSES_BY), oracle(STEADY_LEADER), BRAKES_AHEAD])
def test_the_healthy_one_drives_as_highway_envs_own(scenario):
    with c_library():  # numpy may round differently
        healthy, stock = (
            ROAD.rollout(scenario, policy) for policy in (defects.make("healthy"), IDMVehicle)
        )
    assert (healthy.states == stock.states).all()


@pytest.mark.parametrize("env_id", ["highway-v0", "intersection-v0"])
def test_the_healthy_one_sees_others_in_an_environment(env_id):
    """Its road is its own, but everybody on the environment's road is on it, and it yields as others do."""
    world = World(env_id, duration=10.0)
    lane, speed = world.start or (1, 22.0)
    scenario = Scenario(npcs=BRAKES_AHEAD.npcs, ego_lane=lane, ego_speed=speed, gene_seconds=10.0)
    with c_library():  # numpy may round differently
        healthy, stock = (
            world.rollout(scenario, policy) for policy in (defects.make("healthy"), IDMVehicle)
        )
    assert healthy.states.tobytes() == stock.states.tobytes()
    assert healthy.ego[:, SPEED].min() < speed - 5.0


@table("name", DEFECTIVE)
def test_each_defect_documents_its_kind_and_cause(name):
    text = defects.make(name).__doc__
    assert len(text.splitlines()[0]) > 30
    assert "Why it happens:" in text
