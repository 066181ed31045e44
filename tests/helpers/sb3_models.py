"""Small Stable-Baselines3 models, and its own wrappers around the observations of a run: an oracle for the loader."""

from functools import partial

import gymnasium
import highway_env  # noqa: F401  (registers its environments)
import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

ENV = "highway-fast-v0"
CONTINUOUS = {"action": {"type": "ContinuousAction"}}


def saved_model(folder, cls, *, config=None, frames=1, is_normalised=False, steps=0, policy="MlpPolicy", **arguments):
    """Save a model trained for a number of steps, and its statistics; return their files."""
    env = DummyVecEnv([partial(gymnasium.make, ENV, config={"vehicles_count": 5, **(config or {})})])
    env.seed(1)
    if is_normalised:
        env = VecNormalize(env)
    if frames > 1:
        env = VecFrameStack(env, frames)
    model = cls(policy, env, seed=1, device="cpu", policy_kwargs={"net_arch": [32, 32]}, **arguments)
    if steps:
        model.learn(steps)
    model.save(folder / "model.zip")
    if is_normalised:
        model.get_vec_normalize_env().save(folder / "statistics.pkl")
    return folder / "model.zip", folder / "statistics.pkl" if is_normalised else None


class Shown(gymnasium.Env):
    """An environment that returns whatever observation it is given."""

    def __init__(self, observation_space, action_space):
        self.observation_space, self.action_space = observation_space, action_space
        self.next = None

    def reset(self, *, seed=None, options=None):
        return self.next, {}

    def step(self, action):
        return self.next, 0.0, False, False, {}


class InItsWrappers:
    """An ADS that uses VecNormalize and VecFrameStack themselves, and decides by ``model.predict``."""

    def __init__(self, model, world, statistics=None, frames=1):
        self.model, self.state = model, None
        self.shown = Shown(world.observation_space, world.action_space)
        self.env = DummyVecEnv([lambda: self.shown])
        if statistics is not None:
            self.env = VecNormalize.load(str(statistics), self.env)
            self.env.training = False
        if frames > 1:
            self.env = VecFrameStack(self.env, frames)
        self.action = None

    def __call__(self, observation):
        self.shown.next = observation
        start = np.array([self.action is None])
        seen = self.env.reset() if self.action is None else self.env.step(self.action)[0]
        self.action, self.state = self.model.predict(seen, self.state, start, deterministic=True)
        return self.action[0]
