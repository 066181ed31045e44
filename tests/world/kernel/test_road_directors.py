"""NPCs that cross: their timing, their acts at their zone, and that they hit no vehicle except the ego."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import ControlledVehicle

from pytest_pafot import CrossingInstruction, PositionInstruction, Scenario, ScenarioError, World
from pytest_pafot.model.trace import ACCELERATION, ALONG, LANE, SPEED, Outcome, X, Y
from tests.helpers.crossings import clashes
from tests.helpers.refusals import refused
from tests.helpers.road_cases import world_of
from tests.helpers.stages import oracle
from tests.helpers.tables import table
from tests.helpers.world_cases import beyond, bounds_of_motion, own_limits

LEFT, AHEAD, RIGHT, INTO = "o1>o3", "o2>o0", "o3>o0", "o3>o1"
"""Ways at an intersection where the ego turns left from o0 to o1: three across its way, one into its lane."""
FREEZE, RESPONSE = 3.0, 1.0


class Steady(ControlledVehicle):
    """A vehicle that keeps its route and first speed, whatever the rules of highway-env's road require."""

    first: float | None = None

    def act(self, action=None):
        self.first = self.target_speed = self.speed if self.first is None else self.first
        super().act()


def scenario_of(*npcs, world=None, seed=0):
    """Return a scenario with NPCs from instructions as tuples, or from chains for the grid."""
    lane, speed = (world or world_of("intersection-v0")).start
    chains = [[CrossingInstruction(*npc)] if isinstance(npc, tuple) else npc for npc in npcs]
    return Scenario(npcs=chains, ego_lane=lane, ego_speed=speed, gene_seconds=4.0, seed=seed)


def rollout(*npcs, ego=Steady, world=None):
    world = world or world_of("intersection-v0")
    return world.rollout(scenario_of(*npcs, world=world), ego)


def braking_at(time, until=0.0, braking=6.0):
    """Return a vehicle class that keeps its speed up to a time [s], brakes to a second speed [m/s], and keeps that."""

    class Braking(Steady):
        ticks = 0

        def act(self, action=None):
            super().act()
            if self.ticks >= time * 15:
                gap = self.speed - until
                self.action["acceleration"] = -min(braking, gap * 15) if gap > 0 else 0.0
            self.ticks += 1

    return Braking


def times_in(trace, npc=0):
    """Return when the ego and an NPC enter and leave the zone [s]."""
    zone, clock = trace.zones[npc], trace.times
    ego = np.interp(zone.ego, trace.track[:, 0, ALONG], clock)
    return (*ego, *np.interp(zone.npc, trace.on_way[:, npc], clock))


def slot_of(trace, npc=0):
    """Return the time from the ego's exit to the NPC's entry; if the NPC is first, minus the time between [s]."""
    ego_in, ego_out, npc_in, npc_out = times_in(trace, npc)
    if npc_out < ego_in:
        return npc_out - ego_in
    return npc_in - ego_out if npc_in > ego_out else 0.0


# Time: an ego that keeps its speed, and one that does not.


@table("zone", [LEFT, AHEAD, RIGHT, INTO, "o1>o2", "o2>o1"])
def test_npc_meets_steady_ego_according_to_its_slot(zone):
    for slot, speed in ((-1.5, 8.6), (-0.5, 7.0), (0.5, 8.6), (1.2, 5.0), (3.0, 9.0)):
        trace = rollout((zone, slot, speed))
        assert slot_of(trace) == pytest.approx(slot, abs=0.3), (slot, speed)
        assert trace.arrivals[0][0] == pytest.approx(15 * times_in(trace)[2], abs=1.0)


@table("zone", [LEFT, AHEAD, RIGHT, "o1>o2"])
def test_together_they_collide_where_nobody_gives_way(zone):
    trace = rollout((zone, 0.0, 7.0))
    assert trace.outcome is Outcome.COLLISION
    assert trace.collision.cell is None
    assert np.isnan(trace.track[-1, 1, ALONG])


