"""Runs in which a user's simulator or environment moves vehicles as no vehicle moves are invalid, and no others."""

import math
from functools import cache, partial
from itertools import pairwise

import numpy as np
import pytest
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
from pytest_pafot.world import WorldError
from pytest_pafot.world.engines.episode import drive_episode
from pytest_pafot.world.engines.run import Implausible, Plausibility
from tests.helpers.tables import table
from tests.world.test_simulator import Bicycle, Late

GONE = -1073741824.0
RUNS, PLANTED = 200, 20
SPACE = SearchSpace(npcs=3)
STRAIGHT = lambda: lambda _: (0.0, 0.0)  # noqa: E731


def spoil(now, before, fault, *, is_first):
    """Return x, y, heading and speed of a vehicle after a tick in which it has a fault."""
    x, y, heading, speed = now
    if fault in ("freeze", "all freeze"):
        return [*before[:3], speed]
    if fault == "gone":
        return [GONE] * 4
    if not is_first:
        return [x, y, heading, speed]
    moved = {
        "jump": (49.0, 0.0, 0.0),
        "jump back": (-49.0, 0.0, 0.0),
        "aside": (0.0, 3.0, 0.0),
        "faster": (0, 0, 15.0),
    }
    dx, dy, faster = moved[fault]
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
        for number in range(len(self.cars)) if self.fault == "all freeze" else [self.number]:
            if self.fault and self.ticks >= self.tick:
                is_first = self.ticks == self.tick
                self.cars[number] = spoil(
                    self.cars[number], before[number], self.fault, is_first=is_first
                )


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
        for each in range(len(vehicles)) if fault == "all freeze" else [number]:
            if fault and self.ticks >= tick:
                vehicle = vehicles[each]
                now = (*vehicle.position, vehicle.heading, vehicle.speed)
                *place, vehicle.heading, vehicle.speed = spoil(
                    now, before[each], fault, is_first=self.ticks == tick
                )
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


@cache
def world_of(kind, *plant):
    if kind == "env":
        config = {"plant": list(plant) or ["", 0, 0], "simulation_frequency": 15}
        return pafot.World("faulty-v0", config=config, duration=8.0, planner_hz=5)
    maker, hz = {"bicycle": (FaultyBicycle, 15), "late": (FaultyLate, 15), "coarse": (FaultyBicycle, 5),
                 "fine": (FaultyBicycle, 50)}[kind]  # fmt: skip
    return SimulatorWorld(partial(maker, hz, *plant), ads_hz=5, duration=8.0)


