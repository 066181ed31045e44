"""A simulator of the user's as a world: its runs, its units and axes, its road, its files and its errors."""

import math
import multiprocessing
import os
import pickle
import random
import re
import subprocess
import sys
import time
import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

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
            ahead = self.ahead(length)
            along_x, along_y = self.way(heading)
            stated = math.degrees(heading) % 360.0 if self.says("degrees") else heading
            rows.append([x + ahead * along_x, y + ahead * along_y, stated, speed])
        return rows


BEHIND = ((PositionInstruction(6, 0.0),),)
"""An NPC that stays behind."""

TOY = SimulatorWorld(Bicycle, duration=20.0)
HIGHWAY = Highway(duration=20.0)


def swerving():
    """Return an ADS that steers and brakes by numbers and by Drives in turn."""

    def decide(seen):
        if int(seen.time) % 4 < 2:
            return LaneCommand(
                lane=min(seen.ego.lane + int(seen.time) % 2, 3), speed=20.0 - seen.time / 2
            )
        return 1.5 - seen.time / 4, 0.004 * math.sin(seen.time)

    return decide


def scenarios():
    cells = tuple(
        PositionInstruction(cell, speed) for cell, speed in ((2, 10.0), (3, 24.0), (4, 19.0))
    )
    lanes = tuple(
        LaneInstruction(lane, speed)
        for lane, speed in (("left", 12.0), ("keep", 26.0), ("right", 5.0))
    )
    common = {"gene_seconds": 4.0, "ego_lane": 1}
    return [
        Scenario(npcs=(cells, lanes), **common),
        Scenario(
            npcs=(lanes, cells, lanes[::-1]),
            traffic="everyday",
            vehicles=("truck", "car", "motorcycle"),
            **common,
        ),
        Scenario(npcs=(lanes[1:], cells), ego_speed=17.0, seed=5, **common),
    ]


def same(one, other):
    """Return whether two runs have the same states, decisions and end, to the last bit."""
    return (
        np.array_equal(one.states, other.states)
        and (one.outcome, one.collision, one.actions)
        == (other.outcome, other.collision, other.actions)
        and (one.arrivals, one.executed) == (other.arrivals, other.executed)
    )


@pytest.mark.parametrize("scenario", scenarios(), ids=["mixed", "vehicles", "slow"])
def test_simulator_with_the_same_physics_drives_the_runs_of_a_highway_to_the_bit(scenario):
    in_toy, on_highway = TOY.rollout(scenario, swerving), HIGHWAY.rollout(scenario, swerving)
    assert same(in_toy, on_highway)
    tick, name = on_highway.ticks // 2, "careful-human"
    assert same(TOY.take_over(in_toy, tick, name), HIGHWAY.take_over(on_highway, tick, name))
    assert same(
        TOY.rollout_reference(scenario, "careful-human"),
        HIGHWAY.rollout_reference(scenario, "careful-human"),
    )
    first = on_highway.actions[:7]
    repeated = (
        world.rollout(scenario, lambda: lambda _: (0.5, 0.0), decisions=first)
        for world in (TOY, HIGHWAY)
    )
    assert same(*repeated)


def test_search_on_a_road_of_one_lane_needs_no_arguments():
    single = SimulatorWorld(type("Single", (Bicycle,), {"lanes": 1}), duration=20.0)
    found = explore(lambda: lambda _: (1.0, 0.0), holds=holds, world=single, runs=6, seed=1)
    assert {row["ego_lane"] for row in found.runs} == {0}
    assert {row["npcs"] for row in found.runs} == {1}
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
        assert (
            SimulatorWorld(type("Other", (Bicycle,), given | stated)).rules.obstacles
            == given["obstacles"]
        )


