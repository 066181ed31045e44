"""Vehicles of other sizes keep their own limits, and touch where their boxes do, on every road and in every engine."""

from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle

from pytest_pafot import (
    CrossingInstruction,
    LaneCommand,
    LaneInstruction,
    PositionInstruction,
    Scenario,
    ScenarioError,
    VehicleType,
)
from pytest_pafot.algorithms import sample
from pytest_pafot.criticality.measures import Encounters, overlaps
from pytest_pafot.findings.finding import disagreement
from pytest_pafot.model.trace import ACCELERATION, HEADING, OFFSET, SPEED, Outcome
from pytest_pafot.model.vehicle_type import CAR, MOTORCYCLE, TRUCK, VAN
from pytest_pafot.oracle.run import Run
from pytest_pafot.world import Highway, World
from tests.helpers.limits import limits
from tests.helpers.refusals import refused
from tests.helpers.road_cases import ROADS, space_of, violations, world_of
from tests.helpers.stages import mostly_oracle
from tests.helpers.tables import table
from tests.helpers.world_cases import idm
from tests.helpers.world_cases import violations as violations_of_straight
from tests.report.builders import view_of

KINDS = (
    CAR, VAN, TRUCK, MOTORCYCLE,
    VehicleType(name="slow", length=18.0, width=2.55, acceleration=0.6, braking=5.0, lateral_acceleration=1.2,
                top_speed=9.0),
    VehicleType(name="tiny", length=1.0, width=0.5),
)  # fmt: skip


def keeping():
    """Return a planner that keeps its lane and speed."""
    return lambda seen: LaneCommand(lane=max(seen.ego.lane, 0), acceleration=0.0)


def fits(world, kind, way):
    """Return whether a vehicle can follow the bends of its way, or of the ego's."""
    if way is None:
        return world.can_drive(kind)
    return kind.can_follow(world.crossings.ways[way.zone].sharpest)


def with_kinds(scenario, world, rng):
    """Return a scenario with random vehicles, as far as they can follow the bends."""
    for npc, way in enumerate(scenario.crossings or (None,) * len(scenario.npcs)):
        kind = KINDS[int(rng.integers(len(KINDS)))]
        if fits(world, kind, way):
            scenario = scenario.with_vehicle(npc, kind)
    return scenario


def broken_limits(world, trace):
    return [promise for is_kept, promise, _ in limits(world, trace) if not is_kept]


def assert_fixed(world, trace, ego):
    assert world.rollout(trace.executed, ego).states.tobytes() == trace.states.tobytes()


def seeing(seen, action):
    """Return a factory of planners that store what they see."""
    return lambda: lambda now: (seen.append(now), action)[1]


VAN_AHEAD = Scenario(npcs=[[PositionInstruction(2, 10.0)] * 2], vehicles=["van"])


@pytest.mark.parametrize("traffic", ["paper", "hostile", "everyday"])
def test_own_limits_hold_on_a_straight_road(traffic):
    world, rng = Highway(duration=20.0), np.random.default_rng(4)
    for number in range(12):
        space = space_of(world, npcs=number % 5 + 1, traffic=traffic)
        scenario = with_kinds(sample(space, rng), world, rng)
        sizes = [[each.length, each.width] for each in scenario.all_vehicles]
        for ego in (keeping, idm):
            trace = world.rollout(scenario, ego)
            assert violations_of_straight(trace, world.limits, world.speed_limit) == [], scenario
            assert trace.sizes[1:].tolist() == sizes
            assert_fixed(world, trace, ego)


@pytest.mark.parametrize(
    "env_id", mostly_oracle(ROADS, "merge-v1", "roundabout-v1", "intersection-v0")
)
def test_own_limits_hold_on_every_road(env_id):
    world, rng = world_of(env_id, duration=6.0), np.random.default_rng(3)
    for _ in range(2):
        scenario = with_kinds(sample(space_of(world, traffic="hostile"), rng), world, rng)
        trace = world.rollout(scenario, idm)
        assert violations(trace, world) == [], trace.scenario
        assert_fixed(world, trace, idm)


def test_own_limits_hold_on_ways_that_cross():
    world, rng, crossing = world_of("intersection-v0"), np.random.default_rng(8), set()
    space = replace(space_of(world, npcs=3, traffic="hostile"), crossings=world.crossings)
    for _ in range(12):
        scenario = with_kinds(sample(space, rng), world, rng)
        pairs = zip(scenario.all_vehicles, scenario.crossings, strict=False)
        crossing |= {kind for kind, way in pairs if way}
        assert broken_limits(world, world.rollout(scenario, idm)) == [], scenario
    assert {CAR, TRUCK, MOTORCYCLE} < crossing


