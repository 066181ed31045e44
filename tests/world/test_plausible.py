"""Runs in which a user's simulator or environment moves vehicles as no vehicle moves are invalid, and no others."""

import math
from functools import cache, partial
from itertools import pairwise

import numpy as np
from gymnasium import register
from highway_env.envs.highway_env import HighwayEnvFast
from highway_env.road.road import Road
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import MDPVehicle

import pytest_pafot as pafot
from pytest_pafot import PositionInstruction, Scenario, SimulatorWorld
from pytest_pafot.algorithms.space import SearchSpace, sample
from pytest_pafot.model.scenario import rng_of
from pytest_pafot.model.trace import SPEED, SURVIVES, Outcome, first_difference
from pytest_pafot.world.engines.episode import drive_episode
from pytest_pafot.world.engines.run import Implausible, Plausibility
from tests.helpers.refusals import refused
from tests.helpers.tables import table
from tests.world.test_simulator import Bicycle, Late

GONE = -1073741824.0
RUNS, PLANTED = 200, 20
SPACE = SearchSpace(npcs=3)
STRAIGHT = lambda: lambda _: (0.0, 0.0)  # noqa: E731


MOVED = {
    "jump": (49.0, 0.0, 0.0),
    "jump back": (-49.0, 0.0, 0.0),
    "aside": (0.0, 3.0, 0.0),
    "faster": (0, 0, 15.0),
}


def spoil(now, before, fault, *, is_first):
    """Return x, y, heading and speed of a vehicle after a tick in which it has a fault."""
    x, y, heading, speed = now
    if fault in ("freeze", "all freeze"):
        return [*before[:3], speed]
    if fault == "gone":
        return [GONE] * 4
    if not is_first:
        return [x, y, heading, speed]
    dx, dy, faster = MOVED[fault]
    return [x + dx, y + dy, heading, speed + faster]


class Faults:
    """A simulator in which a vehicle has a fault in a tick, or from then on."""

    def __init__(self, hz=15, fault="", number=0, tick=0):
        self.hz, self.fault, self.number, self.tick = hz, fault, number, tick

    def start(self, vehicles, seed):
        super().start(vehicles, seed)
        self.ticks = 0

    def step(self, controls):
        before = [list(car) for car in self.cars]
        super().step(controls)
        self.ticks += 1
        is_first = self.ticks == self.tick
        for number in range(len(self.cars)) if self.fault == "all freeze" else [self.number]:
            if self.fault and self.ticks >= self.tick:
                spoilt = spoil(self.cars[number], before[number], self.fault, is_first=is_first)
                self.cars[number] = spoilt


class FaultyBicycle(Faults, Bicycle):
    """All vehicles by the simulator's own physics."""


class FaultyLate(Faults, Late):
    """The ego by the simulator's own physics, and late; NPCs where their controls say, unless they have the fault."""


class FaultyRoad(Road):
    """A road of an environment in which a vehicle has a fault."""

    def step(self, dt):
        vehicles, (fault, number, tick) = self.vehicles, self.plant
        before = [(*each.position, each.heading, each.speed) for each in vehicles]
        super().step(dt)
        self.ticks += 1
        is_first = self.ticks == tick
        for each in range(len(vehicles)) if fault == "all freeze" else [number]:
            if fault and self.ticks >= tick:
                vehicle = vehicles[each]
                now = (*vehicle.position, vehicle.heading, vehicle.speed)
                spoilt = spoil(now, before[each], fault, is_first=is_first)
                *place, vehicle.heading, vehicle.speed = spoilt
                vehicle.position = np.array(place)


class FaultyEnv(HighwayEnvFast):
    """An environment with such a road."""

    @classmethod
    def default_config(cls):
        return super().default_config() | {"plant": ["", 0, 0]}

    def _create_road(self):
        super()._create_road()
        self.road.__class__ = FaultyRoad
        self.road.plant, self.road.ticks = self.config["plant"], 0


class Teleporting(HighwayEnvFast):
    """An environment whose step moves the ego back in the sixth step."""

    def step(self, action):
        result = super().step(action)
        if round(self.time) == 6:
            self.vehicle.position = self.vehicle.position - np.array([100.0, 0.0])
        return result


register("faulty-v0", entry_point=FaultyEnv)
register("teleporting-v0", entry_point=Teleporting)


