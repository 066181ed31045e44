"""The four kinds of ADS, new for each scenario, and the factories that make them."""

from __future__ import annotations

import copy
import functools
import gc
import itertools
import math
import threading

import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import MDPVehicle

from pytest_pafot.model.instructions import PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Outcome
from pytest_pafot.world import AdsFactoryError, Highway, Observation, World
from pytest_pafot.world.kernel.director import Director
from tests.helpers.tables import table

SCENARIO = Scenario(
    npcs=[[PositionInstruction(1, 25.0)], [PositionInstruction(5, 20.0)]], gene_seconds=4.0
)
HIGHWAY, GYM = Highway(), World("highway-v0")
CONTINUOUS = World("highway-v0", config={"action": {"type": "ContinuousAction"}})
worlds = pytest.mark.parametrize(
    ("world", "idle"), [(HIGHWAY, (0.0, 0.0)), (GYM, 1)], ids=["Highway", "World"]
)


def always(action):
    """Return a factory of an ADS that always returns the same thing."""
    return lambda: lambda observation: action


# --- kind (a): planners on the highway


def test_planner_sees_scene_in_si_units():
    seen = []
    trace = HIGHWAY.rollout(
        SCENARIO, lambda: lambda observation: seen.append(observation) or (0.5, 0.01)
    )
    assert [observation.time for observation in seen] == [tick / 5 for tick in range(20)]
    for tick, observation in zip(range(0, 60, 3), seen, strict=True):
        assert isinstance(observation, Observation)
        assert (observation.lanes, observation.lane_width, observation.speed_limit) == (
            4,
            4.0,
            26.8,
        )
        vehicles = [observation.ego, *observation.others]
        for state, row, size in zip(vehicles, trace.states[tick], trace.sizes, strict=True):
            assert (state.x, state.y, state.heading, state.speed) == tuple(row[:4])
            assert (state.length, state.width) == tuple(size)
            assert state.lane == row[6]
            assert {type(value) for value in state} <= {float, int}
        assert observation.array.shape == (3, 7)
        assert observation.array[1].tolist() == [float(value) for value in observation.others[0]]


def test_planner_action_is_held_and_logged_as_given():
    numbers = iter(range(100))
    trace = HIGHWAY.rollout(SCENARIO, lambda: lambda observation: (next(numbers) / 100, 0.001))
    assert trace.actions == tuple((number / 100, 0.001) for number in range(20))
    assert trace.ego[1:, 4].tolist() == [number / 100 for number in range(20) for _ in range(3)]
    assert set(trace.ego[1:, 5]) == {0.001}


@table(
    "action",
    [
        (1, 0),
        [1.0, 0.0],
        np.array([1.0, 0.0]),
        np.float32([1, 0]),
        (np.float32(1), np.int64(0)),
        iter,
    ],
)
def test_any_pair_of_numbers_is_an_action(action):
    trace = HIGHWAY.rollout(
        SCENARIO, lambda: lambda observation: iter((1, 0)) if action is iter else action
    )
    assert trace.outcome is Outcome.COMPLETED
    assert set(trace.actions) == {(1.0, 0.0)}


def test_extreme_actions_are_limited_to_what_car_can():
    for wild, tame in (
        ((1e9, 0.0), (6.0, 0.0)),
        ((-1e9, 0.0), (-9.81, 0.0)),
        ((0.0, 9.0), (0.0, math.pi / 4)),
    ):
        a, b = (HIGHWAY.rollout(SCENARIO, always(action)) for action in (wild, tame))
        assert a.states.tobytes() == b.states.tobytes()
        assert a.actions[0] == wild


def test_ego_off_road_records_its_first_tick():
    trace = HIGHWAY.rollout(
        Scenario(npcs=[[PositionInstruction(8, 20.0)]], ego_lane=3), always((0.0, 0.02))
    )
    assert trace.outcome is Outcome.OFF_ROAD
    off = trace.ego[:, 1] > 14.0
    assert trace.off_road_tick == off.argmax() > 0
    assert (trace.ego[off, 6] == -1).all()


# --- kind (b): policies of an environment


def test_policy_gets_environment_observation_and_gives_its_action():
    seen = []
    trace = GYM.rollout(
        SCENARIO, lambda: lambda observation: seen.append(observation) or np.array([3])
    )
    assert {(array.shape, array.dtype) for array in seen} == {((5, 5), np.dtype(np.float32))}
    assert trace.actions == (3,) * 4  # highway-v0 decides once a second
    assert trace.ego[-1, 3] > 24