@table("begin", {
    "elsewhere": (300.0, -50.0, 0.0),
    "to the north": (10.0, 20.0, -math.pi / 2),
    "at an angle": (-90.0, 7.0, 2.5),
}.values())  # fmt: skip
def test_straight_lanes_in_any_direction_are_the_straight_road(begin):
    x0, y0, turn = begin

    class Turned(Bicycle):
        lanes = tuple(
            tuple(
                (
                    x0 + x * math.cos(turn) - y * math.sin(turn),
                    y0 + x * math.sin(turn) + y * math.cos(turn),
                )
                for x in (0.0, 2000.0)
            )
            for y in (0.0, 4.0, 8.0, 12.0)
        )

    world = SimulatorWorld(Turned, duration=20.0)
    there, here = world.rollout(scenarios()[1], swerving), HIGHWAY.rollout(scenarios()[1], swerving)
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
    network = network_of([np.asarray(line) for line in Ring.lanes], LANE, 26.8)
    for (_, _, number), lane in network.lanes_dict().items():
        assert lane.radius == pytest.approx(400.0 - 4.0 * number, rel=3e-3)
        assert np.hypot(*(lane.center - np.array([0.0, 400.0]))) == pytest.approx(0.0, abs=1.3)
        assert np.hypot(
            *(lane.position(lane.length / 2, 0) - np.array([0.0, 400.0]))
        ) == pytest.approx(400.0 - 4.0 * number, abs=5e-3)


def test_ego_that_keeps_its_lane_stays_on_its_circle():
    trace = RING.rollout(
        Scenario(npcs=BEHIND, ego_lane=1, ego_speed=20.0, gene_seconds=20.0),
        lambda: lambda _: LaneCommand(lane=1, speed=20.0),
    )
    away = np.hypot(trace.states[:, 0, 0], trace.states[:, 0, 1] - 400.0)
    assert trace.outcome is Outcome.COMPLETED
    assert away == pytest.approx(396.0, abs=0.1)
    assert np.abs(trace.track[:, 0, 3]).max() < 0.1
    assert trace.track[-1, 0, 0] - trace.track[0, 0, 0] == pytest.approx(20.0 * 20.0, rel=0.01)


