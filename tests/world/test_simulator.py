"""A simulator of the user's as a world: its runs, its units and axes, its road, its files and its errors."""

import math
import multiprocessing
import os
import pickle
import random
import subprocess
import sys
import time
import warnings
from functools import partial
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle

from pytest_pafot import (
    Highway,
    LaneCommand,
    LaneInstruction,
    Perception,
    PositionInstruction,
    Scenario,
    Simulator,
    SimulatorWorld,
    explore,
)
from pytest_pafot.corpus.reader import parsed
from pytest_pafot.corpus.writer import text_of
from pytest_pafot.findings.decisions import is_si
from pytest_pafot.model.trace import Outcome
from pytest_pafot.support.errors import AdsFactoryError
from pytest_pafot.support.process import installed_versions
from pytest_pafot.world import WorldError
from pytest_pafot.world.codec import check_named_world, described, is_code
from pytest_pafot.world.engines.simulation import Simulators
from pytest_pafot.world.roads.survey import network_of, straight_along
from tests.helpers.refusals import refused
from tests.helpers.tables import table

LANE = 4.0


class Bicycle(Simulator):
    """A kinematic bicycle, operation by operation as highway-env writes it, in any units and axes.

    ``inside`` has what it does where that is not what it states.
    """

    hz, lanes = 15, 4
    inside: ClassVar = {}

    def says(self, name):
        return self.inside.get(name, getattr(self, name, False))

    def angle(self, stated):
        return math.radians(stated) if self.says("degrees") else stated

    def start(self, vehicles, seed):
        self.random = random.Random(seed)
        self.lengths = [self.inside.get("length", 1.0) * each.length for each in vehicles]
        self.cars = []
        for each in vehicles:
            heading = self.angle(each.heading)
            back = self.ahead(each.length)
            x, y = self.way(heading)
            self.cars.append([each.x - back * x, each.y - back * y, heading, each.speed])

    def ahead(self, length):
        """Return how far ahead of the centre the places are that it states."""
        return {"front": length / 2, "rear axle": -1.4}.get(self.says("reference"), 0.0)

    def way(self, heading):
        """Return where a heading points, along x and y."""
        x, y = math.cos(heading), math.sin(heading)
        return {"y to x": (y, x), "x to -y": (x, -y), "-x to y": (-x, y)}.get(
            self.says("headings"), (x, y)
        )

    def step(self, controls):
        dt, unit = 1 / self.says("hz"), self.says("metres_per_second") / self.says("metres")
        for car, length, control in zip(self.cars, self.lengths, controls, strict=True):
            slip = math.atan(0.5 * math.tan(self.wheels(control)))
            x, y = self.way(car[2] + slip)
            car[0] += car[3] * unit * x * dt
            car[1] += car[3] * unit * y * dt
            car[2] += car[3] * unit * math.sin(slip) / (length / 2) * dt
            car[3] += self.gas(control) * dt

    def wheels(self, control):
        return self.angle(control.steering)

    def gas(self, control):
        return control.acceleration

    def states(self):
        rows = []
        for (x, y, heading, speed), length in zip(self.cars, self.lengths, strict=True):
            ahead, (along_x, along_y) = self.ahead(length), self.way(heading)
            stated = math.degrees(heading) % 360.0 if self.says("degrees") else heading
            rows.append([x + ahead * along_x, y + ahead * along_y, stated, speed])
        return rows


BEHIND = ((PositionInstruction(6, 0.0),),)
"""An NPC that stays behind."""
AHEAD = Scenario(npcs=((PositionInstruction(2, 10.0),),))


def steady():
    """Return an ADS that neither accelerates nor steers."""
    return lambda _: (0.0, 0.0)


"""An NPC that stays behind."""

TOY = SimulatorWorld(Bicycle, duration=20.0)
HIGHWAY = Highway(duration=20.0)


def swerving():
    """Return an ADS that steers and brakes by numbers and by Drives in turn."""

    def decide(seen):
        second = int(seen.time)
        if second % 4 < 2:
            return LaneCommand(lane=min(seen.ego.lane + second % 2, 3), speed=20.0 - seen.time / 2)
        return 1.5 - seen.time / 4, 0.004 * math.sin(seen.time)

    return decide


def scenarios():
    cells = tuple(map(PositionInstruction, (2, 3, 4), (10.0, 24.0, 19.0)))
    lanes = tuple(map(LaneInstruction, ("left", "keep", "right"), (12.0, 26.0, 5.0)))
    common = {"gene_seconds": 4.0, "ego_lane": 1}
    kinds = {"traffic": "everyday", "vehicles": ("truck", "car", "motorcycle")}
    return [
        Scenario(npcs=(cells, lanes), **common),
        Scenario(npcs=(lanes, cells, lanes[::-1]), **kinds, **common),
        Scenario(npcs=(lanes[1:], cells), ego_speed=17.0, seed=5, **common),
    ]