@table("action", [[0.1, 0.0], (0.1, 0.0), np.array([0.1, 0.0]), np.float32([0.1, 0]), [1, 0]])
def test_continuous_actions_may_be_lists_tuples_and_arrays(action):
    trace = CONTINUOUS.rollout(SCENARIO, always(action))
    assert trace.outcome is Outcome.COMPLETED
    assert trace.actions[0].tolist() == pytest.approx(list(action))


def test_reused_action_array_is_logged_with_true_values():
    buffer, numbers = np.zeros(2), iter(range(100))

    def policy(observation):
        buffer[0] = next(numbers) / 100
        return buffer

    trace = CONTINUOUS.rollout(SCENARIO, lambda: policy)
    assert [action[0] for action in trace.actions] == [0.0, 0.01, 0.02, 0.03]


# --- kind (c): vehicle classes


@pytest.mark.parametrize(
    "ego",
    [
        IDMVehicle,
        functools.partial(IDMVehicle, enable_lane_change=False),
        functools.partial(MDPVehicle, target_speeds=[10, 20]),
        lambda: IDMVehicle,
    ],
    ids=["class", "partial", "partial with speeds", "factory of a class"],
)
@worlds
def test_a_vehicle_class_drives_itself_at_every_tick(world, idle, ego):
    slow_leader = Scenario(npcs=[[PositionInstruction(2, 15.0)]], gene_seconds=10.0)
    trace = world.rollout(slow_leader, ego)
    assert trace.outcome in (Outcome.COMPLETED, Outcome.COLLISION)
    assert trace.actions == ()
    assert trace.ego[1:, 4].any()


# --- kind (d): planners inside the environment


def genes_reachable_from(thing):
    """Return whether a search through all references of an object reaches a director or a gene."""
    seen, queue = set(), [thing]
    while queue:
        item = queue.pop()
        if (
            id(item) in seen
            or isinstance(item, type)
            or type(item).__name__ in ("module", "function", "frame")
        ):
            continue
        if isinstance(item, (Director, PositionInstruction, Scenario)):
            return True
        seen.add(id(item))
        queue.extend(gc.get_referents(item))
    return False


def test_planner_that_copies_environment_finds_no_genes():
    found, traffic = [], []

    def factory(env):
        def plan(observation):
            found.append(genes_reachable_from(copy.deepcopy(env)) or genes_reachable_from(env))
            traffic.append(
                [(type(other), other.target_speed, other.speed) for other in env.road.vehicles[1:]]
            )
            return 1

        return plan

    GYM.rollout(SCENARIO, factory)
    assert found == [False] * 4
    for other_class, target_speed, speed in itertools.chain.from_iterable(traffic):
        assert other_class is IDMVehicle
        assert target_speed == speed


def test_the_search_for_genes_would_find_them():
    assert genes_reachable_from([{"a": (SCENARIO,)}])


def test_planner_changing_its_environment_does_not_change_run():
    def meddler(env):
        def plan(observation):
            inside = copy.deepcopy(env)
            for _ in range(3):
                inside.step(env.action_space.sample())
            env.step(0)  # inside the view, too
            env.vehicle.position[:] = 0.0
            env.road.vehicles.clear()
            env.config["simulation_frequency"] = 1
            return 3

        return plan

    reference = GYM.rollout(SCENARIO, lambda: lambda observation: 3)
    trace = GYM.rollout(SCENARIO, meddler)
    assert trace.states.tobytes() == reference.states.tobytes()
    assert (trace.outcome, trace.actions) == (reference.outcome, reference.actions)


def test_planner_environment_stays_in_step_with_run():
    shown = []

    def factory(env):
        def plan(observation):
            assert observation.tobytes() == env.observation_type.observe().tobytes()
            shown.append(
                [(*other.position, other.heading, other.speed) for other in env.road.vehicles]
            )
            return 3

        return plan

    trace = GYM.rollout(SCENARIO, factory)
    assert trace.outcome is Outcome.COMPLETED, trace.error
    assert shown == [
        [tuple(row) for row in states.tolist()] for states in trace.states[:60:15, :, :4]
    ]


def test_planner_that_samples_plans_the_same_each_time():
    """It is random shooting with the environment's own action space, and highway-env's random traffic behaviour."""

    def shooter(env):
        def plan(observation):
            best = (-math.inf, 1)
            for _ in range(3):
                inside = copy.deepcopy(env)
                action = env.action_space.sample()
                for other in inside.road.vehicles[1:]:
                    other.randomize_behavior()
                reward = inside.step(action)[1] + inside.np_random.uniform(0, 0.01)
                best = max(best, (reward, int(action)))
            return best[1]

        return plan

    runs = [GYM.rollout(SCENARIO, shooter) for _ in range(2)]
    assert len({(run.actions, run.states.tobytes()) for run in runs}) == 1