MAKERS = {
    "bicycle": FaultyBicycle,
    "late": FaultyLate,
    "coarse": FaultyBicycle,
    "fine": FaultyBicycle,
}
HZ = {"bicycle": 15, "late": 15, "coarse": 5, "fine": 50}
KINDS = ("bicycle", "late", "env", "coarse", "fine")
FAULTS = (*MOVED, "freeze", "all freeze", "gone")


@cache
def world_of(kind, *plant):
    if kind == "env":
        config = {"plant": list(plant) or ["", 0, 0], "simulation_frequency": 15}
        return pafot.World("faulty-v0", config=config, duration=8.0, planner_hz=5)
    return SimulatorWorld(partial(MAKERS[kind], HZ[kind], *plant), ads_hz=5, duration=8.0)


def planted(kind, scenario, fault, trace, rng):
    """Return a run with a fault at a random tick, and what must be said of it: the tick, the method and the vehicle."""
    half = math.ceil(trace.physics_hz / 2)
    able = np.argwhere(trace.states[2 : -half - 2, :, SPEED] > 3.0)  # fast enough to freeze
    tick, vehicle = (able[rng.integers(len(able))] + [2, 0]).tolist()
    world = world_of(kind, fault, vehicle, tick)
    # An NPC that is told where to be is known at once to be elsewhere.
    first = vehicle
    if fault == "all freeze":
        first = int(kind == "late" and len(trace.sizes) > 1)
    is_late = "freeze" in fault and not (kind == "late" and first)
    method = "FaultyEnv.step" if kind == "env" else f"{world.maker.__name__}.states"
    who = f"NPC {first - 1}" if first else "the ego"
    return world.rollout(scenario, STRAIGHT), (tick + (half - 1) * is_late, method, who)