def test_take_over_repeats_a_run_in_a_bend_to_the_bit():
    scenario = Scenario(npcs=((PositionInstruction(2, 15.0),),), ego_lane=1, ego_speed=20.0)
    trace = RING.rollout(scenario, swerving)
    taken = RING.take_over(trace, trace.ticks // 2, "careful-human")
    assert np.array_equal(
        taken.states[: trace.ticks // 2 + 1], trace.states[: trace.ticks // 2 + 1]
    )
    again = RING.rollout(scenario, lambda: pytest.fail, decisions=trace.actions)
    assert same(again, trace)


def test_lane_that_ends_is_no_lane_further_on():
    class Merging(Bicycle):
        lanes = (((0.0, 0.0), (900.0, 0.0)), ((0.0, 4.0), (400.0, 4.0)))

    road = SimulatorWorld(Merging, duration=20.0).road
    assert (road.lane_count, road.has_lane(1, 300.0), road.has_lane(1, 500.0)) == (2, True, False)


def test_short_straight_road_ends_runs_where_it_ends():
    class Short(Bicycle):
        lanes, length = 2, 400.0

    world = SimulatorWorld(Short)
    trace = world.rollout(
        Scenario(npcs=BEHIND, ego_lane=0, ego_speed=22.0, gene_seconds=30.0),
        lambda: lambda _: (0.0, 0.0),
    )
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
    class Spiral(Bicycle):
        lanes = tuple(spiral(away) for away in (0.0, 4.0, 8.0))
        start_lane, start_speed = 1, 20.0

    world = SimulatorWorld(Spiral, duration=20.0)
    assert world.road.lane_count == 3
    trace = world.rollout(
        Scenario(npcs=BEHIND, ego_lane=1, ego_speed=20.0, gene_seconds=20.0),
        lambda: lambda seen: LaneCommand(lane=2 if seen.time > 5.0 else 1, speed=20.0),
    )
    assert trace.outcome is Outcome.COMPLETED
    assert trace.states[-1, 0, 6] == 2  # its lane


def test_lanes_from_the_right_or_that_overlap_are_refused():
    for lanes, field, received in (
        (Ring.lanes[::-1], "lanes[1]", "a lane 4.0 m to the left of the previous lane"),
        ([arc(400.0, 3.0, y=3.0 * number) for number in range(3)], "lane_width", "4.00 m"),
        (
            [[(x, y + across) for x, y in arc(100.0, 1.5)] for across in (0.0, 4.0)],
            "lanes[1]",
            "a lane that is",
        ),
    ):
        with pytest.raises(WorldError) as error:
            SimulatorWorld(type("Odd", (Ring,), {"lanes": lanes})).check()
        assert error.value.field == f"Odd.{field}"
        assert error.value.received.startswith(received)


# Ticks, which may be no whole number per second.


class Ticks(Bicycle):
    """The same in ticks of 30 ms, with headings that turn around once per tick."""

    dt, hz = 0.03, 1 / 0.03

    def states(self):
        return [
            (*row[:2], row[2] + 2 * math.pi * round(row[0] / self.dt), row[3])
            for row in super().states()
        ]


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
    assert (world.physics_hz, world.rules.ads_hz) == rates
    assert [type(each) is int for each in (world.physics_hz, world.rules.ads_hz)] == [
        type(e) is int for e in rates
    ]


def test_hz_of_a_simulator_that_states_dt_follows_from_it():
    class Stating(Simulator):
        dt = 0.04

    assert (Simulator.hz, Stating.hz) == (15, 25.0)


@table(("members", "ads_hz", "message"), {
    "both": ({"hz": 20, "dt": 0.03}, None,
             r"Broken.dt: expected 1 / hz = 0.05 s, received 0.03 s. Set either dt or hz"),
    "milliseconds": ({"hz": 33.3, "dt": 30}, None, r"Broken.dt: expected a number from 0.001 to 0.2 seconds, rec"),
    "too fast": ({"hz": 2000.0}, None, r"Broken.hz: expected a number from 5 to 1000, received 2000"),
    "a text": ({"hz": "15"}, None, r"Broken.hz: expected a number from 5 to 1000, received '15'"),
    "decisions between ticks": ({"hz": 1 / 0.03}, 10.0, r"ads_hz: expected a rate that divides Broken's 33.3333 ticks "
                                r"per second, received 10. Use 11.1111 or 8.33333"),
    "more decisions than ticks": ({"hz": 15}, 20, r"received 20. Use 15$"),
    "decisions between ticks of a whole hz": ({"hz": 15}, 4, r"received 4. Use 5 or 3.75"),
    "no rear axle": ({"reference": "rear axle"}, None, r"Broken.rear_axle_offset: expected the distance .*, because "
                     r"reference = 'rear axle', received None. Write, for example, rear_axle_offset = 1.4"),
    "a rear axle of a centre": ({"rear_axle_offset": 1.4}, None, r"rear_axle_offset: expected None, because reference "
                                r"= 'centre', received 1.4. Remove it, or set reference = 'rear axle'"),
    "a negative offset": ({"reference": "rear axle", "rear_axle_offset": -1.4}, None, r"from 0.1 to 20 metres"),
    "another point": ({"reference": "rear_axle"}, None,
                      r"Broken.reference: expected one of 'centre', 'front', 'rear axle', received 'rear_axle'"),
}.values())  # fmt: skip
def test_rates_and_points_that_do_not_fit_are_refused_with_what_does(members, ads_hz, message):
    world = replace(broken(**members), ads_hz=ads_hz)
    with pytest.raises(WorldError, match=message):
        world.check()


@table(
    "lanes",
    [Ticks.lanes, [[(x, 4.0 * lane) for x in range(0, 900, 100)] for lane in range(3)], Ring.lanes],
)
def test_search_in_ticks_of_30_ms_saves_files_that_replay_to_the_bit(lanes):
    world = SimulatorWorld(type("Ticks", (Ticks,), {"lanes": lanes}), duration=20.0)
    found = explore(lambda: lambda _: (0.0, 0.0), holds=holds, world=world, runs=6, seed=1)
    assert {row["gene_seconds"] for row in found.runs} <= {2.01, 3.0, 3.99}
    assert found.findings
    for each, sighting in zip(found.findings, found.sightings, strict=True):
        saved = parsed(Path(f"{each.id}.pafot.yaml"), text_of(each).encode())
        assert (saved.scenario, saved.world) == (each.scenario, each.world)
        again = check_named_world(saved.world, world).rollout(
            saved.scenario, lambda: lambda _: (0.0, 0.0)
        )
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
    for scenario in scenarios():
        steady = lambda: lambda _: (0.0, 0.0)  # noqa: E731  (what takes effect late is the same then)
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
    found = explore(
        lambda: lambda _: (0.0, 0.0),
        holds=holds,
        world=SimulatorWorld(Late, duration=20.0),
        runs=12,
        seed=1,
    )
    assert any(each.expect.takeover for each in found.findings)


def test_npc_that_is_not_put_in_its_place_is_refused():
    world = SimulatorWorld(
        type("Own", (Bicycle,), {"moves_ego_only": True, "hz": 15, "step": half}), duration=4.0
    )
    with pytest.raises(
        WorldError, match=r"Own.states, tick 1 after step: expected x = .* for NPC 0"
    ):
        world.rollout(Scenario(npcs=((PositionInstruction(2, 10.0),),)), swerving)


def half(self, controls):
    Bicycle.step(self, controls)
    self.cars[1][0] -= 0.1


# Errors.


def broken(**members):
    return SimulatorWorld(type("Broken", (Bicycle,), members), duration=4.0)


def raising(self, controls):
    raise KeyError("wheel")


@table(("members", "message"), {
    "no ticks": ({"hz": 0}, r"Broken.hz: expected a number from 5 to 1000, received 0"),
    "a number as a lane": ({"lanes": (1, 2)}, r"Broken.lanes\[0\]: expected at least two points \(x, y\)"),
    "points twice": ({"lanes": (((0, 0), (9, 0), (9, 0)),)},
     r"Broken.lanes\[0\]\[2\]: .* at least 1 mm from the previous point, received a closer"),
    "a narrow lane": ({"lane_width": 0.4}, r"Broken.lane_width: expected a number from 2 to 10"),
    "no lane there": ({"start_lane": 7}, r"Broken.start_lane: expected a whole number from 0 to 3"),
    "odd obstacles": ({"obstacles": ((1, 2),)},
     r"Broken.obstacles\[0\]: expected five numbers: the x, y, heading, length and width"),
    "too few rows": ({"states": lambda self: self.cars[1:]}, r"Broken.states, tick 0: expected .* shape \(2, 4\)"),
    "no numbers": ({"states": lambda self: [self.cars[0], [math.nan] * 4]},
                   r"Broken.states, tick 0: expected finite numbers, received x = nan for NPC 0"),
    "another order": ({"states": lambda self: self.cars[::-1]},
     r"Broken.states, tick 0 after start: expected x = 200.00 m for the ego"),
    "lanes as a text": ({"lanes": "four"},
     r"Broken.lanes: expected a list or tuple of centre lines, or a number of lanes"),
    "no headings": ({"headings": "north"}, r"Broken.headings: expected one of 'x to y', 'x to -y', 'y to -x'"),
    "no mapping": ({"to_dict": lambda self: [1]}, r"Broken.to_dict\(\): expected a dict with the arguments of the"),
    "degrees": ({"states": lambda self: [(*car[:2], math.degrees(car[2]) + 90.0, car[3]) for car in self.cars]},
                r"tick 0 after start: expected heading = 0.00 rad for the ego.* states returned .*, heading = 90,"),
    "headings from y": ({"states": lambda self: [(*car[:2], math.pi / 2 - car[2], car[3]) for car in self.cars]},
     r"expected heading = 0.00 rad for the ego.* received 1.57 rad. .* start received .* heading = 0, .* = 1.5708,"),
    "km/h": ({"states": lambda self: [(*car[:3], car[3] * 3.6) for car in self.cars]},
             r"expected speed = 22.00 m/s for the ego.* received .* = 22, and states returned .* = 79.2. To find"),
    "front bumper": ({"states": lambda self: [(car[0] + 2.5, *car[1:]) for car in self.cars]},
     r"expected x = 200.00 m for the ego.* received 202.50 m. .* received x = 200, .* states returned x = 202.5,"),
    "y to the left": ({"states": lambda self: [(x, -y, heading, speed) for x, y, heading, speed in self.cars]},
     r"expected y = 4.00 m for the ego.* start received x = 200, y = 4, .* states returned x = 200, y = -4,"),
}.values())  # fmt: skip
def test_what_a_simulator_states_wrongly_is_refused_by_its_name(members, message):
    with pytest.raises(WorldError, match=message):
        broken(**members).rollout(Scenario(npcs=((PositionInstruction(2, 10.0),),)), swerving)


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("from_north", 'headings = "y to x"'),
        ("speed_limits", "speed_limit"),
        ("at_front", 'reference = "front"'),
    ],
)
def test_a_statement_under_a_wrong_name_is_refused_with_the_right_one(name, write):
    """Each name is in this file once, as it would be in a user's class."""
    with pytest.raises(
        WorldError,
        match=rf"Broken\.{name}: .* attribute without effect. Write {write}, or rename it to _{name} ",
    ):
        broken(**{name: True}).check()


