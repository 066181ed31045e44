"""The grid on every road of highway-env: cells, limits, ends of a run, and the same run by ``env.step``."""

from __future__ import annotations

import copy
import itertools
import math
from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest
from highway_env.envs.merge_env import MergeEnv
from highway_env.road.lane import CircularLane, StraightLane
from highway_env.vehicle.controller import ControlledVehicle

from pytest_pafot import criticality
from pytest_pafot.algorithms import sample
from pytest_pafot.findings.finding import disagreement
from pytest_pafot.model.instructions import LaneInstruction, PositionInstruction, ScenarioError
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import ALONG, HEADING, LANE, OFFSET, SPEED, Outcome, X, Y
from pytest_pafot.model.vehicle_type import STYLES
from pytest_pafot.oracle.run import Run
from pytest_pafot.world import World
from pytest_pafot.world.roads.road import StraightRoad
from tests.helpers.refusals import refused
from tests.helpers.road_cases import ROADS, OwnEnvironment, space_of, violations, world_of
from tests.helpers.stages import mostly_oracle, oracle
from tests.helpers.tables import table
from tests.helpers.world_cases import idm


def hold(world, *cells, speed=8.0, genes=1, **fields):
    """Return NPCs that stay in one cell each, from the environment's own start, in genes that share a run."""
    lane, ego_speed = world.start
    seconds = math.floor(world.longest_run * world.physics_hz / genes) / world.physics_hz
    fields = {"ego_lane": lane, "ego_speed": ego_speed, "gene_seconds": seconds, **fields}
    return Scenario(npcs=[[PositionInstruction(cell, speed)] * genes for cell in cells], **fields)


def constant():
    """Return an ADS that keeps its lane and its speed."""
    return ControlledVehicle


@pytest.mark.parametrize("env_id", mostly_oracle(ROADS, "merge-v1", "roundabout-v1"))
def test_limits_hold_and_executed_chain_stays_fixed(env_id):
    world, rng = world_of(env_id, duration=6.0), np.random.default_rng(3)
    for ego, style in itertools.product((idm, constant), STYLES):
        trace = world.rollout(sample(space_of(world, traffic=style), rng), ego)
        assert violations(trace, world) == [], trace.scenario.canonical()
        again = world.rollout(trace.executed, ego)
        assert (again.executed, again.driven) == (trace.executed, trace.driven)
        assert again.states.tobytes() == trace.states.tobytes()


BENDS = [
    # An NPC begins a lane change at 5 m/s and could drive 10 m/s in the bend: it must not, while turned outwards.
    oracle(65554407, ("323434", "432323"), ("4.5 8.1 6.9 1.8 7.7 3.9", "2.1 8.1 6.9 4.9 7.7 3.9")),
    # An NPC changes lanes where one lane's bend begins later than the other's.
    oracle(974133204, ("222123", "776565"), ("8.6 7.9 0.0 4.7 5.4 4.7", "1.0 7.2 2.6 3.5 4.2 3.0")),
    # A slow NPC changes to the outer lane in a bend: the lane turns away from it while it turns back.
    (748242784, ("454556", "218187"), ("4.9 3.9 3.9 3.4 0.2 6.0", "2.0 1.7 6.9 9.6 8.3 5.1")),
]


@pytest.mark.parametrize(("seed", "cells", "speeds"), BENDS)
def test_limits_hold_where_lanes_are_changed_in_bends(seed, cells, speeds):
    world = world_of("racetrack-v1")
    chains = [
        [*map(PositionInstruction, map(int, its_cells), map(float, its_speeds.split()))]
        for its_cells, its_speeds in zip(cells, speeds, strict=True)
    ]
    trace = world.rollout(Scenario(npcs=chains, seed=seed, ego_speed=10.0), idm)
    assert violations(trace, world) == []


def test_cells_exist_only_on_lanes_in_ego_direction():
    roundabout = world_of("roundabout-v1").road
    assert roundabout.start_lanes == (1,)
    # before the circle there is one lane
    assert roundabout.cells(roundabout.start, 1, 8.0) == {2, 6}
    in_the_circle = 170.0
    # the inner lane is to the left
    assert roundabout.cells(in_the_circle, 1, 8.0) == {1, 2, 6, 7, 8}
    merge = world_of("merge-v1").road
    assert merge.cells(merge.start, 1, 8.0) == {1, 2, 6, 7, 8}
    assert merge.cells(250.0, 1, 8.0) == {1, 2, 3, 4, 5, 6, 7, 8}  # next to the lane that ends
    assert merge.cells(305.0, 1, 8.0) == {1, 2, 4, 5, 6, 7, 8}
    assert merge.cells(3.0, 1, 8.0) == {1, 2, 8}  # nothing is behind the beginning of the road
    two_way = world_of("two-way-v0").road
    assert two_way.cells(100.0, 1, 8.0) == {1, 2, 6, 7, 8}  # the oncoming lane covers the left one