def test_of_200_runs_those_20_with_a_planted_jump_or_freeze_are_invalid_and_no_other():
    faults, kinds = (
        ("jump", "jump back", "aside", "faster", "freeze", "all freeze", "gone"),
        ("bicycle", "late", "env", "coarse", "fine"),
    )
    found, wrong = 0, []
    for number in range(RUNS):
        every, kind, scenario = (
            RUNS // PLANTED,
            kinds[(number + number // 10) % 5],
            sample(SPACE, rng_of(number)),
        )
        trace, expected = world_of(kind).rollout(scenario, STRAIGHT), ("", "", 0)
        if number % every == 0:
            fault, half = faults[number // every % len(faults)], math.ceil(trace.physics_hz / 2)
            able = np.argwhere(trace.states[2 : -half - 2, :, SPEED] > 3.0)  # fast enough to freeze
            tick, vehicle = (able[rng_of(number).integers(len(able))] + [2, 0]).tolist()
            trace = world_of(kind, fault, vehicle, tick).rollout(scenario, STRAIGHT)
            # An NPC that is told where to be is known at once to be elsewhere.
            first = (
                vehicle if fault != "all freeze" else int(kind == "late" and len(trace.sizes) > 1)
            )
            late = half - 1 if "freeze" in fault and not (kind == "late" and first) else 0
            method = (
                "FaultyEnv.step" if kind == "env" else f"{world_of(kind).maker.__name__}.states"
            )
            expected = (
                f"{method}, tick {tick + late}",
                f"NPC {first - 1}" if first else "the ego",
                tick + late,
            )
        text, seen = trace.users_error_text, ("", "", 0)
        if text:
            assert trace.outcome is Outcome.INVALID
            seen = (
                text.partition(":")[0].removesuffix(" after step"),
                expected[1] if expected[1] in text else text,
            )
            seen = (*seen, trace.ticks + 1 - ("changed its stated speed" in text))
        found += bool(text)
        wrong += [] if seen == expected else [(number, kind, expected, seen, repr(trace))]
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


def test_a_simulator_that_stops_vehicles_before_they_touch_hides_no_collision():
    trace = SimulatorWorld(type("Cushion", (Crashes,), {"room": 1.5})).rollout(AHEAD, STRAIGHT)
    assert trace.outcome is Outcome.INVALID
    assert trace.users_error_text.startswith("Cushion.states, tick ")
    assert trace.users_error_text.endswith(
        "the ego changed its stated speed from 22.0 to 0.0 m/s in a tick"
    )


def test_a_policy_that_a_jump_of_a_speed_confuses_has_not_failed():
    def asserting():
        def decide(seen):
            assert seen.ego.speed < 30.0

        return lambda seen: decide(seen) or (0.0, 0.0)

    trace = world_of("coarse", "faster", 0, 12).rollout(AHEAD, asserting)
    assert (trace.outcome, trace.error) == (Outcome.INVALID, None)
    told = "FaultyBicycle.states, tick 12: the ego changed its stated speed from 22.0 to"
    assert trace.users_error_text.startswith(told)


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
    sideways = [(0.2 * tick * tick / 2, 1.0 * tick, 0.0, 0.2 * tick) for tick in range(30)]
    assert (
        moved(
            (0, 0, 0, 15.0),
            *[(x, y, 0.0, 15.0 - tick / 2) for tick, (x, y, *_) in enumerate(sideways[1:])],
        )
        == ""
    )


@table(("acceleration", "is_plausible"), [(-90.0, True), (0.0, False)])
def test_a_controller_that_brakes_harder_than_any_vehicle_is_no_jump(acceleration, is_plausible):
    plausibility = Plausibility([(0, 0, 0, 20.0)], 0.1)
    plausibility.check([(2.0, 0, 0, 11.0)], "Env.step", [acceleration])
    assert (plausibility.doubt == "") is is_plausible


DRIVES = "in a tick, but its stated speed allows only {:.1f} m"


@table(("states", "text"), [
    ([(0, 0, 0, 20), (1.9, 0, 0, 20)], ""),
    ([(0, 0, 0, 20), (2.0, 0, 0, 20)], f"1: the ego moved 2.0 m {DRIVES.format(1.3)}"),
    ([(0, 0, 0, 0), (0, 0.7, 0, 0)], f"1: the ego moved 0.7 m {DRIVES.format(0.0)}"),
    ([(0, 0, 0, 20), (50, 0, 0, 740)], f"1: the ego moved 50.0 m {DRIVES.format(1.6)}"),
    ([(0, 0, 0, 20), (math.nan, 0, 0, 20)], f"1: the ego moved nan m {DRIVES.format(1.3)}"),
    ([(0, 0, 0, 0), (0, 0, 0, -5), (0, 0, 0, -5)],
     "1: the ego changed its stated speed from 0.0 to -5.0 m/s in a tick"),
    ([(0, 0, 0, 0), (0, 0, 0, 5)], ""),  # it may be a collision that ends the run
    ([(0, 0, 0, 2.1)] * 9, "8: the ego did not move for 0.5 s at a stated speed of 2.1 m/s"),
    ([(0, 0, 0, 2.1)] * 8, ""),
    ([(0, 0, 0, 2.1)] * 7 + [(0, 0, 0, 2.0)] + [(0, 0, 0, 2.1)] * 7, ""),
    ([(0.001 * tick, 0, 0, 20) for tick in range(9)],
     "8: the ego did not move for 0.5 s at a stated speed of 20.0 m/s"),
])  # fmt: skip
def test_what_no_vehicle_does_is_told_with_its_tick(states, text):
    assert moved(*states) == (text and f"Sim.states, tick {text}")


def test_a_policys_environment_whose_step_moves_the_ego_is_named():
    trace = pafot.World("teleporting-v0", duration=10.0).rollout(AHEAD, lambda: lambda _: 4)
    assert trace.outcome is Outcome.INVALID
    assert trace.users_error_text.startswith("Teleporting.step, tick ")
    assert "the ego moved 9" in trace.users_error_text


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


@table(("world", "ads", "name"), [
    (pafot.Highway(duration=10.0), Leaping, "Leaping"),
    (pafot.World("leaps-v0", duration=10.0), lambda: lambda _: 1, "Leaper"),
])  # fmt: skip
def test_an_ego_whose_class_lets_it_leap_is_named(world, ads, name):
    slow = Scenario(npcs=((PositionInstruction(2, 8.0),),), ego_speed=22.0)
    trace = world.rollout(slow, ads)
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
    with pytest.raises(WorldError, match=r"FaultyBicycle.states, tick 1: expected the ego to move"):
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


def test_what_differs_between_two_runs_is_told_with_its_cause():
    worn, sound = SimulatorWorld(Worn, duration=4.0), SimulatorWorld(Bicycle, duration=4.0)
    first, again = (worn.rollout(AHEAD, STRAIGHT) for _ in range(2))
    assert first_difference(first, first) == ""
    assert (
        first_difference(first, again)
        == f"speed of the ego differs by 0.0002 m/s after 0.0667 s; {SURVIVES}"
    )
    brakes = sound.rollout(AHEAD, lambda: lambda seen: (-1.0 if seen.time > 0.9 else 0.0, 0.0))
    assert first_difference(sound.rollout(AHEAD, STRAIGHT), brakes) == (
        "speed of the ego differs by 0.067 m/s after 1.07 s; the policy had decided differently"
    )
    shorter = SimulatorWorld(Bicycle, duration=3.0).rollout(AHEAD, STRAIGHT)
    assert (
        first_difference(sound.rollout(AHEAD, STRAIGHT), shorter)
        == "safe after 4 s, then safe after 3 s"
    )


def test_a_finding_of_a_simulator_that_does_not_repeat_says_when_and_by_how_much():
    world = SimulatorWorld(Worn, duration=10.0)
    found = pafot.explore(STRAIGHT, holds=never_collides, world=world, runs=8, seed=1)
    (flaky,) = {each.flaky.partition(" differs by ")[0] for each in found.findings}
    assert flaky.startswith("running it again gave a different run: ")
    assert all(each.flaky.endswith(SURVIVES) for each in found.findings)
