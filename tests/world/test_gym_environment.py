"""A wrapped environment runs as ``gymnasium.make``, the wrappers and ``env.step`` do; no wrapper is dropped silently.

The plain loop here is independent of this package: the environment's own reset places vehicles, and NPCs follow the
controls from the trace.
"""

from copy import deepcopy
from dataclasses import replace
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

from pytest_pafot import Cell, PositionInstruction, Run, Scenario, ScenarioError, World
from pytest_pafot.algorithms.fitness import before_impact
from pytest_pafot.corpus.reader import load
from pytest_pafot.corpus.writer import write
from pytest_pafot.findings.finding import Expect, disagreement, is_same_event
from pytest_pafot.findings.verdict import Failure
from pytest_pafot.model.trace import ACCELERATION, HEADING, SPEED, STEERING, Outcome
from pytest_pafot.support.errors import CorpusError
from pytest_pafot.world import WorldError
from pytest_pafot.world.gym_environment import CONNECTED, POLICY_OPTIONS, TRAFFIC_OPTIONS
from tests.findings.builders import plain_finding
from tests.helpers.gym_loop import Replayed, StateLog
from tests.helpers.refusals import refused
from tests.helpers.stages import mostly_oracle
from tests.helpers.tables import table
from tests.helpers.traces import collision_at

SCENARIO = Scenario(
    npcs=[
        [PositionInstruction(3, 24.0), PositionInstruction(2, 20.0)],
        [PositionInstruction(5, 20.0)],
    ],
    seed=11,
    gene_seconds=4.0,
)
IDLE = lambda: lambda seen: 1  # noqa: E731
PLANNER = lambda: lambda seen: (0.0, 0.0)  # noqa: E731
RAW = pytest.mark.parametrize("wrappers", [None, []])
FLAT = pytest.mark.parametrize("wrappers", [None, [FlattenObservation]])


def changed(name, change, base=HighwayEnv, method="reset"):
    """Return a class of environments with a method that does something else to the environment in the end."""

    def does(self, *given, **options):
        result = getattr(super(kind, self), method)(*given, **options)
        change(self)
        return result

    kind = type(name, (base,), {method: does})
    return kind


@pytest.fixture
def register(register, monkeypatch):
    """Register an environment for one test, where highway-v0 and its versions observe one beam of a lidar.

    By default they make tables with pandas, which takes three quarters of a run.
    """
    config = HighwayEnv.default_config() | {"observation": {"type": "LidarObservation", "cells": 1}}
    monkeypatch.setattr(HighwayEnv, "default_config", staticmethod(lambda: deepcopy(config)))
    return register


@pytest.fixture
def mine(register):
    """Return a function that makes the world of a class of environments, which it registers."""

    def make(cls, **options):
        name = f"{cls.__name__}-v0"
        if name not in gymnasium.registry:
            register(name, entry_point=cls)
        return World(name, **options)

    return make


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
def test_wrapped_policy_matches_the_plain_gymnasium_loop(case, monkeypatch, register):
    config, wrappers = CASES[case]
    world = World("highway-v0", config=config, duration=4.0, wrappers=wrappers, ends="duration")
    listener = Listener(world.environment.make().action_space)
    trace = world.rollout(SCENARIO, lambda: listener)

    monkeypatch.setattr(Staged, "trace", trace)
    register("staged-v0", entry_point=Staged)
    env = gymnasium.make("staged-v0", config={**config, "duration": 1000}, disable_env_checker=True)
    for wrapper in wrappers:
        env = wrapper(env)
    expected = Listener(env.action_space)
    seen, _ = env.reset(seed=SCENARIO.seed)
    log = env.unwrapped.road.step = StateLog(env.unwrapped.road)
    while len(log.rows) < trace.ticks:
        seen, *_ = env.step(expected(seen))

    assert len(trace.actions) == len(listener.seen) == len(expected.seen) > 3
    for name in ("seen", "actions"):
        pairs = zip(getattr(listener, name), getattr(expected, name), strict=True)
        assert all(np.array_equal(*pair) for pair in pairs)
    assert np.array_equal(np.array(log.rows[: trace.ticks]), trace.states[1:, :, : SPEED + 1])


class Repeating(HighwayEnv):
    def step(self, action):
        super().step(action)
        return super().step(action)


def often(hz):
    """Return a function that makes an environment decide at a rate."""
    return lambda env: env.config.update(policy_frequency=hz)


Hurried = changed("Hurried", often(3))


