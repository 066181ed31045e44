"""An ADS with imperfect sight: its observations, in runs of each kind, against the true states in the trace."""

import functools
from collections import deque
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from highway_env.envs.highway_env import HighwayEnv
from highway_env.vehicle.behavior import IDMVehicle

import pytest_pafot as pafot
from pytest_pafot.model.instructions import PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.sight import Sight, hidden
from pytest_pafot.model.trace import HEADING, SPEED, X, Y
from pytest_pafot.support.errors import AdsFactoryError, FieldError, WorldError
from pytest_pafot.world.driving.perception import sight_of
from tests.helpers.c_library import c_library
from tests.helpers.stages import mostly_oracle
from tests.helpers.tables import table
from tests.helpers.world_cases import changing_lanes

CHAINS = ((5, 17.4), (4, 26.6), (4, 13.7)), ((4, 26.4), (3, 13.3), (2, 23.6)), ((3, 17.5), (2, 21.0), (3, 25.5))
SCENARIO = Scenario(
    npcs=[[PositionInstruction(*gene) for gene in chain] for chain in CHAINS],
    seed=11,
    ego_lane=1,
    ego_speed=22.0,
    gene_seconds=3.0,
)
KINEMATICS = {
    "type": "Kinematics",
    "features": ["presence", "x", "y", "vx", "vy", "heading"],
    "absolute": True,
    "normalize": False,
    "vehicles_count": 4,
    "order": "sorted",
    "see_behind": True,
}
GYM = {"observation": KINEMATICS, "policy_frequency": 3, "duration": 6}
EVERYTHING = {
    "range": 40.0,
    "latency": 0.5,
    "noise": {"position": 0.5, "speed": 1.0},
    "dropout": 0.2,
    "occlusion": True,
    "shuffled": True,
    "ghosts": {"rate": 2.0, "lifetime": 1.0},
    "own_bias": {"position": 1.0, "heading": 0.02, "speed": 1.0},
}
FASTER, IDLE = 3, 1


class Watching:
    """An ADS that drives like a second planner, and stores its observations."""

    def __init__(self):
        self.shown = []
        self._drive = changing_lanes()

    def __call__(self, observation):
        self.shown.append(observation)
        return self._drive(observation)


class WatchingPolicy:
    """A policy that keeps its speed, and stores its observations."""

    def __init__(self, env=None):
        self.shown = []
        self.env = env
        self.views = []

    def __call__(self, observation):
        self.shown.append(observation)
        if self.env is not None:
            self.views.append([tuple(each.position) for each in self.env.road.vehicles])
        return IDLE


def run(rollout, kind, **imperfections):
    """Return the trace of a run, and the ADS that drove it."""
    made = []

    def factory():
        made.append(kind())
        return made[-1]

    return rollout(SCENARIO, pafot.Perception(factory, **imperfections)), made[-1]


def delayed(rows, ticks):
    """Yield rows as a delay line releases them: the first one until it is full."""
    line = deque([rows[0]] * (ticks + 1), maxlen=ticks + 1)
    for row in rows:
        line.append(row)
        yield line[0]


PLANNERS = {"loop": pafot.Highway(duration=9.0).rollout, "gymnasium": pafot.Highway(duration=9.0).rollout_in_gym}
POLICIES = {
    "loop": pafot.World("highway-v0", GYM).rollout,
    "gymnasium": pafot.World("highway-v0", GYM).rollout_in_gym,
    "wrappers": pafot.World("highway-v0", GYM, wrappers=[gymnasium.wrappers.FlattenObservation]).rollout,
}


@table("way", PLANNERS)
def test_planner_sees_others_delayed_and_itself_exactly(way):
    trace, ads = run(PLANNERS[way], Watching, latency=0.5)  # 8 ticks, and decisions are 3 apart
    lines = list(delayed(trace.npcs, 8))
    assert len(ads.shown) > 20
    for decision, seen in enumerate(ads.shown):
        tick = 3 * decision
        assert seen.time == tick / 15
        assert seen.ego[:4] == tuple(trace.ego[tick, [X, Y, HEADING, SPEED]])
        assert [each[:4] for each in seen.others] == [tuple(row) for row in lines[tick][:, [X, Y, HEADING, SPEED]]]


@pytest.mark.parametrize("way", POLICIES)
def test_policy_sees_others_delayed_and_itself_exactly(way):
    trace, ads = run(POLICIES[way], WatchingPolicy, latency=0.5)
    lines = list(delayed(trace.npcs, 8))
    assert len(ads.shown) > 10
    for decision, observed in enumerate(ads.shown):
        tick, rows = 5 * decision, observed.reshape(4, 6)
        assert rows[0, 1:3] == pytest.approx(trace.ego[tick, [X, Y]], rel=1e-6)
        expected = sorted(lines[tick][:, [X, Y]].tolist())
        assert np.array(sorted(rows[1:, 1:3].tolist())) == pytest.approx(np.array(expected), rel=1e-6)


