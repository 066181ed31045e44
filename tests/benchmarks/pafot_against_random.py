"""Does the search find more collisions than chance? PAFOT against random chains, with IDM+MOBIL as the ego.

    python -m tests.benchmarks.pafot_against_random [--seeds 10] [--generations 20]

Prints for every seed the share of colliding scenarios among the unique ones simulated, split by who is responsible
by the authors' position rule, and the Mann-Whitney U test of the shares. Random gets as many scenarios as PAFOT
simulated. Needs the extra ``bench`` (scipy).
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.stats import mannwhitneyu

from example_ads import idm_mobil
from pytest_pafot import Highway, Outcome, Scenario
from pytest_pafot.findings.responsibility import position_rule
from pytest_pafot.searching import Evaluation, PafotSearch, SearchSpace, run_campaign, sample
from pytest_pafot.searching.fitness import resolve


@dataclass
class Tally:
    """What the unique scenarios of one search showed."""

    world: Highway
    scenarios: int = 0
    collisions: int = 0
    invalid: int = 0
    ego: int = 0
    seconds: float = 0.0
    seen: set[Scenario] = field(default_factory=set)

    def evaluate(self, scenarios: Sequence[Scenario]) -> list[Evaluation]:
        """Simulate and count; a collision is what fails."""
        return [self._one(scenario) for scenario in scenarios]

    def _one(self, scenario: Scenario) -> Evaluation:
        trace = self.world.rollout(scenario, idm_mobil.make)
        collided = trace.outcome is Outcome.COLLISION
        if scenario not in self.seen:
            self.seen.add(scenario)
            self.scenarios += 1
            self.collisions += collided
            self.invalid += trace.outcome is Outcome.INVALID
            self.ego += position_rule(trace) == "ego"
            self.seconds += trace.duration
        return Evaluation.of(trace, fitness=resolve("default")(trace), failing=collided)

    @property
    def share(self) -> float:
        """Colliding among all unique scenarios."""
        return self.collisions / self.scenarios

    def __str__(self) -> str:
        return (
            f"{self.collisions:3}/{self.scenarios:<3} = {self.share:5.1%} (ego {self.ego:2}, "
            f"npc {self.collisions - self.ego:3}, invalid {self.invalid:2}, "
            f"{self.seconds / self.scenarios:4.1f} s each)"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--generations", type=int, default=20)
    arguments = parser.parse_args()
    world, space = Highway(), SearchSpace()
    searched, drawn = [], []
    for seed in range(arguments.seeds):
        pafot = Tally(world)
        for _ in run_campaign(PafotSearch(space), pafot.evaluate, generations=arguments.generations, seed=seed):
            pass
        random = Tally(world)
        rng = np.random.default_rng(seed)
        while random.scenarios < pafot.scenarios:
            random.evaluate([sample(space, rng)])
        searched.append(pafot)
        drawn.append(random)
        print(f"seed {seed:2}   pafot {pafot}   random {random}", flush=True)
    ahead = sum(a.share > b.share for a, b in zip(searched, drawn, strict=True))
    test = mannwhitneyu([t.share for t in searched], [t.share for t in drawn], alternative="greater")
    for name, tallies in (("pafot", searched), ("random", drawn)):
        total = sum(t.collisions for t in tallies) / sum(t.scenarios for t in tallies)
        ego = sum(t.ego for t in tallies) / max(sum(t.collisions for t in tallies), 1)
        print(f"{name:6} {total:.1%} of all scenarios collide; the ego is responsible for {ego:.1%} of the collisions")
    print(f"pafot is ahead on {ahead} of {arguments.seeds} seeds; Mann-Whitney U, one-sided: p = {test.pvalue:.2g}")


if __name__ == "__main__":
    main()
