"""The check of a user's simulator: each wrong one is refused with its cause, and a right one that is as odd passes."""

import math
import random
import warnings
from typing import ClassVar

import numpy as np
import pytest

from pytest_pafot import Highway, PositionInstruction, Scenario, SimulatorWorld
from pytest_pafot.testing import check_world
from pytest_pafot.world import WorldError
from tests.helpers.tables import table
from tests.world.test_simulator import Bicycle as Toy


def circle(radius):
    return [(radius * math.sin(turn / 50), -radius * math.cos(turn / 50)) for turn in range(151)]


RINGS = [circle(radius) for radius in (300.0, 304.0, 308.0)]
RING = {"lanes": RINGS, "y_is_left": True, "start_lane": 1, "start_speed": 20.0}


def made(base=Toy, **members):
    return SimulatorWorld(type("Mine", (base,), members), duration=20.0)


def checked(world, **given):
    """Return the words of the error of a check, and its warnings."""
    with warnings.catch_warnings(record=True, action="always") as told:
        try:
            check_world(world, runs=1, **given)
        except AssertionError as error:
            return str(error), [str(each.message) for each in told]
    return "", [str(each.message) for each in told]


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
            [
                each._replace(acceleration=a, steering=s)
                for each, (a, s) in zip(controls, self.now, strict=True)
            ]
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


class WithDriver(Toy):
    """Its vehicles brake by themselves: those whose numbers are in ``drivers``, for vehicles close ahead."""

    drivers: ClassVar = (0,)

    def step(self, controls):
        x, y = self.way(0.0)
        places = [
            (each[0] * x + each[1] * y, each[0] * y + each[1] * x, each[3]) for each in self.cars
        ]
        brakes = {
            number
            for number, (at, across, speed) in enumerate(places)
            if any(
                0 < to - at - 5 < 1.2 * (speed - v) and abs(y - across) < 2 for to, y, v in places
            )
        }
        super().step([
            each._replace(acceleration=-9.0) if number in brakes and number in self.drivers else each
            for number, each in enumerate(controls)
        ])  # fmt: skip


class InOwnLanes(Toy):
    """It puts vehicles into lanes by their numbers."""

    def start(self, vehicles, seed):
        super().start([each._replace(y=self.across(each.lane)) for each in vehicles], seed)


class Shared(Toy):
    cars: ClassVar = []

    def start(self, vehicles, seed):
        super().start(vehicles, seed)
        now, self.cars = self.cars, type(self).cars
        self.cars[:] = now
        del self.__dict__["cars"]


def at_least(speed, vehicles):
    def step(self, controls):
        Toy.step(self, controls)
        for car in self.cars[vehicles]:
            car[3] = max(car[3], speed)

    return step


def jumping(self, controls):
    Toy.step(self, controls)
    self.ticks = getattr(self, "ticks", 0) + 1
    for car in self.cars[1:2]:
        car[0] += 3.0 * (self.ticks % 10 == 0)


OBEYS, TURNS, MOVES = (
    "control.acceleration of a vehicle",
    "control.steering of a vehicle",
    "direction of its heading",
)
KEEPS, SAME = "keeps its speed and heading", "the same start with the same seed gives the same run"