def test_a_simulator_may_have_names_of_its_own():
    """Also ones that are nearly those of statements, if its source reads them."""
    broken(
        lane_widths=(4.0, 4.0),
        colour="red",
        _speed_limit=3.0,
        obstacle=lambda self: self.lane_widths,
    ).check()


class Client:
    """A class of somebody else's, whose other modules read this."""

    simulation_frequency = 20


def test_a_simulator_may_have_bases_whose_names_others_read():
    SimulatorWorld(type("Connected", (Client, Bicycle), {}), duration=4.0).check()


def test_a_name_that_is_no_word_is_one_of_the_users_own():
    broken(**{"lanes(": 2}).check()


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


@table(("members", "received"), {
    "a compass": ({"step": along(math.sin, math.cos)},
                  r"90 degrees off that direction. Are hz, the units and the axes correct"),
    "x to the north": ({"step": along(math.cos, lambda turn: -math.sin(turn)), "headings": "y to x", "y_is_left": True},
                       r"90 degrees off that direction. Are hz, the units and the axes correct"),
    "km/h": ({"step": along(lambda _: 1 / 3.6, math.sin)},
             r"0.41 m, 0 degrees off that direction. Are hz, the units and the axes"),
    "other ticks": ({"hz": 20}, r"0 degrees off that direction. Are hz, the units and the axes correct"),
    "old states": ({"step": before, "states": lambda self: getattr(self, "last", self.cars)},
                   r"0.00 m, .* states\(\) return the states after the step\?.* pytest_pafot.testing.check_world"),
}.values())  # fmt: skip
def test_vehicles_that_drive_elsewhere_than_they_head_are_refused_at_the_first_tick(
    members, received
):
    members = {"step": along(math.cos, math.sin), **members}
    told = rf"Broken.states, tick 1: expected the ego to move .* m in the direction of its heading, .*{received}"
    with pytest.raises(WorldError, match=told):
        broken(**members).rollout(Scenario(npcs=((PositionInstruction(2, 10.0),),)), swerving)