CROWDED = {
    "too many NPCs": ((2, 6, 7), {}, "npcs"),
    "no such lane": ((2,), {"ego_lane": 0}, "ego_lane"),
}


def start_in_circle(cells, given):
    world = world_of("roundabout-v1")
    world.rollout(hold(world, *cells, **given), idm)


@table(("cells", "given", "field"), CROWDED.values())
def test_more_npcs_than_start_cells_and_a_missing_lane_are_refused(cells, given, field):
    with refused(field, ScenarioError):
        start_in_circle(cells, given)


def test_npc_in_lanes_uses_lanes_where_they_exist():
    """The ramp of the merge is the rightmost lane, from 230 m to 309.5 m of the ego's way."""
    world = world_of("merge-v1")
    parts = [("right", 20.0)] * 3, [("keep", 20.0)] * 5, [("right", 8.0)] * 3, [("keep", 8.0)] * 6
    npc = [LaneInstruction(*gene) for part in parts for gene in part]
    scenario = Scenario(npcs=[npc], ego_lane=1, ego_speed=20.0, gene_seconds=1.0)
    trace = world.rollout(scenario, constant)
    along, lane = trace.track[:, 1, ALONG], trace.npcs[:, 0, LANE]
    lanes = [gene.lane for gene in trace.executed.npcs[0][:3]]
    assert lanes == ["right", "right", "keep"], "no ramp is there yet"
    assert set(lane[along < 230]) == {0, 1}
    assert lane[-1] == 2
    assert trace.npcs[-1, 0, SPEED] < 7.0, "it brakes before the ramp ends"
    assert violations(trace, world) == []


def test_ring_steps_skip_cells_that_do_not_exist():
    """On the single lane before the roundabout, a step from 2 to 3 leads to 6."""
    world = World("roundabout-v1", duration=4.0)
    chain = [PositionInstruction(2, 8.0), PositionInstruction(3, 8.0)]
    fields = {"ego_lane": 1, "ego_speed": 1.0, "gene_seconds": 2.0}
    trace = world.rollout(Scenario(npcs=[chain], **fields), constant)
    assert trace.driven == ((2, 6),)
    assert trace.executed.npcs == (tuple(chain),)  # no chain steps from 2 to 6
    assert [gene.cell for gene in trace.chains[0]] == [2, 6]


CURVED = ["racetrack-v1", "racetrack-oval-v1", "roundabout-v1", "intersection-v2"]


@pytest.mark.parametrize("env_id", mostly_oracle(CURVED, "roundabout-v1"))
def test_npcs_stay_near_lane_centre_in_bends(env_id):
    world = world_of(env_id, duration=15.0)
    trace = world.rollout(hold(world, 6, speed=6.0), constant)
    assert np.ptp(np.unwrap(trace.npcs[:, 0, HEADING])) > 0.7
    assert abs(trace.track[:, 1, OFFSET]).max() < 0.25


def test_way_follows_ego_route_or_default_choice_from_before_its_start():
    assert ("ir0", "il1") in world_of("intersection-v0").road.sections  # planned, to the left
    assert ("ir0", "il2") in world_of("intersection-v1").road.sections  # straight on
    assert ("nx", "nxs") in world_of("roundabout-v1").road.sections
    road = world_of(
        "racetrack-v1"
    ).road  # NPCs behind the ego are on the lanes that lead to its start
    assert road.start > 150
    x, y, _ = road.position(road.start - 60, road.ego_lane)
    x0, y0, _ = road.position(road.start, road.ego_lane)
    assert math.hypot(x - x0, y - y0) < 60


def test_speed_limit_is_that_of_the_fastest_lane_or_the_ego_start():
    assert world_of("merge-v1").speed_limit == 30.0  # the lanes' is 20
    assert world_of("racetrack-v1").speed_limit == 10.0
    lane = StraightRoad.uniform(1, 500.0, 4.0, 20.0).lanes[0]
    limits = enumerate((20.0, 30.0, 10.0))
    lanes = [replace(lane, y=4.0 * number, speed_limit=limit) for number, limit in limits]
    assert StraightRoad(tuple(lanes)).speed_limit == 30.0


