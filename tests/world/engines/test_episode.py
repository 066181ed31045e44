"""Episodes in an environment's own traffic, for every kind of ADS."""

import time

import gymnasium
import numpy as np
import pytest
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.highway_env import HighwayEnvFast
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import MDPVehicle

import pytest_pafot as pafot
from example_ads import constant_speed, idm_mobil
from pytest_pafot.support.errors import AdsFactoryError
from pytest_pafot.world import WorldError
from pytest_pafot.world.engines.episode import Episode, drive_episode
from pytest_pafot.world.gym_environment import vehicle_classes_kept

SHORT = {"vehicles_count": 10, "duration": 15}
FAST = pafot.World("highway-fast-v0", SHORT)


def undecided():
    """Return a policy that draws its actions."""
    rng = np.random.default_rng(0)
    return lambda seen: int(rng.integers(3))


def by_hand(world, factory, seed):
    """Return whether gymnasium's own environment flags a crash of a policy in the episode with a seed."""
    with vehicle_classes_kept():  # some environments set their constants
        env = gymnasium.make(world.env_id, config=world.config)
        seen, _ = env.reset(seed=seed)
        act, is_over = factory(), False
        while not (is_over or env.unwrapped.vehicle.crashed):
            seen, _, *ends, _ = env.step(act(seen))
            is_over = any(ends)
        return env.unwrapped.vehicle.crashed


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of old versions of environments
@pytest.mark.parametrize(
    ("env_id", "config", "seeds"),
    [("highway-fast-v0", SHORT, 6), ("merge-v0", {}, 3), ("intersection-v0", {"duration": 5}, 3)],
)
def test_policy_crashes_where_it_does_without_this_package(env_id, config, seeds):
    world = pafot.World(env_id, config)
    for seed in range(seeds):
        episode = drive_episode(world, undecided, seed)
        assert episode.crashed is by_hand(world, undecided, seed), seed


def test_vehicle_class_and_planner_take_the_place_of_the_ego():
    seeds = range(6)
    assert not any(drive_episode(FAST, idm_mobil.make, seed).crashed for seed in seeds)
    assert any(
        drive_episode(FAST, constant_speed.make, seed, is_planner=True).crashed for seed in seeds
    )


def test_crash_counts_though_the_environment_forgets_it(monkeypatch):
    def forgetful(env, action):
        seen, reward, *ends, info = AbstractEnv.step(env, action)
        env.vehicle.crashed = False
        if any(ends):
            env.reset()
        return seen, reward, *ends, info

    drives = [(each, seed) for each in (undecided, constant_speed.make) for seed in range(6)]
    episodes = [drive_episode(FAST, *each, is_planner=each[0] is not undecided) for each in drives]
    monkeypatch.setattr(HighwayEnvFast, "step", forgetful)
    assert [
        drive_episode(FAST, *each, is_planner=each[0] is not undecided) for each in drives
    ] == episodes
    assert (
        {each.crashed for each in episodes[:6]}
        == {each.crashed for each in episodes[6:]}
        == {True, False}
    )


def test_planner_sees_the_traffic_and_its_own_last_controls():
    """Its lanes are 4 m wide, with the centre of the first one at y = 0."""
    seen = []
    world = pafot.World("highway-fast-v0", {**SHORT, "duration": 3})
    drive_episode(world, lambda: lambda now: seen.append(now) or (0.5, 0.002), 0, is_planner=True)
    assert len(seen) in (15, 20)  # five in a second, and the last step may be driven
    assert {(now.acceleration, now.steering) for now in seen[1:]} == {(0.5, 0.002)}
    assert all(round(now.ego.y / 4.0) == now.ego.lane for now in seen)
    assert len(seen[0].others) == 10


def test_planner_may_simulate_the_environment():
    def looking_ahead(env):
        def act(observation):
            for action in (3, 1, 4):
                future = env.unwrapped.simplify()
                future.step(action)
                if not future.vehicle.crashed:
                    return action
            return 4

        return act

    world = pafot.World("highway-fast-v0", {**SHORT, "duration": 4})
    assert drive_episode(world, looking_ahead, 0) == Episode(0)


def test_failing_or_hanging_ads_ends_its_episode():
    def raising():
        actions = [1, 1]
        return lambda seen: actions.pop()

    failed = drive_episode(FAST, raising, 0)
    assert (failed.crashed, failed.error.kind) == (False, "IndexError")
    impatient = pafot.World("highway-fast-v0", SHORT, hang_limit=0.1)
    hung = drive_episode(impatient, lambda: lambda seen: time.sleep(5), 0)
    assert (hung.crashed, hung.error.interrupted) == (False, True)
    broken = drive_episode(FAST, lambda: 1 / 0, 0)
    assert broken.error.kind == "ZeroDivisionError"
    planner = drive_episode(FAST, lambda: lambda seen: "left", 0, is_planner=True)
    assert planner.error.kind == "BadAction"

    class Stuck(IDMVehicle):
        def act(self, action=None):
            raise KeyError("lane")

    assert drive_episode(FAST, lambda: Stuck, 0).error.kind == "KeyError"


def test_a_planner_needs_a_straight_road():
    with pytest.raises(
        WorldError, match=r"expected a straight road for a planner in SI units, received .*Merge"
    ):
        drive_episode(pafot.World("merge-v0"), constant_speed.make, 0, is_planner=True)


def test_imperfect_sight_needs_a_planner():
    blind = pafot.Perception(constant_speed.make, range=1.0)
    with pytest.raises(
        AdsFactoryError, match=r"expected the ADS in a pafot\.Perception to be a planner"
    ):
        drive_episode(FAST, blind, 0)
    seen = []
    looks = pafot.Perception(lambda: lambda now: seen.append(now) or (0.0, 0.0), range=1.0)
    drive_episode(FAST, looks, 0, is_planner=True)
    assert not seen[0].others


def test_environment_needing_its_own_ego_says_so():
    episode = drive_episode(pafot.World("lane-keeping-v0"), idm_mobil.make, 0)
    message = "AttributeError: 'IDMVehicle' object has no attribute 'state'"
    assert (episode.crashed, episode.error.text) == (False, message)


def test_environment_that_counts_its_steps_ends(monkeypatch):
    monkeypatch.setattr(gymnasium.spec("highway-fast-v0"), "max_episode_steps", 10)
    asked = []
    drive_episode(
        pafot.World("highway-fast-v0", SHORT), lambda: lambda seen: asked.append(seen) or 1, 0
    )
    assert len(asked) == 10


def test_environment_restores_class_constants_that_it_sets():
    before = IDMVehicle.DISTANCE_WANTED, MDPVehicle.DEFAULT_TARGET_SPEEDS
    drive_episode(pafot.World("intersection-v0", {"duration": 2}), lambda: lambda seen: 0, 0)
    assert before == (IDMVehicle.DISTANCE_WANTED, MDPVehicle.DEFAULT_TARGET_SPEEDS)
