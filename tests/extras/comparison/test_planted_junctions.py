"""The drivers with a defect at junctions are complete and drive; without the defect they are careful."""

import pytest

from example_ads import junctions
from pytest_pafot import CrossingInstruction, Outcome, Scenario
from tests.benchmarks import planted_junctions
from tests.benchmarks.planted.junctions import PLACES, PLANTED, WHERE


def scenario_of(world, *slots):
    """Return a scenario with an NPC per slot, each at a zone with the ego."""
    lane, speed = world.start
    ways = [zone.way for zone in world.crossings.zones]
    npcs = [[CrossingInstruction(way, slot, 7.0)] for way, slot in zip(ways[:: len(ways) // 2], slots, strict=False)]
    return Scenario(npcs=npcs, ego_lane=lane, ego_speed=speed)


def test_planted_policies_cover_all_places():
    assert len(PLANTED) == 12
    assert set(WHERE.values()) == set(PLACES)
    assert list(WHERE.values()).count("roundabout") == 2


@pytest.mark.parametrize("name", sorted(PLANTED))
def test_driver_repeats_itself_and_twin_is_careful(name):
    world = PLACES[WHERE[name]]
    scenario = scenario_of(world, 0.0, 0.5)
    trace, again = (world.rollout(scenario, PLANTED[name].make()) for _ in range(2))
    assert trace.outcome is not Outcome.ADS_ERROR
    assert (trace.states == again.states).all()
    careful, twin = (world.rollout(scenario, make) for make in (junctions.make, PLANTED[name].twin()))
    assert (careful.states == twin.states).all()


@pytest.mark.oracle
def test_search_finds_defect_but_not_its_twin():
    found = planted_junctions.search("slow-ones-leave", 2, 60, twins=False)
    assert found.found
    twin = planted_junctions.search("slow-ones-leave", 2, found.runs, twins=True)
    assert (twin.found, twin.runs, twin.policy) == (False, found.runs, "slow-ones-leave, repaired")
