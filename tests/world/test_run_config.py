"""Danger comes only from driving: at tick 0 no vehicle touches or endangers another."""

import itertools
import random
from types import SimpleNamespace

import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle

from pytest_pafot import Cell, Highway, PositionInstruction, Scenario, World, criticality
from pytest_pafot.model.instructions import cell_at
from pytest_pafot.model.trace import HEADING, LANE, SPEED, X, Y
from pytest_pafot.world.engines.run import starts_of
from pytest_pafot.world.limits import BEND_SHARE
from tests.helpers.tables import table
from tests.helpers.world_cases import LENGTH, WIDTH, constant_speed, random_scenario


def hold(*cells, **fields):
    npcs = [[PositionInstruction(cell, 20.0)] for cell in cells]
    return Scenario(npcs=npcs, gene_seconds=0.2, **fields)


@table("headway", [1.0, 2.0, 4.0])
@table("speed", [0.0, 10.0, 22.0, 26.8])
def test_npcs_start_alongside_ego_or_at_the_headway(headway, speed):
    world = Highway(headway=headway)
    trace = world.rollout(hold(*Cell, ego_speed=speed, ego_lane=2), constant_speed)
    ego, npcs = trace.ego[0], trace.npcs[0]
    apart = max(headway * speed, world.clearance)
    for cell, npc in zip(Cell, npcs, strict=True):
        assert npc[Y] - ego[Y] == 4.0 * cell.column
        assert np.sign(npc[X] - ego[X]) == cell.row
        bumper_to_bumper = abs(npc[X] - ego[X]) - LENGTH
        assert bumper_to_bumper == pytest.approx(apart if cell.row else -LENGTH)
    assert set(trace.states[0, :, SPEED]) == {speed}
    assert set(trace.states[0, :, HEADING]) == {0.0}
    assert not trace.states[0, :, 4:6].any(), "nobody has accelerated or steered yet"


def test_all_vehicles_start_apart_on_the_road():
    rng = random.Random(3)
    for _ in range(150):
        world = Highway(lanes=rng.randint(3, 6), headway=rng.choice([1.0, 2.0, 10.0]), duration=0.2)
        scenario = random_scenario(rng, lanes=world.lanes, speed_limit=26.8)
        trace = world.rollout(scenario, constant_speed)
        start = trace.states[0]
        assert (start[:, LANE] >= 0).all()
        assert (start[:, X] > LENGTH).all()
        for a, b in itertools.combinations(start, 2):
            along, across = abs(a[X] - b[X]), abs(a[Y] - b[Y])
            assert along >= LENGTH + world.clearance - 1e-9 or across >= WIDTH + 1.0
        assert np.isinf(criticality.ttc(trace)[0]).all()
        assert criticality.min_gap(trace) > 1.0


@table("ego_lane", range(4))
def test_npc_without_start_lane_uses_the_nearest_cell(ego_lane):
    for cell in Cell:
        trace = Highway().rollout(hold(cell, ego_lane=ego_lane), constant_speed)
        (started,) = trace.executed.npcs[0]
        assert 0 <= ego_lane + started.cell.column < 4
        assert started.cell == cell or not 0 <= ego_lane + cell.column < 4
        dx, dy = trace.npcs[0, 0, :2] - trace.ego[0, :2]
        assert cell_at(dx, dy, LENGTH, 4.0) == started.cell


def test_literal_grid_of_paper_starts_without_contact():
    world, scenario = Highway(clearance=0.0, headway=0.0), hold(*Cell, ego_lane=1, ego_speed=20.0)
    trace = world.rollout(scenario, constant_speed)
    assert trace.duration == pytest.approx(0.2)
    apart = np.abs(trace.npcs[0, :, X] - trace.ego[0, X])
    assert apart.tolist() == [LENGTH, LENGTH, LENGTH, 0.0] * 2


class Truck(Vehicle):
    LENGTH, WIDTH = 16.0, 2.6


@table("speed", [0.0, 20.0])
def test_a_long_ego_starts_with_the_same_gaps(speed):
    trace = Highway().rollout(hold(*Cell, ego_lane=1, ego_speed=speed), Truck)
    assert trace.sizes[0].tolist() == [16.0, 2.6]
    gaps = np.abs(trace.npcs[0, :, X] - trace.ego[0, X]) - (16.0 + LENGTH) / 2
    outside = [cell.row != 0 for cell in Cell]
    assert gaps[outside] == pytest.approx(max(3.0, 2.0 * speed))
    assert trace.duration == pytest.approx(0.2)


def test_npc_starts_no_faster_than_bend_allows():
    """If it leans in its lane as in the bend, it turns by v sin(lean) / (length / 2) [rad/s]; times v is sideways."""
    world = World("racetrack-v0")
    rules, scenario, slowed = world.rules, hold(*Cell, ego_lane=0, ego_speed=20.0), 0
    director = SimpleNamespace(first_cells=lambda: tuple(Cell), started=list)
    (_, *places), driven = starts_of(rules, scenario, director, LENGTH)
    for cell, along, (*_, speed) in zip(Cell, places, driven, strict=True):
        lane = scenario.ego_lane + cell.column
        sideways = speed**2 * np.sin(abs(rules.road.bends.lean_at(lane, along))) / (LENGTH / 2)
        most = BEND_SHARE * rules.limits.lateral_acceleration
        assert sideways <= most + 1e-9
        if speed < min(scenario.ego_speed, rules.road.bends.speed_at(lane, along)):
            assert sideways == pytest.approx(most)
            slowed += 1
    assert slowed


def test_cells_around_a_long_ego_are_reached_safely():
    npcs = [[PositionInstruction(cell, 20.0)] for cell in (2, 6)]
    trace = Highway().rollout(Scenario(npcs=npcs, ego_speed=20.0), Truck)
    for npc, (arrival,) in enumerate(trace.arrivals):
        gap = abs(trace.npcs[arrival, npc, X] - trace.ego[arrival, X]) - (16.0 + LENGTH) / 2
        assert gap == pytest.approx(3.0, abs=LENGTH / 2)
    assert criticality.min_gap(trace) > 0


@table("ego", [IDMVehicle, lambda: lambda observation: 1])
def test_gym_worlds_start_in_the_same_way(ego):
    scenario = hold(*Cell, ego_lane=1, ego_speed=22.0)
    trace = World("highway-v0", duration=0.2).rollout(scenario, ego)
    reference = Highway(duration=0.2).rollout(scenario, constant_speed)
    assert trace.states[0, :, :6].tolist() == reference.states[0, :, :6].tolist()
