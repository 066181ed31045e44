"""Random runs on a highway, and the differences between two traces."""

from __future__ import annotations

import hashlib
import random
from dataclasses import dataclass, replace

import numpy as np
from highway_env.vehicle.behavior import IDMVehicle

from pytest_pafot.model.instructions import SHIFTS, LaneInstruction, PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.world import Highway
from tests.helpers.world_cases import EGOS, random_scenario

FREQUENCIES = ((15, 5), (15, 15), (20, 10), (30, 5), (12, 4), (5, 1))
SAME = "executed", "outcome", "collision", "error", "actions", "arrivals", "off_road_tick", "lanes"


class Hurried(IDMVehicle):
    """IDM with different constants."""

    COMFORT_ACC_MAX = 4.5
    TIME_WANTED = 0.6
    DISTANCE_WANTED = 6.0
    POLITENESS = 0.3
    LANE_CHANGE_DELAY = 0.4
    KP_LATERAL = 1.2


def steps_and_swerves():
    """Return an ADS that cycles through kinds of action: beyond a car's limits, lists, arrays, whole numbers, zeros."""
    wild, plain = [(9.0, 0.0), (-20.0, 0.01), [1, 0]], [(0.0, 2.0), (0, 0), (-3.0, -0.02)]
    actions = (*wild, np.array([0.5, -0.01]), *plain)
    return lambda observation: actions[int(observation.time * 2) % len(actions)]


def follows():
    """Return an ADS that reads every part of an observation and brakes behind a vehicle ahead in its lane."""

    def drive(observation):
        ego = observation.ego
        in_lane = [each for each in observation.others if each.lane == ego.lane]
        gaps = [
            each.x - ego.x - (each.length + ego.length) / 2 for each in in_lane if each.x > ego.x
        ]
        wish = 0.3 * (min(observation.speed_limit, min(gaps, default=100.0) / 1.2) - ego.speed)
        return wish, -0.01 * (ego.y - ego.lane * observation.lane_width) - 0.3 * ego.heading

    return drive


def fails_in_the_end():
    """Return an ADS that returns None after four seconds."""
    return lambda observation: (0.2, 0.0) if observation.time < 4 else None


ALL_EGOS = (*EGOS, IDMVehicle, Hurried, steps_and_swerves, follows, fails_in_the_end)


@dataclass(frozen=True)
class Case:
    """A run's world, scenario and ego."""

    world: Highway
    scenario: object
    ego: object

    @classmethod
    def random(cls, seed: int) -> Case:
        """Return a case with one to eight NPCs on three to six lanes.

        In every fourth case all NPCs have Lane-Instructions, and in every other fourth case about half of them have.
        """
        rng = random.Random(seed)
        lanes, (physics_hz, ads_hz) = rng.randint(3, 6), rng.choice(FREQUENCIES)
        world = Highway(
            lanes=lanes, physics_hz=physics_hz, ads_hz=ads_hz, speed_limit=rng.choice([26.8, 20.0, 35.0]),
            clearance=rng.choice([0.0, 3.0, 10.0]), headway=rng.choice([1.0, 2.0]),
        )  # fmt: skip
        scenario = random_scenario(rng, lanes=lanes, speed_limit=world.speed_limit)
        if rng.random() < 0.3:
            scenario = replace(scenario, gene_seconds=10.0)
        if seed % 2:
            scenario = in_lanes(scenario, rng, share=0.5 if seed % 4 == 1 else 1.0)
        return cls(world, scenario, rng.choice(ALL_EGOS))

    def run(self):
        return self.world.rollout(self.scenario, self.ego)

    def run_in_gym(self):
        """Return the run by ``env.step`` of highway-env's own environment."""
        return self.world.rollout_in_gym(self.scenario, self.ego)


def in_lanes(scenario: Scenario, rng: random.Random, share: float = 1.0) -> Scenario:
    """Return the scenario with Lane-Instructions instead of cells for a share of the NPCs on the grid."""
    chains = [
        tuple(LaneInstruction(rng.choice(SHIFTS), gene.speed) for gene in chain)
        if isinstance(chain[0], PositionInstruction) and rng.random() < share
        else chain
        for chain in scenario.npcs
    ]
    return replace(scenario, npcs=tuple(chains))


def differences(first, second) -> list[str]:
    """Return what differs between two traces, to the last bit."""
    found = [name for name in SAME if getattr(first, name) != getattr(second, name)]
    for name in ("states", "sizes"):
        a, b = getattr(first, name), getattr(second, name)
        if not np.array_equal(a, b):
            found.append(f"{name} of {a.shape} and {b.shape}")
    return found


def digest(trace) -> str:
    """Return a text that is equal for equal runs."""
    told = repr([getattr(trace, name) for name in SAME])
    return hashlib.sha256((trace.states + 0.0).tobytes() + told.encode()).hexdigest()