@pytest.mark.parametrize(
    "env_id", ["highway-v0", *mostly_oracle(ROADS, "merge-v1", "intersection-v0")]
)
def test_the_plain_environment_agrees(env_id):
    world, rng = world_of(env_id, duration=6.0), np.random.default_rng(6)
    npcs = 3 if world.crossings else min(3, world.most_on_grid)
    space = replace(space_of(world, npcs=npcs, traffic="hostile"), crossings=world.crossings)
    for _ in range(2):
        first = world.rollout(with_kinds(sample(space, rng), world, rng), idm)
        again = world.rollout_in_gym(first.executed, idm)
        assert disagreement(Run(first), Run(again)) == ""
        # IDM's steering magnifies rounding where it stands
        drives = np.minimum.accumulate(first.ego[:, SPEED] > 1.0)
        assert first.states[drives] == pytest.approx(again.states[drives], abs=1e-9)
        assert first.sizes.tolist() == again.sizes.tolist()


EGOS = tuple(kind for kind in KINDS if kind.braking >= 6.0)


PAIRS = [*((CAR, kind) for kind in KINDS), *((kind, CAR) for kind in EGOS[1:])]


@pytest.mark.parametrize(("ego", "npc"), PAIRS, ids=lambda kind: kind.name)
@table(("cell", "speed", "side"), [(2, 12.0, "front"), (4, 22.0, "right")])
def test_a_run_ends_exactly_when_the_boxes_touch(ego, npc, cell, speed, side):
    faster, steering = (3.0, 0.05) if ego is CAR else (1.0, 0.02)
    action = (faster, 0.0) if cell == 2 else (0.0, steering)
    still = Scenario(npcs=[[PositionInstruction(cell, speed)] * 3], vehicles=(npc,))
    trace = Highway(ego=ego).rollout(still, lambda: lambda seen: action)
    touching = overlaps(Encounters(trace).pairs)[0]
    assert touching.nonzero()[0].tolist() == [trace.ticks]
    assert (trace.outcome, trace.collision.side) == (Outcome.COLLISION, side)


def test_a_vehicle_starts_no_faster_than_it_can_drive():
    fast = Scenario(npcs=[[PositionInstruction(2, 26.0)]], ego_speed=26.8, vehicles=("truck",))
    speed = Highway().rollout(fast, idm).npcs[:, 0, SPEED]
    assert speed[0] == speed.max() == 25.0


def check_truck(way):
    """Check whether a truck can drive on a way that crosses."""
    world = world_of("intersection-v0")
    lane, speed = world.start
    npcs = [[CrossingInstruction(way, 0.0, 8.0)]]
    world.check_fits(Scenario(npcs=npcs, ego_lane=lane, ego_speed=speed, vehicles=("truck",)))


def test_a_vehicle_that_is_too_long_for_a_bend_is_refused():
    check_truck("o1>o3")
    with refused("vehicles[0]", ScenarioError):
        check_truck("o3>o0")
    with refused("ego"):
        World("racetrack-v0", ego=TRUCK).check()


def test_a_planner_sees_how_large_a_vehicle_is():
    seen = []
    scenario = Scenario(npcs=[[PositionInstruction(2, 10.0)]], vehicles=["truck"])
    for world in (Highway(), World("merge-v0", planner_hz=5)):
        world.rollout(scenario, seeing(seen, (0.0, 0.0)))
    assert {(each.others[0].length, each.others[0].width) for each in seen} == {(12.0, 2.55)}


def pedals(seen):
    """Return the acceleration and steering of a planner that asks for more than any vehicle can do."""
    return (9.0, 0.7) if seen.time < 4.0 else (-12.0, -0.7)


def full(seen):
    """Return the action of a policy that speeds up, and then brakes, as hard as it can."""
    return np.array([1.0, 1.0]) if seen[0, 1] < 0.9 else np.array([-1.0, 1.0])


@pytest.mark.parametrize("kind", EGOS[1:], ids=lambda kind: kind.name)
@pytest.mark.parametrize("ads", ["planner", "policy", "vehicle class"])
def test_an_ego_does_no_more_than_its_vehicle_can(kind, ads):
    world, factory = Highway(ego=kind), {"planner": lambda: pedals, "vehicle class": idm}.get(ads)
    if ads == "policy":
        config = {"action": {"type": "ContinuousAction"}, "duration": 12}
        world, factory = World("highway-v0", config, ego=kind), lambda: full
    ahead = Scenario(npcs=[[PositionInstruction(2, 3.0)]], ego_speed=26.0, gene_seconds=12.0)
    trace = world.rollout(ahead, factory)
    speed, turned = trace.ego[:, SPEED], np.diff(trace.ego[:, HEADING]) * trace.physics_hz
    assert trace.sizes[0].tolist() == [kind.length, kind.width]
    assert speed[0] == min(26.0, kind.top_speed)
    assert speed.max() <= kind.top_speed + 1e-9
    assert -kind.braking - 1e-9 <= trace.ego[:, ACCELERATION].min() < 0
    assert trace.ego[:, ACCELERATION].max() <= kind.acceleration + 1e-9
    assert np.abs(speed[:-1] * turned).max() <= kind.lateral_acceleration + 1e-9
    again = world.rollout_in_gym(trace.executed, factory)
    assert again.states == pytest.approx(trace.states, abs=1e-9)
    assert again.sizes.tolist() == trace.sizes.tolist()


