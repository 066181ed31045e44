"""The same actions give the same trajectories as highway-env's own vehicles, road and ``env.step``.

Stock vehicles drive the NPCs there with the controls from the trace. So the tests compare the physics, the action
types, the decision rate, the observations and highway-env's own drivers, and not this package with itself.
"""

from __future__ import annotations

import random
from contextlib import nullcontext

import gymnasium
import highway_env  # noqa: F401  (registers its environments)
import numpy as np
import pytest
from highway_env.road.road import RoadNetwork
from highway_env.vehicle.behavior import AggressiveVehicle, DefensiveVehicle, IDMVehicle, LinearVehicle
from highway_env.vehicle.dynamics import BicycleVehicle
from highway_env.vehicle.kinematics import Vehicle

from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import ACCELERATION, HEADING, SPEED, STEERING, Outcome
from pytest_pafot.world import Highway, World
from tests.helpers.c_library import c_library
from tests.helpers.gym_loop import Replayed, StateLog
from tests.helpers.stages import mostly_oracle, oracle
from tests.helpers.world_cases import chains

STATE = slice(0, SPEED + 1)


@pytest.fixture(params=mostly_oracle(["exactly", "within a centimetre"], "exactly"))
def exact(request):
    """Return whether to compare to the last bit, on which machines agree only with the C library's functions."""
    with c_library() if request.param == "exactly" else nullcontext():
        yield request.param == "exactly"


only_exactly = pytest.mark.parametrize("exact", ["exactly"], indirect=True)


class Npc(Replayed):
    """A stock vehicle about which an IDM follower assumes the same as about an NPC: it drives at its desired speed."""

    @property
    def target_speed(self):
        return self.speed


def stock_env(trace, env_id="highway-v0", config=None, ego_class=None):
    """Return an environment of gymnasium with the trace's vehicles at their start, and a log of their states."""
    config = {"vehicles_count": 0, "duration": 10_000, **(config or {})}
    env = gymnasium.make(env_id, config=config, disable_env_checker=True)
    env.reset(seed=0)
    plain = env.unwrapped
    lane = trace.lanes[0]
    plain.road.network = RoadNetwork.straight_road_network(
        len(trace.lanes), length=lane.length, speed_limit=lane.speed_limit
    )
    start = trace.states[0]
    ego = (ego_class or plain.action_type.vehicle_class)(plain.road, start[0, :2], *start[0, [HEADING, SPEED]].tolist())
    npcs = [Npc(plain.road, npc[:2], *npc[[HEADING, SPEED]].tolist()) for npc in start[1:]]
    for index, npc in enumerate(npcs, start=1):
        controls = trace.states[1:, index, (ACCELERATION, STEERING)]
        npc.tick, npc.controls = 0, np.concatenate([controls, np.zeros((20, 2))])  # env.step ends its last decision
    for vehicle in (ego, *npcs):
        vehicle.check_collisions = False
    plain.road.vehicles = [ego, *npcs]
    plain.controlled_vehicles = [ego]
    plain.define_spaces()
    plain.road.step = StateLog(plain.road)
    return env, plain.road.step


def assert_same(trace, log, exact):
    stock = np.array(log.rows[: trace.ticks])
    assert stock.shape == (trace.ticks, trace.states.shape[1], 4)
    own = trace.states[1:, :, STATE]
    if exact:
        assert np.array_equal(stock, own), f"differ from tick {np.flatnonzero((stock != own).any(axis=(1, 2)))[0] + 1}"
    else:
        assert np.abs(stock[..., :2] - own[..., :2]).max() <= 0.01


def random_scenarios(count, *, lanes, speed_limit, seed, npcs=2, genes=6):
    rng = random.Random(seed)
    for _ in range(count):
        yield Scenario.repaired(
            chains(rng, npcs, genes, speed_limit),
            seed=rng.randrange(2**32),
            ego_lane=rng.randrange(lanes),
            ego_speed=rng.uniform(18, 25),
        )


def lmap(action, low, high):
    return low + (action + 1) * (high - low) / 2


@pytest.mark.parametrize(("physics_hz", "ads_hz"), [(15, 5), (20, 10), (5, 1)])
def test_highway_planner_drives_like_continuous_actions(exact, physics_hz, ads_hz):
    world = Highway(physics_hz=physics_hz, ads_hz=ads_hz)
    (scenario,) = random_scenarios(1, lanes=4, speed_limit=26.8, seed=physics_hz)
    rng = np.random.default_rng(0)
    actions = np.stack([rng.uniform(-0.3, 0.32, 600), rng.normal(0, 0.004, 600)], axis=1)
    numbers = iter(actions)

    def planner(observation):
        throttle, wheel = next(numbers)
        return lmap(throttle, -5.0, 5.0), lmap(wheel, -np.pi / 4, np.pi / 4)

    trace = world.rollout(scenario, lambda: planner)
    env, log = stock_env(
        trace,
        config={
            "lanes_count": 4,
            "simulation_frequency": physics_hz,
            "policy_frequency": ads_hz,
            "action": {"type": "ContinuousAction"},
        },
    )
    env.unwrapped.observation_type.observe = lambda: None  # not needed, and slower than all the rest
    for action in actions[: len(trace.actions)]:
        env.step(action)
    assert trace.outcome is not Outcome.ADS_ERROR
    assert trace.ego[:, SPEED].min() > 1
    assert_same(trace, log, exact)


@pytest.mark.parametrize(
    ("world", "ego_class"),
    [
        (Highway(duration=20.0), IDMVehicle),
        (Highway(duration=20.0), LinearVehicle),
        (World("highway-v0", duration=20.0), BicycleVehicle),
        *(oracle(Highway(), each) for each in (AggressiveVehicle, DefensiveVehicle, Vehicle, BicycleVehicle)),
        *(
            oracle(World("highway-v0", duration=60.0), each)
            for each in (IDMVehicle, LinearVehicle, AggressiveVehicle, DefensiveVehicle, Vehicle)
        ),
    ],
    ids=lambda value: getattr(value, "__name__", type(value).__name__),
)
@only_exactly
def test_vehicle_classes_drive_themselves_as_in_gymnasium(exact, world, ego_class):
    (scenario,) = random_scenarios(1, lanes=4, speed_limit=26.8, seed=ego_class.__name__)
    trace = world.rollout(scenario, ego_class)
    env, log = stock_env(trace, ego_class=ego_class)
    plain = env.unwrapped
    for _ in range(trace.ticks):
        plain.road.act()
        plain.road.step(1 / 15)
    assert_same(trace, log, exact)


def test_collisions_start_at_first_overlap_of_stock_boxes():
    """It uses highway-env's own polygons, tested for contact without its prediction."""
    from highway_env.utils import are_polygons_intersecting

    world, found = Highway(), 0
    for scenario in random_scenarios(4, lanes=4, speed_limit=26.8, seed=11):
        trace = world.rollout(scenario, lambda: lambda observation: (0.0, 0.0))
        env, _ = stock_env(trace, ego_class=Vehicle)
        road, first = env.unwrapped.road, None
        for tick in range(1, trace.ticks + 1):
            road.act()
            road.step(1 / 15)
            ego, *npcs = road.vehicles
            still = np.zeros(2)
            hits = [
                np.hypot(*(npc.position - ego.position)) < 6.0  # further apart than two half diagonals of 2.7 m
                and are_polygons_intersecting(ego.polygon(), npc.polygon(), still, still)[0]
                for npc in npcs
            ]
            if any(hits):
                first = (tick, hits.index(True))
                break
        assert first == (trace.collision and (trace.collision.tick, trace.collision.npc))
        found += first is not None
    assert found >= 2
