"""Train the example PPO policy on its failures, and measure the effect on them and on its ordinary driving.

    pip install "pytest-pafot[train]"
    python -m tests.benchmarks.train_on_failures

This takes minutes; ``--seeds 3 --workers 9`` repeats each training with more seeds, on nine cores. It prints these
shares before and after training, each with its interval:

- the random scenarios, not used for training, in which the policy is responsible for a crash;
- the failures among them before training in which it still is: one column for the fault that it was trained on, a
  missing response to a leader that brakes, and one for all other faults;
- the episodes in the environment's own traffic with a crash.

Always read the last column, too: a policy that has forgotten how to drive also fails in few scenarios.
"""

from __future__ import annotations

import argparse
import multiprocessing
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np

import pytest_pafot as pafot
from example_ads.ppo import PpoPolicy, read_actor
from example_ads.ppo.train import actor_modules, actor_of, give_actor, untrained
from pytest_pafot.attribution.responsibility import Fault, rss_rule
from pytest_pafot.extras.episodes.rate import Pair, Rate, driven
from pytest_pafot.extras.training import random_scenarios
from pytest_pafot.support.proportions import interval_text

WORLD = pafot.World("highway-fast-v0")
TRAINED_ON: Fault = "leader-unanswered"
ARMS = {"failures only": 1.0, "half failures": 0.5, "no failures": 0.0}
"""The shares of failures among the episodes of a training; the last shows the effect of more training by itself."""
CRITIC_STEPS = 8_192
"""The steps of training only the critic. Only the actor is stored, and a new critic must first learn the value of its
decisions before the actor may change."""


@dataclass(frozen=True, kw_only=True)
class Measured:
    """The measured driving of a policy.

    Attributes:
        faults: for each scenario, the fault by which the policy is responsible for a crash, or None.
        rate: crash rate in the environment's own traffic.
    """

    faults: tuple[Fault | None, ...]
    rate: Rate


def scenarios(seed: int, count: int) -> list[pafot.Scenario]:
    """Return random scenarios."""
    draw, rng = random_scenarios(WORLD), np.random.default_rng(seed)
    return [draw(rng) for _ in range(count)]


def faults(policy: PpoPolicy, given: Sequence[pafot.Scenario]) -> tuple[Fault | None, ...]:
    """Return for each scenario the fault by which a policy is responsible for a crash, or None."""
    traces = WORLD.rollout_batch(given, lambda: policy)
    return tuple(rss_rule(trace).fault for trace in traces)


def measured(name: str, policy: PpoPolicy, given: Sequence[pafot.Scenario], episodes: int) -> Measured:
    """Drive a policy in scenarios, and in ordinary traffic with the seeds 0, 1, 2 ..."""
    rows = tuple(driven(WORLD, name, lambda: policy, seed, is_planner=False) for seed in range(episodes))
    return Measured(faults=faults(policy, given), rate=Rate(ads=name, rows=rows))


def trained(failures: Sequence[pafot.Scenario], share: float, steps: int, seed: int) -> PpoPolicy:
    """Return the policy after this many more steps, in episodes of which a share are failures."""
    model = untrained(pafot.training_env(WORLD, failures, share), seed, learning_rate=3e-4)
    give_actor(model, read_actor())
    for module in actor_modules(model):
        module.requires_grad_(requires_grad=False)
    model.learn(total_timesteps=CRITIC_STEPS)
    for module in actor_modules(model):
        module.requires_grad_(requires_grad=True)
    model.learn(total_timesteps=steps)
    return PpoPolicy(actor_of(model))


def arm(
    name: str,
    seed: int,
    failures: Sequence[pafot.Scenario],
    fresh: Sequence[pafot.Scenario],
    steps: int,
    episodes: int,
) -> Measured:
    """Train and measure one arm."""
    return measured(f"{name}, seed {seed}", trained(failures, ARMS[name], steps, seed), fresh, episodes)


def row(before: Measured, after: Measured) -> str:
    """Return a line of the table."""
    pairs = list(zip(before.faults, after.faults, strict=True))
    groups = (
        [now for _, now in pairs],
        [now for then, now in pairs if then == TRAINED_ON],
        [now for then, now in pairs if then not in (None, TRAINED_ON)],
    )
    shares = [f"{interval_text(sum(now is not None for now in each), len(each))} of {len(each)}" for each in groups]
    ordinary = f"{interval_text(len(after.rate.crashed), after.rate.episodes)} of {after.rate.episodes}"
    return f"| {' | '.join([after.rate.ads, *shares, ordinary])} |"


def main() -> None:
    """Find failures, train, and report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--steps", type=int, default=61_440, help="steps of each training (default: %(default)s)")
    parser.add_argument("--seeds", type=int, default=1, help="trainings of each kind (default: %(default)s)")
    parser.add_argument(
        "--scenarios",
        type=int,
        default=1500,
        help="scenarios to train on, and as many to measure with (default: %(default)s)",
    )
    parser.add_argument(
        "--episodes", type=int, default=1000, help="episodes of ordinary traffic (default: %(default)s)"
    )
    parser.add_argument("--workers", type=int, default=1, help="processes (default: %(default)s)")
    options = parser.parse_args()
    shipped = PpoPolicy(read_actor())
    known, fresh = scenarios(1, options.scenarios), scenarios(2, options.scenarios)
    failures = [each for each, fault in zip(known, faults(shipped, known), strict=True) if fault == TRAINED_ON]
    before = measured("before", shipped, fresh, options.episodes)
    print(f"{len(failures)} of {len(known)} scenarios to train on\n")
    print("| | Random scenarios | Failures of the kind trained on | Failures of other kinds | Ordinary traffic |")
    print("| --- | --- | --- | --- | --- |")
    print(row(before, before), flush=True)
    with ProcessPoolExecutor(options.workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        jobs = [
            pool.submit(arm, name, seed, failures, fresh, options.steps, options.episodes)
            for name in ARMS
            for seed in range(options.seeds)
        ]
        for job in jobs:
            print(row(before, job.result()), flush=True)
    print()
    for job in jobs:
        print(Pair.of(before.rate, job.result().rate).sentence)


if __name__ == "__main__":
    main()