@table(("base", "members", "expected", "cause"), [
    (Toy, {"inside": {"degrees": True}}, MOVES, ". Use degrees = True"),
    (Toy, {"degrees": True, "inside": {"degrees": False}}, MOVES, ". Use degrees = False"),
    (Toy, {"inside": {"headings": "y to x"}}, MOVES, ". Use headings = 'y to x'"),
    (Toy, {**RING, "inside": {"degrees": True, "headings": "y to x"}}, MOVES, ". Use degrees = True, headings"),
    (Toy, {"reference": "front", "inside": {"reference": "centre"}}, "turns about",
     ". Use reference = 'centre'"),
    (Toy, {"reference": "rear axle", "rear_axle_offset": 1.4, "inside": {"reference": "centre"}}, "turns about",
     ". Use reference = 'centre'"),
    (Toy, {"states": lambda self: [(x + 2.5, *rest) for x, *rest in self.cars]}, "after start", "2.50 m ahead of"),
    (Toy, {"states": lambda self: [(x - 1.4, *rest) for x, *rest in self.cars]}, "after start", "1.40 m behind the"),
    (Toy, {"inside": {"hz": 10}}, "fits its speed", "distance for the ego (car, lane 2). Use hz = 10.0"),
    (Toy, {"hz": 50.0, "inside": {"hz": 1 / 0.03}}, "a vehicle fits its speed", ". Use hz = 33.333333"),
    (Toy, {"metres": 0.3048, "lane_width": 12.0, "inside": {"metres": 1.0}}, "fits its speed",
     ". Use metres_per_second = 0.3048"),
    (Toy, {"metres_per_second": 1 / 3.6, "speed_limit": 96.0, "inside": {"metres_per_second": 1.0}}, "fits its speed",
     ". Use metres_per_second = 1.0"),
    (Toy, {"metres_per_second": 1 / 3.6, "speed_limit": 96.0, "gas": lambda self, each: each.acceleration * 3.6}, OBEYS,
     "3.60 times that for the ego (car, lane 2). Use acceleration = 0.277778 times"),
    (Toy, {"gas": lambda self, each: each.acceleration / 3.6}, OBEYS, "(car, lane 2), as in km/h per second"),
    (Toy, {"wheels": lambda self, each: -each.steering}, TURNS, ". Use steering = -1.0 times that in control"),
    (Toy, {"wheels": lambda self, each: math.radians(each.steering)}, TURNS, "0.02 times that for the ego"),
    (Toy, {"step": limited}, OBEYS, "times that for the ego"),
    (Toy, {"gas": lambda self, each: 0.0}, OBEYS, "0.00 times that for the ego"),
    (Toy, {"gas": lambda self, each: each.acceleration - 1.0}, KEEPS, "-1.5 m/s and +0.00 rad for the ego"),
    (Toy, {"wheels": lambda self, each: each.steering + 0.02}, KEEPS, "+0.0 m/s and +0.09 rad for the ego"),
    (Toy, {"states": lambda self: [(x, y, -heading, v) for x, y, heading, v in self.cars]}, MOVES, "turned by -0.2"),
    (Toy, {"states": lambda self: [self.cars[0], *([x, y, 0.0, v] for x, y, _, v in self.cars[1:])]}, MOVES,
     "for NPC 0 (car, lane 3), whose heading turned by 0.00 rad"),
    (Toy, {"way": lambda self, heading: (-math.cos(heading), math.sin(heading))}, MOVES, ". Use headings = '-x to y'"),
    (Late, {}, "states() returns states after the step", "the first step does not move the ego"),
    (Late, {"states": lambda self: [Toy.states(self)[0], *self.seen[1:]]}, "states after the step", "not move NPC 0"),
    (Worn, {}, SAME, "in a simulator that was used before. Reset everything in start"),
    (Own, {}, SAME, "draw random numbers from a generator that start creates from seed"),
    (Toy, {"gas": lambda self, each: each.acceleration + random.gauss(0.0, 0.001)}, SAME, "a generator that start"),
    (Shared, {}, "simulators in a process share nothing, unless the class states", "while"),
    (Toy, {"step": standing}, "a vehicle stops, waits and drives on as requested", "m/s after 9 s for the ego"),
    (Toy, {"step": at_least(8.0, slice(1, None))}, "stops, waits and drives on", "8.0 m/s after 6 s and"),
    (Toy, {"step": at_least(2.0, slice(0, 1))}, "stops, waits and drives on", "2.0 m/s after 6 s and"),
    (Toy, {"step": on_rails}, TURNS, "-0.00 times that for NPC 0"),
    (Toy, {"step": steady_npcs}, OBEYS, "-0.00 times that for NPC 0"),
    (Toy, {"step": lambda self, controls: Toy.step(self, [*controls[1:], controls[0]])}, OBEYS, "of NPC 0 moves it"),
    (Toy, {"states": lambda self: Toy.states(self)[::-1]}, "after start", "in another order than start"),
    (Toy, {"states": lambda self: sorted(Toy.states(self))}, "after start", "in another order than start"),
    (Toy, {"states": lambda self: self.cars[:4]}, "states() returns finite numbers of shape (7, 4)", "[[150.0"),
    (Toy, {"step": jumping}, "states() returns states after the step, without jumps", "for NPC 0 (car, lane"),
    (Resized, {"size": lambda self, each: each._replace(length=each.width)}, TURNS, "Use steering = 0.4 times"),
    (Resized, {"size": lambda self, each: each._replace(length=5.0)}, "according to its length", "2.2 and 12 m"),
    (Resized, {"size": lambda self, each: {"car": each, "van": each}[each.kind]}, "vehicles of all types", "KeyError"),
    (InOwnLanes, {"across": lambda self, lane: 4.0 * (3 - lane)}, "after start", "counted from the right"),
    (InOwnLanes, {"across": lambda self, lane: 3.5 * lane}, "after start", "0.875 times as wide as lane_width"),
    (WithDriver, {}, KEEPS, "for the ego (car, lane 2)"),
    (WithDriver, {"drivers": (1, 2, 3, 4, 5, 6)}, KEEPS, "for NPC 1 ("),
    (Toy, {"step": lambda self, controls: (Toy.step(self, controls), controls.pop())}, "does not change", "Control("),
    (Toy, {"close": lambda self: 1 / 0}, "close() returns in time and without an exception", "ZeroDivisionError"),
])  # fmt: skip
def test_wrong_simulator_is_refused_with_what_was_expected_and_the_cause(
    base, members, expected, cause
):
    error, _ = checked(made(base, **members))
    assert error.startswith("expected that ")
    assert expected in error.partition(", received ")[0]
    assert cause in error.partition(", received ")[2]


