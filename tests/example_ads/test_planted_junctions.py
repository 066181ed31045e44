"""The drivers with a defect at junctions are complete, drive, and are careful once they are repaired."""

import pytest

from example_ads import junctions
from pytest_pafot import CrossingInstruction, Outcome, Scenario
from tests.benchmarks import planted_junctions
from tests.benchmarks.planted.junctions import PLANTED, RING, WORLDS


def scenario_of(world, *slots):
    """Somebody with the ego at as many zones as there are slots."""
    lane, speed = world.start
    ways = [zone.way for zone in world.crossings.zones]
    npcs = [[CrossingInstruction(way, slot, 7.0)] for way, slot in zip(ways[:: len(ways) // 2], slots, strict=False)]
    return Scenario(npcs=npcs, ego_lane=lane, ego_speed=speed)


def test_each_has_a_world_and_two_are_at_a_roundabout():
    assert PLANTED.keys() == WORLDS.keys()
    assert len(PLANTED) >= 10
    assert sum(world is RING for world in WORLDS.values()) == 2


@pytest.mark.parametrize("name", sorted(PLANTED))
def test_driver_and_twin_drive_and_the_twin_is_the_careful_one(name):
    world = WORLDS[name]
    scenario = scenario_of(world, 0.0, 0.5)
    trace, again = (world.rollout(scenario, PLANTED[name].make()) for _ in range(2))
    assert trace.outcome is not Outcome.ADS_ERROR
    assert (trace.states == again.states).all()
    careful, twin = (world.rollout(scenario, make) for make in (junctions.make, PLANTED[name].twin()))
    assert (careful.states == twin.states).all()


def test_a_defect_is_found_and_its_twin_is_not():
    found = planted_junctions.search("slow-ones-leave", 1, 60, twins=False)
    assert found.found
    twin = planted_junctions.search("slow-ones-leave", 1, found.runs, twins=True)
    assert (twin.found, twin.runs, twin.policy) == (False, found.runs, "slow-ones-leave, repaired")