def test_exception_of_a_simulator_names_its_method_and_its_tick():
    with pytest.raises(KeyError, match="wheel") as error:
        broken(step=raising).rollout(scenarios()[0], swerving)
    assert error.value.__notes__ == ["raised by Broken.step, tick 1"]


def test_method_that_does_not_return_is_ended(monkeypatch):
    monkeypatch.setattr("pytest_pafot.world.guard.hang_guard.LEAST_FOR_WORLD", 0.2)

    def wait(self, controls):
        while True:
            pass

    world = SimulatorWorld(type("Stuck", (Bicycle,), {"step": wait}), duration=4.0, hang_limit=0.02)
    with pytest.raises(
        WorldError, match=r"Stuck.step, tick 1: expected a return within 0.2 s, received none"
    ):
        world.rollout(scenarios()[0], swerving)


def test_decision_that_hangs_ends_the_run_and_not_the_simulator():
    def hangs(seen):
        while seen.time > 1.0:
            pass
        return 0.0, 0.0

    trace = SimulatorWorld(Bicycle, hang_limit=0.1).rollout(scenarios()[0], lambda: hangs)
    assert (trace.outcome, trace.error.tick) == (Outcome.HANG, 18)


@table("given", ["class", "env"])
def test_ads_of_another_kind_is_refused(given):
    from highway_env.vehicle.behavior import IDMVehicle

    with pytest.raises(
        AdsFactoryError, match=r"expected a callable that turns a pafot\.Observation"
    ):
        TOY.rollout(scenarios()[0], IDMVehicle if given == "class" else lambda env: None)


@table("given", [Bicycle(), 3, "toy"])
def test_object_instead_of_a_class_is_refused_with_what_to_write(given):
    with pytest.raises(
        WorldError, match=r"simulator: expected a subclass .* Write pafot.SimulatorWorld\("
    ):
        SimulatorWorld(given)


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