def same(one, other):
    """Return whether two runs have the same states, decisions and end, to the last bit."""
    names = "outcome", "collision", "actions", "arrivals", "executed"
    equal = all(getattr(one, name) == getattr(other, name) for name in names)
    return equal and np.array_equal(one.states, other.states)


@pytest.mark.parametrize("scenario", scenarios(), ids=["mixed", "vehicles", "slow"])
def test_simulator_with_the_same_physics_drives_the_runs_of_a_highway_to_the_bit(scenario):
    runs = [world.rollout(scenario, swerving) for world in (TOY, HIGHWAY)]
    assert same(*runs)
    tick, name = runs[0].ticks // 2, "careful-human"
    for drive in (
        lambda world, run: world.take_over(run, tick, name),
        lambda world, run: world.rollout_reference(scenario, name),
        lambda world, run: world.rollout(
            scenario, lambda: lambda _: (0.5, 0.0), decisions=run.actions[:7]
        ),
    ):
        assert same(*map(drive, (TOY, HIGHWAY), runs))


def test_search_on_a_road_of_one_lane_needs_no_arguments():
    single = SimulatorWorld(type("Single", (Bicycle,), {"lanes": 1}), duration=20.0)
    found = explore(lambda: lambda _: (1.0, 0.0), holds=holds, world=single, runs=6, seed=1)
    assert {(row["ego_lane"], row["npcs"]) for row in found.runs} == {(0, 1)}
    assert found.findings


class Slowing:
    def __call__(self, seen):
        return -seen.ego.speed / 20, 0.0


# Units and axes.

FOOT, KMH = 0.3048, 1 / 3.6


@table("flags", {
    "y to the left": {"y_is_left": True},
    "degrees": {"degrees": True},
    "front bumper": {"reference": "front"},
    "rear axle": {"reference": "rear axle", "rear_axle_offset": 1.4},
    "feet and km/h": {"metres": FOOT, "metres_per_second": KMH, "lane_width": LANE / FOOT, "speed_limit": 96.48},
    "a compass": {"y_is_left": True, "headings": "y to x"},
    "x to the north, a compass": {"y_is_left": True, "headings": "x to -y"},
    "x backwards": {"y_is_left": True, "headings": "-x to y", "degrees": True},
    "all, as SUMO states them": {"y_is_left": True, "degrees": True, "headings": "y to x", "reference": "front"},
    "rear axle and a compass": {"y_is_left": True, "headings": "y to x", "reference": "rear axle",
                                "rear_axle_offset": 1.4},
}.values())  # fmt: skip
def test_run_is_that_of_a_highway_in_other_units_and_axes(flags):
    world = SimulatorWorld(type("Other", (Bicycle,), flags), duration=20.0)
    for scenario in scenarios()[1:3]:
        there, here = world.rollout(scenario, swerving), HIGHWAY.rollout(scenario, swerving)
        assert (there.outcome, there.ticks) == (here.outcome, here.ticks)
        assert there.states == pytest.approx(here.states, abs=1e-6)


def test_places_of_objects_are_those_of_their_centres_whatever_those_of_vehicles_are():
    given = {"obstacles": ((450.0, 4.0, 0.2, 2.0, 1.0),)}
    for stated in ({}, {"reference": "front"}, {"reference": "rear axle", "rear_axle_offset": 1.4}):
        world = SimulatorWorld(type("Other", (Bicycle,), given | stated))
        assert world.rules.obstacles == given["obstacles"]


@table(("x0", "y0", "turn"), [(300.0, -50.0, 0.0), (10.0, 20.0, -math.pi / 2), (-90.0, 7.0, 2.5)])
def test_straight_lanes_in_any_direction_are_the_straight_road(x0, y0, turn):
    cos, sin = math.cos(turn), math.sin(turn)

    def moved(x, y):
        return x0 + x * cos - y * sin, y0 + x * sin + y * cos

    class Turned(Bicycle):
        lanes = tuple((moved(0.0, y), moved(2000.0, y)) for y in (0.0, 4.0, 8.0, 12.0))

    world = SimulatorWorld(Turned, duration=20.0)
    there, here = (each.rollout(scenarios()[1], swerving) for each in (world, HIGHWAY))
    assert world.start is None
    assert there.states[..., :6] == pytest.approx(here.states[..., :6], abs=1e-6)


# Roads.


def arc(radius, angle, points=60, y=0.0):
    """Return points of a circle to the right around (0, radius), at a distance ``y`` to its inside."""
    turns = np.linspace(0.0, angle, points)
    return np.stack([(radius - y) * np.sin(turns), radius - (radius - y) * np.cos(turns)], axis=-1)


class Ring(Bicycle):
    """Three lanes in a bend to the right with a radius of 400 m, of the leftmost."""

    lanes = tuple(arc(400.0, 3.0, y=4.0 * number) for number in range(3))
    start_lane, start_speed = 1, 20.0


RING = SimulatorWorld(Ring, duration=20.0)