@pytest.mark.parametrize("name", EVERYTHING)
def test_env_step_shows_a_planner_the_same(name):
    with c_library():
        (trace, first), (stock, again) = (run(way, Watching, **{name: EVERYTHING[name]}) for way in PLANNERS.values())
    assert again.shown == first.shown != run(PLANNERS["loop"], Watching)[1].shown
    assert stock.states.tobytes() == trace.states.tobytes()


def test_env_step_shows_a_policy_the_same():
    runs = [run(rollout, WatchingPolicy, **EVERYTHING)[1].shown for rollout in POLICIES.values()]
    for shown in runs[1:]:
        assert np.array([each.ravel() for each in shown]) == pytest.approx(np.array([each.ravel() for each in runs[0]]))


@pytest.mark.parametrize("env_id", mostly_oracle(["merge-v0", "two-way-v0", "racetrack-v0"], "two-way-v0"))
def test_policy_sees_the_same_on_any_road(env_id):
    world = pafot.World(env_id, duration=4.0)
    lane, speed = world.start or (1, 22.0)
    scenario = Scenario(npcs=[[PositionInstruction(2, 8.0)]], ego_lane=lane, ego_speed=speed, seed=5)
    shown = []

    def policy():
        shown.append([])
        action = [0.0] if env_id == "racetrack-v0" else IDLE
        return lambda observation: shown[-1].append(np.array(observation)) or action

    factory = pafot.Perception(policy, **EVERYTHING)
    for rollout, each in ((world.rollout, factory), (world.rollout_in_gym, factory), (world.rollout, policy)):
        rollout(scenario, each)
    direct, stepped, perfect = map(np.array, shown)
    assert np.array_equal(direct, stepped)
    assert not np.array_equal(direct, perfect)


def test_environment_that_resets_itself_shows_the_same(monkeypatch):
    class Resetting(HighwayEnv):
        def reset(self, **options):
            return super().reset(**options)

    monkeypatch.setitem(gymnasium.registry, "mine-v0", EnvSpec("mine-v0", entry_point=Resetting))
    own, stock = (
        run(pafot.World(name, GYM).rollout_in_gym, WatchingPolicy, **EVERYTHING)[1]
        for name in ("mine-v0", "highway-v0")
    )
    assert np.array_equal(own.shown, stock.shown)


def test_range_and_occlusion_apply_at_the_seen_moment():
    trace, ads = run(PLANNERS["loop"], Watching, latency=1.0, range=50.0, occlusion=True)
    sizes = np.broadcast_to(trace.sizes, (len(trace.states), 4, 2))
    states = np.concatenate([trace.states[..., :4], np.zeros_like(sizes[..., :1]), sizes], axis=-1)
    counts = set()
    for decision, seen in enumerate(ads.shown):
        then = states[max(0, 3 * decision - 15)]
        near = np.hypot(*(then[1:, :2] - then[0, :2]).T) <= 50.0
        expected = [tuple(row[:2]) for row in then[1:][near & ~hidden(then)]]
        assert [each[:2] for each in seen.others] == expected
        assert seen.ids == tuple(np.flatnonzero(near & ~hidden(then)))
        counts.add(len(expected))
    assert len(counts) > 1


def test_vehicle_lane_is_that_of_its_seen_position():
    _, ads = run(PLANNERS["loop"], Watching, noise={"position": 3.0})
    seen = [each for observation in ads.shown for each in observation.others]
    assert {each.lane == min(range(4), key=lambda lane: abs(each.y - 4.0 * lane)) for each in seen} == {True}


def test_shuffled_vehicles_keep_their_ids_and_states():
    (_, plain), (_, ads) = run(PLANNERS["loop"], Watching), run(PLANNERS["loop"], Watching, shuffled=True)
    for exact, seen in zip(plain.shown, ads.shown, strict=True):
        assert dict(zip(seen.ids, seen.others, strict=True)) == dict(zip(exact.ids, exact.others, strict=True))
        lateral = dict(zip(exact.ids, exact.lateral_velocities[1:], strict=True))
        assert seen.lateral_velocities[1:] == tuple(lateral[each] for each in seen.ids)
        assert seen.array[1:].tolist() == [list(each) for each in seen.others]
    assert len({seen.ids for seen in ads.shown}) == 6


