"""A reference driver takes over in the middle of a recorded run: before that, everything is as recorded."""

from dataclasses import replace

import numpy as np
import pytest
from gymnasium.wrappers import FlattenObservation
from highway_env.vehicle.behavior import IDMVehicle, LinearVehicle
from highway_env.vehicle.controller import ControlledVehicle

from pytest_pafot.attribution.responsibility import Passing
from pytest_pafot.attribution.takeovers import latest
from pytest_pafot.model.instructions import CrossingInstruction, PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import ACCELERATION, SPEED
from pytest_pafot.support.errors import DriverError
from pytest_pafot.world import Highway, SimulatorWorld, World
from pytest_pafot.world.reference_drivers import REFERENCES
from tests.helpers.puppets import Puppets
from tests.helpers.refusals import refused
from tests.helpers.stages import mostly_oracle
from tests.helpers.tables import table
from tests.helpers.world_cases import changing_lanes, weaving

CHAINS = [[PositionInstruction(2, 22.0), PositionInstruction(2, 4.0)], [PositionInstruction(8, 25.0)] * 2]  # fmt: skip
BRAKES = Scenario(npcs=CHAINS, ego_lane=1, ego_speed=22.0)
SHORT = Scenario(npcs=[[PositionInstruction(2, 10.0)]], ego_lane=1, ego_speed=22.0, gene_seconds=5.0)  # fmt: skip


def steady():
    return lambda seen: (0.0, 0.0)


def faster():
    return lambda seen: 3


HIGHWAY = Highway(duration=14.0)


class Lorry(IDMVehicle):
    """A vehicle longer and wider than those that a planner sees."""

    LENGTH, WIDTH = 8.0, 2.5


def on(env_id, drive, **config):
    """Run in an environment; return its world and its trace."""
    world = World(env_id, duration=6.0, **config)
    lane, speed = world.start or (1, 22.0)
    chain = [PositionInstruction(2, 8.0)]
    return world, world.rollout(Scenario(npcs=[chain], ego_lane=lane, ego_speed=speed), drive)


CASES = {
    "planner": lambda: (HIGHWAY, HIGHWAY.rollout(BRAKES, changing_lanes)),
    "planner off the road": lambda: (HIGHWAY, HIGHWAY.rollout(BRAKES, weaving)),
    "vehicle class": lambda: (HIGHWAY, HIGHWAY.rollout(BRAKES, IDMVehicle)),
    "vehicle class with own code": lambda: (HIGHWAY, HIGHWAY.rollout(BRAKES, LinearVehicle)),
    "larger vehicle": lambda: (HIGHWAY, HIGHWAY.rollout(BRAKES, Lorry)),
    "policy": lambda: on("highway-v0", faster),
    "policy in wrappers": lambda: on("highway-v0", faster, wrappers=[FlattenObservation]),
    "merge": lambda: on("merge-v0", faster),
    "bend": lambda: on("roundabout-v0", IDMVehicle),
}


@pytest.mark.parametrize(
    "name", mostly_oracle(CASES, "planner", "larger vehicle", "policy", "bend")
)
def test_run_before_taking_over_equals_the_recording(name):
    world, trace = CASES[name]()
    for tick in (0, trace.ticks // 2, trace.ticks - 1):
        taken = world.take_over(trace, tick, "careful-human")
        assert taken.states[: tick + 1].tobytes() == trace.states[: tick + 1].tobytes()
        assert taken.ticks > tick
        assert (taken.sizes == trace.sizes).all()


@pytest.mark.parametrize("name", REFERENCES)
def test_driver_that_replaces_same_driver_continues_identically(name):
    trace = HIGHWAY.rollout_reference(BRAKES, name)
    for tick in (0, 1, 40, 90):
        assert HIGHWAY.take_over(trace, tick, name).states.tobytes() == trace.states.tobytes()


def test_new_driver_brakes_at_once_for_watched_leader():
    leader = Scenario(npcs=[[PositionInstruction(2, 16.0)]], ego_lane=1, ego_speed=22.0)
    trace = HIGHWAY.rollout(leader, steady)
    taken = HIGHWAY.take_over(trace, trace.ticks - 9, "careful-human")
    assert taken.ego[trace.ticks - 8, ACCELERATION] < -4.0
    left = HIGHWAY.rollout(BRAKES, changing_lanes)
    tick = 15 + next(tick for tick in range(left.ticks) if left.ego[tick, 6] != 1)
    kept = HIGHWAY.take_over(left, tick, "careful-human")
    assert (kept.ego[tick:, 6] == left.ego[tick, 6]).all()


def test_new_driver_wants_ego_speed_from_before_braking():
    far = Scenario(npcs=[[PositionInstruction(8, 22.0)]], ego_lane=1, ego_speed=22.0)
    trace = HIGHWAY.rollout(far, lambda: lambda seen: (-5.0 if seen.time > 2 else 0.0, 0.0))
    taken = HIGHWAY.take_over(trace, 60, "careful-human")
    assert trace.ego[60, SPEED] < 14.0
    assert np.diff(taken.ego[60:, SPEED]).min() > 0 or taken.ego[-1, SPEED] > 21.0


REFUSED = {
    "another driver": (10, "me", HIGHWAY, ""),
    "a negative tick": (-1, "careful-human", HIGHWAY, "tick"),
    "a tick after the end": (10**6, "careful-human", HIGHWAY, "tick"),
    "other ticks": (10, "careful-human", Highway(physics_hz=30), "trace"),
}


@table(("tick", "name", "world", "field"), REFUSED.values())
def test_what_cannot_be_taken_over_is_refused(tick, name, world, field):
    trace = HIGHWAY.rollout(BRAKES, weaving)
    with refused(field):
        world.take_over(trace, tick, name)


def test_careful_driver_avoids_a_collision_in_a_zone_until_shortly_before_the_ego_enters_it():
    world, npc = World("roundabout-v0"), CrossingInstruction("wer>wxr", 0.0, 5.0)
    scenario = Scenario(npcs=[[npc]], ego_lane=1, ego_speed=8.0)
    run = world.run_of(world.rollout(scenario, ControlledVehicle))
    assert run.attribution.fault == "did-not-give-way"
    entered = Passing(run.trace, 0, run.trace.zones[0]).entry / run.trace.physics_hz
    assert 0 < run.collision.time - latest(run.trace, run.take_over) < entered


class Jams(Puppets):
    """A simulator that raises at a tick that only a longer run has."""

    def start(self, vehicles, seed):
        super().start(vehicles, seed)
        self.ticks = 0

    def step(self, controls):
        super().step(controls)
        self.ticks += 1
        if self.ticks > 75:
            raise KeyError("jammed")


def take_over_in_jam():
    """Let a driver take over in a simulator that raises afterwards."""
    world = SimulatorWorld(Jams)
    run = world.run_of(world.rollout(SHORT, steady))
    run.take_over.lasting(14.0)(run.trace, 3)


def test_error_of_a_simulator_while_a_driver_takes_over_is_one_of_the_driver():
    with pytest.raises(DriverError):
        take_over_in_jam()


def test_driver_that_takes_over_is_driven_on_in_the_longer_world():
    run = HIGHWAY.run_of(HIGHWAY.rollout(replace(SHORT, gene_seconds=2.0), steady))
    usual, longer = (each(run.trace, 15) for each in (run.take_over, run.take_over.lasting(14.0)))
    assert (usual.duration, longer.duration) == (2.0, 14.0)
    assert longer.states[: len(usual.states)].tobytes() == usual.states.tobytes()