def test_lanes_of_a_circle_are_arcs_of_its_radius():
    network, centre = (
        network_of([np.asarray(line) for line in Ring.lanes], LANE, 26.8),
        [0.0, 400.0],
    )
    for (_, _, number), lane in network.lanes_dict().items():
        radius = 400.0 - 4.0 * number
        assert lane.radius == pytest.approx(radius, rel=3e-3)
        assert np.hypot(*(lane.center - centre)) == pytest.approx(0.0, abs=1.3)
        middle = lane.position(lane.length / 2, 0)
        assert np.hypot(*(middle - centre)) == pytest.approx(radius, abs=5e-3)


FOR_20_S = Scenario(npcs=BEHIND, ego_lane=1, ego_speed=20.0, gene_seconds=20.0)


def test_ego_that_keeps_its_lane_stays_on_its_circle():
    trace = RING.rollout(FOR_20_S, lambda: lambda _: LaneCommand(lane=1, speed=20.0))
    away = np.hypot(trace.states[:, 0, 0], trace.states[:, 0, 1] - 400.0)
    assert trace.outcome is Outcome.COMPLETED
    assert away == pytest.approx(396.0, abs=0.1)
    assert np.abs(trace.track[:, 0, 3]).max() < 0.1
    assert trace.track[-1, 0, 0] - trace.track[0, 0, 0] == pytest.approx(20.0 * 20.0, rel=0.01)


def test_take_over_repeats_a_run_in_a_bend_to_the_bit():
    scenario = Scenario(npcs=((PositionInstruction(2, 15.0),),), ego_lane=1, ego_speed=20.0)
    trace = RING.rollout(scenario, swerving)
    half = trace.ticks // 2
    taken = RING.take_over(trace, half, "careful-human")
    assert np.array_equal(taken.states[: half + 1], trace.states[: half + 1])
    assert same(RING.rollout(scenario, lambda: pytest.fail, decisions=trace.actions), trace)


def test_lane_or_road_that_ends_is_none_further_on():
    lanes = (((0.0, 0.0), (900.0, 0.0)), ((0.0, 4.0), (400.0, 4.0)))
    road = SimulatorWorld(type("Merging", (Bicycle,), {"lanes": lanes}), duration=20.0).road
    assert (road.lane_count, road.has_lane(1, 300.0), road.has_lane(1, 500.0)) == (2, True, False)
    short = SimulatorWorld(type("Short", (Bicycle,), {"lanes": 2, "length": 400.0}))
    scenario = Scenario(npcs=BEHIND, ego_lane=0, ego_speed=22.0, gene_seconds=30.0)
    trace = short.rollout(scenario, steady)
    assert trace.outcome is Outcome.END_OF_ROAD
    assert trace.states[-1, 0, 0] == pytest.approx(397.5, abs=2.0)


@table(("lines", "found"), {
    "equal lanes": ([[(0, 0), (900, 0)], [(0, 4), (900, 4)]], ((0.0, 0.0, 0.0), 900.0)),
    "one lane": ([[(5, 5), (5, 400)]], ((5.0, 5.0, math.pi / 2), 395.0)),
    "other widths": ([[(0, 0), (900, 0)], [(0, 5), (900, 5)]], None),
    "a bend": ([[(0, 0), (500, 0), (900, 1)]], None),
    "lanes from the right": ([[(0, 4), (900, 4)], [(0, 0), (900, 0)]], None),
    "a lane that ends": ([[(0, 0), (900, 0)], [(0, 4), (400, 4)]], None),
}.values())  # fmt: skip
def test_lines_are_a_straight_road_if_lanes_are_equal(lines, found):
    assert straight_along([np.array(line, dtype=float) for line in lines], LANE) == found


def spiral(away, radius=300.0, grows=18.0, points=300):
    """Return points of two turns to the right with a growing radius, at a distance ``away`` from its outside."""
    turns = np.linspace(0.0, 4 * math.pi, points + 1)
    reach = radius + grows * turns
    way = np.stack([reach * np.sin(turns), -reach * np.cos(turns)], axis=-1)[:, ::-1]
    along = np.gradient(way, axis=0, edge_order=2)
    along /= np.hypot(*along.T)[:, None]
    return way + away * np.stack([-along[:, 1], along[:, 0]], axis=-1)


def test_spiral_is_a_road_whose_lanes_are_next_to_each_other():
    class Spiral(Ring):
        lanes = tuple(spiral(away) for away in (0.0, 4.0, 8.0))

    world = SimulatorWorld(Spiral, duration=20.0)
    assert world.road.lane_count == 3
    trace = world.rollout(
        FOR_20_S, lambda: lambda seen: LaneCommand(lane=1 + (seen.time > 5.0), speed=20.0)
    )
    assert (trace.outcome, trace.states[-1, 0, 6]) == (Outcome.COMPLETED, 2)


# Ticks, which may be no whole number per second.


class Ticks(Bicycle):
    """The same in ticks of 30 ms, with headings that turn around once per tick."""

    dt, hz = 0.03, 1 / 0.03

    def states(self):
        turn = 2 * math.pi
        return [(x, y, h + turn * round(x / self.dt), v) for x, y, h, v in super().states()]