def test_npc_follows_arrival_of_a_slower_ego():
    """The ego slows from 10 to 7 m/s at once and comes two seconds later, and so does the NPC."""
    late = rollout((LEFT, 1.0, 7.0), ego=braking_at(0.0, 7.0))
    assert times_in(late)[0] - times_in(rollout((LEFT, 1.0, 7.0)))[0] > 1.5
    assert slot_of(late) == pytest.approx(1.0, abs=0.3)


def test_npc_ignores_the_ego_shortly_before_it_enters():
    kept = rollout((LEFT, -1.0, 7.0))
    entered = kept.arrivals[0][0] / 15
    brakes = rollout((LEFT, -1.0, 7.0), ego=braking_at(entered - FREEZE + 0.2, 4.0))
    assert brakes.arrivals == kept.arrivals
    earlier = rollout((LEFT, -1.0, 7.0), ego=braking_at(0.2, 8.0))
    assert earlier.arrivals[0][0] > kept.arrivals[0][0] + 2


def test_npc_does_not_wait_for_a_waiting_ego():
    stands = rollout((LEFT, -0.5, 8.0), ego=braking_at(0.0, 0.0))
    assert stands.ego[-1, SPEED] == pytest.approx(0.0, abs=0.1)
    assert stands.arrivals[0][0] is not None
    assert stands.on_way[-1, 0] > stands.zones[0].npc[1]


# Acts.


def entry(trace):
    """Return the first tick at which the ego is behind the beginning of the first NPC's zone."""
    return int(np.flatnonzero(trace.track[:, 0, ALONG] > trace.zones[0].ego[0])[0])


def test_holding_npc_waits_until_the_ego_has_passed():
    trace = rollout((AHEAD, 0.0, 8.0, "hold"))
    zone, place = trace.zones[0], trace.on_way[:, 0]
    passed = int(np.flatnonzero(trace.track[:, 0, ALONG] > zone.ego[1])[0])
    assert zone.npc[0] - 3.0 < place[passed] < zone.npc[0] - 1.8
    assert trace.npcs[passed, 0, SPEED] < 0.5
    assert trace.arrivals[0][0] > passed
    assert place[-1] > zone.npc[1]
    waits = rollout((AHEAD, 0.0, 8.0, "hold"), ego=braking_at(2.0, 0.0))
    assert waits.on_way[-1, 0] == pytest.approx(zone.npc[0] - 2.0, abs=0.3)
    assert waits.arrivals == ((None,),)


def test_one_that_stops_does_so_in_the_zone():
    trace = rollout((LEFT, -1.0, 8.0, "stop"), ego=braking_at(2.0, 0.0))
    first, last = trace.zones[0].npc
    assert first + 3 < trace.on_way[-1, 0] < last - 3
    assert trace.npcs[-1, 0, SPEED] == pytest.approx(0.0, abs=0.05)
    assert rollout((LEFT, -1.0, 8.0, "stop")).outcome is Outcome.COLLISION


def test_late_npc_starts_from_line_by_its_slot():
    trace = rollout((LEFT, 1.0, 8.0, "late"))
    entered = trace.arrivals[0][0]
    assert trace.npcs[:entered, 0, SPEED].min() < 0.5
    assert slot_of(trace) == pytest.approx(1.0, abs=0.4)


# The ego in the zone already.


def entering_and_standing():
    """Return an ego that drives into the zone of NPCs from the left and stops there."""
    return braking_at(6.6, 0.0, 8.0)


def test_npc_answers_ego_in_its_zone_after_second():
    trace = rollout((LEFT, 2.5, 8.0), ego=entering_and_standing())
    zone = trace.zones[0]
    assert zone.ego[0] < trace.track[-1, 0, ALONG] < zone.ego[1]
    assert trace.outcome is Outcome.COMPLETED
    assert zone.npc[0] - 4.0 < trace.on_way[-1, 0] <= zone.npc[0]
    braking = trace.npcs[:, 0, ACCELERATION]
    assert int(np.flatnonzero(braking < -2.0)[0]) >= entry(trace) + RESPONSE * 15
    assert braking.min() >= -6.0 - 1e-9
    assert (rollout((LEFT, 2.5, 8.0)).npcs[:, 0, ACCELERATION] > -2.0).all()