@pytest.mark.usefixtures("registered")
def test_roads_beside_the_way_keep_their_own_speed_limit():
    """The ego drives at 10 m/s; where a lane has a lower limit or none, its own speed is the limit."""
    assert [lane.speed_limit for lane in World("OwnMeeting-v0").road.lanes] == [20.0, 20.0]


@pytest.mark.usefixtures("registered")
@pytest.mark.parametrize(("length", "lanes"), [(8.0, 1), (13.0, 2)])
def test_lane_shorter_than_ten_metres_is_no_lane_of_the_grid(length, lanes):
    assert World("OwnTaper-v0", config={"taper": length}).lanes == lanes


@pytest.mark.oracle
def test_exit_is_passed_at_its_own_speed_limit():
    """Its survey takes longer than those of the other roads together."""
    world = world_of("exit-v1")
    assert ("2", "3") in world.road.sections
    assert world.speed_limit == 26.0


def test_run_lasts_as_long_as_shortest_limit_allows():
    assert world_of("roundabout-v1").longest_run == 11.0
    assert World("roundabout-v1", duration=5.0).longest_run == 5.0
    assert World("roundabout-v1", duration=50.0).longest_run == 11.0
    assert world_of("merge-v1").longest_run == pytest.approx((460 - 30) / 30)
    assert world_of("racetrack-v1").longest_run == 60.0


def test_the_end_of_the_road_ends_a_run():
    world = world_of("merge-v1")
    trace = world.rollout(hold(world, 1, speed=30.0, gene_seconds=30.0), constant)
    assert trace.outcome is Outcome.END_OF_ROAD
    assert trace.track[:, :, ALONG].max() == pytest.approx(460 - 2.5, abs=2.5)


def test_leaving_the_road_ends_a_run():
    config = {"action": {"type": "ContinuousAction"}, "observation": {"type": "Kinematics"}}
    world = World("racetrack-v1", config=config, duration=20.0)
    trace = world.rollout(hold(world, 8), lambda: lambda observation: np.array([0.0, 0.0]))
    assert trace.outcome is Outcome.OFF_ROAD
    assert trace.off_road_tick == trace.ticks
    assert trace.ego[-1, LANE] == -1


def test_leaving_the_route_ends_a_run():
    """The ego turns right where its route goes left."""
    world = world_of("intersection-v0")

    class TurnsRight(ControlledVehicle):
        def follow_road(self):
            self.route = [("ir0", "il3", 0), ("il3", "o3", 0)]
            super().follow_road()

    trace = world.rollout(hold(world, 6, speed=5.0), lambda: TurnsRight)
    assert trace.outcome is Outcome.LEFT_ROUTE
    assert trace.ego[-1, LANE] >= 1


def test_trace_lanes_are_indexed_and_curves_have_points():
    world = world_of("racetrack-v1", duration=20.0)
    trace = world.rollout(hold(world, 1, 7), idm)
    for vehicle in range(3):
        for tick in range(0, trace.ticks, 30):
            lane = trace.lanes[int(trace.states[tick, vehicle, LANE])]
            points = np.array(lane.points)
            distance = np.hypot(*(points - trace.states[tick, vehicle, :2]).T).min()
            assert distance <= lane.width / 2 + 1.0
    assert all(lane.points == () for lane in world_of("merge-v1").road.lanes[:3])


@pytest.mark.usefixtures("registered")
def test_headway_is_measured_along_the_road_in_bends():
    """The headway is two seconds at 10 m/s and a vehicle's length, on a lane with a radius of 46 m."""
    world = World("OwnCircuit-v0", duration=2.0)
    trace = world.rollout(hold(world, 2, speed=10.0), constant)
    chord = 2 * 46 * math.sin(25 / 46 / 2)
    assert np.hypot(*(trace.npcs[0, 0, :2] - trace.ego[0, :2])) == pytest.approx(chord, abs=0.02)
    assert trace.road.ahead[0, 0] == pytest.approx(25, abs=0.05)
    assert criticality.longitudinal_gap(trace)[0, 0] == pytest.approx(20, abs=0.15)


def test_copied_vehicle_shares_its_way_with_the_original():
    """highway-env's intersections copy every vehicle, with everything it refers to, to see whether it must yield."""
    road = world_of("intersection-v0").road
    assert copy.deepcopy([road])[0] is road


