"""A wrapped environment runs as ``gymnasium.make``, the wrappers and ``env.step`` do; no wrapper is dropped silently.

The plain loop here is independent of this package: the environment's own reset places vehicles, and NPCs follow the
controls from the trace.
"""

import re
from copy import deepcopy
from dataclasses import replace
from fnmatch import fnmatch
from functools import partial
from hashlib import sha256
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import WrapperSpec, load_env_creator
from gymnasium.wrappers import (
    Autoreset,
    ClipAction,
    FlattenObservation,
    FrameStackObservation,
    MaxAndSkipObservation,
    NormalizeObservation,
    RescaleAction,
    StickyAction,
    TimeLimit,
    TransformAction,
    TransformObservation,
)
from highway_env.envs.highway_env import HighwayEnv
from highway_env.road.road import Road
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import MDPVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Landmark, Obstacle

from pytest_pafot.algorithms.fitness import before_impact
from pytest_pafot.corpus.reader import load
from pytest_pafot.corpus.writer import write
from pytest_pafot.findings.finding import Expect, disagreement, is_same_event
from pytest_pafot.findings.verdict import Failure
from pytest_pafot.model.instructions import Cell, PositionInstruction, ScenarioError
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import ACCELERATION, HEADING, SPEED, STEERING, Collision, Outcome
from pytest_pafot.oracle.run import Run
from pytest_pafot.support.errors import CorpusError
from pytest_pafot.world import World, WorldError
from pytest_pafot.world.gym_environment import CONNECTED, POLICY_OPTIONS, TRAFFIC_OPTIONS
from tests.findings.builders import plain_finding
from tests.helpers.gym_loop import Replayed, StateLog
from tests.helpers.stages import mostly_oracle
from tests.helpers.tables import table

TRAFFIC_TOLD = "NPCs replace the environment's own traffic"
SCENARIO = Scenario(
    npcs=[
        [PositionInstruction(3, 24.0), PositionInstruction(2, 20.0)],
        [PositionInstruction(5, 20.0)],
    ],
    seed=11,
    gene_seconds=4.0,
)
IDLE = lambda: lambda seen: 1  # noqa: E731
CONTINUOUS = {"action": {"type": "ContinuousAction"}, "policy_frequency": 5}


def acting(kind, **options):
    """Return a configuration with a kind of actions, in which the policy also sees behind itself."""
    return {
        "action": {"type": kind, **options},
        "observation": {"type": "Kinematics", "see_behind": True},
    }


class Staged(HighwayEnv):
    """A version of highway-v0 whose reset gives the first moment of a trace."""

    trace = None

    def _create_vehicles(self):
        states = self.trace.states
        first = [(row[:2], float(row[HEADING]), float(row[SPEED])) for row in states[0]]
        ego = self.action_type.vehicle_class(self.road, *first[0])
        npcs = [Replayed(self.road, *place) for place in first[1:]]
        for index, npc in enumerate(npcs, start=1):
            controls = states[1:, index, (ACCELERATION, STEERING)]
            # the last decision continues
            npc.tick, npc.controls = 0, np.concatenate([controls, np.zeros((60, 2))])
        self.road.vehicles = [ego, *npcs]
        self.controlled_vehicles = [ego]
        for vehicle in self.road.vehicles:
            vehicle.check_collisions = False


class Listener:
    """A policy whose actions depend on every bit of its observations, and which stores both."""

    def __init__(self, space):
        self.space, self.seen, self.actions = space, [], []

    def __call__(self, observation):
        array = np.asarray(observation)
        rng = np.random.default_rng(list(sha256(array.tobytes()).digest()))
        if isinstance(self.space, gymnasium.spaces.Discrete):
            action = int(rng.integers(self.space.n))
        else:
            # without infinite bounds
            low, high = np.maximum(self.space.low, -1.5), np.minimum(self.space.high, 1.5)
            action = (low + high) / 2 + rng.uniform(-0.02, 0.02, self.space.shape) * (high - low)
        self.seen.append(array.copy())
        self.actions.append(action)
        return action


def halved(env):
    return TransformObservation(env, lambda seen: (seen - 0.1) / 0.5, env.observation_space)


def mirrored(env):
    return TransformAction(env, lambda action: 4 - action, env.action_space)


CASES = {
    "none": ({}, []),
    "flattened": ({}, [FlattenObservation]),
    "with fixed statistics": ({}, [halved, FlattenObservation]),
    "in another order": ({}, [FlattenObservation, halved]),
    "with running statistics": ({}, [NormalizeObservation]),
    "four frames at once": ({}, [partial(FrameStackObservation, stack_size=4)]),
    "other actions": ({}, [mirrored]),
    "speeds alone": (acting("DiscreteMetaAction", lateral=False), []),
    "steering alone": (acting("ContinuousAction", longitudinal=False), []),
    "a bicycle": (acting("ContinuousAction", dynamical=True), []),
    "a range of speeds": (acting("ContinuousAction", speed_range=[5, 25]), []),
    "numbers for continuous actions": (acting("DiscreteAction", steering_range=[-0.01, 0.01]), []),
    "rescaled actions": (CONTINUOUS, [partial(RescaleAction, min_action=0.0, max_action=1.0)]),
    "clipped actions": (CONTINUOUS, [ClipAction, FlattenObservation]),
    "actions that stick by chance": ({}, [partial(StickyAction, repeat_action_probability=0.5)]),
    "each action three times": ({"policy_frequency": 5}, [partial(MaxAndSkipObservation, skip=3)]),
    "episodes that end before the run": ({}, [partial(TimeLimit, max_episode_steps=3)]),
    "another kind of observation": (
        {"observation": {"type": "OccupancyGrid"}},
        [FlattenObservation, partial(FrameStackObservation, stack_size=2)],
    ),
}


@pytest.mark.filterwarnings("ignore:.*precision lowered by casting")
@pytest.mark.parametrize(
    "case", mostly_oracle(CASES, "with running statistics", "clipped actions", "a bicycle")
)
def test_wrapped_policy_matches_the_plain_gymnasium_loop(case, monkeypatch):
    config, wrappers = CASES[case]
    world = World("highway-v0", config=config, duration=4.0, wrappers=wrappers, ends="duration")
    listener = Listener(world.environment.make().action_space)
    trace = world.rollout(SCENARIO, lambda: listener)

    monkeypatch.setattr(Staged, "trace", trace)
    monkeypatch.setitem(
        gymnasium.registry, "staged-v0", gymnasium.envs.registration.EnvSpec("staged-v0", Staged)
    )
    env = gymnasium.make("staged-v0", config={**config, "duration": 1000}, disable_env_checker=True)
    for wrapper in wrappers:
        env = wrapper(env)
    expected = Listener(env.action_space)
    seen, _ = env.reset(seed=SCENARIO.seed)
    log = env.unwrapped.road.step = StateLog(env.unwrapped.road)
    while len(log.rows) < trace.ticks:
        seen, *_ = env.step(expected(seen))

    assert len(listener.seen) == len(expected.seen) > 3
    assert all(np.array_equal(a, b) for a, b in zip(listener.seen, expected.seen, strict=True))
    assert all(
        np.array_equal(a, b) for a, b in zip(listener.actions, expected.actions, strict=True)
    )
    assert np.array_equal(np.array(log.rows[: trace.ticks]), trace.states[1:, :, : SPEED + 1])
    assert len(trace.actions) == len(listener.actions)


