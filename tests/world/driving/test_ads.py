"""The four kinds of ADS, new for each scenario, and the factories that make them."""

import copy
import functools
import gc
import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import MDPVehicle

from pytest_pafot import Highway, Observation, PositionInstruction, Scenario, World
from pytest_pafot.model.trace import Outcome
from pytest_pafot.world import AdsFactoryError
from pytest_pafot.world.kernel.director import Director
from tests.helpers.tables import table

NPCS = [[PositionInstruction(1, 25.0)], [PositionInstruction(5, 20.0)]]
SCENARIO = Scenario(npcs=NPCS, gene_seconds=4.0)
HIGHWAY, GYM = Highway(), World("highway-v0")
CONTINUOUS = World("highway-v0", config={"action": {"type": "ContinuousAction"}})
worlds = pytest.mark.parametrize(
    ("world", "idle"), [(HIGHWAY, (0.0, 0.0)), (GYM, 1)], ids=["Highway", "World"]
)


def always(action):
    """Return a factory of an ADS that always returns the same thing."""
    return lambda: lambda observation: action


def noting(seen, action):
    """Return a factory of an ADS that stores what it sees and always returns the same thing."""
    return lambda: lambda observation: (seen.append(observation), action)[1]


# --- kind (a): planners on the highway


def test_planner_sees_scene_in_si_units():
    seen = []
    trace = HIGHWAY.rollout(SCENARIO, noting(seen, (0.5, 0.01)))
    assert [observation.time for observation in seen] == [tick / 5 for tick in range(20)]
    for tick, observation in zip(range(0, 60, 3), seen, strict=True):
        road = observation.lanes, observation.lane_width, observation.speed_limit
        assert (type(observation), *road) == (Observation, 4, 4.0, 26.8)
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


@table("action", [
    (1, 0), [1.0, 0.0], np.array([1.0, 0.0]), np.float32([1, 0]), (np.float32(1), np.int64(0)), iter,
])  # fmt: skip
def test_any_pair_of_numbers_is_an_action(action):
    ads = (lambda: lambda _: iter((1, 0))) if action is iter else always(action)
    trace = HIGHWAY.rollout(SCENARIO, ads)
    assert trace.outcome is Outcome.COMPLETED
    assert set(trace.actions) == {(1.0, 0.0)}


@table(("wild", "tame"), [
    ((1e9, 0.0), (6.0, 0.0)), ((-1e9, 0.0), (-9.81, 0.0)), ((0.0, 9.0), (0.0, math.pi / 4)),
])  # fmt: skip
def test_extreme_actions_are_limited_to_what_car_can(wild, tame):
    a, b = (HIGHWAY.rollout(SCENARIO, always(action)) for action in (wild, tame))
    assert a.states.tobytes() == b.states.tobytes()
    assert a.actions[0] == wild


def test_ego_off_road_records_its_first_tick():
    scenario = Scenario(npcs=[[PositionInstruction(8, 20.0)]], ego_lane=3)
    trace = HIGHWAY.rollout(scenario, always((0.0, 0.02)))
    assert trace.outcome is Outcome.OFF_ROAD
    off = trace.ego[:, 1] > 14.0
    assert trace.off_road_tick == off.argmax() > 0
    assert (trace.ego[off, 6] == -1).all()


# --- kind (b): policies of an environment


def test_policy_gets_environment_observation_and_gives_its_action():
    seen = []
    trace = GYM.rollout(SCENARIO, noting(seen, np.array([3])))
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