@pytest.mark.parametrize("env_id", mostly_oracle(ROADS, "merge-v1", "intersection-v0"))
def test_an_ego_of_any_size_drives_on_every_road(env_id):
    plain = world_of(env_id, duration=6.0)
    for kind in filter(plain.can_drive, (VAN, MOTORCYCLE)):
        world, rng = replace(plain, ego=kind), np.random.default_rng(6)
        space = replace(space_of(world, npcs=2, traffic="hostile"), crossings=world.crossings)
        first = world.rollout(sample(space, rng), idm)
        again = world.rollout_in_gym(first.executed, idm)
        assert first.sizes[0].tolist() == again.sizes[0].tolist() == [kind.length, kind.width]
        assert disagreement(Run(first), Run(again)) == ""
        assert broken_limits(world, first) == []


def test_starts_are_measured_from_bumper_to_bumper():
    rows = [[PositionInstruction(cell, 15.0)] * 2 for cell in (2, 6, 4)]
    gaps = []
    for ego, npc in product(EGOS, (CAR, VAN)):
        scenario = Scenario(npcs=rows, vehicles=(npc,) * 3, ego_speed=15.0)
        run = Run(Highway(ego=ego).rollout(scenario, keeping))
        gaps.append([run.npcs[number].gap[0] for number in (0, 1)])
    assert np.array(gaps) == pytest.approx(np.array(gaps[:1] * len(gaps)))


def test_a_planner_sees_its_own_size_and_a_straightened_road():
    seen, npcs = [], [[LaneInstruction("keep", 5.0)]]
    for world in (Highway(ego=VAN), World("racetrack-v0", planner_hz=5, duration=8.0, ego=VAN)):
        scenario = Scenario(npcs=npcs, ego_lane=1, ego_speed=10.0)
        trace = world.rollout(scenario, seeing(seen, LaneCommand(lane=1, speed=8.0)))
    assert {(each.ego.length, each.ego.width) for each in seen} == {(6.5, 2.16)}
    assert abs(trace.track_of(0)[:, OFFSET]).max() < 0.25


class Bus(IDMVehicle):
    LENGTH, WIDTH = 12.0, 2.55


def drive_bus_as_van():
    Highway(ego=VAN).rollout(Scenario(npcs=[[PositionInstruction(2, 10.0)]]), lambda: Bus)


def test_a_vehicle_class_of_another_size_is_refused():
    scenario = Scenario(npcs=[[PositionInstruction(2, 10.0)]])
    for world in (Highway(), Highway(ego=TRUCK), World("highway-v0", ego=TRUCK)):
        for factory in (lambda: Bus, lambda: partial(Bus, enable_lane_change=False)):
            assert world.rollout(scenario, factory).sizes[0].tolist() == [12.0, 2.55]
    with refused("ego"):
        drive_bus_as_van()


def test_zones_of_a_long_ego_are_longer():
    cars, vans = (World("intersection-v0", ego=kind).crossings.zones for kind in (CAR, VAN))
    for zone, longer in zip(cars, vans, strict=True):
        assert longer == replace(zone, ego=(zone.ego[0] - 0.75, zone.ego[1] + 0.75))


@pytest.mark.parametrize(("kind", "expected"), [(CAR, 7.593), (TRUCK, 7.0)], ids=["car", "truck"])
def test_braking_that_a_truck_cannot_do_avoids_nothing(kind, expected):
    world, stops = Highway(ego=kind), [PositionInstruction(2, 22.0), PositionInstruction(2, 0.0)]
    scenario = Scenario(npcs=[stops], ego_speed=22.0, gene_seconds=2.0)
    trace = world.rollout_reference(scenario, "careful-human")
    hardest = -trace.ego[:, ACCELERATION].min()
    assert hardest == pytest.approx(expected, abs=1e-3)
    taken = world.take_over(world.rollout(scenario, keeping), 20, "careful-human")
    assert -taken.ego[:, ACCELERATION].min() <= hardest + 1e-9


def test_picture_names_the_vehicles():
    trace = Highway(ego=TRUCK).rollout(VAN_AHEAD, keeping)
    vehicles = [(each.name, each.length) for each in view_of(trace).vehicles]
    assert vehicles == [("ego, truck", 12.0), ("NPC 0, van", 6.5)]
    assert str(VAN_AHEAD).endswith(": van 2@10 2@10>")
