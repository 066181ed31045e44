"""NPCs drive like vehicles: their limits hold at every tick of every trace."""

import random

import pytest
from highway_env.vehicle.behavior import IDMVehicle

from pytest_pafot import Highway, NpcLimits, PositionInstruction, Scenario, World
from pytest_pafot.model.trace import SPEED, Outcome, X, Y
from pytest_pafot.world.kernel.driver import NpcDriver
from pytest_pafot.world.kernel.lanes import Body
from tests.helpers.stages import oracle
from tests.helpers.tables import table
from tests.helpers.world_cases import (
    EGOS,
    LENGTH,
    WIDTH,
    chains,
    constant_speed,
    random_scenario,
    violations,
)


def random_highway(rng, physics_hz, limits=None):
    ads_hz = rng.choice([hz for hz in (1, 5, physics_hz) if physics_hz % hz == 0])
    return Highway(
        lanes=rng.randint(3, 6), speed_limit=rng.choice([26.8, 26.8, 13.9, 36.0]), physics_hz=physics_hz,
        ads_hz=ads_hz, duration=rng.choice([5.0, 8.0]), clearance=rng.choice([0.0, 3.0, 3.0, 8.0]),
        headway=rng.choice([0.0, 1.0, 2.0, 2.0, 10.0]), limits=limits or NpcLimits(),
    )  # fmt: skip


def driven_within_limits(rng, world, ego, npcs=None):
    """Return a random run, after checking the limits of its NPCs."""
    scenario = random_scenario(rng, lanes=world.lanes, speed_limit=world.speed_limit, npcs=npcs)
    trace = world.rollout(scenario, ego)
    broken = violations(trace, world.limits, world.speed_limit)
    assert broken == [], (world, scenario.canonical())
    return trace


def assert_fixed_point(world, trace, ego):
    again = world.rollout(trace.executed, ego)
    assert again.states.tobytes() == trace.states.tobytes()
    for name in ("executed", "outcome", "collision", "arrivals"):
        assert getattr(again, name) == getattr(trace, name)


@pytest.mark.parametrize("ego", EGOS, ids=lambda ego: ego.__name__)
@pytest.mark.parametrize(
    ("physics_hz", "scenarios", "seed"),
    [(5, 16, 0), (15, 24, 0), (50, 16, 0), oracle(5, 70, 1), oracle(15, 65, 1), oracle(50, 25, 1)],
)
def test_all_limits_hold_and_executed_chain_stays_fixed(physics_hz, scenarios, seed, ego):
    rng, outcomes = random.Random(f"{physics_hz} {ego.__name__} {seed}"), set()
    for number in range(scenarios):
        world = random_highway(rng, physics_hz)
        trace = driven_within_limits(rng, world, ego, npcs=number % 8 + 1)
        if number % 3 == 0:
            assert_fixed_point(world, trace, ego)
        outcomes.add(trace.outcome)
    assert Outcome.COLLISION in outcomes
    assert {Outcome.COMPLETED, Outcome.OFF_ROAD} & outcomes, "the scenarios do not all end alike"


@pytest.mark.parametrize(("physics_hz", "scenarios"), [oracle(5, 120), (15, 120), oracle(50, 40)])
def test_limits_are_options_and_hold_whatever_they_are(physics_hz, scenarios):
    rng = random.Random(physics_hz)
    for number in range(scenarios):
        limits = NpcLimits(
            acceleration=rng.choice([0.5, 2.0, 5.0, 9.0]),
            braking=rng.choice([1.0, 4.0, 8.0, 10.0]),
            jerk=rng.choice([1.0, 5.0, 10.0, 100.0, 1000.0]),
            lateral_acceleration=rng.choice([0.3, 1.0, 2.0, 4.0, 9.0]),
            overspeed=rng.choice([1.0, 1.05, 1.1]),
            heading=rng.choice([0.02, 0.1, 0.3, 0.5, 0.78]),
        )
        world = random_highway(rng, physics_hz, limits)
        driven_within_limits(rng, world, EGOS[number % len(EGOS)])


@pytest.mark.parametrize(("ego", "runs"), [(constant_speed, 80), (IDMVehicle, 20)])
def test_less_than_a_quarter_of_runs_is_invalid(ego, runs):
    rng, world = random.Random(7), Highway()
    scenarios = [Scenario.repaired(chains(rng, 2, 6, 26.8), seed=seed) for seed in range(runs)]
    traces = [world.rollout(scenario, ego) for scenario in scenarios]
    assert sum(trace.outcome is Outcome.INVALID for trace in traces) < runs / 4
    reached = [tick is not None for trace in traces for each in trace.arrivals for tick in each]
    assert sum(reached) > len(reached) / 4, "hardly any gene reaches its cell"


def driver_at(hz):
    return NpcDriver(NpcLimits(), 40.0, LENGTH, 1 / hz)


def drive_npc(hz, *, speed, offset=0.0, heading=0.0, seconds=5.0):
    """Return offset [m] and heading [rad] after each tick of an NPC of constant speed that steers to its lane."""
    driver, body, course, rows = driver_at(hz), Body(LENGTH, WIDTH), heading, []
    body.place(0.0, offset, heading, speed)
    for _ in range(round(seconds * hz)):
        body.steering = driver.steering(body.y, body.heading, course, body.speed)
        course = driver.course
        body.step(1 / hz)
        rows.append((body.y, body.heading))
    return rows


