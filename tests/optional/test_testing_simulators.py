"""Experiments with simulators: each wrong one is refused with its cause, and a right one that is as odd passes."""

import math
import random
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest

from pytest_pafot import PositionInstruction, Scenario, SimulatorWorld
from pytest_pafot.searching.space import sample
from pytest_pafot.testing import check_world
from pytest_pafot.testing.simulators import experiments
from pytest_pafot.world.guard.own_worlds import base_world
from tests.helpers.tables import table
from tests.world.test_simulator import Bicycle as Toy


def circle(radius):
    return [(radius * math.sin(turn / 50), -radius * math.cos(turn / 50)) for turn in range(151)]


RINGS = [circle(radius) for radius in (300.0, 304.0, 308.0)]
RING = {"lanes": RINGS, "y_is_left": True, "start_lane": 1, "start_speed": 20.0}


def made(base=Toy, **members):
    return SimulatorWorld(type("Mine", (base,), members), duration=20.0)


def first_broken(world, **space):
    """Return the words of the first promise that experiments find broken."""
    asked = sample(base_world(world).space(space), np.random.default_rng(0))
    assert isinstance(asked, Scenario)
    return next(
        (f"{promise}, received {received}" for kept, promise, received in experiments(world, asked, 0) if not kept), ""
    )


class Late(Toy):
    def start(self, vehicles, seed):
        super().start(vehicles, seed)
        self.seen = super().states()

    def step(self, controls):
        self.seen = super().states()
        super().step(controls)

    def states(self):
        return self.seen


class Delayed(Toy):
    ticks = 1

    def start(self, vehicles, seed):
        super().start(vehicles, seed)
        self.waiting = [[]] * self.ticks

    def step(self, controls):
        now, *self.waiting = [*self.waiting, controls]
        super().step(now or [each._replace(acceleration=0.0, steering=0.0) for each in controls])


class DelayedEgo(Delayed):
    """Its ego obeys some ticks later; NPCs are put where their controls say."""

    moves_ego_only = True

    def step(self, controls):
        super().step(controls)
        for car, control in zip(self.cars[1:], controls[1:], strict=True):
            car[:] = control.x, control.y, control.heading, control.speed
        self.cars[0][3] = max(self.cars[0][3], 0.0)  # brakes hold a vehicle that stands


class Lagging(Toy):
    """It obeys with a lag of 0.3 s, as engines and steering do."""

    def start(self, vehicles, seed):
        super().start(vehicles, seed)
        self.now = np.zeros((len(vehicles), 2))

    def step(self, controls):
        asked = np.array([(each.acceleration, each.steering) for each in controls])
        self.now += (asked - self.now) / (0.3 * self.hz)
        super().step(
            [each._replace(acceleration=a, steering=s) for each, (a, s) in zip(controls, self.now, strict=True)]
        )


class Worn(Toy):
    heat = 0.0

    def gas(self, control):
        self.heat += max(-control.acceleration, 0.0)
        return control.acceleration * (1 - 1e-6 * self.heat)


class Rested(Worn):
    def start(self, vehicles, seed):
        super().start(vehicles, seed)
        self.heat = 0.0


class Own(Toy):
    def __init__(self):
        self.wind = np.random.default_rng(0)

    def gas(self, control):
        return control.acceleration + 0.01 * self.wind.normal()


class Single(Toy):
    def start(self, vehicles, seed):
        super().start(vehicles, seed)
        self.cars = np.array(self.cars, np.float32)

    def states(self):
        return self.cars


class Substeps(Toy):
    inside: ClassVar = {"hz": 150}

    def step(self, controls):
        for _ in range(10):
            super().step(controls)


class Resized(Toy):
    def start(self, vehicles, seed):
        super().start([self.size(each) for each in vehicles], seed)


def limited(self, controls):
    Toy.step(self, controls)
    for car in self.cars:
        car[3] = min(car[3], 24.0)


def standing(self, controls):
    """Let vehicles that stand never drive again."""
    Toy.step(self, [
        each._replace(acceleration=0.0) if car[3] < 0.5 else each
        for car, each in zip(self.cars, controls, strict=True)
    ])  # fmt: skip


def on_rails(self, controls):
    Toy.step(self, [controls[0], *(each._replace(steering=0.0) for each in controls[1:])])


def steady_npcs(self, controls):
    Toy.step(self, [controls[0], *(each._replace(acceleration=0.0) for each in controls[1:])])


class Dragging(DelayedEgo):
    """Its ego has drag and rolls with friction, and obeys at once."""

    ticks = 0

    def gas(self, control):
        speed = self.cars[0][3]
        return control.acceleration - (0.15 + 4e-4 * speed**2 if speed > 0.1 else 0.0)