HALVES = (("n", "s", 0.0), ("s", "n", math.pi))
"""The nodes and the first angle of the two halves of a circle."""


class OwnCircuit(OwnEnvironment):
    """A user's environment: two lanes around a circle, with only the road from highway-env."""

    options: ClassVar = {"action": {"type": "DiscreteMetaAction", "target_speeds": [0, 6, 12]}}

    def _reset(self):
        lanes = [
            (node, after, CircularLane([0, 0], radius, start, start + math.pi, speed_limit=12))
            for node, after, start in HALVES
            for radius in (50, 46)  # clockwise on the screen, so the outer lane is the left one
        ]
        inner = lanes[1][2]
        self.open(lanes, inner.position(30, 0), inner.heading_at(30))

    def _is_truncated(self):
        return False


class OwnDeadEnd(OwnCircuit):
    def _reset(self):
        lane = StraightLane([0, 0], [30, 40], speed_limit=12)
        self.open([("a", "b", lane)], [27.0, 36.0], math.atan2(4, 3))


class OwnTaper(OwnCircuit):
    """A user's environment in which the right one of two straight lanes ends."""

    options: ClassVar = OwnCircuit.options | {"taper": 60.0}

    def _reset(self):
        end = self.config["taper"]
        lanes = [("a", "b", StraightLane([0, y], [end, y], speed_limit=30)) for y in (0, 4)]
        lanes.append(("b", "c", StraightLane([end, 0], [end + 600, 0], speed_limit=30)))
        self.open(lanes, [20.0, 0.0], speed=6.0)


class OwnRamp(MergeEnv):
    """The ego starts next to the motorway of merge-v0, in the lane of the ramp, which ends there."""

    def _make_vehicles(self):
        self.vehicle = self.action_type.vehicle_class(self.road, [235.0, 8.0], speed=20.0)
        self.road.vehicles.append(self.vehicle)


class OwnMeeting(OwnCircuit):
    """A straight road from west to east, and a second one that meets or passes it."""

    other: ClassVar = {"other": ["n", "s"], "points": [[200.0, -80.0], [200.0, 90.0]]}
    options: ClassVar = OwnCircuit.options | other

    def _reset(self):
        other = StraightLane(*self.config["points"], speed_limit=20)
        lanes = [
            ("a", "b", StraightLane([0, 0], [300, 0], speed_limit=20)),
            ("b", "c", StraightLane([300, 0], [600, 0], speed_limit=20)),
            (*self.config["other"], other),
        ]
        self.open(lanes, [50.0, 0.0])


class OwnTraffic(OwnMeeting):
    def step(self, action):
        return super().step(action)


class OwnHalves(OwnCircuit):
    """Two half circles. No run reaches the second one: its nodes are those of the first in the other order."""

    def _reset(self):
        lanes = [
            (*nodes, CircularLane([0, 0], 200, start, start + math.pi, speed_limit=12))
            for *nodes, start in HALVES
        ]
        first = lanes[0][2]
        self.open(lanes, first.position(200, 0), first.heading_at(200))


OWN = (OwnCircuit, OwnDeadEnd, OwnTaper, OwnMeeting, OwnTraffic, OwnHalves, OwnRamp)


@pytest.fixture
def registered(register):
    for entry_point in OWN:
        register(f"{entry_point.__name__}-v0", entry_point)


@pytest.mark.usefixtures("registered")
def test_an_environment_of_ones_own_works_the_same():
    world, rng = World("OwnCircuit-v0", duration=6.0), np.random.default_rng(0)
    assert world.lanes == 2
    assert world.start == (1, 10.0)
    for ego in (idm, lambda: lambda observation: 1):
        trace = world.rollout(sample(space_of(world), rng), ego)
        assert violations(trace, world) == []
        again = world.rollout_in_gym(trace.executed, ego)
        assert disagreement(Run(trace), Run(again)) == ""


@pytest.mark.usefixtures("registered")
@pytest.mark.parametrize("lane", [0, 1])
def test_attentive_npc_in_bend_holds_distance_along_road(lane):
    """At 10 m/s it is 6 m and a vehicle's length, on either lane; only one lane is as long as the way."""
    world = World("OwnCircuit-v0", duration=24.0)
    scenario = hold(world, 6, speed=12.0, ego_lane=lane, ego_speed=10.0, traffic="hostile")
    trace = world.rollout(scenario, constant)
    assert np.hypot(*(trace.ego[-1, :2] - trace.npcs[-1, 0, :2])) == pytest.approx(11.0, abs=0.2)


