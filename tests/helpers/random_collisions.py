"""Random collisions of many policies on many roads; a policy and a number reproduce each of them."""

from __future__ import annotations

import functools
import math
import random
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import ControlledVehicle

from example_ads import constant_speed, defects, idm_mobil
from pytest_pafot import Highway, Trace
from pytest_pafot.searching.space import SearchSpace, sample, space_on
from pytest_pafot.world.reference_drivers import CarefulHuman
from tests.helpers.junctions import random_meeting
from tests.helpers.road_cases import space_of, world_of

ATTEMPTS = 400
"""The number of scenarios to try for one collision."""
ROADS = ("merge-v0", "roundabout-v0", "racetrack-v0", "exit-v0", "two-way-v0", "u-turn-v0", "intersection-v0")
"""Roads that are not straight."""
JUNCTIONS = ("intersection-v0", "roundabout-v0")
"""Roads on which NPCs cross."""


class Erratic:
    """Brake, speed up and drift anywhere on the road, from random ticks on; its habits are sampled once."""

    def __init__(self, rng: random.Random) -> None:
        self.rng = rng
        self.hold, self.braking = rng.uniform(0.2, 3.0), rng.uniform(2.0, 9.0)
        self.sideways, self.patience = rng.uniform(0.1, 2.5), rng.uniform(1.0, 8.0)
        self.calm = rng.uniform(0.0, 0.9)
        self.acceleration, self.target, self.path = 0.0, math.nan, math.nan
        self.until = self.turns = self.now = 0.0

    def __call__(self, seen):
        if math.isnan(self.path):
            self.path = self.target = seen.ego.y
        step, self.now = seen.time - self.now, seen.time
        if seen.time >= self.until:
            self.until = seen.time + self.rng.expovariate(1 / self.hold)
            self.acceleration = 0.0 if self.rng.random() < self.calm else self.rng.uniform(-self.braking, 3.0)
        if seen.time >= self.turns:
            self.turns = seen.time + self.rng.expovariate(1 / self.patience)
            place = self.rng.randrange(seen.lanes) + self.rng.choice([0.0, 0.0, self.rng.uniform(-0.5, 0.5)])
            self.target = place * seen.lane_width
        reach = self.sideways * step
        self.path += max(min(self.target - self.path, reach), -reach)
        heading = math.asin(max(min(0.8 * (self.path - seen.ego.y) / max(seen.ego.speed, 3.0), 0.3), -0.3))
        acceleration = max(self.acceleration, -3.0 * seen.ego.speed)
        return acceleration, 6.0 / max(seen.ego.speed, 6.0) * (heading - seen.ego.heading)


class StopAndGo(Erratic):
    """Keep the lane, speed up, and stop for some seconds again and again."""

    def __init__(self, rng: random.Random) -> None:
        super().__init__(rng)
        self.patience, self.standing = 1e9, rng.uniform(1.0, 8.0)
        self.turns, self.stops = 1e9, rng.uniform(1.0, 10.0)

    def __call__(self, seen):
        _, steering = super().__call__(seen)
        if seen.time < self.stops:
            return (2.0 if seen.ego.speed < 0.9 * seen.speed_limit else 0.0), steering
        if seen.time > self.stops + self.standing + 25.0 / self.braking:
            self.stops = seen.time + self.rng.uniform(2.0, 10.0)
        return max(-self.braking, -3.0 * seen.ego.speed), steering


def erratic_vehicle(rng):
    """Return a vehicle class that stays on its way, and brakes, speeds up and changes lanes at random."""
    hold, braking, patience = rng.uniform(0.2, 3.0), rng.uniform(2.0, 9.0), rng.uniform(1.0, 8.0)

    class ErraticVehicle(ControlledVehicle):
        ticks = 0
        wanted = 0.0

        def act(self, action=None):
            self.ticks += 1
            turns = rng.random() < 1 / 15 / patience
            super().act(rng.choice(["LANE_LEFT", "LANE_RIGHT"]) if turns else None)
            if rng.random() < 1 / 15 / hold:
                self.wanted = rng.uniform(-braking, 3.0)
            self.action["acceleration"] = max(self.wanted, -3.0 * self.speed)

    return ErraticVehicle


