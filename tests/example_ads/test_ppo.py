"""The PPO policy consists of plain arrays, runs in numpy, and drives well in its training environment."""

import numpy as np
import pytest

from example_ads import ppo
from example_ads.ppo import train
from pytest_pafot import World
from pytest_pafot.world.engines.episode import Episode, drive_episode

ACTIONS = 5


@pytest.fixture(scope="module")
def observations():
    """Return Kinematics observations, shape [500, 5, 5]: presence, then values that highway-env clips to [-1, 1]."""
    return np.random.default_rng(0).uniform(-1, 1, size=(500, 5, 5)).astype(np.float32)


def test_weights_are_small_file_of_float32_arrays():
    assert ppo.ACTOR.stat().st_size < 200_000
    with np.load(ppo.ACTOR, allow_pickle=False) as arrays:
        assert {array.dtype for array in arrays.values()} == {np.dtype(np.float32)}


def test_it_takes_the_action_with_the_largest_logit():
    layers = ((np.eye(2, 3, dtype=np.float32), np.array([0, 0, 0.5], dtype=np.float32)),)
    policy = ppo.PpoPolicy(layers)
    assert policy(np.array([[0.1, 0.9]])) == 1
    assert policy(np.array([[0.1, 0.2]])) == 2


def test_ppo_actions_are_plain_valid_integers(observations):
    actions = [ppo.make()(observation) for observation in observations[:20]]
    assert all(type(action) is int and 0 <= action < ACTIONS for action in actions)


def test_float64_observations_are_rounded_to_float32_first(observations):
    policy = ppo.make()
    assert all(policy(o.astype(np.float64)) == policy(o) for o in observations)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_it_drives_through_ordinary_traffic_without_a_crash(seed):
    world = World("highway-fast-v0", {"lanes_count": 4})
    assert drive_episode(world, ppo.make, seed) == Episode(seed)


def test_weights_survive_scaling_and_back_exactly():
    inside = train.in_scale(ppo.read_actor(), np.reciprocal(train.SCALES))
    for kept, again in zip(ppo.read_actor(), train.in_scale(inside, train.SCALES), strict=True):
        assert all(
            np.array_equal(a, b) and a.dtype == b.dtype for a, b in zip(kept, again, strict=True)
        )