@table(("members", "rates"), {
    "a whole hz": ({"hz": 10}, (10, 5)),
    "a whole hz as a float": ({"hz": np.float64(10.0)}, (10, 5)),
    "a whole hz without a divisor near 5": ({"hz": 33}, (33, 11)),
    "dt of a whole hz": ({"hz": 20.0, "dt": 0.05}, (20, 5)),
    "dt of no whole hz": ({"hz": 1 / 0.03, "dt": 0.03}, (pytest.approx(100 / 3), pytest.approx(100 / 18))),
    "hz that is not whole": ({"hz": 33.3}, (33.3, pytest.approx(5.55))),
}.values())  # fmt: skip
def test_rates_are_whole_numbers_wherever_they_are_whole(members, rates):
    world = broken(**members)
    found = world.physics_hz, world.rules.ads_hz
    assert found == rates
    assert [type(each) is int for each in found] == [type(each) is int for each in rates]


STRAIGHT = [[(x, 4.0 * lane) for x in range(0, 900, 100)] for lane in range(3)]


@table("lanes", [Ticks.lanes, STRAIGHT, Ring.lanes])
def test_search_in_ticks_of_30_ms_saves_files_that_replay_to_the_bit(lanes):
    world = SimulatorWorld(type("Ticks", (Ticks,), {"lanes": lanes}), duration=20.0)
    found = explore(steady, holds=holds, world=world, runs=6, seed=1)
    assert {row["gene_seconds"] for row in found.runs} <= {2.01, 3.0, 3.99}
    assert found.findings
    for each, sighting in zip(found.findings, found.sightings, strict=True):
        saved = parsed(Path(f"{each.id}.pafot.yaml"), text_of(each).encode())
        assert (saved.scenario, saved.world) == (each.scenario, each.world)
        again = check_named_world(saved.world, world).rollout(saved.scenario, steady)
        assert again.states.tobytes() == sighting.run.trace.states.tobytes()
        assert again.ticks == round(saved.expect.time / 0.03)
        assert [*again.decision_ticks][:3] == [0, 6, 12]
        assert each.flaky is None


def test_durations_of_genes_are_rounded_to_whole_ticks_of_30_ms_only():
    ticks, plain = SimulatorWorld(Ticks, duration=60.0), SimulatorWorld(Bicycle, duration=60.0)
    for world, seconds in ((ticks, (9.99, 2.01, 13.98)), (plain, (10.0, 2.0, 14.0))):
        space = world.space({"genes": 7})
        assert (space.gene_seconds, world.space({"gene_seconds": 2.0}).gene_seconds) == seconds[:2]
        assert space.sliced(5).gene_seconds == seconds[2]
        assert ("tick" in space.plain) is (world is ticks)


# A simulator in which a control takes effect late.


class Late(Bicycle):
    """An ego with a lag of first order of 0.3 s in acceleration and steering, between NPCs that are put in places."""

    moves_ego_only = True

    def start(self, vehicles, seed):
        super().start(vehicles, seed)
        self.real = np.zeros(2)

    def step(self, controls):
        first, *others = controls
        wanted = np.array([first.acceleration, first.steering])
        self.real = self.real + (wanted - self.real) * (1.0 - math.exp(-1 / self.hz / 0.3))
        acceleration, steering = self.real.tolist()
        super().step([first._replace(acceleration=acceleration, steering=steering), *others])
        self.cars[1:] = [[each.x, each.y, each.heading, each.speed] for each in others]


def test_npcs_next_to_an_ego_that_obeys_late_drive_as_on_a_highway():
    late = SimulatorWorld(Late, duration=20.0)
    for scenario in scenarios():  # what takes effect late is the same then
        assert same(late.rollout(scenario, steady), HIGHWAY.rollout(scenario, steady))
    scenario = Scenario(npcs=((PositionInstruction(2, 26.0),),), ego_lane=1, ego_speed=22.0)
    trace = late.rollout(scenario, lambda: lambda _: (-4.0, 0.0))
    after = np.arange(0, 31) / 15
    exact = 22.0 - 4.0 * (after - 0.3 * (1.0 - np.exp(-after / 0.3)))
    assert trace.states[:31, 0, 3] == pytest.approx(exact, abs=0.15)
    taken = late.take_over(trace, 10, "careful-human")
    assert np.array_equal(taken.states[:11], trace.states[:11])


def holds(run):
    assert not run.collision


def test_search_with_an_ego_that_obeys_late_finds_when_a_careful_driver_avoids_a_collision():
    late = SimulatorWorld(Late, duration=20.0)
    found = explore(steady, holds=holds, world=late, runs=12, seed=1)
    assert any(each.expect.takeover for each in found.findings)


# Errors.


def broken(base=Bicycle, *, ads_hz=None, **members):
    return SimulatorWorld(type("Broken", (base,), members), ads_hz=ads_hz, duration=4.0)


def raising(self, controls):
    raise KeyError("wheel")