@table(("close", "message"), {
    "raises": (raising, r"Counted.close: expected no exception, received TypeError"),
    "hangs": (lambda self: time.sleep(60), r"Counted.close: expected a call that returns within 0.2 s"),
}.values())  # fmt: skip
def test_close_that_fails_is_a_warning_and_is_called_once(monkeypatch, close, message):
    monkeypatch.setattr("pytest_pafot.world.engines.simulation.CLOSING", 0.2)
    world = SimulatorWorld(partial(type("Counted", (Bicycle,), {"close": close})), duration=1.0)
    world.rollout(scenarios()[0], Slowing)
    with pytest.warns(RuntimeWarning, match=message):
        Simulators.close_all()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Simulators.close_all()
        world.rollout(scenarios()[0], Slowing)
    with pytest.warns(RuntimeWarning, match=message):  # the run made another one
        Simulators.close_all()


def test_close_has_the_ten_seconds_that_its_page_promises(monkeypatch):
    limits = []
    monkeypatch.setattr(
        "pytest_pafot.world.engines.simulation.call_close", lambda *given: limits.append(given[-1])
    )
    Simulators(Bicycle).give(Bicycle(), is_sound=False)
    assert limits == [10.0]


@pytest.mark.parametrize("action", ["error", "ignore"])
def test_close_that_fails_never_hides_the_error_of_the_run(recwarn, action):
    failing = type("Failing", (Bicycle,), {"step": raising, "close": raising})
    with warnings.catch_warnings():
        warnings.simplefilter(action)
        with pytest.raises(KeyError, match="wheel") as caught:
            SimulatorWorld(failing, duration=1.0).rollout(scenarios()[0], Slowing)
    assert caught.value.__notes__ == ["raised by Failing.step, tick 1"]
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
    world = SimulatorWorld(partial(Marking, tmp_path), duration=1.0)
    world.rollout(scenarios()[0], Slowing)
    process = multiprocessing.get_context(how).Process(
        target=world.rollout, args=(scenarios()[0], Slowing)
    )
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
    assert (data["kind"], data["class"], data["data"]["simulator"]) == (
        "own",
        "Counted",
        {"name": "own"},
    )
    assert (data["data"]["physics_hz"], data["data"]["lanes"], data["data"]["duration"]) == (
        15,
        4,
        2.0,
    )
    assert is_code(data)
    assert check_named_world(data, world) is world
    with pytest.raises(WorldError, match="a simulator of the class Counted"):
        check_named_world(data, TOY)


class Packaged(Bicycle):
    packages = ("pytest",)


def test_the_packages_of_a_simulator_are_among_the_versions():
    assert SimulatorWorld(Bicycle).packages == ()
    assert SimulatorWorld(partial(Packaged)).packages == ("pytest",)
    assert installed_versions(SimulatorWorld(Packaged).packages)["pytest"] == pytest.__version__


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
    assert trace.collision is not None
    assert seen[0].tolist() == [22.0, pytest.approx(trace.states[0, 1, 0] - trace.states[0, 0, 0])]
    assert np.array_equal(trace.actions, [controls[0].action for controls in got[::3]])
    assert len(trace.actions) == len(seen)
    assert trace.states[1:, 0, 3] == pytest.approx(
        22.0 + np.cumsum([6.0 * c[0].action[1] for c in got]) / 15, abs=1e-5
    )
    assert {(c[0].acceleration, c[0].steering, c[1].action) for c in got} == {(0.0, 0.0, None)}
    assert min(controls[1].acceleration for controls in got) < -1.0


def same_native(one, other):
    return one.states.tobytes() == other.states.tobytes() and np.array_equal(
        one.actions, other.actions
    )


def test_run_of_a_native_policy_repeats_by_its_decisions_to_the_bit():
    trace = PEDALS.rollout(SLOWER, Following)
    assert same_native(PEDALS.rollout(SLOWER, Following), trace)
    again = PEDALS.rollout(trace.executed, lambda: pytest.fail, decisions=trace.actions)
    assert same_native(again, trace)
    resumed = PEDALS.rollout(trace.executed, Following, decisions=trace.actions[:9])
    assert same_native(resumed, trace)


