"""How fast a world runs, against the usual ``gymnasium.make`` + ``env.step`` loop on the same actions.

    python -m tests.benchmarks.world_against_gym [--rounds 9]

Prints scenario-seconds per second of three ways to run the same 60 s with two NPCs and the same trajectories:
``pafot.Highway``, ``highway-v0`` with its Kinematics observation, and ``highway-v0`` with the observation stubbed.
All three take turns in one process and are measured in processor time, so that a noisy machine changes the
ratios little.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import numpy as np

from pytest_pafot import Highway, PositionInstruction, Scenario, Trace
from pytest_pafot.trace import FloatArray
from tests.support.gym_loop import drive, make_env, place, si_actions

SCENARIO = Scenario(
    npcs=(
        tuple(PositionInstruction(cell, speed) for cell, speed in ((8, 22.0), (1, 26.0), (1, 24.0))),
        tuple(PositionInstruction(cell, speed) for cell, speed in ((4, 22.0), (3, 24.0), (4, 23.0))),
    ),
    gene_seconds=20.0,
)


def gentle_actions() -> list[FloatArray]:
    """One continuous action in [-1, 1]^2 per decision: the ego breathes and weaves a little."""
    return [np.array([0.05 * np.sin(k / 5), 0.002 * np.cos(k / 7)], dtype=np.float32) for k in range(300)]


class Playback:
    """An ADS that returns a list of actions, one after the other."""

    def __init__(self, actions: list[tuple[float, float]]) -> None:
        self._actions = iter(actions)

    def __call__(self, observation: object) -> tuple[float, float]:
        return next(self._actions)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=9)
    rounds = parser.parse_args().rounds
    world, actions = Highway(speed_limit=30.0), gentle_actions()
    metres = si_actions(actions)

    def pafot() -> Trace:
        return world.rollout(SCENARIO, lambda: Playback(metres))

    trace = pafot()
    envs = {stub: make_env(trace) for stub in (False, True)}
    logs = {}

    def gym(stub: bool) -> Callable[[], None]:
        def loop() -> None:
            env = envs[stub]
            env.reset(seed=0)
            logs[stub] = place(env, trace, stub_observation=stub)
            drive(env, trace, actions)

        return loop

    ways: dict[str, Callable[[], object]] = {
        "pafot.Highway": pafot,
        "gym, Kinematics": gym(stub=False),
        "gym, observation stubbed": gym(stub=True),
    }
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(rounds):
        for name, way in ways.items():
            started = time.process_time()
            way()
            seconds[name].append(time.process_time() - started)

    npcs, hertz = len(SCENARIO.npcs), f"{trace.physics_hz}/{trace.ads_hz} Hz"
    print(f"{trace.duration:g} s simulated, {npcs} NPCs, {hertz}, {rounds} rounds, medians of processor time")
    ours = seconds["pafot.Highway"]
    for name, times in seconds.items():
        ratio = statistics.median(theirs / own for theirs, own in zip(times, ours, strict=True))
        rate = trace.duration / statistics.median(times)
        milliseconds = statistics.median(times) * 1e3
        print(f"{name:26}{milliseconds:9.1f} ms {rate:8.0f} scenario-s/s   pafot is {ratio:6.1f}x as fast")
    for stub, log in logs.items():
        difference = np.abs(np.array(log.rows)[: trace.ticks] - trace.states[1:, :, :4]).max()
        print(f"largest difference to gym {'with stubbed observation' if stub else 'with Kinematics'}: {difference:g}")


if __name__ == "__main__":
    main()