def half(self, controls):
    Bicycle.step(self, controls)
    self.cars[1][0] -= 0.1


def along(x, y):
    """Return a step in which vehicles drive along the vector that x and y return for a heading."""

    def step(self, controls):
        for car in self.cars:
            car[0] += car[3] * x(car[2]) / 15
            car[1] += car[3] * y(car[2]) / 15

    return step


def before(self, controls):
    self.last = [list(car) for car in self.cars]
    Bicycle.step(self, controls)


def stated(change):
    """Return a method that changes the rows that a simulator states."""
    return lambda self: [change(*car) for car in self.cars]


AT_START, AT_FIRST_TICK = "Broken.states, tick 0 after start", "Broken.states, tick 1"
ON_WAY = along(math.cos, math.sin)
WRONG = {
    "no ticks": ({"hz": 0}, "Broken.hz"),
    "too fast": ({"hz": 2000.0}, "Broken.hz"),
    "a text as a rate": ({"hz": "15"}, "Broken.hz"),
    "hz and dt": ({"hz": 20, "dt": 0.03}, "Broken.dt"),
    "milliseconds": ({"hz": 33.3, "dt": 30}, "Broken.dt"),
    "decisions between ticks": ({"hz": 1 / 0.03, "ads_hz": 10.0}, "ads_hz"),
    "more decisions than ticks": ({"hz": 15, "ads_hz": 20}, "ads_hz"),
    "decisions between ticks of a whole hz": ({"hz": 15, "ads_hz": 4}, "ads_hz"),
    "no rear axle": ({"reference": "rear axle"}, "Broken.rear_axle_offset"),
    "a rear axle of a centre": ({"rear_axle_offset": 1.4}, "Broken.rear_axle_offset"),
    "a negative offset": ({"reference": "rear axle", "rear_axle_offset": -1.4}, "Broken.rear_axle_offset"),
    "another point": ({"reference": "rear_axle"}, "Broken.reference"),
    "a number as a lane": ({"lanes": (1, 2)}, "Broken.lanes[0]"),
    "points twice": ({"lanes": (((0, 0), (9, 0), (9, 0)),)}, "Broken.lanes[0][2]"),
    "lanes as a text": ({"lanes": "four"}, "Broken.lanes"),
    "lanes from the right": ({"base": Ring, "lanes": Ring.lanes[::-1]}, "Broken.lanes[1]"),
    "lanes that overlap": ({"base": Ring, "lanes": [arc(400.0, 3.0, y=3.0 * number) for number in range(3)]},
                           "Broken.lane_width"),
    "lanes that are not parallel": ({"base": Ring, "lanes": [arc(100.0, 1.5), np.add(arc(100.0, 1.5), [0.0, 4.0])]},
                                    "Broken.lanes[1]"),
    "a narrow lane": ({"lane_width": 0.4}, "Broken.lane_width"),
    "no lane there": ({"start_lane": 7}, "Broken.start_lane"),
    "odd obstacles": ({"obstacles": ((1, 2),)}, "Broken.obstacles[0]"),
    "no headings": ({"headings": "north"}, "Broken.headings"),
    "no mapping": ({"to_dict": lambda self: [1]}, "Broken.to_dict()"),
    **{f"an attribute like {name}": ({wrong: True}, f"Broken.{wrong}") for name, wrong in (
        ("headings", "from_north"), ("speed_limit", "speed_limits"), ("reference", "at_front"),
    )},
    "too few rows": ({"states": lambda self: self.cars[1:]}, "Broken.states, tick 0"),
    "no numbers": ({"states": lambda self: [self.cars[0], [math.nan] * 4]}, "Broken.states, tick 0"),
    "another order": ({"states": lambda self: self.cars[::-1]}, AT_START),
    "degrees": ({"states": stated(lambda x, y, turn, speed: (x, y, math.degrees(turn) + 90.0, speed))}, AT_START),
    "headings from y": ({"states": stated(lambda x, y, turn, speed: (x, y, math.pi / 2 - turn, speed))}, AT_START),
    "km/h": ({"states": stated(lambda x, y, turn, speed: (x, y, turn, speed * 3.6))}, AT_START),
    "front bumper": ({"states": stated(lambda x, *others: (x + 2.5, *others))}, AT_START),
    "y to the left": ({"states": stated(lambda x, y, *others: (x, -y, *others))}, AT_START),
    "steps by a compass": ({"step": along(math.sin, math.cos)}, AT_FIRST_TICK),
    "steps with x to the north": ({"step": along(math.cos, lambda turn: -math.sin(turn)), "headings": "y to x",
                                   "y_is_left": True}, AT_FIRST_TICK),
    "steps in km/h": ({"step": along(lambda _: 1 / 3.6, math.sin)}, AT_FIRST_TICK),
    "steps of other ticks": ({"step": ON_WAY, "hz": 20}, AT_FIRST_TICK),
    "old states": ({"step": before, "states": lambda self: getattr(self, "last", self.cars)}, AT_FIRST_TICK),
    "an NPC at another place": ({"step": half, "moves_ego_only": True}, f"{AT_FIRST_TICK} after step"),
}  # fmt: skip
"""Statements of simulators, and what the error is about; each wrong name is in this file once, as in a user's class."""


