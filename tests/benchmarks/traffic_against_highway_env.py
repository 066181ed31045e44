"""Does compiled traffic give the same episodes as the steps of highway-env, and what does each cost?

    python -m tests.benchmarks.traffic_against_highway_env [EPISODES]

Each of nine environments gets a ninth of the episodes (450), from which the time of 1,000 is extrapolated. Outcome and
time must be the same, and all positions up to rounding, up to the tick before the ego is flagged. At that tick,
highway-env pushes boxes apart along the shortest of several normals, which rounding errors decide.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from example_ads import idm_mobil, ppo
from pytest_pafot import World
from pytest_pafot.model.trace import Outcome
from pytest_pafot.world.engines.episode import Episode
from pytest_pafot.world.engines.ordinary_traffic import drive

WITHIN = 1e-9
"""The largest distance [m] from rounding, also for headings [rad] and speeds [m/s], unless a vehicle crawls."""


def undecided() -> Callable[[Any], int]:
    """Return a policy that takes random meta-actions, and crashes soon."""
    rng = np.random.default_rng(1)
    return lambda observation: int(rng.integers(5))


def swerving() -> Callable[[Any], Any]:
    """Return a policy that steers and accelerates at random."""
    rng = np.random.default_rng(1)
    return lambda observation: rng.uniform((-0.5, -0.02), (0.5, 0.02))


def straying() -> Callable[[Any], Any]:
    """Return a policy that steers at random."""
    rng = np.random.default_rng(1)
    return lambda observation: rng.uniform(-0.1, 0.1, size=1)


CASES = {
    "highway-fast-v0, PPO": (World("highway-fast-v0"), ppo.make),
    "highway-v0, 15 vehicles, random meta-actions": (World("highway-v0", {"vehicles_count": 15}), undecided),
    "highway-fast-v0, 5 lanes, 40 vehicles, dense, IDM+MOBIL": (
        World("highway-fast-v0", {"lanes_count": 5, "vehicles_count": 40, "vehicles_density": 2}),
        idm_mobil.make,
    ),
    "highway-v0, 2 lanes, 12 vehicles, random steering": (
        World(
            "highway-v0",
            {
                "lanes_count": 2,
                "vehicles_count": 12,
                "policy_frequency": 5,
                "action": {"type": "ContinuousAction"},
                "duration": 20,
            },
        ),
        swerving,
    ),
    "merge-v0, random meta-actions": (World("merge-v0"), undecided),
    "roundabout-v0, IDM+MOBIL": (World("roundabout-v0"), idm_mobil.make),
    "racetrack-v0, random steering": (World("racetrack-v0"), straying),
    "exit-v0, random meta-actions": (World("exit-v0"), undecided),
    "intersection-v0, IDM+MOBIL": (World("intersection-v0"), idm_mobil.make),
}


def difference(one: Episode, other: Episode) -> float:
    """Return the largest distance [m], also of headings [rad] and speeds [m/s]; infinity if the endings differ."""
    if (one.outcome, one.seconds) != (other.outcome, other.seconds) or one.recording is None or other.recording is None:
        return float("inf")
    states, others = one.recording.states, other.recording.states
    if states.shape != others.shape or (np.isnan(states) != np.isnan(others)).any():  # NaN: not on the road
        return float("inf")
    last = -1 if one.outcome is Outcome.COLLISION else None
    return float(np.nan_to_num(np.abs(states - others))[:last].max(initial=0.0))


def main(episodes: int) -> None:
    """Print a line for each environment."""
    for name, (world, factory) in CASES.items():
        taken, worst, crashes, different = {True: 0.0, False: 0.0}, 0.0, 0, 0
        count = episodes // len(CASES)
        for seed in range(count):
            made = {}
            for may_compile in (True, False):
                started = time.process_time()
                made[may_compile] = drive(
                    world.environment,
                    factory,
                    seed,
                    hang_limit=60.0,
                    may_compile=may_compile,
                    is_recorded=not may_compile,
                )
                taken[may_compile] += time.process_time() - started
            # Recording takes longer than compiled traffic itself, so it is not in the time.
            made[True] = drive(world.environment, factory, seed, hang_limit=60.0, is_recorded=True)
            apart = difference(made[True], made[False])
            worst, different = max(worst, apart), different + (apart > WITHIN)
            crashes += made[True].outcome is Outcome.COLLISION
        compiled, stepped = (1000 * taken[may_compile] / count for may_compile in (True, False))
        print(f"{name}: {count} episodes, {crashes} crashes, {different} different, at most {worst:.1e} apart")
        print(f"    1,000 take {compiled:.0f} s compiled, {stepped:.0f} s by the environment's steps", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 450)