def test_one_that_can_no_longer_stop_drives_on():
    trace = rollout((LEFT, 0.5, 8.0), ego=entering_and_standing())
    assert trace.outcome is Outcome.COLLISION
    assert trace.npcs[-1, 0, SPEED] > 7.0


# Among each other.


def test_npc_follows_a_slower_ego_behind_a_merge():
    trace = rollout((INTO, 0.6, 9.0), ego=braking_at(7.0, 4.0, 3.0))
    assert trace.outcome is Outcome.COMPLETED
    on_way = np.isfinite(trace.track[:, 1, ALONG])
    assert on_way[-1]
    assert trace.npcs[-1, 0, SPEED] == pytest.approx(4.0, abs=1.0)
    ahead = trace.track[on_way, 0, ALONG] - trace.track[on_way, 1, ALONG]
    assert ahead.min() > 5.0
    assert (trace.npcs[on_way, 0, LANE] >= 0).all()


def test_npc_with_the_higher_number_waits():
    """They cross each other's way, both equally long after the ego; their windows clash, so no search samples them."""
    first, second, world = (LEFT, 1.0, 8.0), ("o3>o0", 1.0, 6.0), world_of("intersection-v0")
    assert clashes(world.crossings, scenario_of(first, second))
    for npcs in ((first, second), (second, first)):
        trace = world.rollout(scenario_of(*npcs), Steady)
        assert trace.outcome is Outcome.COMPLETED
        number = npcs.index(second)
        slowest = trace.npcs[:, number, SPEED].min()
        assert (slowest < 2.5) == (number == 1), (npcs, slowest)


AT_8_M_PER_S, AT_4_M_PER_S = ("ner>exr", -2.7, 16.9), ("wer>exr", -1.0, 4.0)


@table(("env_id", "slower", "faster", "does_clash"), [
    # they start 4.7 m apart
    ("intersection-v0", ("o1>o2", -3.0, 4.2, "hold"), ("o1>o2", -4.8, 6.5), True),
    # in the circle, 2.5 m apart
    ("roundabout-v0", ("wer>exr", -0.9, 3.8), ("ner>nxr", -3.5, 18.5), True),
    # 7.5 m apart, at 4 and 8.8 m/s
    ("roundabout-v0", AT_4_M_PER_S, AT_8_M_PER_S, True),
    ("roundabout-v0", ("wer>exr", 1.0, 4.0), AT_8_M_PER_S, False),
])  # fmt: skip
def test_npcs_that_start_too_near_in_one_lane_clash_whether_it_is_that_of_their_entry(
    env_id, slower, faster, does_clash
):
    world = world_of(env_id)
    for npcs in ((slower, faster), (faster, slower)):
        assert clashes(world.crossings, scenario_of(*npcs, world=world)) is does_clash
        assert (rollout(*npcs, world=world).outcome is Outcome.INVALID) is does_clash


def drawn(rng, world, on_grid=0):
    """Return a random scenario whose NPCs do not clash."""
    names, top = sorted(world.crossings.ways), min(world.speed_limit, 10.0)

    def tenths(low, high):
        return round(float(rng.uniform(low, high)), 1)

    def crossing():
        given = names[rng.integers(len(names))], tenths(-2.5, 2.5), tenths(4.0, top)
        return CrossingInstruction(*given, str(rng.choice(["pass"] * 3 + ["hold", "stop", "late"])))

    while True:
        npcs = [[crossing()] for _ in range(rng.integers(1, 4))]
        for cell in (2, 6)[:on_grid]:
            chain = [PositionInstruction(cell, tenths(0.0, 10.0)) for _ in range(3)]
            npcs.insert(int(rng.integers(len(npcs) + 1)), chain)
        scenario = scenario_of(*npcs, world=world, seed=int(rng.integers(1000)))
        with suppress(ScenarioError):
            world.check_fits(scenario)
            if not clashes(world.crossings, scenario):
                return scenario