def test_careful_driver_takes_over_from_a_native_policy_by_acceleration_and_steering():
    trace = PEDALS.rollout(SLOWER, Following)
    for tick in (0, 20, 31):
        taken = PEDALS.take_over(trace, tick, "careful-human")
        got = [controls[0] for controls in PEDALS.simulators._free[0].got]
        assert np.array_equal(taken.states[: tick + 1], trace.states[: tick + 1])
        assert [each.action is None for each in got] == [
            number >= tick for number in range(len(got))
        ]
        assert min(each.acceleration for each in got[tick:]) < -2.0
        assert taken.collision is None
    reference = PEDALS.rollout_reference(SLOWER, "careful-human")
    assert same(reference, TOY.rollout_reference(SLOWER, "careful-human"))


def answering(value):
    return lambda: lambda seen: value


@table(("action", "message"), {
    "no return": (None, "expected an action for Pedals.step, received None; is a `return` missing?"),
    "too much": ((0.0, 3.0), "expected steering and throttle, from -1 to 1, received (0.0, 3.0)"),
    "no numbers": ("left", "could not convert string to float: 'left'"),
    "an object": (Following, "Pedals.check_action(<class 'tests.world.test_simulator.Following'>): TypeError: float() "
                             "argument must be a string or a real number, not 'type'"),
}.values())  # fmt: skip
def test_what_is_no_action_of_a_native_simulator_is_an_error_of_the_policy(action, message):
    error = PEDALS.rollout(SLOWER, answering(action)).error
    assert (error.kind, error.message, error.tick) == ("BadAction", message, 0)


def test_simulator_that_accepts_all_actions_still_refuses_none():
    plain = SimulatorWorld(
        type("Plain", (Pedals,), {"check_action": Simulator.check_action}), duration=2.0
    )
    assert plain.rollout(SLOWER, answering(None)).error.message.startswith(
        "expected an action for Plain.step, "
    )
    pair = plain.rollout(SLOWER, answering((0.0, -0.5)))
    assert pair.actions[0] == (0.0, -0.5)
    assert not is_si(pair.actions[0])
    assert (
        plain.take_over(pair, 20, "careful-human").states[:21].tobytes()
        == pair.states[:21].tobytes()
    )


@table(("members", "error", "message"), {
    "check_action without a return": ({"check_action": lambda self, action: None}, WorldError,
        r"Odd.check_action: expected the method to return the action, received None. Is a `return` missing\?"),
    "observe that fails": ({"observe": raising}, TypeError, "missing 1 required positional argument"),
    "no observe": ({"observe": Simulator.observe}, WorldError, "Odd.observe: expected a method, because native is"),
    "native as a number": ({"native": 1}, WorldError, "Odd.native: expected True or False, received 1"),
}.values())  # fmt: skip
def test_native_simulator_that_is_wrong_is_no_error_of_the_policy(members, error, message):
    with pytest.raises(error, match=message):
        SimulatorWorld(type("Odd", (Pedals,), members), duration=2.0).rollout(SLOWER, Following)


def test_policy_of_a_native_simulator_has_no_imperfect_sight():
    with pytest.raises(AdsFactoryError, match="a policy that uses an environment's observations"):
        PEDALS.rollout(SLOWER, Perception(Following, latency=0.5))


def test_decision_of_a_native_policy_that_hangs_ends_the_run():
    def hangs(seen):
        while True:
            pass

    trace = SimulatorWorld(Pedals, hang_limit=0.1).rollout(SLOWER, lambda: hangs)
    assert (trace.outcome, trace.error.tick) == (Outcome.HANG, 0)


@table(("simulator", "told"), {
    "a vehicle can be hidden": (Pedals, r"saw NPC 0 \(.* ahead.*\) and chose \[0, .*with NPC 0 hidden, it chose \["),
    "no vehicle can be hidden": (Blind, r"^At .* s, NPC 0 was .* m ahead, .* slower, and the policy chose \[0, "),
}.values())  # fmt: skip
def test_finding_of_a_native_policy_has_a_takeover_a_moment_and_decisions(simulator, told):
    world = SimulatorWorld(simulator, duration=20.0)
    found = explore(Following, holds=holds, world=world, runs=20, seed=1)
    assert found.findings
    first = found.findings[0]
    assert first.expect.takeover
    assert re.search(told, str(found.sightings[0].moment))