Policy = Callable[[random.Random], Any]


ON_A_MOTORWAY: dict[str, Policy] = {
    "constant-speed": lambda rng: constant_speed.make,
    "idm-mobil": lambda rng: idm_mobil.make(),
    "erratic": lambda rng: functools.partial(Erratic, random.Random(rng.random())),
    "stop-and-go": lambda rng: functools.partial(StopAndGo, random.Random(rng.random())),
    "careful-human": lambda rng: CarefulHuman,
    "looks-only-ahead": lambda rng: defects.make("looks-only-ahead"),
    "sees-cut-ins-late": lambda rng: defects.make("sees-cut-ins-late"),
}
ON_OTHER_ROADS: dict[str, Policy] = {"erratic, other roads": erratic_vehicle}
AT_JUNCTIONS: dict[str, Policy] = {
    "constant-speed, junctions": lambda rng: ControlledVehicle,
    "idm, junctions": lambda rng: IDMVehicle,
    "erratic, junctions": erratic_vehicle,
}
BY_HAND = "by hand, junctions"
"""Collisions at junctions that are made without a policy and a world."""
POLICIES = {**ON_A_MOTORWAY, **ON_OTHER_ROADS, **AT_JUNCTIONS, BY_HAND: lambda rng: ControlledVehicle}


def collision(policy: str, number: int, seed: int = 0) -> Trace:
    """Return the collision with a number; it is the same at every call.

    Raises:
        LookupError: None is found.
    """
    rng, roads = random.Random(f"{policy} {number} {seed}"), JUNCTIONS if policy in AT_JUNCTIONS else ROADS
    for _ in range(ATTEMPTS):
        if policy == BY_HAND:
            met = random_meeting(np.random.default_rng(rng.getrandbits(60)))
            if met is None or met.ticks < 2:
                continue
            return met
        world = motorway(rng) if policy in ON_A_MOTORWAY else world_of(rng.choice(roads))
        drawn = np.random.default_rng(rng.getrandbits(60))
        if policy in AT_JUNCTIONS:
            space = crossing_space(world, rng)
        else:
            space = motorway_space(world, rng) if policy in ON_A_MOTORWAY else space_of(world, rng.randint(1, 2))
        trace = world.rollout(sample(replace(space, instructions="cells"), drawn), POLICIES[policy](rng))
        if trace.collision is not None:
            return trace
    raise LookupError(f"{policy}: no collision in {ATTEMPTS} runs")


def motorway(rng: random.Random) -> Highway:
    """Return a motorway of random size and frequency."""
    physics_hz = rng.choice([15, 15, 15, 10, 20])
    return Highway(
        lanes=rng.randint(3, 6),
        speed_limit=round(rng.uniform(12.0, 36.0), 1),
        physics_hz=physics_hz,
        ads_hz=rng.choice([5, physics_hz]),
        duration=30.0,
        clearance=rng.choice([0.0, 1.0, 2.0, 5.0, 10.0, 20.0]),
    )


def crossing_space(world: Any, rng: random.Random) -> SearchSpace:
    """Return a search space with NPCs that cross."""
    given = {"npcs": rng.randint(1, 3), "crossings": world.crossings, "most_on_grid": 1}
    return space_on(world.speed_limit, world.longest_run, given, world.road_start)


def motorway_space(world: Highway, rng: random.Random) -> SearchSpace:
    """Return a search space with long or short instructions."""
    genes = rng.choice([3, 6, 10, 15])
    return SearchSpace(
        npcs=rng.randint(1, 5),
        genes=genes,
        gene_seconds=world.duration / genes,
        speed_limit=world.speed_limit,
        ego_lane=rng.randrange(1, world.lanes - 1),
        ego_speed=round(rng.uniform(0.4, 1.0) * world.speed_limit, 1),
    )