@table(("base", "members", "cause"), [
    (Toy, {"inside": {"degrees": True}}, "all fits with degrees = True"),
    (Toy, {"degrees": True, "inside": {"degrees": False}}, "all fits with degrees = False"),
    (Toy, {"inside": {"headings": "y to x"}}, "fits"),
    (Toy, {**RING, "inside": {"degrees": True, "headings": "y to x"}}, "fits with degrees = True, headings"),
    (Toy, {"at_front": True, "inside": {"at_front": False}}, "all fits with at_front = False"),
    (Toy, {"states": lambda self: [(x + 2.5, *rest) for x, *rest in self.cars]}, "the ego ahead of where"),
    (Toy, {"inside": {"hz": 10}}, "all fits with hz = 10"),
    (Toy, {"metres": 0.3048, "lane_width": 12.0, "inside": {"metres": 1.0}}, "metres_per_second = 0.3048"),
    (Toy, {"metres_per_second": 1 / 3.6, "speed_limit": 96.0, "gas": lambda self, each: each.acceleration * 3.6},
     "all fits with 0.278 times control.acceleration"),
    (Toy, {"wheels": lambda self, each: -each.steering}, "the opposite sign of control.steering"),
    (Toy, {"step": limited}, "the speed changes by control.acceleration"),
    (Toy, {"gas": lambda self, each: 0.0}, "the speed changes by control.acceleration"),
    (Toy, {"gas": lambda self, each: each.acceleration - 1.0}, "the speed is steady without acceleration"),
    (Toy, {"wheels": lambda self, each: each.steering + 0.02}, "the heading is steady without steering"),
    (Toy, {"states": lambda self: [(x, y, -heading, v) for x, y, heading, v in self.cars]}, "its heading points"),
    (Toy, {"way": lambda self, heading: (-math.cos(heading), math.sin(heading))}, "fits with headings = '-x to y'"),
    (Late, {}, "states() has to return the states after the last step"),
    (Delayed, {}, "an acceleration that begins a tick late"),
    (Worn, {}, "used before; reset all in start"),
    (Own, {}, "used before; reset all in start, also random generators"),
    (Toy, {"gas": lambda self, each: each.acceleration + random.gauss(0.0, 0.001)}, "in new simulators, too"),
    (Toy, {"metres_per_second": 1 / 3.6, "speed_limit": 96.0, "inside": {"metres_per_second": 1.0}},
     "all fits with metres_per_second = 1.0"),
    (Toy, {"step": standing}, "0 times an acceleration of 2 m/s^2, from 0 m/s on"),
    (Late, {"states": lambda self: [Toy.states(self)[0], *self.seen[1:]]},
     "states that are a tick old, unlike those of the ego"),
    (Toy, {"step": on_rails}, "that its control.steering does not turn it"),
    (Toy, {"step": steady_npcs}, "that its control.acceleration does not move it"),
    (Toy, {"step": lambda self, controls: Toy.step(self, [*controls[1:], controls[0]])}, "those of NPC 0 move it"),
    (Toy, {"states": lambda self: Toy.states(self)[::-1]}, "in the order in which start received them"),
    (Resized, {"size": lambda self, each: each._replace(length=each.width)}, "another turn of a wider vehicle"),
])  # fmt: skip
def test_wrong_simulator_is_refused_with_the_cause(base, members, cause):
    assert cause in first_broken(made(base, **members))


@table(("base", "members"), [
    (Toy, {}),
    (Toy, {"lanes": 1}),
    (Toy, {"degrees": True, "headings": "y to x", "at_front": True, "y_is_left": True}),
    (Toy, {**RING, "degrees": True, "headings": "y to x", "at_front": True}),
    (Toy, RING),
    (Toy, {"metres": 0.3048, "metres_per_second": 1 / 3.6, "lane_width": 12.0, "speed_limit": 96.0}),
    (Toy, {"hz": 7}),
    (Toy, {"inside": {"length": 0.5}}),
    (Toy, {"gas": lambda self, each: each.acceleration + 0.05 * self.random.gauss(0.0, 1.0)}),
    (Lagging, {}),
    (Lagging, {"hz": 240}),
    (DelayedEgo, {"ticks": 7}),
    (Dragging, {}),
    (Rested, {}),
    (Single, {}),
    (Substeps, {}),
    (Toy, {**RING, "lane_width": 3.0, "lanes": [circle(radius) for radius in (300.0, 303.0, 306.0)]}),
])  # fmt: skip
def test_right_simulator_passes_the_experiments(base, members):
    npcs = {"npcs": 1, "ego_lane": 0} if members.get("lanes") == 1 else {}
    assert first_broken(made(base, **members), **npcs) == ""


class Backwards(Toy):
    def step(self, controls):
        super().step(controls)
        for car in self.cars:
            car[3] -= 1e-3 if car[3] <= 1e-3 else 0.0


def test_npc_that_a_simulator_pushes_backwards_is_driven_on():
    npcs = ((PositionInstruction(2, 0.0),),)
    assert made(Backwards).rollout(Scenario(npcs=npcs, ego_speed=5.0), lambda: lambda seen: (-2.0, 0.0)).ticks == 150


@pytest.mark.filterwarnings("ignore:check_world. no:RuntimeWarning")
def test_ego_that_obeys_late_is_right_where_a_simulator_states_it():
    check_world(made(DelayedEgo, ticks=7), runs=2)


@pytest.mark.filterwarnings("ignore:check_world. no:RuntimeWarning")
def test_check_of_a_road_of_one_lane_needs_no_arguments():
    check_world(made(lanes=1), runs=2)


@dataclass(frozen=True, kw_only=True)
class Derived(SimulatorWorld):
    """A world around a simulator that makes its traces by itself, some with wrong units."""

    speed_unit: float = 1.0

    def rollout(self, scenario, ads_factory, **given):
        trace = super().rollout(scenario, ads_factory, **given)
        lanes = [replace(each, speed_limit=each.speed_limit * self.speed_unit) for each in trace.lanes]
        return replace(trace, lanes=tuple(lanes))


@pytest.mark.filterwarnings("ignore:check_world. no:RuntimeWarning")
def test_traces_of_a_class_derived_from_the_simulators_world_are_checked_as_the_users():
    check_world(Derived(simulator=Toy, duration=10.0), runs=2)
    with pytest.raises(AssertionError, match="lanes have a speed_limit in m/s"):
        check_world(Derived(simulator=Toy, duration=10.0, speed_unit=3.6), runs=2)