def slowing():
    """Return a policy that brakes, waits and drives on at random, always in the same way."""
    rng = np.random.default_rng(5)
    return lambda seen: int(rng.integers(3))


EGOS = (Steady, slowing, IDMVehicle)


@pytest.mark.parametrize(("env_id", "on_grid", "runs"), [
    ("intersection-v0", 0, 12),
    ("roundabout-v0", 0, 6),
    ("intersection-v0", 2, 9),
    oracle("intersection-v0", 0, 60),
    oracle("intersection-v1", 2, 30),
    oracle("roundabout-v0", 2, 30),
])  # fmt: skip
def test_npcs_without_clash_never_touch_and_respect_limits(env_id, on_grid, runs):
    world, rng = world_of(env_id), np.random.default_rng(runs)
    egos = EGOS if env_id != "intersection-v1" else EGOS[::2]
    for run in range(runs):
        scenario = drawn(rng, world, on_grid)
        trace = world.rollout(scenario, egos[run % len(egos)])
        assert trace.outcome is not Outcome.INVALID, scenario
        assert violations(trace, world) == [], scenario


def violations(trace, world):
    """Return the limits that crossing NPCs break, and how far they leave their ways."""
    crossing = [npc for npc, each in enumerate(trace.scenario.crossings) if each is not None]
    s, (top, own) = trace.npcs[:, crossing], own_limits(trace, world.limits, world.speed_limit)
    own = {name: values[crossing] for name, values in own.items()}
    bounds, _ = bounds_of_motion(s, world.limits, top[crossing], own, trace.dt)
    bounds["forward motion"] = np.diff(trace.on_way[:, crossing], axis=0), -1e-9, np.inf
    for number, npc in enumerate(crossing):
        line = world.road.junction.ways[trace.zones[npc].way].line
        apart = np.hypot(s[:, number, X, None] - line.x, s[:, number, Y, None] - line.y).min(axis=1)
        bounds[f"beside its way, NPC {npc}"] = apart, -np.inf, np.hypot(0.1, 0.26)
    return beyond(bounds)


@table("zone", [LEFT, AHEAD, RIGHT])
def test_higher_numbered_of_grid_and_crossing_npc_waits(zone):
    """The NPC ahead of the ego and the crossing NPC would be in the zone together."""
    ahead, crossing = [PositionInstruction(2, 9.0)] * 3, (zone, -0.5, 8.0)
    ego = braking_at(0.0, 7.0, 2.0)
    alone = [rollout(npc, ego=ego).npcs[:, 0, SPEED] for npc in (ahead, crossing)]
    for npcs in ((ahead, crossing), (crossing, ahead)):
        trace = rollout(*npcs, ego=ego)
        assert trace.outcome is not Outcome.INVALID
        for npc in range(2):
            before = alone[npcs[npc] is crossing]
            ticks = min(len(before), trace.ticks + 1)
            slower = (before[:ticks] - trace.npcs[:ticks, npc, SPEED]).max()
            assert (slower > 2.5) == (npc == 1), (npcs, npc, slower)


def test_npc_on_grid_avoids_cell_next_to_merged():
    world = world_of("roundabout-v0")
    scenario = scenario_of(("wer>exr", 1.0, 8.0), [PositionInstruction(2, 8.0)], world=world)
    director, road = world.rules.director(scenario, 5.0), world.road
    crossing, on_grid = director.npcs
    zone = world.crossings.ways["wer>exr"].zone
    crossing.place(zone.npc[1], 0.0, 0.0, 8.0)
    for ahead, has_room in ((0.0, False), (6.0, False), (-6.0, False), (12.0, True)):
        on_grid.place(zone.ego[1] + ahead, road.centre(0), 0.0, 8.0)
        assert director.leaves_room(on_grid, road.ego_lane) is has_room, ahead
        assert director.leaves_room(on_grid, 0)
    on_grid.place(zone.ego[1] + 12.0, road.centre(0), 0.0, 1.0)
    assert not director.leaves_room(on_grid, road.ego_lane)