@table("ego", [
    IDMVehicle,
    functools.partial(IDMVehicle, enable_lane_change=False),
    functools.partial(MDPVehicle, target_speeds=[10, 20]),
    lambda: IDMVehicle,
])  # fmt: skip
@table("world", [HIGHWAY, GYM])
def test_a_vehicle_class_drives_itself_at_every_tick(world, ego):
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
        is_code = type(item).__name__ in ("module", "function", "frame") or isinstance(item, type)
        if id(item) in seen or is_code:
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
            others = env.road.vehicles[1:]
            traffic.extend((type(other), other.target_speed - other.speed) for other in others)
            return 1

        return plan

    GYM.rollout(SCENARIO, factory)
    assert found == [False] * 4
    assert set(traffic) == {(IDMVehicle, 0.0)}
    assert genes_reachable_from([{"a": (SCENARIO,)}]), "the search would find them"


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
            vehicles = env.road.vehicles
            shown.append([(*each.position, each.heading, each.speed) for each in vehicles])
            return 3

        return plan

    trace = GYM.rollout(SCENARIO, factory)
    assert trace.outcome is Outcome.COMPLETED, trace.error
    assert np.array_equal(shown, trace.states[:60:15, :, :4])


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
    config = {"lanes_count": 5, "action": {"type": "DiscreteAction"}}
    world, seen = World("highway-fast-v0", config=config), []
    world.rollout(SCENARIO, lambda env: seen.append(env) or (lambda observation: 4))
    assert (seen[0].spec.id, seen[0].config["lanes_count"]) == ("highway-fast-v0", 5)
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


def values(observation):
    return np.array(getattr(observation, "array", observation))


@busy_worlds
def test_a_run_inside_a_run_disturbs_neither(world, busy):
    seen, seen_outside, inner = [], [], []

    def nesting(observation):
        seen_outside.append(values(observation))
        inner.append(world.rollout(SCENARIO.truncated(1), always(busy)))
        return busy

    plain = world.rollout(SCENARIO, lambda: lambda now: (seen.append(values(now)), busy)[1])
    outer = world.rollout(SCENARIO, lambda: nesting)
    for trace in (outer, *inner):
        assert trace.states.tobytes() == plain.states.tobytes()
    assert np.array_equal(seen, seen_outside)


@busy_worlds
def test_runs_in_several_threads_equal_sequential_runs(world, busy):
    def work(cell):
        scenario = Scenario(npcs=[[PositionInstruction(cell, 20.0)]], gene_seconds=3.0)
        return world.rollout(scenario, always(busy)).states.tobytes()

    with ThreadPoolExecutor(8) as threads:
        assert [*threads.map(work, range(1, 9))] == [work(cell) for cell in range(1, 9)]


# --- factories that are none


class CustomFault(Exception):  # noqa: N818
    pass


NO_FACTORIES = [None, 3, "planner", (0.0, 0.0), object()]


@worlds
def test_what_is_no_factory_of_a_policy_is_refused(world, idle):
    factories = [*NO_FACTORIES, inside] if world is HIGHWAY else NO_FACTORIES
    for factory in factories:
        with pytest.raises(AdsFactoryError):
            world.rollout(SCENARIO, factory)


def inside(env):
    """Return a planner inside of an environment."""
    return lambda observation: (0, 0)


@worlds
def test_what_the_factory_itself_raises_comes_through(world, idle):
    def factory():
        raise CustomFault("no weights file")

    with pytest.raises(CustomFault):
        world.rollout(SCENARIO, factory)
    assert world.rollout(SCENARIO, always(idle)).outcome is Outcome.COMPLETED
    with pytest.raises(TypeError) as caught:
        world.rollout(SCENARIO, lambda: len(3))
    assert not isinstance(caught.value, AdsFactoryError)


class Aggressive(IDMVehicle):
    def __init__(self, road, position, heading=0.0, speed=0.0, *, aggression):
        super().__init__(road, position, heading, speed)
        self.aggression = aggression


SHORT = [Highway(duration=2), World("highway-v0", duration=2)]
AHEAD = Scenario(npcs=[[PositionInstruction(2, 22.0)]])


@pytest.mark.parametrize("world", SHORT)
def test_vehicle_class_with_an_argument_of_its_own_is_refused_without_it(world):
    # a World wants the class itself
    factories = [Aggressive] if isinstance(world, World) else [Aggressive, lambda: Aggressive]
    for factory in factories:
        with pytest.raises(AdsFactoryError):
            world.rollout(AHEAD, factory)
    assert world.rollout(AHEAD, functools.partial(Aggressive, aggression=2)).ticks > 0