@table(("members", "field"), WRONG.values())
def test_what_a_simulator_states_wrongly_is_refused_by_its_name(members, field):
    with refused(field):
        broken(**members).rollout(AHEAD, swerving)


class Client:
    """A class of somebody else's, whose other modules read this."""

    simulation_frequency = 20


def test_a_simulator_may_have_names_of_its_own_and_bases_whose_names_others_read():
    """Also names that are nearly those of statements, if its source reads them, or that are no words."""
    own = {"lane_widths": (4.0, 4.0), "colour": "red", "_speed_limit": 3.0, "lanes(": 2}
    broken(**own, obstacle=lambda self: self.lane_widths).check()
    SimulatorWorld(type("Connected", (Client, Bicycle), {}), duration=4.0).check()


def stuck():
    def wait(self, controls):
        while True:
            pass

    return SimulatorWorld(type("Stuck", (Bicycle,), {"step": wait}), duration=4.0, hang_limit=0.02)


def test_method_that_does_not_return_is_ended(monkeypatch):
    monkeypatch.setattr("pytest_pafot.world.guard.hang_guard.LEAST_FOR_WORLD", 0.2)
    with refused("Stuck.step, tick 1"):
        stuck().rollout(scenarios()[0], swerving)


def test_objects_and_policies_of_another_kind_are_refused():
    for given in (Bicycle(), 3, "toy"):
        with refused("simulator"):
            SimulatorWorld(given)
    blurred = Perception(Following, latency=0.5)
    for world, ads in ((TOY, IDMVehicle), (TOY, lambda env: None), (PEDALS, blurred)):
        with pytest.raises(AdsFactoryError):
            world.rollout(scenarios()[0], ads)


# Objects, processes and files.


class Counted(Bicycle):
    made, closed = [], []

    def __init__(self, name="plain"):
        self.name = name
        self.made.append(os.getpid())

    def close(self):
        self.closed.append(self.name)

    def to_dict(self):
        return {"name": self.name}


def test_runs_use_one_simulator_after_the_other_until_one_fails():
    Counted.made.clear()
    Counted.closed.clear()
    world = SimulatorWorld(partial(Counted, "own"), duration=2.0)
    for _ in range(3):
        world.rollout(scenarios()[0], Slowing)
    world.take_over(world.rollout(scenarios()[0], Slowing), 3, "careful-human")
    assert (len(Counted.made), Counted.closed) == (1, [])
    world.simulators._free[0].states = lambda: None
    with pytest.raises(WorldError):
        world.rollout(scenarios()[0], Slowing)
    assert Counted.closed == ["own"]
    world.rollout(scenarios()[0], Slowing)
    assert len(Counted.made) == 2


CLOSES = {"raises": raising, "hangs": lambda self: time.sleep(60)}


def closing(close):
    """Return a world whose simulators have this method."""
    return SimulatorWorld(partial(type("Counted", (Bicycle,), {"close": close})), duration=1.0)


@table("close", CLOSES.values())
def test_close_that_fails_is_a_warning_and_is_called_once(monkeypatch, close):
    monkeypatch.setattr("pytest_pafot.world.engines.simulation.CLOSING", 0.2)
    world = closing(close)
    world.rollout(scenarios()[0], Slowing)
    with pytest.warns(RuntimeWarning):
        Simulators.close_all()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Simulators.close_all()
        world.rollout(scenarios()[0], Slowing)
    with pytest.warns(RuntimeWarning):  # the run made another one
        Simulators.close_all()


def test_close_has_the_ten_seconds_that_its_page_promises(monkeypatch):
    limits, place = [], "pytest_pafot.world.engines.simulation.call_close"
    monkeypatch.setattr(place, lambda *given: limits.append(given[-1]))
    Simulators(Bicycle).give(Bicycle(), is_sound=False)
    assert limits == [10.0]


@pytest.mark.parametrize("action", ["error", "ignore"])
def test_exception_of_a_simulator_has_its_method_and_tick_and_no_close_that_fails_hides_it(
    recwarn, action
):
    failing = type("Failing", (Bicycle,), {"step": raising, "close": raising})
    with warnings.catch_warnings():
        warnings.simplefilter(action)
        with pytest.raises(KeyError, match="wheel") as caught:
            SimulatorWorld(failing, duration=1.0).rollout(scenarios()[0], Slowing)
    assert caught.value.__notes__[0].endswith(" Failing.step, tick 1")
    assert caught.value.__context__ is None
    assert len(recwarn) == (action == "error")


class Marking(Bicycle):
    def __init__(self, folder):
        self.folder = folder

    def close(self):
        (self.folder / str(os.getpid())).touch(exist_ok=False)