def test_ghosts_are_seen_next_to_the_vehicles_that_exist():
    ghosts = {"rate": 3.0, "lifetime": 1.0}
    (_, plain), (_, ads) = run(PLANNERS["loop"], Watching), run(PLANNERS["loop"], Watching, ghosts=ghosts)
    expected = [list(Sight(ghosts=ghosts).ghosts_at(SCENARIO.seed, seen.time)) for seen in ads.shown]
    for exact, seen, there in zip(plain.shown, ads.shown, expected, strict=True):
        assert seen.others[:3] == exact.others
        assert seen.ids == (0, 1, 2, *(3 + each.number for each in there))
        assert len(seen.lateral_velocities) == len(seen.array) == len(seen.ids) + 1
        for each, ghost in zip(seen.others[3:], there, strict=True):
            assert (each.x - seen.ego.x, each.y - seen.ego.y) == pytest.approx(ghost[1:3])
            assert each.speed == max(0.0, seen.ego.speed + ghost.faster)
            assert each.lane == min(range(4), key=lambda lane, y=each.y: abs(y - 4.0 * lane))
    assert len({each for seen in ads.shown for each in seen.ids}) > 10


def test_biased_ego_measures_the_others_from_where_it_takes_itself_to_be():
    bias = {"position": 1.0, "heading": 0.02, "speed": 1.0}
    own = Sight(own_bias=bias).own_errors(SCENARIO.seed)
    shown = [], []
    for now, wrong in zip(shown, ({}, {"own_bias": bias}), strict=True):
        run(PLANNERS["loop"], lambda now=now: lambda seen: now.append(seen) or (0.0, 0.001), **wrong)
    for exact, seen in zip(*shown, strict=True):
        errors = np.subtract(seen.ego[:4], exact.ego[:4])
        assert errors == pytest.approx(np.array(own))
        for was, each in zip(exact.others, seen.others, strict=True):
            assert in_frame_of(seen.ego, each) == pytest.approx(in_frame_of(exact.ego, was))
        drifts = [each.speed * np.sin(each.heading) for each in (seen.ego, *seen.others)]
        before = [each.speed * np.sin(each.heading) for each in (exact.ego, *exact.others)]
        slips = np.subtract(exact.lateral_velocities, before)
        assert np.array(seen.lateral_velocities) == pytest.approx(np.array(drifts) + slips)


def in_frame_of(ego, other):
    """Return what a sensor on the ego measures: distance, bearing, relative heading, and the speed that it adds up."""
    dx, dy, turned = other.x - ego.x, other.y - ego.y, other.heading - ego.heading
    bearing = np.angle(np.exp(1j * (np.arctan2(dy, dx) - ego.heading)))
    return np.hypot(dx, dy), bearing, turned, other.speed - ego.speed * np.cos(turned)


def test_policy_sees_the_same_ghosts_and_errors_as_a_planner():
    """On a straight road, where both keep speed and wheels as they are."""
    config = GYM | {"observation": KINEMATICS | {"vehicles_count": 30}, "action": {"type": "ContinuousAction"}}
    worlds = pafot.World("highway-v0", config), pafot.World("highway-v0", {"duration": 6}, planner_hz=3)
    wrong = {name: EVERYTHING[name] for name in ("range", "dropout", "ghosts", "own_bias")}
    shown = [], []
    for world, seen, action in zip(worlds, shown, (np.zeros(2), (0.0, 0.0)), strict=True):
        run(world.rollout, lambda seen=seen, action=action: lambda now: seen.append(now) or action, **wrong)
    for rows, seen in zip(*shown, strict=True):
        there = sorted(rows[rows[:, 0] == 1][:, 1:4].tolist())
        expected = sorted((each.x, each.y, each.speed * np.cos(each.heading)) for each in (seen.ego, *seen.others))
        assert np.array(there) == pytest.approx(np.array(expected), rel=1e-4)
    assert len({each for seen in shown[1] for each in seen.ids if each >= 3}) == 3


def test_ego_is_exact_again_after_each_observation():
    wrong = {"own_bias": {"position": 5.0, "heading": 0.1, "speed": 5.0}}
    for rollout in POLICIES.values():
        exact, biased = run(rollout, WatchingPolicy)[0], run(rollout, WatchingPolicy, **wrong)[0]
        assert biased.states.tobytes() == exact.states.tobytes()


def test_biased_policy_sees_fixed_objects_where_they_are_on_the_road():
    """Unlike vehicles, they do not move with the ego's error, so the policy's gap to them is wrong by it."""
    world = pafot.World("merge-v0", {"observation": KINEMATICS})
    scenario = replace(SCENARIO, ego_speed=30.0, gene_seconds=12.0, npcs=[[PositionInstruction(6, 15.0)]])
    (obstacle,), shown = world.rules.obstacles, ([], [])
    for seen, wrong in zip(shown, ({}, {"own_bias": {"position": 5.0}}), strict=True):
        world.rollout(scenario, pafot.Perception(lambda seen=seen: lambda now: seen.append(now) or IDLE, **wrong))
    rows = [[row[1:3].tolist() for row in now[1:] if row[0]] for now in shown[1]]
    assert np.abs(shown[0][0][0, 1:3] - shown[1][0][0, 1:3]).max() > 0.5
    assert any(row == pytest.approx(obstacle[:2], abs=1e-3) for now in rows for row in now)


