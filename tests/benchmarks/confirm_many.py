"""Does the plain environment agree with the search? Every collision of several policies, driven again in gymnasium.

    python -m tests.benchmarks.confirm_many [--collisions 1100]

Random scenarios are run by ``rollout``; each that collides is run again through ``env.step`` of the registered
highway-env environment. Prints for every policy how many agree, how many of these at the same tick and with the same
states to the last bit, and each disagreement.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from example_ads import blind_lane_change, constant_speed, defects, idm_mobil, ppo
from pytest_pafot import Highway, Run, World
from pytest_pafot.findings.replay import disagreement
from pytest_pafot.searching import SearchSpace, sample
from pytest_pafot.trace import Outcome, Trace


@dataclass
class Tally:
    """How the collisions of one policy compare."""

    name: str
    runs: int = 0
    collisions: int = 0
    agree: int = 0
    same_tick: int = 0
    same_bits: int = 0
    seconds: list[float] = field(default_factory=lambda: [0.0, 0.0])
    disagreements: list[str] = field(default_factory=list)

    def compare(self, world: Highway | World, first: Trace, ads: Callable[..., Any]) -> None:
        """Drive a colliding run again."""
        started = time.process_time()
        again = world.rollout_in_gym(first.executed, ads)
        self.seconds[1] += time.process_time() - started
        self.collisions += 1
        differs = disagreement(Run(first), Run(again))
        self.agree += not differs
        self.same_tick += first.collision == again.collision
        self.same_bits += np.array_equal(first.states, again.states)
        if differs:
            self.disagreements.append(f"{first.executed!r}: {differs}")

    def __str__(self) -> str:
        own, gym = (1e3 * seconds / max(count, 1) for seconds, count in zip(
            self.seconds, (self.runs, self.collisions), strict=True))  # fmt: skip
        return (
            f"{self.name:26} {self.runs:5} runs {self.collisions:5} collisions, agree {self.agree:5}, same collision "
            f"{self.same_tick:5}, same bits {self.same_bits:5}   {own:5.1f} ms a run, {gym:6.1f} ms a confirmation"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--collisions", type=int, default=1100)
    parser.add_argument(
        "--seconds", type=float, default=40.0, help="of processor time for each policy that collides seldom"
    )
    arguments = parser.parse_args()
    highway = Highway()
    cases: list[tuple[str, Highway | World, Callable[..., Any]]] = [
        ("idm-mobil", highway, idm_mobil.make),
        *((name, highway, defects.make(name)) for name in ("looks-only-ahead", "brakes-weakly", "two-defects")),
        ("idm-mobil in highway-v0", World("highway-v0"), idm_mobil.make),
        ("ppo in highway-v0", World("highway-v0"), ppo.make),
        ("blind-lane-change", highway, blind_lane_change.make),
        ("constant-speed", highway, constant_speed.make),
    ]
    tallies: list[Tally] = []
    for number, (name, world, ads) in enumerate(cases):
        total = sum(tally.collisions for tally in tallies)
        share = -(-(arguments.collisions - total) // (len(cases) - number))
        seconds = arguments.seconds if number < len(cases) - 2 else float("inf")
        tallies.append(_compared(Tally(name), world, ads, share, seconds))
    total = sum(tally.collisions for tally in tallies)
    print(f"{sum(tally.agree for tally in tallies)} of {total} collisions agree")
    for tally in tallies:
        for line in tally.disagreements:
            print(f"{tally.name}: {line}")


def _compared(tally: Tally, world: Highway | World, ads: Callable[..., Any], wanted: int, seconds: float) -> Tally:
    rng = np.random.default_rng(0)
    space = SearchSpace(speed_limit=world.speed_limit, genes=-(-int(world.longest_run) // 10))
    while tally.collisions < wanted and sum(tally.seconds) < seconds:
        scenario = sample(space, rng)
        started = time.process_time()
        trace = world.rollout(scenario, ads)
        tally.seconds[0] += time.process_time() - started
        tally.runs += 1
        if trace.outcome is Outcome.COLLISION:
            tally.compare(world, trace, ads)
    print(tally, flush=True)
    return tally


if __name__ == "__main__":
    main()