@pytest.mark.processes
@pytest.mark.parametrize("how", ["fork", "spawn"])
def test_a_process_of_multiprocessing_closes_its_own_simulators_at_its_end(tmp_path, how):
    """Such a process does not call the functions of ``atexit``; one that is forked has those of its parent, too."""
    world, given = (
        SimulatorWorld(partial(Marking, tmp_path), duration=1.0),
        (scenarios()[0], Slowing),
    )
    world.rollout(*given)
    process = multiprocessing.get_context(how).Process(target=world.rollout, args=given)
    process.start()
    process.join(60.0)
    assert [each.name for each in tmp_path.iterdir()] == [str(process.pid)]
    Simulators.close_all()
    assert len([*tmp_path.iterdir()]) == 2


OUTLIVES_ITS_MODULE = """
import sys
from pytest_pafot.world.engines import simulation

class Simulator:
    def close(self):
        print("closed")

sys.module, simulation.kept = simulation, simulation.Simulators(Simulator)
simulation.kept.give(simulation.kept.take())
"""


@pytest.mark.processes
def test_simulators_that_outlive_their_module_are_closed_once_at_the_end_of_python():
    """Python empties a module that something still refers to, and deletes what is in it one after the other."""
    command = [sys.executable, "-c", OUTLIVES_ITS_MODULE]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert (ended.stdout, ended.stderr) == ("closed\n", "")


def test_world_that_is_sent_to_a_process_makes_its_own_simulator():
    world = SimulatorWorld(Counted, duration=2.0)
    trace = world.rollout(scenarios()[0], Slowing)
    Counted.made.clear()
    again = pickle.loads(pickle.dumps(world))
    assert same(again.rollout(scenarios()[0], Slowing), trace)
    assert len(Counted.made) == 1


def test_file_names_the_class_of_a_simulator_and_what_it_states():
    world = SimulatorWorld(partial(Counted, "own"), duration=2.0)
    data = described(world)
    stated = {"simulator": {"name": "own"}, "physics_hz": 15, "lanes": 4, "duration": 2.0}
    assert (data["kind"], data["class"]) == ("own", "Counted")
    assert stated.items() <= data["data"].items()
    assert is_code(data)
    assert check_named_world(data, world) is world
    with pytest.raises(WorldError):
        check_named_world(data, TOY)


class Packaged(Bicycle):
    packages = ("pytest",)


def test_the_packages_of_a_simulator_are_among_the_versions_and_its_hz_follows_from_dt():
    assert SimulatorWorld(Bicycle).packages == ()
    assert SimulatorWorld(partial(Packaged)).packages == ("pytest",)
    assert installed_versions(SimulatorWorld(Packaged).packages)["pytest"] == pytest.__version__
    assert (Simulator.hz, type("Stating", (Simulator,), {"dt": 0.04}).hz) == (15, 25.0)


# Policies with observations and actions of the simulator's own.


class Pedals(Bicycle):
    """A simulator whose policy sees the gaps ahead and acts by steering and throttle from -1 to 1."""

    native = True

    def start(self, vehicles, seed):
        super().start(vehicles, seed)
        self.got = []

    def observe(self, hidden=None):
        x, y, _, speed = self.cars[0]
        shown = [each for number, each in enumerate(self.cars[1:]) if number != hidden]
        gaps = [other[0] - x for other in shown if abs(other[1] - y) < 2.0 and other[0] > x]
        return np.array([speed, min(gaps, default=99.0)], dtype=np.float32)

    def check_action(self, action):
        checked = np.asarray(action, dtype=np.float32)
        if checked.shape != (2,) or not (np.abs(checked) <= 1.0).all():
            raise ValueError(
                f"expected steering and throttle, from -1 to 1, received {action!r:.60}"
            )
        return checked

    def step(self, controls):
        self.got.append(controls)
        super().step(controls)

    def wheels(self, control):
        return super().wheels(control) if control.action is None else 0.5 * float(control.action[0])

    def gas(self, control):
        return super().gas(control) if control.action is None else 6.0 * float(control.action[1])


class Blind(Pedals):
    """The same, but no vehicle can be hidden from its policy."""

    def observe(self):
        return super().observe()


class Following:
    """A policy that uses its array again, and brakes too late."""

    def __init__(self):
        self.action = np.zeros(2, dtype=np.float32)

    def __call__(self, seen):
        speed, gap = seen
        self.action[1] = -0.5 if gap < 12.0 else float(np.clip((26.0 - speed) / 6.0, -1.0, 1.0))
        return self.action


PEDALS = SimulatorWorld(Pedals, duration=20.0)
SLOWER = Scenario(npcs=((PositionInstruction(2, 8.0),) * 2,), gene_seconds=5.0)


