"""The training script's output decides as stable-baselines3 does; the training itself is not run."""

import gymnasium as gym
import numpy as np
import pytest

from example_ads import ppo

torch = pytest.importorskip("torch", reason='needs pip install "pytest-pafot[sb3]"')
sb3 = pytest.importorskip("stable_baselines3", reason='needs pip install "pytest-pafot[sb3]"')

from example_ads.ppo import train  # noqa: E402


class FiveVehicles(gym.Env):
    """An environment with the spaces of highway-v0, in which nothing moves."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, shape=(5, 5), dtype=np.float32)
    action_space = gym.spaces.Discrete(5)


@pytest.fixture(scope="module")
def model():
    architecture = {
        "net_arch": {"pi": [128, 128], "vf": [128, 128]},
        "activation_fn": torch.nn.ReLU,
    }
    return sb3.PPO("MlpPolicy", FiveVehicles(), policy_kwargs=architecture, seed=0, device="cpu")


@pytest.fixture(scope="module")
def shipped(model):
    """Return stable-baselines3's own policy with the shipped weights."""
    train.give_actor(model, ppo.read_actor())
    return model


def test_numpy_policy_agrees_with_stable_baselines3(shipped):
    seen = list(np.random.default_rng(1).uniform(-1, 1, size=(500, 5, 5)).astype(np.float32))
    assert train.agreement(shipped, ppo.make(), seen) == 500


def test_exported_model_is_the_actor_only(shipped):
    for written, kept in zip(train.actor_of(shipped), ppo.read_actor(), strict=True):
        assert all(np.array_equal(a, b) for a, b in zip(written, kept, strict=True))


def test_layers_are_restored_exactly_from_the_file(model, tmp_path):
    layers = train.actor_of(model)
    train.write_actor(tmp_path / "actor.npz", layers)
    for before, after in zip(layers, ppo.read_actor(tmp_path / "actor.npz"), strict=True):
        assert all(np.array_equal(a, b) for a, b in zip(before, after, strict=True))
