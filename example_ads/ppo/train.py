"""Train the PPO policy in this folder, and write its actor as numpy arrays.

    pip install "pytest-pafot[sb3]"
    python -m example_ads.ppo.train

This takes about six minutes on one core. The program then prints how often the policy crashes in unmodified
``highway-v0``, and for how many observations the numpy version chooses the same action as stable-baselines3.
``--report-only`` prints only the crashes with the weights in this package: 1 in 30 episodes, at 20 m/s.
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
"""Changes to ``highway-fast-v0``, which simulates 5 ticks per second and checks only the ego for collisions.

With these changes, it has four lanes, like ``highway-v0``, but shorter episodes and denser traffic, so that more of the
simulation is useful for learning.
"""

SCALES = np.array([1, 8, 4, 16, 16], dtype=np.float32)
"""The factors for presence, x, y, vx and vy in training, which make 25 m, one lane and 5 m/s each about 1.

highway-env divides by 200 m and 80 m/s, which makes the relevant differences too small for a new network. The factors
are powers of two, so that they can be multiplied into the first layer without rounding.
"""

Decide = Callable[[npt.NDArray[np.float32]], int]


class UnevenTraffic(gym.Wrapper[Any, Any, Any, Any]):
    """An environment in which half of the other vehicles slow down to between 8 and 20 m/s.

    All of highway-env's traffic drives at 21 m/s or more, and the lowest speed of the meta-actions is 20 m/s. Without
    this change, slowing down always works, and a policy learns nothing else.
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
    """Train a stable-baselines3 PPO model for a number of environment steps, and return it."""
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
    """Return a new stable-baselines3 PPO model for an environment, whose observations it scales."""
    import torch  # noqa: PLC0415 - the extra `sb3`
    from stable_baselines3 import PPO  # noqa: PLC0415

    torch.set_num_threads(1)
    env = gym.wrappers.TransformObservation(
        plain, lambda observation: observation * SCALES, plain.observation_space
    )
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
    """Return the actor's layers, first layer first, for the unscaled observations of highway-env."""
    layers = [
        (layer.weight.detach().numpy().T, layer.bias.detach().numpy())
        for layer in actor_modules(model)
    ]
    return in_scale(layers, SCALES)


def give_actor(model: Any, layers: Layers) -> None:
    """Copy layers into a model's actor, the inverse of :func:`actor_of`. The critic does not change."""
    import torch  # noqa: PLC0415

    with torch.no_grad():
        for layer, (weights, biases) in zip(
            actor_modules(model), in_scale(layers, np.reciprocal(SCALES)), strict=True
        ):
            layer.weight.copy_(torch.from_numpy(weights.T.copy()))
            layer.bias.copy_(torch.from_numpy(biases.copy()))


def actor_modules(model: Any) -> list[Any]:
    """Return the linear modules of a model's actor, first layer first."""
    import torch  # noqa: PLC0415

    modules = [*model.policy.mlp_extractor.policy_net, model.policy.action_net]
    return [module for module in modules if isinstance(module, torch.nn.Linear)]


def in_scale(layers: Iterable[tuple[Any, Any]], scales: npt.NDArray[np.float32]) -> Layers:
    """Return layers for unscaled inputs from layers for scaled inputs, with one scale per feature of a vehicle."""
    (first, biases), *rest = layers
    per_input = np.tile(scales, len(first) // len(scales))[:, np.newaxis]
    return ((first * per_input, biases), *rest)


def write_actor(path: Path, layers: Layers) -> None:
    """Write layers in the format that :func:`read_actor` reads."""
    arrays = {
        f"weights_{n}": np.ascontiguousarray(weights) for n, (weights, _) in enumerate(layers)
    }
    arrays |= {f"biases_{n}": biases for n, (_, biases) in enumerate(layers)}
    np.savez(path, **arrays)  # type: ignore[arg-type]  # all its keyword arguments are arrays, except one flag


def crashes(
    decide: Decide, episodes: int, env_id: str = "highway-v0"
) -> tuple[int, list[npt.NDArray[np.float32]]]:
    """Return the number of episodes in which the policy crashed, and all its observations."""
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
    """Return the number of observations for which the numpy policy and stable-baselines3 choose the same action."""
    return sum(
        policy(o) == int(model.predict(o * SCALES, deterministic=True)[0]) for o in observations
    )


def main() -> None:
    """Train a policy, write its actor, and print a report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument(
        "--steps",
        type=int,
        default=36_864,
        help="number of environment steps (default: %(default)s)",
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="seed for training (default: %(default)s)"
    )
    parser.add_argument(
        "--output", type=Path, default=ACTOR, help="file for the actor (default: %(default)s)"
    )
    parser.add_argument(
        "--episodes", type=int, default=30, help="episodes for the report (default: %(default)s)"
    )
    parser.add_argument(
        "--report-only", action="store_true", help="report on the existing file without training"
    )
    options = parser.parse_args()
    gym.register_envs(highway_env)
    model = None if options.report_only else train(options.steps, options.seed)
    if model is not None:
        write_actor(options.output, actor_of(model))
    policy = PpoPolicy(read_actor(options.output))
    crashed, observations = crashes(policy, options.episodes)
    print(
        f"Crashed in {crashed} of {options.episodes} episodes of highway-v0 ({len(observations)} decisions)."
    )
    if model is not None:
        sample = observations[:500]
        print(
            f"numpy and stable-baselines3 agree on {agreement(model, policy, sample)} of {len(sample)} observations."
        )


if __name__ == "__main__":
    main()