class Repeating(HighwayEnv):
    def step(self, action):
        super().step(action)
        return super().step(action)


class Hurried(HighwayEnv):
    def reset(self, **options):
        first = super().reset(**options)
        self.config["policy_frequency"] = 3
        return first


@pytest.mark.parametrize(("entry_point", "wrappers", "every"), [
    (HighwayEnv, [partial(MaxAndSkipObservation, skip=3)], 45),
    (Repeating, None, 30),
    (Repeating, [partial(MaxAndSkipObservation, skip=2)], 60),
    (Hurried, None, 5),
    (HighwayEnv, None, 15),
])  # fmt: skip
def test_times_of_decisions_are_those_at_which_the_policy_was_asked(
    entry_point, wrappers, every, register
):
    register("mine-v0", entry_point=entry_point)
    world = World("mine-v0", duration=8.0, wrappers=wrappers)
    trace = world.rollout(SCENARIO, lambda: Listener(gymnasium.spaces.Discrete(5)))
    assert list(trace.decision_ticks) == list(range(0, trace.ticks, every))
    assert len(trace.decision_ticks) == len(trace.actions) > 1
    assert bool(trace.decided) == (every != trace.physics_hz // trace.ads_hz)


class Drawn(HighwayEnv):
    def reset(self, **options):
        first = super().reset(**options)
        self.config["policy_frequency"] = int(self.np_random.choice((3, 5)))
        return first


def test_drawn_rate_of_decisions_is_that_of_the_run(register):
    register("mine-v0", entry_point=Drawn)
    world, rates = World("mine-v0", duration=3.0), set()
    for seed in range(6):
        scenario = replace(SCENARIO, seed=seed)
        trace, again = world.rollout(scenario, IDLE), world.rollout_in_gym(scenario, IDLE)
        assert list(trace.decision_ticks) == list(range(0, trace.ticks, 15 // trace.ads_hz))
        assert (trace.decided, trace.ads_hz) == (again.decided, again.ads_hz) == ((), again.ads_hz)
        assert len(trace.actions) == len(trace.decision_ticks)
        rates.add(trace.ads_hz)
    assert rates == {3, 5}


@pytest.mark.parametrize(("name", "rates", "message"), [
    ("policy_frequency", [1, 4], r"config.policy_frequency: expected a divisor of config.simulation_frequency \(15\)"),
    ("simulation_frequency", [15, 30], "expected 15, as after a reset with seed 0, received 30"),
])  # fmt: skip
def test_drawn_rates_that_fit_no_run_are_refused(name, rates, message, register):
    class Unfit(HighwayEnv):
        def reset(self, *, seed=None, options=None):
            first = super().reset(seed=seed, options=options)
            self.config[name] = rates[bool(seed)]
            return first

    register("mine-v0", entry_point=Unfit)
    world = World("mine-v0", duration=3.0)
    for run in (world.rollout, world.rollout_in_gym):
        with pytest.raises(WorldError, match=message):
            run(SCENARIO, IDLE)


def test_readers_of_a_run_use_the_times_of_its_decisions():
    skips = World("highway-v0", duration=8.0, wrappers=[partial(MaxAndSkipObservation, skip=2)])
    trace = skips.rollout(SCENARIO, lambda: lambda seen: 1)
    hit = Collision(
        tick=105,
        time=7.0,
        npc=0,
        side="front",
        cell=None,
        ego_speed=9.0,
        npc_speed=0.0,
        closing_speed=9.0,
    )
    before = before_impact(replace(trace, outcome="collision", collision=hit))
    assert (before.ticks, before.decided, len(before.actions)) == (60, (0, 30), 2)


def test_decision_that_fails_has_its_time_too():
    def failing():
        calls = iter([1, 1])
        return lambda seen: next(calls)

    skips = World("highway-v0", duration=8.0, wrappers=[partial(MaxAndSkipObservation, skip=2)])
    trace = skips.rollout(SCENARIO, failing)
    assert (trace.decision_ticks, len(trace.actions), trace.error.tick) == ((0, 30, 60), 2, 60)
    plain = World("highway-v0", duration=8.0).rollout(SCENARIO, failing)
    assert (list(plain.decision_ticks), len(plain.actions), plain.error.tick) == (
        [0, 15, 30],
        2,
        30,
    )


def test_each_run_has_fresh_wrappers_and_is_confirmed():
    world = World(
        "highway-v0",
        duration=4.0,
        wrappers=[NormalizeObservation, partial(StickyAction, repeat_action_probability=0.5)],
    )
    traces = [
        world.rollout(SCENARIO, lambda: Listener(world.environment.make().action_space)),
        world.rollout(SCENARIO, lambda: Listener(world.environment.make().action_space)),
        world.rollout_in_gym(SCENARIO, lambda: Listener(world.environment.make().action_space)),
    ]
    assert len({trace.states.tobytes() for trace in traces}) == 1


# --- what a registration adds


def flattened(config=None, render_mode=None):
    """Return a wrapped environment, as an entry point."""
    return FlattenObservation(HighwayEnv(config, render_mode))


@pytest.fixture
def register(monkeypatch):
    """Register an environment for one test, where highway-v0 and its versions observe one beam of a lidar.

    By default they make tables with pandas, which takes three quarters of a run.
    """
    config = HighwayEnv.default_config() | {"observation": {"type": "LidarObservation", "cells": 1}}
    monkeypatch.setattr(HighwayEnv, "default_config", staticmethod(lambda: deepcopy(config)))
    monkeypatch.setattr(gymnasium.envs.registration, "registry", {**gymnasium.registry})
    monkeypatch.setattr(gymnasium, "registry", gymnasium.envs.registration.registry)
    return gymnasium.register


REGISTERED = {
    "by its entry point": {"entry_point": flattened},
    "beside its entry point": {
        "entry_point": HighwayEnv,
        "additional_wrappers": (
            WrapperSpec("Flatten", "gymnasium.wrappers:FlattenObservation", {}),
        ),
    },
}


@pytest.mark.parametrize("how", REGISTERED)
def test_registered_wrapper_is_refused_with_the_way_out(how, register):
    register("mine-v0", **REGISTERED[how])
    message = r"which is registered with these wrappers: FlattenObservation. .*World\('mine-v0', wrappers=\[\]\)"
    with pytest.raises(WorldError, match=message):
        World("mine-v0").check()


@pytest.mark.parametrize("how", REGISTERED)
def test_wrapper_list_is_added_to_the_registered_wrappers(how, register):
    register("mine-v0", **REGISTERED[how])
    for wrappers, shape in [([], (2,)), ([partial(FrameStackObservation, stack_size=3)], (3, 2))]:
        world = World("mine-v0", wrappers=wrappers, duration=2.0)
        listener = Listener(world.environment.make().action_space)
        world.rollout(SCENARIO, lambda listener=listener: listener)
        assert {seen.shape for seen in listener.seen} == {shape}
    assert world.to_dict()["wrappers"] == ["FlattenObservation", "FrameStackObservation"]


def test_default_gymnasium_wrappers_are_no_reason_to_refuse(register):
    register("mine-v0", entry_point=HighwayEnv, max_episode_steps=3)
    assert gymnasium.make("mine-v0").spec.max_episode_steps == 3
    assert World("mine-v0", duration=5.0).rollout(SCENARIO, lambda: lambda seen: 1).duration == 3.0
    assert "wrappers" not in World("mine-v0").to_dict()


def test_registered_configuration_applies_unless_another_is_given(register):
    register(
        "mine-v0",
        entry_point=HighwayEnv,
        kwargs={"config": {"lanes_count": 6, "policy_frequency": 5}},
    )
    for config in (None, {"lanes_count": 3}):
        plain = gymnasium.make(
            "mine-v0", **({} if config is None else {"config": config})
        ).unwrapped
        world = World("mine-v0", config=config)
        assert (world.lanes, world.ads_hz) == (
            plain.config["lanes_count"],
            plain.config["policy_frequency"],
        )


class Doubled(HighwayEnv):
    def reset(self, **options):
        seen, info = super().reset(**options)
        return 2 * seen, info

    def step(self, action):
        seen, *others = super().step(action)
        return (2 * seen, *others)


class Unhurried(HighwayEnv):
    def reset(self, **options):
        first = super().reset(**options)
        self.vehicle.target_speed = 12.0
        return first


def test_what_a_custom_reset_does_to_the_ego_holds_in_runs(register):
    register("mine-v0", entry_point=Unhurried)
    world = World("mine-v0", duration=8.0)
    trace = world.rollout(SCENARIO, lambda: lambda seen: 1)
    assert trace.ego[-1, 3] == pytest.approx(12.0, abs=0.1)
    assert np.array_equal(
        trace.states, world.rollout_in_gym(SCENARIO, lambda: lambda seen: 1).states
    )
    planned = World("mine-v0", duration=2.0, planner_hz=5)
    assert planned.rollout(SCENARIO, lambda: lambda seen: (0.0, 0.0)).ego[-1, 3] == pytest.approx(
        SCENARIO.ego_speed
    )


class Heading(HighwayEnv):
    """A straight road whose reset gives its ego a goal, which its step reads, and which keeps its ego."""

    def _reset(self):
        super()._reset()
        self.ego, self.vehicle.goal = self.vehicle, 300.0

    def step(self, action):
        assert self.ego is self.vehicle
        return super().step(4 if self.ego.position[0] > self.vehicle.goal else action)


@pytest.mark.parametrize("wrappers", [None, []])
def test_ego_of_a_run_is_what_the_environment_keeps_of_its_own(wrappers, register):
    register("mine-v0", entry_point=Heading)
    world = World("mine-v0", duration=12.0, wrappers=wrappers)
    trace = world.rollout(replace(SCENARIO, ego_speed=25.0), IDLE)
    speed = trace.ego[:, SPEED]
    assert speed[trace.ego[:, 0] > 350.0].max() < speed[trace.ego[:, 0] < 300.0].min()


KEEPERS = [lambda ego: [ego], lambda ego: {"ego": ego}, lambda ego: SimpleNamespace(of=ego)]


@pytest.mark.parametrize("wrappers", [None, []])
@pytest.mark.parametrize("keeper", KEEPERS, ids=["list", "dict", "helper"])
def test_ego_that_is_kept_where_no_run_replaces_it_is_refused(keeper, wrappers, register):
    class Keeping(HighwayEnv):
        def _reset(self):
            super()._reset()
            self.shield = keeper(self.vehicle)

    register("mine-v0", entry_point=Keeping)
    with pytest.raises(
        WorldError, match="received Keeping, whose `shield` still has the ego of the last reset"
    ):
        World("mine-v0", duration=3.0, wrappers=wrappers).rollout(SCENARIO, IDLE)
    assert World("mine-v0", duration=3.0).rollout(SCENARIO, Vehicle).ticks > 0


class Truck(MDPVehicle):
    """A long vehicle that gains speed slowly, the more so the heavier it is."""

    LENGTH = 8.0

    def __init__(self, *args, mass=2.0, **kwargs):
        super().__init__(*args, **kwargs)
        self.mass = mass

    def speed_control(self, target_speed):
        return super().speed_control(target_speed) / self.mass


class Freight(HighwayEnv):
    def _create_vehicles(self):
        super()._create_vehicles()
        usual = self.vehicle
        self.vehicle = Truck(
            self.road, usual.position, usual.heading, usual.speed, target_speeds=[20, 28], mass=3.0
        )
        self.road.vehicles[self.road.vehicles.index(usual)] = self.vehicle


@pytest.mark.parametrize("wrappers", [None, []])
def test_ego_is_of_the_class_of_which_the_environment_makes_it(wrappers, register):
    register("mine-v0", entry_point=Freight)
    world, faster = World("mine-v0", duration=3.0, wrappers=wrappers), 3
    scenario = Scenario(npcs=[[PositionInstruction(6, 10.0)]], ego_lane=1, ego_speed=20.0)
    trace = world.rollout(scenario, lambda: lambda seen: faster)
    env = gymnasium.make("mine-v0", config={"vehicles_count": 0}).unwrapped
    env.reset(seed=0)
    x, y, heading, speed = trace.ego[0, :4]
    env.vehicle = Truck(env.road, [x, y], heading, speed, target_speeds=[20, 28], mass=3.0)
    env.road.vehicles = [env.vehicle]
    for _ in range(3):
        env.step(faster)
    assert trace.ego[-1, :4] == pytest.approx(
        [*env.vehicle.position, env.vehicle.heading, env.vehicle.speed]
    )
    assert trace.sizes[0][0] == 8.0


class Icy(Road):
    """A road on which the first vehicle slows down from 250 m on, whatever it wants."""

    def act(self):
        super().act()
        self.slow()

    def slow(self):
        if self.vehicles[0].position[0] > 250.0:
            self.vehicles[0].action["acceleration"] = -4.0


class Alps(HighwayEnv):
    def _create_road(self):
        super()._create_road()
        self.road = Icy(self.road.network, np_random=self.np_random)


@pytest.mark.parametrize(
    ("options", "ads", "speed"),
    [({}, IDLE, 20.0), ({"wrappers": []}, IDLE, 20.0),
     ({"planner_hz": 5}, lambda: lambda seen: (0.0, 0.0), 22.0), ({}, IDMVehicle, 22.0)],
    ids=["policy", "wrapped", "planner", "class"],
)  # fmt: skip
def test_what_the_act_of_an_own_road_does_to_the_ego_holds_in_runs(options, ads, speed, register):
    register("mine-v0", entry_point=Alps)
    scenario = Scenario(npcs=[[PositionInstruction(6, 10.0)]], ego_lane=1, ego_speed=22.0)
    ego = World("mine-v0", duration=5.0, **options).rollout(scenario, ads).ego
    on_ice = ego[:-1, 0] > 250.0
    assert ego[:-1][~on_ice, SPEED][-1] == pytest.approx(speed, abs=0.2)
    assert np.diff(ego[:, SPEED])[on_ice] == pytest.approx(-4.0 / 15)


class Harder(HighwayEnv):
    episodes = 0

    def _reset(self):
        type(self).episodes += 1
        self.config["lanes_count"] = 3 + type(self).episodes // 3
        super()._reset()


class Chancy(HighwayEnv):
    def _create_vehicles(self):
        super()._create_vehicles()
        self.vehicle.position[0] += np.random.default_rng().uniform()


class Lessons(gymnasium.Wrapper):
    lessons = 0

    def reset(self, **kwargs):
        self.lessons += 1
        self.unwrapped.config["lanes_count"] = 4 + (self.lessons > 1)
        return self.env.reset(**kwargs)


@table(("cls", "wrappers", "received"), [
    (Harder, None, "Harder, where config['lanes_count'] is 4 after the first reset and 5 after a later one"),
    (Chancy, None, "Chancy, where vehicle is MDPVehicle at *"),
    (HighwayEnv, [Lessons], "HighwayEnv in Lessons, where config['lanes_count'] is 4 after the first"),
])  # fmt: skip
def test_environment_whose_resets_differ_is_refused(cls, wrappers, received, register):
    Harder.episodes = 0
    register(f"{cls.__name__}-v0", entry_point=cls)
    with pytest.raises(WorldError) as told:
        World(f"{cls.__name__}-v0", wrappers=wrappers).check()
    assert fnmatch(str(told.value), f"*received {received.replace('[', '[[]')}*")


class Weighed(Truck):
    def __init__(self, road, position, heading, speed, mass):
        super().__init__(road, position, heading, speed, mass=mass)


class Depot(HighwayEnv):
    """One whose ego can be made only with an argument that nothing else knows."""

    def _create_vehicles(self):
        self.vehicle = Weighed(self.road, [200.0, 4.0], 0.0, 20.0, 3.0)
        self.road.vehicles.append(self.vehicle)


def test_ego_whose_class_needs_more_arguments_is_refused(register):
    register("mine-v0", entry_point=Depot)
    with pytest.raises(
        WorldError, match=r"Weighed\(road, .*'mass'\). Give the other parameters default values"
    ):
        World("mine-v0").rollout(SCENARIO, lambda: lambda seen: 1)


class Loaded(HighwayEnv):
    def _create_vehicles(self):
        super()._create_vehicles()
        own = type("Truck", (type(self.vehicle),), {"load": lambda self: 1.0})
        place = self.vehicle.position, self.vehicle.heading, self.vehicle.speed
        self.controlled_vehicles = [own(self.road, *place)]


class Weighing(Loaded):
    def step(self, action):
        self.vehicle.load()
        return super().step(action)


class Watching(Loaded):
    def define_spaces(self):
        super().define_spaces()
        kind = type("Weight", (type(self.observation_type),), {})
        kind.observe = lambda seen: (self.vehicle.load(), super(kind, seen).observe())[1]
        self.observation_type.__class__ = kind


@pytest.mark.parametrize(("cls", "wrappers"), [(Weighing, None), (Weighing, []), (Watching, None)])
def test_environment_may_ask_the_ego_of_its_own_class(cls, wrappers, register):
    register("mine-v0", entry_point=cls)
    assert (
        World("mine-v0", duration=3.0, wrappers=wrappers).rollout(SCENARIO, IDLE).outcome == "safe"
    )


class Wet(HighwayEnv):
    def _simulate(self, action=None):
        self.vehicle.speed *= 0.9
        super()._simulate(action)


class Wide(HighwayEnv):
    def _create_road(self):
        self.config["lanes_count"] = int(self.np_random.integers(2, 50))
        super()._create_road()


def test_random_straight_road_is_the_same_in_each_session(register):
    register("mine-v0", entry_point=Wide)
    assert len({World("mine-v0").lanes for _ in range(4)}) == 1


def test_custom_step_is_used_on_straight_roads_too(register):
    register("mine-v0", entry_point=Doubled)
    # a policy with one action
    own, stock = (Listener(gymnasium.spaces.Discrete(1)) for _ in range(2))
    World("mine-v0", duration=2.0).rollout(SCENARIO, lambda: own)
    World("highway-v0", duration=2.0).rollout(SCENARIO, lambda: stock)
    assert np.array_equal(own.seen[0], 2 * stock.seen[0])
    assert np.array_equal(own.seen[1], 2 * stock.seen[1])


class Bothered(HighwayEnv):
    """A straight road on which ``bother`` does something to other vehicles before each step from 2 s."""

    def step(self, action):
        if self.time >= 2.0:
            self.bother()
        return super().step(action)

    def other(self):
        x, y = self.vehicle.position
        return Vehicle(self.road, np.array([x + 40.0, y]), 0.0, 0.0)


class Spawning(Bothered):
    def bother(self):
        self.road.vehicles.append(self.other())


class Braking(Bothered):
    def bother(self):
        self.road.vehicles[-1].speed = 5.0


class Pushing(Bothered):
    def bother(self):
        self.road.vehicles[1].position[0] += 5.0


class Sorting(Bothered):
    def bother(self):
        self.road.vehicles = sorted(self.road.vehicles, key=lambda each: each.position[0])


class Choosing(HighwayEnv):
    def reset(self, **options):
        first = super().reset(**options)
        self.road.vehicles[1:] = []
        return first


class Crowding(HighwayEnv):
    def reset(self, **options):
        first = super().reset(**options)
        self.road.vehicles.append(Replayed(self.road, [500.0, 0.0]))
        return first


class Swapping(HighwayEnv):
    def reset(self, **options):
        first = super().reset(**options)
        self.vehicle = type(self.vehicle)(self.road, self.vehicle.position, speed=20.0)
        return first


@pytest.mark.parametrize("wrappers", [None, [FlattenObservation]])
@pytest.mark.parametrize(("cls", "received"), [
    (Spawning, "whose `step` adds 1 vehicle at 3.0 s"),
    (Braking, "whose `step` sets the speed of NPC 1 from 2*.* to 5.0 m/s at 3.0 s"),
    (Pushing, "whose `step` moves NPC 0 from (2*.*, 4.0) m at 3.0 s"),
    (Choosing, "whose `reset` removes 2 vehicles at 0.0 s"),
    (Crowding, "whose `reset` adds 1 vehicle at 0.0 s"),
    (Swapping, "whose `reset` replaces the ego at 0.0 s"),
    (Sorting, ""),
])  # fmt: skip
def test_environment_that_changes_the_vehicles_of_a_run_is_refused(
    cls, received, wrappers, register
):
    register("mine-v0", entry_point=cls)
    world = World("mine-v0", duration=6.0, wrappers=wrappers)
    scenario = Scenario(
        npcs=[[PositionInstruction(2, 22.0)], [PositionInstruction(6, 22.0)]], ego_lane=1
    )
    if not received:
        assert world.rollout(scenario, IDLE).ticks == 90
        return
    with pytest.raises(WorldError) as refused:
        world.rollout(scenario, IDLE)
    assert fnmatch(
        str(refused.value),
        f"*received {cls.__name__}*, {received}. If the environment has other vehicles, create them in `_reset`, *",
    )


class Slowing(HighwayEnv):
    def reset(self, **options):
        super().reset(**options)
        for each in self.road.vehicles[1:]:
            each.speed *= 0.5
            each.target_speed = 5.0
            each.position[0] += 3.0
            each.heading = 1.0
        return self.observation_type.observe(), {}


class Warming(HighwayEnv):
    def reset(self, **options):
        super().reset(**options)
        seen, *_, info = super().step(0)
        return seen, info


def test_reset_does_nothing_to_npcs(register):
    slowing, stock, warming = (
        World("mine-v0", duration=4.0),
        World("highway-v0", duration=4.0),
        "warming-v0",
    )
    register("mine-v0", entry_point=Slowing)
    register(warming, entry_point=Warming)
    one, other, third = (Listener(gymnasium.spaces.Discrete(1)) for _ in range(3))
    expected = stock.rollout(SCENARIO, lambda: other).states
    assert np.allclose(slowing.rollout(SCENARIO, lambda: one).states, expected, atol=1e-9)
    assert np.array_equal(one.seen, other.seen)
    warmed = World(warming, duration=4.0).rollout(SCENARIO, lambda: third)
    assert np.allclose(warmed.states, expected, atol=1e-9), (
        "its first second is the one that the reset drives"
    )
    assert np.array_equal(third.seen[0], other.seen[1])


class Configured(gymnasium.Wrapper):
    changes = None
    by_options = False

    def reset(self, *, seed=None, options=None):
        if self.by_options:
            return self.env.reset(seed=seed, options={"config": self.changes})
        self.unwrapped.config.update(self.changes)
        return self.env.reset(seed=seed, options=options)


@pytest.mark.parametrize("by_options", [False, True], ids=["config", "options"])
def test_configuration_that_wrappers_give_holds_in_runs(by_options):
    changes = {
        "policy_frequency": 5,
        "simulation_frequency": 10,
        "lanes_count": 5,
        "observation": {"type": "Kinematics", "vehicles_count": 3},
        "action": {"type": "DiscreteMetaAction", "target_speeds": [10, 15]},
        "vehicles_count": 7,
    }
    wrapper = type("Given", (Configured,), {"changes": changes, "by_options": by_options})
    world, plain = (
        World("highway-v0", wrappers=[wrapper], duration=4.0),
        World("highway-v0", changes, duration=4.0),
    )
    assert (world.lanes, world.physics_hz, world.ads_hz) == (5, 10, 5)
    assert world.observation_space == plain.observation_space
    one, other = (Listener(gymnasium.spaces.Discrete(1)) for _ in range(2))
    scenario = replace(SCENARIO, ego_lane=4, npcs=[[PositionInstruction(3, 15.0)]])
    wrapped, expected = world.rollout(scenario, lambda: one), plain.rollout(scenario, lambda: other)
    assert np.allclose(wrapped.states, expected.states, atol=1e-9)
    assert len(wrapped.states) == 41
    assert np.allclose(one.seen, other.seen, atol=1e-6)


class Fast(HighwayEnv):
    def reset(self, *, seed=None, options=None):
        gymnasium.Env.reset(self, seed=seed)
        top = 30 if self.np_random.uniform() < 0.5 else 25
        self.config["action"] = {"type": "DiscreteMetaAction", "target_speeds": [20, top]}
        return super().reset(options=options)


def test_speeds_of_actions_are_those_that_the_reset_of_the_run_draws(register):
    register("mine-v0", entry_point=Fast)
    world, plain, tops = World("mine-v0", duration=20.0), gymnasium.make("mine-v0"), set()
    for seed in range(4):
        plain.reset(seed=seed)
        tops.add(top := plain.unwrapped.vehicle.target_speeds[-1])
        scenario = Scenario(
            npcs=[[PositionInstruction(6, 20.0)]], seed=seed, gene_seconds=10.0, ego_speed=22.0
        )
        assert world.rollout(scenario, lambda: lambda seen: 3).ego[-1, SPEED] == pytest.approx(
            top, abs=0.1
        )
    assert tops == {25, 30}


class Burning(HighwayEnv):
    """One whose reward burns fuel, and counts how often."""

    def _reset(self):
        super()._reset()
        self.fuel, self.vehicle.calls = 1.0, []

    def _reward(self, action):
        self.fuel -= 0.01
        self.vehicle.calls.append(action)
        return super()._reward(action)


class Urging(HighwayEnv):
    """One whose rewards slow a fast ego down, by a method of their own, and whose end counts."""

    def _rewards(self, action):
        self.calm(self.vehicle)
        return super()._rewards(action)

    def calm(self, vehicle):
        if vehicle.speed > 100:
            vehicle.target_speed = 20.0

    def _is_terminated(self):
        self.asked: int = 1
        return super()._is_terminated()


class Scoring(HighwayEnv):
    def _reward(self, action):
        found = {}
        found["twice"] = 2 * super()._reward(action)
        return found["twice"]


def test_rewards_that_change_the_state_are_named_where_no_run_calls_them(register):
    register("mine-v0", entry_point=Burning)
    assert World("mine-v0").left_out == {"_reward": ("fuel", "vehicle.calls")}
    assert World("mine-v0", wrappers=[]).left_out == World("mine-v0", planner_hz=5).left_out == {}
    register("third-v0", entry_point=Urging)
    rewards = {"_rewards": ("vehicle.target_speed",)}
    assert World("third-v0").left_out == rewards
    assert World("third-v0", ends="duration").left_out == rewards | {"_is_terminated": ("asked",)}
    register("other-v0", entry_point=Scoring)
    assert World("other-v0").left_out == World("highway-v0").left_out == {}


class Following(HighwayEnv):
    """A straight road whose info, also that of its reset, is about the nearest other vehicle."""

    def _info(self, seen, action=None):
        ego, *others = self.road.vehicles
        return super()._info(seen, action) | {
            "nearest": min(abs(each.position[0] - ego.position[0]) for each in others)
        }


@pytest.mark.parametrize("wrappers", [None, [FlattenObservation]])
def test_environment_that_looks_at_its_traffic_in_reset_runs_with_the_npcs_alone(
    wrappers, register
):
    register("mine-v0", entry_point=Following)
    own, stock = (
        World("mine-v0", duration=3.0, wrappers=wrappers),
        World("highway-v0", duration=3.0),
    )
    expected = stock.rollout(SCENARIO, lambda: lambda seen: 1)
    for run in (own.rollout, own.rollout_in_gym):
        states = run(SCENARIO, lambda: lambda seen: 1).states
        assert states.shape == expected.states.shape
        assert np.abs(states - expected.states).max() < 1e-9
    assert own.to_dict()["config"] == stock.to_dict()["config"]


class Roadworks(HighwayEnv):
    """A straight road with an obstacle in lane 1, and a mark in lane 2 that vehicles can drive over."""

    def _create_road(self):
        super()._create_road()
        self.road.objects += [Obstacle(self.road, [300.0, 4.0]), Landmark(self.road, [300.0, 8.0])]


AT_ONCE = [[PositionInstruction(6, 20.0)]]


@pytest.mark.parametrize("wrappers", [None, [FlattenObservation]])
@pytest.mark.parametrize(
    "factory", [IDLE, Vehicle, lambda: lambda seen: (0.0, 0.0)], ids=["policy", "class", "planner"]
)
def test_contact_with_an_obstacle_is_a_collision_for_which_the_ego_is_responsible(
    factory, wrappers, register
):
    register("mine-v0", entry_point=Roadworks)
    world = World("mine-v0", duration=12.0, wrappers=wrappers)
    if factory not in (IDLE, Vehicle):
        world = World("mine-v0", duration=12.0, planner_hz=5)
    scenario = Scenario(npcs=AT_ONCE, ego_lane=1)
    first, again = world.rollout(scenario, factory), world.rollout_in_gym(scenario, factory)
    assert disagreement(Run(first), Run(again)) == ""
    run, hit = Run(first), first.collision
    assert (run.outcome, hit.npc, hit.side, hit.cell, hit.npc_speed) == (
        "collision",
        None,
        "front",
        None,
        0.0,
    )
    assert 0 <= 300.0 - 1.0 - (first.ego[-2, 0] + 2.5) < hit.ego_speed / first.physics_hz, (
        "the last tick before it"
    )
    assert (run.responsibility, run.event_npc, run.off_road) == ("ego", None, False)
    assert run.explain().startswith(f"The ego hit a fixed object after {hit.time:.1f} s")
    assert "The ego is responsible, because a fixed object does not move." in run.explain()
    beside = world.rollout(replace(scenario, ego_lane=2), factory)
    assert beside.outcome == "safe"


def test_npc_at_an_obstacle_makes_a_run_invalid(register):
    register("mine-v0", entry_point=Roadworks)
    world = World("mine-v0", duration=12.0)
    ahead = Scenario(npcs=[[PositionInstruction(2, 20.0)]], ego_lane=1)
    for run in (world.rollout, world.rollout_in_gym):
        trace = run(ahead, IDLE)
        assert (trace.outcome, trace.collision) == ("invalid", None)
        assert trace.states[-1, 1, 0] + 2.5 > 299.0
        assert "or one touched a fixed object" in Run(trace).explain()


class Littered(HighwayEnv):
    def reset(self, **options):
        first = super().reset(**options)
        self.road.objects.append(Obstacle(self.road, [300.0, 4.0]))
        return first


@pytest.mark.parametrize("wrappers", [None, [FlattenObservation]])
def test_obstacle_that_a_custom_reset_puts_there_is_one_like_others(wrappers, register):
    register("mine-v0", entry_point=Littered)
    register("other-v0", entry_point=Roadworks)
    own, other = (
        World(f"{name}-v0", duration=12.0, wrappers=wrappers) for name in ("mine", "other")
    )
    scenario, counts = Scenario(npcs=AT_ONCE, ego_lane=1), []

    def counting(env):
        return TransformObservation(
            env, lambda seen: counts.append(len(env.unwrapped.road.objects)) or seen, None
        )

    expected = other.rollout(scenario, IDLE)
    for run in (own.rollout, own.rollout_in_gym):
        trace = run(scenario, IDLE)
        assert (trace.outcome, trace.collision.npc) == ("collision", None)
        assert trace.obstacles == expected.obstacles
        assert np.allclose(trace.states, expected.states, atol=1e-9)
    World("mine-v0", duration=3.0, wrappers=[counting]).rollout(scenario, IDLE)
    assert set(counts) == {1}


class Chanced(HighwayEnv):
    def _reset(self):
        super()._reset()
        self.road.objects.append(
            Obstacle(self.road, [float(self.np_random.uniform(250.0, 400.0)), 4.0])
        )


def test_random_obstacle_is_where_a_reset_with_seed_0_and_no_traffic_puts_it(register):
    register("mine-v0", entry_point=Chanced)
    places = []
    for count in (0, 50):
        plain = gymnasium.make("mine-v0", config={"vehicles_count": count})
        plain.reset(seed=0)
        places.append(plain.unwrapped.road.objects[0].position[0])
    world = World("mine-v0", duration=2.0, config={"vehicles_count": 50})
    trace = world.rollout(Scenario(npcs=AT_ONCE, ego_lane=2, seed=7), IDLE)
    assert trace.obstacles[0][0] == places[0] != places[1]


class Falling(Roadworks):
    def step(self, action):
        if 3.0 <= self.time < 3.1:
            self.fall()
        return super().step(action)

    def fall(self):
        self.road.objects.append(Obstacle(self.road, [500.0, 0.0]))


class Rolling(Falling):
    def fall(self):
        self.road.objects[0].position = np.array([400.0, 4.0])


class Strewing(Roadworks):
    def reset(self, **options):
        first = super().reset(**options)
        self.road.objects.append(Obstacle(self.road, [400.0 + 100 * self.np_random.random(), 0.0]))
        return first


class Marking(Falling):
    def fall(self):
        self.road.objects.append(Landmark(self.road, [500.0, 0.0]))


@pytest.mark.parametrize("wrappers", [None, [FlattenObservation]])
@pytest.mark.parametrize(("cls", "received"), [
    (Falling, "with an additional object at (500.0, 0.0) m at 4.0 s"),
    (Rolling, "with a changed object at (300.0, 4.0) m at 4.0 s"),
    (Strewing, "with a changed object at (4"),
    (Marking, ""),
])  # fmt: skip
def test_objects_that_do_not_stay_as_they_are_are_refused(cls, received, wrappers, register):
    register("mine-v0", entry_point=cls)
    world, scenario = (
        World("mine-v0", duration=6.0, wrappers=wrappers),
        Scenario(npcs=AT_ONCE, ego_lane=3),
    )
    if not received:
        assert world.rollout(scenario, IDLE).outcome == "safe"
        return
    for run in (world.rollout, world.rollout_in_gym):
        with pytest.raises(WorldError, match=re.escape(f"{cls.__name__}, {received}")):
            run(scenario, IDLE)


class Lorry(Vehicle):
    LENGTH = 16.0


def test_ego_does_not_start_at_an_obstacle(register):
    class Blocked(HighwayEnv):
        def _create_road(self):
            super()._create_road()
            places = [[202.5, 4.0], [244.0, 8.0], [194.0, 0.0], [150.0, 12.0]]
            self.road.objects += [Obstacle(self.road, each) for each in places]

    register("mine-v0", entry_point=Blocked)
    world = World("mine-v0", duration=12.0)
    ahead = (
        "for 2 s at 22 m/s from the ego's start at (200, 4) m, received lane 1, which "
        "has an object at (202.5, 4.0) m"
    )
    blocked = Scenario(npcs=AT_ONCE, ego_lane=1, ego_speed=22.0)
    with pytest.raises(ScenarioError, match=re.escape(f"{ahead}. Write ego_lane=0")):
        world.rollout(blocked, IDLE)
    with pytest.raises(
        ScenarioError, match=re.escape("received lane 2, which has an object at (244.0, 8.0) m")
    ):
        world.rollout(replace(blocked, ego_lane=2), IDLE)
    slow = world.rollout(replace(blocked, ego_lane=2, ego_speed=20.0), lambda: lambda seen: 4)
    assert (slow.collision.npc, slow.ticks > 15) == (None, True)
    for run in (world.rollout, world.rollout_in_gym):
        free = replace(blocked, ego_lane=0)
        assert run(free, IDLE).ticks > 0
        with pytest.raises(
            ScenarioError, match=re.escape("received lane 0, which has an object at (194.0, 0.0) m")
        ):
            run(free, Lorry)


def test_finding_at_an_obstacle_is_saved_and_read(register, tmp_path):
    register("mine-v0", entry_point=Roadworks)
    run = Run(World("mine-v0", duration=12.0).rollout(Scenario(npcs=AT_ONCE, ego_lane=1), IDLE))
    failure = Failure(
        kind="AssertionError", message="assert not run.collision", assertion="not run.collision"
    )
    expect = Expect.from_run(run, failure)
    assert (expect.outcome, expect.npc, expect.cell, expect.side) == (
        "collision",
        None,
        None,
        "front",
    )
    assert expect.brief == "The ego hit a fixed object after 4.8 s, closing at 20.0 m/s"
    assert is_same_event(expect, run, failure)
    for given in (expect, replace(expect, npc=0), replace(expect, cell=Cell.FRONT)):
        path = tmp_path / f"front-{given.npc}-{given.cell}.pafot.yaml"
        finding = plain_finding(expect=given)
        write(path, finding)
        if given is expect:
            assert load(path).expect == expect
            continue
        with pytest.raises(CorpusError, match="expect"):
            load(path)


ROAD = (
    "lanes_count speed_limit length no_lanes roundabout_radius roundabout_lanes before_merge_length after_merge_length "
    "converge_merge_length parallel_merge_length block_lane force_decision add_walls"
)
RUN = "simulation_frequency duration destination state_noise derivative_noise steering_range"
REFUSED = "controlled_vehicles manual_control"
REWARDS = (
    "action_reward arrived_reward collision_reward goal_reward high_speed_reward lane_centering_cost "
    "lane_centering_reward lane_change_reward left_lane_constraint left_lane_reward merging_speed_reward "
    "normalize_reward reward_speed_range reward_weights right_lane_reward success_goal_reward"
)
DRAWING = (
    "centering_position offscreen_rendering real_time_rendering render_agent scaling screen_height screen_width "
    "show_trajectories"
)
NAMED = "ego_spacing initial_lane_id offroad_terminal terminate_off_road"


def test_every_option_of_highway_env_is_used_refused_or_named():
    entries = [
        spec
        for spec in gymnasium.registry.values()
        if str(spec.entry_point).startswith("highway_env.")
    ]
    known = {key for spec in entries for key in load_env_creator(spec.entry_point).default_config()}
    texts = " ".join((ROAD, RUN, REFUSED, REWARDS, DRAWING, NAMED))
    assert known == {*TRAFFIC_OPTIONS, *POLICY_OPTIONS, CONNECTED, *texts.split()}


@table(("env_id", "config", "names"), [
    ("highway-v0", {"initial_lane_id": 0, "vehicles_density": 2, "offroad_terminal": True, "lanes_count": 3},
     {"write ego_lane=0": ["initial_lane_id"], TRAFFIC_TOLD: ["vehicles_density"]}),
    ("highway-v0", {"ego_spacing": 3}, {"the world's headway= sets the gaps at the start": ["ego_spacing"]}),
    ("highway-v0", {"initial_lane_id": None, "offroad_terminal": False, "collision_reward": -9}, {}),
    ("intersection-v0", {"spawn_probability": 0, "initial_vehicle_count": 3},
     {TRAFFIC_TOLD: ["spawn_probability", "initial_vehicle_count"]}),
    ("intersection-v0", {"offroad_terminal": True, "destination": "o2"}, {}),
    ("racetrack-v1", {"terminate_off_road": False, "other_vehicles": 2},
     {"runs on this road end when the ego leaves it": ["terminate_off_road"], TRAFFIC_TOLD: ["other_vehicles"]}),
])  # fmt: skip
def test_option_that_something_replaces_is_named_with_what_does(env_id, config, names):
    assert World(env_id, config=config).options_without_effect(drives_itself=False) == names


def test_option_that_ends_episodes_is_named_where_the_duration_ends_runs():
    world = World("highway-v0", config={"offroad_terminal": True}, ends="duration")
    told = "runs continue after the ego leaves a straight road, which run.off_road reports"
    assert world.options_without_effect(drives_itself=False) == {told: ["offroad_terminal"]}


@table(("kind", "planner_hz", "names"), [
    # an observation may look for vehicles of that class
    ({"drives_itself": False}, None, [CONNECTED]),
    ({"drives_itself": False}, 5, [CONNECTED, "other_vehicles_type"]),
    ({"drives_itself": True}, None, ["other_vehicles_type"]),  # an IDMVehicle looks there
    # what it simulates has vehicles of that class
    ({"drives_itself": False, "simulates": True}, None, []),
])  # fmt: skip
def test_option_for_highway_envs_own_driver_is_named_where_nobody_drives_so(
    kind, planner_hz, names
):
    config = {
        CONNECTED: True,
        "other_vehicles_type": "highway_env.vehicle.behavior.DefensiveVehicle",
    }
    found = World("intersection-v0", config=config, planner_hz=planner_hz).options_without_effect(
        **kind
    )
    assert found == ({TRAFFIC_TOLD: names} if names else {})


class Refusing(HighwayEnv):
    """An environment that cannot be reset. It counts the attempts."""

    attempts = 0

    def _create_vehicles(self):
        type(self).attempts += 1
        raise ValueError("no map")


def test_environment_that_cannot_be_reset_is_not_blamed_on_a_configuration_that_nobody_gave(
    register, monkeypatch
):
    monkeypatch.setattr(Refusing, "attempts", 0)
    register("mine-v0", entry_point=Refusing)
    with pytest.raises(
        WorldError, match=r"env_id: expected an environment that .* received 'mine-v0'. .*no map"
    ):
        World("mine-v0").check()
    assert Refusing.attempts == 2
    given = r"config: expected a configuration that .* received \{'duration': 9\}. .*no map"
    with pytest.raises(WorldError, match=given):
        World("mine-v0", config={"duration": 9}).check()
    monkeypatch.setattr(Refusing, "attempts", 0)
    with pytest.raises(WorldError, match="no map"):
        World("mine-v0", config={"vehicles_count": 10**9}).check()
    assert Refusing.attempts == 1, "not tried with traffic that takes minutes"


def test_a_simulation_of_its_own_is_too(register):
    register("mine-v0", entry_point=Wet)
    trace = World("mine-v0", duration=3.0).rollout(SCENARIO, lambda: lambda seen: 1)
    assert trace.ego[15, SPEED] < 0.95 * SCENARIO.ego_speed


# --- who drives, and what cannot be


@pytest.mark.parametrize("factory", [IDMVehicle, lambda: IDMVehicle])
def test_vehicle_class_drives_without_the_wrappers(factory):
    wrapped = World("highway-v0", duration=6.0, wrappers=[FlattenObservation]).rollout(
        SCENARIO, factory
    )
    bare = World("highway-v0", duration=6.0).rollout(SCENARIO, factory)
    assert np.abs(wrapped.states - bare.states).max() < 0.01


def test_a_planner_inside_of_the_environment_is_refused():
    world = World("highway-v0", wrappers=[FlattenObservation])
    with pytest.raises(
        WorldError, match=r"wrappers: expected no wrappers= for a factory .* `env`, received Fl"
    ):
        world.rollout(SCENARIO, lambda env: lambda seen: 1)


@table(("wrappers", "message"), [
    (FlattenObservation, "wrappers: expected a list of callables, received <class .*FlattenObservation"),
    (["FlattenObservation"], r"wrappers\[0\]: expected a callable, received 'FlattenObservation'"),
    ([FlattenObservation, FrameStackObservation], r"wrappers\[1\]: expected .* raised TypeError: .*stack_size"),
    ([lambda env: None], r"wrappers\[0\]: expected .* which returned None"),
    ([lambda env: gymnasium.make("highway-v0")], r"wrappers\[0\]: expected .* which returned <OrderEnforcing"),
    ([partial(TransformAction, func=int, action_space=gymnasium.spaces.MultiBinary(2))],
     r"wrappers: .* received MultiBinary\(2\) from TransformAction. Make the wrappers' action_space"),
])  # fmt: skip
def test_what_is_no_wrapper_is_told(wrappers, message):
    with pytest.raises(WorldError, match=message):
        World("highway-v0", wrappers=wrappers).rollout(SCENARIO, lambda: lambda seen: 1)


@pytest.mark.parametrize("seen_before", [0, 3])
def test_wrapper_exception_is_ads_failure_at_its_decision(seen_before):
    left = []

    def broken(seen):
        if len(left) == seen_before:
            raise ZeroDivisionError("no spread in these statistics")
        left.append(seen)
        return seen

    world = World("highway-v0", wrappers=[lambda env: TransformObservation(env, broken, None)])
    world.check()
    left.clear()
    trace = world.rollout(SCENARIO, lambda: lambda seen: 1)
    assert (trace.outcome, trace.error.kind) == ("ads_error", "ZeroDivisionError")
    assert trace.ticks == trace.error.tick == seen_before * 15
    assert "in broken" in trace.error.traceback


def test_wrapper_that_does_not_step_is_reported():
    wrappers = [partial(TimeLimit, max_episode_steps=2), Autoreset]
    trace = World("highway-v0", duration=5.0, wrappers=wrappers).rollout(
        SCENARIO, lambda: lambda seen: 1
    )
    assert (trace.duration, trace.ended) == (2.0, "max_episode_steps=2")
    world = World("highway-v0", duration=5.0, wrappers=wrappers, ends="duration")
    with pytest.raises(
        WorldError, match=r"a step at 2.0 s that did not. Remove wrappers .* reset episodes"
    ):
        world.rollout(SCENARIO, lambda: lambda seen: 1)


class Cautious(HighwayEnv):
    """A version of highway-v0 that calls less than 20 m to the vehicle ahead a crash, and ends the episode there."""

    def step(self, action):
        seen, reward, is_over, is_cut, info = super().step(action)
        is_near = self.road.vehicles[1].position[0] - self.vehicle.position[0] < 20
        self.vehicle.crashed |= bool(is_near)  # so that highway-env brakes it
        return seen, reward, is_over or is_near, is_cut, info


def test_a_crash_that_only_the_environment_sees_is_no_collision(register):
    register("mine-v0", Cautious)
    queue = Scenario(npcs=[[PositionInstruction(2, 5.0)]], gene_seconds=10.0)
    assert World("highway-v0").rollout(queue, IDLE).outcome is Outcome.COLLISION
    trace = World("mine-v0").rollout(queue, IDLE)
    assert (trace.outcome, trace.ended, trace.duration < 10.0) == (
        Outcome.COMPLETED,
        "Cautious.step",
        True,
    )
    trace = World("mine-v0", ends="duration").rollout(queue, IDLE)
    assert (trace.outcome, trace.ended, trace.duration) == (Outcome.COMPLETED, "", 10.0)