@pytest.mark.usefixtures("registered")
@pytest.mark.parametrize(("speed", "taper", "does_enter"), [
    (6.0, 100.0, False), oracle(6.0, 130.0, True), oracle(25.0, 350.0, False), (25.0, 500.0, True),
])  # fmt: skip
def test_ending_lane_is_entered_only_with_enough_room(speed, taper, does_enter):
    """Slow NPCs need three seconds before its end, fast ones as long as it takes to stop gently."""
    world = World("OwnTaper-v0", config={"taper": taper}, duration=13.0)
    chain = [PositionInstruction(2, speed), PositionInstruction(3, speed)]
    given = Scenario(npcs=[chain], ego_lane=0, ego_speed=speed, gene_seconds=8.0)
    trace = world.rollout(given, constant)
    assert bool(trace.npcs[:, 0, Y].max() > 2.0) == does_enter


@pytest.mark.usefixtures("registered")
def test_ending_lane_is_left_before_its_end():
    world = World("OwnTaper-v0", config={"taper": 150.0}, duration=16.0)
    trace = world.rollout(hold(world, 3, speed=10.0, ego_lane=0, ego_speed=10.0), constant)
    assert trace.npcs[0, 0, Y] == pytest.approx(4.0)
    assert trace.npcs[-1, 0, :2] == pytest.approx([185.0, 0.0], abs=15.0)


@pytest.mark.usefixtures("registered")
def test_way_ends_with_the_lane_of_a_ramp():
    """The next lane is 4 m to the left of its end: an ego merges before, and an NPC stops before the fixed object."""
    world = World("OwnRamp-v0")
    assert world.road.route == (("j", "k", 0), ("k", "b", 0), ("b", "c", 2))
    scenario = hold(world, 2, speed=20.0)
    merges, hits = (world.rollout(scenario, lambda a=a: lambda seen: a) for a in (0, 1))
    assert (merges.outcome, hits.outcome) == (Outcome.END_OF_ROAD, Outcome.COLLISION)
    assert merges.ego[-1, Y] == pytest.approx(0.0, abs=0.1)
    assert 290 < hits.npcs[-1, 0, X] < 306


@pytest.mark.usefixtures("registered")
def test_road_that_ends_ahead_of_ego_is_refused():
    with refused("OwnDeadEnd-v0"):
        World("OwnDeadEnd-v0").check()


UNUSED = {"intersection": {"crosses", "joins"}, "two-way": {"oncoming"}}
JOINED = ("merge", "merge-generic", "roundabout", "roundabout-generic")
UNUSED |= {name: {"joins"} for name in JOINED}


def test_a_world_knows_the_roads_that_nobody_uses():
    """On other roads nothing meets the ego's way: the exit leaves it, and circuits and bends have no other road."""
    for env_id in ROADS:
        found = world_of(env_id, duration=6.0).unused_roads
        assert found == UNUSED.get(env_id.rpartition("-")[0], set()), env_id
    assert World("highway-v0").unused_roads == frozenset()


@pytest.mark.usefixtures("registered")
@pytest.mark.parametrize(("other", "points", "unused"), [
    (("n", "s"), ([200, -80], [200, 90]), {"crosses"}),
    (("n", "b"), ([200, -80], [300, 0]), {"joins"}),
    (("b", "s"), ([300, 0], [400, 90]), set()),  # leaves
    (("n", "s"), ([200, -80], [200, -10]), set()),  # ends before it
    (("n", "s"), ([0, 12], [600, 12]), set()),  # runs next to it
    (("b", "a"), ([300, -4], [0, -4]), {"oncoming"}),
    (("b", "a"), ([200, -4], [199.2, -4]), {"oncoming"}),  # however short
])  # fmt: skip
def test_crossing_roads_are_found_where_ways_meet(other, points, unused):
    config = {"other": list(other), "points": [list(map(float, point)) for point in points]}
    assert World("OwnMeeting-v0", config=config, duration=10.0).unused_roads == unused


@pytest.mark.usefixtures("registered")
def test_unknown_facts_about_roads_are_not_reported():
    assert World("OwnTraffic-v0", duration=10.0).unused_roads == frozenset()
    assert World("OwnTraffic-v0", duration=10.0).road.unused == {"crosses"}
    halves = World("OwnHalves-v0", duration=3.0)
    assert (halves.road.others, halves.unused_roads) == ((("s", "n", 0),), frozenset())