class AtRearAxle(Toy):
    """It moves rear axles, 1.4 m behind the centres of vehicles, whose axles are 0.56 of their lengths apart."""

    reference, rear_axle_offset = "rear axle", 1.4

    def step(self, controls):
        for car, length, control in zip(self.cars, self.lengths, controls, strict=True):
            car[0] += car[3] * math.cos(car[2]) / self.hz
            car[1] += car[3] * math.sin(car[2]) / self.hz
            car[2] += car[3] * math.tan(control.steering) / (0.56 * length) / self.hz
            car[3] += control.acceleration / self.hz


class Native(Toy):
    """Its policy gets an array and answers with steering and throttle, as a network does. It has drag."""

    native = True

    def observe(self):
        return np.array(self.cars)

    def step(self, controls):
        told = [each if each.action is None else each._replace(
            steering=0.5 * each.action[0], acceleration=4.0 * each.action[1]) for each in controls]  # fmt: skip
        super().step([
            each._replace(acceleration=4.0 * max(-1.0, min(each.acceleration / 4.0, 1.0)) - 3e-4 * car[3] ** 2)
            for each, car in zip(told, self.cars, strict=True)
        ])  # fmt: skip
        for car in self.cars:
            car[3] = max(car[3], 0.0)


class Alone(Toy):
    one_at_a_time = True
    open: ClassVar = []

    def __init__(self):
        assert not self.open
        self.open.append(self)

    def close(self):
        self.open.remove(self)


WIDE = (
    "control.steering turns the ego {:.2f} times as much as in a bicycle model. If its wheelbase is not its length, "
    "use atan({:.2f} * tan(steering))"
)
LATE = "control.acceleration of the ego takes effect {}. A lagging drivetrain is allowed"


