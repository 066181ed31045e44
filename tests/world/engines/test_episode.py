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


def crashes(factory, **given):
    """Return by seed whether an ADS crashes in an episode."""
    return [drive_episode(FAST, factory, seed, **given).crashed for seed in range(6)]


def test_vehicle_class_and_planner_take_the_place_of_the_ego():
    assert not any(crashes(idm_mobil.make))
    assert any(crashes(constant_speed.make, is_planner=True))


def test_crash_counts_though_the_environment_forgets_it(monkeypatch):
    def forgetful(env, action):
        seen, reward, *ends, info = AbstractEnv.step(env, action)
        env.vehicle.crashed = False
        if any(ends):
            env.reset()
        return seen, reward, *ends, info

    found = crashes(undecided), crashes(constant_speed.make, is_planner=True)
    monkeypatch.setattr(HighwayEnvFast, "step", forgetful)
    assert (crashes(undecided), crashes(constant_speed.make, is_planner=True)) == found
    assert {*found[0]} == {*found[1]} == {True, False}


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
        def crashes(action):
            future = env.unwrapped.simplify()
            future.step(action)
            return future.vehicle.crashed

        return lambda observation: next((each for each in (3, 1, 4) if not crashes(each)), 4)

    world = pafot.World("highway-fast-v0", {**SHORT, "duration": 4})
    assert drive_episode(world, looking_ahead, 0) == Episode(0)


def test_failing_or_hanging_ads_ends_its_episode():
    def raising():
        actions = [1, 1]
        return lambda seen: actions.pop()

    class Stuck(IDMVehicle):
        def act(self, action=None):
            raise KeyError("lane")

    failed = [drive_episode(FAST, ads, 0) for ads in (raising, lambda: 1 / 0, lambda: Stuck)]
    assert [each.error.kind for each in failed] == ["IndexError", "ZeroDivisionError", "KeyError"]
    assert not any(each.crashed for each in failed)
    impatient = pafot.World("highway-fast-v0", SHORT, hang_limit=0.1)
    hung = drive_episode(impatient, lambda: lambda seen: time.sleep(5), 0)
    assert (hung.crashed, hung.error.interrupted) == (False, True)
    planner = drive_episode(FAST, lambda: lambda seen: "left", 0, is_planner=True)
    assert planner.error.kind == "BadAction"


def test_a_planner_needs_a_straight_road():
    with pytest.raises(WorldError):
        drive_episode(pafot.World("merge-v0"), constant_speed.make, 0, is_planner=True)


def test_imperfect_sight_needs_a_planner():
    with pytest.raises(AdsFactoryError):
        drive_episode(FAST, pafot.Perception(constant_speed.make, range=1.0), 0)
    seen = []
    looks = pafot.Perception(lambda: lambda now: seen.append(now) or (0.0, 0.0), range=1.0)
    drive_episode(FAST, looks, 0, is_planner=True)
    assert not seen[0].others


def test_environment_needing_its_own_ego_says_so():
    episode = drive_episode(pafot.World("lane-keeping-v0"), idm_mobil.make, 0)
    assert (episode.crashed, episode.error.kind) == (False, "AttributeError")
    assert "'state'" in episode.error.message


def test_environment_that_counts_its_steps_ends(monkeypatch):
    monkeypatch.setattr(gymnasium.spec("highway-fast-v0"), "max_episode_steps", 10)
    asked, world = [], pafot.World("highway-fast-v0", SHORT)
    drive_episode(world, lambda: lambda seen: asked.append(seen) or 1, 0)
    assert len(asked) == 10


def test_environment_restores_class_constants_that_it_sets():
    before = IDMVehicle.DISTANCE_WANTED, MDPVehicle.DEFAULT_TARGET_SPEEDS
    drive_episode(pafot.World("intersection-v0", {"duration": 2}), lambda: lambda seen: 0, 0)
    assert before == (IDMVehicle.DISTANCE_WANTED, MDPVehicle.DEFAULT_TARGET_SPEEDS)
