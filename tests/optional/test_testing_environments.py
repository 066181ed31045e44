"""The kit that checks a world accepts environments with rates, resets and obstacles of their own."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from gymnasium.wrappers import FlattenObservation, MaxAndSkipObservation
from highway_env.vehicle.kinematics import Vehicle

from pytest_pafot import PositionInstruction, Scenario, World
from pytest_pafot.model.trace import Outcome
from pytest_pafot.testing import check_world
from pytest_pafot.testing.traces import contacts, end
from tests.world.test_gym_environment import (
    AT_ONCE,
    IDLE,
    Drawn,
    Hurried,
    Repeating,
    Roadworks,
    register,  # noqa: F401  (a fixture)
)


def drives_at(x, y):
    """Return a vehicle class that drives straight on for 150 m, and then at a point of the road [m]."""

    class DrivesAt(Vehicle):
        def act(self, action=None):
            to_x, to_y = x - self.position[0], y - self.position[1]
            wanted = np.arctan2(to_y, to_x) if self.position[0] > 150 and to_x > 1 else 0.0
            steering = float(np.clip(wanted - self.heading, -0.3, 0.3))
            super().act({"acceleration": 0.0, "steering": steering})

    return DrivesAt


@pytest.mark.parametrize(
    ("entry_point", "wrappers"), [(Repeating, [partial(MaxAndSkipObservation, skip=2)]), (Hurried, None), (Drawn, None)]
)
def test_decisions_at_rates_of_an_environments_own_are_accepted(entry_point, wrappers, register):
    register("mine-v0", entry_point=entry_point)
    check_world(World("mine-v0", duration=8.0, wrappers=wrappers), ads=IDLE, npcs=1, runs=2)


@pytest.mark.parametrize("told", [(0, 15, 45), (0, 0, 45, 90), (15, 45, 90), (0, 90, 45)])
def test_wrong_times_of_decisions_are_refused(told):
    class Lying(World):
        def rollout(self, scenario, ads_factory):
            return replace(super().rollout(scenario, ads_factory), decided=told)

    with pytest.raises(AssertionError, match="decided has the ticks of all decisions"):
        check_world(Lying("highway-v0", duration=6.0), ads=lambda: lambda seen: 1, npcs=1, runs=2)


@pytest.mark.parametrize("options", [{}, {"wrappers": [FlattenObservation]}, {"planner_hz": 5}])
def test_contact_with_an_obstacle_is_accepted(options, register):
    register("mine-v0", entry_point=Roadworks)
    world = World("mine-v0", duration=12.0, **options)
    factory = (lambda: lambda seen: (0.0, 0.0)) if "planner_hz" in options else IDLE
    trace = world.rollout(Scenario(npcs=AT_ONCE, ego_lane=1), factory)
    assert trace.outcome is Outcome.COLLISION
    assert all(is_kept for is_kept, *_ in contacts(trace))
    check_world(world, ads=factory, npcs=1, runs=4, ego_lane=2)


def test_contact_with_an_obstacle_of_a_lane_that_merges_is_accepted():
    world = World("merge-v0", duration=14.0)
    (obstacle,) = world.environment.unwrapped.road.objects
    lane, speed = world.start
    behind = Scenario(npcs=[[PositionInstruction(6, 5.0)]], ego_lane=lane, ego_speed=speed)
    trace = world.rollout(behind, drives_at(*obstacle.position))
    assert trace.outcome is Outcome.COLLISION
    assert all(is_kept for rule in (end(world, trace), contacts(trace)) for is_kept, *_ in rule)


def test_collision_with_an_obstacle_is_checked_in_own_worlds(register):
    register("mine-v0", entry_point=Roadworks)
    trace = World("mine-v0", duration=12.0).rollout(Scenario(npcs=AT_ONCE, ego_lane=1), IDLE)

    def is_kept(**fields):
        return all(each for each, *_ in contacts(replace(trace, **fields)))

    assert is_kept()
    assert not is_kept(obstacles=())
    assert not is_kept(obstacles=((200.0, 4.0, 0.0, 2.0, 2.0),))
    for lie in ({"npc": 0}, {"npc": 1}, {"closing_speed": 1.0}, {"ego_speed": 1.0}, {"npc_speed": 3.0}):
        assert not is_kept(collision=replace(trace.collision, **lie))
