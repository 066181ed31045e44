"""Runs that go on after the end of their scenario and of their world's own duration."""

import pickle
import random
from dataclasses import replace

import pytest
from gymnasium.wrappers import FlattenObservation
from highway_env.vehicle.behavior import IDMVehicle, LinearVehicle

from example_ads.junctions import CarefulDriver
from pytest_pafot import CrossingInstruction, Highway, PositionInstruction, Scenario, World
from pytest_pafot.model.trace import LANE, SPEED, Outcome, X
from pytest_pafot.world import from_dict
from tests.helpers.refusals import refused
from tests.helpers.tables import table
from tests.helpers.world_cases import EGOS, chains, constant_speed

DURATION = 4.0


def idle():
    return lambda observation: 1


def simulating(env):
    return lambda observation: int(env.action_space.sample())


def hard_to_please(observation):
    """Return an action that depends on every bit of an observation."""
    return (float(hash((observation.array.tobytes(), observation.road_length)) % 7 - 3), 0.0)


JUNCTION = World("intersection-v0", planner_hz=5, duration=DURATION, config={"destination": "o2"})
CASES = [
    *((Highway(duration=DURATION), ego) for ego in (*EGOS, lambda: hard_to_please)),
    (Highway(duration=DURATION), LinearVehicle),
    (World("highway-v0", duration=DURATION), idle),
    (World("highway-v0", duration=DURATION), simulating),
    (World("highway-v0", duration=DURATION), IDMVehicle),
    (World("highway-v0", duration=DURATION, wrappers=[FlattenObservation]), idle),
    (JUNCTION, CarefulDriver),
    (World("intersection-v0", duration=DURATION), idle),
    (World("roundabout-v0", duration=DURATION), idle),
]


def scenarios(world):
    if world.crossings is None:
        for lane in (0, 2):
            npcs = chains(random.Random(lane), 3, 2, 20.0)
            yield Scenario.repaired(npcs, ego_lane=lane, gene_seconds=1.0)
        return
    lane, speed = world.start
    for zone in world.crossings.zones[:2]:
        npc = (CrossingInstruction(zone=zone.way, slot=1.0, speed=5.0),)
        yield Scenario(npcs=(npc,), ego_lane=lane, ego_speed=speed, seed=3)


@pytest.mark.parametrize(("world", "ads"), CASES)
def test_longer_run_begins_as_the_usual_run(world, ads):
    endless = (Outcome.COMPLETED, Outcome.OFF_ROAD)
    for scenario in scenarios(world):
        worlds = (world, world.lasting(DURATION + 3.0))
        usual, longer = (each.rollout(scenario, ads) for each in worlds)
        rows = len(usual.states)
        assert longer.states[:rows].tobytes() == usual.states.tobytes()
        assert (longer.scenario, longer.actions[: len(usual.actions)]) == (scenario, usual.actions)
        assert usual.outcome not in endless or longer.ticks > usual.ticks
        assert longer.outcome not in endless or longer.duration == DURATION + 3.0


def test_road_and_configuration_stay_the_same():
    for world in (Highway(duration=DURATION), JUNCTION):
        # a road through a network equals only itself, and a world makes its own when asked
        road = world.road
        longer = world.lasting(14.0)
        assert (longer, longer.to_dict(), longer.road) == (world, world.to_dict(), road)
        assert (world.longest_run, longer.longest_run) == (DURATION, 14.0)


def test_npc_goes_on_with_its_last_instruction():
    scenario = Scenario(npcs=((PositionInstruction(2, 5.0),),), gene_seconds=3.0)
    worlds = (Highway(), Highway().lasting(13.0))
    usual, longer = (world.rollout(scenario, constant_speed) for world in worlds)
    (arrived,) = longer.arrivals[0]
    assert (usual.arrivals, usual.ticks < arrived) == (((None,),), True)


def test_npc_with_shorter_chain_keeps_lane_and_speed_for_good():
    """Both fall back from 40 m ahead. At 2 s one of them has no instruction left; the other drives on to its cell."""
    chains = [PositionInstruction(1, 20.0)], [PositionInstruction(3, 20.0)] * 2
    scenario = Scenario(npcs=chains, ego_speed=20.0, gene_seconds=2.0)
    trace = Highway().lasting(15.0).rollout(scenario, constant_speed)
    (short,), (_, arrived) = trace.arrivals
    assert short is None
    assert set(trace.npcs[:, 0, LANE]) == {0}
    assert trace.npcs[30:, 0, SPEED] == pytest.approx(trace.npcs[30, 0, SPEED], abs=0.2)
    assert arrived > 60, "after the end of its chain, too"
    assert trace.npcs[-1, 1, SPEED] == pytest.approx(20.0, abs=0.1)


def test_npc_that_has_arrived_takes_the_speed_of_its_last_gene():
    """It starts in its cell, and cannot brake from 20 to 10 m/s within its only gene of a second."""
    chains = [PositionInstruction(8, 10.0)], [PositionInstruction(2, 20.0)] * 4
    scenario = Scenario(npcs=chains, ego_speed=20.0, gene_seconds=1.0)
    trace = Highway().rollout(scenario, constant_speed)
    assert trace.arrivals[0] == (0,)
    assert trace.npcs[15, 0, SPEED] > 12.0
    assert trace.npcs[-1, 0, SPEED] == pytest.approx(10.0, abs=0.2)


@table(("world", "action"), [(Highway(speed_limit=36.0), (5.0, 0.0)), (World("highway-v0"), 3)])
def test_run_ends_before_the_end_of_a_straight_road(world, action):
    longer = world.lasting(3000.0)
    scenario = Scenario(npcs=((PositionInstruction(6, 0.0),),), ego_speed=30.0)
    trace = longer.rollout(scenario, lambda: lambda _: action)
    assert world.longest_run < longer.longest_run < 3000.0
    assert trace.ego[:, X].max() <= world.road.lanes[0].length
    assert (trace.ego[:, LANE] >= 0).all()


@table("seconds", [-5.0, 0, float("nan"), float("inf"), "20", None, True])
@table("world", [Highway(), World("highway-v0")])
def test_duration_that_is_no_positive_number_is_refused(world, seconds):
    with refused("lasting"):
        world.lasting(seconds)


def test_longer_world_survives_copies_and_shows_its_duration():
    longer = Highway().lasting(20.0)
    copies = replace(longer, lanes=5), pickle.loads(pickle.dumps(longer)), Highway(lasts=20.0)
    assert {each.longest_run for each in copies} == {20.0}
    assert "lasts=20.0" in repr(longer)
    with refused("lasts"):
        Highway(lasts=-1.0)
    with refused("world (kind highway)"):
        from_dict({**Highway().to_dict(), "lasts": 20.0})
