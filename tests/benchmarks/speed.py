"""How fast does a world run, and where does the time go? One command for the figures of docs/guide/ci.md:

    python -m tests.benchmarks.speed [--rounds 7] [--parts engines search]

- ``engines``: one run of 60 s with two NPCs, by the usual ``gymnasium.make`` + ``env.step`` loop with its Kinematics
  observation, by the same with the observation stubbed, and by the kernel compiled and interpreted. All take turns in
  one process, and their trajectories are compared by hash in that process.
- ``search``: the cost of searches in addition to their rollouts.

Times are processor time, so a noisy machine hardly changes ratios; nothing is asserted.
"""

from __future__ import annotations

import hashlib
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np
from highway_env.vehicle.behavior import IDMVehicle

from pytest_pafot import Highway, PositionInstruction, Scenario, Trace, explore
from pytest_pafot.model.trace import FloatArray
from pytest_pafot.world import kernel
from tests.benchmarks.command import holds, options
from tests.helpers.gym_loop import drive, make_env, place, si_actions
from tests.helpers.interpreted import InterpretedWorld

SCENARIO = Scenario(
    npcs=(
        tuple(
            PositionInstruction(cell, speed) for cell, speed in ((8, 22.0), (1, 26.0), (1, 24.0))
        ),
        tuple(
            PositionInstruction(cell, speed) for cell, speed in ((4, 22.0), (3, 24.0), (4, 23.0))
        ),
    ),
    gene_seconds=20.0,
)
KERNEL = "kernel, compiled" if kernel.is_compiled() else "kernel, interpreted"


def median_ms(way: Callable[[], object], rounds: int, repeats: int = 1) -> float:
    """Return the median processor time of one call [ms]."""
    times = []
    for _ in range(rounds):
        started = time.process_time()
        for _ in range(repeats):
            way()
        times.append((time.process_time() - started) / repeats)
    return statistics.median(times) * 1e3


def gentle_actions(count: int) -> list[FloatArray]:
    """Return one continuous action in [-1, 1]^2 per decision: the ego's speed and steering vary a little."""
    return [
        np.array([0.05 * np.sin(k / 5), 0.002 * np.cos(k / 7)], dtype=np.float32)
        for k in range(count)
    ]


def playback(
    actions: list[tuple[float, float]],
) -> Callable[[], Callable[[object], tuple[float, float]]]:
    """Return a factory of an ADS that returns the actions of a list one after another."""

    def make() -> Callable[[object], tuple[float, float]]:
        rest = iter(actions)
        return lambda observation: next(rest)

    return make


def idle() -> Callable[[object], tuple[float, float]]:
    """Return the simplest possible ADS."""
    return lambda observation: (0.0, 0.0)


def engines(rounds: int) -> None:
    """Run part ``engines``."""
    for ads_hz in (5, 15):
        _engines_at(Highway(speed_limit=30.0, ads_hz=ads_hz), rounds)


def _engines_at(world: Highway, rounds: int) -> None:
    actions = gentle_actions(60 * world.ads_hz)
    ads, other = playback(si_actions(actions)), InterpretedWorld()
    trace = world.rollout(SCENARIO, ads)
    logs: dict[str, Any] = {}

    def own(road: Any, name: str) -> Callable[[], None]:
        def run() -> None:
            logs[name] = road.rollout(SCENARIO, ads).states[1:, :, :4]

        return run

    def gym(stub: bool, name: str) -> Callable[[], None]:
        env = make_env(trace)

        def run() -> None:
            env.reset(seed=0)
            log = place(env, trace, stub_observation=stub)
            drive(env, trace, actions)
            logs[name] = np.array(log.rows)

        return run

    stock, stubbed = "gym, Kinematics", "gym, observation stubbed"
    plain = other.room.Highway(speed_limit=30.0, ads_hz=world.ads_hz)

    def interpreted() -> None:
        with other.in_place():
            own(plain, "kernel, interpreted")()

    ways = {
        stock: (gym(False, stock), 1),
        stubbed: (gym(True, stubbed), 1),
        "kernel, interpreted": (interpreted, 5),
        KERNEL: (own(world, KERNEL), 50),
    }
    times: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(rounds):
        for name, (way, repeats) in ways.items():
            times[name].append(median_ms(way, 1, repeats))
    hashes = {
        name: hashlib.sha256(np.ascontiguousarray(log + 0.0).tobytes()).hexdigest()[:8]
        for name, log in logs.items()
    }
    print(f"\n60 s, 2 NPCs, {world.physics_hz}/{world.ads_hz} Hz, trivial ADS, {rounds} rounds")
    for name, own_times in times.items():
        by_stub, by_stock = (
            statistics.median(a / b for a, b in zip(times[gym_name], own_times, strict=True))
            for gym_name in (stubbed, stock)
        )
        print(
            f"  {name:26}{statistics.median(own_times):10.3f} ms   {by_stub:7.1f} x stubbed gym {by_stock:8.1f} x gym"
            f"   trajectory {hashes[name]}"
        )


@dataclass(frozen=True, kw_only=True)
class TimedHighway(Highway):
    """A road that records how long its runs take."""

    # processor time of each run [s]
    spent: list[float] = field(default_factory=list, compare=False)
    guards_ads = True  # in the rollout of its base class

    def rollout(self, *args: Any, **more: Any) -> Trace:
        """Run as on any road, and record the time."""
        started = time.process_time()
        trace = super().rollout(*args, **more)
        self.spent.append(time.process_time() - started)
        return trace


def search(rounds: int) -> None:
    """Run part ``search``: searches with the default options, 800 runs and no shrinking, against their rollouts."""
    print(f"\nsearches with blame='ego', beside their rollouts, {KERNEL}, 800 runs")
    arms: dict[str, dict[str, Any]] = {
        "default": {},
        "default, blame='any'": {"blame": "any"},
        "random": {"algorithm": "random"},
        "pafot": {"algorithm": "pafot"},
    }
    for (ego, ads), (arm, more) in product(
        (("constant speed", idle), ("IDM+MOBIL", IDMVehicle)), arms.items()
    ):
        road, started = TimedHighway(), time.process_time()
        told = {
            "holds": holds,
            "world": road,
            "runs": 800,
            "shrink_runs": 0,
            "blame": "ego",
            **more,
        }
        for seed in range(rounds):
            explore(ads, seed=seed, **told)
        total, rollouts, runs = time.process_time() - started, sum(road.spent), len(road.spent)
        each = f"rollout {1e3 * rollouts / runs:.2f} ms, all else {1e3 * (total - rollouts) / runs:.2f} ms"
        print(f"  {ego:15} {arm:22} {runs} runs: {each}, {(total - rollouts) / rollouts:.2f} of it")


PARTS: dict[str, Callable[[int], None]] = {"engines": engines, "search": search}


def main() -> None:
    arguments = options(__doc__, rounds=7, parts=PARTS)
    for part in arguments.parts:
        PARTS[part](arguments.rounds)


if __name__ == "__main__":
    main()