@table(("base", "members", "notes"), [
    (Toy, {}, []),
    (Toy, {"lanes": 1}, []),
    (Toy, {"degrees": True, "headings": "y to x", "reference": "front", "y_is_left": True}, []),
    (Toy, {**RING, "degrees": True, "headings": "y to x", "reference": "front"}, []),
    (Toy, RING, []),
    (Toy, {"metres": 0.3048, "metres_per_second": 1 / 3.6, "lane_width": 12.0, "speed_limit": 96.0}, []),
    (Toy, {"hz": 7}, []),
    (Toy, {"dt": 0.03, "hz": 1 / 0.03}, []),
    (Toy, {"speed_limit": 9.0}, []),
    (Toy, {"length": 900.0}, []),
    (Toy, {"inside": {"length": 0.5}}, [WIDE.format(2.0, 0.5)]),
    (Toy, {"gas": lambda self, each: each.acceleration + 0.05 * self.random.gauss(0.0, 1.0)}, []),
    (Delayed, {}, [LATE.format("0.07 s late"), "control.steering of the ego takes effect 0.07 s late"]),
    (Lagging, {}, [LATE.format("0.23 s late"), "Set moves_ego_only = True if NPCs obey immediately"]),
    (Lagging, {"hz": 240}, [LATE.format("0.28 s late"), "control.steering of the ego takes effect 0.27 s late"]),
    (DelayedEgo, {"ticks": 7}, [LATE.format("0.47 s late"), "control.steering of the ego"]),
    (Dragging, {}, [LATE.format("in part, 0.80 times")]),
    (Rested, {}, []),
    (Single, {}, []),
    (Substeps, {}, []),
    (Toy, {**RING, "lane_width": 3.0, "lanes": [circle(radius) for radius in (300.0, 303.0, 306.0)]}, []),
    (AtRearAxle, {}, [WIDE.format(1.79, 0.56)]),
    (AtRearAxle, {"reference": "centre", "rear_axle_offset": None}, ['Should reference be "rear axle"?']),
    (Native, {}, []),
    (Alone, {}, []),
])  # fmt: skip
def test_right_simulator_passes_and_what_may_surprise_is_a_warning(base, members, notes):
    error, told = checked(made(base, **members))
    assert error == ""
    assert len(told) == len(notes)
    assert all(note in each for note, each in zip(notes, told, strict=True))


class Backwards(Toy):
    def step(self, controls):
        super().step(controls)
        for car in self.cars:
            car[3] -= 1e-3 if car[3] <= 1e-3 else 0.0


def test_npc_that_a_simulator_pushes_backwards_is_driven_on():
    npcs = ((PositionInstruction(2, 0.0),),)
    assert (
        made(Backwards)
        .rollout(Scenario(npcs=npcs, ego_speed=5.0), lambda: lambda seen: (-2.0, 0.0))
        .ticks
        == 150
    )


def test_policy_that_fails_in_the_check_is_named_as_such():
    error, _ = checked(made(), ads=lambda: lambda seen: None)
    assert error.startswith(
        "expected that random runs are valid, and the policy of the check drives in this world"
    )
    assert error.endswith("Give a different ads=")


def test_simulator_whose_states_freeze_is_refused_with_method_and_tick():
    def step(self, controls):
        self.ticks = getattr(self, "ticks", 0) + 1
        if not 200 < self.ticks < 210:
            Toy.step(self, controls)

    def start(self, vehicles, seed):
        Toy.start(self, vehicles, seed)
        self.ticks = 0

    error, _ = checked(made(start=start, step=step))
    assert "Mine.states, tick 208: " in error


class Leaking:
    """A policy whose runs depend on earlier ones."""

    made = 0

    def __init__(self):
        Leaking.made += 1
        self.acceleration = 0.001 * Leaking.made

    def __call__(self, seen):
        return self.acceleration, 0.0


def test_in_other_worlds_of_the_package_only_the_repetition_of_runs_is_checked():
    check_world(Highway(duration=4.0), runs=2)
    with pytest.raises(
        AssertionError,
        match=r"expected that the same scenario gives the same run.*, received .* differs by",
    ):
        check_world(Highway(duration=4.0), runs=2, ads=Leaking)


def test_what_is_no_world_is_refused_with_the_way_out():
    class Mine:
        def rollout(self, scenario, ads_factory):
            raise AssertionError

    told = r"Derive your own simulator from pafot\.Simulator, and pass it to pafot\.SimulatorWorld"
    with pytest.raises(WorldError, match=told):
        check_world(Mine())
