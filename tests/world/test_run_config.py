"""Danger comes only from driving: at tick 0 no vehicle touches or endangers another."""

from __future__ import annotations

import itertools
import random
from types import SimpleNamespace

import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle

from pytest_pafot import criticality
from pytest_pafot.model.instructions import Cell, PositionInstruction, cell_at
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import HEADING, LANE, SPEED, X, Y
from pytest_pafot.world import Highway, World
from pytest_pafot.world.engines.run import starts_of
from pytest_pafot.world.limits import BEND_SHARE
from tests.helpers.tables import table
from tests.helpers.world_cases import LENGTH, WIDTH, constant_speed, random_scenario


def starts(world, scenario, ego=constant_speed):
    """Return the states at tick 0."""
    return world.rollout(scenario, ego)


def hold(*cells, **fields):
    return Scenario(
        npcs=[[PositionInstruction(cell, 20.0)] for cell in cells], gene_seconds=0.2, **fields
    )


@table("headway", [1.0, 2.0, 4.0])
@table("speed", [0.0, 10.0, 22.0, 26.8])
def test_npcs_start_alongside_ego_or_at_the_headway(headway, speed):
    world = Highway(headway=headway)
    trace = starts(world, hold(*Cell, ego_speed=speed, ego_lane=2))
    ego, npcs = trace.ego[0], trace.npcs[0]
    for cell, npc in zip(Cell, npcs, strict=True):
        assert npc[Y] - ego[Y] == 4.0 * cell.column
        bumper_to_bumper = abs(npc[X] - ego[X]) - LENGTH
        assert np.sign(npc[X] - ego[X]) == cell.row
        assert bumper_to_bumper == pytest.approx(
            max(headway * speed, world.clearance) if cell.row else -LENGTH
        )
    assert set(trace.states[0, :, SPEED]) == {speed}
    assert set(trace.states[0, :, HEADING]) == {0.0}
    assert not trace.states[0, :, 4:6].any(), "nobody has accelerated or steered yet"


def test_all_vehicles_start_apart_on_the_road():
    rng = random.Random(3)
    for _ in range(150):
        world = Highway(lanes=rng.randint(3, 6), headway=rng.choice([1.0, 2.0, 10.0]), duration=0.2)
        trace = starts(world, random_scenario(rng, lanes=world.lanes, speed_limit=26.8))
        start = trace.states[0]
        assert (start[:, LANE] >= 0).all()
        assert (start[:, X] > LENGTH).all()
        for a, b in itertools.combinations(start, 2):
            assert (
                abs(a[X] - b[X]) >= LENGTH + world.clearance - 1e-9
                or abs(a[Y] - b[Y]) >= WIDTH + 1.0
            )
        assert np.isinf(criticality.ttc(trace)[0]).all()
        assert criticality.min_gap(trace) > 1.0


@table("ego_lane", range(4))
def test_npc_without_start_lane_uses_the_nearest_cell(ego_lane):
    for cell in Cell:
        trace = starts(Highway(), hold(cell, ego_lane=ego_lane))
        (started,) = trace.executed.npcs[0]
        assert 0 <= ego_lane + started.cell.column < 4
        assert started.cell == cell or not 0 <= ego_lane + cell.column < 4
        dx, dy = trace.npcs[0, 0, :2] - trace.ego[0, :2]
        assert cell_at(dx, dy, LENGTH, 4.0) == started.cell


def test_literal_grid_of_paper_starts_without_contact():
    world = Highway(clearance=0.0, headway=0.0)
    trace = starts(world, hold(*Cell, ego_lane=1, ego_speed=20.0))
    assert trace.duration == pytest.approx(0.2)
    assert np.abs(trace.npcs[0, :, X] - trace.ego[0, X]).tolist() == [LENGTH] * 3 + [0.0] + [
        LENGTH
    ] * 3 + [0.0]


class Truck(Vehicle):
    LENGTH = 16.0
    WIDTH = 2.6


@pytest.mark.parametrize("speed", [0.0, 20.0])
def test_a_long_ego_starts_with_the_same_gaps(speed):
    world = Highway()
    trace = starts(world, hold(*Cell, ego_lane=1, ego_speed=speed), Truck)
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
    front = Scenario(
        npcs=[[PositionInstruction(2, 20.0)], [PositionInstruction(6, 20.0)]], ego_speed=20.0
    )
    trace = Highway().rollout(front, Truck)
    for npc, (arrival,) in enumerate(trace.arrivals):
        gap = abs(trace.npcs[arrival, npc, X] - trace.ego[arrival, X]) - (16.0 + LENGTH) / 2
        assert gap == pytest.approx(3.0, abs=LENGTH / 2)
    assert criticality.min_gap(trace) > 0


@pytest.mark.parametrize(
    "ego", [IDMVehicle, lambda: lambda observation: 1], ids=["vehicle class", "policy"]
)
def test_gym_worlds_start_in_the_same_way(ego):
    world = World("highway-v0", duration=0.2)
    trace = starts(world, hold(*Cell, ego_lane=1, ego_speed=22.0), ego)
    reference = starts(Highway(duration=0.2), hold(*Cell, ego_lane=1, ego_speed=22.0))
    assert trace.states[0, :, :6].tolist() == reference.states[0, :, :6].tolist()