@pytest.mark.parametrize(("entry_point", "wrappers", "every"), [
    (HighwayEnv, [partial(MaxAndSkipObservation, skip=3)], 45),
    (Repeating, None, 30),
    (Repeating, [partial(MaxAndSkipObservation, skip=2)], 60),
    (Hurried, None, 5),
    (HighwayEnv, None, 15),
])  # fmt: skip
def test_times_of_decisions_are_those_at_which_the_policy_was_asked(
    entry_point, wrappers, every, mine
):
    world = mine(entry_point, duration=8.0, wrappers=wrappers)
    trace = world.rollout(SCENARIO, lambda: Listener(gymnasium.spaces.Discrete(5)))
    assert list(trace.decision_ticks) == list(range(0, trace.ticks, every))
    assert len(trace.decision_ticks) == len(trace.actions) > 1
    assert bool(trace.decided) == (every != trace.physics_hz // trace.ads_hz)


def test_drawn_rate_of_decisions_is_that_of_the_run(mine):
    drawn = changed("Drawn", lambda env: often(int(env.np_random.choice((3, 5))))(env))
    world, rates = mine(drawn, duration=3.0), set()
    for seed in range(6):
        scenario = replace(SCENARIO, seed=seed)
        trace, again = world.rollout(scenario, IDLE), world.rollout_in_gym(scenario, IDLE)
        assert list(trace.decision_ticks) == list(range(0, trace.ticks, 15 // trace.ads_hz))
        assert (trace.decided, trace.ads_hz) == (again.decided, again.ads_hz) == ((), again.ads_hz)
        assert len(trace.actions) == len(trace.decision_ticks)
        rates.add(trace.ads_hz)
    assert rates == {3, 5}


def unfit(name, rates):
    """Return a class of environments in which a rate depends on the seed."""

    class Unfit(HighwayEnv):
        def reset(self, *, seed=None, options=None):
            first = super().reset(seed=seed, options=options)
            self.config[name] = rates[bool(seed)]
            return first

    return Unfit


UNFIT = {"policy_frequency": (1, 4), "simulation_frequency": (15, 30)}


@pytest.mark.parametrize("name", UNFIT)
def test_drawn_rates_that_fit_no_run_are_refused(name, mine):
    world = mine(unfit(name, UNFIT[name]), duration=3.0)
    for run in (world.rollout, world.rollout_in_gym):
        with refused(f"config.{name}"):
            run(SCENARIO, IDLE)


SKIPS = World("highway-v0", duration=8.0, wrappers=[partial(MaxAndSkipObservation, skip=2)])


def test_readers_of_a_run_use_the_times_of_its_decisions():
    hit = replace(collision_at(105, ego_speed=9.0, npc_speed=0.0), cell=None)
    run = replace(SKIPS.rollout(SCENARIO, IDLE), outcome="collision", collision=hit)
    before = before_impact(run)
    assert (before.ticks, before.decided, len(before.actions)) == (60, (0, 30), 2)


def test_decision_that_fails_has_its_time_too():
    def failing():
        calls = iter([1, 1])
        return lambda seen: next(calls)

    for world, ticks in ((SKIPS, (0, 30, 60)), (World("highway-v0", duration=8.0), (0, 15, 30))):
        trace = world.rollout(SCENARIO, failing)
        assert (*trace.decision_ticks, trace.error.tick) == (*ticks, ticks[-1])
        assert len(trace.actions) == 2


def test_each_run_has_fresh_wrappers_and_is_confirmed():
    wrappers = [NormalizeObservation, partial(StickyAction, repeat_action_probability=0.5)]
    world = World("highway-v0", duration=4.0, wrappers=wrappers)
    listener = lambda: Listener(world.environment.make().action_space)  # noqa: E731
    runs = (world.rollout, world.rollout, world.rollout_in_gym)
    assert len({run(SCENARIO, listener).states.tobytes() for run in runs}) == 1


# --- what a registration adds


def flattened(config=None, render_mode=None):
    """Return a wrapped environment, as an entry point."""
    return FlattenObservation(HighwayEnv(config, render_mode))


FLATTENED = WrapperSpec("Flatten", "gymnasium.wrappers:FlattenObservation", {})
REGISTERED = {
    "by its entry point": {"entry_point": flattened},
    "beside its entry point": {"entry_point": HighwayEnv, "additional_wrappers": (FLATTENED,)},
}


@pytest.mark.parametrize("how", REGISTERED)
def test_registered_wrappers_are_refused_without_a_list_to_which_they_are_added(how, register):
    register("mine-v0", **REGISTERED[how])
    with refused("env_id"):
        World("mine-v0").check()
    for wrappers, shape in [([], (2,)), ([partial(FrameStackObservation, stack_size=3)], (3, 2))]:
        world = World("mine-v0", wrappers=wrappers, duration=2.0)
        listener = Listener(world.environment.make().action_space)
        world.rollout(SCENARIO, lambda listener=listener: listener)
        assert {seen.shape for seen in listener.seen} == {shape}
    assert world.to_dict()["wrappers"] == ["FlattenObservation", "FrameStackObservation"]


def test_default_gymnasium_wrappers_are_no_reason_to_refuse(register):
    register("mine-v0", entry_point=HighwayEnv, max_episode_steps=3)
    assert gymnasium.make("mine-v0").spec.max_episode_steps == 3
    assert World("mine-v0", duration=5.0).rollout(SCENARIO, IDLE).duration == 3.0
    assert "wrappers" not in World("mine-v0").to_dict()


def test_registered_configuration_applies_unless_another_is_given(register):
    own = {"lanes_count": 6, "policy_frequency": 5}
    register("mine-v0", entry_point=HighwayEnv, kwargs={"config": own})
    for config in (None, {"lanes_count": 3}):
        given = {} if config is None else {"config": config}
        plain, world = gymnasium.make("mine-v0", **given).unwrapped, World("mine-v0", config=config)
        expected = plain.config["lanes_count"], plain.config["policy_frequency"]
        assert (world.lanes, world.ads_hz) == expected


class Doubled(HighwayEnv):
    def reset(self, **options):
        seen, info = super().reset(**options)
        return 2 * seen, info

    def step(self, action):
        seen, *others = super().step(action)
        return (2 * seen, *others)


def test_what_a_custom_reset_does_to_the_ego_holds_in_runs(mine):
    unhurried = changed("Unhurried", lambda env: setattr(env.vehicle, "target_speed", 12.0))
    world = mine(unhurried, duration=8.0)
    trace = world.rollout(SCENARIO, IDLE)
    assert trace.ego[-1, 3] == pytest.approx(12.0, abs=0.1)
    assert np.array_equal(trace.states, world.rollout_in_gym(SCENARIO, IDLE).states)
    planned = mine(unhurried, duration=2.0, planner_hz=5).rollout(SCENARIO, PLANNER)
    assert planned.ego[-1, 3] == pytest.approx(SCENARIO.ego_speed)


class Heading(HighwayEnv):
    """A straight road whose reset gives its ego a goal, which its step reads, and which keeps its ego."""

    def _reset(self):
        super()._reset()
        self.ego, self.vehicle.goal = self.vehicle, 300.0

    def step(self, action):
        assert self.ego is self.vehicle
        return super().step(4 if self.ego.position[0] > self.vehicle.goal else action)


@RAW
def test_ego_of_a_run_is_what_the_environment_keeps_of_its_own(wrappers, mine):
    world = mine(Heading, duration=12.0, wrappers=wrappers)
    trace = world.rollout(replace(SCENARIO, ego_speed=25.0), IDLE)
    speed = trace.ego[:, SPEED]
    assert speed[trace.ego[:, 0] > 350.0].max() < speed[trace.ego[:, 0] < 300.0].min()


KEEPERS = [lambda ego: [ego], lambda ego: {"ego": ego}, lambda ego: SimpleNamespace(of=ego)]


def keeping(keeper):
    return changed(
        "Keeping", lambda env: setattr(env, "shield", keeper(env.vehicle)), method="_reset"
    )


@RAW
@pytest.mark.parametrize("keeper", KEEPERS, ids=["list", "dict", "helper"])
def test_ego_that_is_kept_where_no_run_replaces_it_is_refused(keeper, wrappers, mine):
    with refused("env_id"):
        mine(keeping(keeper), duration=3.0, wrappers=wrappers).rollout(SCENARIO, IDLE)
    assert mine(keeping(keeper), duration=3.0).rollout(SCENARIO, Vehicle).ticks > 0


class Truck(MDPVehicle):
    """A long vehicle that gains speed slowly, the more so the heavier it is."""

    LENGTH = 8.0

    def __init__(self, *args, mass=2.0, **kwargs):
        super().__init__(*args, **kwargs)
        self.mass = mass

    def speed_control(self, target_speed):
        return super().speed_control(target_speed) / self.mass


HEAVY = {"target_speeds": [20, 28], "mass": 3.0}


class Freight(HighwayEnv):
    def _create_vehicles(self):
        super()._create_vehicles()
        usual = self.vehicle
        self.vehicle = Truck(self.road, usual.position, usual.heading, usual.speed, **HEAVY)
        self.road.vehicles[self.road.vehicles.index(usual)] = self.vehicle


@RAW
def test_ego_is_of_the_class_of_which_the_environment_makes_it(wrappers, mine):
    world, faster = mine(Freight, duration=3.0, wrappers=wrappers), 3
    scenario = Scenario(npcs=[[PositionInstruction(6, 10.0)]], ego_lane=1, ego_speed=20.0)
    trace = world.rollout(scenario, lambda: lambda seen: faster)
    env = gymnasium.make(world.env_id, config={"vehicles_count": 0}).unwrapped
    env.reset(seed=0)
    x, y, heading, speed = trace.ego[0, :4]
    env.vehicle = ego = Truck(env.road, [x, y], heading, speed, **HEAVY)
    env.road.vehicles = [ego]
    for _ in range(3):
        env.step(faster)
    assert trace.ego[-1, :4] == pytest.approx([*ego.position, ego.heading, ego.speed])
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
    [({}, IDLE, 20.0), ({"wrappers": []}, IDLE, 20.0), ({"planner_hz": 5}, PLANNER, 22.0), ({}, IDMVehicle, 22.0)],
    ids=["policy", "wrapped", "planner", "class"],
)  # fmt: skip
def test_what_the_act_of_an_own_road_does_to_the_ego_holds_in_runs(options, ads, speed, mine):
    scenario = Scenario(npcs=[[PositionInstruction(6, 10.0)]], ego_lane=1, ego_speed=22.0)
    ego = mine(Alps, duration=5.0, **options).rollout(scenario, ads).ego
    on_ice = ego[:-1, 0] > 250.0
    assert ego[:-1][~on_ice, SPEED][-1] == pytest.approx(speed, abs=0.2)
    assert np.diff(ego[:, SPEED])[on_ice] == pytest.approx(-4.0 / 15)


class Harder(HighwayEnv):
    episodes = 0

    def _reset(self):
        type(self).episodes += 1
        self.config["lanes_count"] = 3 + type(self).episodes // 3
        super()._reset()


def by_chance(env):
    env.vehicle.position[0] += np.random.default_rng().uniform()


Chancy = changed("Chancy", by_chance, method="_create_vehicles")


class Lessons(gymnasium.Wrapper):
    lessons = 0

    def reset(self, **kwargs):
        self.lessons += 1
        self.unwrapped.config["lanes_count"] = 4 + (self.lessons > 1)
        return self.env.reset(**kwargs)


DIFFERING = [(Harder, None), (Chancy, None), (HighwayEnv, [Lessons])]


@table(("cls", "wrappers"), DIFFERING)
def test_environment_whose_resets_differ_or_whose_ego_needs_arguments_is_refused(
    cls, wrappers, mine
):
    Harder.episodes = 0
    with refused("env_id"):
        mine(cls, wrappers=wrappers).check()
    with refused("env_id"):
        mine(Depot).rollout(SCENARIO, IDLE)
    assert len({mine(Wide).lanes for _ in range(4)}) == 1, "it is drawn, and always the same"


class Weighed(Truck):
    def __init__(self, road, position, heading, speed, mass):
        super().__init__(road, position, heading, speed, mass=mass)


class Depot(HighwayEnv):
    """One whose ego can be made only with an argument that nothing else knows."""

    def _create_vehicles(self):
        self.vehicle = Weighed(self.road, [200.0, 4.0], 0.0, 20.0, 3.0)
        self.road.vehicles.append(self.vehicle)


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
def test_environment_may_ask_the_ego_of_its_own_class(cls, wrappers, mine):
    world = mine(cls, duration=3.0, wrappers=wrappers)
    assert world.rollout(SCENARIO, IDLE).outcome == "safe"


class Wet(HighwayEnv):
    def _simulate(self, action=None):
        self.vehicle.speed *= 0.9
        super()._simulate(action)


class Wide(HighwayEnv):
    def _create_road(self):
        self.config["lanes_count"] = int(self.np_random.integers(2, 50))
        super()._create_road()


def test_custom_step_and_simulation_are_used_on_straight_roads_too(mine):
    # a policy with one action
    own, stock = (Listener(gymnasium.spaces.Discrete(1)) for _ in range(2))
    mine(Doubled, duration=2.0).rollout(SCENARIO, lambda: own)
    World("highway-v0", duration=2.0).rollout(SCENARIO, lambda: stock)
    assert np.array_equal(own.seen[:2], 2 * np.array(stock.seen[:2]))
    slowed = mine(Wet, duration=3.0).rollout(SCENARIO, IDLE)
    assert slowed.ego[15, SPEED] < 0.95 * SCENARIO.ego_speed


class Bothered(HighwayEnv):
    """A straight road on which ``bother`` does something to other vehicles before each step from 2 s."""

    def step(self, action):
        if self.time >= 2.0:
            self.bother()
        return super().step(action)

    def other(self):
        x, y = self.vehicle.position
        return Vehicle(self.road, np.array([x + 40.0, y]), 0.0, 0.0)


def bothered(name, bother):
    return type(name, (Bothered,), {"bother": bother})


def sort(env):
    env.road.vehicles = sorted(env.road.vehicles, key=lambda each: each.position[0])


def swap(env):
    env.vehicle = type(env.vehicle)(env.road, env.vehicle.position, speed=20.0)


def push(env):
    env.road.vehicles[1].position[0] += 5.0


BOTHERED = [
    bothered("Spawning", lambda env: env.road.vehicles.append(env.other())),
    bothered("Braking", lambda env: setattr(env.road.vehicles[-1], "speed", 5.0)),
    bothered("Pushing", push),
    changed("Choosing", lambda env: env.road.vehicles.__setitem__(slice(1, None), [])),
    changed("Crowding", lambda env: env.road.vehicles.append(Replayed(env.road, [500.0, 0.0]))),
    changed("Swapping", swap),
]
TWO = Scenario(npcs=[[PositionInstruction(2, 22.0)], [PositionInstruction(6, 22.0)]], ego_lane=1)


@FLAT
@pytest.mark.parametrize("cls", BOTHERED)
def test_environment_that_changes_the_vehicles_of_a_run_is_refused(cls, wrappers, mine):
    with refused("env_id"):
        mine(cls, duration=6.0, wrappers=wrappers).rollout(TWO, IDLE)


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


def test_reset_does_nothing_to_npcs(mine):
    stock, slowing, warming = (Listener(gymnasium.spaces.Discrete(1)) for _ in range(3))
    expected = World("highway-v0", duration=4.0).rollout(SCENARIO, lambda: stock).states
    # the first second of one that warms up is the one that the reset drives
    for cls, listener in ((Slowing, slowing), (Warming, warming)):
        run = mine(cls, duration=4.0).rollout(SCENARIO, lambda listener=listener: listener)
        assert np.allclose(run.states, expected, atol=1e-9)
    assert np.array_equal(slowing.seen, stock.seen)
    assert np.array_equal(warming.seen[0], stock.seen[1])


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
        "policy_frequency": 5, "simulation_frequency": 10, "lanes_count": 5, "vehicles_count": 7,
        "observation": {"type": "Kinematics", "vehicles_count": 3},
        "action": {"type": "DiscreteMetaAction", "target_speeds": [10, 15]},
    }  # fmt: skip
    wrapper = type("Given", (Configured,), {"changes": changes, "by_options": by_options})
    world = World("highway-v0", wrappers=[wrapper], duration=4.0)
    plain = World("highway-v0", changes, duration=4.0)
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


def test_speeds_of_actions_are_those_that_the_reset_of_the_run_draws(mine):
    world, tops = mine(Fast, duration=20.0), set()
    plain, npcs = gymnasium.make(world.env_id), [[PositionInstruction(6, 20.0)]]
    for seed in range(4):
        plain.reset(seed=seed)
        tops.add(top := plain.unwrapped.vehicle.target_speeds[-1])
        scenario = Scenario(npcs=npcs, seed=seed, gene_seconds=10.0, ego_speed=22.0)
        trace = world.rollout(scenario, lambda: lambda seen: 3)
        assert trace.ego[-1, SPEED] == pytest.approx(top, abs=0.1)
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


def test_rewards_that_change_the_state_are_named_where_no_run_calls_them(mine):
    assert mine(Burning).left_out == {"_reward": ("fuel", "vehicle.calls")}
    assert mine(Burning, wrappers=[]).left_out == mine(Burning, planner_hz=5).left_out == {}
    rewards = {"_rewards": ("vehicle.target_speed",)}
    assert mine(Urging).left_out == rewards
    assert mine(Urging, ends="duration").left_out == rewards | {"_is_terminated": ("asked",)}
    assert mine(Scoring).left_out == World("highway-v0").left_out == {}


class Following(HighwayEnv):
    """A straight road whose info, also that of its reset, is about the nearest other vehicle."""

    def _info(self, seen, action=None):
        ego, *others = (each.position[0] for each in self.road.vehicles)
        nearest = {"nearest": min(abs(each - ego) for each in others)}
        return super()._info(seen, action) | nearest


@FLAT
def test_environment_that_looks_at_its_traffic_in_reset_runs_with_the_npcs_alone(wrappers, mine):
    own, stock = mine(Following, duration=3.0, wrappers=wrappers), World("highway-v0", duration=3.0)
    expected = stock.rollout(SCENARIO, IDLE).states
    for run in (own.rollout, own.rollout_in_gym):
        np.testing.assert_allclose(run(SCENARIO, IDLE).states, expected, rtol=0, atol=1e-9)
    assert own.to_dict()["config"] == stock.to_dict()["config"]


class Roadworks(HighwayEnv):
    """A straight road with an obstacle in lane 1, and a mark in lane 2 that vehicles can drive over."""

    def _create_road(self):
        super()._create_road()
        self.road.objects += [Obstacle(self.road, [300.0, 4.0]), Landmark(self.road, [300.0, 8.0])]


AT_ONCE = [[PositionInstruction(6, 20.0)]]


@FLAT
@pytest.mark.parametrize("factory", [IDLE, Vehicle, PLANNER], ids=["policy", "class", "planner"])
def test_contact_with_an_obstacle_is_a_collision_for_which_the_ego_is_responsible(
    factory, wrappers, mine
):
    options = {"planner_hz": 5} if factory is PLANNER else {"wrappers": wrappers}
    world = mine(Roadworks, duration=12.0, **options)
    scenario = Scenario(npcs=AT_ONCE, ego_lane=1)
    first, again = world.rollout(scenario, factory), world.rollout_in_gym(scenario, factory)
    assert disagreement(Run(first), Run(again)) == ""
    run, hit = Run(first), first.collision
    assert (run.outcome, run.responsibility, run.event_npc) == ("collision", "ego", None)
    assert (hit.npc, hit.side, hit.cell, hit.npc_speed, run.off_road) == (
        None,
        "front",
        None,
        0.0,
        False,
    )
    gap = 300.0 - 1.0 - (first.ego[-2, 0] + 2.5)
    assert 0 <= gap < hit.ego_speed / first.physics_hz, "the last tick before it"
    assert world.rollout(replace(scenario, ego_lane=2), factory).outcome == "safe"


def test_npc_at_an_obstacle_makes_a_run_invalid(mine):
    world = mine(Roadworks, duration=12.0)
    for run in (world.rollout, world.rollout_in_gym):
        trace = run(Scenario(npcs=[[PositionInstruction(2, 20.0)]], ego_lane=1), IDLE)
        assert (trace.outcome, trace.collision) == ("invalid", None)
        assert trace.states[-1, 1, 0] + 2.5 > 299.0


def littered(x, y):
    """Return a function that puts an obstacle at a place."""
    return lambda env: env.road.objects.append(Obstacle(env.road, [x, y]))


@FLAT
def test_obstacle_that_a_custom_reset_puts_there_is_one_like_others(wrappers, mine):
    cls = changed("Littered", littered(300.0, 4.0))
    own, other = (mine(each, duration=12.0, wrappers=wrappers) for each in (cls, Roadworks))
    scenario, counts = Scenario(npcs=AT_ONCE, ego_lane=1), []

    def counting(env):
        count = lambda seen: counts.append(len(env.unwrapped.road.objects)) or seen  # noqa: E731
        return TransformObservation(env, count, None)

    expected = other.rollout(scenario, IDLE)
    for run in (own.rollout, own.rollout_in_gym):
        trace = run(scenario, IDLE)
        assert (trace.outcome, trace.collision.npc) == ("collision", None)
        assert trace.obstacles == expected.obstacles
        assert np.allclose(trace.states, expected.states, atol=1e-9)
    mine(cls, duration=3.0, wrappers=[counting]).rollout(scenario, IDLE)
    assert set(counts) == {1}


def at_random(env):
    littered(float(env.np_random.uniform(250.0, 400.0)), 4.0)(env)


Chanced = changed("Chanced", at_random, method="_reset")


def test_random_obstacle_is_where_a_reset_with_seed_0_and_no_traffic_puts_it(mine):
    world, places = mine(Chanced, duration=2.0, config={"vehicles_count": 50}), []
    for count in (0, 50):
        plain = gymnasium.make(world.env_id, config={"vehicles_count": count})
        plain.reset(seed=0)
        places.append(plain.unwrapped.road.objects[0].position[0])
    trace = world.rollout(Scenario(npcs=AT_ONCE, ego_lane=2, seed=7), IDLE)
    assert trace.obstacles[0][0] == places[0] != places[1]


class Falling(Roadworks):
    def step(self, action):
        if 3.0 <= self.time < 3.1:
            self.fall()
        return super().step(action)

    fall = littered(500.0, 0.0)


def roll(env):
    env.road.objects[0].position = np.array([400.0, 4.0])


def mark(env):
    env.road.objects.append(Landmark(env.road, [500.0, 0.0]))


STREWN = lambda env: littered(400.0 + 100 * env.np_random.random(), 0.0)(env)  # noqa: E731
STILL = Scenario(npcs=AT_ONCE, ego_lane=3)
RESTLESS = [
    Falling,
    type("Rolling", (Falling,), {"fall": roll}),
    changed("Strewing", STREWN, base=Roadworks),
]


@FLAT
@pytest.mark.parametrize("cls", RESTLESS)
def test_objects_that_do_not_stay_as_they_are_are_refused(cls, wrappers, mine):
    world = mine(cls, duration=6.0, wrappers=wrappers)
    for run in (world.rollout, world.rollout_in_gym):
        with refused("env_id"):
            run(STILL, IDLE)


@FLAT
def test_environment_may_sort_the_vehicles_of_a_run_and_add_marks(wrappers, mine):
    marking = type("Marking", (Falling,), {"fall": mark})
    for cls, scenario in ((bothered("Sorting", sort), TWO), (marking, STILL)):
        trace = mine(cls, duration=6.0, wrappers=wrappers).rollout(scenario, IDLE)
        assert (trace.outcome, trace.ticks) == ("safe", 90)


class Lorry(Vehicle):
    LENGTH = 16.0


class Blocked(HighwayEnv):
    def _create_road(self):
        super()._create_road()
        places = [[202.5, 4.0], [244.0, 8.0], [194.0, 0.0], [150.0, 12.0]]
        self.road.objects += [Obstacle(self.road, each) for each in places]


BLOCKED = Scenario(npcs=AT_ONCE, ego_lane=1, ego_speed=22.0)


def test_ego_does_not_start_at_an_obstacle(mine):
    world = mine(Blocked, duration=12.0)
    for lane in (1, 2):
        with refused("ego_lane", ScenarioError):
            world.rollout(replace(BLOCKED, ego_lane=lane), IDLE)
    slow = world.rollout(replace(BLOCKED, ego_lane=2, ego_speed=20.0), lambda: lambda seen: 4)
    assert (slow.collision.npc, slow.ticks > 15) == (None, True)
    free = replace(BLOCKED, ego_lane=0)
    for run in (world.rollout, world.rollout_in_gym):
        assert run(free, IDLE).ticks > 0
        with refused("ego_lane", ScenarioError):
            run(free, Lorry)


def test_finding_at_an_obstacle_is_saved_and_read(mine, tmp_path):
    scenario = Scenario(npcs=AT_ONCE, ego_lane=1)
    run = Run(mine(Roadworks, duration=12.0).rollout(scenario, IDLE))
    failure = Failure(
        kind="AssertionError", message="assert not run.collision", assertion="not run.collision"
    )
    expect = Expect.from_run(run, failure)
    assert (expect.outcome, expect.npc, expect.cell) == ("collision", None, None)
    assert (expect.side, expect.time) == ("front", pytest.approx(4.8, abs=0.05))
    assert is_same_event(expect, run, failure)
    for given in (expect, replace(expect, npc=0), replace(expect, cell=Cell.FRONT)):
        path = tmp_path / f"front-{given.npc}-{given.cell}.pafot.yaml"
        write(path, plain_finding(expect=given))
        if given is expect:
            assert load(path).expect == expect
        else:
            with refused("expect", CorpusError):
                load(path)


KNOWN = """
lanes_count speed_limit length no_lanes roundabout_radius roundabout_lanes before_merge_length after_merge_length
converge_merge_length parallel_merge_length block_lane force_decision add_walls
simulation_frequency duration destination state_noise derivative_noise steering_range
controlled_vehicles manual_control
action_reward arrived_reward collision_reward goal_reward high_speed_reward lane_centering_cost lane_centering_reward
lane_change_reward left_lane_constraint left_lane_reward merging_speed_reward normalize_reward reward_speed_range
reward_weights right_lane_reward success_goal_reward
centering_position offscreen_rendering real_time_rendering render_agent scaling screen_height screen_width
show_trajectories
ego_spacing initial_lane_id offroad_terminal terminate_off_road
"""
"""Options of the road and of runs, refused ones, of rewards, of drawings, and those that something else replaces."""


def test_every_option_of_highway_env_is_used_refused_or_named():
    entries = {str(spec.entry_point): spec.entry_point for spec in gymnasium.registry.values()}
    own = [each for name, each in entries.items() if name.startswith("highway_env.")]
    known = {key for entry in own for key in load_env_creator(entry).default_config()}
    assert known == {*TRAFFIC_OPTIONS, *POLICY_OPTIONS, CONNECTED, *KNOWN.split()}


REPLACED = {
    "a lane and traffic": (
        "highway-v0", {"initial_lane_id": 0, "vehicles_density": 2, "offroad_terminal": True, "lanes_count": 3}, {},
        [["initial_lane_id"], ["vehicles_density"]],
    ),
    "a spacing": ("highway-v0", {"ego_spacing": 3}, {}, [["ego_spacing"]]),
    "no lane": ("highway-v0", {"initial_lane_id": None, "offroad_terminal": False, "collision_reward": -9}, {}, []),
    "traffic at a junction": (
        "intersection-v0", {"spawn_probability": 0, "initial_vehicle_count": 3}, {},
        [["spawn_probability", "initial_vehicle_count"]],
    ),
    "a destination": ("intersection-v0", {"offroad_terminal": True, "destination": "o2"}, {}, []),
    "an end off the road": (
        "racetrack-v1", {"terminate_off_road": False, "other_vehicles": 2}, {},
        [["terminate_off_road"], ["other_vehicles"]],
    ),
    "an end off the road where the duration ends runs": (
        "highway-v0", {"offroad_terminal": True}, {"ends": "duration"}, [["offroad_terminal"]],
    ),
}  # fmt: skip


def without_effect(env_id, config, options):
    return World(env_id, config=config, **options).options_without_effect(drives_itself=False)


@table(("env_id", "config", "options", "names"), REPLACED.values())
def test_option_that_something_replaces_is_named(env_id, config, options, names):
    found = without_effect(env_id, config, options).values()
    assert sorted(found) == sorted(names)


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
    defensive = "highway_env.vehicle.behavior.DefensiveVehicle"
    config = {CONNECTED: True, "other_vehicles_type": defensive}
    world = World("intersection-v0", config=config, planner_hz=planner_hz)
    assert [*world.options_without_effect(**kind).values()] == [names] * bool(names)


class Refusing(HighwayEnv):
    """An environment that cannot be reset. It counts the attempts."""

    attempts = 0

    def _create_vehicles(self):
        type(self).attempts += 1
        raise ValueError("no map")


def test_environment_that_cannot_be_reset_is_not_blamed_on_a_configuration_that_nobody_gave(
    mine, monkeypatch
):
    # with a traffic that takes minutes, it is not tried again without the configuration
    for config, field, attempts in ((None, "env_id", 2), ({"duration": 9}, "config", None),
                                    ({"vehicles_count": 10**9}, "config", 1)):  # fmt: skip
        monkeypatch.setattr(Refusing, "attempts", 0)
        with refused(field):
            mine(Refusing, config=config).check()
        assert Refusing.attempts == attempts or attempts is None


# --- who drives, and what cannot be


@pytest.mark.parametrize("factory", [IDMVehicle, lambda: IDMVehicle])
def test_vehicle_class_drives_without_the_wrappers(factory):
    wrapped, bare = (
        World("highway-v0", duration=6.0, wrappers=wrappers).rollout(SCENARIO, factory)
        for wrappers in ([FlattenObservation], None)
    )
    assert np.abs(wrapped.states - bare.states).max() < 0.01


NO_WRAPPERS = {
    "no list": (FlattenObservation, "wrappers"),
    "a name": (["FlattenObservation"], "wrappers[0]"),
    "a missing argument": ([FlattenObservation, FrameStackObservation], ""),
    "one that returns nothing": ([lambda env: None], ""),
    "one that returns another environment": ([lambda env: gymnasium.make("highway-v0")], ""),
    "several actions": ([partial(TransformAction, func=int, action_space=gymnasium.spaces.MultiBinary(2))],
                        "wrappers"),
}  # fmt: skip


@table(("wrappers", "field"), NO_WRAPPERS.values())
def test_what_is_no_wrapper_and_a_planner_inside_of_wrappers_are_refused(wrappers, field):
    with refused(field):
        World("highway-v0", wrappers=wrappers).rollout(SCENARIO, IDLE)
    with refused(""):
        World("highway-v0", wrappers=[FlattenObservation]).rollout(SCENARIO, lambda env: IDLE())


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
    trace = world.rollout(SCENARIO, IDLE)
    assert (trace.outcome, trace.error.kind) == ("ads_error", "ZeroDivisionError")
    assert trace.ticks == trace.error.tick == seen_before * 15
    assert "in broken" in trace.error.traceback


STOPS = [partial(TimeLimit, max_episode_steps=2), Autoreset]


def test_wrapper_that_does_not_step_is_refused_where_it_matters():
    trace = World("highway-v0", duration=5.0, wrappers=STOPS).rollout(SCENARIO, IDLE)
    assert (trace.duration, trace.ended) == (2.0, "max_episode_steps=2")
    with pytest.raises(WorldError):
        World("highway-v0", duration=5.0, wrappers=STOPS, ends="duration").rollout(SCENARIO, IDLE)


class Cautious(HighwayEnv):
    """A version of highway-v0 that calls less than 20 m to the vehicle ahead a crash, and ends the episode there."""

    def step(self, action):
        seen, reward, is_over, is_cut, info = super().step(action)
        is_near = self.road.vehicles[1].position[0] - self.vehicle.position[0] < 20
        self.vehicle.crashed |= bool(is_near)  # so that highway-env brakes it
        return seen, reward, is_over or is_near, is_cut, info


def test_a_crash_that_only_the_environment_sees_is_no_collision(mine):
    queue = Scenario(npcs=[[PositionInstruction(2, 5.0)]], gene_seconds=10.0)
    assert World("highway-v0").rollout(queue, IDLE).outcome is Outcome.COLLISION
    for ends, ended in (("environment", "Cautious.step"), ("duration", "")):
        trace = mine(Cautious, ends=ends).rollout(queue, IDLE)
        assert (trace.outcome, trace.ended) == (Outcome.COMPLETED, ended)
        assert (trace.duration < 10.0) is bool(ended)
