"""How many steps per second of processor time does training take? Each step includes the decision of the PPO policy:

    python -m tests.benchmarks.training [--seconds 8]

It compares ``pafot.training_env`` with only scenarios, with only ordinary traffic, and the environment as gymnasium
makes it. They take turns in one process.
"""

from __future__ import annotations

import time
from typing import Any

import gymnasium as gym

import pytest_pafot as pafot
from example_ads import ppo
from tests.benchmarks.command import options, print_head

WORLDS = (("highway-fast-v0", 5), ("highway-fast-v0", 1), ("highway-v0", 1))
"""The environments, with the decisions per second of simulated time."""
TURNS = 4


class Drive:
    """Episodes of an environment, one after another."""

    def __init__(self, env: Any) -> None:
        self._env, self._policy = env, ppo.make()
        self._seen, _ = env.reset(seed=0)
        self.steps, self.seconds = 0, 0.0

    def go_on(self, seconds: float) -> None:
        """Drive for a time, including resets [s]."""
        began = time.process_time()
        while time.process_time() - began < seconds:
            self._seen, _, terminated, truncated, _ = self._env.step(self._policy(self._seen))
            self.steps += 1
            if terminated or truncated:
                self._seen, _ = self._env.reset()
        self.seconds += time.process_time() - began


def main() -> None:
    """Print the table."""
    seconds = options(__doc__, seconds=8.0).seconds  # for each cell
    print_head("Environment", "Decisions a second", "Scenarios", "Ordinary traffic", "`gymnasium.make`")
    for env_id, hertz in WORLDS:
        config = {"policy_frequency": hertz}
        world = pafot.World(env_id, config)
        drives = [Drive(pafot.training_env(world, share=share)) for share in (1.0, 0.0)]
        drives.append(Drive(gym.make(env_id, config=config)))
        for _ in range(TURNS):
            for drive in drives:
                drive.go_on(seconds / TURNS)
        rates = [f"{float(f'{drive.steps / drive.seconds:.2g}'):,.10g}" for drive in drives]
        print(f"| `{env_id}` | {hertz} | {' | '.join(rates)} |")


if __name__ == "__main__":
    main()