@table("hz", [15, 50])
@table("speed", [20.0, 25.0, 30.0])
def test_lane_change_takes_two_seconds_without_overshoot(hz, speed):
    """It ends where the director says that an NPC has arrived, half a metre before the centre of the lane."""
    offsets = [offset for offset, _ in drive_npc(hz, speed=speed, offset=-4.0)]
    arrived = next(tick for tick, offset in enumerate(offsets) if offset > -0.5)
    assert arrived / hz == pytest.approx(2.0, abs=0.35)
    assert offsets[-1] == pytest.approx(0.0, abs=0.01)
    assert max(offsets) < 0.01


def test_turned_npc_loses_a_tenth_of_its_angle_in_a_fiftieth_of_a_second():
    """In the centre of its lane it turns by five times its angle per second: by a tenth of it in a fiftieth."""
    ((_, heading),) = drive_npc(50, speed=20.0, heading=0.001, seconds=0.02)
    assert heading == pytest.approx(0.0009, rel=1e-3)


def test_lane_change_goes_on_before_the_sharpest_bend():
    """Of 4 m/s^2, 97 % are for control, of these 70 % for the end of a lane change, and of these always 15 %.

    That is 0.407 m/s^2. It stops a sideways speed of 0.903 m/s within a metre: at 10 m/s, an angle of 0.0904 rad. An
    NPC a metre before the centre of its lane keeps this angle; from a smaller or larger angle it steers towards it.
    """
    driver = driver_at(50)
    driver.steering_in_bend(-1.0, 0.0904, 0.0904, 10.0, 0.0, 0.0, 1.0)
    assert driver.course == pytest.approx(0.0904, abs=1e-4)
    assert driver.steering_in_bend(-1.0, 0.08, 0.08, 10.0, 0.0, 0.0, 1.0) > 0.0
    assert driver.steering_in_bend(-1.0, 0.10, 0.10, 10.0, 0.0, 0.0, 1.0) < 0.0


def test_npc_drives_to_cell_then_at_its_speed():
    """The ego drives 20 m/s in lane 1; the NPC should go to the front left, then cut in and brake."""
    chain = [PositionInstruction(1, 24.0), PositionInstruction(2, 8.0)]
    trace = Highway(clearance=3.0).rollout(Scenario(npcs=[chain], ego_speed=20.0), constant_speed)
    (first, second), npc, ego = trace.arrivals[0], trace.npcs[:, 0], trace.ego
    assert 0 <= first < 150 < second < 300
    assert npc[first, 0] - ego[first, 0] == pytest.approx(8.0, abs=2.5)
    assert npc[149, SPEED] == pytest.approx(24.0, abs=0.1)
    assert npc[149, Y] == pytest.approx(0.0, abs=0.05)
    assert abs(npc[second, Y] - ego[second, Y]) <= 0.5
    hit = trace.collision
    assert (trace.outcome, hit.side, hit.cell) == (Outcome.COLLISION, "front", 2)


def test_lane_that_vanishes_inside_gene_is_not_approached():
    """The ego moves to the left lane while an NPC is on its way to the front left."""

    def to_the_left():
        return lambda observation: (0.0, -0.01 * observation.ego.y - 0.3 * observation.ego.heading)

    npcs = [[PositionInstruction(cell, 20.0)] for cell in (1, 4)]
    trace = Highway().rollout(Scenario(npcs=npcs, ego_lane=1), to_the_left)
    assert violations(trace, NpcLimits(), 26.8) == []
    assert trace.npcs[:, 0, Y].min() > -1.0


def test_npcs_brake_for_each_other():
    """The first NPC stops in the left lane ahead of the second, which wants 26 m/s: it stops behind it."""
    stop, rush = [PositionInstruction(1, 0.0)], [PositionInstruction(7, 26.0)]
    trace = Highway().rollout(Scenario(npcs=[stop, rush], gene_seconds=30.0), constant_speed)
    gap = trace.npcs[:, 0, X] - trace.npcs[:, 1, X] - 5.0
    assert trace.outcome is Outcome.COMPLETED
    assert trace.arrivals[0] != (None,)
    assert 0.5 < gap.min() < 10
    assert trace.npcs[-1, :, SPEED].max() < 0.1


def test_limits_hold_around_reversing_or_spinning_ego():
    rng = random.Random(12)
    world = World("highway-v0", config={"action": {"type": "ContinuousAction"}}, duration=12.0)
    for _ in range(25):
        npcs, lane = chains(rng, 3, 4, 30.0), rng.randrange(4)
        scenario = Scenario.repaired(npcs, ego_lane=lane, gene_seconds=3.0)
        action = (rng.uniform(-1, 1), rng.choice([0.0, 0.1, -0.3, 0.9]))
        trace = world.rollout(scenario, lambda action=action: lambda observation: action)
        broken = violations(trace, world.limits, world.speed_limit)
        assert broken == [], (scenario.canonical(), action)