def test_occupancy_grid_is_empty_without_visible_vehicles():
    config = {"observation": {"type": "OccupancyGrid", "features": ["presence"]}, "duration": 3}
    rollout = pafot.World("highway-v0", config).rollout
    assert sum(grid.sum() for grid in run(rollout, WatchingPolicy)[1].shown) > 3  # four times, without the ego
    assert {grid.sum() for grid in run(rollout, WatchingPolicy, range=0.0)[1].shown} == {1.0}


def test_planner_in_environment_finds_only_visible_vehicles():
    made = []

    def factory(env):
        made.append(WatchingPolicy(env))
        return made[-1]

    for rollout in (POLICIES["loop"], POLICIES["gymnasium"]):
        rollout(SCENARIO, pafot.Perception(factory, range=30.0))
    first, second = (ads.views for ads in made)
    assert first == second
    assert {len(view) for view in first} == {1, 2, 3, 4} & {len(view) for view in first} != {4}


class OfItsOwn:
    """An ADS that says how it was made, and is closed."""

    def __init__(self):
        self.closed = []

    def __call__(self, observation):
        return -1.0 if len(observation.others) % 2 else 0.5, 0.0

    def close(self):
        self.closed.append(True)


def test_perception_passes_questions_to_the_policy_factory():
    class Loading:
        def check_world(self, world):
            raise WorldError(f"not on {world.lanes} lanes")

        def __call__(self):
            return Watching()

    factory = pafot.Perception(Loading(), latency=0.2)
    with pytest.raises(WorldError, match="not on 4 lanes"):
        pafot.Highway().rollout(SCENARIO, factory)


def test_ads_is_closed_and_gains_no_methods():
    _, ads = run(PLANNERS["loop"], OfItsOwn, latency=0.2)
    assert ads.closed == [True]
    assert not hasattr(pafot.Perception(Watching)(), "close")


@table(
    ("make", "error", "message"),
    [
        (lambda: pafot.Perception(IDMVehicle), AdsFactoryError, "a highway-env vehicle class drives itself"),
        (lambda: pafot.Perception(pafot.Perception(Watching)), AdsFactoryError, "all imperfections to one"),
        (lambda: pafot.Perception(42), AdsFactoryError, "give a function or class that makes one"),
        (lambda: pafot.Perception(Watching, latency=-1.0), FieldError, "latency: expected"),
        (pafot.Perception(lambda: IDMVehicle), AdsFactoryError, "expected a callable in a Perception"),
        (
            lambda: pafot.Perception(Watching)("what is seen"),
            AdsFactoryError,
            "that is used as the factory, received a call of it with an observation",
        ),
        (lambda: pafot.Perception(Watching)()("what is seen"), WorldError, "expected pafot.Highway or pafot.World"),
    ],
)
def test_what_cannot_be_is_refused(make, error, message):
    with pytest.raises(error, match=message):
        make()


@pytest.mark.parametrize("world", [pafot.Highway(), pafot.World("highway-v0"), pafot.World("merge-v0")])
def test_hidden_perception_inside_a_factory_is_refused(world):
    def inner():
        return pafot.Perception(WatchingPolicy, noise={"speed": 1.0})()

    for factory in (inner, pafot.Perception(inner, latency=0.2)):
        with pytest.raises(
            AdsFactoryError, match=r"expected a pafot\.Perception as the factory itself, received a pafot\.Perception "
        ):
            world.rollout(SCENARIO, factory)


def test_functools_wrapper_reveals_the_perception_it_wraps():
    seeing = pafot.Perception(Watching, latency=0.2)

    @functools.wraps(seeing)
    def wrapper():
        return seeing()

    assert sight_of(wrapper) == seeing.sight
    assert PLANNERS["loop"](SCENARIO, wrapper).error is None


@pytest.mark.parametrize("rollout", ["rollout", "rollout_in_gym"])
def test_observation_without_road_data_is_refused(rollout):
    config = {"observation": {"type": "AttributesObservation", "attributes": ["steps"]}}
    world = pafot.World("highway-v0", config)
    with pytest.raises(WorldError, match=r"config\.observation: expected .*\"Kinemat.*received AttributesObservation"):
        getattr(world, rollout)(SCENARIO, pafot.Perception(WatchingPolicy, latency=0.2))