def test_policy_of_a_native_simulator_sees_and_does_what_the_simulator_says():
    seen = []

    def policy():
        following = Following()
        return lambda observation: (seen.append(observation), following(observation))[1]

    trace, got = PEDALS.rollout(SLOWER, policy), PEDALS.simulators._free[0].got
    first = trace.states[0]
    driven = 22.0 + np.cumsum([6.0 * ego.action[1] for ego, _ in got]) / 15
    assert trace.collision is not None
    assert seen[0].tolist() == [22.0, pytest.approx(first[1, 0] - first[0, 0])]
    assert np.array_equal(trace.actions, [controls[0].action for controls in got[::3]])
    assert len(trace.actions) == len(seen)
    assert trace.states[1:, 0, 3] == pytest.approx(driven, abs=1e-5)
    controls = {(ego.acceleration, ego.steering, npc.action) for ego, npc in got}
    assert controls == {(0.0, 0.0, None)}
    assert min(npc.acceleration for _, npc in got) < -1.0


def same_native(one, other):
    same_states = one.states.tobytes() == other.states.tobytes()
    return same_states and np.array_equal(one.actions, other.actions)


def test_run_of_a_native_policy_repeats_by_its_decisions_to_the_bit():
    trace = PEDALS.rollout(SLOWER, Following)
    assert same_native(PEDALS.rollout(SLOWER, Following), trace)
    for policy, decisions in ((lambda: pytest.fail, trace.actions), (Following, trace.actions[:9])):
        again = PEDALS.rollout(trace.executed, policy, decisions=decisions)
        assert same_native(again, trace)


def test_careful_driver_takes_over_from_a_native_policy_by_acceleration_and_steering():
    trace = PEDALS.rollout(SLOWER, Following)
    for tick in (0, 20, 31):
        taken = PEDALS.take_over(trace, tick, "careful-human")
        got = [controls[0] for controls in PEDALS.simulators._free[0].got]
        is_taken = [each.action is None for each in got]
        assert np.array_equal(taken.states[: tick + 1], trace.states[: tick + 1])
        assert is_taken == [number >= tick for number in range(len(got))]
        assert min(each.acceleration for each in got[tick:]) < -2.0
        assert taken.collision is None
    assert same(*(world.rollout_reference(SLOWER, "careful-human") for world in (PEDALS, TOY)))


def answering(value):
    return lambda: lambda seen: value


PLAIN = type("Plain", (Pedals,), {"check_action": Simulator.check_action})
"""A simulator that accepts all actions."""
NO_ACTIONS = {
    "no return": (Pedals, None),
    "too much": (Pedals, (0.0, 3.0)),
    "no numbers": (Pedals, "left"),
    "an object": (Pedals, Following),
    "no return, without a check": (PLAIN, None),
}


def error_of_policy(simulator, action):
    return SimulatorWorld(simulator, duration=2.0).rollout(SLOWER, answering(action)).error


@table(("simulator", "action"), NO_ACTIONS.values())
def test_what_is_no_action_of_a_native_simulator_is_an_error_of_the_policy(simulator, action):
    error = error_of_policy(simulator, action)
    assert (error.kind, error.tick) == ("BadAction", 0)


def test_any_action_may_be_one_of_a_native_simulator():
    plain = SimulatorWorld(PLAIN, duration=2.0)
    pair = plain.rollout(SLOWER, answering((0.0, -0.5)))
    assert pair.actions[0] == (0.0, -0.5)
    assert not is_si(pair.actions[0])
    taken = plain.take_over(pair, 20, "careful-human")
    assert taken.states[:21].tobytes() == pair.states[:21].tobytes()


WRONG_NATIVE = {
    "check_action without a return": ({"check_action": lambda self, action: None}, "Broken.check_action"),
    "no observe": ({"observe": Simulator.observe}, "Broken.observe"),
    "native as a number": ({"native": 1}, "Broken.native"),
}  # fmt: skip


def test_native_simulator_that_is_wrong_is_no_error_of_the_policy():
    for members, field in WRONG_NATIVE.values():
        with refused(field):
            broken(Pedals, **members).rollout(SLOWER, Following)
    with pytest.raises(TypeError):
        broken(Pedals, observe=raising).rollout(SLOWER, Following)


@table(("simulator", "since", "tick"), [(Bicycle, 1.0, 18), (Pedals, -1.0, 0)])
def test_decision_that_hangs_ends_the_run_and_not_the_simulator(simulator, since, tick):
    def hangs(seen):
        while getattr(seen, "time", 0.0) > since:
            pass
        return 0.0, 0.0

    world = SimulatorWorld(simulator, hang_limit=0.1)
    trace = world.rollout(scenarios()[0], lambda: hangs)
    assert (trace.outcome, trace.error.tick) == (Outcome.HANG, tick)


@table(("simulator", "can_hide"), [(Pedals, True), (Blind, False)])
def test_finding_of_a_native_policy_has_a_takeover_a_moment_and_decisions(simulator, can_hide):
    world = SimulatorWorld(simulator, duration=20.0)
    found = explore(Following, holds=holds, world=world, runs=20, seed=1)
    moment = found.sightings[0].moment
    assert found.findings[0].expect.takeover
    assert moment.npc == 0
    assert moment.action.startswith("[0, ")
    hides = bool(moment.seen), bool(moment.was), moment.hidden is not None
    assert hides == (can_hide, not can_hide, can_hide)
