"""Train the PPO policy of this folder and write its actor as plain numpy arrays.

    pip install "pytest-pafot[sb3]"
    python -m example_ads.ppo.train

This takes about six minutes on one core. Then it prints how often the result crashes in unmodified ``highway-v0``, and
on how many observations its numpy form chooses the same action as stable-baselines3. ``--report-only`` prints the
crashes of the weights in this package: 1 in 30 episodes, at 20 m/s.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import gymnasium as gym
import highway_env
import numpy as np
import numpy.typing as npt

from . import ACTOR, Layers, PpoPolicy, read_actor

TRAINING_CONFIG = {
    "lanes_count": 4,
    "vehicles_count": 11,
    "vehicles_density": 1.4,
    "duration": 25,
    "high_speed_reward": 0.5,
    "right_lane_reward": 0.0,
}
"""Changes to ``highway-fast-v0``, which steps its physics 5 times a second and tests only the ego for collisions.

It has four lanes as in ``highway-v0``, but is shorter and denser, so that more of the simulation is useful for
learning.
"""

SCALES = np.array([1, 8, 4, 16, 16], dtype=np.float32)
"""The factors of presence, x, y, vx and vy in training, so that 25 m, a lane and 5 m/s are each about 1.

highway-env divides by 200 m and 80 m/s, which makes the relevant differences too small for a new network. The factors
are powers of two, so that the first layer can absorb them without rounding.
"""

Decide = Callable[[npt.NDArray[np.float32]], int]


class UnevenTraffic(gym.Wrapper[Any, Any, Any, Any]):
    """An environment in which half of the others slow down to between 8 and 20 m/s.

    All of highway-env's traffic drives at 21 m/s or more, and the slowest meta-action at 20. Then slowing down always
    works, and a policy learns nothing else.
    """

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Start an episode."""
        observation = self.env.reset(seed=seed, options=options)
        env: Any = self.unwrapped
        for vehicle in env.road.vehicles[1:]:
            if env.np_random.random() < 0.5:
                vehicle.target_speed = env.np_random.uniform(8, 20)
        return observation


def train(steps: int, seed: int) -> Any:
    """Return a stable-baselines3 PPO model after this many environment steps."""
    model = untrained(
        UnevenTraffic(gym.make("highway-fast-v0", config=TRAINING_CONFIG)),
        seed,
        learning_rate=lambda remaining: 6e-4 * remaining,
        verbose=1,
    )
    model.learn(total_timesteps=steps, log_interval=4)
    model.env.close()
    return model


def untrained(plain: gym.Env[Any, Any], seed: int, **arguments: Any) -> Any:
    """Return a new stable-baselines3 PPO model, with more arguments, in an environment with scaled observations."""
    import torch  # noqa: PLC0415 - the extra `sb3`
    from stable_baselines3 import PPO  # noqa: PLC0415

    torch.set_num_threads(1)
    env = gym.wrappers.TransformObservation(plain, lambda observation: observation * SCALES, plain.observation_space)
    return PPO(
        "MlpPolicy",
        env,
        n_steps=512,
        batch_size=64,
        n_epochs=10,
        gamma=0.9,
        ent_coef=0.003,
        policy_kwargs={
            "net_arch": {"pi": [128, 128], "vf": [128, 128]},
            "activation_fn": torch.nn.ReLU,
        },
        seed=seed,
        device="cpu",
        **arguments,
    )


def actor_of(model: Any) -> Layers:
    """Return the actor's layers from the input on, for the unscaled observations of highway-env."""
    layers = [(layer.weight.detach().numpy().T, layer.bias.detach().numpy()) for layer in actor_modules(model)]
    return in_scale(layers, SCALES)


def give_actor(model: Any, layers: Layers) -> None:
    """Make a model decide as these layers do, the inverse of :func:`actor_of`. Its critic does not change."""
    import torch  # noqa: PLC0415

    with torch.no_grad():
        for layer, (weights, biases) in zip(actor_modules(model), in_scale(layers, np.reciprocal(SCALES)), strict=True):
            layer.weight.copy_(torch.from_numpy(weights.T.copy()))
            layer.bias.copy_(torch.from_numpy(biases.copy()))


def actor_modules(model: Any) -> list[Any]:
    """Return the linear modules of a model's actor, from the input on."""
    import torch  # noqa: PLC0415

    modules = [*model.policy.mlp_extractor.policy_net, model.policy.action_net]
    return [module for module in modules if isinstance(module, torch.nn.Linear)]


def in_scale(layers: Iterable[tuple[Any, Any]], scales: npt.NDArray[np.float32]) -> Layers:
    """Return the layers for inputs without scales, given one scale for each feature of a vehicle."""
    (first, biases), *rest = layers
    per_input = np.tile(scales, len(first) // len(scales))[:, np.newaxis]
    return ((first * per_input, biases), *rest)


def write_actor(path: Path, layers: Layers) -> None:
    """Write layers in the format of :func:`read_actor`."""
    arrays = {f"weights_{n}": np.ascontiguousarray(weights) for n, (weights, _) in enumerate(layers)}
    arrays |= {f"biases_{n}": biases for n, (_, biases) in enumerate(layers)}
    np.savez(path, **arrays)  # type: ignore[arg-type]  # its keyword arguments are arrays, except one flag


def crashes(decide: Decide, episodes: int, env_id: str = "highway-v0") -> tuple[int, list[npt.NDArray[np.float32]]]:
    """Return in how many of the episodes 0, 1, 2 ... the policy crashed, and all its observations."""
    env = gym.make(env_id)
    crashed, seen = 0, []
    for seed in range(episodes):
        observation, _ = env.reset(seed=seed)
        over = False
        while not over:
            seen.append(observation)
            observation, _, terminated, truncated, _ = env.step(decide(observation))
            over = terminated or truncated
        crashed += terminated
    env.close()
    return crashed, seen


def agreement(model: Any, policy: PpoPolicy, observations: list[npt.NDArray[np.float32]]) -> int:
    """Return on how many observations the numpy policy and stable-baselines3 choose the same action."""
    return sum(policy(o) == int(model.predict(o * SCALES, deterministic=True)[0]) for o in observations)


def main() -> None:
    """Train, write, and report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--steps", type=int, default=36_864, help="environment steps (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the training (default: %(default)s)")
    parser.add_argument("--output", type=Path, default=ACTOR, help="file to write (default: %(default)s)")
    parser.add_argument("--episodes", type=int, default=30, help="episodes of the report (default: %(default)s)")
    parser.add_argument("--report-only", action="store_true", help="report on the file, without training")
    options = parser.parse_args()
    gym.register_envs(highway_env)
    model = None if options.report_only else train(options.steps, options.seed)
    if model is not None:
        write_actor(options.output, actor_of(model))
    policy = PpoPolicy(read_actor(options.output))
    crashed, observations = crashes(policy, options.episodes)
    print(f"crashed in {crashed} of {options.episodes} episodes of highway-v0 ({len(observations)} decisions)")
    if model is not None:
        sample = observations[:500]
        print(f"numpy and stable-baselines3 agree on {agreement(model, policy, sample)} of {len(sample)} observations")


if __name__ == "__main__":
    main()