# What is recorded, and the same run by other means.


def steering():
    """Return a policy of continuous actions that holds the wheel straight and speeds up a little."""
    return lambda seen: np.array([0.3, 0.0], dtype=np.float32)


@pytest.mark.parametrize(
    ("env_id", "egos"),
    [("intersection-v0", EGOS), ("intersection-v1", [steering]), oracle("roundabout-v0", EGOS)],
)
def test_run_repeats_exactly_and_in_environment_steps(env_id, egos):
    world, rng = world_of(env_id), np.random.default_rng(8)
    for run in range(6 if len(egos) > 1 else 2):
        ego = egos[run % len(egos)]
        trace = world.rollout(drawn(rng, world, on_grid=run % 2), ego)
        assert np.array_equal(world.rollout(trace.executed, ego).states, trace.states)
        again = world.rollout_in_gym(trace.executed, ego)
        assert again.outcome is trace.outcome
        for name in ("states", "track", "on_way"):
            np.testing.assert_allclose(getattr(again, name), getattr(trace, name), atol=1e-6)
        assert (again.arrivals, again.zones) == (trace.arrivals, trace.zones)


@pytest.mark.parametrize("env_id", ["intersection-v0", "roundabout-v0"])
def test_trace_has_place_of_each_npc_on_way(env_id):
    world = world_of(env_id)
    trace = world.rollout(drawn(np.random.default_rng(3), world, on_grid=1), Steady)
    told = trace.scenario.crossings
    ways = [zone and zone.way for zone in trace.zones]
    assert ways == [each and each.zone for each in told]
    for npc, each in enumerate(told):
        on_way = trace.on_way[:, npc]
        if each is None:
            assert np.isnan(on_way).all()
            assert np.isfinite(trace.track[:, npc + 1]).all()
            continue
        start = pytest.approx(world.crossings.start(each), abs=1e-6)
        assert on_way[0] == start or each.act == "stop"
        assert np.isnan(trace.track[on_way < trace.zones[npc].npc[0], npc + 1]).all()
        steps = np.hypot(*np.diff(trace.npcs[:, npc, :2], axis=0).T)
        np.testing.assert_allclose(np.diff(on_way), steps, atol=0.05)


def test_run_without_crossing_npcs_has_no_way_data():
    trace = rollout([PositionInstruction(2, 4.0)] * 3, [PositionInstruction(6, 9.0)] * 3)
    assert (trace.zones, trace.on_way) == ((), None)
    assert np.isfinite(trace.track).all()


# What does not fit.


UNFITTING = {
    "no such exit": (("o3>o9", 0.0, 8.0), "zone"),
    "a way that does not cross": (("o1>o0", 0.0, 8.0), "zone"),
    "a slot before the start": ((LEFT, -5.0, 8.0), "slot"),
    "a speed above the limit": ((LEFT, 0.0, 11.0), "speed"),
}


@table(("npc", "field"), UNFITTING.values())
def test_unfitting_instruction_is_refused(npc, field):
    with refused(f"npcs[0][0].{field}", ScenarioError):
        world_of("intersection-v0").check_fits(scenario_of(npc))
    world_of("intersection-v0").check_fits(scenario_of((LEFT, 0.0, 9.9, "hold")))


def check_crossing(world):
    lane, speed = world.start or (1, 20.0)
    npcs = [[CrossingInstruction(LEFT, 0.0, 8.0)]]
    world.check_fits(Scenario(npcs=npcs, ego_lane=lane, ego_speed=speed))


def test_world_without_crossings_refuses_them():
    for world in (World("highway-v0"), world_of("merge-v1")):
        with refused("npcs[0][0]", ScenarioError):
            check_crossing(world)