def test_planner_environment_has_kind_and_config_of_world():
    world = World(
        "highway-fast-v0", config={"lanes_count": 5, "action": {"type": "DiscreteAction"}}
    )
    seen = []
    world.rollout(SCENARIO, lambda env: seen.append(env) or (lambda observation: 4))
    assert seen[0].config["lanes_count"] == 5
    assert seen[0].spec.id == "highway-fast-v0"
    assert len(seen[0].road.network.lanes_list()) == 5


# --- fresh per scenario


@worlds
def test_every_run_gets_a_fresh_ads_from_factory(world, idle):
    made = []

    class Counting:
        def __init__(self):
            self.calls = 0
            made.append(self)

        def __call__(self, observation):
            self.calls += 1
            return idle

    first = world.rollout(SCENARIO, Counting)
    second = world.rollout(SCENARIO, Counting)
    assert [ads.calls for ads in made] == [len(first.actions)] * 2
    assert first.states.tobytes() == second.states.tobytes()


busy_worlds = pytest.mark.parametrize(
    ("world", "busy"), [(HIGHWAY, (1.0, 0.001)), (GYM, 3)], ids=["Highway", "World"]
)


@busy_worlds
def test_a_run_inside_a_run_disturbs_neither(world, busy):
    seen, seen_outside, inner = [], [], []

    def watching(observation):
        seen.append(np.array(getattr(observation, "array", observation)))
        return busy

    def nesting(observation):
        seen_outside.append(np.array(getattr(observation, "array", observation)))
        inner.append(world.rollout(SCENARIO.truncated(1), always(busy)))
        return busy

    plain = world.rollout(SCENARIO, lambda: watching)
    outer = world.rollout(SCENARIO, lambda: nesting)
    for trace in (outer, *inner):
        assert trace.states.tobytes() == plain.states.tobytes()
    assert np.array_equal(seen, seen_outside)


@busy_worlds
def test_runs_in_several_threads_equal_sequential_runs(world, busy):
    scenarios = [
        Scenario(npcs=[[PositionInstruction(cell, 20.0)]], gene_seconds=3.0) for cell in range(1, 9)
    ]
    expected = [world.rollout(scenario, always(busy)).states.tobytes() for scenario in scenarios]
    received = {}

    def work(index):
        received[index] = world.rollout(scenarios[index], always(busy)).states.tobytes()

    threads = [threading.Thread(target=work, args=(index,)) for index in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [received[index] for index in range(8)] == expected


# --- factories that are none


class CustomFault(Exception):  # noqa: N818
    pass


@worlds
@pytest.mark.parametrize("factory", [None, 3, "planner", (0.0, 0.0), object()])
def test_what_cannot_be_called_is_no_factory(world, idle, factory):
    with pytest.raises(
        AdsFactoryError, match=r"ads: expected a factory, a callable .*return lambda: MyPlanner"
    ):
        world.rollout(SCENARIO, factory)


def test_the_highway_has_no_environment_to_plan_in():
    with pytest.raises(
        AdsFactoryError,
        match=r'without the parameter `env`.*use world=pafot\.World\("highway-v0"\)',
    ):
        HIGHWAY.rollout(SCENARIO, lambda env: lambda observation: (0, 0))


@worlds
def test_what_the_factory_itself_raises_comes_through(world, idle):
    def factory():
        raise CustomFault("no weights file")

    with pytest.raises(CustomFault, match="no weights file"):
        world.rollout(SCENARIO, factory)
    assert world.rollout(SCENARIO, always(idle)).outcome is Outcome.COMPLETED


def test_factory_type_error_is_not_a_wrong_signature():
    def factory():
        return len(3)

    with pytest.raises(TypeError, match="has no len") as caught:
        HIGHWAY.rollout(SCENARIO, factory)
    assert not isinstance(caught.value, AdsFactoryError)


class Aggressive(IDMVehicle):
    def __init__(self, road, position, heading=0.0, speed=0.0, *, aggression):
        super().__init__(road, position, heading, speed)
        self.aggression = aggression


@pytest.mark.parametrize("world", [Highway(duration=2), World("highway-v0", duration=2)])
def test_vehicle_class_with_an_argument_of_its_own_is_refused_with_a_way_out(world):
    for factory in (Aggressive, lambda: Aggressive):
        # a World wants the class itself
        if not (isinstance(world, World) and factory is not Aggressive):
            with pytest.raises(
                AdsFactoryError,
                match=r"received Aggressive with .*functools\.partial\(Aggressive, ",
            ):
                world.rollout(Scenario(npcs=[[PositionInstruction(2, 22.0)]]), factory)
    given = functools.partial(Aggressive, aggression=2)
    assert world.rollout(Scenario(npcs=[[PositionInstruction(2, 22.0)]]), given).ticks > 0