def test_of_200_runs_those_20_with_a_planted_jump_or_freeze_are_invalid_and_no_other():
    every, found, wrong = RUNS // PLANTED, 0, []
    for number in range(RUNS):
        kind, scenario = KINDS[(number + number // 10) % 5], sample(SPACE, rng_of(number))
        trace, expected = world_of(kind).rollout(scenario, STRAIGHT), None
        if number % every == 0:
            fault = FAULTS[number // every % len(FAULTS)]
            trace, expected = planted(kind, scenario, fault, trace, rng_of(number))
        text, is_as_expected = trace.users_error_text, not expected
        found += bool(text)
        if text and expected:
            tick, method, who = expected
            place = text.partition(":")[0].removesuffix(" after step")
            is_as_expected = place == f"{method}, tick {tick}" and who in text
            is_as_expected &= trace.outcome is Outcome.INVALID and trace.ticks in (tick, tick - 1)
        wrong += [] if is_as_expected else [(number, kind, expected, text, repr(trace))]
    assert (found, wrong) == (PLANTED, [])


AHEAD = Scenario(npcs=((PositionInstruction(2, 0.0),),), ego_speed=22.0)
"""An NPC in front of the ego stops."""


class Crashes(Bicycle):
    """A simulator in which vehicles that touch, or are about to, stand at once."""

    room = 0.0

    def step(self, controls):
        super().step(controls)
        (x, *_), (other, *_) = self.cars
        if 0 < other - x < 5.0 + self.room:
            self.cars[0][3] = self.cars[1][3] = 0.0


def test_a_speed_that_ends_at_once_in_a_collision_is_a_collision():
    trace = SimulatorWorld(Crashes).rollout(AHEAD, STRAIGHT)
    assert (trace.outcome, trace.users_error_text) == (Outcome.COLLISION, "")
    assert trace.collision.ego_speed == 0.0


CUSHION = SimulatorWorld(type("Cushion", (Crashes,), {"room": 1.5}))


def test_a_simulator_that_stops_vehicles_before_they_touch_hides_no_collision():
    trace = CUSHION.rollout(AHEAD, STRAIGHT)
    assert trace.outcome is Outcome.INVALID
    assert trace.users_error_text.startswith("Cushion.states, tick ")


def test_a_policy_that_a_jump_of_a_speed_confuses_has_not_failed():
    def asserting():
        def decide(seen):
            assert seen.ego.speed < 30.0

        return lambda seen: decide(seen) or (0.0, 0.0)

    trace = world_of("coarse", "faster", 0, 12).rollout(AHEAD, asserting)
    assert (trace.outcome, trace.error) == (Outcome.INVALID, None)
    assert trace.users_error_text.startswith("FaultyBicycle.states, tick 12:")


def moved(*states, dt=1 / 15):
    """Check the states of one vehicle, tick by tick, and return what is said of them."""
    plausibility = Plausibility([states[0]], dt)
    try:
        for each in states[1:]:
            plausibility.check([each], "Sim.states")
    except Implausible as fault:
        return str(fault)
    return ""


def going(speeds, dt, *, late=0.0, slip=0.0, old=False):
    """Return the states of a vehicle with these speeds; it moves by the old speeds, or by the new ones."""
    x, found = 0.0, [(0.0, 0.0, 0.0, speeds[0])]
    for before, speed in pairwise(speeds):
        x += (before if old else speed) * dt * (1.0 - late)
        found.append((x * math.cos(slip), x * math.sin(slip), 0.0, speed))
    return found


@table("dt", [0.2, 1 / 15, 0.03, 0.001])
def test_what_a_vehicle_can_do_is_plausible(dt):
    ticks = round(4 / dt)
    seconds = [tick * dt for tick in range(ticks)]
    sound = {
        "emergency braking": [max(40.0 - 12.0 * each, 0.0) for each in seconds],
        "a racing start": [20.0 * each for each in seconds],
        "reverse": [5.0 - 6.0 * each for each in seconds],
        "standing": [0.0] * ticks,
        "creeping": [1.9] * ticks,
        "jitter": [20.0 + (-1) ** tick for tick in range(ticks)],
        "a hit by another": [0.0] * (ticks // 2) + [SPEED_OF_A_HIT] * (ticks - ticks // 2),
    }
    for what, speeds in sound.items():
        for old in (True, False):
            assert moved(*going(speeds, dt, old=old), dt=dt) == "", what
            assert moved(*going(speeds, dt, old=old, slip=0.4, late=0.2), dt=dt) == "", what


SPEED_OF_A_HIT = 2.4
"""A change that is still allowed in a tick of any length [m/s]."""


def test_a_vehicle_may_slide_on_sideways_with_its_speed_along_its_heading():
    sideways = [(0.1 * tick * tick, 1.0 * tick, 0.0, 15.5 - tick / 2) for tick in range(1, 30)]
    assert moved((0, 0, 0, 15.0), *sideways) == ""


@table(("acceleration", "is_plausible"), [(-90.0, True), (0.0, False)])
def test_a_controller_that_brakes_harder_than_any_vehicle_is_no_jump(acceleration, is_plausible):
    plausibility = Plausibility([(0, 0, 0, 20.0)], 0.1)
    plausibility.check([(2.0, 0, 0, 11.0)], "Env.step", [acceleration])
    assert (plausibility.doubt == "") is is_plausible


MOTIONS = {
    "to the slack": ([(0, 0, 0, 20), (1.9, 0, 0, 20)], 0),
    "beyond the slack": ([(0, 0, 0, 20), (2.0, 0, 0, 20)], 1),
    "without speed": ([(0, 0, 0, 0), (0, 0.7, 0, 0)], 1),
    "with a jump of the speed": ([(0, 0, 0, 20), (50, 0, 0, 740)], 1),
    "nowhere": ([(0, 0, 0, 20), (math.nan, 0, 0, 20)], 1),
    "a speed that jumps": ([(0, 0, 0, 0), (0, 0, 0, -5), (0, 0, 0, -5)], 1),
    "a jump that may be a collision": ([(0, 0, 0, 0), (0, 0, 0, 5)], 0),
    "still for half a second": ([(0, 0, 0, 2.1)] * 9, 8),
    "still for less": ([(0, 0, 0, 2.1)] * 8, 0),
    "still and slow between": ([(0, 0, 0, 2.1)] * 7 + [(0, 0, 0, 2.0)] + [(0, 0, 0, 2.1)] * 7, 0),
    "nearly still": ([(0.001 * tick, 0, 0, 20) for tick in range(9)], 8),
}


@table(("states", "tick"), MOTIONS.values())
def test_what_no_vehicle_does_is_told_with_its_tick(states, tick):
    place, _, _ = moved(*states).partition(":")
    assert place == (f"Sim.states, tick {tick}" if tick else "")


class Leap:
    """A vehicle that leaps over what is ahead of it."""

    def step(self, dt):
        super().step(dt)
        if any(0.0 < each.position[0] - self.position[0] < 12.0 for each in self.road.vehicles):
            self.position = self.position + np.array([20.0, 0.0])


class Leaping(Leap, IDMVehicle):
    """One that drives itself."""


class Leaper(Leap, MDPVehicle):
    """One for the actions of an environment."""


class Leaps(HighwayEnvFast):
    """An environment with such an ego."""

    def _create_vehicles(self):
        super()._create_vehicles()
        old = self.vehicle
        self.road.vehicles.remove(old)
        self.vehicle = Leaper(self.road, old.position, speed=old.speed)
        self.road.vehicles.append(self.vehicle)


register("leaps-v0", entry_point=Leaps)


SLOW = Scenario(npcs=((PositionInstruction(2, 8.0),),), ego_speed=22.0)
LEAPS = [
    (pafot.World("teleporting-v0", duration=10.0), AHEAD, lambda: lambda _: 4, "Teleporting"),
    (pafot.Highway(duration=10.0), SLOW, Leaping, "Leaping"),
    (pafot.World("leaps-v0", duration=10.0), SLOW, lambda: lambda _: 1, "Leaper"),
]


@table(("world", "scenario", "ads", "name"), LEAPS)
def test_an_environment_or_class_that_moves_the_ego_is_named(world, scenario, ads, name):
    trace = world.rollout(scenario, ads)
    assert trace.outcome is Outcome.INVALID
    assert trace.users_error_text.startswith(f"{name}.step, tick ")


def test_rate_counts_no_episode_in_which_the_ego_jumps():
    config = {"vehicles_count": 1, "duration": 12}
    jumps, sound = (pafot.World(f"{name}-v0", config) for name in ("teleporting", "highway-fast"))
    policy = lambda: lambda _: 1  # noqa: E731
    episode = drive_episode(jumps, policy, 3)
    assert not episode.crashed
    assert episode.error.text.startswith("Implausible: Teleporting.step, tick ")
    assert drive_episode(sound, policy, 3).error is None


def test_a_fault_in_the_first_tick_is_an_error_at_once():
    with refused("FaultyBicycle.states, tick 1"):
        world_of("bicycle", "jump", 0, 1).rollout(AHEAD, STRAIGHT)


def test_the_simulator_of_an_invalid_run_is_not_used_again():
    world = world_of("bicycle", "jump", 0, 20)
    world.rollout(AHEAD, STRAIGHT)
    assert world.simulators._free == []


# Runs that do not repeat.


def never_collides(run):
    assert not run.collision


class Worn(Bicycle):
    """A simulator whose vehicles drive a little slower in each run, because start leaves something as it is."""

    runs = 0

    def start(self, vehicles, seed):
        super().start(vehicles, seed)
        self.runs += 1

    def gas(self, control):
        return control.acceleration - 0.003 * self.runs


def differing():
    """Return pairs of runs that differ, by the cause."""
    worn, sound = SimulatorWorld(Worn, duration=4.0), SimulatorWorld(Bicycle, duration=4.0)
    brakes = sound.rollout(AHEAD, lambda: lambda seen: (-1.0 if seen.time > 0.9 else 0.0, 0.0))
    driven = sound.rollout(AHEAD, STRAIGHT)
    return {
        "a simulator that remembers": [worn.rollout(AHEAD, STRAIGHT) for _ in range(2)],
        "another decision": (driven, brakes),
        "another duration": (
            driven,
            SimulatorWorld(Bicycle, duration=3.0).rollout(AHEAD, STRAIGHT),
        ),
    }


def test_runs_that_differ_are_told_apart():
    for one, other in differing().values():
        assert first_difference(one, other)
        assert first_difference(one, one) == ""


def test_a_finding_of_a_simulator_that_does_not_repeat_is_flaky():
    world = SimulatorWorld(Worn, duration=10.0)
    found = pafot.explore(STRAIGHT, holds=never_collides, world=world, runs=8, seed=1)
    assert found.findings
    assert all(each.flaky.endswith(SURVIVES) for each in found.findings)
